"""A scene on a page: what the canvas of a widget shows, for readers without a kernel.

Reads a `Scene`; gives one figure with its panels, its charts and its status line.
"""

from math import sqrt
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import Patch, Rectangle

from fgtutor.course.widgets.panels import Chart, Panel, Scene
from fgtutor.figures.maps import BLOCKED
from fgtutor.figures.style import INK, TITLE, Picture

WIDTH = 9.0
"""Width of the figure, inches."""
SMALL: dict[str, Any] = TITLE | {"fontsize": 9}
"""How panels are titled."""
MARKS = {"start": ("o", 6), "goal": ("*", 12)}


def scene_figure(scene: Scene) -> Picture:
    """Draw a scene as the canvas does, in metres."""
    x0, y0, x1, y1 = scene.extent
    aspect = (y1 - y0) / (x1 - x0)
    heights = [WIDTH / len(row) * aspect * 0.9 + 0.6 for row in scene.rows]
    heights += [1.6] * bool(scene.charts)
    figure = Picture(WIDTH, sum(heights) + 0.7)
    bands = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    for band, row in zip(bands, scene.rows, strict=False):
        for axes, panel in zip(band.subplots(1, len(row), squeeze=False)[0], row, strict=True):
            _panel(axes, scene, panel)
    if scene.charts:
        panels = bands[-1].subplots(1, len(scene.charts), squeeze=False, sharey=True)[0]
        for axes, chart in zip(panels, scene.charts, strict=True):
            draw_chart(axes, chart)
    handles = [Patch(color=colour, label=name) for name, colour in scene.legend.items()]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles),
                      frameon=False, fontsize=8)  # fmt: skip
    figure.suptitle(scene.status, fontsize=9, x=0.01, ha="left", wrap=True)
    figure.alt = ". ".join(
        [scene.status, *(f"{panel.title}: {panel.caption}" for row in scene.rows for panel in row)]
    )
    return figure


def _panel(axes: Axes, scene: Scene, panel: Panel) -> None:
    """Draw one picture of the map with everything that lies on it."""
    pixels = scene.pictures[panel.key]
    x0, y0, x1, y1 = scene.extent
    across, up = (x1 - x0) / pixels.shape[1], (y1 - y0) / pixels.shape[0]
    axes.imshow(pixels, extent=(x0, x1, y0, y1), interpolation="nearest")

    def place(u: float, v: float) -> tuple[float, float]:
        return x0 + u * across, y1 - v * up

    for left, top, right, bottom in scene.hatched:
        axes.add_patch(Rectangle(place(left, bottom), (right - left) * across, (bottom - top) * up,
                                 hatch="////", facecolor="none", edgecolor="#777777",
                                 linewidth=0))  # fmt: skip
    for width, casing in ((4.5, "white"), (2.4, "")):
        for colour, points in scene.lines:
            line = [place(*point) for point in points]
            axes.plot(*zip(*line, strict=True), color=casing or colour, linewidth=width)
    if scene.box:
        left, top, right, bottom = scene.box
        axes.add_patch(Rectangle(place(left, bottom), (right - left) * across, (bottom - top) * up,
                                 fill=False, edgecolor=BLOCKED, linewidth=1.5))  # fmt: skip
    for role, (marker, size) in MARKS.items():
        if role in scene.marks:
            axes.plot(*place(*scene.marks[role]), marker, color="white", markersize=size,
                      markeredgecolor="black")  # fmt: skip
    axes.set(xlim=(x0, x1), ylim=(y0, y1))
    axes.tick_params(labelsize=7)
    axes.set_title(panel.title, **SMALL, loc="left")
    axes.set_xlabel(f"x (m)\n{panel.caption}", fontsize=7.5)
    axes.set_ylabel("y (m)", fontsize=7.5)


def draw_chart(axes: Axes, chart: Chart) -> None:
    """Draw how the losses are spread, the weight that they get, and those of the own ground.

    Bars are roots of shares: much of a map is flat, and would dwarf the rest.
    """
    (low, high), count = chart.span, len(chart.shares)
    step, tallest = (high - low) / count, max(chart.shares)
    left = [10 ** (low + i * step) for i in range(count + 1)]
    heights = [sqrt(share / tallest) for share in chart.shares]
    axes.stairs(heights, left, fill=True, color=chart.colour, alpha=0.45)
    axes.plot(left, chart.weights, color=INK, linewidth=1.5)
    if chart.home:
        home = [10**value for value in chart.home]
        axes.plot([left[0], home[-1]], [-0.1, -0.1], color=chart.colour, linewidth=3)
        axes.plot(home, [-0.1] * len(home), "|", color=INK, markersize=8)
    axes.set(xscale="log", xlim=(left[0], left[-1]), ylim=(-0.2, 1.08))
    axes.tick_params(labelsize=7)
    axes.set_title(chart.title, **SMALL, loc="left")
    axes.set_xlabel("L_recon\nbars: map (root); line: w_ood", fontsize=7.5)
