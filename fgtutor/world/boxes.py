"""Boxes, the one shape that terrains are made of, and the way to and from an elevation map.

Reads boxes and gives the map they rasterise to, exact for tilted boxes; or reads a piecewise-flat
map and gives the boxes that make it up, for physics.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from fgtutor.elevation import ElevationMap
from fgtutor.errors import TerrainError
from fgtutor.grid import check_cells


@dataclass(frozen=True, kw_only=True)
class Box:
    """A solid box, anywhere in space."""

    centre: tuple[float, float, float]
    """Centre (x, y, z), m."""
    size: tuple[float, float, float]
    """Full side lengths along the box's own x, y and z, m."""
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw, radians: turned about x, then y, then z of the world (REP-103)."""

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The matrix Rz(yaw) Ry(pitch) Rx(roll); its columns are the box's axes in the world."""
        return Rotation.from_euler("xyz", self.rpy).as_matrix()

    @property
    def quaternion(self) -> list[float]:
        """The same rotation as [w, x, y, z], the order MuJoCo uses."""
        return Rotation.from_euler("xyz", self.rpy).as_quat(scalar_first=True).tolist()

    def shifted(self, dx: float, dy: float) -> "Box":
        """Return the box moved in the plane."""
        x, y, z = self.centre
        return Box(centre=(x + dx, y + dy, z), size=self.size, rpy=self.rpy)


def rasterise(boxes: Sequence[Box], size: tuple[float, float], resolution: float) -> ElevationMap:
    """Return the height of the highest box over each cell's centre, exact for tilted boxes too.

    The vertical line through a centre meets a box where it is inside all three pairs of faces (the
    slab test for rays); the upper end of that interval is the height. Cells without a box are NaN.
    Raises `TerrainError` if the map would have too many cells.
    """
    nx, ny = (round(length / resolution) for length in size)
    check_cells((nx, ny), TerrainError)
    heights = np.full((nx, ny), -np.inf)
    for box in boxes:
        # Only the cells under the box's bounding rectangle, one more to each side.
        reach = np.abs(box.rotation) @ (0.5 * np.array(box.size))
        low = np.floor((box.centre - reach)[:2] / resolution).astype(int) - 1
        high = np.ceil((box.centre + reach)[:2] / resolution).astype(int) + 1
        (i0, j0), (i1, j1) = np.clip([low, high], 0, (nx, ny)).tolist()
        x, y = np.arange(i0, i1) + 0.5, np.arange(j0, j1) + 0.5
        top = _top(box, x[:, None] * resolution, y[None, :] * resolution)
        heights[i0:i1, j0:j1] = np.maximum(heights[i0:i1, j0:j1], top)
    return ElevationMap(np.where(np.isneginf(heights), np.nan, heights), resolution=resolution)


def _top(box: Box, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height at which the box ends above each (x, y); -inf beside the box."""
    dx, dy = x - box.centre[0], y - box.centre[1]
    low, high = -np.inf, np.inf
    for axis, half in zip(box.rotation.T, 0.5 * np.array(box.size), strict=True):
        across = axis[0] * dx + axis[1] * dy
        if abs(axis[2]) < 1e-12:  # the face is upright: the line runs along it, inside or outside
            low = np.maximum(low, np.where(np.abs(across) > half + 1e-9, np.inf, -np.inf))
        else:
            ends = (-half - across) / axis[2], (half - across) / axis[2]
            low, high = np.maximum(low, np.minimum(*ends)), np.minimum(high, np.maximum(*ends))
    return np.where(low <= high, box.centre[2] + high, -np.inf)


def boxes_from_elevation(
    elevation: ElevationMap, wanted: Bool[np.ndarray, "nx ny"] | None = None
) -> tuple[Box, ...]:
    """Return upright boxes for a map, one for each rectangle of cells of equal height.

    Made for piecewise-flat maps: on a slope every cell becomes a box. Unknown cells are filled.
    Rectangles are found greedily: along y while heights agree, then along x. With `wanted`, only
    these cells are covered.
    """
    ground = elevation.filled()
    heights, step = ground.heights, ground.resolution
    todo = np.ones(ground.shape, dtype=bool) if wanted is None else wanted.copy()
    bottom = float(heights.min()) - 0.5
    boxes = []
    while todo.any():
        i0, j0 = np.unravel_index(int(todo.argmax()), todo.shape)
        same = todo & (heights == heights[i0, j0])
        j1 = j0 + _run(same[i0, j0:])
        i1 = i0 + _run(same[i0:, j0:j1].all(axis=1))
        todo[i0:i1, j0:j1] = False
        top = float(heights[i0, j0])
        x, y = ground.origin[0] + (i0 + i1) / 2 * step, ground.origin[1] + (j0 + j1) / 2 * step
        boxes.append(
            Box(
                centre=(float(x), float(y), (top + bottom) / 2),
                size=(float(i1 - i0) * step, float(j1 - j0) * step, top - bottom),
            )
        )
    return tuple(boxes)


def _run(flags: np.ndarray) -> int:
    """Return how many leading flags are set."""
    return len(flags) if flags.all() else int(flags.argmin())
