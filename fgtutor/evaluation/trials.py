"""Trials: ground to cross, planners that plan over it, and a robot that drives what they planned.

Reads grounds, planners by name and a zoo; gives one `Trial` a planner, ground and seed. Every
experiment's tasks call `drive`.
Source: paper, Sec. IV-B: a trial fails if no route is found or the goal is not reached in time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from fgtutor.baselines import AssessedMap, Planner, find_route
from fgtutor.elevation import ElevationMap
from fgtutor.execution import FollowConfig, execute_batch
from fgtutor.routes import Refusal, Route
from fgtutor.settings import PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import Terrain

EPISODES = 50
"""Episodes simulated side by side."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """The outcome of one trial."""

    terrain: str
    policy: str
    """The policy or planner."""
    ground: int
    """Seed of the terrain."""
    seed: int
    """Seed of the episode: start pose and localisation noise."""
    outcome: str
    """reached | no_route | fell | timeout"""
    length: float = 0.0
    """Distance driven, m."""
    seconds: float = 0.0
    """Simulated time, s."""
    switches: int = 0
    """Policy changes on the way."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """One terrain, with its start and goal, and the episodes that are driven over it."""

    terrain: Terrain
    """What the robot drives on."""
    seeds: tuple[int, ...]
    """One episode each."""
    seen: ElevationMap | None = None
    """The map that planning sees; default: the truth."""


def drive(
    grounds: Sequence[Ground],
    planned: Mapping[str, Planner],
    zoo: Mapping[str, Specialist],
    *,
    settings: PlanSettings,
) -> list[Trial]:
    """Plan over every ground with every planner, and drive the routes; planner by planner.

    Each (ground, specialist) is assessed once, each (ground, planner) planned once.
    """
    maps = [
        AssessedMap(ground.seen or ground.terrain.elevation, zoo, settings.taus)
        for ground in grounds
    ]
    follow = FollowConfig(hold_steps=settings.hold_steps)
    trials: list[Trial] = []
    for name, planner in planned.items():
        jobs: dict[tuple[str, ...], list[tuple[Route, Terrain, int]]] = {}
        for ground, known in zip(grounds, maps, strict=True):
            terrain = ground.terrain
            route = find_route(planner, known, terrain.start, terrain.goal, settings)
            if isinstance(route, Refusal):
                trials += (_trial(terrain, name, seed, "no_route") for seed in ground.seeds)
                continue
            work = jobs.setdefault(route.names, [])
            work += ((route, terrain, seed) for seed in ground.seeds)
        for work in jobs.values():
            trials += _episodes(name, work, zoo, follow)
    return trials


def _episodes(
    name: str,
    work: Sequence[tuple[Route, Terrain, int]],
    zoo: Mapping[str, Specialist],
    follow: FollowConfig,
) -> Iterator[Trial]:
    """Drive routes, `EPISODES` at a time."""
    for first in range(0, len(work), EPISODES):
        routes, terrains, seeds = zip(*work[first : first + EPISODES], strict=True)
        episodes = execute_batch(routes, terrains, zoo, seeds=seeds, config=follow)
        for terrain, seed, episode in zip(terrains, seeds, episodes, strict=True):
            yield replace(
                _trial(terrain, name, seed, episode.reason),
                length=round(episode.length, 3),
                seconds=round(episode.seconds, 3),
                switches=episode.switches,
            )


def _trial(terrain: Terrain, policy: str, seed: int, outcome: str) -> Trial:
    return Trial(
        terrain=terrain.name, policy=policy, ground=terrain.seed, seed=seed, outcome=outcome
    )
