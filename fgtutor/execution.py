"""Driving a planned route in simulation, each step of it by the policy that the route names.

Reads routes, terrains and specialists; gives an `Episode` each. Trials run side by side: one
environment holds each terrain as one tile of its world, and trials of one terrain share that tile.
Source: paper, Sec. III-C (policy map P) and Sec. IV-B (what counts as a failure); the follower is
pure pursuit (Coulter, 1992).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from fgtutor.errors import ConfigError
from fgtutor.io.validation import Count, Unbounded, check_fields
from fgtutor.robots import env_class
from fgtutor.robots.base import LocomotionEnv
from fgtutor.robots.conditions import Condition
from fgtutor.routes import Refusal, Route
from fgtutor.settings import PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import Terrain, World

LONGEST = 100_000.0
"""The longest route that is driven, m."""
Magnitude = Annotated[float, Interval(ge=0, le=1000)]
"""A length, m, an angle, rad, or the error of one."""
Factor = Annotated[float, Interval(ge=0, le=1e6)]
"""A time, s, or what one is multiplied by."""


@dataclass(frozen=True, kw_only=True)
class FollowConfig:
    """How a route is followed, and when an episode is over."""

    lookahead: Magnitude = 0.55
    """Distance to the point on the route that the robot steers for, m. A bend at full speed needs
    speed / greatest turn rate (the toy 0.57, the A1 0.45 to 0.9): with much less the A1 overshot
    right angles before a wall, with more it cuts corners."""
    goal_radius: Magnitude = 0.35
    """The goal is reached within this distance of it, m."""
    patience: Factor = 3.0
    """Time limit as a multiple of the time that the route takes at its policies' speeds, plus
    `grace`."""
    grace: Factor = 5.0
    """Seconds added to the time limit."""
    stuck_seconds: Unbounded = 10.0
    """A robot that has come no further on its route for this long has run out of time too, s."""
    acceleration: Factor = 0.5
    """Greatest change of the speed told along a route, m/s^2: the robot has slowed down by the time
    that a slower policy takes over."""
    hold_steps: Count = PlanSettings.hold_steps
    """Hysteresis: a policy takes over once it has been wanted for this many control steps."""
    start_noise: Magnitude = 0.03
    """Standard deviation of the start position, m."""
    start_yaw_noise: Magnitude = 0.03
    """Standard deviation of the start yaw, rad."""
    position_noise: Magnitude = 0.0
    """Standard deviation of each localisation fix, m."""
    drift: Magnitude = 0.0
    """Growth of the localisation error, m per square root of a second (a random walk)."""
    fusing_seconds: Factor = 0.0
    """Time over which fixes are averaged, s; in between, the robot knows how far it has moved, here
    without error (on a robot, by odometry). 0: each fix is believed as it comes."""
    displaced_scan: bool = False
    """Let the error of a fix displace what the policy sees too, as where a robot looks its heights
    up in a map; if not, only the follower is misled."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class Episode:
    """One driven route."""

    success: bool
    """Whether the goal was reached in time and without a fall."""
    reason: str
    """reached | fell | timeout"""
    poses: Float[np.ndarray, "steps 4"]
    """Chassis or trunk poses (x, y, z, yaw) in the terrain's frame, one per control step."""
    policies: Int[np.ndarray, "steps"]
    """Index of the active policy at each step, into the route's policy names."""
    length: float
    """Distance driven in the plane, m."""
    seconds: float
    """Simulated time, s."""
    robot: str
    """The robot that drove."""
    body: Float[np.ndarray, "steps features"] | None = None
    """What a figure needs to draw the robot (see `LocomotionEnv.drawing`), if it was recorded."""

    @property
    def switches(self) -> int:
        """How often the policy changed."""
        return int(np.count_nonzero(np.diff(self.policies)))

    def __repr__(self) -> str:
        return (
            f"Episode({self.reason}, {self.length:.2f} m in {self.seconds:.1f} s, "
            f"{self.switches} switches)"
        )


def execute(
    route: Route | Refusal,
    terrain: Terrain,
    zoo: Mapping[str, Specialist],
    *,
    seed: int = 0,
    config: FollowConfig | None = None,
    progress: bool = False,
) -> Episode:
    """Drive one route and record the robot's body, so that the episode can be drawn.

    Raises what `execute_batch` raises, and the `PlanningError` of a `Refusal`.
    """
    return execute_batch(
        [route.raise_for()],
        [terrain],
        zoo,
        seeds=[seed],
        config=config,
        record_body=True,
        progress=progress,
    )[0]


def execute_batch(
    routes: Sequence[Route],
    terrains: Sequence[Terrain],
    zoo: Mapping[str, Specialist],
    *,
    seeds: Sequence[int],
    config: FollowConfig | None = None,
    condition: Condition | None = None,
    record_body: bool = False,
    progress: bool = False,
) -> list[Episode]:
    """Drive route i on terrain i with the policies of `zoo`, all at once; return the episodes.

    Trials on one `Terrain` stand on one tile, where they cannot meet: robots do not collide. What
    is amiss with them, and what they are told, is the `condition`'s: nothing and all if None. What
    it leaves to chance is drawn from the first seed.
    A route's policies are taken from `zoo` by their names; without names ("policy 0" and so on, as
    `plan` calls them then) they count in its order. Raises `ConfigError` if the lists differ in
    length, a seed is negative, the zoo is empty or mixes robots, or it lacks a policy of a route.
    """
    settings = config or FollowConfig()
    if not (len(routes) == len(terrains) == len(seeds)):
        raise ConfigError(
            f"need one route, terrain and seed per trial, got {len(routes)}, {len(terrains)} and "
            f"{len(seeds)}"
        )
    if not routes:
        return []
    if min(seeds) < 0:
        raise ConfigError(f"seeds are numbers from 0, got {min(seeds)}")
    robots = {specialist.robot for specialist in zoo.values()}
    if len(robots) != 1:
        raise ConfigError(f"a zoo to drive with holds one robot's policies, got {sorted(robots)}")
    places = [_places(route, tuple(zoo)) for route in routes]
    specialists = list(zoo.values())
    team = [specialists[place] for place in {place for own in places for place in own.values()}]
    robot = env_class(robots.pop())
    episodes = replace(
        robot.episodes,
        train=False,
        stuck_seconds=math.inf,
        history=max(specialist.history for specialist in team),
    )
    tiles = {terrain: index for index, terrain in enumerate(dict.fromkeys(terrains))}
    # The first seed is enough: robots of one batch are drawn one after another.
    options = {**condition.options, "seed": seeds[0]} if condition else {}
    env = robot(World([list(tiles)]), len(routes), config=episodes, **options)
    where = torch.tensor([tiles[terrain] for terrain in terrains])
    tracks = [_Track(route, own) for route, own in zip(routes, places, strict=True)]
    drive = _Drive(env, where, tracks, specialists, seeds, settings)
    return drive.run(record_body, progress)


def _places(route: Route, names: tuple[str, ...]) -> dict[int, int]:
    """Return where each policy of a route stands among `names`, those of a zoo.

    Raises `ConfigError` if one that is used does not.
    """
    unnamed = all(name == f"policy {index}" for index, name in enumerate(route.names))
    order = {name: index for index, name in enumerate(names)}
    if unnamed and not set(route.names) & order.keys():
        order = dict(zip(route.names, range(len(names)), strict=False))
    places = {i: order[name] for i, name in enumerate(route.names) if name in order}
    used = set(route.policies.tolist()) or {0}
    if missing := [route.names[i] for i in sorted(used - places.keys())]:
        raise ConfigError(
            f"routes name {', '.join(missing)}; the zoo has {', '.join(names)}: execute a route "
            "with the zoo that it was planned with"
        )
    return places


class _Drive:
    """A batch of robots on their routes, from the first step to the last one's end."""

    def __init__(
        self,
        env: LocomotionEnv,
        tiles: Int[Tensor, "trials"],
        tracks: Sequence["_Track"],
        specialists: Sequence[Specialist],
        seeds: Sequence[int],
        config: FollowConfig,
    ) -> None:
        self.env, self.specialists, self.config = env, specialists, config
        self.tracks = tracks
        self.corners = env.offsets[0, tiles].cpu().numpy().astype(np.float64)
        self.rngs = [np.random.default_rng(seed) for seed in seeds]
        speeds = np.array([specialist.command[0] for specialist in specialists])
        self.told = [track.told(speeds, config.acceleration) for track in tracks]
        seconds = np.array([track.seconds(speeds) for track in tracks])
        self.limits = (config.patience * seconds + config.grace) / env.control_dt
        n = len(tracks)
        self.error, self.believed_error = np.zeros((2, n, 2))
        self.active = np.array([track.policy for track in self.tracks])
        self.waiting = np.zeros(n, dtype=int)
        starts = [
            (
                *(track.points[0] + corner + config.start_noise * rng.standard_normal(2)),
                track.bearing(track.points[0], config.lookahead)
                + config.start_yaw_noise * rng.standard_normal(),
            )
            for track, corner, rng in zip(self.tracks, self.corners, self.rngs, strict=True)
        ]
        poses = torch.tensor(np.array(starts), dtype=torch.float32)
        env.start(torch.arange(n), poses, torch.zeros(n), columns=tiles)

    def run(self, record_body: bool, progress: bool) -> list[Episode]:
        """Step until every robot has reached its goal, fallen or run out of time."""
        n = len(self.tracks)
        reason: list[str | None] = [None] * n
        poses: list[list[np.ndarray]] = [[] for _ in range(n)]
        policies: list[list[int]] = [[] for _ in range(n)]
        bodies: list[list[np.ndarray]] = [[] for _ in range(n)]
        stuck = self.config.stuck_seconds / self.env.control_dt
        with tqdm(total=n, unit="trial", disable=not progress) as bar:
            for step in range(1, max(1, math.ceil(self.limits.max())) + 1):
                self._command(self._pose())
                with torch.inference_mode():
                    actions = self._act()
                    _, _, _, extras = self.env.step(actions)
                pose, fell = self._pose(), extras["fell"].cpu().numpy()
                drawing = self.env.drawing() if record_body else None
                for i in range(n):
                    if reason[i] is not None:
                        continue
                    poses[i].append(pose[i])
                    policies[i].append(int(self.active[i]))
                    if drawing is not None:
                        bodies[i].append(drawing[i])
                    away = np.hypot(*(pose[i, :2] - self.tracks[i].points[-1]))
                    if fell[i]:
                        reason[i] = "fell"
                    elif away <= self.config.goal_radius:
                        reason[i] = "reached"
                    elif step >= self.limits[i] or self.tracks[i].idle >= stuck:
                        reason[i] = "timeout"
                    bar.update(reason[i] is not None)
                if None not in reason:
                    break
        return [
            Episode(
                success=reason[i] == "reached",
                reason=reason[i] or "timeout",
                poses=np.array(poses[i]),
                policies=np.array([self.tracks[i].own[place] for place in policies[i]]),
                length=float(np.hypot(*np.diff(np.array(poses[i])[:, :2], axis=0).T).sum()),
                seconds=len(poses[i]) * self.env.control_dt,
                robot=self.specialists[0].robot,
                body=np.array(bodies[i]) if record_body else None,
            )
            for i in range(n)
        ]

    def _pose(self) -> Float[np.ndarray, "trials 4"]:
        """Return the true poses, each in its own terrain's frame."""
        pose = self.env.motion()[0].cpu().numpy().astype(np.float64)
        pose[:, :2] -= self.corners
        return pose

    def _command(self, pose: Float[np.ndarray, "trials 4"]) -> None:
        """Command (v, 0, w) by pure pursuit from where each robot believes it is.

        v is what it is told where it is (`_Track.told`), and less while it turns.
        """
        config, n = self.config, len(self.tracks)
        if config.drift or config.position_noise:
            fixes = np.array([rng.standard_normal((2, 2)) for rng in self.rngs])
            self.error += config.drift * math.sqrt(self.env.control_dt) * fixes[:, 0]
            wrong = self.error + config.position_noise * fixes[:, 1]
            # A first-order filter over where the fixes say that it is, moved along with the robot.
            share = self.env.control_dt / max(config.fusing_seconds, self.env.control_dt)
            self.believed_error += share * (wrong - self.believed_error)
            believed = pose[:, :2] + self.believed_error
        else:
            believed = pose[:, :2]
        if config.displaced_scan:
            self.env.displacement[:] = torch.as_tensor(believed - pose[:, :2])
        aims, speeds = np.zeros((2, n))
        for i, track in enumerate(self.tracks):
            track.advance(believed[i])
            aims[i] = track.bearing(believed[i], config.lookahead, pose[i, 3])
            speeds[i] = self.told[i][track.nearest]
            self._choose(i, track.policy)
        numbers = np.stack((aims, pose[:, 3], speeds))
        wanted, yaw, self.env.cruise[:] = torch.as_tensor(numbers).to(self.env.command)
        self.env.steer(wanted, yaw)

    def _choose(self, i: int, wanted: int) -> None:
        """Switch robot i's policy once another has been wanted for long enough."""
        self.waiting[i] = self.waiting[i] + 1 if wanted != self.active[i] else 0
        if self.waiting[i] >= self.config.hold_steps:
            self.active[i], self.waiting[i] = wanted, 0

    def _act(self) -> Tensor:
        """Ask each robot's active policy for its action."""
        observations = self.env.get_observations()
        actions = torch.zeros(len(self.tracks), self.env.num_actions, device=self.env.device)
        for index, specialist in enumerate(self.specialists):
            mine = torch.as_tensor(np.flatnonzero(self.active == index))
            if len(mine):
                actions[mine] = specialist.act(observations[mine])
        return actions


class _Track:
    """A route resampled every `SPACING` metres, which remembers how far along it the robot is.

    Its policies are numbered as `places` says, and `own` is the way back to the route's numbers.
    """

    SPACING = 0.02

    def __init__(self, route: Route, places: Mapping[int, int]) -> None:
        self.own = {place: index for index, place in places.items()}
        xy = np.asarray(route.xy, dtype=np.float64)
        at = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))))
        self.length = float(at[-1])
        if self.length > LONGEST:
            raise ConfigError(f"a route of {self.length:g} m is too long, at most {LONGEST:g} m")
        self.distance = np.append(np.arange(0.0, self.length, self.SPACING), self.length)
        edge = np.clip(np.searchsorted(at, self.distance, "right") - 1, 0, max(len(at) - 2, 0))
        self.points = np.stack([np.interp(self.distance, at, line) for line in xy.T], axis=-1)
        named = route.policies[edge].tolist() if len(at) > 1 else [0]
        self.policies = np.array([places[index] for index in named])
        self.nearest = 0
        self.idle = 0  # steps since it last came further

    @property
    def policy(self) -> int:
        """The policy that the route names where the robot is, its place in the zoo."""
        return int(self.policies[self.nearest])

    def seconds(self, speeds: Float[np.ndarray, "policies"]) -> float:
        """Return the time that it takes at the speeds of its policies, m/s, by their place."""
        steps = np.hypot(*np.diff(self.points, axis=0).T)
        return float((steps / speeds[self.policies[:-1]]).sum())

    def told(
        self, speeds: Float[np.ndarray, "policies"], acceleration: float
    ) -> Float[np.ndarray, "points"]:
        """Return the speed at each point, m/s: its policy's, changing by `acceleration` at most.

        v^2 changes by at most 2 a per metre, so a robot brakes before a slower policy takes over.
        """
        square = speeds[self.policies] ** 2
        change = 2 * acceleration * self.distance
        braking = np.minimum.accumulate((square + change)[::-1])[::-1] - change
        gathering = np.minimum.accumulate(square - change) + change
        return np.sqrt(np.minimum(braking, gathering).clip(min=square.min()))

    def bearing(self, place: np.ndarray, distance: float, there: float = 0.0) -> float:
        """Return the direction to the point `distance` metres further along, or to the end, rad.

        `there` is the answer where `place` is that point.
        """
        ahead = min(self.nearest + round(distance / self.SPACING), len(self.points) - 1)
        aim = self.points[ahead] - place
        return math.atan2(aim[1], aim[0]) if np.hypot(*aim) > 1e-3 else there

    def advance(self, place: np.ndarray, window: float = 1.0) -> None:
        """Move to the nearest point of the route within `window` metres ahead; never back."""
        reach = self.points[self.nearest : self.nearest + round(window / self.SPACING)]
        further = int(np.argmin(((reach - place) ** 2).sum(axis=1)))
        self.nearest += further
        self.idle = 0 if further else self.idle + 1
