"""What the pictures of maps share: panels in metres, their words, legends, hatching and routes.

Reads maps, routes and colours; draws on matplotlib axes.

Arrays are [ix, iy], but an image has y first: `show_cells` transposes.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.style import TITLE, Picture
from fgtutor.routes import Route

BLOCKED, UNKNOWN = "#33363B", "#C4C4C4"
"""Cells that no policy may leave, and cells that were never observed."""


def page_size(grid: ElevationMap, width: float) -> tuple[float, float]:
    """Return the size of a picture of this map in inches, words included."""
    return width, float(np.clip((width - 1.2) * grid.size[1] / grid.size[0], 1.2, 9.0)) + 1.3


def stage(grid: ElevationMap, axes: Axes | None) -> Axes:
    """Return axes in metres with the map's frame, on a new picture if there are none."""
    axes = axes or Picture(*page_size(grid, 7.2)).subplots()
    x0, y0, x1, y1 = grid.extent
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.tick_params(labelsize=8)
    return axes


def root(axes: Axes) -> Figure:
    """Return the whole figure that axes lie on; raises `ConfigError` if they lie on none."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ConfigError("these axes were removed from their figure: draw on others")
    return figure


def say(axes: Axes, title: str, caption: str, grid: ElevationMap | None = None) -> None:
    """Write what is drawn above the picture, and what to see in it below.

    With `grid`, the caption names the hatching where the map has unknown cells.
    """
    if grid is not None and not grid.known.all():
        caption = f"{caption}. Hatched: never observed"
    axes.set_title(title, **TITLE, loc="left")
    axes.set_xlabel(f"x (m)\n{caption}", fontsize=9)
    axes.set_ylabel("y (m)", fontsize=9)


def legend(axes: Axes, colours: Mapping[str, str], more: Sequence[Line2D] = ()) -> None:
    """Name colours below the picture."""
    handles = [Patch(color=colour, label=name) for name, colour in colours.items()]
    panel = axes.get_figure(root=False)
    if panel is not None and (handles or more):
        columns = min(len(handles) + len(more), 7)
        style = {"fontsize": 9, "columnspacing": 1.2, "handlelength": 1.2, "frameon": False}
        panel.legend(handles=[*handles, *more], loc="outside lower center", ncols=columns, **style)


def show_cells(axes: Axes, grid: ElevationMap, colours: Float[np.ndarray, "nx ny 3"]) -> None:
    """Show one colour per cell."""
    x0, y0, x1, y1 = grid.extent
    # An image is [row = y, column = x]: transpose; its first row lies at the bottom: origin lower.
    axes.imshow(
        colours.transpose(1, 0, 2), origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest"
    )


def paint_route(axes: Axes, route: Route, colours: Iterable[str]) -> list[Line2D]:
    """Draw a route, one colour per edge; return its start and goal for a legend."""
    edges = list(np.stack((route.xy[:-1], route.xy[1:]), axis=1))
    for line in ({"colors": "white", "linewidths": 6}, {"colors": colours, "linewidths": 3.2}):
        axes.add_collection(LineCollection(edges, capstyle="round", **line))
    ends: list[Line2D] = []
    style: dict[str, Any] = {"linestyle": "none", "color": "white", "markeredgecolor": "black"}
    for at, role, marker, size in ((0, "start", "o", 9), (-1, "goal", "*", 15)):
        x, y = route.xy[at]
        ends += axes.plot([x], [y], label=role, marker=marker, markersize=size, zorder=5, **style)
    return ends


def hatch_unknown(axes: Axes, grid: ElevationMap) -> None:
    """Cover the cells that were never observed with grey hatching."""
    if grid.known.all():
        return
    half = grid.resolution / 2
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    centres = np.stack(grid.centre_of(*np.nonzero(~grid.known)), axis=-1)  # pyright: ignore
    squares = PolyCollection(
        list(centres[:, None] + corners), facecolors=UNKNOWN, edgecolors="#777777", linewidths=0
    )
    squares.set_hatch("////")
    axes.add_collection(squares)
