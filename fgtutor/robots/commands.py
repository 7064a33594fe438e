"""What robots are told: the settings of episodes, and how fast to turn to a heading.

Reads headings; gives turn rates. Shared by training, where episodes are drawn, and by execution,
where a route is followed.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Ge, Interval
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from fgtutor.io.validation import Ascending, NonNegative, Share, Unbounded, check_fields

Speed = Annotated[float, Interval(ge=0, le=20)]
"""A speed, m/s."""
Time = Annotated[float, Interval(gt=0, le=3600)]
"""A part of an episode, s."""
LOOKAHEAD = 0.45
"""Distance to the point on its line that a robot steers for, m, in training as on a route."""


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """How episodes are drawn and ended; the robot's own numbers live beside the robot."""

    speed: Annotated[tuple[Speed, Speed], Ascending] = (0.7, 1.0)
    """Range of the commanded forward speed, m/s."""
    max_turn_rate: Annotated[float, Interval(gt=0, le=20)] = 1.5
    """Limit of the commanded turn rate, rad/s."""
    episode_seconds: Time = 8.0
    """Time limit of an episode, s."""
    stuck_seconds: Unbounded = 2.0
    """An episode without `stuck_progress` for this long has failed, s; waiting must not pay."""
    stuck_progress: NonNegative = 0.05
    """Progress that counts as moving, m."""
    stray: Unbounded = 1.0
    """In training a robot this far beside its line has failed, m, and so has one that heads more
    than 45 degrees off the heading that it was told."""
    slowest: Share = 1.0
    """Least share of its speed at which a robot turns; 1: it never slows down to turn."""
    obedience: Annotated[float, Interval(gt=0, le=1)] = 1.0
    """Share of the greatest turn rate at which a robot is expected to follow a new heading."""
    start_yaw: Annotated[float, Interval(ge=0, le=math.pi)] = 0.15
    """Greatest angle at which a crossing comes to its lane, rad; routes do at 45 or 90 degrees."""
    start_beside: NonNegative = 0.3
    """Greatest distance beside the corridor over the obstacle at which a crossing begins, m."""
    run_up: Annotated[float, Ge(0), Field(allow_inf_nan=True)] = math.inf
    """Least distance before the obstacle at which a crossing begins, m, since a route may bend as
    late; infinite: all begin at the tile's end."""
    traverse_share: Share = 0.6
    """Share of episodes that start before the obstacle and cross it; others start anywhere."""
    turn_share: Share = 0.25
    """Share of episodes whose heading changes on the way, as a route's does."""
    promote_above: Share = 0.5
    """Mean r_v of an unfailed episode from which its robot moves to a harder row."""
    demote_below: Share = 0.3
    """Mean r_v of a crossing below which its robot moves to an easier row; so does a failure in the
    tile's first half."""
    train: bool = True
    """Draw new episodes when one ends; False leaves finished robots where they are."""
    history: Annotated[int, Interval(ge=0, le=100)] = 0
    """Frames that a blind policy remembers; with any, there are groups `history` and `critic`."""

    def __post_init__(self) -> None:
        check_fields(self)


def bearing(beside: Float[Tensor, "envs"]) -> Float[Tensor, "envs"]:
    """Return by how much to head to the right of a line's direction to come back to it, rad.

    `beside` is how far to the left of the line each robot is, m. It steers for the point of the
    line that is `LOOKAHEAD` away, and never comes in at more than 45 degrees, as on a route.
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
