"""Driving a robot by hand: one robot on one terrain, commands and policies changed on the way.

Reads a terrain, a zoo and a way to draw the robot; gives frames, the commands' tracking reward and,
at any time, the `Episode` driven so far. Source: the policies' commands (v, 0, w) of the paper,
Sec. III-A; physics and observations are the environments', as in `execution`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.colors import to_rgb

from fgtutor.directions import NUM_HEADINGS
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode
from fgtutor.figures.style import policy_colours
from fgtutor.figures.toy_film import ToyFilm
from fgtutor.planning import plan
from fgtutor.robots import env_class
from fgtutor.robots.base import LocomotionEnv
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import Terrain, World

Render = Callable[[LocomotionEnv], UInt8[np.ndarray, "height width 3"]]


@runtime_checkable
class Coated(Protocol):
    """A way to draw a robot whose hull has a colour that can be changed."""

    coat: tuple[float, float, float]
    """Colour of the hull: red, green, blue, from 0 to 1."""

    def __call__(self, env: LocomotionEnv) -> UInt8[np.ndarray, "height width 3"]:
        """Draw robot 0."""
        ...


class Drive:
    """One robot under a person's command.

    Attributes:
        speed: Commanded forward speed, m/s.
        turn: Commanded turn rate, rad/s.
        policy: Name of the policy that acts.
    """

    def __init__(
        self,
        terrain: Terrain,
        zoo: Mapping[str, Specialist],
        *,
        render: Render | None = None,
        yaw: float = 0.0,
    ) -> None:
        """Put the robot at the terrain's start, facing `yaw` (rad).

        Args:
            terrain: The ground.
            zoo: The policies to choose from, all of one robot. That of the terrain's name acts
                first, if there is one, else the first.
            render: Draws robot 0 of an environment, the hull in the colour of the policy that acts
                if it is `Coated`. None draws the toy's side view.
            yaw: Heading at the start, rad.

        Raises:
            ConfigError: The zoo is empty or mixes robots, or `render` is None for another robot
                than the toy.
        """
        robots = sorted({specialist.robot for specialist in zoo.values()})
        if len(robots) != 1:
            raise ConfigError(f"a zoo to drive with holds one robot's policies, got {robots}")
        if render is None and robots != ["toy"]:
            raise ConfigError(
                f"driving the robot {robots[0]!r} needs render, a function that draws its "
                "environment; only the toy draws itself"
            )
        robot = env_class(robots[0])
        history = max(specialist.history for specialist in zoo.values())
        config = replace(robot.episodes, train=False, stuck_seconds=math.inf, history=history)
        self.env = robot(World([[terrain]]), 1, config=config)
        self.terrain, self.zoo, self._render, self._yaw = terrain, dict(zoo), render, yaw
        self.policy, self.turn = terrain.name if terrain.name in zoo else next(iter(zoo)), 0.0
        self.speed = self.zoo[self.policy].command[0]
        self.top_speed, self.top_turn = 1.5 * config.speed[1], config.max_turn_rate
        """What the sliders reach: half more than was trained, so that the limit can be felt."""
        self.reset()

    def reset(self) -> None:
        """Put the robot back to the start; the command and the policy stay."""
        corner = self.env.offsets[0, 0].cpu()
        start = torch.tensor(self.terrain.start) + corner
        pose = torch.tensor([[start[0], start[1], self._yaw]], dtype=torch.float32)
        self.env.reset_all()
        only = torch.zeros(1, dtype=torch.long)
        self.env.start(only, pose, 0.0, columns=only)
        self.fallen = False
        """Whether the robot has fallen, after which it no longer moves."""
        self.r_v = 1.0
        """The tracking reward of the last step."""
        self._poses, self._policies, self._bodies = [], [], []
        self._record()

    def advance(self, seconds: float) -> None:
        """Simulate under the present command and policy, at least one step; stop at a fall.

        Raises `ConfigError` for a policy that is not in the zoo or a command that is not finite.
        """
        if self.policy not in self.zoo:
            raise ConfigError(f"no policy {self.policy!r}; there are {', '.join(self.zoo)}")
        if not (math.isfinite(self.speed) and math.isfinite(self.turn)):
            raise ConfigError(f"a command must be finite, got ({self.speed}, 0, {self.turn})")
        for _ in range(max(1, round(seconds / self.env.control_dt))):
            if self.fallen:
                return
            self.env.command[0] = torch.tensor((self.speed, 0.0, self.turn))
            with torch.inference_mode():
                actions = self.zoo[self.policy].act(self.env.get_observations())
                _, _, _, extras = self.env.step(actions)
            self.fallen = bool(extras["fell"][0])
            self.r_v = float(self.env.tracking[0, 0])
            self._record()

    def _record(self) -> None:
        pose = self.env.motion()[0][0].cpu().numpy().astype(np.float64)
        pose[:2] -= self.env.offsets[0, 0].cpu().numpy()
        self._poses.append(pose)
        self._policies.append(list(self.zoo).index(self.policy))
        self._bodies.append(self.env.drawing()[0])

    @property
    def episode(self) -> Episode:
        """What was driven since the last reset."""
        poses = np.array(self._poses)
        return Episode(
            success=False,
            reason="fell" if self.fallen else "by hand",
            poses=poses,
            policies=np.array(self._policies),
            length=float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
            seconds=len(poses) * self.env.control_dt,
            robot=self.zoo[self.policy].robot,
            body=np.array(self._bodies),
        )

    def frame(self) -> UInt8[np.ndarray, "height width 3"]:
        """Return a picture of the robot as it stands."""
        if self._render is not None:
            if isinstance(self._render, Coated):
                self._render.coat = to_rgb(policy_colours([*self.zoo])[self.policy])
            return np.asarray(self._render(self.env))
        episode = self.episode
        # The film colours policies by the names of a route: one that stays where it starts.
        grid, here = self.terrain.elevation, self.terrain.start
        closed = np.zeros((*grid.shape, NUM_HEADINGS))
        stay = plan(closed, closed, grid=grid, start=here, goal=here, names=tuple(self.zoo))
        film = ToyFilm(episode, self.terrain, stay.raise_for())
        return np.asarray(film.side(len(episode.poses) - 1))

    @property
    def status(self) -> str:
        """One line: time, place, and how well the command is followed."""
        x, y, _, yaw = self._poses[-1].tolist()
        seconds = (len(self._poses) - 1) * self.env.control_dt
        told = f"({self.speed:.2f} m/s, {self.turn:+.2f} rad/s)"
        outcome = f"r_v {self.r_v:.2f}" if seconds else "press play"
        if self.fallen:
            outcome = "fallen: press reset"
        return (
            f"{seconds:.1f} s, {self.policy} at x {x:.2f} m, y {y:.2f} m, "
            f"{math.degrees(yaw):.0f} degrees, command {told}: {outcome}"
        )
