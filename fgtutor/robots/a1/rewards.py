"""What the A1 is rewarded for: one small function per term, and the terms' weights.

Reads plain tensors (one row per robot, legs in the order of `model.LEGS`); gives one number per
robot. The family of terms is that of legged_gym (Rudin et al., CoRL 2021), with a clocked gait as
in Siekmann et al., ICRA 2021. Foot heights are above the ground near the foot, never above z = 0,
or they would teach nonsense on slopes.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.io.validation import check_fields
from fgtutor.robots.a1.model import JOINT_RANGES, LINKS

TROT = (0.0, 0.5, 0.5, 0.0)
"""By how much of a gait cycle each leg is ahead: diagonal legs move together."""
POSTURE = (3.0, 0.1, 0.1) * 4
"""How much each joint's distance from `NARROW` counts: legs may bend, but not spread."""
NARROW = (0.2, 0.0, 0.0, -0.2, 0.0, 0.0) * 2
"""Joint angles relative to the stance that posture asks for, rad: 0.1 rad inward instead of 0.1
outward at the hips, so that left and right feet fit on 0.25 m of ground instead of 0.35 m."""
SOFT_LIMIT = 0.95
"""Share of a joint's range in which it may move freely."""

Weight = Annotated[float, Interval(ge=-1000, le=1000)]
"""What a term of the reward counts."""


@dataclass(frozen=True, kw_only=True)
class RewardWeights:
    """Weight of each term, per second; the sum is floored at zero.

    Terms that also pay a robot that stands are multiplied by `moving`, so that waiting in front of
    a hard place is worth little: hesitation, not falling, is what robots learn otherwise.
    """

    tracking: Weight = 1.2
    """Narrow kernel of the planar velocity error."""
    approach: Weight = 0.6
    """Wide kernel of the same error: a slope to climb from afar."""
    turning: Weight = 0.5
    """Kernel of the turn rate error, when moving."""
    gait: Weight = 1.5
    """Stepping with the clock, when moving."""
    posture: Weight = 0.5
    """Joints near the stance, feet close together, when moving."""
    orientation: Weight = -2.0
    """Squared sine of the trunk's tilt."""
    bounce: Weight = -0.5
    """Squared vertical velocity."""
    wobble: Weight = -0.02
    """Squared roll and pitch rate."""
    limits: Weight = -1.0
    """Joint angles beyond the soft limits, rad."""
    jerk: Weight = -0.02
    """Squared change of the action."""
    landing: Weight = -0.3
    """Foot forces beyond what a step needs."""

    def __post_init__(self) -> None:
        check_fields(self)


def kernel(error: Float[Tensor, "*n"], width: float) -> Float[Tensor, "*n"]:
    """Return exp(-error^2 / width), 1 at no error; `width` in the error's unit squared."""
    return torch.exp(-error.square() / width)


def moving(speed_error: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return 0.2 + 0.8 exp(-e^2 / 0.25): what style is worth at this velocity error (m/s)."""
    return 0.2 + 0.8 * kernel(speed_error, 0.25)


def stance_share(clock: Float[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Return how much each foot should stand (1) or swing (0) at a clock in gait cycles.

    The two blend into each other, so that the moment of touching down is the robot's to choose.
    """
    phase = clock[:, None] + torch.tensor(TROT, device=clock.device)
    return (0.5 + 1.2 * torch.sin(2 * math.pi * phase)).clamp(0.0, 1.0)


def gait(
    stance: Float[Tensor, "n 4"],
    force: Float[Tensor, "n 4"],
    slide: Float[Tensor, "n 4"],
    clearance: Float[Tensor, "n 4"],
    corridor: tuple[float, float],
) -> Float[Tensor, "n"]:
    """Return -1 to 1: stand loaded and without sliding, swing unloaded in the corridor.

    Standing on all feet does half of it at any time and is worth 0.

    Args:
        stance: How much each foot should stand, from `stance_share`.
        force: Size of the ground's force on the foot, N.
        slide: Speed of the foot, m/s.
        clearance: Height of the sole above the highest ground near the foot, m.
        corridor: Lowest and highest clearance of a good swing, m.
    """
    # Two feet carry the 13.7 kg in a trot, 67 N each; more than half of that is loaded.
    load = (force / 40.0).clamp(max=1.0)
    low, high = corridor
    outside = (low - clearance).clamp(min=0.0) + (clearance - high).clamp(min=0.0)
    stand = load * kernel(slide, 0.1)
    swing = (1.0 - load) * kernel(outside, 0.03**2)
    return 2.0 * (stance * stand + (1.0 - stance) * swing).mean(dim=-1) - 1.0


def posture(joints: Float[Tensor, "n 12"]) -> Float[Tensor, "n"]:
    """Return exp(-sum w (q - n)^2) of joints q relative to the stance and `NARROW` n, rad."""
    weight, narrow = (torch.tensor(row, device=joints.device) for row in (POSTURE, NARROW))
    return torch.exp(-(weight * (joints - narrow).square()).sum(dim=-1))


def limits(angles: Float[Tensor, "n 12"]) -> Float[Tensor, "n"]:
    """Return by how much the joints exceed their soft limits together, rad."""
    low, high = torch.tensor([JOINT_RANGES[link] for link in LINKS], device=angles.device).T
    middle, half = (low + high) / 2, SOFT_LIMIT * (high - low) / 2
    beyond = (angles - middle.repeat(4)).abs() - half.repeat(4)
    return beyond.clamp(min=0.0).sum(dim=-1)


def landing(force: Float[Tensor, "n 4"]) -> Float[Tensor, "n"]:
    """Return the foot forces beyond the robot's whole weight on one foot, in units of 100 N."""
    return ((force - 135.0) / 100.0).clamp(0.0, 2.0).sum(dim=-1)
