"""Pictures of point clouds, and by how much a map that was scanned is wrong."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import GROUND
from fgtutor.figures.style import TITLE, Picture

DOTS = 3_000
"""Points of a cloud that are drawn at most: more would only cover each other."""


def draw_cloud(
    points: Float[np.ndarray, "n 3"], *, sensors: ArrayLike | None = None, title: str = ""
) -> Picture:
    """Draw a point cloud from above and from the side, coloured by height; crosses are sensors."""
    shown = np.asarray(points)[:: max(1, -(-len(points) // DOTS))]
    x, y, z = shown.T
    figure = Picture(7.2, 4.8)
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
    reach = max(0.1, float(np.quantile(np.abs(z), 0.999)))
    style = {"s": 2.0, "cmap": GROUND, "vmin": -reach, "vmax": reach, "linewidths": 0}
    dots = above.scatter(x, y, c=z, **style)
    side.scatter(x, z, c=z, **style)
    if sensors is not None:
        at = np.atleast_2d(np.asarray(sensors, dtype=float))
        above.plot(at[:, 0], at[:, 1], "x", color="#D55E00")
        side.plot(at[:, 0], at[:, 2], "x", color="#D55E00")
    for axes in (above, side):
        axes.set_facecolor("#C9CED3")  # level ground is nearly white
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8)
    above.set(ylabel="y (m)")
    side.set(xlabel=f"x (m)\n{len(points):,} points, from above and from the side", ylabel="z (m)")
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
