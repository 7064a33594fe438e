"""From a point cloud to an elevation map: remove outliers, sort points into cells, find the ground.

Reads points [n, 3] in metres, z up (`io.clouds` reads them from files); gives a `ScannedMap`: the
`ElevationMap` that planning takes, and how many points each of its cells rests on.
Source: paper, Sec. IV-C (a MID-360 scan, denoised, in voxels of 5 cm); the outlier test is that of
Rusu et al., "Towards 3D Point Cloud Based Object Maps for Household Environments" (2008).
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from fgtutor.elevation import ElevationMap
from fgtutor.errors import CloudError
from fgtutor.grid import MOST_CELLS, cells_of, check_cells, coordinate_text
from fgtutor.io.cloud import Cloud, Points, cloud_of
from fgtutor.io.validation import Count, NonNegative, Unbounded, check_arguments, check_fields

Area = tuple[float, float, float, float]

VOXEL = 0.05
"""Side of a voxel, m (paper); a cell is divided into whole voxels as near to it as possible."""
_EMPTY = 1000
"""A map of more than a million cells is refused if it has more cells per point than this, for the
same reason that `MOST_CELLS` is."""
WALL = 0.2
"""Points of a cell that are spread over more than this lie on a wall too, m. No step is so high,
and no slope that can be walked rises so far within a cell."""
LAYER = 0.08
"""Thickness of the layer in which the points of level ground lie, m: twice two standard deviations
of a MID-360's range."""
AROUND = 0.15
"""How far level ground is looked for, m, which tells how many points such a layer holds here."""
_DISTANCES = 10**7
"""Distances that are kept in memory at a time."""
_TICK = 1e-4
"""Heights are sorted in steps of this, m; far below what any scanner resolves."""


@dataclass(frozen=True, kw_only=True)
class ScanConfig:
    """How a point cloud becomes a map."""

    resolution: Annotated[float, Interval(gt=0, le=1000)] = 0.05
    """Side of a cell, m."""
    neighbours: Annotated[int, Interval(ge=0, le=1000)] = 8
    """Voxels that the outlier test looks at around each voxel; 0 leaves the test out."""
    outlier_ratio: NonNegative = 3.0
    """A voxel is an outlier if its mean distance to its neighbours exceeds the cloud's mean by this
    many standard deviations, and in any case two and a half voxels, and twice what the nearest
    neighbour is usually away."""
    min_points: Count = 2
    """A cell with fewer points stays unknown."""
    clearance: Unbounded = 1.5
    """Points that hang at least this far above those below them are no ground (a ceiling, leaves)
    and are left out, m."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def voxel(self) -> float:
        """Side of a voxel, m; a whole number of them makes a cell."""
        return self.resolution / max(round(self.resolution / VOXEL), 1)


@dataclass(frozen=True, eq=False)
class ScannedMap:
    """An elevation map, and what each cell of it rests on."""

    elevation: ElevationMap
    """The median height of each cell's points; beside a wall, of those on top of it or at its foot,
    whichever the cell is. Cells with too few are unknown. So an edge stays where it is: anything
    higher would grow every block and narrow every gap, of which a scanner sees more wall than
    floor."""
    count: Int[np.ndarray, "nx ny"]
    """Points in each cell."""
    outliers: int
    """Points that the outlier test removed."""
    overhanging: int
    """Points that hung too far above the ground."""
    outside: int = 0
    """Points outside the area."""

    @property
    def sparse(self) -> int:
        """Points in cells that have too few of them."""
        return int(self.count[~self.elevation.known].sum())

    def __repr__(self) -> str:
        return (
            f"ScannedMap({self.elevation}, {self.count.sum()} points in "
            f"{np.count_nonzero(self.count)} cells, without {self.outliers} outliers and "
            f"{self.overhanging} overhanging)"
        )


def map_points(
    points: Points | Cloud, *, config: ScanConfig | None = None, area: Area | None = None
) -> ScannedMap:
    """Turn a cloud into a map.

    Args:
        points: Points in metres, z up; rows that are masked or not finite are left out.
        config: The settings.
        area: Corners (x0, y0, x1, y1) that the map covers, m; its cells begin at (x0, y0), and a
            cell that reaches beyond (x1, y1) belongs to it. Default: all points, with cell borders
            at multiples of the resolution.

    Raises:
        CloudError: There are no points, none lies in the area, no cell has enough of them, they
            are stored too coarsely for the cells, or the map would be absurdly large.
        MapError: The coordinates are too large for the cells.
    """
    config = config or ScanConfig()
    check_arguments(map_points, {"area": area}, CloudError)
    cloud = cloud_of(points)
    _check_step(cloud, config.resolution)
    points, corner, shape = cloud.points, np.zeros(2), None
    # In their own type, whose rounding tells how near to a border a point lies on it.
    stored = points.astype(np.float32) if cloud.single else points
    if area is not None:
        corner, end = np.array(area[:2], dtype=float), np.array(area[2:], dtype=float)
        if not (corner < end).all():
            raise CloudError(f"the area {area} is empty: give x0 y0 x1 y1 with x0 < x1 and y0 < y1")
        shape = np.maximum(-cells_of(-end, -corner, config.resolution), 2)
        check_cells(shape.tolist(), CloudError)
    cells = cells_of(stored[:, :2], corner, config.resolution)
    if shape is not None:
        inside = ((cells >= 0) & (cells < shape)).all(axis=1)
        if not inside.any():
            raise CloudError(
                f"no point lies in the area {area}; the cloud covers {_extent(points, config)}"
            )
        points, stored, cells = points[inside], stored[inside], cells[inside]
    outside = len(cloud.points) - len(points)
    keep = _inliers(points, stored, corner, config)
    outliers = len(points) - int(keep.sum())
    if outliers:
        points, cells = points[keep], cells[keep]
    first = np.zeros(2, dtype=np.int64)
    if shape is None:
        first = cells.min(axis=0)
        shape = np.maximum(cells.max(axis=0) - first + 1, 2)
        if math.prod(shape.tolist()) > min(MOST_CELLS, max(10**6, _EMPTY * len(points))):
            raise CloudError(
                f"a map of {shape[0]} x {shape[1]} cells is too large for the cloud over "
                f"{_extent(points, config)}: check that it is in metres, give an area, or a "
                "coarser resolution"
            )
    cells -= first
    origin = np.round(corner + first * config.resolution, 9).tolist()
    heights, count, overhanging = _ground(
        cells[:, 0] * shape[1] + cells[:, 1], points[:, 2], tuple(shape.tolist()), config
    )
    return ScannedMap(
        elevation=ElevationMap(heights, config.resolution, (origin[0], origin[1])),
        count=count,
        outliers=outliers,
        overhanging=overhanging,
        outside=outside,
    )


def _check_step(cloud: Cloud, resolution: float) -> None:
    """Raise `CloudError` if neighbouring values of a coordinate are too far apart for the cells.

    Floats come in steps of powers of two, which fit no cell: with a tenth of it, cells get up to a
    tenth more points than others. The steps of LAS are decimal, as cells are, and mostly divide
    them; with half a cell some still get twice what others get, beyond that some get none.
    """
    largest = float(np.abs(cloud.points).max())
    floats = cloud.single or cloud.step <= np.spacing(largest)
    if cloud.step > resolution / (10 if floats else 2):
        cure = "subtract an offset from them" + ", or export doubles" * cloud.single
        raise CloudError(
            f"the coordinates, up to {largest:g} m, are stored in steps of {cloud.step:g} m, too "
            f"coarse for cells of {resolution:g} m: "
            + (cure if floats else "export with a finer scale, or choose coarser cells")
        )


def _inliers(
    points: Points, stored: np.ndarray, corner: np.ndarray, config: ScanConfig
) -> Bool[np.ndarray, " n"]:
    """Tell which points lie in voxels that have neighbours as near as voxels usually have.

    Voxels, not points, are compared: near the scanner points lie closer, voxels do not; and a
    hundred times fewer of them have to be searched.
    """
    voxels = cells_of(stored, (*corner, 0.0), config.voxel)
    voxels -= voxels.min(axis=0)
    nx, ny, nz = (voxels.max(axis=0) + 1).tolist()
    if nx * ny * nz >= 2**62:
        raise CloudError(
            f"the cloud covers {_extent(points, config)}, too far for voxels of {config.voxel:g} m:"
            " check that it is in metres, or give an area"
        )
    ix, iy, iz = voxels.T
    _, voxel, count = np.unique((ix * ny + iy) * nz + iz, return_inverse=True, return_counts=True)
    if config.neighbours == 0 or len(count) <= config.neighbours:
        return np.ones(len(points), dtype=bool)
    centres = np.stack([np.bincount(voxel, axis) / count for axis in points.T], axis=-1)
    tree, parts = cKDTree(centres), -(-len(centres) * (config.neighbours + 1) // _DISTANCES)
    means, nearest = [], []
    for part in np.array_split(centres, parts):
        # Each voxel is its own nearest neighbour, at distance 0.
        distance = tree.query(part, config.neighbours + 1, workers=-1)[0]
        means.append(distance.sum(axis=1) / config.neighbours)
        nearest.append(distance[:, 1])
    mean = np.concatenate(means)
    limit = mean.mean() + config.outlier_ratio * mean.std()
    # In a corner of an even sheet the mean distance is 1.8 times that to the nearest, and being
    # there is no fault.
    least = max(2.5 * config.voxel, 2.0 * float(np.median(np.concatenate(nearest))))
    return (mean <= max(limit, least))[voxel]


def _ground(
    cell: Int[np.ndarray, " n"],
    z: Float[np.ndarray, " n"],
    shape: tuple[int, int],
    config: ScanConfig,
) -> tuple[Float[np.ndarray, "nx ny"], Int[np.ndarray, "nx ny"], int]:
    """Return the height of the ground in each cell, its points, and how many hung above it."""
    # One sort of whole numbers, cell and height in one, is ten times faster than two of floats.
    low = z.min()
    span = int((z.max() - low) / _TICK) + 2
    if span * shape[0] * shape[1] >= 2**63:
        raise CloudError(f"heights reach from {low:g} to {z.max():g} m: check that z is in metres")
    ticks = np.round((z - low) / _TICK).astype(np.int64)
    cell, ticks = np.divmod(np.sort(cell * span + ticks), span)
    z = low + ticks * _TICK

    def runs() -> tuple[np.ndarray, np.ndarray]:
        first = np.flatnonzero(np.diff(cell, prepend=-1))
        return first, np.diff(first, append=len(cell))

    first, count = runs()
    gap = np.diff(z, prepend=z[0]) >= config.clearance
    gap[first] = False
    gaps_below = np.cumsum(gap)
    ground = gaps_below == np.repeat(gaps_below[first], count)
    overhanging = len(z) - int(ground.sum())
    if overhanging:
        cell, z = cell[ground], z[ground]
        first, count = runs()

    def quantile(share: float) -> np.ndarray:
        # The nearest rank: the lowest height that at least this share of the points do not exceed.
        return z[first + np.ceil(share * count).astype(np.int64) - 1]

    where = np.unravel_index(cell[first], shape)

    def grid(values: np.ndarray, empty: float = np.nan) -> np.ndarray:
        full = np.full(shape, empty, dtype=np.float32)
        full[where] = values
        return full

    high = quantile(0.95)
    walled = high - z[first] > WALL
    on_top = np.add.reduceat((z > np.repeat(high - LAYER, count)).astype(np.int64), first)
    around = 2 * min(round(AROUND / config.resolution), max(shape)) + 1
    level = ndimage.maximum_filter(grid(np.where(walled, 0, count), empty=0.0), size=around)
    # What a wall holds up shows as many points on top as level ground. What lies at its foot shows
    # there only those of the wall that fall into its cell: fewer, or a small share of its own.
    foot = walled & ((on_top < 0.5 * level[where]) | (on_top < 0.3 * count))
    top = z[first + count - 1 - on_top // 2]
    heights = np.where(foot, quantile(0.05), np.where(walled, top, quantile(0.5)))

    enough = count >= config.min_points
    if not enough.any():
        raise CloudError(
            f"no cell of {config.resolution:g} m holds {config.min_points} points: scan more "
            "densely, choose a coarser resolution or a lower min_points"
        )
    counts = np.zeros(shape, dtype=np.int32)
    counts[where] = count
    return grid(np.where(enough, heights, np.nan)), counts, overhanging


def _extent(points: Points, config: ScanConfig) -> str:
    """Return what a cloud covers, in words."""
    low, high = (
        [coordinate_text(value, config.resolution) for value in corner]
        for corner in (points.min(axis=0).tolist(), points.max(axis=0).tolist())
    )
    return ", ".join(f"{axis} {a}..{b} m" for axis, a, b in zip("xyz", low, high, strict=True))
