"""One obstacle at any angle: what the number of headings lets a robot reach, and by which way.

Reads a robot, kinds of obstacles, angles and a number of trials; lays each obstacle turned about
the middle of a map that it crosses from border to border, plans over it with all specialists, and
drives the route. Gives success, failures by reason, SPL and the time to plan by kind and angle.
Source: the obstacles are the paper's (Sec. IV-A), which stand square to its 8 headings.

SPL divides by the shortest way of the geometry itself, which knows of no cells and no headings:
straight to where the beam or the valley begins, along its middle, straight on to the goal (over
other kinds the straight line), less the radius within which the goal counts as reached.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Annotated

import numpy as np
from annotated_types import Len

from fgtutor.baselines import OURS, ours
from fgtutor.directions import HeadingCount
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.report import (
    Findings,
    markdown,
    reliability_chart,
    run_and_report,
    shares_chart,
)
from fgtutor.evaluation.success import Trials, cut, terrain_seed
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import (
    DisturbedConfig,
    Ground,
    TrialRow,
    by_cell,
    drive_plans,
    failures,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.io.validation import Share as Fraction
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.statistics import Share, spl
from fgtutor.world.terrain import Terrain
from fgtutor.world.turned import Degrees, make_turned

COMMAND = "evaluate turned"


@dataclass(frozen=True, kw_only=True)
class TurnedConfig(DisturbedConfig):
    """Cross one obstacle, turned by some angles."""

    finer_headings: HeadingCount | None = None
    """Headings to try where the others find no sure route (ours 48, the paper's 8: none)."""
    robot: str = "a1"
    """Which robot."""
    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Kinds of obstacles; default: those of the robot's mixed terrain."""
    angles: Annotated[tuple[Degrees, ...], Unique, Len(1)] = (0.0, 10.0, 22.0, 30.0, 37.0, 45.0)
    """Angles of the way over the obstacle, degrees counter-clockwise from +x."""
    trials: Trials = 20
    """Trials per kind and angle, each on a ground of its own. With more of them in the same folder,
    only the new ones are driven."""
    difficulty: Fraction = 1.0
    """Difficulty of all obstacles."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of obstacles to cross."""
        return self.terrains or ROBOTS[self.robot].scale.mixed

    def load_zoo(self) -> dict[str, Specialist]:
        """Return the specialists, which our planner fuses."""
        return load_zoo(self.robot, self.home)

    def terrain(self, kind: str, angle: float, trial: int = 0) -> Terrain:
        """Return the ground of one trial: the same layout at every angle."""
        seed = terrain_seed(self.seed, trial)
        return make_turned(
            kind, robot=self.robot, angle=angle, difficulty=self.difficulty, seed=seed
        )


class TurnedRow(TrialRow):
    """A trial over a turned obstacle, as a report keeps it."""

    angle: float
    """By how much the obstacle is turned, degrees."""
    shortest: float
    """The length of the shortest way to where the goal counts as reached, m."""
    planned: float | None
    """The route's length, m."""
    planning: float
    """Time on one core from the map to the route, s. It alone depends on the machine."""


def shortest(terrain: Terrain) -> float:
    """Return the length of a terrain's lane to where its goal counts as reached, m."""
    lane = np.array(terrain.lane)
    return float(np.hypot(*np.diff(lane, axis=0).T).sum()) - FollowConfig().goal_radius


def run_task(
    config: TurnedConfig, kind: str, angle: float, indices: Sequence[int]
) -> list[TurnedRow]:
    """Do one task: some grounds of one kind at one angle."""
    zoo, settings = config.load_zoo(), config.planning
    grounds = [
        Ground(
            terrain=config.terrain(kind, angle, trial),
            seeds=(terrain_seed(config.seed, trial),),
        )
        for trial in indices
    ]
    maps = [ground.assess(zoo, settings) for ground in grounds]
    plans = plan_all(ours, grounds, maps, settings)
    follow = FollowConfig(hold_steps=settings.hold_steps)
    return [
        {
            **trial.row,
            "angle": angle,
            "shortest": round(shortest(trial.planned.ground.terrain), 3),
            "planned": round(trial.route.length, 3) if trial.route else None,
            "planning": round(trial.planned.seconds, 3),
        }
        for trial in drive_plans(OURS, plans, zoo, follow, config.condition)
    ]


def make_tasks(config: TurnedConfig) -> list[Task]:
    """Cut the evaluation into tasks of one kind and angle each."""
    for kind in config.kinds:  # an unknown name fails here, not in a worker an hour later
        config.terrain(kind, 0.0)
    return [
        Task(
            name=f"{kind}-{angle:g}-{grounds.start:05d}-{grounds.stop:05d}",
            function=run_task,
            arguments=(config, kind, angle, grounds),
        )
        for kind in config.kinds
        for angle in config.angles
        for grounds in cut(config.trials)
    ]


def table(trials: Sequence[TurnedRow]) -> str:
    """Return the trials as a Markdown table, a line per kind and angle."""
    lines = []
    for (kind, angle), cell in by_cell(trials, ("terrain", "angle")).items():
        reached = np.array([trial["outcome"] == "reached" for trial in cell])
        lengths, reference = np.array([(t["length"], t["shortest"]) for t in cell]).T
        lines.append(
            [
                kind,
                f"{angle:g}",
                Share.reached(cell),
                *failures(cell),
                f"{spl(reached, lengths, reference):.3f}",
                f"{median(trial['planning'] for trial in cell):.2f}",
            ]
        )
    columns = "terrain, angle, success (%), no route, fell, timeout, SPL, planning (s)"
    return markdown(columns.split(", "), lines)


def run(config: TurnedConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo, tasks = config.load_zoo(), make_tasks(config)

    def cost() -> Cost:
        each = config.trials * len(config.angles)
        grounds = [config.terrain(kind, config.angles[0]) for kind in config.kinds]
        return estimate(zoo, grounds, grounds=each, episodes=each, condition=config.condition)

    def find(trials: list[TurnedRow]) -> Findings:
        groups: dict[str, dict[str, Share]] = {}
        for (kind, angle), cell in by_cell(trials, ("terrain", "angle")).items():
            groups.setdefault(kind, {})[f"{angle:g} degrees"] = Share.reached(cell)
        title = "One obstacle, turned"
        return Findings(
            table=table(trials),
            caption=(
                f"Success in % with 95 % intervals, {config.trials:,} trials per cell, each on a "
                "held-out ground of its own that the obstacle crosses from border to border; "
                f"robot {config.robot}, difficulty {config.difficulty:g}, specialists "
                f"{', '.join(zoo)}, {config.planning}, seed {config.seed}; "
                f"{config.told(config.condition)}. The planner knows the true map. SPL against "
                "the shortest way of the geometry, "
                f"{fmean(t['shortest'] for t in trials):.2f} m in the mean; planning is the "
                "median time on one core, from the map to the route."
            ),
            figures={"success.svg": shares_chart(groups, title), **reliability_chart(trials)},
        )

    return run_and_report(
        config,
        title=f"Obstacles at any angle ({config.robot})",
        tasks=tasks,
        settings=config.run_settings(
            COMMAND, without=("trials", "terrains"), terrains=config.kinds
        ),
        cost=cost,
        find=find,
    )
