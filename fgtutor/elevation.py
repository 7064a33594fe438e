"""The elevation map M: one height per cell, what is unknown, and where the grid lies in the world.

Reads heights [nx, ny] or a file (.npz, GeoTIFF, 16-bit PNG with a YAML sidecar); gives cells,
heights at points and derived maps. Source: the paper's M in R^(W x H), Sec. III-B.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy import ndimage

from fgtutor import mapfiles
from fgtutor.errors import MapError, OffMapError
from fgtutor.grid import cells_of, coordinate_text, point_text


@dataclass(frozen=True, eq=False)
class ElevationMap:
    """Heights on a regular grid, indexed [ix, iy]; z up, metres.

    Raises:
        MapError: The heights are not a 2-D grid of at least 2 x 2 cells, hold an infinity, or are
            all unknown; or the resolution, the origin or `known` does not fit.
    """

    heights: Float[np.ndarray, "nx ny"]
    """Height of each cell, m; NaN where it was never observed. Kept as a read-only float32 copy."""
    resolution: float = 0.1
    """Side of a cell, m."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Lower-left corner (not centre) of cell (0, 0), m."""
    known: Bool[np.ndarray, "nx ny"] = None  # pyright: ignore[reportAssignmentType]
    """Which cells were observed; default: those that are not NaN."""

    def __post_init__(self) -> None:
        heights = _as_heights(self.heights)
        resolution = float(self.resolution)
        if not (math.isfinite(resolution) and resolution > 0):
            raise MapError(f"resolution must be a positive number of metres, got {self.resolution}")
        origin = tuple(float(value) for value in self.origin)
        if len(origin) != 2 or not all(math.isfinite(value) for value in origin):
            raise MapError(f"origin must be two finite numbers (x, y) in metres, got {self.origin}")
        observed = ~np.isnan(heights)
        known = observed if self.known is None else np.array(self.known, dtype=bool)
        if known.shape != heights.shape:
            raise MapError(f"known has shape {known.shape}, the heights have {heights.shape}")
        if (known & ~observed).any():
            ix, iy = np.argwhere(known & ~observed)[0]
            raise MapError(f"cell ({ix}, {iy}) is marked known but its height is NaN")
        if not known.any():
            raise MapError("every cell of the map is unknown (NaN): nothing can be planned on it")
        heights.flags.writeable = known.flags.writeable = False
        for name, value in {
            "heights": heights,
            "resolution": resolution,
            "origin": origin,
            "known": known,
        }.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """Say what a person wants to know about a map, in one line."""
        low, high = np.nanmin(self.heights), np.nanmax(self.heights)
        unknown = int((~self.known).sum())
        return (
            f"ElevationMap({self.shape[0]} x {self.shape[1]} cells of {self.resolution:g} m from "
            f"{self.origin}, heights {low:.2f}..{high:.2f} m, {unknown} unknown)"
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells along x and along y."""
        nx, ny = self.heights.shape
        return nx, ny

    @property
    def size(self) -> tuple[float, float]:
        """Length along x and along y, m."""
        return self.shape[0] * self.resolution, self.shape[1] * self.resolution

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Corners (x0, y0, x1, y1) of the area covered, m."""
        (x0, y0), (length, width) = self.origin, self.size
        return x0, y0, x0 + length, y0 + width

    @property
    def centres(self) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
        """The x of every column of cells and the y of every row, m."""
        x, y = (np.arange(n) + 0.5 for n in self.shape)
        return self.origin[0] + x * self.resolution, self.origin[1] + y * self.resolution

    def cell_of(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (ix, iy) that holds a point; a border belongs to the upper cell.

        The far border of the map has no upper cell and belongs to the last one.

        Raises:
            OffMapError: The point lies outside the map.
        """
        if not self.contains(x, y):
            x0, y0, x1, y1 = (coordinate_text(value, self.resolution) for value in self.extent)
            raise OffMapError(
                f"{point_text((x, y), self.resolution)} m is off the map, which covers x from {x0} "
                f"to {x1} m and y from {y0} to {y1} m: choose a point inside"
            )
        ix, iy = cells_of((x, y), self.origin, self.resolution).tolist()
        return min(ix, self.shape[0] - 1), min(iy, self.shape[1] - 1)

    def centre_of(self, ix: int, iy: int) -> tuple[float, float]:
        """Return the centre (x, y) of a cell, m; the cell need not be on the map."""
        return (
            self.origin[0] + (ix + 0.5) * self.resolution,
            self.origin[1] + (iy + 0.5) * self.resolution,
        )

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point lies on the map, its border included."""
        if math.isnan(x) or math.isnan(y):
            return False
        # Turned over, a border belongs to the lower cell: so the far one is on the map.
        low = cells_of((x, y), self.origin, self.resolution)
        high = cells_of((-x, -y), [-corner for corner in self.extent[2:]], self.resolution)
        return bool((low >= 0).all() and (high >= 0).all())

    def height_at(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Interpolate heights bilinearly between cell centres; beyond them the edge cell continues.

        `x` and `y` broadcast. The result is NaN where a cell that carries weight is NaN.
        """
        (nx, ny), (x0, y0) = self.shape, self.origin
        u = np.clip((np.asarray(x, dtype=float) - x0) / self.resolution - 0.5, 0, nx - 1)
        v = np.clip((np.asarray(y, dtype=float) - y0) / self.resolution - 0.5, 0, ny - 1)
        i = np.minimum(u.astype(int), nx - 2)
        j = np.minimum(v.astype(int), ny - 2)
        a, b = u - i, v - j
        total = np.zeros(np.broadcast_shapes(u.shape, v.shape))
        for di, wi in ((0, 1 - a), (1, a)):
            for dj, wj in ((0, 1 - b), (1, b)):
                # 0 * NaN is NaN: an unknown neighbour without weight must not spread.
                weight = wi * wj
                total = total + np.where(weight > 0, weight * self.heights[i + di, j + dj], 0.0)
        return total

    def filled(self) -> Self:
        """Return the map with every unknown cell at the nearest known height; `known` is kept."""
        if self.known.all():
            return self
        _, (ix, iy) = ndimage.distance_transform_edt(~self.known, return_indices=True)  # pyright: ignore
        return self._replace(self.heights[ix, iy], known=self.known)

    def levelled(self, depth: float, reach: float) -> Self:
        """Return the map with deep holes raised to `depth` below the ground around them.

        A hole has higher ground on both sides: the ground around it is the grey closing of the map
        with a square of round(reach / resolution) cells to each side, which fills what is narrower
        than the square and leaves the foot of a wall or of a slope alone. At the border the edge
        cell continues.

        Raises:
            MapError: Some height is NaN (call `filled` first), or a number is negative or NaN.
        """
        if not (depth >= 0 and reach >= 0):
            raise MapError(f"levelled needs depth >= 0 and reach >= 0 m, got {depth} and {reach}")
        if np.isnan(self.heights).any():
            raise MapError("levelled needs a height in every cell: call filled() first")
        cells = round(reach / self.resolution)
        square = (2 * cells + 1, 2 * cells + 1)
        # Closed on a padded map: scipy's own border would erode what it has just dilated.
        padded = np.pad(self.heights, 2 * cells, mode="edge")
        closed = ndimage.grey_erosion(ndimage.grey_dilation(padded, size=square), size=square)
        inside = tuple(slice(2 * cells, 2 * cells + n) for n in self.shape)
        highest = closed[inside]
        return self._replace(
            np.maximum(self.heights, highest - np.float32(depth)), known=self.known
        )

    def smoothed(self, width: float) -> Self:
        """Return the map seen through a triangular window that reaches `width` to each side, m.

        Sampled every `width` metres, the map as it is would hide where between two samples an edge
        lies; smoothed, its height there tells. A width of one cell or less changes nothing.

        Raises:
            MapError: Some height is NaN (call `filled` first), or the width is negative or NaN.
        """
        if not width >= 0:
            raise MapError(f"smoothed needs a width of 0 m or more, got {width}")
        if np.isnan(self.heights).any():
            raise MapError("smoothed needs a height in every cell: call filled() first")
        cells = round(width / self.resolution)
        if cells <= 1:
            return self
        box = np.ones(cells)
        window = np.convolve(box, box) / cells**2
        heights = self.heights.astype(np.float64)
        for axis in (0, 1):
            heights = ndimage.convolve1d(heights, window, axis=axis, mode="nearest")
        return self._replace(heights, known=self.known)

    def crop(self, x0: float, y0: float, x1: float, y1: float) -> Self:
        """Return the cells whose centres lie in the rectangle, which may reach beyond the map.

        Raises:
            MapError: Fewer than 2 x 2 cells are left.
        """
        x, y = self.centres
        ix = np.flatnonzero((x >= x0) & (x <= x1))
        iy = np.flatnonzero((y >= y0) & (y <= y1))
        if len(ix) < 2 or len(iy) < 2:
            raise MapError(
                f"crop to {point_text((x0, y0, x1, y1), self.resolution)} m leaves {len(ix)} x "
                f"{len(iy)} cells of the map over {point_text(self.extent, self.resolution)} m; at "
                "least 2 x 2 are needed"
            )
        window = slice(ix[0], ix[-1] + 1), slice(iy[0], iy[-1] + 1)
        corner_x, corner_y = self.centre_of(int(ix[0]), int(iy[0]))
        half = 0.5 * self.resolution
        return self._replace(
            self.heights[window],
            known=self.known[window],
            origin=(corner_x - half, corner_y - half),
        )

    def resample(self, resolution: float) -> Self:
        """Return the map on cells of another size: bilinear heights, the origin kept.

        A new cell is known, and has a height, where the old cell at its centre was known. The area
        shrinks or grows by less than half a new cell where its size is no multiple of theirs.
        """
        if not (math.isfinite(resolution) and resolution > 0):
            raise MapError(f"resolution must be a positive number of metres, got {resolution}")
        steps = [
            (np.arange(max(round(length / resolution), 1)) + 0.5) * resolution
            for length in self.size
        ]
        ix, iy = (
            np.minimum(cells_of(step, 0.0, self.resolution), n - 1)
            for step, n in zip(steps, self.shape, strict=True)
        )
        known = self.known[np.ix_(ix, iy)]
        x, y = self.origin[0] + steps[0], self.origin[1] + steps[1]
        heights = self.filled().height_at(x[:, None], y[None, :])
        kept = known | ~np.isnan(self.heights[np.ix_(ix, iy)])
        heights = np.where(kept, heights, np.nan)
        return type(self)(heights, resolution=resolution, origin=self.origin, known=known)

    def rotated90(self, k: int = 1) -> Self:
        """Return the map turned by k quarter turns counter-clockwise about the world's (0, 0).

        The height at a point p is afterwards the height at R p, R the rotation by 90 k degrees; so
        the new origin is the lower-left corner of the turned rectangle: for k = 1 the old corner
        (x0, y0 + width) goes to (-(y0 + width), x0). Headings shift by 2 k.
        """
        x0, y0, x1, y1 = self.extent
        origin = ((x0, y0), (-y1, x0), (-x1, -y1), (y0, -x1))[k % 4]
        # np.rot90 turns the first axis towards the second: x towards y, counter-clockwise.
        return self._replace(
            np.rot90(self.heights, k), known=np.rot90(self.known, k), origin=origin
        )

    def _replace(self, heights: np.ndarray, *, known: np.ndarray, origin=None) -> Self:
        return type(self)(
            heights, resolution=self.resolution, origin=origin or self.origin, known=known
        )

    def save(self, path: str | Path) -> None:
        """Write the map to .npz, .tif / .tiff (GeoTIFF) or .png (16 bit, with `path`.yaml).

        .npz keeps everything. The images keep what was observed: an unknown cell is written as
        unknown even if it was filled. A PNG rounds heights to 1/65534 of their range.

        Raises:
            MapError: The suffix is none of these.
            StorageError: The system refused to write; nothing partial is left.
        """
        mapfiles.write(self, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a map from .npz, .tif / .tiff or .png (which needs its sidecar `path`.yaml).

        Raises:
            MapError: The file is missing, of another kind, corrupt, or says too little.
        """
        path = Path(path)
        fields = mapfiles.read(path)
        try:
            return cls(**fields)
        except MapError as error:
            raise MapError(f"{path}: {error}") from error


def _as_heights(values: object) -> np.ndarray:
    """Return a float32 copy of the heights, or say what is wrong with them."""
    try:
        with np.errstate(over="ignore"):
            heights = np.array(values, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise MapError(f"heights must be a grid of numbers [nx, ny]: {error}") from error
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise MapError(f"a map needs at least 2 x 2 cells [nx, ny], got shape {heights.shape}")
    infinite = np.isinf(heights)
    if infinite.any():
        ix, iy = np.argwhere(infinite)[0]
        raise MapError(
            f"cell ({ix}, {iy}) has an infinite height ({infinite.sum()} such cells): mark unknown "
            "cells with NaN"
        )
    return heights
