"""The ground under an A1: how it enters MuJoCo, and where it has edges that feet must clear.

Reads boxes or an elevation map; adds shapes to an `MjSpec`, and tabulates edges and holes.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import itertools

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.ndimage import grey_closing

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.world.boxes import Box


def blocky(elevation: ElevationMap) -> bool:
    """Tell whether most neighbouring cells have equal heights, so that few boxes suffice."""
    heights = np.asarray(elevation.filled().heights)
    return all(float((np.diff(heights, axis=k) == 0).mean()) > 0.9 for k in (0, 1))


def add_box(spec: mujoco.MjSpec, box: Box) -> None:
    """Add one box of terrain; `box.size` holds full lengths, MuJoCo wants half."""
    half = tuple(length / 2 for length in box.size)
    add_ground(spec, type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.centre, quat=box.quaternion, size=half)


def add_heightfield(spec: mujoco.MjSpec, elevation: ElevationMap, *, base: float = 0.1) -> None:
    """Add an elevation map as a height field whose vertices are the centres of the cells.

    It covers the map but for half a cell along the border; `base` is its thickness below the lowest
    cell, m. Raises `ConfigError` if the map has unknown cells.
    """
    heights = np.asarray(elevation.heights, dtype=float)
    if not np.isfinite(heights).all():
        raise ConfigError("a height field needs every height; call elevation.filled() first")
    low = float(heights.min())
    # MuJoCo refuses a height field without relief, so a flat map gets a token one it never reaches.
    relief = max(float(heights.max()) - low, 1e-6)
    nx, ny = heights.shape
    # Rows of a MuJoCo height field run along y and columns along x: [ix, iy] is transposed.
    half = elevation.resolution / 2
    spec.add_hfield(
        name="terrain",
        nrow=ny,
        ncol=nx,
        size=((nx - 1) * half, (ny - 1) * half, relief, base),
        userdata=((heights - low) / relief).T.ravel(),
    )
    x, y = elevation.origin[0] + nx * half, elevation.origin[1] + ny * half
    add_ground(spec, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="terrain", pos=(x, y, low))


def add_ground(spec: mujoco.MjSpec, **properties: object) -> None:
    """Add a piece of ground in any shape."""
    # Terrain only receives contacts and the robot only makes them, so neither meets itself.
    spec.worldbody.add_geom(contype=0, conaffinity=1, rgba=(0.62, 0.6, 0.57, 1.0), **properties)


def edges(ground: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "nx ny"]:
    """Return the height of each cell or of an edge beside it; a steady slope has no edge.

    The rise to a neighbour counts as far as it exceeds the rise up to here from the other side.
    """
    nx, ny = ground.shape
    padded = np.pad(ground, 1, mode="edge")
    edge = np.zeros_like(ground)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        ahead = padded[1 + i : 1 + i + nx, 1 + j : 1 + j + ny] - ground
        behind = ground - padded[1 - i : 1 - i + nx, 1 - j : 1 - j + ny]
        edge = np.maximum(edge, ahead - behind.clip(min=0.0))
    return ground + edge


def rims(ground: Float[np.ndarray, "nx ny"], reach: int) -> Float[np.ndarray, "nx ny"]:
    """Return the ground with holes closed that are at most 2 `reach` + 1 cells wide.

    A closing, unlike a maximum, does not take the foot of a wall for the floor of a hole. A square
    window alone would reach further along diagonals than `reach`, and close valleys that lie askew
    deeper than others; a round one alone would close the corners of chasms. The lower of both does
    neither.
    """
    offset = np.arange(-reach, reach + 1)
    square = np.ones((len(offset), len(offset)), dtype=bool)
    disc = np.hypot(*np.meshgrid(offset, offset)) <= reach
    around = len(offset)
    padded = np.pad(ground, around, mode="edge")
    closed = [grey_closing(padded, footprint=window) for window in (square, disc)]
    return np.minimum(*closed)[around:-around, around:-around]
