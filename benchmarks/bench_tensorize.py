"""How long assessing a map takes: reference against fast, four Feasibility-Nets of standard size.

Reads nothing; prints one row a map. Use: python benchmarks/bench_tensorize.py [threads]
"""

import resource
import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import FeasibilityNet
from fgtutor.patches import PatchGrid
from fgtutor.tensorization import Method, assess

NETS = 4


def specialists() -> list[Any]:
    """Return what `assess` reads of a specialist; the policies would not be asked."""
    grid = PatchGrid()
    return [
        SimpleNamespace(
            feasibility=FeasibilityNet(grid.num_points), grid=grid, command=(0.6, 0.0, 0.0)
        )
        for _ in range(NETS)
    ]


def seconds(elevation: ElevationMap, team: list[Any], method: Method) -> float:
    start = time.perf_counter()
    for specialist in team:
        assess(elevation, specialist, method)
    return time.perf_counter() - start


def main() -> None:
    torch.set_num_threads(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    team = specialists()
    print(f"{NETS} nets, {torch.get_num_threads()} thread(s); seconds for all nets and headings")
    print("cells       resolution   reference      fast   speed-up   peak memory")
    for cells, resolution in ((128, 0.1), (128, 0.05), (256, 0.1), (256, 0.05)):
        elevation = ElevationMap(rng.random((cells, cells)), resolution=resolution)
        fast = min(seconds(elevation, team, "fast") for _ in range(2))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        reference = seconds(elevation, team, "reference")
        print(
            f"{cells} x {cells}   {resolution:6.2f} m   {reference:9.2f} {fast:9.2f} "
            f"{reference / fast:8.1f} x {peak:10.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
