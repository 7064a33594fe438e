"""The seam between learning and simulation: a batch of robots that track velocity commands.

`LocomotionEnv` is rsl_rl's `VecEnv`. It owns what every robot shares: commands, patches at the
robots' poses, the tracking reward, failures, time-outs, and placing robots for evaluation; where
episodes lead is the work of `crossings`. A robot adds its physics in a handful of members
(see the abstract methods). Source: paper, Sec. III-A (Eq. 1).
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fgtutor import patches
from fgtutor.errors import ConfigError
from fgtutor.feasibility import tracking_reward
from fgtutor.io.rsl import TensorDict, VecEnv
from fgtutor.io.validation import Count, check_arguments
from fgtutor.patches import PatchGrid, sample_patches
from fgtutor.policies.dreamwaq import VELOCITY, History
from fgtutor.policies.symmetry import Mirror
from fgtutor.robots.crossings import UNTRIED, Crossings, EnvConfig
from fgtutor.robots.steering import slowdown, turn_rate
from fgtutor.world.terrain import TerrainSeed, World

Layout = tuple[list[dict[str, Any]], dict[str, Any]]
"""The parts of the observation in order (see `part`), and what an action means."""


def plain_tensors(method: Callable[..., Any]) -> Callable[..., Any]:
    """Run a method so that what it makes are ordinary tensors without gradients.

    rsl_rl collects rollouts under `inference_mode`, whose tensors could not be written to
    afterwards.
    """
    return torch.inference_mode(False)(torch.no_grad()(method))


class LocomotionEnv(VecEnv):
    """A batch of robots on a `World`, with observation groups {policy, patch, command, tracking}.

    The `tracking` group holds, for the step just taken, (r_v, failed, ended): r_v is 0 once a robot
    has failed, so a fall never looks feasible; leaving for the next tile's obstacle counts as a
    failure by `UNTRIED`. With `history`, there are three more groups: `history`, the last frames of
    what a blind robot observes, `scan`, what it does not, and `critic`, the true velocity, traits
    of the body that no sensor tells, and the `policy` group.
    """

    grid: PatchGrid
    """Where patches are sampled; the robot chooses."""
    control_dt: float
    """Seconds between two actions."""
    episodes: EnvConfig = EnvConfig()
    """How this robot's episodes are drawn unless the caller says otherwise."""
    mirror: Mirror | None = None
    """The robot's left-right symmetry; with one, its policies are made symmetric."""
    felt: tuple[int, ...] = ()
    """Which numbers of the `policy` group a blind robot observes: neither velocity nor scan."""
    unfelt: tuple[int, ...] = ()
    """Which three of its numbers it has to estimate instead: its velocity."""
    disturbances: ClassVar[Mapping[str, Any]] = {"usual": None}
    """Kinds of disturbance that training may ask for, and the `settings` of each; None: the class's
    own."""

    @plain_tensors
    def __init__(
        self,
        world: World,
        num_envs: Count,
        *,
        config: EnvConfig | None = None,
        seed: TerrainSeed = 0,
        device: str = "cpu",
    ) -> None:
        """Prepare buffers; the subclass builds its physics, then calls `reset_all`."""
        check_arguments(LocomotionEnv.__init__, locals(), ConfigError)
        self.world, self.num_envs, self.device = world, num_envs, device
        self.cfg = self.config = config or self.episodes
        self.max_episode_length = round(self.config.episode_seconds / self.control_dt)
        prepared = world.lay(patches.prepare)
        self.heights = torch.tensor(prepared.heights, device=device)
        self.resolution, self.origin = prepared.resolution, prepared.origin
        self.crossings = Crossings(
            world,
            num_envs,
            self.config,
            grid=self.grid,
            look=self.patches_at,
            uniform=self.uniform,
            device=device,
        )
        self.offsets = self.crossings.offsets
        """Where the corner (0, 0) of each tile [rows, columns, 2] lies in the world, m."""
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.command = torch.zeros(num_envs, 3, device=device)
        self.cruise = torch.zeros(num_envs, device=device)
        self.tracking = torch.zeros(num_envs, 3, device=device)
        self.return_r_v = torch.zeros(num_envs, device=device)
        self.traits = torch.zeros(num_envs, 0, device=device)
        """What a critic may know of each robot's body; a robot that randomises writes it."""
        self.displacement = torch.zeros(num_envs, 2, device=device)
        """Where each robot takes itself to be, minus where it is (x, y), m: its map is read there.
        Whoever drives may write it; it moves what is seen, not the physics."""
        self.history = None
        if self.config.history:
            if len(self.unfelt) != VELOCITY:
                raise ConfigError(
                    f"{type(self).__name__} does not say what a blind policy feels: set `felt` and "
                    f"{VELOCITY} numbers `unfelt`, or leave history at 0"
                )
            self.history = History(self.config.history, len(self.felt), num_envs, device)
        self.reseed(seed)

    # What a robot adds ------------------------------------------------------------------------

    @abstractmethod
    def place(self, ids: Int[Tensor, "n"], poses: Float[Tensor, "n 3"]) -> None:
        """Put robots at rest, in their stance, on the ground at (x, y, yaw)."""

    @abstractmethod
    def advance(self, actions: Float[Tensor, "envs actions"]) -> None:
        """Apply actions and simulate one control step."""

    @abstractmethod
    def proprioception(self) -> Float[Tensor, "envs features"]:
        """Return what the policy feels of its own body."""

    @abstractmethod
    def motion(self) -> tuple[Float[Tensor, "envs 4"], Float[Tensor, "envs 3"]]:
        """Return poses (x, y, z, yaw) in the world and velocities (vx, vy, wz) in the yaw frame."""

    @abstractmethod
    def fallen(self) -> Bool[Tensor, "envs"]:
        """Tell which robots have fallen: nothing they do can save the episode."""

    @abstractmethod
    def reward(self, r_v: Float[Tensor, "envs"], failed: Bool[Tensor, "envs"]) -> Tensor:
        """Return the reward of the step just taken, from r_v and the robot's own terms."""

    @abstractmethod
    def drawing(self) -> Float[np.ndarray, "envs features"]:
        """Return what a figure or a video needs to draw each robot; the robot says what that is."""

    # What a robot may add ---------------------------------------------------------------------

    def rebuild(self) -> None:
        """Rebuild the physics so that nothing of the past remains in it."""

    def scan(self, patch: Float[Tensor, "envs points"]) -> Tensor:
        """Return the part of the patch that the policy sees; all of it by default."""
        return patch

    def truth(self, policy: Float[Tensor, "envs features"]) -> Float[Tensor, "envs 3"]:
        """Return what is `unfelt`; a robot with noisy observations returns it without noise."""
        return policy[:, list(self.unfelt)]

    def conditions(self) -> dict[str, Any]:
        """Return how the robots sense, act and are disturbed, as plain values, for provenances."""
        return {}

    def layout(self) -> Layout:
        """Describe the `policy` group and the action for `fgtutor export`; here, by sizes only."""
        here = f"see {type(self).__name__} in {type(self).__module__}"
        felt, scan = self.proprioception().shape[-1], self.scan(self.patches()).shape[-1]
        command = part("command", 3, "wanted vx, vy, turn rate")
        parts = [part("proprioception", felt, here), command, part("scan", scan, here)]
        return parts, {"size": self.num_actions, "meaning": here}

    # rsl_rl's VecEnv --------------------------------------------------------------------------

    @plain_tensors
    def get_observations(self) -> TensorDict:
        """Return the observation groups at the robots' present state."""
        patch = self.patches()
        felt, scan = self.proprioception(), self.scan(patch)
        policy = torch.cat((felt, self.command, scan), dim=-1)
        groups = {
            "policy": policy,
            "patch": patch,
            "command": self.command.clone(),
            "tracking": self.tracking.clone(),
        }
        if self.history:
            groups["history"] = self.history.see(policy[:, list(self.felt)])
            groups["scan"] = scan
            groups["critic"] = torch.cat((self.truth(policy), self.traits, policy), dim=-1)
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    @plain_tensors
    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Take one control step; in training, ended episodes begin anew at once."""
        self.advance(actions)
        if self.history:
            self.history.advance()
        self.episode_length_buf += 1
        pose, velocity = self.motion()
        fell = self.fallen()
        failed = fell | self.crossings.stuck(pose, self.control_dt)
        if self.config.train:
            failed |= self.crossings.strayed(pose)
        planar = self.crossings.along_heading(pose, velocity)
        r_v = tracking_reward(planar, self.command[:, :2]) * ~failed
        reward = self.reward(r_v, failed)
        self.return_r_v += r_v
        outside, strange = self.crossings.outside(pose)
        truncated = (self.episode_length_buf >= self.max_episode_length) | outside
        done = failed | truncated
        lost = failed.float().maximum(UNTRIED * strange)
        self.tracking = torch.stack((r_v, lost, done.float()), dim=-1)
        extras = {"time_outs": (truncated & ~failed).float(), "fell": fell}
        if self.config.train:
            ids = done.nonzero().flatten()
            if len(ids):
                mean = self.return_r_v[ids] / self.episode_length_buf[ids].clamp(min=1)
                self.crossings.promote(ids, mean, pose[ids, :2], failed[ids])
                self.reset(ids)
            pose, _ = self.motion()
            self.steer(self.crossings.headings(pose, self.control_dt), pose[:, 3])
        return self.get_observations(), reward, done.long(), extras

    # Episodes ---------------------------------------------------------------------------------

    def reseed(self, seed: int) -> None:
        """Start the random stream of episodes anew: what follows depends on `seed` alone."""
        self.rng = torch.Generator(device="cpu").manual_seed(seed)

    def uniform(self, *shape: int) -> Tensor:
        """Draw numbers in [0, 1) from the random stream."""
        return torch.rand(*shape, generator=self.rng).to(self.device)

    @plain_tensors
    def reset_all(self) -> None:
        """Begin a new episode for every robot on a rebuilt simulation."""
        self.rebuild()
        self.tracking.zero_()
        self.reset(torch.arange(self.num_envs))

    @plain_tensors
    def reset(self, ids: Int[Tensor, "n"]) -> None:
        """Begin new training episodes for `ids`: draw a pose, a heading and a speed."""
        poses, crossing = self.crossings.draw(ids)
        low, high = self.config.speed
        self.start(ids, poses, low + (high - low) * self.uniform(len(ids)))
        self.crossings.assign(ids, poses, crossing)

    @plain_tensors
    def start(
        self,
        ids: Int[Tensor, "n"],
        poses: Float[Tensor, "n 3"],
        speed: Tensor | float,
        *,
        columns: Int[Tensor, "n"] | None = None,
    ) -> None:
        """Begin episodes at poses (x, y, yaw) in the world and a speed, without drawing anything.

        `columns` says on which tiles of the first row these poses lie; default: on the robots' own.
        """
        if columns is not None:
            self.crossings.row[ids], self.crossings.column[ids] = 0, columns
        self.place(ids, poses)
        if self.history:
            self.history.forget(ids)
        self.episode_length_buf[ids] = 0
        self.return_r_v[ids] = 0.0
        self.crossings.start(ids, poses)
        self.command[ids] = 0.0
        self.command[ids, 0] = speed
        self.cruise[ids] = speed

    def steer(self, wanted: Float[Tensor, "envs"], yaw: Float[Tensor, "envs"]) -> None:
        """Command the turn rate, and the speed meanwhile, that bring each robot to a heading."""
        self.command[:, 0] = self.cruise * slowdown(wanted, yaw, self.config.slowest)
        self.command[:, 2] = turn_rate(wanted, yaw, self.config.max_turn_rate)

    def patches(self) -> Float[Tensor, "envs points"]:
        """Return the height patch H_xy under every robot, looking along its yaw."""
        poses = self.motion()[0][:, [0, 1, 3]]
        poses[:, :2] += self.displacement
        return self.patches_at(poses)

    def patches_at(self, poses: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch points"]:
        """Return the height patches at poses (x, y, yaw) in the world."""
        return sample_patches(
            self.heights, poses, self.grid, resolution=self.resolution, origin=self.origin
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return what training must store to continue: the curriculum and the random stream."""
        return self.crossings.state_dict() | {"random": self.rng.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over a stored curriculum and random stream; call `reset_all` afterwards.

        Raises `ValueError` if it belongs to another world or number of robots.
        """
        self.crossings.load_state_dict(state)
        self.rng.set_state(state["random"])


def part(
    name: str,
    size: int,
    meaning: str,
    *,
    scale: float = 1.0,
    offset: float | tuple[float, ...] = 0.0,
    limits: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Describe one part of an observation: clip(scale * (clip(raw, *limits) - offset), -20, 20)."""
    return {
        "name": name,
        "size": size,
        "meaning": meaning,
        "limits": limits and list(limits),
        "offset": list(offset) if isinstance(offset, tuple) else offset,
        "scale": scale,
    }
