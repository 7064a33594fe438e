"""Open ground: many maps with several ways across, at any yaw, and tasks that are impossible.

Reads a robot, a number of maps and names of planners; lays each map (`world.openground`), plans all
its tasks with every planner, and drives the routes. Gives success, SPL, refusals right and wrong,
the calibration of what routes promise, policy changes and the time to plan, for maps of obstacles
that the specialists were trained on and maps of others, and failures by the obstacle they were
nearest to. Source: maps and tasks as many as Verti-Bench (arXiv 2502.11426) has; SPL: Anderson et
al. (2018), against the shortest way over cells that are traversable by construction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
from annotated_types import Interval, MinLen

from fgtutor.baselines import (
    OURS,
    AssessedMap,
    Classical,
    OccupancyConfig,
    Planner,
    TraversabilityConfig,
    occupancy,
    ours,
    planners,
    traversability,
)
from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.openground_tables import OpenRow, failed_where, table
from fgtutor.evaluation.report import (
    Draw,
    Findings,
    reliability_chart,
    run_and_report,
    shares_chart,
)
from fgtutor.evaluation.success import terrain_seed
from fgtutor.evaluation.switching import Levels
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import (
    Ground,
    Planned,
    PlannedConfig,
    Trial,
    by_cell,
    choose,
    drive_plans,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.io.validation import Unique
from fgtutor.planning import plan
from fgtutor.routes import Refusal, Route
from fgtutor.settings import PAPER, PlanSettings
from fgtutor.specialist import GENERAL, Specialist
from fgtutor.statistics import Share
from fgtutor.world.openground import CELL, Group, OpenGround, OpenTask, make_open_ground

COMMAND = "evaluate openground"
GROUPS: tuple[Group, ...] = ("seen", "unseen")
"""What maps are made of, in turn."""
PICTURES = 10
"""Maps that a report draws."""
HEADINGS = 16
"""Headings that the shortest way may take."""
PAPERS = "paper"
"""The planner that is ours by the paper's settings."""
STEPS = {"traversability": TraversabilityConfig.step, "occupancy": OccupancyConfig.step}
"""Critical steps of the classical planners, m: the published ones, chosen on no map of ours."""


@dataclass(frozen=True, kw_only=True)
class OpenGroundConfig(PlannedConfig):
    """Plan and drive over open ground, where tasks have several ways or none."""

    finer_headings: HeadingCount | None = None
    """Headings to try where the others find no sure route (ours 48, the paper's 8: none)."""
    robot: str = "a1"
    """Which robot."""
    maps: Annotated[int, Interval(ge=1, le=10_000)] = 100
    """Maps, in turn of obstacles seen in training and of others. With more of them in the same
    folder, only the new ones are driven."""
    tasks: Annotated[int, Interval(ge=1, le=100)] = 10
    """Tasks per map; every fifth is impossible."""
    levels: Levels = ((0.0, 0.0), (0.03, 0.0), (0.1, 0.03))
    """Localisation errors: standard deviation of each fix, m, and its drift, m per square root of a
    second. They displace what the policies see too. Planners but ours drive at the first only."""
    planners: Annotated[tuple[str, ...], Unique, MinLen(1)] = (
        OURS,
        PAPERS,
        "no-ood",
        "no-heading",
        GENERAL,
        "traversability",
        "occupancy",
    )
    """Planners: ours, by the settings; paper, ours by the paper's; and those of `evaluate
    baselines`. After traversability@ or occupancy@ goes another critical step, m, than theirs."""


def make_ground(config: OpenGroundConfig, index: int) -> OpenGround:
    """Lay one map, by turns of obstacles seen in training and of others."""
    return make_open_ground(
        terrain_seed(config.seed, index),
        robot=config.robot,
        group=GROUPS[index % len(GROUPS)],
        tasks=config.tasks,
    )


def ways(
    config: OpenGroundConfig, zoo: Mapping[str, Specialist]
) -> dict[str, tuple[Planner, PlanSettings]]:
    """Return the planners asked for and their settings, by name.

    Raises `ConfigError` for an unknown one, or for a critical step that is no number.
    """
    known, settings = {**planners(zoo), PAPERS: ours}, config.planning
    found: dict[str, tuple[Planner, PlanSettings]] = {}
    for name in config.planners:
        base, at, text = name.partition("@")
        if base in STEPS and base in known:
            try:
                step = float(text) if at else STEPS[base]
            except ValueError:
                raise ConfigError(f"{name!r}: a critical step in metres goes after @") from None
            cells = _traversability if base == "traversability" else _occupancy
            found[name] = Classical(partial(cells, step)), settings
        else:
            choose("planner", [name], known)
            found[name] = known[name], PAPER if name == PAPERS else settings
    return found


def _traversability(step: float, elevation: ElevationMap, radius: float) -> np.ndarray:
    # Steps make ground rough: the published roughness goes with the published step of 12 cm.
    rough = TraversabilityConfig.roughness * step / TraversabilityConfig.step
    return traversability(elevation, radius, TraversabilityConfig(step=step, roughness=rough))


def _occupancy(step: float, elevation: ElevationMap, radius: float) -> np.ndarray:
    return occupancy(elevation, radius, OccupancyConfig(step=step))


def shortest_ways(ground: OpenGround) -> list[float | None]:
    """Return the length of each task's shortest way to where its goal counts as reached, m.

    It leads over passable cells along `HEADINGS` headings, and knows of no policy.
    """
    free = Headings(HEADINGS).steps_within(ground.passable).astype(np.float32)
    grid = ElevationMap(np.zeros(ground.passable.shape), resolution=CELL)
    lengths: list[float | None] = []
    for task in ground.tasks:
        answer = plan(free, 0 * free, grid=grid, start=task.start, goal=task.goal, cost="length")
        far = answer.length - FollowConfig().goal_radius if isinstance(answer, Route) else None
        lengths.append(far)
    return lengths


def plan_map(
    config: OpenGroundConfig, ground: OpenGround, zoo: Mapping[str, Specialist]
) -> dict[str, tuple[list[Planned], float]]:
    """Plan all tasks of a map with every planner; return the plans, and the time to assess, s."""
    terrain, plans = ground.terrain, {}
    assessed: dict[object, AssessedMap] = {}
    took: dict[object, float] = {}
    grounds = [  # one terrain for physics, its ends changed for planning alone
        Ground(
            terrain=replace(terrain, start=task.start, goal=task.goal), seeds=(terrain.seed + i,)
        )
        for i, task in enumerate(ground.tasks)
    ]
    for name, (planner, settings) in ways(config, zoo).items():
        key = settings.taus, settings.headings
        if key not in assessed:
            assessed[key] = AssessedMap(terrain.elevation, zoo, *key)
        began = process_time()
        planner(assessed[key])  # whatever it needs is kept
        who = (*key, name if name == GENERAL or name.partition("@")[0] in STEPS else OURS)
        took.setdefault(who, process_time() - began)
        answers = plan_all(planner, grounds, [assessed[key]] * len(grounds), settings)
        shared = [
            replace(planned, ground=replace(planned.ground, terrain=terrain)) for planned in answers
        ]
        plans[name] = shared, took[who]
    return plans


def run_task(config: OpenGroundConfig, index: int) -> list[OpenRow]:
    """Do one task: all that is asked of one map."""
    zoo, ground = config.load_zoo(), make_ground(config, index)
    lengths, plans, known = shortest_ways(ground), plan_map(config, ground, zoo), ways(config, zoo)
    rows: list[OpenRow] = []
    for level, (noise, drift) in enumerate(config.levels):
        drivers = [name for name in plans if level == 0 or name == OURS]
        for hold in sorted({known[name][1].hold_steps for name in drivers}):
            errors = {"position_noise": noise, "drift": drift, "displaced_scan": True}
            follow = FollowConfig(hold_steps=hold, **errors)
            # Side by side, whoever planned them: a batch costs little more than one robot.
            asked = {
                id(planned): (name, task)
                for name in drivers
                if known[name][1].hold_steps == hold
                for task, planned in enumerate(plans[name][0])
            }
            together = [plans[name][0][task] for name, task in asked.values()]
            for trial in drive_plans("", together, zoo, follow):
                name, task = asked[id(trial.planned)]
                row: OpenRow = {
                    **trial.row,
                    "policy": name,
                    "map": index,
                    "task": task,
                    "feasible": ground.tasks[task].feasible,
                    "noise": noise,
                    "drift": drift,
                    "shortest": lengths[task],
                    "planned": round(trial.route.length, 3) if trial.route else None,
                    "assessing": round(plans[name][1], 3),
                    "planning": round(trial.planned.seconds, 3),
                    "near": near(ground, trial),
                }
                rows.append(row)
    return sorted(rows, key=lambda row: (row["noise"], row["drift"], row["policy"], row["task"]))


def near(ground: OpenGround, trial: Trial) -> str | None:
    """Name the crossing nearest to where a trial failed; None if it did not."""
    answer = trial.planned.answer
    if isinstance(answer, Refusal):
        place = answer.nearest or ground.terrain.start
    elif trial.episode and trial.outcome != "reached":
        x, y = trial.episode.poses[-1, :2].tolist()
        place = x, y
    else:
        return None
    return ground.crossing_near(place).kind


def make_tasks(config: OpenGroundConfig) -> list[Task]:
    """Cut the evaluation into tasks of one map each."""
    return [
        Task(name=f"map-{index:05d}", function=run_task, arguments=(config, index))
        for index in range(config.maps)
    ]


def picture(config: OpenGroundConfig, index: int, rows: Sequence[OpenRow]) -> Draw:
    """Return what draws a map with our routes over it; `rows` are those of our undisturbed drives.

    Tasks that were refused are not planned again: all headings are tried there, for half a minute.
    """

    def draw(path: Path) -> None:
        # It loads matplotlib, which no worker needs.
        from fgtutor.figures.maps import draw_elevation, draw_route

        zoo, ground = config.load_zoo(), make_ground(config, index)
        elevation = ground.terrain.elevation
        mine = replace(config, planners=(OURS,))
        figure = draw_elevation(elevation)
        axes = figure.axes[0]
        taken: list[OpenTask] = []
        for row in rows:
            task = ground.tasks[row["task"]]
            if row["outcome"] == "no_route":
                axes.plot(*zip(task.start, task.goal, strict=True), "k:x", linewidth=0.8)
            else:
                taken.append(task)
        plans, _ = plan_map(mine, replace(ground, tasks=tuple(taken)), zoo)[OURS]
        for planned in plans:
            if isinstance(planned.answer, Route):
                draw_route(planned.answer, elevation, axes=axes, bare=True)
        reached = Share.reached(row for row in rows if row["feasible"])
        axes.set_title(
            f"Map {index} ({ground.group}): {reached.successes} of {reached.trials} feasible tasks "
            "reached; dotted: refused",
            fontsize=9,
            loc="left",
        )
        figure.savefig(path)

    return draw


def run(config: OpenGroundConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    zoo = config.load_zoo()
    names = ways(config, zoo)  # an unknown one fails here, not in a worker an hour later

    def cost() -> Cost:
        grounds = [make_ground(config, index).terrain for index in range(min(config.maps, 2))]
        episodes = config.tasks * (len(names) + len(config.levels) - 1)
        count = -(-config.maps // len(grounds))
        return estimate(zoo, grounds, grounds=count, episodes=episodes * count, detour=1.5)

    def find(trials: list[OpenRow]) -> Findings:
        ideal = [row for row in trials if row["noise"] == row["drift"] == 0]
        able = [row for row in ideal if row["feasible"]]
        groups: dict[str, dict[str, Share]] = {}
        for (group, name), cell in by_cell(able, ("terrain", "policy")).items():
            groups.setdefault(group, {})[name] = Share.reached(cell)
        mine = [row for row in ideal if row["policy"] == OURS]
        pictures = {
            f"map-{index:05d}.png": picture(config, index, own)
            for (index,), own in by_cell(mine, ("map",)).items()
            if index < PICTURES
        }
        return Findings(
            table=table(trials),
            caption=(
                f"{config.maps} maps of {config.tasks} tasks, every fifth of them impossible; "
                "success in % of the feasible ones with 95 % intervals. Maps are by turns of "
                "obstacles that specialists were trained on (seen) and of others, with natural "
                "ground (unseen). SPL against the shortest way over cells that are traversable by "
                "construction. Recall: impossible tasks that were refused; precision: refusals "
                "that were right. Brier: the promises of routes against arrivals, impossible tasks "
                "included. Noise and drift (cm, cm per root second) displace what the policies see "
                f"too. Robot {config.robot}, specialists {', '.join(zoo)}, {config.planning}, seed "
                f"{config.seed}; nothing else disturbs the robot but a start off by 3 cm and 0.03 "
                "rad. Time to assess a map and to plan a task on it: medians on one core. Feasible "
                f"tasks that {OURS} failed, by the nearest crossing: {failed_where(trials)}."
            ),
            figures={
                "success.svg": shares_chart(groups, "Open ground"),
                **reliability_chart([row for row in trials if row["policy"] == OURS]),
                **pictures,
            },
        )

    return run_and_report(
        config,
        title=f"Open ground ({config.robot})",
        tasks=make_tasks(config),
        settings=config.run_settings(COMMAND, without=("maps",), steps=STEPS),
        cost=cost,
        find=find,
    )
