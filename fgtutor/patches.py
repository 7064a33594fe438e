"""Local height patches H_xy around a pose, cut from an elevation map (paper, Sec. III-B).

Reads a prepared map (no unknown cells, deep holes levelled) and poses (x, y, yaw); gives heights
relative to the ground under the robot. Training and planning call the same function, which is what
makes the planner's input look like the training data.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.elevation import ElevationMap, Resolution
from fgtutor.errors import ConfigError
from fgtutor.grid import point_text
from fgtutor.io.validation import check_arguments, check_fields

HOLE_DEPTH = 0.3
"""Depth at which a hole counts as bottomless, m: deeper cells look alike to a patch."""
HOLE_REACH = 0.25
"""How far the ground that a hole is measured against may be, m: holes are up to twice as wide. Any
further, and the bottom of a valley with walls of 50 degrees would count as one."""
SPACING = 0.1
"""Distance between neighbouring points of a patch, m."""
MOST_POINTS = 10_000
"""Points of the largest patch."""
Reach = Annotated[float, Interval(ge=0, le=100)]
"""How far a patch reaches, m."""


@dataclass(frozen=True, kw_only=True)
class PatchGrid:
    """Where a patch is sampled, in the robot's yaw frame (x ahead, y left), metres."""

    ahead: Reach = 0.8
    """Reach in front of the robot's centre, m."""
    behind: Reach = 0.8
    """Reach behind the robot's centre, m."""
    half_width: Reach = 0.5
    """Reach to either side, m."""
    spacing: Annotated[float, Interval(ge=1e-3, le=100)] = SPACING
    """Distance between neighbouring points, m."""
    footprint: tuple[Reach, Reach] = (0.2, 0.1)
    """Half length and half width of the area whose median is the ground under the robot, m."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.num_points > MOST_POINTS:
            raise ConfigError(
                f"{self} has {self.num_points} points, more than {MOST_POINTS}: take a larger "
                "spacing or a smaller patch"
            )
        if not self.footprint_index.numel():
            raise ConfigError(
                f"no patch point lies under the footprint {self.footprint}: enlarge it"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Points along x and along y."""
        rows = round(self.ahead / self.spacing) + round(self.behind / self.spacing) + 1
        return rows, 2 * round(self.half_width / self.spacing) + 1

    @property
    def num_points(self) -> int:
        """Points in one flattened patch."""
        return self.shape[0] * self.shape[1]

    @cached_property
    def points(self) -> Float[Tensor, "points 2"]:
        """The points (x, y) in the yaw frame, m; x varies slowest, from behind to ahead."""
        rows, columns = self.shape
        x = (torch.arange(rows) - round(self.behind / self.spacing)) * self.spacing
        y = (torch.arange(columns) - columns // 2) * self.spacing
        return torch.cartesian_prod(x, y).to(torch.float32).reshape(-1, 2)

    @cached_property
    def footprint_index(self) -> Tensor:
        """Indices of the points that lie under the robot."""
        half_length, half_width = self.footprint
        inside = (self.points[:, 0].abs() <= half_length + 1e-6) & (
            self.points[:, 1].abs() <= half_width + 1e-6
        )
        return inside.nonzero().flatten()


def prepare(elevation: ElevationMap) -> ElevationMap:
    """Return the map that patches are taken from: filled, deep holes levelled, not finer than them.

    A slot's depth would dominate L_recon while saying nothing about how hard it is to cross; cells
    more than `HOLE_DEPTH` below the ground around them are raised to that depth. A finer map is
    smoothed to the points' `SPACING`, so that an edge between two of them is felt by both.
    """
    return elevation.filled().levelled(depth=HOLE_DEPTH, reach=HOLE_REACH).smoothed(SPACING)


def sample_heights(
    heights: Float[Tensor, "nx ny"],
    xy: Float[Tensor, "*batch 2"],
    *,
    resolution: Resolution,
    origin: tuple[float, float],
) -> Float[Tensor, "*batch"]:
    """Interpolate heights bilinearly at world points; beyond the border the edge cell continues.

    A point that is NaN has the height NaN. Raises `ConfigError` if these are no floats, or floats
    too coarse for the cells at coordinates as large as `origin`.
    """
    check_arguments(sample_heights, locals(), ConfigError)
    if not (heights.is_floating_point() and xy.is_floating_point()):
        raise ConfigError(f"heights and points must be floats, got {heights.dtype} and {xy.dtype}")
    if max(map(abs, origin)) * torch.finfo(xy.dtype).eps > 0.1 * resolution:
        raise ConfigError(
            f"points in {xy.dtype} at the origin {point_text(origin, resolution)} m are coarser "
            f"than cells of {resolution:g} m: subtract the origin, or use float64"
        )
    nx, ny = heights.shape
    u = ((xy[..., 0] - origin[0]) / resolution - 0.5).clamp(0, nx - 1)
    v = ((xy[..., 1] - origin[1]) / resolution - 0.5).clamp(0, ny - 1)
    i = u.long().clamp(0, max(nx - 2, 0))
    j = v.long().clamp(0, max(ny - 2, 0))
    a, b = u - i, v - j
    flat, base = heights.reshape(-1), i * ny + j
    right, up = ny * (nx > 1), int(ny > 1)

    def at(cell: Tensor) -> Tensor:  # several times faster than flat[cell]
        return flat.index_select(0, cell.reshape(-1)).reshape(cell.shape)

    near = at(base) * (1 - b) + at(base + up) * b
    far = at(base + right) * (1 - b) + at(base + right + up) * b
    return near * (1 - a) + far * a


def rotate(points: Float[Tensor, "points 2"], yaw: Float[Tensor, "*batch"]) -> Tensor:
    """Rotate yaw-frame points into the world, one copy per yaw: [*batch, points, 2]."""
    cos, sin = torch.cos(yaw)[..., None], torch.sin(yaw)[..., None]
    x, y = points[:, 0], points[:, 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def ground_height(patch: Float[Tensor, "*batch points"], grid: PatchGrid) -> Tensor:
    """Return the median height of the points under the footprint, [*batch, 1].

    The lower of the two middle values is taken when their number is even.
    """
    return patch[..., grid.footprint_index].median(dim=-1, keepdim=True).values


def sample_patches(
    heights: Float[Tensor, "nx ny"],
    poses: Float[Tensor, "*batch 3"],
    grid: PatchGrid,
    *,
    resolution: Resolution,
    origin: tuple[float, float] = (0.0, 0.0),
) -> Float[Tensor, "*batch points"]:
    """Cut the yaw-aligned patch H_xy at each pose (x, y, yaw), relative to the ground beneath it.

    `heights` comes from a prepared map (see `prepare`). The rotation to the heading happens here,
    so a patch always looks along the way the robot faces. Raises `ConfigError` as `sample_heights`,
    and if a pose or a height near it is not finite: a NaN would spread through the whole batch.
    """
    offsets = rotate(grid.points.to(heights), poses[..., 2])
    points = poses[..., None, :2] + offsets
    patch = sample_heights(heights, points, resolution=resolution, origin=origin)
    if not torch.isfinite(patch).all():
        raise ConfigError(
            "sample_patches needs finite heights and poses; call patches.prepare(map) first"
        )
    return patch - ground_height(patch, grid)


def reach(grid: PatchGrid) -> float:
    """Return the distance from the centre to the farthest point of the patch, m."""
    return math.hypot(max(grid.ahead, grid.behind), grid.half_width)
