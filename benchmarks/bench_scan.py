"""How long a scan and its map take: ray casting, and mapping clouds of up to ten million points.

Reads nothing; prints one row a terrain and one a cloud. Use: python benchmarks/bench_scan.py
"""

import time

import numpy as np

from fgtutor.robots.lidar import LidarConfig, scan_terrain, survey
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


def main() -> None:
    print("terrain     boxes  poses     points  wall s   cpu s")
    for name in ("steps", "rubble"):
        terrain = make_terrain(name, robot="a1", seed=1)
        wall, cpu = time.perf_counter(), time.process_time()
        cloud = scan_terrain(terrain)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(
            f"{name:10}{len(terrain.boxes):7}{len(survey(terrain)):7}{len(cloud):11}"
            f"{wall:8.1f}{cpu:8.1f}",
            flush=True,
        )
    print(f"({LidarConfig().rays} rays a pose)\n\npoints      cells  outliers  wall s   cpu s")
    for points in (100_000, 1_000_000, 10_000_000):
        cloud = synthetic(points)
        wall, cpu = time.perf_counter(), time.process_time()
        scanned = map_points(cloud)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(
            f"{points:9}{scanned.count.size:8}{scanned.outliers:10}{wall:8.1f}{cpu:8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
