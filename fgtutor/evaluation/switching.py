"""Table III: from one terrain, and one policy, to the next, on a scanned map and lost by inches.

Reads a robot, a number of trials and levels of localisation noise; lays courses of two terrains
(and one of all), scans each with a simulated MID-360, plans on that map, never on the truth, and
drives the routes with a follower that does not know exactly where it is. Gives success by course,
level and planner. Source: paper, Sec. V (Table III: 20 attempts each with a real robot, which a
simulation is not); it names imprecise localisation and free switching as what failures came from.
"""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from statistics import fmean
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Interval, MinLen

from fgtutor.baselines import OURS, AssessedMap, Planner, find_route, ours, single
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, TerrainError
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.planned import PlannedConfig
from fgtutor.evaluation.report import Draw, Findings, markdown, run_and_report
from fgtutor.evaluation.shards import settings_of
from fgtutor.evaluation.success import cut, terrain_seed
from fgtutor.evaluation.tasks import Row, Task
from fgtutor.execution import FollowConfig, execute_batch
from fgtutor.figures.charts import draw_shares
from fgtutor.io.validation import Count, Unique, check_arguments
from fgtutor.io.validation import Share as Fraction
from fgtutor.robots import ROBOTS
from fgtutor.robots.lidar import scan_terrain, survey
from fgtutor.routes import Route
from fgtutor.specialist import GENERAL, Specialist
from fgtutor.statistics import Share
from fgtutor.world.obstacles import OBSTACLES, Course
from fgtutor.world.scanning import ScanConfig, map_points
from fgtutor.world.terrain import Section, Terrain, TerrainSeed, rasterise

T = TypeVar("T")
Error = Annotated[float, Interval(ge=0, le=10)]
"""How far off a fix is, m, or drifts, m per square root of a second."""
Levels = Annotated[tuple[tuple[Error, Error], ...], MinLen(1), Unique]
"""Pairs of both."""

COMMAND = "evaluate switching"
FULL = "full"
"""Name of the whole course."""
NEARLY_FREE = 1e-6
"""A switch cost that changes no route by itself. But with one above 0, the search lets the policy
change only for a step that the old and the new one can both take."""


@dataclass(frozen=True, kw_only=True)
class SwitchingConfig(PlannedConfig):
    """Drive from terrain to terrain on scanned maps, the paper's Table III."""

    trials: Count = 50
    """Trials per course, planner and level of noise, each on a ground of its own. With more of
    them in the same folder, only the new ones are driven."""
    levels: Levels = ((0.0, 0.0), (0.03, 0.0), (0.03, 0.01), (0.06, 0.02))
    """Localisation errors: standard deviation of each fix, m, and its drift, m per square root of a
    second."""
    courses: Annotated[tuple[str, ...], Unique] = ()
    """Only these courses, such as steps-gaps; default: every pair of neighbours, and full."""
    planners: Annotated[tuple[str, ...], Unique] = ()
    """Only these planners; default: all."""
    difficulty: Fraction = 1.0
    """Difficulty of all terrains."""
    scan_spacing: Annotated[float, Interval(ge=0.01, le=100)] = 0.2
    """Distance between two poses of the scanner, m."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A way to plan and to follow."""

    planner: Planner
    """Gives the layers to plan on."""
    switch_cost: float = 0.0
    """What a change of policy costs in planning."""
    hold_steps: int = 1
    """Control steps for which a policy must be wanted before it takes over."""


def variants(config: SwitchingConfig, zoo: Mapping[str, Specialist]) -> dict[str, Variant]:
    """Return the ways to compare: the paper's, each of our additions alone, all, the generalist.

    The switch cost includes that both policies must be able to take the step, since the search
    does. Raises `ConfigError` for a name that is none of them.
    """
    cost, hold = config.planning.switch_cost, config.planning.hold_steps
    known = {
        OURS: Variant(planner=ours),
        "+ hysteresis": Variant(planner=ours, hold_steps=hold),
        "+ both feasible": Variant(planner=ours, switch_cost=NEARLY_FREE),
        "+ switch cost": Variant(planner=ours, switch_cost=cost),
        "+ all": Variant(planner=ours, switch_cost=cost, hold_steps=hold),
    }
    if GENERAL in zoo:
        known[GENERAL] = Variant(planner=partial(single, GENERAL))
    return _choose("planner", config.planners, known)


def courses(config: SwitchingConfig) -> dict[str, tuple[str, ...]]:
    """Return the terrains of each course, in the paper's order; raises `ConfigError` for others."""
    if config.robot not in ROBOTS:
        raise ConfigError(f"no course for robot {config.robot!r}: choose of {', '.join(ROBOTS)}")
    order = ROBOTS[config.robot].course
    known = {"-".join(pair): pair for pair in pairwise(order)} | {FULL: order}
    return _choose("course", config.courses, known)


def _choose(what: str, names: Sequence[str], known: Mapping[str, T]) -> dict[str, T]:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"no {what} named {', '.join(unknown)}; choose of {', '.join(known)}")
    return {name: value for name, value in known.items() if not names or name in names}


def lay_course(
    kinds: Sequence[str], *, robot: str = "toy", difficulty: Fraction = 1.0, seed: TerrainSeed = 0
) -> Terrain:
    """Lay obstacles in the order given, with flat ground before, between and behind them.

    As the mixed terrain of `make_terrain`, but all of them equally long, and none drawn.
    Raises `TerrainError` for an unknown kind or robot, or for none.
    """
    check_arguments(lay_course, locals(), TerrainError)
    if robot not in ROBOTS or not kinds or not set(kinds) <= OBSTACLES.keys():
        raise TerrainError(
            f"cannot lay {', '.join(kinds) or 'nothing'} for {robot!r}: choose of "
            f"{', '.join(OBSTACLES)}, and a robot of {', '.join(ROBOTS)}"
        )
    scale = ROBOTS[robot].scale
    course = Course(scale, difficulty, np.random.default_rng((seed, 3)))
    x, sections, lane = 0.0, [], []
    for kind in kinds:
        x0 = course.snap(x + (scale.mixed_landing if sections else scale.apron))
        x1 = course.snap(x0 + scale.mixed_section)
        course.full(x, x0)
        y = OBSTACLES[kind](course, x0, x1)
        sections.append(Section(name=kind, x0=x0, y0=0.0, x1=x1, y1=course.width))
        lane += [(x0 - 0.3, y), (x1 + 0.3, y)]
        x = x1
    length = course.snap(x + scale.apron)
    course.full(x, length)
    start, goal = (scale.apron / 2, course.middle), (length - scale.apron / 2, course.middle)
    return Terrain(
        name="-".join(kinds),
        robot=robot,
        difficulty=difficulty,
        seed=seed,
        elevation=rasterise(course.boxes, (length, course.width), scale.resolution),
        boxes=tuple(course.boxes),
        start=start,
        goal=goal,
        sections=tuple(sections),
        lane=(start, *lane, goal),
    )


def scan_map(terrain: Terrain, *, seed: int, spacing: float = 0.2) -> ElevationMap:
    """Return what a survey with a simulated MID-360 makes of a terrain; cells may stay unknown."""
    points = scan_terrain(terrain, poses=survey(terrain, spacing=spacing), seed=seed)
    config = ScanConfig(resolution=terrain.elevation.resolution)
    return map_points(points, config=config, area=terrain.elevation.extent).elevation


def make_tasks(config: SwitchingConfig) -> list[Task]:
    """Cut the evaluation into tasks: some grounds of one course, all planners and levels."""
    return [
        Task(
            name=f"{course}-{grounds.start:05d}-{grounds.stop:05d}",
            function=run_task,
            arguments=(config, course, grounds),
        )
        for course in courses(config)
        for grounds in cut(config.trials)
    ]


def run_task(config: SwitchingConfig, course: str, indices: Sequence[int]) -> list[Row]:
    """Do one task: scan each ground once, plan once a variant, drive at every level of noise."""
    zoo, kinds = config.load_zoo(), courses(config)[course]
    grounds = [
        lay_course(
            kinds,
            robot=config.robot,
            difficulty=config.difficulty,
            seed=terrain_seed(config.seed, index),
        )
        for index in indices
    ]
    maps = [
        AssessedMap(
            scan_map(ground, seed=ground.seed, spacing=config.scan_spacing),
            zoo,
            config.planning.taus,
        )
        for ground in grounds
    ]
    routes: dict[tuple[Planner, float], list[Route | None]] = {}
    rows: list[Row] = []
    for name, variant in variants(config, zoo).items():
        how = variant.planner, variant.switch_cost
        if how not in routes:
            routes[how] = [
                _route(ground, known, variant, config)
                for ground, known in zip(grounds, maps, strict=True)
            ]
        for level in config.levels:
            shared = {"course": course, "policy": name, "noise": level[0], "drift": level[1]}
            follow = FollowConfig(
                hold_steps=variant.hold_steps, position_noise=level[0], drift=level[1]
            )
            rows += (shared | row for row in _drive(routes[how], grounds, zoo, follow))
    return rows


def _route(
    ground: Terrain, known: AssessedMap, variant: Variant, config: SwitchingConfig
) -> Route | None:
    settings = replace(config.planning, switch_cost=variant.switch_cost)
    answer = find_route(variant.planner, known, ground.start, ground.goal, settings)
    return answer if isinstance(answer, Route) else None


def _drive(
    routes: Sequence[Route | None],
    grounds: Sequence[Terrain],
    zoo: Mapping[str, Specialist],
    follow: FollowConfig,
) -> list[Row]:
    """Drive what was planned, all at once; one row a ground."""
    planned = [(route, ground) for route, ground in zip(routes, grounds, strict=True) if route]
    driven = {}
    if planned:
        way, where = zip(*planned, strict=True)
        seeds = [ground.seed for ground in where]
        episodes = execute_batch(way, where, zoo, seeds=seeds, config=follow)
        driven = dict(zip(seeds, episodes, strict=True))
    rows = []
    for route, ground in zip(routes, grounds, strict=True):
        row: Row = {"ground": ground.seed, "seed": ground.seed, "outcome": "no_route"}
        if route:
            episode = driven[ground.seed]
            row |= {
                "outcome": episode.reason,
                "length": round(episode.length, 3),
                "seconds": round(episode.seconds, 3),
                "switches": episode.switches,
                "planned_switches": route.switches,
                "end": [round(value, 2) for value in episode.poses[-1, :2].tolist()],
            }
        rows.append(row)
    return rows


def by_level(trials: Sequence[Row]) -> dict[tuple[float, float], dict[str, dict[str, list[Row]]]]:
    """Sort trials by level of noise, planner and course, in the order in which they appear."""
    levels: dict[tuple[float, float], dict[str, dict[str, list[Row]]]] = {}
    for trial in trials:
        planners = levels.setdefault((trial["noise"], trial["drift"]), {})
        planners.setdefault(trial["policy"], {}).setdefault(trial["course"], []).append(trial)
    return levels


def table(trials: Sequence[Row]) -> str:
    """Return the trials as a Markdown table: a line a level and planner, a column a course.

    The last columns count, over all courses, how trials failed and how often the policy changed.
    """
    names = list(dict.fromkeys(trial["course"] for trial in trials))
    lines = []
    for (noise, drift), planners in by_level(trials).items():
        for planner, cells in planners.items():
            everything = [trial for cell in cells.values() for trial in cell]
            failed = Counter(trial["outcome"] for trial in everything)
            switches = [t["switches"] for t in everything if t["outcome"] == "reached"]
            lines.append(
                [
                    f"{100 * noise:g} + {100 * drift:g}",
                    planner,
                    *(Share.reached(cells[name]) for name in names),
                    *(failed[reason] for reason in ("no_route", "fell", "timeout")),
                    f"{fmean(switches):.1f}" if switches else "-",
                ]
            )
    columns = ["noise + drift", "planner", *names, "no route", "fell", "timeout", "switches"]
    return markdown(columns, lines)


def charts(trials: Sequence[Row]) -> dict[str, Draw]:
    """Return a chart a level: planners within courses."""
    figures: dict[str, Draw] = {}
    for (noise, drift), planners in by_level(trials).items():
        groups = {
            course: {planner: Share.reached(cells[course]) for planner, cells in planners.items()}
            for course in dict.fromkeys(trial["course"] for trial in trials)
        }
        title = f"Fixes off by {100 * noise:g} cm, drift {100 * drift:g} cm per root second"
        chart = draw_shares(groups, title=title)
        name = f"success-{100 * noise:g}-{100 * drift:g}.svg"
        figures[name] = chart.savefig
    return figures


def run(config: SwitchingConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo = config.load_zoo()
    planners = variants(config, zoo)

    def cost() -> Cost:
        grounds = [lay_course(kinds, robot=config.robot) for kinds in courses(config).values()]
        episodes = config.trials * len(planners) * len(config.levels)
        driven = estimate(zoo, grounds, grounds=config.trials, episodes=episodes)
        scanned = config.trials * _scan_seconds(grounds, config.scan_spacing)
        return replace(driven, seconds=driven.seconds + scanned)

    def find(trials: list[Row]) -> Findings:
        return Findings(
            table=table(trials),
            caption=(
                f"Success in % with 95 % intervals, {config.trials:,} trials a cell; fixes with a "
                "standard deviation of noise (cm) and a drift (cm per root second), maps from a "
                f"simulated scan; robot {config.robot}, {config.planning}, seed {config.seed}."
            ),
            figures=charts(trials),
        )

    return run_and_report(
        config,
        title=f"From terrain to terrain ({config.robot})",
        tasks=make_tasks(config),
        settings=settings_of(config, COMMAND, without=("trials",), zoo=config.zoo_digests()),
        cost=cost,
        find=find,
    )


def _scan_seconds(grounds: Sequence[Terrain], spacing: float) -> float:
    """Measure one scan, and return what one of each ground will take, s."""
    began = time.perf_counter()
    scan_map(grounds[0], seed=0, spacing=spacing)
    area = [ground.elevation.heights.size for ground in grounds]
    return (time.perf_counter() - began) * sum(area) / area[0]
