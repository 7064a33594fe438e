"""A natural map of 12 x 12 m at 5 cm with the A1's four specialists, each time in a fresh process.

CPU seconds from the map to the route, the most memory above what imports and specialists take, and
the seconds over bare sgemm of the same multiplications. As a program it is that process:
`python benchmarks/bench_map.py 240` prints its numbers.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
from harness import Row, Size, row

CELLS = 240


def measure(cells: int) -> dict[str, float]:
    """Plan across a natural map once, in this process; return what it took."""
    import torch
    from bench_tensorize import HEADINGS, sgemm
    from worlds import a1, natural

    from fgtutor.planning import plan_on_map

    torch.set_num_threads(1)
    elevation, zoo = natural(cells), a1()
    before = memory()
    began = time.process_time()
    corner = elevation.centre_of(2, 2), elevation.centre_of(cells - 3, cells - 3)
    plan_on_map(elevation, zoo, *corner, f_min=1e-6)
    ours = time.process_time() - began
    peak = memory() - before
    began = time.process_time()
    with torch.no_grad():
        sgemm(zoo, cells * cells * HEADINGS)
    return {"s": ours, "MB": peak, "x": ours / (time.process_time() - began)}


def memory() -> float:
    """Return the most memory that this process has held, MB (on Windows, what it holds)."""
    try:
        import resource
    except ImportError:  # Windows
        return psutil.Process().memory_info().rss / 1e6
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most / 1e3


def rows(size: Size) -> Iterator[Row]:
    """Measure in processes of their own, one after the other."""
    cells, rounds = {"full": (CELLS, 3), "quick": (CELLS, 1), "tiny": (24, 1)}[size]
    command = [sys.executable, str(Path(__file__)), str(cells)]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
    found = [
        json.loads(subprocess.run(command, check=True, capture_output=True, env=one_thread).stdout)
        for _ in range(rounds)
    ]
    place = f"natural map, {cells} x {cells} of 0.05 m, 4 A1 policies"
    for unit, what in (("s", "CPU"), ("MB", "memory"), ("x", "CPU / sgemm")):
        yield row("natural map", f"{what}, {place}", [one[unit] for one in found], unit)


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]))))
