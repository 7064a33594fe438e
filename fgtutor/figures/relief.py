"""The colours of heights, and the bar that explains them.

Reads elevation maps; gives one colour per cell, shaded as if lit from the upper left, and a colour
bar in metres over the heights that the map has.
"""

from typing import cast

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import FuncNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from fgtutor.elevation import ElevationMap

GROUND = LinearSegmentedColormap.from_list(
    "ground", ["#16324A", "#5F87A6", "#F4F1EA", "#B08D5E", "#4F3517"]
)
"""Below the usual ground blue, above it brown; the usual ground is light, so routes stand out."""
DETAIL = 0.1
"""Heights within this many metres of the usual ground get the larger part of the colours."""
LEVEL = 0.02
"""Heights that differ by less than this are one level, m."""
MARKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Distances from the usual ground that a colour bar names where there is room, m."""
ROOM = 0.13
"""Distance between two ticks, as a share of the bar: closer ones would touch."""


def usual_height(elevation: ElevationMap) -> float:
    """Return the most common height of the observed cells, m: the median of the commonest level."""
    heights = elevation.heights[elevation.known].astype(np.float64)
    levels = np.rint(heights / LEVEL)
    values, counts = np.unique(levels, return_counts=True)
    return float(np.median(heights[levels == values[counts.argmax()]]))


def relief(
    elevation: ElevationMap, usual: float | None = None
) -> tuple[Float[np.ndarray, "nx ny 3"], FuncNorm]:
    """Return a map's cells in the colours of `GROUND`, shaded, and the scale of the colours.

    `usual` (m) is the height that is white; by default `usual_height`.
    """
    heights = elevation.filled().heights.astype(np.float64)
    middle = usual_height(elevation) if usual is None else usual
    reach = max(float(np.abs(heights - middle).max()), DETAIL)
    # A wall of 1 m must not wash out a ledge of 5 cm: colours follow an inverse sinh.
    norm = FuncNorm(
        (lambda z: np.arcsinh((z - middle) / DETAIL), lambda c: np.sinh(c) * DETAIL + middle),
        vmin=middle - reach,
        vmax=middle + reach,
    )
    # Light from the upper left: ground that rises to the right or falls towards the top is bright.
    rise_x, rise_y = np.gradient(heights, elevation.resolution)
    light = 1 + 0.25 * np.tanh((rise_x - rise_y) / 2)
    return np.clip(GROUND(norm(heights))[..., :3] * light[..., None], 0, 1), norm


def height_bar(axes: Axes, elevation: ElevationMap, norm: FuncNorm, label: str) -> None:
    """Add the bar of `relief`'s colours beside a map: from its lowest height to its highest."""
    known = elevation.heights[elevation.known].astype(np.float64)
    low, high = float(known.min()), float(known.max())
    middle = (cast(float, norm.vmin) + cast(float, norm.vmax)) / 2
    if high - low < LEVEL:  # a bar needs some length
        low, high = middle - DETAIL, middle + DETAIL
    figure = cast(Figure, axes.get_figure(root=True))
    bar = figure.colorbar(
        ScalarMappable(norm, GROUND),
        cax=axes.inset_axes((1.015, 0.0, 0.025, 1.0)),  # as high as the map
        ticks=_ticks(norm, low, middle, high),
        format=FuncFormatter(lambda z, _: f"{round(z, 2) + 0.0:.2f}"),  # + 0.0: never "-0.00"
    )
    bar.set_label(label, fontsize=9)
    bar.ax.set_ylim(low, high)
    bar.ax.tick_params(labelsize=8)
    bar.ax.minorticks_off()


def _ticks(norm: FuncNorm, low: float, middle: float, high: float) -> list[float]:
    """Return heights to name on a bar: both ends, the usual ground, then what has room between."""
    offered = [low, high, middle, *(middle + sign * mark for mark in MARKS for sign in (1, -1))]
    ends = np.asarray(norm([low, high]), dtype=float)
    kept: list[float] = []
    for height in (z for z in offered if low <= z <= high):
        at = np.asarray(norm([height, *kept]), dtype=float)
        if (np.abs(at[1:] - at[0]) >= ROOM * np.ptp(ends)).all():
            kept.append(height)
    return sorted(kept)
