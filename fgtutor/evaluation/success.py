"""Success rates over drawn grounds: what matrix, ablation and newcomer have in common.

Reads a `TrialsConfig`, terrains and the names of planners; gives a row per trial, and a report.
Trial k of a terrain is the same ground, start and goal for all planners.
Source: paper, Sec. IV-B: 40 tasks of 250 trials per terrain, failures by reason.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval

from fgtutor.baselines import planners
from fgtutor.evaluation import report
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.report import Findings
from fgtutor.evaluation.tasks import Row, Task
from fgtutor.evaluation.trials import DisturbedConfig, Ground, TrialRow, by_cell, drive
from fgtutor.io.validation import Share as Fraction
from fgtutor.statistics import Share
from fgtutor.world.terrain import Terrain, make_terrain

GROUNDS = 25
"""Grounds of one task, where each is driven once."""
PAPER_GROUNDS, PAPER_TRIALS = 40, 10_000
"""Tasks of a terrain, and its trials per policy: 40 times 250 (paper, Sec. IV-B)."""
CLEARANCE = 0.5
"""Distance of a drawn start or goal from the obstacle and from the map's border, m."""

Trials = Annotated[int, Interval(ge=1, le=50_000)]
"""A number of trials, as many as the files of a report hold."""


@dataclass(frozen=True, kw_only=True)
class TrialsConfig(DisturbedConfig):
    """What success rates are measured on."""

    trials: Trials | None = None
    """Trials per policy and terrain; default: 50, for the paper's protocol its 10,000. With more
    of them in the same folder, only the new ones are driven, but for the paper's protocol."""
    protocol: Literal["grounds", "paper"] = "grounds"
    """"grounds" crosses a new ground in each trial; "paper" draws 40 grounds with a start and a
    goal each (mixed: its own) and crosses each 250 times."""
    difficulty: Fraction = 1.0
    """Difficulty of all terrains."""

    @property
    def count(self) -> int:
        """Trials per policy and terrain."""
        return self.trials or (PAPER_TRIALS if self.protocol == "paper" else 50)

    @property
    def grounds(self) -> int:
        """Grounds per terrain."""
        return min(self.count, PAPER_GROUNDS) if self.protocol == "paper" else self.count


def terrain_seed(seed: int, trial: int) -> int:
    """Return the terrain seed of a trial: odd, since training draws even ones."""
    return 2 * (seed * 1_000_000 + trial) + 1


def make_ground(config: TrialsConfig, terrain: str, index: int) -> Ground:
    """Make one ground, and say which trials it stands for: every n-th of the terrain's."""
    made = make_terrain(
        terrain,
        robot=config.robot,
        difficulty=config.difficulty,
        seed=terrain_seed(config.seed, index),
        unlike=True,
    )
    if config.protocol == "paper" and terrain != "mixed":
        made = with_random_ends(made, made.seed)
    trials = range(index, config.count, config.grounds)
    return Ground(terrain=made, seeds=tuple(terrain_seed(config.seed, trial) for trial in trials))


def with_random_ends(terrain: Terrain, seed: int) -> Terrain:
    """Return the terrain with start and goal drawn anew, each on the flat ground at one end.

    Which end the start is at is drawn too. A random place might be in a chasm or on a wall.
    """
    rng = np.random.default_rng((seed, 1))
    (x0, y0, x1, y1), parts = terrain.elevation.extent, terrain.sections
    flats = ((x0, parts[0].x0), (parts[-1].x1, x1)) if parts else ((x0, x1), (x0, x1))

    def draw(low: float, high: float) -> float:
        room = max(high - low - 2 * CLEARANCE, 0.0)
        return float((low + high) / 2 + room * (rng.random() - 0.5))

    ends = [(draw(low, high), draw(y0, y1)) for low, high in flats]
    if rng.random() < 0.5:
        ends.reverse()
    return replace(terrain, start=ends[0], goal=ends[1])


def run_task(
    config: TrialsConfig, terrain: str, policies: Sequence[str], indices: Sequence[int]
) -> list[TrialRow]:
    """Do one task: some grounds of one terrain, all policies."""
    zoo, grounds = config.load_zoo(), [make_ground(config, terrain, index) for index in indices]
    known = planners(zoo)
    asked = {name: known[name] for name in policies}
    trials = drive(grounds, asked, zoo, settings=config.planning, condition=config.condition)
    return [trial.row for trial in trials]


def make_tasks(
    config: TrialsConfig,
    terrains: Sequence[str],
    policies: Sequence[str],
    work: Callable[..., list[Any]],
) -> list[Task]:
    """Cut an evaluation into tasks; the cut depends on the trials only, never on the workers.

    `work` does a task, with the arguments of `run_task`.
    """
    for name in terrains:  # an unknown name fails here, not in a worker an hour later
        make_terrain(name, robot=config.robot, difficulty=config.difficulty)
    # A ground that is driven 250 times is work enough for a task.
    size = 1 if config.protocol == "paper" else GROUNDS
    return [
        Task(
            name=f"{terrain}-{grounds.start:05d}-{grounds.stop:05d}",
            function=work,
            arguments=(config, terrain, tuple(policies), grounds),
        )
        for terrain in terrains
        for grounds in cut(config.grounds, size)
    ]


def cut(count: int, size: int = GROUNDS) -> Iterator[range]:
    """Cut `count` grounds into tasks of `size`; a greater count only adds tasks, or fills one."""
    for first in range(0, count, size):
        yield range(first, min(first + size, count))


def run_and_report(
    config: TrialsConfig,
    command: str,
    *,
    title: str,
    terrains: Sequence[str],
    policies: Sequence[str],
    table: Callable[[Sequence[Any]], str],
    work: Callable[..., list[Any]] = run_task,
    remark: Callable[[Sequence[Any]], str] | None = None,
) -> int:
    """Estimate, evaluate, print the table (made of all trials) and write the report.

    `work` is as in `make_tasks`; a `remark` on all trials ends the caption.
    """

    def cost() -> Cost:
        return estimate(
            config.load_zoo(),
            [make_ground(config, terrain, 0).terrain for terrain in terrains],
            grounds=config.grounds,
            episodes=config.count * len(policies),
            condition=config.condition,
        )

    def find(trials: list[Row]) -> Findings:
        shares: dict[str, dict[str, Share]] = {}
        for (terrain, policy), cell in by_cell(trials).items():
            shares.setdefault(terrain, {})[policy] = Share.reached(cell)
        caption = (
            f"Success in % with 95 % intervals, {config.count:,} trials per cell; robot "
            f"{config.robot}, protocol {config.protocol}, {config.planning}, seed {config.seed}; "
            f"{config.told(config.condition)}."
        )
        return Findings(
            table=table(trials),
            caption=f"{caption} {remark(trials)}" if remark else caption,
            figures={
                "success.svg": report.shares_chart(shares, title),
                **report.reliability_chart(trials),
            },
        )

    # By the paper's protocol, their number says which trials a ground is for.
    number = {"trials": config.count} if config.protocol == "paper" else {}
    return report.run_and_report(
        config,
        title=title,
        tasks=make_tasks(config, terrains, policies, work),
        settings=config.run_settings(
            command,
            without=("trials",),
            terrains=terrains,
            policies=policies,
            unlike=True,
            **number,
        ),
        cost=cost,
        find=find,
    )
