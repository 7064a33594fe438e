"""How long a drag of the tau sliders takes to compute, at 128 x 128 x 8 with four policies.

Reads the shipped demo map and toy zoo (mirrored to 128 x 128 cells); prints one row a kind of drag.
A row holds everything between the slider's message and the picture's: weights, fusion, planning and
colours. CPU is what the machine spends, wall is what a person waits; they part where other work
competes for the cores. Use: python benchmarks/bench_widgets.py [drags]
"""

import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from fgtutor.cli.demo import GOAL, MAP, START
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.elevation import ElevationMap
from fgtutor.specialist import load_zoo
from fgtutor.tensorization import Assessment

CELLS = 128
BUDGET = 50.0
"""What a drag may take, ms."""
POLICIES = 4


def real_world() -> Explorer:
    """Return the demo map, mirrored at its border until it is large enough."""
    small = ElevationMap.load(MAP)
    more = [(0, max(0, CELLS - n)) for n in small.shape]
    heights, known = (
        np.pad(values, more, mode="reflect")[:CELLS, :CELLS]
        for values in (small.heights, small.known)
    )
    grid = ElevationMap(np.where(known, heights, np.nan), small.resolution)
    zoo = dict(list(load_zoo("toy").items())[:POLICIES])
    return Explorer(grid, zoo, START, GOAL)


def noisy_world() -> Explorer:
    """Return the worst case: policies that take turns at every cell, so little can be left out."""
    rng = torch.Generator().manual_seed(0)
    shape = (CELLS, CELLS, 8)
    grid = ElevationMap(np.zeros((CELLS, CELLS)))
    said = {
        f"policy {i}": Assessment(
            0.3 + 0.7 * torch.rand(shape, generator=rng), 2 * torch.rand(shape, generator=rng), grid
        )
        for i in range(POLICIES)
    }
    return Explorer(grid, said, grid.centre_of(5, 5), grid.centre_of(122, 122))


def drag(explorer: Explorer, count: int, switch_cost: float) -> str:
    """Move tau_high through its range and say what that took."""
    explorer.update(switch_cost=switch_cost)
    view = TauPictures(explorer)
    cpu, wall = [], []

    def timed(work: Callable[[], object]) -> None:
        began = time.process_time(), time.perf_counter()
        work()
        cpu.append(1000 * (time.process_time() - began[0]))
        wall.append(1000 * (time.perf_counter() - began[1]))

    def one(high: float) -> None:
        explorer.update(taus=(0.1, high))
        view.scene()

    for high in np.linspace(0.4, 5.0, count).tolist():
        timed(lambda high=high: one(high))
    numbers = [np.quantile(times, q) for times in (cpu, wall) for q in (0.5, 0.95)]
    verdict = "met" if numbers[1] <= BUDGET else "missed"
    return "".join(f"{number:9.1f}" for number in numbers) + f"   {verdict}"


def main() -> None:
    torch.set_num_threads(1)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    print(f"{CELLS} x {CELLS} x 8, {POLICIES} policies, {count} drags; ms, budget {BUDGET:g}")
    print("map     switch cost   CPU p50      p95 wall p50      p95   p95 of CPU in budget")
    for name, make in (("demo", real_world), ("noise", noisy_world)):
        explorer = make()
        for switch_cost in (0.0, 1.0, 3.0):
            row = drag(explorer, count, switch_cost)
            print(f"{name:6}{switch_cost:13.1f} {row}", flush=True)


if __name__ == "__main__":
    main()
