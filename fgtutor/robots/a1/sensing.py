"""What an A1 measures amiss, and how its legs tell its velocity.

Reads `A1EnvConfig` and the true state; gives each robot's errors of encoders, gyroscope, direction
of gravity and scan, drawn anew for each episode, and the velocity that its policy is told. Leg
odometry is the kinematic part of the state estimator in Bloesch et al., RSS 2012: a foot that
carries weight stands still. All vectors are in the trunk's frame (x ahead, y left, z up) unless
said otherwise.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fgtutor.robots.a1.model import (
    CALF_LENGTH,
    FOOT_RADIUS,
    HIP_OFFSET,
    LEG_X,
    LEG_Y,
    THIGH_LENGTH,
)
from fgtutor.robots.a1.observation import NOISE
from fgtutor.robots.a1.randomise import A1EnvConfig

LOADED = 40.0
"""Force from which a foot counts fully as standing, N; two feet carry 67 N each in a trot."""
SMOOTHING = 0.06
"""Time constant of the filter over what the legs say, s."""
SIDES = ((1, -1), (1, 1), (-1, -1), (-1, 1))
"""Front (+1) or rear, left (+1) or right, of each leg, in the order of `model.LEGS`."""


class Senses:
    """The errors of a batch of robots, and what their legs say.

    Attributes:
        share: By how much each robot is in error [envs, 1]: 0 for a calm one, 1 for any other.
        encoder: Error of each joint's zero [envs, 12], rad.
        gyro: Error of the rotation rates [envs, 3], rad/s.
        tilt: Error of the direction of gravity, as a rotation vector [envs, 3], rad.
        scan: Error of the scan [envs, 3], along the world's axes, m.
        velocity: What the velocity is told to be in error by, or, with odometry, to be [envs, 3],
            m/s.
    """

    def __init__(
        self,
        settings: A1EnvConfig,
        num_envs: int,
        control_dt: float,
        uniform: Callable[..., Tensor],
        device: str,
    ) -> None:
        """Begin without errors; `uniform` draws numbers in [0, 1) of a given shape."""
        self.settings, self.dt, self._uniform = settings, control_dt, uniform
        self.share = torch.ones(num_envs, 1, device=device)
        self.encoder = torch.zeros(num_envs, 12, device=device)
        self.gyro, self.tilt, self.scan, self.velocity = torch.zeros(4, num_envs, 3, device=device)
        s = settings
        tilt, scan = (
            (s.tilt_offset, s.tilt_offset, 0.0),
            (s.scan_shift, s.scan_shift, s.scan_offset),
        )
        # A uniform number has a third of its largest one's square as variance.
        error = math.sqrt(3) * s.velocity_error * (s.velocity == "error")
        self._drawn = [
            (value, torch.tensor(largest, device=device).expand(value.shape[1]))
            for value, largest in (
                (self.encoder, s.encoder_offset),
                (self.gyro, s.gyro_offset),
                (self.tilt, tilt),
                (self.scan, scan),
                (self.velocity, error),
            )
            if torch.tensor(largest).any()
        ]

    def begin(self, ids: Int[Tensor, "n"]) -> None:
        """Draw the errors of new episodes."""
        self.velocity[ids] = 0.0
        self.scan[ids] = 0.0
        for value, largest in self._drawn:
            value[ids] = self.share[ids] * largest * self._signed(len(ids), value.shape[1])

    def advance(
        self,
        joints: Float[Tensor, "envs 12"],
        rates: Float[Tensor, "envs 12"],
        spin: Float[Tensor, "envs 3"],
        up: Float[Tensor, "envs 3"],
        force: Float[Tensor, "envs 4"],
    ) -> None:
        """Let one control step pass, from the true state.

        Args:
            joints: Joint angles, rad.
            rates: Joint speeds, rad/s.
            spin: The trunk's rotation rates, rad/s.
            up: The direction against gravity.
            force: Size of the ground's force on each foot, N.
        """
        s = self.settings
        if s.scan_drift:
            step = math.sqrt(3 * self.dt) * s.scan_drift
            self.scan += self.share * step * self._signed(*self.scan.shape)
        if s.velocity == "error":
            kept = math.exp(-self.dt / s.velocity_seconds)
            kick = math.sqrt(3 * (1 - kept**2)) * s.velocity_error
            kicks = self.share * kick * self._signed(*self.velocity.shape)
            self.velocity = kept * self.velocity + kicks
        elif s.velocity == "odometry":
            joints = self._measured(joints + self.encoder, "joints")
            rates = self._measured(rates, "joint rates")
            spin = self._measured(spin + self.gyro, "gyroscope")
            up = up + torch.linalg.cross(self.tilt, up)
            by_legs, weight = leg_odometry(joints, rates, spin, up, force)
            share = min(1.0, self.dt / SMOOTHING) * weight.clamp(max=1.0)[:, None]
            self.velocity = self.velocity + share * (by_legs - self.velocity)

    def told(self, velocity: Float[Tensor, "envs 3"]) -> Float[Tensor, "envs 3"]:
        """Return what the policy is told its velocity is, given the truth."""
        if self.settings.velocity == "true":
            return velocity
        if self.settings.velocity == "error":
            return velocity + self.velocity
        return self.velocity

    def _measured(self, value: Tensor, kind: str) -> Tensor:
        """Add the noise of a kind of sensor, if there is noise."""
        if not self.settings.noise:
            return value
        noise = self.share * self.settings.noise_share * NOISE[kind][1]
        return value + noise * self._signed(*value.shape)

    def _signed(self, *shape: int) -> Tensor:
        """Draw numbers in [-1, 1)."""
        return 2 * self._uniform(*shape) - 1


def leg_odometry(
    joints: Float[Tensor, "n 12"],
    rates: Float[Tensor, "n 12"],
    spin: Float[Tensor, "n 3"],
    up: Float[Tensor, "n 3"],
    force: Float[Tensor, "n 4"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return the trunk's velocity if loaded feet stand still, and how many feet carry it.

    v = -(dp/dt + w x p), averaged over the feet by load; p is the foot's lowest point, which rolls
    with the shank. Arguments as for `Senses.advance`.
    """
    (a, b, c), (da, db, dc) = (values.reshape(-1, 4, 3).unbind(-1) for values in (joints, rates))
    front, left = torch.tensor(SIDES, device=joints.device).T
    knee, dknee = b + c, db + dc
    # In the plane of the leg, x ahead and z along the leg's own vertical.
    x = -THIGH_LENGTH * torch.sin(b) - CALF_LENGTH * torch.sin(knee)
    z = -THIGH_LENGTH * torch.cos(b) - CALF_LENGTH * torch.cos(knee)
    dx = -THIGH_LENGTH * torch.cos(b) * db - CALF_LENGTH * torch.cos(knee) * dknee
    dz = THIGH_LENGTH * torch.sin(b) * db + CALF_LENGTH * torch.sin(knee) * dknee
    y = HIP_OFFSET * left
    cos, sin = torch.cos(a), torch.sin(a)
    arm = torch.stack((x, cos * y - sin * z, sin * y + cos * z), dim=-1)
    hip = torch.stack((LEG_X * front, LEG_Y * left, 0 * left), dim=-1)
    speed = torch.stack((dx, -sin * dz, cos * dz), dim=-1)
    speed += torch.stack((0 * da, -da * arm[..., 2], da * arm[..., 1]), dim=-1)
    sole = -FOOT_RADIUS * up[:, None]
    shank = torch.stack((da, cos * dknee, sin * dknee), dim=-1)
    speed = speed + torch.linalg.cross(shank, sole.expand_as(shank))
    point = hip + arm + sole
    velocity = -(speed + torch.linalg.cross(spin[:, None].expand_as(point), point))
    load = (force / LOADED).clamp(max=1.0)
    weight = load.sum(dim=-1)
    return (load[..., None] * velocity).sum(dim=1) / weight.clamp(min=1e-6)[:, None], weight
