"""How long planning takes: networkx against scipy, free switching against paid, replanning.

Reads nothing; prints one row a map. Use: python benchmarks/bench_plan.py
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from fgtutor.elevation import ElevationMap
from fgtutor.fusion import fuse
from fgtutor.planning import Backend, Planner, plan

POLICIES = 4


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Return the shortest of several runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def row(cells: int) -> str:
    """Time every way of planning from corner to corner of one square map."""
    rng = np.random.default_rng(0)
    tensors = [rng.uniform(0.05, 1, (cells, cells, 8)).astype("float32") for _ in range(POLICIES)]
    fused, policy_map = fuse(tensors)
    grid = ElevationMap(np.zeros((cells, cells)))
    start, goal = grid.centre_of(0, 0), grid.centre_of(cells - 1, cells - 1)
    tree = Planner(fused=fused, policy_map=policy_map, grid=grid).towards(goal)

    def route(backend: Backend, **settings: Any) -> Callable[[], object]:
        settings |= {"grid": grid, "start": start, "goal": goal, "tensors": tensors}
        return lambda: plan(fused, policy_map, backend=backend, **settings)

    times = [
        seconds(route("networkx"), 1),
        seconds(route("scipy"), 3),
        seconds(route("scipy", switch_cost=1.0), 1),
        seconds(lambda: fuse(tensors), 3),
        seconds(lambda: tree.route(start), 3),
    ]
    return f"{cells:3} x {cells:<3}" + "".join(f"{time:13.4f}" for time in times)


def main() -> None:
    print(f"{POLICIES} policies; seconds for one route from corner to corner")
    print("cells         networkx        scipy  switch_cost         fuse       replan")
    for cells in (8, 16, 32, 64, 128, 256):
        print(row(cells), flush=True)


if __name__ == "__main__":
    main()
