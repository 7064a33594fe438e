"""The elevation map M: one height per cell, what is unknown, and where the grid lies in the world.

Reads heights [nx, ny] or a file (.npz, GeoTIFF, 16-bit PNG with a YAML sidecar); gives cells,
heights at points and derived maps. Source: the paper's M in R^(W x H), Sec. III-B.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy import ndimage

from fgtutor.errors import MapError, OffMapError
from fgtutor.grid import cells_of, check_cells, coordinate_text, point_text
from fgtutor.io import maps
from fgtutor.io.validation import (
    NonNegative,
    check_arguments,
    check_fields,
    detached,
    numbers,
)

Resolution = Annotated[float, Interval(ge=1e-3, le=1e6)]
"""Side of a cell, m. Less than a millimetre is no metre: degrees, in all likelihood."""
_Place = Annotated[float, Interval(ge=-1e12, le=1e12)]
_HIGHEST = 25_000.0
"""Greatest height and depth, m; twice what the Earth has. Beyond, numbers mean something else."""
_NO_HEIGHT = -9999.0
"""What many programs write where they know no height; nothing lies exactly so deep."""
_WIDEST_WINDOW = 10_000
"""Cells; the window of `smoothed` is made in the square of the time."""


@dataclass(frozen=True, eq=False)
class ElevationMap:
    """Heights on a regular grid, indexed [ix, iy]; z up, metres.

    Raises:
        MapError: The heights are not a 2-D grid of at least 2 x 2 real numbers, are no heights in
            metres, or are all unknown; or the resolution, the origin or `known` does not fit.
    """

    heights: Float[np.ndarray, "nx ny"]
    """Height of each cell, m; NaN (or masked) where it was never observed. Kept as a read-only
    float32 copy."""
    resolution: Resolution = 0.1
    """Side of a cell, m."""
    origin: tuple[_Place, _Place] = (0.0, 0.0)
    """Lower-left corner (not centre) of cell (0, 0), m."""
    known: Bool[np.ndarray, "nx ny"] = None  # pyright: ignore[reportAssignmentType]
    """Which cells were observed; default: those that are not NaN."""

    def __post_init__(self) -> None:
        for name in ("resolution", "origin"):  # arrays and tensors as Python's numbers
            value: Any = getattr(self, name)
            value = value.tolist() if hasattr(value, "tolist") else value
            object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)
        check_fields(self, MapError)
        heights = _as_heights(self.heights)
        resolution, origin = float(self.resolution), tuple(map(float, self.origin))
        # Farther out, floats lie too far apart to tell the cells from each other.
        farthest = max(abs(o) + n * resolution for o, n in zip(origin, heights.shape, strict=True))
        if farthest * 2.0**-52 > 1e-5 * resolution:
            raise MapError(
                f"coordinates of {farthest:.0f} m are too large for cells of {resolution:g} m: "
                "subtract an offset from them"
            )
        observed = ~np.isnan(heights)
        known = observed if self.known is None else _as_truths(self.known, heights.shape)
        if (known & ~observed).any():
            ix, iy = np.argwhere(known & ~observed)[0]
            raise MapError(f"cell ({ix}, {iy}) is marked known but its height is NaN")
        if not known.any():
            raise MapError("every cell of the map is unknown (NaN): nothing can be planned on it")
        heights.flags.writeable = known.flags.writeable = False
        values = {"heights": heights, "resolution": resolution, "origin": origin, "known": known}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """Say what a person wants to know about a map, in one line."""
        (nx, ny), low, high = self.shape, np.nanmin(self.heights), np.nanmax(self.heights)
        return (
            f"ElevationMap({nx} x {ny} cells of {self.resolution:g} m from {self.origin}, heights "
            f"{low:.2f}..{high:.2f} m, {(~self.known).sum()} unknown)"
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
        (x0, y0), step = self.origin, self.resolution
        return x0 + (ix + 0.5) * step, y0 + (iy + 0.5) * step

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

        `x` and `y` broadcast. The result is NaN where a cell that carries weight is NaN, or where
        the point is NaN or masked.

        Raises:
            MapError: These are no real numbers.
        """
        (nx, ny), (x0, y0) = self.shape, self.origin
        with np.errstate(over="ignore"):
            x, y = (numbers(n, p, MapError, unknown=True) for n, p in (("x", x), ("y", y)))
            u = np.clip((x - x0) / self.resolution - 0.5, 0, nx - 1)
            v = np.clip((y - y0) / self.resolution - 0.5, 0, ny - 1)
        nowhere = np.isnan(u) | np.isnan(v)
        u, v = np.nan_to_num(u), np.nan_to_num(v)
        i = np.minimum(u.astype(int), nx - 2)
        j = np.minimum(v.astype(int), ny - 2)
        a, b = u - i, v - j
        total = np.zeros(np.broadcast_shapes(u.shape, v.shape))
        for di, wi in ((0, 1 - a), (1, a)):
            for dj, wj in ((0, 1 - b), (1, b)):
                # 0 * NaN is NaN: an unknown neighbour without weight must not spread.
                weight = wi * wj
                total = total + np.where(weight > 0, weight * self.heights[i + di, j + dj], 0.0)
        return np.where(nowhere, np.nan, total)

    def filled(self) -> Self:
        """Return the map with every unknown cell at the nearest known height; `known` is kept."""
        if self.known.all():
            return self
        _, (ix, iy) = ndimage.distance_transform_edt(~self.known, return_indices=True)  # pyright: ignore
        return replace(self, heights=self.heights[ix, iy])

    def levelled(self, depth: NonNegative, reach: NonNegative) -> Self:
        """Return the map with deep holes raised to `depth` below the ground around them.

        A hole has higher ground on both sides: the ground around it is the grey closing of the map
        with a square of round(reach / resolution) cells to each side, which fills what is narrower
        than the square and leaves the foot of a wall or of a slope alone. At the border the edge
        cell continues.

        Raises:
            MapError: Some height is NaN (call `filled` first), a number is negative or not finite,
                or `reach` is too far.
        """
        check_arguments(ElevationMap.levelled, locals(), MapError)
        if np.isnan(self.heights).any():
            raise MapError("levelled needs a height in every cell: call filled() first")
        cells = round(min(reach / self.resolution, 1e9))
        check_cells([4 * cells] * 2)  # what is laid around the map
        # Closed on a padded map: scipy's own border would erode what it has just dilated.
        padded = np.pad(self.heights, 2 * cells, mode="edge")
        closed = ndimage.grey_closing(padded, size=(2 * cells + 1, 2 * cells + 1))
        highest = closed[tuple(slice(2 * cells, 2 * cells + n) for n in self.shape)]
        floor = highest - np.float32(min(depth, 2 * _HIGHEST))
        return replace(self, heights=np.maximum(self.heights, floor))

    def smoothed(self, width: NonNegative) -> Self:
        """Return the map seen through a triangular window that reaches `width` to each side, m.

        Sampled every `width` metres, the map as it is would hide where between two samples an edge
        lies; smoothed, its height there tells. A width of one cell or less changes nothing.

        Raises:
            MapError: Some height is NaN (call `filled` first), or the width is negative, not finite
                or more than ten thousand cells.
        """
        check_arguments(ElevationMap.smoothed, locals(), MapError)
        if width > _WIDEST_WINDOW * self.resolution:
            raise MapError(
                f"a window of {width:g} m is wider than {_WIDEST_WINDOW} cells of "
                f"{self.resolution:g} m: choose a smaller width"
            )
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
        return replace(self, heights=heights)

    def crop(self, x0: float, y0: float, x1: float, y1: float) -> Self:
        """Return the cells whose centres lie in the rectangle, which may reach beyond the map.

        Raises:
            MapError: Fewer than 2 x 2 cells are left, or a corner is NaN.
        """
        half = 0.5 * self.resolution
        first = [corner + half for corner in self.origin]
        # The first centre from x0 on is the last one, turned over, so a border holds on both sides.
        low = -cells_of((-x0, -y0), [-centre for centre in first], self.resolution)
        high = cells_of((x1, y1), first, self.resolution)
        low, high = np.maximum(low, 0), np.minimum(high, np.array(self.shape) - 1)
        if (high - low < 1).any():
            nx, ny = np.maximum(high - low + 1, 0)
            raise MapError(
                f"crop to {point_text((x0, y0, x1, y1), self.resolution)} m leaves {nx} x {ny} "
                f"cells of the map over {point_text(self.extent, self.resolution)} m; at least 2 x "
                "2 are needed"
            )
        window = slice(low[0], high[0] + 1), slice(low[1], high[1] + 1)
        x, y = self.centre_of(int(low[0]), int(low[1]))
        return replace(
            self,
            heights=self.heights[window],
            known=self.known[window],
            origin=(x - half, y - half),
        )

    def rotated90(self, k: int = 1) -> Self:
        """Return the map turned by k quarter turns counter-clockwise about the world's (0, 0).

        The height at a point p is afterwards the height at R p, R the rotation by 90 k degrees; so
        the new origin is the lower-left corner of the turned rectangle: for k = 1 the old corner
        (x0, y0 + width) goes to (-(y0 + width), x0). Headings shift by 2 k.

        Raises:
            MapError: `k` is no whole number.
        """
        check_arguments(ElevationMap.rotated90, locals(), MapError)
        x0, y0, x1, y1 = self.extent
        origin = ((x0, y0), (-y1, x0), (-x1, -y1), (y0, -x1))[k % 4]
        # np.rot90 turns the first axis towards the second: x towards y, counter-clockwise.
        heights, known = np.rot90(self.heights, k), np.rot90(self.known, k)
        return replace(self, heights=heights, known=known, origin=origin)

    def save(self, path: str | Path) -> None:
        """Write the map to .npz, .tif / .tiff (GeoTIFF) or .png (16 bit, with `path`.yaml).

        .npz keeps everything. The images keep what was observed: an unknown cell is written as
        unknown even if it was filled. A PNG rounds heights to 1/65534 of their range.

        Raises:
            MapError: The suffix is none of these.
            StorageError: The system refused to write; nothing partial is left.
        """
        maps.write(self, Path(path))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a map from .npz, .tif / .tiff or .png (which needs its sidecar `path`.yaml).

        A GeoTIFF is converted to metres by the units, scale and offset that it states.

        Raises:
            MapError: The file is missing, of another kind, corrupt, too large, says too little, or
                says something of its numbers that cannot be obeyed (degrees, several bands).
        """
        path = Path(path)
        fields = maps.read(path)
        try:
            return cls(**fields)
        except MapError as error:
            raise MapError(f"{path}: {error}") from error


def _as_truths(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return which cells are known, as a copy; masked ones are not."""
    known: Any = np.ma.asarray(detached(values))
    if known.dtype.kind != "b":
        raise MapError(f"known must hold True or False for each cell, got {known.dtype}")
    if known.shape != shape:
        raise MapError(f"known has shape {known.shape}, the heights have {shape}")
    return np.array(known.filled(False))


def _as_heights(values: Any) -> np.ndarray:
    """Return a float32 copy of the heights, or say what is wrong with them."""
    heights = numbers("heights", values, MapError, unknown=True)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise MapError(f"a map needs at least 2 x 2 cells [nx, ny], got shape {heights.shape}")
    low, high = np.fmin.reduce(heights, axis=None), np.fmax.reduce(heights, axis=None)
    if low < -_HIGHEST or high > _HIGHEST or (heights == _NO_HEIGHT).any():
        wrong = (np.abs(heights) > _HIGHEST) | (heights == _NO_HEIGHT)
        ix, iy = np.argwhere(wrong)[0]
        raise MapError(
            f"cell ({ix}, {iy}) has a height of {heights[ix, iy]:g} m ({wrong.sum()} such cells): "
            "if it stands for no data, declare it in the file or mark unknown cells with NaN; else "
            "check the unit"
        )
    return np.array(heights, dtype=np.float32)
