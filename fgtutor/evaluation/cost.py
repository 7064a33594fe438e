"""What an evaluation will take, before it starts: a small sample, measured here and now.

Reads a zoo and one terrain of each kind; gives numbers of maps and episodes, and hours. What
another kind of run takes, such as trainings (`sweep`), is an `Estimate` too.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from fgtutor.evaluation.trials import EPISODES
from fgtutor.execution import FollowConfig, execute_batch
from fgtutor.planning import plan
from fgtutor.specialist import Specialist
from fgtutor.tensorization import assess_all
from fgtutor.world.terrain import Terrain


class Estimate(Protocol):
    """What a run will take."""

    def on(self, cores: int) -> str:
        """Say it, for a number of cores."""
        ...


def on_cores(seconds: float, cores: int) -> str:
    """Say what `seconds` of one core come to on a number of them."""
    hours = seconds / cores / 3600
    time = f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"
    return f"about {time} on {cores} core{'s' * (cores > 1)} like this one"


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What an evaluation takes if every trial has a route and none fails early."""

    maps: int
    """Maps to assess, one a ground and policy of the zoo."""
    episodes: int
    """Episodes to drive."""
    seconds: float
    """Time on one core, s."""

    def on(self, cores: int) -> str:
        """Say it, for a number of cores."""
        return (
            f"{self.maps:,} maps to assess and up to {self.episodes:,} episodes, at most "
            f"{on_cores(self.seconds, cores)}"
        )


def estimate(
    zoo: Mapping[str, Specialist], terrains: Sequence[Terrain], *, grounds: int, episodes: int
) -> Cost:
    """Measure one map and one second of driving, and work out what `grounds` and `episodes` of
    each terrain will take."""
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
        )
        driven = time.perf_counter()
    finally:
        torch.set_num_threads(threads)
    cell_seconds = (assessed - began) / sample.elevation.heights.size
    drive_seconds = (driven - assessed) / at_once
    cells = sum(terrain.elevation.heights.size for terrain in terrains)
    metres = sum(float(np.hypot(*np.subtract(t.goal, t.start))) for t in terrains)
    return Cost(
        maps=grounds * len(zoo) * len(terrains),
        episodes=episodes * len(terrains),
        seconds=grounds * cells * cell_seconds
        + episodes * metres / specialist.command[0] * drive_seconds,
    )
