"""The seam between learning and simulation: a batch of robots that track velocity commands.

`LocomotionEnv` is rsl_rl's `VecEnv`. It owns what every robot shares: the world of terrain tiles,
commands, patches at the robots' poses, the tracking reward, time-outs, the curriculum and placing
robots for evaluation. A robot adds its physics in a handful of members (see the abstract methods).
Source: paper, Sec. III-A (Eq. 1); world of difficulty rows as in Rudin et al., CoRL 2021.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from fgtutor import patches
from fgtutor.errors import ConfigError
from fgtutor.feasibility import tracking_reward
from fgtutor.io.validation import Count, check_arguments
from fgtutor.patches import PatchGrid, sample_patches
from fgtutor.policies.dreamwaq import VELOCITY, History
from fgtutor.policies.symmetry import Mirror
from fgtutor.robots.commands import (
    LOOKAHEAD,
    EnvConfig,
    bearing,
    off_by,
    slowdown,
    turn_rate,
)
from fgtutor.robots.lanes import Lanes
from fgtutor.world.terrain import TerrainSeed, World


def plain_tensors(method: Callable[..., Any]) -> Callable[..., Any]:
    """Run a method so that what it makes are ordinary tensors without gradients.

    rsl_rl collects rollouts under `inference_mode`, whose tensors could not be written to
    afterwards.
    """
    return torch.inference_mode(False)(torch.no_grad()(method))


UNTRIED = 1 / 3
"""How far back it counts as a failure to go on to another's obstacle, as a share of the label's
window. Over the whole of it, no policy would be feasible where one must hand over to the next."""


class LocomotionEnv(VecEnv):
    """A batch of robots on a `World`, with observation groups {policy, patch, command, tracking}.

    The `tracking` group holds, for the step just taken, (r_v, failed, ended): r_v is 0 once a robot
    has failed, so a fall can never look feasible; nor can what is never tried: whoever goes on to
    another's obstacle has failed there, by `UNTRIED`. If asked for, `history` holds the last frames
    of what a blind robot feels and `critic` all that the simulation knows: true velocity, policy.
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
        self.config = config or self.episodes
        self.cfg = self.config
        self.max_episode_length = round(self.config.episode_seconds / self.control_dt)
        prepared = world.lay(patches.prepare)
        self.heights = torch.tensor(prepared.heights, device=device)
        self.resolution, self.origin = prepared.resolution, prepared.origin
        self.offsets = torch.as_tensor(world.offset, dtype=torch.float32, device=device)
        self.num_rows, self.num_columns = self.offsets.shape[:2]
        self.tile_size = torch.tensor(
            world.tiles[0][0].elevation.size, dtype=torch.float32, device=device
        )

        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.row = torch.zeros(num_envs, dtype=torch.long)
        self.column = torch.arange(num_envs) % self.num_columns
        self.command = torch.zeros(num_envs, 3, device=device)
        self.cruise = torch.zeros(num_envs, device=device)
        self.target_yaw = torch.zeros(num_envs, device=device)
        self.told_yaw = torch.zeros(num_envs, device=device)
        self.anchor = torch.zeros(num_envs, 2, device=device)
        self.begin = torch.zeros(num_envs, 2, device=device)
        self.turning = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.crossing = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.aside = torch.zeros(num_envs, device=device)
        self.lanes = Lanes(world, self.config.run_up, device)
        self.tracking = torch.zeros(num_envs, 3, device=device)
        self.return_r_v = torch.zeros(num_envs, device=device)
        self.stuck_from = torch.zeros(num_envs, 2, device=device)
        self.stuck_steps = torch.zeros(num_envs, dtype=torch.long, device=device)
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

    def truth(self, policy: Float[Tensor, "envs features"]) -> Float[Tensor, "envs 3"]:
        """Return what is `unfelt`; a robot with noisy observations returns it without noise."""
        return policy[:, list(self.unfelt)]

    def rebuild(self) -> None:
        """Rebuild the physics so that nothing of the past remains in it."""

    # rsl_rl's VecEnv --------------------------------------------------------------------------

    @plain_tensors
    def get_observations(self) -> TensorDict:
        """Return the observation groups at the robots' present state."""
        patch = self.patches()
        policy = torch.cat((self.proprioception(), self.command, self.scan(patch)), dim=-1)
        groups = {
            "policy": policy,
            "patch": patch,
            "command": self.command.clone(),
            "tracking": self.tracking.clone(),
        }
        if self.history:
            groups["history"] = self.history.see(policy[:, list(self.felt)])
            groups["critic"] = torch.cat((self.truth(policy), policy), dim=-1)
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
        failed = fell | self._stuck(pose) | self._strayed(pose)
        r_v = tracking_reward(self.along_heading(pose, velocity), self.command[:, :2]) * ~failed
        reward = self.reward(r_v, failed)
        self.return_r_v += r_v
        outside, strange = self._outside(pose)
        truncated = (self.episode_length_buf >= self.max_episode_length) | outside
        done = failed | truncated
        lost = failed.float().maximum(UNTRIED * strange)
        self.tracking = torch.stack((r_v, lost, done.float()), dim=-1)
        extras = {"time_outs": (truncated & ~failed).float(), "fell": fell}
        if self.config.train:
            ids = done.nonzero().flatten()
            if len(ids):
                self._promote(ids, failed[ids])
                self.reset(ids)
            self._steer()
        return self.get_observations(), reward, done.long(), extras

    # Episodes ---------------------------------------------------------------------------------

    def reseed(self, seed: int) -> None:
        """Start the random stream of episodes anew: what follows depends on `seed` alone."""
        self.random = torch.Generator(device="cpu").manual_seed(seed)

    @plain_tensors
    def reset_all(self) -> None:
        """Begin a new episode for every robot on a rebuilt simulation."""
        self.rebuild()
        self.tracking.zero_()
        self.reset(torch.arange(self.num_envs))

    @plain_tensors
    def reset(self, ids: Int[Tensor, "n"]) -> None:
        """Begin new training episodes for `ids`: draw a pose, a heading and a speed."""
        n = len(ids)
        self.column[ids] = (self.column[ids] + 1) % self.num_columns
        poses, crossing = self._draw_poses(ids)
        low, high = self.config.speed
        speed = low + (high - low) * self._uniform(n)
        self.start(ids, poses, speed)
        self.turning[ids] = self._uniform(n) < self.config.turn_share
        self.crossing[ids] = crossing
        beside = poses[:, 1] - self.tile_corner(ids)[:, 1] - self._lane(ids, poses[:, 0])
        spread = self.lanes.spreads[self.row[ids], self.column[ids]]
        self.aside[ids] = torch.minimum(torch.maximum(beside, -spread), spread)

    @plain_tensors
    def start(self, ids: Tensor, poses: Float[Tensor, "n 3"], speed: Tensor | float) -> None:
        """Begin episodes at the given poses and forward speed, without drawing anything."""
        self.place(ids, poses)
        if self.history:
            self.history.forget(ids)
        self.episode_length_buf[ids] = 0
        self.return_r_v[ids] = 0.0
        self.stuck_steps[ids] = 0
        self.stuck_from[ids] = poses[:, :2]
        self.anchor[ids] = poses[:, :2]
        self.begin[ids] = poses[:, :2]
        self.target_yaw[ids] = poses[:, 2]
        self.told_yaw[ids] = poses[:, 2]
        self.crossing[ids] = False
        self.turning[ids] = False
        self.command[ids] = 0.0
        self.command[ids, 0] = speed
        self.cruise[ids] = speed

    def patches(self) -> Float[Tensor, "envs points"]:
        """Return the height patch H_xy under every robot, looking along its yaw."""
        pose, _ = self.motion()
        return sample_patches(
            self.heights,
            pose[:, [0, 1, 3]],
            self.grid,
            resolution=self.resolution,
            origin=self.origin,
        )

    def scan(self, patch: Float[Tensor, "envs points"]) -> Tensor:
        """Return the part of the patch that the policy sees; all of it by default."""
        return patch

    def state_dict(self) -> dict[str, Tensor]:
        """Return what training must store to continue: the curriculum and the random stream."""
        return {
            "row": self.row.clone(),
            "column": self.column.clone(),
            "random": self.random.get_state(),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over a stored curriculum and random stream; call `reset_all` afterwards.

        Raises `ValueError` if there is no such row or column here.
        """
        for name, number in zip(("row", "column"), self.offsets.shape, strict=False):
            value, own = state[name], getattr(self, name)
            fits = (value.shape, value.dtype) == (own.shape, own.dtype)
            if not (fits and ((value >= 0) & (value < number)).all()):
                raise ValueError(f"the {name} of each robot should be one of {number}")
        self.row, self.column = state["row"].clone(), state["column"].clone()
        self.random.set_state(state["random"])

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.random).to(self.device)

    def _lane(self, ids: Tensor, x: Tensor) -> Tensor:
        """Return how far to the left of its tile's corner each robot's lane lies at world x, m."""
        row, column = self.row[ids], self.column[ids]
        return self.lanes.at(row, column, x - self.offsets[row, column, 0])

    def _draw_poses(self, ids: Tensor) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """Draw poses: before the obstacle to cross it, or anywhere the ground is level."""
        n, tries = len(ids), 8
        corner = self.tile_corner(ids)
        row, column = self.row[ids], self.column[ids]
        first, last = self.lanes.limits[row, column].unbind(-1)
        width = self.tile_size[1]
        backwards = self._uniform(n) < 0.3
        side = backwards.long()
        x = self.lanes.ends[row, column, side]
        if math.isfinite(self.config.run_up):
            x = x + self._uniform(n) * (self.lanes.near[row, column, side] - x)
        # Near enough to the lane to reach it before the obstacle begins.
        beside = (self.lanes.spreads[row, column] + self.config.start_beside).clamp(max=0.3 * width)
        beside = beside * (2 * self._uniform(n) - 1)
        y = self._lane(ids, corner[:, 0] + x) + beside
        yaw = torch.where(backwards, torch.full((n,), math.pi), torch.zeros(n))
        across = torch.stack((corner[:, 0] + x, corner[:, 1] + y, yaw), dim=-1)
        inside = 0.1 + 0.8 * self._uniform(n, tries, 2)
        size = torch.stack((last - first, width.expand(n)), dim=-1)
        corner[:, 0] += first
        eighths = torch.floor(self._uniform(n, tries) * 8)
        anywhere = torch.cat(
            (corner[:, None] + inside * size[:, None], eighths[..., None] * (math.pi / 4)), dim=-1
        )
        patch = sample_patches(
            self.heights, anywhere, self.grid, resolution=self.resolution, origin=self.origin
        )
        under = patch[..., self.grid.footprint_index]
        best = (under.amax(-1) - under.amin(-1)).argmin(dim=1)
        level = anywhere[torch.arange(n), best]
        crossing = self._uniform(n) < self.config.traverse_share
        poses = torch.where(crossing[:, None], across, level)
        # Askew towards the lane, as a route comes to it, and rather more than less, since who fails
        # to turn leaves few samples; a little to either side elsewhere.
        slight, share = 0.15, self._uniform(n)
        to_lane = -torch.sign(beside * torch.cos(poses[:, 2]))
        askew = to_lane * ((self.config.start_yaw + slight) * share.sqrt() - slight)
        poses[:, 2] += torch.where(crossing, askew, slight * (2 * share - 1))
        return poses, crossing

    def _steer(self) -> None:
        """Command the turn rate that keeps each robot on its line, as on a route."""
        pose, _ = self.motion()
        turn = self.turning & (self._uniform(self.num_envs) < self.control_dt / 2.0)
        if turn.any():
            eighths = torch.floor(self._uniform(self.num_envs) * 5) - 2
            self.target_yaw = torch.where(
                turn, self.target_yaw + eighths * (math.pi / 4), self.target_yaw
            )
            self.anchor = torch.where(turn[:, None], pose[:, :2], self.anchor)
            self.crossing &= ~turn
        wanted = self.target_yaw - bearing(self._beside_line(pose))
        if self.crossing.any():
            forth = torch.sign(torch.cos(self.target_yaw))
            beside = forth * self._beside_lane(pose, LOOKAHEAD * forth)
            ahead = torch.where(forth > 0, 0.0, math.pi)
            wanted = torch.where(self.crossing, ahead - bearing(beside), wanted)
        self.steer(wanted, pose[:, 3])
        expected = self.config.obedience * self.config.max_turn_rate
        self.told_yaw += self.control_dt * turn_rate(wanted, self.told_yaw, expected)
        # Nobody is expected to wait for it: it never lags behind who has turned further.
        to_go, left = off_by(wanted, self.told_yaw), off_by(wanted, pose[:, 3])
        further = (to_go * left > 0) & (left.abs() < to_go.abs())
        self.told_yaw = torch.where(further, pose[:, 3], self.told_yaw)

    def steer(self, wanted: Float[Tensor, "envs"], yaw: Float[Tensor, "envs"]) -> None:
        """Command the turn rate, and the speed meanwhile, that bring each robot to a heading."""
        self.command[:, 0] = self.cruise * slowdown(wanted, yaw, self.config.slowest)
        self.command[:, 2] = turn_rate(wanted, yaw, self.config.max_turn_rate)

    def _beside_line(self, pose: Tensor) -> Float[Tensor, "envs"]:
        """Return how far to the left of the straight line from its anchor each robot is, m."""
        x, y = (pose[:, :2] - self.anchor).unbind(dim=-1)
        return torch.cos(self.target_yaw) * y - torch.sin(self.target_yaw) * x

    def _beside_lane(self, pose: Tensor, forth: Tensor | float = 0.0) -> Float[Tensor, "envs"]:
        """Return how far each robot is in y from its way over the tile, `forth` further on, m."""
        everyone = torch.arange(self.num_envs, device=self.device)
        lane = self._lane(everyone, pose[:, 0] + forth) + self.aside
        return pose[:, 1] - lane - self.tile_corner(everyone)[:, 1]

    def _strayed(self, pose: Tensor) -> Bool[Tensor, "envs"]:
        """Tell which robots have left their way; on a route, keeping it is the follower's task."""
        if not self.config.train:
            return torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        beside = torch.where(self.crossing, self._beside_lane(pose), self._beside_line(pose))
        away = torch.cos(pose[:, 3] - self.told_yaw) < math.cos(math.pi / 4)
        return (beside.abs() > self.config.stray) | away

    def along_heading(
        self, pose: Float[Tensor, "envs 4"], velocity: Float[Tensor, "envs 3"]
    ) -> Float[Tensor, "envs 2"]:
        """Return the planar velocity along and across the heading that each robot was told.

        In its own frame, a robot that turns away from an obstacle and walks off would track its
        command perfectly. On a route, the heading is the follower's to correct.
        """
        if not self.config.train:
            return velocity[:, :2]
        off = pose[:, 3] - self.told_yaw
        cos, sin, (vx, vy) = torch.cos(off), torch.sin(off), velocity[:, :2].unbind(-1)
        return torch.stack((cos * vx - sin * vy, sin * vx + cos * vy), dim=-1)

    def _stuck(self, pose: Tensor) -> Bool[Tensor, "envs"]:
        moved = (pose[:, :2] - self.stuck_from).norm(dim=-1) > self.config.stuck_progress
        self.stuck_from = torch.where(moved[:, None], pose[:, :2], self.stuck_from)
        self.stuck_steps = torch.where(moved, 0, self.stuck_steps + 1)
        return self.stuck_steps * self.control_dt > self.config.stuck_seconds

    def _outside(self, pose: Tensor) -> tuple[Bool[Tensor, "envs"], Bool[Tensor, "envs"]]:
        """Tell which robots have left their tile, and which of them for a neighbour's obstacle."""
        x, y = (pose[:, :2] - self.tile_corner(torch.arange(self.num_envs))).unbind(dim=-1)
        first, last = self.lanes.limits[self.row, self.column].unbind(-1)
        beyond = (x < first) | (x > last)
        strange = beyond & (x > 0.0) & (x < self.tile_size[0])
        return beyond | (y < 0.0) | (y > self.tile_size[1]), strange

    def tile_corner(self, ids: Tensor) -> Float[Tensor, "n 2"]:
        """Return the world position of the corner (0, 0) of each robot's present tile, m."""
        return self.offsets[self.row[ids], self.column[ids]]

    def _promote(self, ids: Tensor, failed: Tensor) -> None:
        """Move robots along the difficulty rows by the tracking reward of the episode just ended.

        Only crossings count against a robot: what other episodes ask for may be impossible. One
        that masters the last row is sent to a random one of the harder half.
        """
        mean = self.return_r_v[ids] / self.episode_length_buf[ids].clamp(min=1)
        way = (self.motion()[0][ids, :2] - self.begin[ids]).norm(dim=-1) / self.tile_size[0]
        up = (mean > self.config.promote_above) & (way > 0.25) & ~failed
        down = (mean < self.config.demote_below) | (failed & (way < 0.5))
        down &= self.crossing[ids]
        row = self.row[ids] + up.long() - (down & ~up).long()
        half = self.num_rows // 2
        anywhere = half + torch.floor(self._uniform(len(ids)) * (self.num_rows - half)).long()
        self.row[ids] = torch.where(row >= self.num_rows, anywhere, row.clamp(min=0))
