"""Pictures of point clouds, and by how much a map that was scanned is wrong."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import draw_elevation
from fgtutor.figures.style import LINES, TITLE, Picture

DOTS = 4_000
"""Points of a cloud that are drawn at most: more would only cover each other."""


def draw_cloud(
    points: Float[np.ndarray, "n 3"], *, sensors: ArrayLike | None = None, title: str = ""
) -> Picture:
    """Draw a point cloud from above and from the side, coloured by height; crosses are sensors."""
    shown = np.asarray(points)[:: max(1, -(-len(points) // DOTS))]
    x, y, z = shown.T
    figure = Picture(7.2, 4.8)
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
    low, high = np.quantile(z, (0.001, 0.999)).tolist()
    style = {"s": 4.0, "cmap": "cividis", "vmin": low, "vmax": high, "linewidths": 0}
    dots = above.scatter(x, y, c=z, **style)
    side.scatter(x, z, c=z, **style)
    if sensors is not None:
        at = np.atleast_2d(np.asarray(sensors, dtype=float))
        above.plot(at[:, 0], at[:, 1], "x", color=LINES[1], label="sensor")
        side.plot(at[:, 0], at[:, 2], "x", color=LINES[1])
        figure.legend(loc="outside lower center", frameon=False, fontsize=9)
    for axes in (above, side):
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
    above.set(ylabel="y (m)")
    some = "" if len(shown) == len(points) else f", of which {len(shown):,} are drawn"
    side.set(xlabel=f"x (m)\n{len(points):,} points{some}; from above and from the side")
    side.set(ylabel="z (m)")
    figure.colorbar(dots, ax=[above, side], shrink=0.8, pad=0.01, label="height (m)")
    above.set_title(title, **TITLE, loc="left")
    return figure


def difference(scanned: ElevationMap, truth: ElevationMap) -> ElevationMap:
    """Return by how much a scanned map is too high, m; unknown where the scan is.

    Raises `ConfigError` if the maps do not cover each other.
    """
    if scanned.shape != truth.shape or scanned.origin != truth.origin:
        raise ConfigError(f"need maps of one area, got {scanned} and {truth}")
    heights = np.where(scanned.known, scanned.heights - truth.heights, np.nan)
    return ElevationMap(heights, scanned.resolution, scanned.origin)


def draw_error(scanned: ElevationMap, truth: ElevationMap) -> Picture:
    """Draw by how much a scanned map is wrong; raises as `difference` does."""
    return draw_elevation(
        difference(scanned, truth),
        title="The scan minus the truth",
        caption="White: no error. Blue: the scan is too low, brown: too high",
        label="error (m)",
        usual=0.0,
    )  # pyright: ignore[reportReturnType]
