"""Table I: the better the policy, the shorter the route that feasibility allows it.

Reads checkpoints of one specialist and a number of trials; plans and drives each of them over the
same maps, on which three ways lead around a wall: the shorter the way, the higher its steps. Gives
route, length and SPL by checkpoint. Source: paper, Sec. IV-A (Table I, Fig. 4).

SPL divides by a reference length, and the paper does not say by which. Its numbers are those of the
straight line of 5.0 m (0.51 * 9.73 m), which no robot could walk: so we give SPL against `straight`
and against `geodesic`, the shortest way over cells that are no wall.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import numpy as np
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.baselines import single
from fgtutor.directions import HeadingCount, Headings
from fgtutor.errors import TerrainError
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.report import Draw, Findings, markdown, run_and_report
from fgtutor.evaluation.success import terrain_seed
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import DisturbedConfig, Ground, Outcome, by_cell, drive
from fgtutor.io.validation import Count, check_arguments
from fgtutor.io.validation import Share as Fraction
from fgtutor.planning import plan, plan_on_map
from fgtutor.robots import ROBOTS
from fgtutor.routes import Route
from fgtutor.settings import HEADINGS
from fgtutor.specialist import ZOO, Specialist
from fgtutor.statistics import Share, spl
from fgtutor.world.obstacles import Course
from fgtutor.world.terrain import Section, Terrain, TerrainSeed, finish_course

COMMAND = "evaluate adaptation"
CHECKPOINTS = "_checkpoints"
"""Folder of a shipped zoo that holds the early, mid and late checkpoint of its steps."""
WAYS = ("short", "middle", "long")
"""The ways around the wall, from the highest steps to the lowest."""
LENGTHS = (9.9, 14.5, 26.3)
"""What they measure from start to goal along the cells, m; about as in the paper's Table I."""
STRAIGHT, SIDE, BELOW = 5.0, 1.5, 1.0
"""From start to goal; from either to the border beside it, and to the border below, m."""
GATES, GATE_WIDTH = (2.5, 5.1, 11.0), 1.8
"""Where each way's gate begins beyond the line from start to goal, and how wide it is, m."""
WALL = 0.6
"""Height of the wall, m; none of our robots climbs it."""
TREADS = 3
"""Treads of a gate's flight: two steps up, two down."""
RESAMPLES = 2000
"""Resamples of a bootstrap interval."""
Riser = Annotated[float, Interval(ge=0, le=1.5)]
"""A riser as a share of the robot's highest one."""
Risers = tuple[Riser, Riser, Riser]
"""Those of the short, the middle and the long way."""


@dataclass(frozen=True, kw_only=True)
class AdaptationConfig(DisturbedConfig):
    """Plan with early, mid and late checkpoints of one policy, the paper's Table I."""

    trials: Count = 100
    """Trials per checkpoint."""
    maps: Annotated[int, Interval(ge=1, le=100_000)] = 20
    """Maps that the trials are spread over; their steps differ a little."""
    heights: Risers = (0.87, 0.67, 0.2)
    """Risers of the short, the middle and the long way, as shares of the robot's highest one."""
    f_min: Fraction = 0.45
    """Edges less feasible than this do not exist; a robot that may go around can be choosy."""
    zoo: Path | None = None
    """Folder of checkpoints, a specialist folder each; default: those of the shipped steps."""

    @property
    def home(self) -> Path:
        """Where the checkpoints lie."""
        return self.zoo or ZOO / self.robot / CHECKPOINTS

    def load_checkpoints(self) -> dict[str, Specialist]:
        """Return the checkpoints by name, the least trained one first."""
        return dict(
            sorted(self.load_zoo().items(), key=lambda item: item[1].provenance.get("samples", 0))
        )

    def seeds(self, index: int) -> tuple[int, ...]:
        """Return the seeds of the trials on one map: every n-th."""
        trials = range(index, self.trials, min(self.maps, self.trials))
        return tuple(terrain_seed(self.seed, trial) for trial in trials)


def make_map(robot: str, seed: TerrainSeed, heights: Risers = AdaptationConfig.heights) -> Terrain:
    """Make a map with a wall between start and goal, and three gates in it, the nearest first.

    In each gate lie two steps up and two down. The seed draws their risers (up to a tenth less than
    `heights`, shares of the robot's highest) and their treads; the wall and the gates stay.
    Raises `TerrainError` for an unknown robot.
    """
    check_arguments(make_map, locals(), TerrainError)
    if robot not in ROBOTS:
        raise TerrainError(f"unknown robot {robot!r}: choose one of {', '.join(ROBOTS)}")
    width = BELOW + GATES[-1] + GATE_WIDTH
    scale = replace(ROBOTS[robot].scale, width=width, length=STRAIGHT + 2 * SIDE)
    course = Course(scale, 1.0, np.random.default_rng((seed, 2)))
    thickness = course.snap(TREADS * fmean(scale.step_tread))
    x0 = course.snap((scale.length - thickness) / 2)
    x1 = course.snap(x0 + thickness)
    course.full(0.0, scale.length)
    edge, gates = 0.0, []
    for beyond, height in zip(GATES, heights, strict=True):
        y0, y1 = course.snap(BELOW + beyond), course.snap(BELOW + beyond + GATE_WIDTH)
        course.block(x0, x1, edge, y0, WALL)
        _lay_flight(course, (x0, x1), (y0, y1), height * scale.step_height[1])
        gates.append(Section(name="steps", x0=x0, y0=y0, x1=x1, y1=y1))
        edge = y1
    return finish_course(
        course,
        name="nested ways",
        robot=robot,
        seed=seed,
        length=scale.length,
        start=(SIDE, BELOW),
        goal=(SIDE + STRAIGHT, BELOW),
        sections=gates,
    )


def _lay_flight(
    course: Course, x: tuple[float, float], y: tuple[float, float], highest: float
) -> None:
    """Lay two steps up and two down between x[0] and x[1]."""
    first, second = highest * course.rng.uniform(0.9, 1.0, 2)
    shares = np.cumsum(course.rng.uniform(0.9, 1.1, TREADS))
    borders = [x[0], *(course.snap(x[0] + (x[1] - x[0]) * share / shares[-1]) for share in shares)]
    for near, far, top in zip(borders, borders[1:], (first, first + second, second), strict=False):
        course.block(near, far, *y, float(top))


def geodesic(terrain: Terrain, headings: HeadingCount = HEADINGS) -> float:
    """Return the length of the shortest way from start to goal over cells that are no wall, m.

    It goes from cell to cell along as many headings as routes do: no route is shorter.
    """
    open_ = terrain.elevation.heights < WALL - 1e-3
    free = np.repeat(open_[..., None], headings, axis=-1).astype(float)
    free = Headings(headings).least(free)
    start, goal = terrain.start, terrain.goal
    route = plan(free, 0 * free, grid=terrain.elevation, start=start, goal=goal)
    return route.raise_for().length


def way_of(xy: Float[np.ndarray, "n 2"], terrain: Terrain) -> str | None:
    """Return which way the points go, by the gate in which they pass the wall's middle."""
    gate = terrain.sections[0]
    y = xy[np.abs(xy[:, 0] - (gate.x0 + gate.x1) / 2).argmin(), 1]
    ways = (
        way for way, gate in zip(WAYS, terrain.sections, strict=True) if gate.y0 <= y <= gate.y1
    )
    return next(ways, None)


def find_plans(
    terrain: Terrain, zoo: Mapping[str, Specialist], config: AdaptationConfig
) -> dict[str, tuple[Float[Tensor, "nx ny d"], Route | None]]:
    """Return each checkpoint's tensor on a map and its route, None where there is no way for it."""
    ends, plans = (terrain.start, terrain.goal), {}
    for name, specialist in zoo.items():
        plan = plan_on_map(terrain.elevation, {name: specialist}, *ends, settings=config.planning)
        plans[name] = plan.fused, plan.answer or None
    return plans


class AdaptationRow(Outcome):
    """A trial of a checkpoint, as a report keeps it."""

    length: float
    """Distance driven, m."""
    way: str | None
    """The way that was planned, one of `WAYS`."""
    planned: float | None
    """The route's length, m."""
    straight: float
    """The length of the straight line, m."""
    geodesic: float
    """The length of the shortest way over no wall, m."""


def run_task(config: AdaptationConfig, index: int) -> list[AdaptationRow]:
    """Do one task: all trials of all checkpoints on one map."""
    terrain = make_map(config.robot, terrain_seed(config.seed, index), config.heights)
    shortest = round(geodesic(terrain, config.planning.headings), 3)
    ground, zoo = Ground(terrain=terrain, seeds=config.seeds(index)), config.load_checkpoints()
    planners = {name: partial(single, name) for name in zoo}
    return [
        {
            "policy": trial.policy,
            "ground": terrain.seed,
            "seed": trial.seed,
            "outcome": trial.outcome,
            "length": trial.length,
            "way": way_of(trial.route.xy, terrain) if trial.route else None,
            "planned": round(trial.route.length, 3) if trial.route else None,
            "straight": STRAIGHT,
            "geodesic": shortest,
        }
        for trial in drive(
            [ground], planners, zoo, settings=config.planning, condition=config.condition
        )
    ]


def make_tasks(config: AdaptationConfig) -> list[Task]:
    """Cut the evaluation into tasks, one per map."""
    return [
        Task(name=f"map-{index:05d}", function=run_task, arguments=(config, index))
        for index in range(min(config.maps, config.trials))
    ]


Interval95 = tuple[float, float, float]
"""A mean and the ends of its 95 % interval."""


def summarise(trials: Sequence[AdaptationRow]) -> dict[str, Interval95 | None]:
    """Return the `length` of one checkpoint's successes, m, and its SPL, by reference.

    Intervals are bootstrapped over the maps: trials on one map resemble each other.
    """
    maps = by_cell(trials, ("ground",)).values()
    reached = [[t["length"] for t in own if t["outcome"] == "reached"] for own in maps]
    return {
        "length": bootstrap(reached),
        "straight": bootstrap([[_spl(t, t["straight"]) for t in own] for own in maps]),
        "geodesic": bootstrap([[_spl(t, t["geodesic"]) for t in own] for own in maps]),
    }


def _spl(trial: AdaptationRow, reference: float) -> float:
    return spl(np.array([trial["outcome"] == "reached"]), np.array([trial["length"]]), reference)


def bootstrap(groups: Iterable[Sequence[float]]) -> Interval95 | None:
    """Return the mean of all values and its interval, from groups drawn anew; None of no value."""
    groups = [group for group in groups if group]
    if not groups:
        return None
    means, sizes = np.array([(fmean(group), len(group)) for group in groups]).T
    drawn = np.random.default_rng(0).integers(len(groups), size=(RESAMPLES, len(groups)))
    resampled = (means * sizes)[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.percentile(resampled, (2.5, 97.5)).tolist()
    return fmean(value for group in groups for value in group), low, high


def table(trials: Sequence[AdaptationRow], zoo: Mapping[str, Specialist]) -> str:
    """Return the trials as a Markdown table, a line per checkpoint of the zoo.

    A dash stands where nothing was reached.
    """

    def write(mean: Interval95 | None, digits: int) -> str:
        value, low, high = (f"{number:.{digits}f}" for number in mean or (0.0,) * 3)
        return f"{value} ({low}-{high})" if mean else "-"

    cells, lines = by_cell(trials, ("policy",)), []
    for name, specialist in zoo.items():
        own = cells[name,]
        mean, taken = summarise(own), {trial["way"] for trial in own}
        lines.append(
            [
                name,
                f"{specialist.provenance.get('samples', 0):,}",
                ", ".join(way for way in WAYS if way in taken) or "none",
                write(mean["length"], 2),
                Share.reached(own),
                write(mean["straight"], 3),
                write(mean["geodesic"], 3),
            ]
        )
    columns = "checkpoint, samples, way, length (m), success (%), SPL straight, SPL geodesic"
    return markdown(columns.split(", "), lines)


def run(config: AdaptationConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo, tasks = config.load_checkpoints(), make_tasks(config)
    first = make_map(config.robot, terrain_seed(config.seed, 0), config.heights)

    def cost() -> Cost:
        detour, episodes = fmean(LENGTHS) / STRAIGHT, config.trials * len(zoo)
        return estimate(
            zoo,
            [first],
            grounds=len(tasks),
            episodes=episodes,
            detour=detour,
            condition=config.condition,
        )

    def find(trials: list[AdaptationRow]) -> Findings:
        return Findings(
            table=table(trials, zoo),
            caption=f"{config.trials:,} trials per checkpoint on {len(tasks)} maps, with 95 % "
            f"intervals; robot {config.robot}, {config.planning}, seed {config.seed}; "
            f"{config.told(config.condition)}. SPL against "
            f"the straight line of {STRAIGHT:g} m, as the paper's numbers imply, and against the "
            f"shortest way over no wall, {geodesic(first, config.planning.headings):.1f} m.",
            figures=figures(first, zoo, config) if config.out else {},
        )

    return run_and_report(
        config,
        title=f"Planning adapts to the policy ({config.robot})",
        tasks=tasks,
        settings=config.run_settings(COMMAND),
        cost=cost,
        find=find,
    )


def figures(
    first: Terrain, zoo: Mapping[str, Specialist], config: AdaptationConfig
) -> dict[str, Draw]:
    """Return a map with its route for each checkpoint, drawn and as numbers."""
    from fgtutor.figures.maps import draw_plans  # matplotlib: no worker needs it

    plans = find_plans(first, zoo, config)
    picture = draw_plans(
        first.elevation,
        plans,
        title="The better the policy, the shorter its route",
        f_min=config.f_min,
        walls=first.elevation.heights > WALL - 1e-3,
        places=first.sections,
    )
    stories = json.dumps({name: route and route.to_json() for name, (_, route) in plans.items()})
    return {
        "maps.svg": picture.savefig,
        "routes.json": partial(Path.write_text, data=stories),
    }
