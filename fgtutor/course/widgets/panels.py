"""What the canvas of a widget shows: pictures of one map side by side, a route on top, and texts.

Reads what an `Explorer` or a `Painting` computed; gives the plain values that `static/panels.js`
draws. Nothing here knows the notebook.

Arrays are [ix, iy], but a picture has its rows first and y = 0 at the bottom: `upright` turns them,
and points of the overlay count (right, down) in cells from the picture's upper left corner.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.colors import to_rgb

from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import BLOCKED, UNKNOWN, relief

Cell = tuple[int, int]
Point = tuple[float, float]
CIVIDIS = matplotlib.colormaps["cividis"]
"""Colours of F: they differ in brightness too, so the colour-blind read them alike."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture of the map."""

    key: str
    """Which of the scene's pictures it shows."""
    title: str
    """What it is."""
    caption: str = ""
    """What to see in it."""
    colour: str = ""
    """Colour of the title, "#RRGGBB", where the picture belongs to one policy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything a view draws."""

    rows: Sequence[Sequence[Panel]]
    """The panels, row by row; those of a row share its width."""
    pictures: Mapping[str, UInt8[np.ndarray, "ny nx 3"]]
    """One colour per cell, upright, by panel key."""
    lines: Sequence[tuple[str, Sequence[Point]]] = field(default_factory=tuple)
    """Polylines over every panel: a colour and points (right, down), in cells."""
    marks: Mapping[str, Point] = field(default_factory=dict)
    """Where "start" and "goal" lie."""
    box: tuple[float, float, float, float] | None = None
    """A rectangle (left, top, right, bottom) to outline, in cells."""
    legend: Mapping[str, str] = field(default_factory=dict)
    """Colours by name."""
    status: str = ""
    """One line of text that says what came out."""


def upright(values: np.ndarray) -> np.ndarray:
    """Turn an array [ix, iy, ...] into a picture: x to the right, y up."""
    return np.ascontiguousarray(np.swapaxes(values, 0, 1)[::-1])


def on_picture(cells: Float[np.ndarray, "n 2"], ny: int) -> list[Point]:
    """Return where the centres of cells (ix, iy) lie in a picture of `ny` rows, (right, down)."""
    return [(ix + 0.5, ny - iy - 0.5) for ix, iy in np.asarray(cells).tolist()]


def picture(
    colours: Float[np.ndarray, "nx ny 3"], known: Bool[np.ndarray, "nx ny"]
) -> UInt8[np.ndarray, "ny nx 3"]:
    """Turn one colour per cell into a picture; cells that were never observed are grey."""
    shown = np.where(known[..., None], colours, to_rgb(UNKNOWN))
    return upright((shown * 255).round().astype(np.uint8))


def feasibility_picture(
    best: Float[np.ndarray, "nx ny"], known: Bool[np.ndarray, "nx ny"], f_min: float
) -> UInt8[np.ndarray, "ny nx 3"]:
    """Colour F, one number per cell; dark where it is below `f_min`."""
    colours = CIVIDIS(best)[..., :3]
    colours[best < f_min] = to_rgb(BLOCKED)
    return picture(colours, known)


def ground_picture(elevation: ElevationMap) -> UInt8[np.ndarray, "ny nx 3"]:
    """Colour the heights of a map as `figures.maps.draw_elevation` does."""
    return picture(relief(elevation)[0], elevation.known)


def check_cell(elevation: ElevationMap, cell: Cell) -> None:
    """Raise `ConfigError` for a cell off the map."""
    nx, ny = elevation.shape
    if not (0 <= cell[0] < nx and 0 <= cell[1] < ny):
        raise ConfigError(f"there is no cell {cell} on a map of {nx} x {ny} cells")


def cell_table(
    elevation: ElevationMap,
    cell: Cell,
    headings: Headings,
    rows: Mapping[str, Sequence[float] | Sequence[str]],
) -> str:
    """Say where a cell is and how high, then a value per heading for each label of `rows`.

    Eight headings stand side by side, further ones below.
    """
    x, y = elevation.centre_of(*cell)
    height = f"height {elevation.heights[cell]:.2f} m"
    known = height if elevation.known[cell] else "never observed: closed"
    lines = [f"cell ({cell[0]}, {cell[1]})   x {x:.2f} m, y {y:.2f} m, {known}"]
    table = {"heading": headings.names, **rows}
    for first in range(0, headings.count, 8):
        for label, values in table.items():
            some = values[first : first + 8]
            texts = [value[:7] if isinstance(value, str) else f"{value:.2f}" for value in some]
            lines.append(f"{label:<11.11}" + "".join(f"{text:>8}" for text in texts))
    return "\n".join(lines)
