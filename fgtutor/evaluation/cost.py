"""What an evaluation will take, told before it starts: a small sample, measured here and now.

Reads a zoo and one terrain of each kind; gives numbers of maps and episodes, and the time.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from fgtutor.evaluation.trials import EPISODES
from fgtutor.execution import FollowConfig, execute_batch
from fgtutor.io.progress import duration
from fgtutor.planning import plan
from fgtutor.robots.conditions import Condition
from fgtutor.specialist import Specialist
from fgtutor.tensorization import assess_all
from fgtutor.world.terrain import Terrain


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What an evaluation takes."""

    work: str
    """What there is to do."""
    seconds: float
    """Time on one core, s."""
    parts: int | None = None
    """Equal parts of it, if one cannot be spread over several cores."""

    def on(self, cores: int) -> str:
        """Say it, for a number of cores."""
        rounds = math.ceil(self.parts / cores) / self.parts if self.parts else 1 / cores
        many = "1 core" if cores == 1 else f"{cores} cores"
        return f"{self.work} about {duration(self.seconds * rounds)} on {many} like this one"


def estimate(
    zoo: Mapping[str, Specialist],
    terrains: Sequence[Terrain],
    *,
    grounds: int,
    episodes: int,
    detour: float = 1.0,
    condition: Condition | None = None,
) -> Cost:
    """Measure one map and one second of driving, and work out what `grounds` and `episodes` of
    each terrain take if every trial has a route, `detour` times the straight line, and drives it
    to the end, under the `condition`."""
    name, specialist = next(iter(zoo.items()))
    sample, at_once = terrains[0], min(episodes, EPISODES)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in the tasks
    try:
        began = time.perf_counter()
        assess_all(sample.elevation, zoo)
        assessed = time.perf_counter()
        free = np.ones((*sample.elevation.shape, 8))
        start, goal = sample.start, sample.goal
        route = plan(
            free, 0 * free, grid=sample.elevation, start=start, goal=goal, names=[name]
        ).raise_for()
        execute_batch(
            [route] * at_once,
            [sample] * at_once,
            {name: specialist},
            seeds=range(at_once),
            config=FollowConfig(patience=0.0, grace=1.0),
            condition=condition,
        )
        driven = time.perf_counter()
    finally:
        torch.set_num_threads(threads)
    cell_seconds = (assessed - began) / sample.elevation.heights.size
    drive_seconds = (driven - assessed) / at_once
    cells = sum(terrain.elevation.heights.size for terrain in terrains)
    metres = sum(float(np.hypot(*np.subtract(t.goal, t.start))) for t in terrains)
    slowest = min(one.command[0] for one in zoo.values())
    driving = episodes * metres * detour / slowest * drive_seconds
    return Cost(
        work=f"{grounds * len(zoo) * len(terrains):,} maps to assess and up to "
        f"{episodes * len(terrains):,} episodes, at most",
        seconds=grounds * cells * cell_seconds + driving,
    )
