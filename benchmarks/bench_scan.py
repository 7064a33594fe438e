"""A scan and its map: casting the rays, and mapping clouds, against sorting the same points.

Mapping must at least bring the points of a cell together: a bare sort by cell is what it cannot do
without.
"""

from collections.abc import Iterator

import numpy as np
from harness import Row, Size, in_turns, ratios, row

from fgtutor.robots.lidar import scan_terrain
from fgtutor.world.scanning import map_points
from fgtutor.world.terrain import make_terrain

AREA = (40.0, 25.0)
"""Size of the synthetic clouds, m."""


def synthetic(points: int) -> np.ndarray:
    """Return hills with 2 cm of noise, and one point in a thousand anywhere up to 5 m above."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform((0.0, 0.0), AREA, (points, 2)).T
    z = 0.5 * np.sin(x) * np.cos(0.7 * y) + rng.normal(0.0, 0.02, points)
    stray = slice(0, points // 1000)
    z[stray] += rng.uniform(0.3, 5.0, len(z[stray]))
    return np.stack((x, y, z), axis=-1)


def sort_by_cell(cloud: np.ndarray) -> None:
    """Sort points by the cell of 0.1 m that they lie in, and do nothing else."""
    cells = np.floor(cloud[:, :2] / 0.1).astype(np.int64)
    cloud[np.lexsort((cells[:, 1], cells[:, 0]))]


def rows(size: Size) -> Iterator[Row]:
    """Scan a terrain and map it; map synthetic clouds."""
    clouds, rounds = {
        "full": ((100_000, 1_000_000, 10_000_000), 3), "quick": ((100_000, 1_000_000), 2),
        "tiny": ((20_000,), 1),
    }[size]  # fmt: skip
    if size != "tiny":
        terrain = make_terrain("steps", robot="a1", seed=1)
        cloud = scan_terrain(terrain)
        ways = {"scan": lambda: scan_terrain(terrain), "map": lambda: map_points(cloud)}
        times = in_turns(ways, 1 if size == "quick" else rounds)
        place = f"casting the rays / mapping them, steps, {len(cloud):,} points"
        yield row("scan", place, ratios(times, "scan", "map"))
    for points in clouds:
        cloud = synthetic(points)
        ways = {
            "map": lambda cloud=cloud: map_points(cloud),
            "sort": lambda cloud=cloud: sort_by_cell(cloud),
        }
        times = in_turns(ways, rounds)
        what = f"mapping / sorting by cell, {points:,} points of {AREA[0]:g} x {AREA[1]:g} m"
        yield row("scan", what, ratios(times, "map", "sort"))
