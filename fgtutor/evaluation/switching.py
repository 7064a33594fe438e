"""Table III: from one terrain to the next, on a scanned map, by a robot unsure of its position.

Reads a robot, a number of trials and levels of localisation noise; lays courses of two terrains
(and one of all), scans each with a simulated MID-360, plans on that map, never on the truth, and
drives the routes with a follower that does not know exactly where it is. Gives success by course,
level and planner. Source: paper, Sec. V (Table III: 20 attempts each with a real robot, which a
simulation is not); it names imprecise localisation and free switching as what failures came from.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from typing import Annotated, Literal, NotRequired

import numpy as np
from annotated_types import Interval, MinLen

from fgtutor.baselines import OURS, Planner, ours, single
from fgtutor.elevation import ElevationMap
from fgtutor.errors import TerrainError
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.report import Draw, Findings, markdown, run_and_report, shares_chart
from fgtutor.evaluation.success import cut, terrain_seed
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import (
    DisturbedConfig,
    Ground,
    Outcome,
    Planned,
    Trial,
    by_cell,
    choose,
    drive_plans,
    failures,
    mean_if_reached,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.io.validation import Count, Positive, Unique, check_arguments
from fgtutor.io.validation import Share as Fraction
from fgtutor.robots import ROBOTS
from fgtutor.robots.lidar import scan_terrain, survey
from fgtutor.settings import PlanSettings
from fgtutor.specialist import GENERAL
from fgtutor.statistics import Share
from fgtutor.world.obstacles import OBSTACLES, Course
from fgtutor.world.scanning import ScanConfig, map_points
from fgtutor.world.terrain import Section, Terrain, TerrainSeed, finish_course

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
class SwitchingConfig(DisturbedConfig):
    """Drive from terrain to terrain on scanned maps, the paper's Table III."""

    trials: Count = 50
    """Trials per course, planner and level of noise, each on a ground of its own. With more of
    them in the same folder, only the new ones are driven."""
    levels: Levels = ((0.0, 0.0), (0.03, 0.0), (0.03, 0.01), (0.06, 0.02))
    """Localisation errors: standard deviation of each fix, m, and its drift, m per square root of a
    second."""
    misled: Annotated[tuple[Literal["follower", "scan"], ...], MinLen(1), Unique] = ("follower",)
    """What the errors of a fix mislead: the follower alone; or the scan as well, the heights around
    it that a policy sees, as where a robot looks them up in a map. Both: one after the other."""
    fusing_seconds: Annotated[float, Interval(ge=0, le=60)] = 0.0
    """Time over which the robot averages its fixes, moved along with it, s; 0: it believes each."""
    courses: Annotated[tuple[str, ...], Unique] = ()
    """Only these courses, such as steps-gaps; default: every pair of neighbours, and full."""
    planners: Annotated[tuple[str, ...], Unique] = ()
    """Only these planners; default: all."""
    difficulty: Fraction = 1.0
    """Difficulty of all terrains."""
    switch_cost: Positive | None = None
    """Cost of changing the policy, for the planners that heed it (default 1)."""
    hold_steps: Count | None = None
    """Control steps for which a policy is wanted before it takes over, for the planners with
    hysteresis (default 3)."""
    scan_spacing: Annotated[float, Interval(ge=0.01, le=100)] = 0.2
    """Distance between two poses of the scanner, m."""

    @property
    def planning(self) -> PlanSettings:
        """The settings with all of our additions, whichever of the two they start from."""
        cost, hold = PlanSettings.switch_cost, PlanSettings.hold_steps
        return replace(
            super().planning,
            switch_cost=self.switch_cost or cost,
            hold_steps=self.hold_steps or hold,
        )


class SwitchingRow(Outcome):
    """A trial on a course, as a report keeps it; without a route there is nothing to add."""

    course: str
    noise: float
    """Standard deviation of a fix, m."""
    drift: float
    """Growth of the error, m per square root of a second."""
    misled: str
    """What both mislead, one of `SwitchingConfig.misled`."""
    length: NotRequired[float]
    """Distance driven, m."""
    seconds: NotRequired[float]
    """Simulated time, s."""
    switches: NotRequired[int]
    """Policy changes on the way."""
    planned_switches: NotRequired[int]
    """Policy changes of the route."""
    end: NotRequired[list[float]]
    """Where the robot was in the end, m."""


def variants(
    config: SwitchingConfig, zoo: Iterable[str]
) -> dict[str, tuple[Planner, PlanSettings]]:
    """Return the ways to compare: the paper's, each of our additions alone, all, the generalist.

    The switch cost includes that both policies must be able to take the step, since the search
    does. Raises `ConfigError` for a name that is none of them.
    """
    both = config.planning
    free = replace(both, switch_cost=0.0, hold_steps=1)
    known = {
        OURS: (ours, free),
        "+ hysteresis": (ours, replace(both, switch_cost=0.0)),
        "+ both feasible": (ours, replace(free, switch_cost=NEARLY_FREE)),
        "+ switch cost": (ours, replace(both, hold_steps=1)),
        "+ all": (ours, both),
    }
    if GENERAL in zoo:
        known[GENERAL] = (partial(single, GENERAL), free)
    return {name: known[name] for name in choose("planner", config.planners, known)}


def courses(config: SwitchingConfig) -> dict[str, tuple[str, ...]]:
    """Return the terrains of each course, in the paper's order; raises `ConfigError` for others."""
    (robot,) = choose("robot", [config.robot], ROBOTS)
    order = ROBOTS[robot].course
    known = {"-".join(pair): pair for pair in pairwise(order)} | {FULL: order}
    return {name: known[name] for name in choose("course", config.courses, known)}


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
    return finish_course(
        course,
        name="-".join(kinds),
        robot=robot,
        seed=seed,
        length=length,
        start=(scale.apron / 2, course.middle),
        goal=(length - scale.apron / 2, course.middle),
        sections=sections,
        lane=lane,
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


def run_task(config: SwitchingConfig, course: str, indices: Sequence[int]) -> list[SwitchingRow]:
    """Do one task: scan each ground once, plan once per variant, drive at every level of noise."""
    zoo, kinds = config.load_zoo(), courses(config)[course]
    grounds = [make_ground(config, kinds, terrain_seed(config.seed, index)) for index in indices]
    maps = [ground.assess(zoo, config.planning) for ground in grounds]
    plans: dict[tuple[Planner, float], list[Planned]] = {}
    rows: list[SwitchingRow] = []
    for name, (planner, settings) in variants(config, zoo).items():
        how = planner, settings.switch_cost
        if how not in plans:
            plans[how] = plan_all(planner, grounds, maps, settings)
        for misled, (noise, drift) in product(config.misled, config.levels):
            follow = FollowConfig(
                hold_steps=settings.hold_steps,
                position_noise=noise,
                drift=drift,
                fusing_seconds=config.fusing_seconds,
                displaced_scan=misled == "scan",
            )
            rows += (
                _row(trial, course, noise, drift, misled)
                for trial in drive_plans(name, plans[how], zoo, follow, config.condition)
            )
    return rows


def make_ground(config: SwitchingConfig, kinds: Sequence[str], seed: int) -> Ground:
    """Lay a course, and scan it: the scan is what planning sees."""
    terrain = lay_course(kinds, robot=config.robot, difficulty=config.difficulty, seed=seed)
    scan = scan_map(terrain, seed=seed, spacing=config.scan_spacing)
    return Ground(terrain=terrain, seeds=(seed,), seen=scan)


def _row(trial: Trial, course: str, noise: float, drift: float, misled: str) -> SwitchingRow:
    row: SwitchingRow = {
        "course": course,
        "policy": trial.policy,
        "noise": noise,
        "drift": drift,
        "misled": misled,
        "ground": trial.seed,
        "seed": trial.seed,
        "outcome": trial.outcome,
    }
    if trial.route and trial.episode:
        row["length"] = trial.length
        row["seconds"] = trial.row["seconds"]
        row["switches"] = trial.episode.switches
        row["planned_switches"] = trial.route.switches
        row["end"] = [round(value, 2) for value in trial.episode.poses[-1, :2].tolist()]
    return row


def table(trials: Sequence[SwitchingRow]) -> str:
    """Return the trials as a Markdown table: a line per level and planner, a column per course.

    The last columns count, over all courses, how trials failed and how often the policy changed.
    """
    names = list(dict.fromkeys(trial["course"] for trial in trials))
    lines = []
    keys = ("misled", "noise", "drift", "policy")
    for (misled, noise, drift, planner), own in by_cell(trials, keys).items():
        cells = by_cell(own, ("course",))
        shares = [Share.reached(cells[name,]) for name in names]
        level = f"{100 * noise:g} + {100 * drift:g}"
        lines.append(
            [level, misled, planner, *shares, *failures(own), mean_if_reached(own, "switches")]
        )
    columns = [
        "noise + drift",
        "misled",
        "planner",
        *names,
        "no route",
        "fell",
        "timeout",
        "switches",
    ]
    return markdown(columns, lines)


def charts(trials: Sequence[SwitchingRow]) -> dict[str, Draw]:
    """Return a chart per level and what it misleads: planners within courses."""
    figures: dict[str, Draw] = {}
    for (misled, noise, drift), level in by_cell(trials, ("misled", "noise", "drift")).items():
        groups: dict[str, dict[str, Share]] = {}
        for (course, planner), cell in by_cell(level, ("course", "policy")).items():
            groups.setdefault(course, {})[planner] = Share.reached(cell)
        title = f"Fixes off by {100 * noise:g} cm, drift {100 * drift:g} cm per root second"
        name = f"success-{100 * noise:g}-{100 * drift:g}.svg"
        if misled == "scan":
            title, name = f"{title}, scan displaced", f"scan-{name}"
        figures[name] = shares_chart(groups, title)
    return figures


def run(config: SwitchingConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo = config.load_zoo()
    planners = variants(config, zoo)

    def cost() -> Cost:
        grounds = [lay_course(kinds, robot=config.robot) for kinds in courses(config).values()]
        episodes = config.trials * len(planners) * len(config.levels) * len(config.misled)
        driven = estimate(
            zoo, grounds, grounds=config.trials, episodes=episodes, condition=config.condition
        )
        scanned = config.trials * _scan_seconds(grounds, config.scan_spacing)
        return replace(driven, seconds=driven.seconds + scanned)

    def find(trials: list[SwitchingRow]) -> Findings:
        fused = config.fusing_seconds
        averaged = f", averaged over {fused:g} s along the robot's motion," if fused else ""
        return Findings(
            table=table(trials),
            caption=(
                f"Success in % with 95 % intervals, {config.trials:,} trials per cell; fixes with "
                f"a standard deviation of noise (cm) and a drift (cm per root second){averaged} "
                "mislead the follower, or displace the scan that policies see as well; maps to "
                f"plan on from a simulated scan; robot {config.robot}, {config.planning}, seed "
                f"{config.seed}; {config.told(config.condition)}, but for the fix."
            ),
            figures=charts(trials),
        )

    return run_and_report(
        config,
        title=f"From terrain to terrain ({config.robot})",
        tasks=make_tasks(config),
        settings=config.run_settings(COMMAND, without=("trials",)),
        cost=cost,
        find=find,
    )


def _scan_seconds(grounds: Sequence[Terrain], spacing: float) -> float:
    """Measure one scan, and return what one of each ground will take, s."""
    began = time.perf_counter()
    scan_map(grounds[0], seed=0, spacing=spacing)
    area = [ground.elevation.heights.size for ground in grounds]
    return (time.perf_counter() - began) * sum(area) / area[0]
