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
from fgtutor.figures.maps import BLOCKED
from fgtutor.figures.panels import UNKNOWN
from fgtutor.figures.relief import relief

Cell = tuple[int, int]
Point = tuple[float, float]
Box = tuple[float, float, float, float]
"""A rectangle (left, top, right, bottom), in cells."""
VIRIDIS = matplotlib.colormaps["viridis"]
"""Colours of F, as in every figure; they differ in brightness too, for the colour-blind."""


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


@dataclass(frozen=True, kw_only=True)
class Chart:
    """How the losses of one policy are spread on the map, and the weight that each loss gets."""

    title: str
    """What it is."""
    colour: str
    """Colour of the policy, "#RRGGBB"."""
    span: tuple[float, float]
    """The axis: log10 of the lowest and of the highest L_recon."""
    shares: Sequence[float]
    """Share of the map's patches in each bin, the bins evenly spread over the span."""
    weights: Sequence[float]
    """w_ood at losses evenly spread over the span, both ends included."""
    home: Sequence[float] = ()
    """log10 of the losses below which lie half, 9 of 10 and 99 of 100 patches of its own ground."""


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
    box: Box | None = None
    """A rectangle to outline."""
    hatched: Sequence[Box] = ()
    """Rectangles of cells that were never observed."""
    extent: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    """Corners (x0, y0, x1, y1) of the map, m."""
    charts: Sequence[Chart] = ()
    """Below the panels, one for each policy."""
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
    return picture(feasibility_colours(best, f_min), known)


def feasibility_colours(
    best: Float[np.ndarray, "nx ny"], f_min: float
) -> Float[np.ndarray, "nx ny 3"]:
    """Return the colour of each cell's F; dark where it is below `f_min`."""
    colours = VIRIDIS(best)[..., :3]
    colours[best < f_min] = to_rgb(BLOCKED)
    return colours


def ground_picture(elevation: ElevationMap) -> UInt8[np.ndarray, "ny nx 3"]:
    """Colour the heights of a map as `figures.maps.draw_elevation` does."""
    return picture(relief(elevation)[0], elevation.known)


def unknown_boxes(elevation: ElevationMap) -> list[Box]:
    """Return the cells that were never observed, as runs along the rows of the picture."""
    boxes = []
    for row, unknown in enumerate(upright(~elevation.known)):
        edges = np.flatnonzero(np.diff(unknown.astype(int), prepend=0, append=0))
        boxes += [(float(a), float(row), float(b), row + 1.0) for a, b in edges.reshape(-1, 2)]
    return boxes


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
