"""How long planning takes: networkx against scipy, and free switching against paid.

Prints one row per map, in seconds of CPU and as ratios of the same run. "zoo" tensors are those of
the toy's four specialists on the demo's map, mirrored at its border until it is large enough;
"rough" ones are random in every cell, and "smooth" ones vary over eight cells. Use:

    python benchmarks/bench_plan.py
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

from fgtutor.cli.demo import MAP
from fgtutor.elevation import ElevationMap
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.specialist import load_zoo
from fgtutor.tensorization import assess_all

POLICIES = 4


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def tensors_of(cells: int, kind: str) -> list[np.ndarray]:
    """Return F of four policies on a square map."""
    if kind == "zoo":
        small = ElevationMap.load(MAP).filled()
        more = [(0, max(0, cells - n)) for n in small.shape]
        heights = np.pad(small.heights, more, mode="reflect")[:cells, :cells]
        assessments = assess_all(ElevationMap(heights, small.resolution), load_zoo("toy"))
        return [one.weighted().numpy() for one in assessments.values()]
    tensors = np.random.default_rng(0).uniform(size=(POLICIES, cells, cells, 8))
    if kind == "smooth":
        tensors = ndimage.gaussian_filter(tensors, (0, 8, 8, 0))
        tensors = (tensors - tensors.min()) / np.ptp(tensors)
    return list((0.05 + 0.95 * tensors).astype("float32"))


def row(cells: int, kind: str) -> str:
    """Time every way of planning across one square map, from corner to corner if that goes."""
    tensors = tensors_of(cells, kind)
    fused, policy_map = fuse(tensors)
    grid = ElevationMap(np.zeros((cells, cells)))
    start, goal = grid.centre_of(1, 1), grid.centre_of(cells - 2, cells - 2)

    def route(**changes: Any) -> Callable[[], object]:
        common = {"grid": grid, "start": start, "goal": goal, "tensors": tensors}
        return lambda: plan(fused, policy_map, **common, **changes).raise_for()

    networkx = seconds(route(backend="networkx", switch_cost=0.0), 1)
    free = seconds(route(switch_cost=0.0), 5)
    paid = seconds(route(switch_cost=1.0), 5)
    times = f"{networkx:10.3f}{free:10.3f}{paid:10.3f}"
    return f"{cells:3} x {cells:<3} {kind:6}{times}{networkx / free:16.1f}{paid / free:13.1f}"


def main() -> None:
    print(f"{POLICIES} policies, 8 headings; CPU seconds for one route from corner to corner")
    print("cells            networkx     scipy scipy paid   networkx/scipy    paid/free")
    for cells in (64, 256):
        for kind in ("zoo", "smooth", "rough"):
            print(row(cells, kind), flush=True)


if __name__ == "__main__":
    main()
