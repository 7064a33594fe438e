"""Trials: ground to cross, planners that plan over it, and a robot that drives what they planned.

Reads grounds, planners by name and a zoo; gives a `Trial` per planner, ground and seed, and counts
of their rows. Every experiment that plans calls `drive`, or its two halves.
Source: paper, Sec. IV-B: a trial fails if no route is found or the goal is not reached in time.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from time import process_time
from typing import Any, TypedDict, TypeVar

from fgtutor.baselines import AssessedMap, Planner, find_route
from fgtutor.directions import HeadingCount
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.evaluation.shards import RunConfig, digest, settings_of
from fgtutor.execution import Episode, FollowConfig, execute_batch
from fgtutor.io.validation import Seed
from fgtutor.robots import condition_of
from fgtutor.robots.conditions import Condition
from fgtutor.routes import Refusal, Route
from fgtutor.settings import PlanOptions, PlanSettings
from fgtutor.specialist import DESCRIPTION, ZOO, Specialist, load_zoo
from fgtutor.world.terrain import Terrain

R = TypeVar("R", bound=Mapping[str, Any])

EPISODES = 50
"""Episodes simulated side by side."""
FAILURES = ("no_route", "fell", "timeout")
"""How a trial fails."""


@dataclass(frozen=True, kw_only=True)
class ZooConfig(RunConfig):
    """Whose specialists are evaluated."""

    robot: str = "toy"
    """Which robot."""
    seed: Seed = 0
    """What grounds and starts are drawn from."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo."""

    @property
    def home(self) -> Path:
        """Where the specialists' folders lie."""
        return self.zoo or ZOO / self.robot

    @property
    def folders(self) -> list[Path]:
        """The specialists' folders."""
        return sorted(path.parent for path in self.home.glob(f"[!._]*/{DESCRIPTION}"))

    def load_zoo(self) -> dict[str, Specialist]:
        """Return the specialists and the generalist, if there is one."""
        return load_zoo(self.robot, self.home, include_general=True)

    def told(self, condition: Condition) -> str:
        """Say what is amiss, how fast policies drive and what they know of it, for a caption."""
        zoo = self.load_zoo()
        paces: dict[float, list[str]] = {}
        for name, specialist in zoo.items():
            paces.setdefault(specialist.command[0], []).append(name)
        each = ", ".join(f"{', '.join(paces[pace])} at {pace:g} m/s" for pace in sorted(paces))
        said = f"{condition.words}; {each}; told {condition.told}"
        blind = [name for name, specialist in zoo.items() if specialist.history]
        if not blind:
            return said
        estimate = "estimate" if len(blind) > 1 else "estimates"
        return f"{said}; but {', '.join(blind)} {estimate} the velocity from what they sense"

    def zoo_digests(self) -> dict[str, str]:
        """Return a digest of each of them, which changes with any of its weights."""
        return {folder.name: digest((folder / DESCRIPTION).read_bytes()) for folder in self.folders}


@dataclass(frozen=True, kw_only=True)
class PlannedConfig(PlanOptions, ZooConfig):
    """Which specialists plan, and by what settings."""

    finer_headings: HeadingCount | None = 8
    """Headings to try where the others find no sure route; 8: none. Obstacles of the standard
    terrains lie along the axes."""

    def run_settings(
        self, command: str, *, without: Collection[str] = (), **more: Any
    ) -> dict[str, Any]:
        """Return what a command's rows depend on (see `settings_of`), the planning and the zoo."""
        everything = asdict(self.planning) | {"zoo": self.zoo_digests()} | more
        return settings_of(self, command, without=("settings", *without), **everything)


@dataclass(frozen=True, kw_only=True)
class DisturbedConfig(PlannedConfig):
    """And whether anything is amiss while they drive."""

    disturbed: bool = False
    """Drive under the robot's preset of disturbances, which the caption spells out."""

    @property
    def condition(self) -> Condition:
        """What is amiss; raises `ConfigError` if the robot cannot be disturbed."""
        return condition_of(self.robot, "disturbed" if self.disturbed else "undisturbed")

    def run_settings(
        self, command: str, *, without: Collection[str] = (), **more: Any
    ) -> dict[str, Any]:
        """Return what a command's rows depend on, every range of the disturbances with it."""
        return super().run_settings(
            command, without=without, condition=self.condition.ranges, **more
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """One terrain, with its start and goal, and the episodes that are driven over it."""

    terrain: Terrain
    """What the robot drives on."""
    seeds: tuple[int, ...]
    """One episode each: its start pose and localisation noise."""
    seen: ElevationMap | None = None
    """The map that planning sees; default: the truth."""

    def assess(self, zoo: Mapping[str, Specialist], settings: PlanSettings) -> AssessedMap:
        """Return what a zoo says of the map that planning sees."""
        seen = self.seen or self.terrain.elevation
        return AssessedMap(seen, zoo, settings.taus, settings.headings)


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """What a planner answered for one ground."""

    ground: Ground
    """Where the plan leads."""
    known: AssessedMap
    """What it was planned on."""
    answer: Route | Refusal
    """The plan."""
    seconds: float = 0.0
    """Time on one core that it took, with the assessment if it was the first to ask for it, s."""


class Outcome(TypedDict):
    """What every row of a report says of its trial."""

    policy: str
    """The policy or planner."""
    ground: int
    """Seed of the terrain."""
    seed: int
    """Seed of the episode."""
    outcome: str
    """reached, or one of `FAILURES`."""


class TrialRow(Outcome):
    """A trial, as a report keeps it."""

    terrain: str
    length: float
    """Distance driven, m."""
    seconds: float
    """Simulated time, s."""
    switches: int
    """Policy changes on the way."""
    promise: float | None
    """`Route.promise`; None without a route."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One plan, driven once."""

    policy: str
    """The policy or planner."""
    planned: Planned
    """Its plan."""
    seed: int
    """Seed of the episode."""
    episode: Episode | None = None
    """The drive; None without a route."""

    @property
    def terrain(self) -> str:
        """Name of the terrain."""
        return self.planned.ground.terrain.name

    @property
    def outcome(self) -> str:
        """How it ended: reached, or one of `FAILURES`."""
        return self.episode.reason if self.episode else "no_route"

    @property
    def route(self) -> Route | None:
        """The route that was driven."""
        return self.planned.answer if isinstance(self.planned.answer, Route) else None

    @property
    def length(self) -> float:
        """Distance driven, m."""
        return round(self.episode.length, 3) if self.episode else 0.0

    @property
    def row(self) -> TrialRow:
        """What a report keeps of it."""
        return {
            "terrain": self.terrain,
            "policy": self.policy,
            "ground": self.planned.ground.terrain.seed,
            "seed": self.seed,
            "outcome": self.outcome,
            "length": self.length,
            "seconds": round(self.episode.seconds, 3) if self.episode else 0.0,
            "switches": self.episode.switches if self.episode else 0,
            "promise": round(self.route.promise, 4) if self.route else None,
        }


def drive(
    grounds: Sequence[Ground],
    planners: Mapping[str, Planner],
    zoo: Mapping[str, Specialist],
    *,
    settings: PlanSettings,
    condition: Condition | None = None,
) -> Iterator[Trial]:
    """Plan over every ground with every planner, and drive the routes; planner by planner.

    Each (ground, specialist) is assessed once, each (ground, planner) planned once.
    """
    maps = [ground.assess(zoo, settings) for ground in grounds]
    follow = FollowConfig(hold_steps=settings.hold_steps)
    for name, planner in planners.items():
        plans = plan_all(planner, grounds, maps, settings)
        yield from drive_plans(name, plans, zoo, follow, condition)


def plan_all(
    planner: Planner,
    grounds: Iterable[Ground],
    maps: Iterable[AssessedMap],
    settings: PlanSettings,
) -> list[Planned]:
    """Plan over every ground with one planner."""
    plans = []
    for ground, known in zip(grounds, maps, strict=True):
        began, ends = process_time(), (ground.terrain.start, ground.terrain.goal)
        answer = find_route(planner, known, *ends, settings)
        took = process_time() - began
        plans.append(Planned(ground=ground, known=known, answer=answer, seconds=took))
    return plans


def drive_plans(
    policy: str,
    plans: Iterable[Planned],
    zoo: Mapping[str, Specialist],
    follow: FollowConfig,
    condition: Condition | None = None,
) -> Iterator[Trial]:
    """Drive what was planned, `EPISODES` at a time; what was refused comes first."""
    jobs: dict[tuple[str, ...], list[tuple[Planned, Route, int]]] = {}
    for planned in plans:
        if isinstance(planned.answer, Refusal):
            for seed in planned.ground.seeds:
                yield Trial(policy=policy, planned=planned, seed=seed)
        else:
            job = jobs.setdefault(planned.answer.names, [])
            job += ((planned, planned.answer, seed) for seed in planned.ground.seeds)
    for job in jobs.values():
        for first in range(0, len(job), EPISODES):
            batch, routes, seeds = zip(*job[first : first + EPISODES], strict=True)
            terrains = [planned.ground.terrain for planned in batch]
            episodes = execute_batch(
                routes, terrains, zoo, seeds=seeds, config=follow, condition=condition
            )
            for planned, seed, episode in zip(batch, seeds, episodes, strict=True):
                yield Trial(policy=policy, planned=planned, seed=seed, episode=episode)


def by_cell(
    rows: Iterable[R], keys: Sequence[str] = ("terrain", "policy")
) -> dict[tuple[Any, ...], list[R]]:
    """Sort rows by the values of `keys`, in the order in which these first appear."""
    cells: dict[tuple[Any, ...], list[R]] = {}
    for row in rows:
        cells.setdefault(tuple(row[key] for key in keys), []).append(row)
    return cells


def failures(rows: Iterable[Mapping[str, Any]]) -> list[int]:
    """Count the rows that failed, in the order of `FAILURES`."""
    count = Counter(row["outcome"] for row in rows)
    return [count[reason] for reason in FAILURES]


def mean_if_reached(rows: Iterable[Mapping[str, Any]], key: str) -> str:
    """Write the mean of a value over the trials that reached their goal; a dash if none did."""
    values = [row[key] for row in rows if row["outcome"] == "reached"]
    return f"{fmean(values):.1f}" if values else "-"


def choose(what: str, names: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """Return the known names that are asked for, in their order: all, if none is.

    Raises `ConfigError` for a name that is not known.
    """
    known = tuple(known)
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"no {what} named {', '.join(unknown)}; choose of {', '.join(known)}")
    return tuple(name for name in known if not names or name in names)
