"""How a robot is steered: to a line in training, to a heading on a route.

Reads headings and distances, one per robot; gives headings, speeds and turn rates. A line is
followed by pure pursuit (Coulter, 1992).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

LOOKAHEAD = 0.45
"""Distance to the point on its line that a robot steers for while it learns, m."""


def bearing(beside: Float[Tensor, "envs"]) -> Float[Tensor, "envs"]:
    """Return by how much to head to the right of a line's direction to come back to it, rad.

    `beside` is how far to the left of the line each robot is, m. It steers for the point of the
    line that is `LOOKAHEAD` away, and never comes in at more than 45 degrees.
    """
    steepest = math.sin(math.pi / 4)
    return torch.asin((beside / LOOKAHEAD).clamp(-steepest, steepest))


def off_by(wanted: Tensor, yaw: Tensor) -> Tensor:
    """Return the angle from `yaw` to `wanted` the shorter way, rad in [-pi, pi)."""
    return torch.remainder(wanted - yaw + math.pi, 2 * math.pi) - math.pi


def slowdown(wanted: Tensor, yaw: Tensor, slowest: float) -> Tensor:
    """Return the share of its speed at which a robot should turn to the heading wanted.

    It falls with the square of the yaw error's cosine, to `slowest` from 90 degrees on: without it,
    no bend is tighter than speed / greatest turn rate.
    """
    return torch.cos(wanted - yaw).clamp(min=0.0).square().clamp(min=slowest)


def turn_rate(wanted: Tensor, yaw: Tensor, limit: float, gain: float = 3.0) -> Tensor:
    """Return the turn rate (rad/s) that closes the yaw error the shorter way, within `limit`."""
    return (gain * off_by(wanted, yaw)).clamp(-limit, limit)
