"""How an A1 stands where it is placed: as high and as tilted as the ground under its feet is.

Reads heights under the four feet; gives the trunk's height and rotation.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from fgtutor.robots.a1.model import STANCE_HEIGHT

FEET = ((0.17, -0.155), (0.17, 0.155), (-0.22, -0.155), (-0.22, 0.155))
"""Where the feet stand in the stance, in the yaw frame, m; legs in the order of `LEGS`."""
MAX_SLOPE = 0.6
"""Steepest ground a robot is tilted to when it is placed; rise over run."""


def stand(
    under: Float[Tensor, "n 4"], yaw: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 4"]]:
    """Return the trunk's height, m, and its quaternion, from the ground under each foot."""
    feet = torch.tensor(FEET, device=under.device)
    right, left = under[:, 0::2].mean(-1), under[:, 1::2].mean(-1)
    front, rear = under[:, :2].mean(-1), under[:, 2:].mean(-1)
    slope_x = ((front - rear) / (FEET[0][0] - FEET[2][0])).clamp(-MAX_SLOPE, MAX_SLOPE)
    slope_y = ((left - right) / (FEET[1][1] - FEET[0][1])).clamp(-MAX_SLOPE, MAX_SLOPE)
    # The lowest plane of this slope that keeps all four feet out of the ground.
    rise = slope_x[:, None] * feet[:, 0] + slope_y[:, None] * feet[:, 1]
    ground = (under - rise).amax(-1)
    steep = (1 + slope_x.square() + slope_y.square()).sqrt()
    height = ground + steep * STANCE_HEIGHT + 0.01
    pitch = -torch.atan(slope_x)
    return height, _quaternion(torch.atan(slope_y * torch.cos(pitch)), pitch, yaw)


def _quaternion(
    roll: Float[Tensor, "n"], pitch: Float[Tensor, "n"], yaw: Float[Tensor, "n"]
) -> Float[Tensor, "n 4"]:
    """Return (w, x, y, z) of the rotation about x, then y, then z of the world (REP-103)."""
    (cr, cp, cy), (sr, sp, sy) = (
        [trig(a / 2) for a in (roll, pitch, yaw)] for trig in (torch.cos, torch.sin)
    )
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        dim=-1,
    )
