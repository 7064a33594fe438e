"""How much a robot and its simulation may change before our planner's policies no longer arrive.

Reads a robot, a number of trials and names of axes; drives the same routes on the same grounds once
per level of each axis, one thing amiss at a time and several together, and on another model of the
robot where there is one. Gives success by terrain and level, the highest level passed on each axis,
and the worst case. What the axes and levels are is the robot's own (`robots.conditions`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

from annotated_types import Interval

from fgtutor.baselines import OURS, planners
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.report import Draw, Findings, markdown, run_and_report, shares_chart
from fgtutor.evaluation.success import Trials, cut, terrain_seed
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import (
    EPISODES,
    Ground,
    Planned,
    PlannedConfig,
    TrialRow,
    by_cell,
    choose,
    drive_plans,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.io.validation import Share as Fraction
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS, conditions_of, never_disturbed
from fgtutor.robots.conditions import Axis, Condition
from fgtutor.statistics import Share
from fgtutor.world.terrain import Terrain, make_terrain

COMMAND = "evaluate robustness"
NOTHING = "undisturbed"
"""The axis on which nothing is amiss; every table begins with it."""


@dataclass(frozen=True, kw_only=True)
class RobustnessConfig(PlannedConfig):
    """Drive our planner's routes under one disturbance after another."""

    axes: Annotated[tuple[str, ...], Unique] = ()
    """Only these axes, such as low-friction; default: all that the robot has."""
    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Only these terrains; default: the robot's own and mixed."""
    trials: Trials = 30
    """Trials per level and terrain, each on a ground of its own. With more of them in the same
    folder, only the new ones are driven."""
    planner: str = OURS
    """Which planner, as in `evaluate baselines`; its policies drive."""
    difficulty: Fraction = 1.0
    """Difficulty of all terrains."""
    passed: Annotated[float, Interval(gt=0, le=1)] = 0.9
    """A level is passed if at least this share of the trials arrives on every terrain."""

    @property
    def chosen(self) -> tuple[str, ...]:
        """The terrains."""
        return self.terrains or (*ROBOTS[self.robot].scale.mixed, "mixed")


class RobustnessRow(TrialRow):
    """A trial, and what was amiss."""

    axis: str
    level: str


def axes(config: RobustnessConfig) -> dict[str, Axis]:
    """Return the axes asked for, `NOTHING` first.

    Raises `ConfigError` for an unknown robot or axis, or for a robot that has none.
    """
    known = conditions_of(config.robot)
    if not known.axes:
        raise never_disturbed(config.robot)
    names = choose("axis", config.axes, known.axes)
    free = Axis(levels={"-": known.undisturbed})
    return {NOTHING: free, **{name: known.axes[name] for name in names}}


def make_ground(config: RobustnessConfig, terrain: str, index: int) -> Ground:
    """Make one ground, the same as that of `evaluate matrix`, to be driven once."""
    seed = terrain_seed(config.seed, index)
    how = {"robot": config.robot, "difficulty": config.difficulty, "seed": seed}
    made = make_terrain(terrain, **how, unlike=True)
    return Ground(terrain=made, seeds=(seed,))


def run_task(
    config: RobustnessConfig, axis: str, terrain: str, indices: range
) -> list[RobustnessRow]:
    """Do one task: plan on some grounds of one terrain, and drive at every level of one axis."""
    zoo = config.load_zoo()
    plans = plan_once(config, terrain, indices, tuple(config.zoo_digests().items()))
    follow = FollowConfig(hold_steps=config.planning.hold_steps)
    return [
        {**trial.row, "axis": axis, "level": level}
        for level, condition in axes(config)[axis].levels.items()
        for trial in drive_plans(config.planner, plans, zoo, follow, condition)
    ]


@lru_cache(maxsize=1)
def plan_once(
    config: RobustnessConfig, terrain: str, indices: range, digests: tuple[tuple[str, str], ...]
) -> list[Planned]:
    """Plan on some grounds of one terrain with a zoo of these digests; tasks in a row share it."""
    zoo, settings = config.load_zoo(), config.planning
    grounds = [make_ground(config, terrain, index) for index in indices]
    maps = [ground.assess(zoo, settings) for ground in grounds]
    return plan_all(planners(zoo)[config.planner], grounds, maps, settings)


def make_tasks(config: RobustnessConfig) -> list[Task]:
    """Cut the evaluation into tasks: some grounds of one terrain, all levels of one axis."""
    for name in config.chosen:  # an unknown name fails here, not in a worker an hour later
        make_terrain(name, robot=config.robot, difficulty=config.difficulty)
    return [
        Task(
            name=f"{axis}-{terrain}-{grounds.start:05d}-{grounds.stop:05d}",
            function=run_task,
            arguments=(config, axis, terrain, grounds),
        )
        for terrain in config.chosen
        for grounds in cut(config.trials, EPISODES)
        for axis in axes(config)
    ]


Cells = dict[tuple[str, str], dict[str, Share]]
"""Success by (axis, level) and terrain."""


def shares(trials: Sequence[RobustnessRow]) -> Cells:
    """Count the trials that arrived, by axis and level, then by terrain."""
    cells: Cells = {}
    for (axis, level, terrain), own in by_cell(trials, ("axis", "level", "terrain")).items():
        cells.setdefault((axis, level), {})[terrain] = Share.reached(own)
    return cells


def is_passed(cell: Mapping[str, Share], least: float) -> bool:
    """Tell whether at least a share `least` arrived on every terrain."""
    return all(share.successes >= least * share.trials for share in cell.values())


def table(trials: Sequence[RobustnessRow], least: float) -> str:
    """Return the trials as a Markdown table: a line per level, a column per terrain."""
    cells = shares(trials)
    terrains = list(next(iter(cells.values())))
    return markdown(
        ["axis", "level", *terrains, "passed"],
        (
            [*names, *(cell[terrain] for terrain in terrains), "yes" if fine else "no"]
            for names, cell in cells.items()
            for fine in [is_passed(cell, least)]
        ),
    )


def highest(cells: Cells, name: str, axis: Axis, least: float) -> str:
    """Say how far an axis is passed: its last level before the first that is not, or all that are
    where they have no order."""
    passed = [is_passed(cells[name, level], least) for level in axis.levels]
    if axis.ordered and not all(passed):
        passed = [fine and i < passed.index(False) for i, fine in enumerate(passed)]
    levels = [level for level, fine in zip(axis.levels, passed, strict=True) if fine]
    best = levels[-1:] if axis.ordered else levels
    return f"{name} {'; '.join(best) or 'none'}"


def worst(cells: Cells) -> str:
    """Say which level on which terrain has the fewest successes; the first of several."""
    every = [(names, terrain, s) for names, cell in cells.items() for terrain, s in cell.items()]
    names, terrain, share = min(every, key=lambda one: one[2].successes / one[2].trials)
    return f"{' '.join(names)} on {terrain}, {share} %"


def ranges(conditions: Mapping[str, Axis], base: Condition) -> dict[str, Any]:
    """Return every number of the undisturbed condition, and those that each level changes."""
    changes = {
        name: {
            level: {
                option: {k: v for k, v in value.items() if base.ranges[option].get(k) != v}
                for option, value in condition.ranges.items()
            }
            for level, condition in axis.levels.items()
        }
        for name, axis in conditions.items()
    }
    return {NOTHING: base.ranges, "changes": changes}


def charts(trials: Sequence[RobustnessRow]) -> dict[str, Draw]:
    """Return a chart per axis: its levels within terrains."""
    groups: dict[str, dict[str, dict[str, Share]]] = {}
    for (axis, level), cell in shares(trials).items():
        for terrain, share in cell.items():
            groups.setdefault(axis, {}).setdefault(terrain, {})[level] = share
    return {f"{axis}.svg": shares_chart(own, f"Success by {axis}") for axis, own in groups.items()}


def run(config: RobustnessConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo, asked = config.load_zoo(), axes(config)  # an unknown robot or axis fails here
    choose("planner", [config.planner], planners(zoo))
    known = conditions_of(config.robot)

    def cost() -> Cost:
        made = [make_ground(config, name, 0).terrain for name in config.chosen]
        grounds: list[Terrain] = made * len(asked)
        levels = sum(len(axis.levels) for axis in asked.values()) / len(asked)
        episodes = round(config.trials * levels)
        return estimate(zoo, grounds, grounds=config.trials, episodes=episodes)

    def find(trials: list[RobustnessRow]) -> Findings:
        cells = shares(trials)
        tops = [highest(cells, *item, config.passed) for item in asked.items()][1:]
        return Findings(
            table=table(trials, config.passed),
            caption=(
                f"Success in % with 95 % intervals, {config.trials:,} trials per cell; robot "
                f"{config.robot}, planner {config.planner}, {config.planning}, seed "
                f"{config.seed}; {config.told(known.undisturbed)}, but for what the level says. "
                f"Passed: at least {100 * config.passed:g} % on every terrain. Highest level "
                f"passed, after all milder ones: {', '.join(tops)}. Worst: {worst(cells)}."
            ),
            figures=charts(trials),
        )

    return run_and_report(
        config,
        title=f"What the policies of {config.planner} endure ({config.robot})",
        tasks=make_tasks(config),
        settings=config.run_settings(
            COMMAND,
            without=("trials", "axes", "terrains", "passed"),
            unlike=True,
            conditions=ranges(known.axes, known.undisturbed),
        ),
        cost=cost,
        find=find,
    )
