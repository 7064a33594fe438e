"""The Unitree A1 behind the same seam as the toy: MuJoCo physics, a trot clock and a height scan.

Reads a `World`; gives a `LocomotionEnv` whose actions are joint targets around the stance, at 50
Hz. All robots share one MuJoCo model of the world's ground, simulated as a batch (`physics`).
The recipe (observations, rewards, gains) follows legged_gym (Rudin et al., CoRL 2021) and, for a
policy that trains on two CPU cores, adds a gait clock and left-right symmetry.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import math
import warnings
from dataclasses import asdict, fields
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter
from torch import Tensor

from fgtutor.patches import PatchGrid, ground_height, rotate, sample_heights
from fgtutor.robots.a1 import observation, rewards
from fgtutor.robots.a1.footing import FEET, stand
from fgtutor.robots.a1.ground import edges, rims
from fgtutor.robots.a1.model import (
    FOOT_RADIUS,
    STANCE,
    STANCE_HEIGHT,
    A1Config,
    sensor_slices,
    world_spec,
)
from fgtutor.robots.a1.observation import NOISE, SCAN_GRID, SCAN_LIMIT, SCAN_SCALE
from fgtutor.robots.a1.physics import Physics
from fgtutor.robots.a1.randomise import WIDE, A1EnvConfig, Bodies, delayable, randomise
from fgtutor.robots.a1.sensing import Senses
from fgtutor.robots.base import Layout, LocomotionEnv
from fgtutor.robots.crossings import EnvConfig
from fgtutor.world.terrain import World

A1_GRID = PatchGrid(ahead=0.8, behind=0.8, half_width=0.5)
"""The A1's patch: 17 x 11 points, 1.6 m x 1.0 m."""
LOOK_GRID = PatchGrid(ahead=0.9, behind=0.8, half_width=0.5)
"""The patch and the policy's scan (`SCAN_GRID`), sampled at once."""
MAX_TILT = 1.2
"""A trunk tilted further than this has fallen, rad."""
DROP = 0.35
"""A sole this far below the ground around it has dropped into a hole, m; at the bottom of a valley
with walls of 50 degrees it is 0.3 m below the ground that is `RIM` away."""
RIM = 0.25
"""Half of the widest hole that a foot can drop into while the robot still stands, m."""
FREE_FALL = 2.0
"""A trunk that sinks faster than this falls, m/s: a step of 0.2 m would do it, walking never."""
NOSE = 0.35
"""Distance ahead of the trunk's centre at which a wrong turn rate counts as a wrong velocity, m."""
A1_EPISODES = EnvConfig(
    speed=(0.45, 0.9),
    max_turn_rate=1.0,
    episode_seconds=20.0,
    stuck_seconds=2.5,
    slowest=0.25,
    obedience=0.5,
    start_yaw=1.6,
    start_beside=0.5,
    run_up=0.6,
    traverse_share=0.85,
    promote_above=0.4,
    demote_below=0.15,
)
"""The A1's commands; the time limit lets the slowest command cross a tile of 8 m."""


class A1Env(LocomotionEnv):
    """A batch of A1s in MuJoCo."""

    num_actions = 12
    """Joint targets relative to the stance, in the order of `model.JOINTS`."""
    grid = A1_GRID
    mirror = observation.mirror()
    episodes = A1_EPISODES
    felt, unfelt = observation.FELT, observation.UNFELT
    disturbances: ClassVar = {"usual": A1EnvConfig(), "wide": WIDE}

    def __init__(
        self,
        world: World,
        num_envs: int = 1024,
        *,
        config: EnvConfig | None = None,
        settings: A1EnvConfig | None = None,
        model: A1Config | None = None,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        """Build the model of the world and a batch of robots on it.

        Unless `settings` say otherwise, robots in training are randomised and noisy, others are
        neither. `threads` default to torch's: one process, one number of cores.
        """
        config = config or self.episodes
        self.settings = settings or A1EnvConfig(randomise=config.train, noise=config.train)
        self.model = model or A1Config()
        self.control_dt = self.model.timestep * self.settings.substeps
        super().__init__(world, num_envs, config=config, seed=seed, device=device)
        spec = world_spec(world, self.model)
        if self.settings.delay[1]:
            delayable(spec, self.settings.delay[1])
        self.physics = Physics(spec.compile(), num_envs, threads=threads or torch.get_num_threads())
        self.sensors = sensor_slices()
        ground = np.asarray(world.elevation.filled().heights)
        self.peaks = torch.as_tensor(maximum_filter(ground, 3), device=device)
        self.edges = torch.as_tensor(edges(ground), device=device)
        self.rims = torch.as_tensor(rims(ground, round(RIM / self.resolution)), device=device)
        self.stance = torch.tensor(STANCE, device=device)
        self.look_points = LOOK_GRID.points.to(device)
        self.noise, self.scale = (
            torch.cat([torch.full((row[0],), row[k]) for row in NOISE.values()]).to(device)
            for k in (1, 2)
        )
        self.noise *= self.settings.noise_share
        if self.settings.velocity != "true":  # its errors are another kind
            self.noise[: NOISE["velocity"][0]] = 0.0
        self.last_action = torch.zeros(num_envs, 12, device=device)
        self.action_change = torch.zeros(num_envs, 12, device=device)
        self.clock = torch.zeros(num_envs, device=device)
        self.exploded = torch.zeros(num_envs, dtype=torch.bool)
        self.explosions = 0
        self.senses = Senses(self.settings, num_envs, self.control_dt, self.uniform, device)
        self.late, _, self.traits = Bodies.alike(num_envs)
        self.body_seed = seed
        self._randomise()
        self.reset_all()

    # Physics ----------------------------------------------------------------------------------

    def _randomise(self) -> None:
        """Make every simulation another robot on another ground, once for all its episodes."""
        if self.settings.randomise:
            bodies = randomise(self.physics, self.settings, self.body_seed)
            self.late, calm, self.traits = (value.to(self.device) for value in bodies)
            self.senses.share = (~calm).float()

    def state_dict(self) -> dict[str, Tensor]:
        """Return what training must store to continue, and which robots it had drawn."""
        return super().state_dict() | {"body_seed": torch.tensor(self.body_seed)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over a stored state, with the robots that belong to it."""
        super().load_state_dict(state)
        self.body_seed = int(state["body_seed"])
        self._randomise()

    def rebuild(self) -> None:
        """Reset every simulation: no contact and no warm start of the past survives."""
        self.physics.reset()
        self.physics.forward()
        self._read()

    def advance(self, actions: Float[Tensor, "envs 12"]) -> None:
        """Set the joint targets and simulate one control step."""
        broken = ~torch.isfinite(actions).all(dim=-1)
        action = torch.where(broken[:, None], 0.0, actions.detach()).to(self.stance)
        applied = torch.where(self.late, self.last_action, action)
        self.action_change, self.last_action = action - self.last_action, action
        target = self.stance + self.settings.action_scale * applied
        if self.settings.randomise and self.settings.push_speed:
            self._push()
        self.physics.ctrl.copy_(target - self.senses.encoder)
        self.physics.step(self.settings.substeps)
        self.clock = (self.clock + self.settings.gait_frequency * self.control_dt).remainder(1.0)
        self._read()
        force = self._feet("foot_force").norm(dim=-1)
        self.senses.advance(self.q[:, 7:], self.v[:, 6:], self.v[:, 3:6], self.up, force)
        self._count_explosions(broken.cpu())

    def _push(self) -> None:
        """Change the velocity of a few robots, as a shove would."""
        hit = self.uniform(self.num_envs) < self.control_dt / self.settings.push_seconds
        if hit.any():
            shove = self.settings.push_speed * (2 * self.uniform(self.num_envs, 2) - 1)
            shove = self.senses.share * shove * hit[:, None]
            self.physics.qvel[:, :2] += shove.double().cpu()

    def _count_explosions(self, broken: Bool[Tensor, "envs"]) -> None:
        """Mark simulations whose numbers blew up, or whose actions were not numbers, as lost.

        They stay lost until they are placed anew; no other simulation is touched.
        """
        lost = broken
        lost[self.physics.exploded()] = True
        new = int((lost & ~self.exploded).sum())
        self.exploded |= lost
        if new:
            self.explosions += new
            warnings.warn(
                f"{new} simulations exploded and count as failed ({self.explosions} so far)",
                RuntimeWarning,
                stacklevel=2,
            )

    def _read(self) -> None:
        """Take the state over from the simulator, with the trunk's rotation worked out."""
        self.q = self.physics.qpos.to(self.device, torch.float32)
        self.v = self.physics.qvel.to(self.device, torch.float32)
        self.sensed = self.physics.sensors.to(self.device, torch.float32)
        w, x, y, z = self.q[:, 3:7].unbind(-1)
        # Rows of the rotation matrix: the axes of the world as the trunk sees them.
        east = torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1)
        north = torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1)
        self.up = torch.stack(
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1
        )
        vx, vy, vz = self.v[:, :3].T[..., None]
        self.body_velocity = vx * east + vy * north + vz * self.up
        yaw = torch.atan2(north[:, 0], east[:, 0])
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        vx, vy = vx[:, 0], vy[:, 0]
        turn = (self.v[:, 3:6] * self.up).sum(-1)
        self.pose = torch.cat((self.q[:, :3], yaw[:, None]), dim=-1)
        self.velocity = torch.stack((cos * vx + sin * vy, cos * vy - sin * vx, turn), dim=-1)

    # Places -----------------------------------------------------------------------------------

    def place(self, ids: Int[Tensor, "n"], poses: Float[Tensor, "n 3"]) -> None:
        """Put robots at rest in their stance, tilted to the ground under their feet."""
        feet = torch.tensor(FEET, device=self.device)
        under = self._lookup(self.peaks, poses[:, None, :2] + rotate(feet, poses[:, 2]))
        state = torch.zeros(len(ids), self.physics.model.nq, device=self.device)
        state[:, :2] = poses[:, :2]
        state[:, 2], state[:, 3:7] = stand(under, poses[:, 2])
        state[:, 7:] = self.stance
        self.physics.reset(ids)
        self.physics.qpos[ids] = state.double().cpu()
        self.physics.forward(ids)
        self.last_action[ids] = 0.0
        self.action_change[ids] = 0.0
        self.clock[ids] = 0.0
        self.exploded[ids] = False
        self.senses.begin(ids)
        self.physics.hold(ids, self.stance - self.senses.encoder[ids])
        self._read()

    def _lookup(
        self, cells: Float[Tensor, "nx ny"], xy: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch"]:
        """Return the value of the cell that each point lies in; off the map, of the nearest."""
        nx, ny = cells.shape
        i = ((xy[..., 0] - self.origin[0]) / self.resolution).long().clamp(0, nx - 1)
        j = ((xy[..., 1] - self.origin[1]) / self.resolution).long().clamp(0, ny - 1)
        return cells[i, j]

    # What the base class asks -----------------------------------------------------------------

    def motion(self) -> tuple[Float[Tensor, "envs 4"], Float[Tensor, "envs 3"]]:
        """Return the trunk's pose (x, y, z, yaw) and its velocity (vx, vy, wz) in the yaw frame."""
        return self.pose, self.velocity

    def proprioception(self) -> Float[Tensor, "envs 47"]:
        """Return what `NOISE` lists, scaled; noisy if the settings say so."""
        angle = 2 * math.pi * self.clock[:, None]
        features = torch.cat(
            (
                self.senses.told(self.body_velocity),
                self.v[:, 3:6] + self.senses.gyro,
                -self.up - torch.linalg.cross(self.senses.tilt, self.up),
                self.q[:, 7:] + self.senses.encoder - self.stance,
                self.v[:, 6:],
                self.last_action,
                torch.sin(angle),
                torch.cos(angle),
            ),
            dim=-1,
        )
        if self.settings.noise:
            features += self.senses.share * self.noise * (2 * self.uniform(*features.shape) - 1)
        # What is about to explode must not reach the learner either.
        return (features * self.scale).clamp(-20.0, 20.0)

    def truth(self, policy: Tensor) -> Float[Tensor, "envs 3"]:
        """Return the trunk's velocity in its own frame, without noise, scaled as observed."""
        return (self.body_velocity * self.scale[:3]).clamp(-20.0, 20.0)

    def conditions(self) -> dict[str, Any]:
        """Return the settings and the model, as plain values."""
        return {"settings": asdict(self.settings), "model": asdict(self.model)}

    def layout(self) -> Layout:
        """Describe the observation and the action."""
        settings = self.settings
        return observation.layout(self.model, settings.action_scale, settings.gait_frequency)

    def patches(self) -> Float[Tensor, "envs points"]:
        """Return the patches that `sample_patches` would; the scan shares their points."""
        seen_from = self.pose[:, :2] + self.displacement + self.senses.scan[:, :2]
        points = seen_from[:, None] + rotate(self.look_points, self.pose[:, 3])
        look = sample_heights(self.heights, points, resolution=self.resolution, origin=self.origin)
        self.look = look.reshape(-1, *LOOK_GRID.shape)
        patch = self.look[:, : A1_GRID.shape[0]].flatten(1)
        return patch - ground_height(patch, A1_GRID)

    def scan(self, patch: Float[Tensor, "envs points"]) -> Float[Tensor, "envs 135"]:
        """Return heights around the robot relative to its trunk, centred and scaled.

        They come from where `patches` has just looked: unlike a patch, the policy sees its own
        height above the ground.
        """
        rows, columns = SCAN_GRID.shape
        side = (LOOK_GRID.shape[1] - columns) // 2
        trunk = self.pose[:, 2:3] + self.senses.scan[:, 2:]
        heights = self.look[:, -rows:, side : side + columns].flatten(1) - trunk
        if self.settings.noise:
            noise = self.senses.share * self.settings.scan_noise
            heights += noise * (2 * self.uniform(*heights.shape) - 1)
        return SCAN_SCALE * (heights.clamp(-SCAN_LIMIT, SCAN_LIMIT) + STANCE_HEIGHT)

    def fallen(self) -> Bool[Tensor, "envs"]:
        """Tell which robots lie, touch the ground with the trunk, fell into a hole or exploded."""
        touching = self.sensed[:, self.sensors["trunk_contact"]].any(dim=-1)
        tipped = self.up[:, 2] < math.cos(MAX_TILT)
        feet = self._feet("foot_position")
        rim = self._lookup(self.rims, feet[..., :2])
        dropped = (feet[..., 2] - FOOT_RADIUS < rim - DROP).any(dim=-1)
        falling = self.v[:, 2] < -FREE_FALL
        return touching | tipped | dropped | falling | self.exploded.to(self.device)

    def drawing(self) -> Float[np.ndarray, "envs 19"]:
        """Return qpos: trunk position (world), trunk quaternion (w, x, y, z) and joint angles."""
        return self.physics.qpos.numpy().copy()

    def reward(self, r_v: Tensor, failed: Bool[Tensor, "envs"]) -> Float[Tensor, "envs"]:
        """Return the weighted sum of the terms, floored at zero: ending early never pays."""
        total = sum(self.reward_terms().values(), torch.zeros(self.num_envs, device=self.device))
        return self.control_dt * torch.where(failed, 0.0, total.clamp(min=0.0))

    def reward_terms(self) -> dict[str, Float[Tensor, "envs"]]:
        """Return each weighted term of the step just taken, per second."""
        velocity = self.crossings.along_heading(self.pose, self.velocity)
        wrong = (velocity - self.command[:, :2]).norm(dim=-1)
        turn = self.velocity[:, 2] - self.command[:, 2]
        # The error of a point ahead of the trunk: on the spot, turning wrongly is the only error.
        nose = torch.hypot(wrong, NOSE * turn)
        style = rewards.moving(nose)
        force = self._feet("foot_force").norm(dim=-1)
        foot = self._feet("foot_position")
        gait = rewards.gait(
            rewards.stance_share(self.clock),
            force,
            self._feet("foot_velocity").norm(dim=-1),
            foot[..., 2] - FOOT_RADIUS - self._lookup(self.edges, foot[..., :2]),
            self.settings.swing_height,
        )
        terms = {
            "tracking": rewards.kernel(wrong, 0.1),
            "approach": rewards.kernel(nose, 0.25),
            "turning": style * rewards.kernel(turn, 0.25),
            "gait": style * gait,
            "posture": style * rewards.posture(self.q[:, 7:] - self.stance),
            "orientation": self.up[:, :2].square().sum(-1),
            "bounce": self.v[:, 2].square(),
            "wobble": self.v[:, 3:5].square().sum(-1),
            "limits": rewards.limits(self.q[:, 7:]),
            "jerk": self.action_change.square().sum(-1),
            "landing": rewards.landing(force),
        }
        weights = self.settings.weights
        return {f.name: getattr(weights, f.name) * terms[f.name] for f in fields(weights)}

    def _feet(self, name: str) -> Float[Tensor, "envs 4 3"]:
        """Return a group of sensors, one vector per foot."""
        return self.sensed[:, self.sensors[name]].reshape(-1, 4, 3)
