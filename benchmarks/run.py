"""Run every benchmark, print one Markdown table, and write the numbers as JSON.

    python benchmarks/run.py [--quick] [--only NAME ...] [--out FILE]

What the numbers mean: benchmarks/README.md.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module, metadata
from pathlib import Path

import torch
from harness import Row, Size

from fgtutor.evaluation.report import markdown
from fgtutor.io.machine import available_memory, usable_cores
from fgtutor.io.storage import atomic_write

BENCHES = ("tensorize", "plan", "widgets", "env", "scan", "map", "growth")
PACKAGES = ("fgtutor", "torch", "numpy", "scipy", "networkx", "rustworkx", "igraph", "mujoco")
PACKAGES += ("pymunk",)


def versions() -> dict[str, str | None]:
    """Return what is installed; None for what is not."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def machine() -> dict[str, str | float | list[float]]:
    """Say where this runs, and how busy it was."""
    load = [round(one, 2) for one in os.getloadavg()] if hasattr(os, "getloadavg") else []
    return {
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": usable_cores(),
        "free_memory_gb": round(available_memory() / 1e9, 1),
        "load": load,
    }


def run(size: Size, names: Sequence[str] = BENCHES) -> list[Row]:
    """Run benchmarks one after the other, saying what came out as it comes."""
    torch.set_num_threads(1)
    found = []
    for name in names:
        began = time.perf_counter()
        for one in import_module(f"bench_{name}").rows(size):
            found.append(one)
            print("  ".join(line(one)), file=sys.stderr, flush=True)
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def line(one: Row) -> list[str]:
    """Return the cells of a row of the table."""
    median, low, high = (f"{value:.3g}" for value in (one.median, one.low, one.high))
    return [one.bench, one.what, f"{median} {one.unit}", f"{low} to {high}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description="Run every benchmark.")
    parser.add_argument("--quick", action="store_true", help="smaller: under three minutes")
    parser.add_argument("--only", nargs="+", choices=BENCHES, default=BENCHES, help="which ones")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results.json")
    options = parser.parse_args(arguments)
    report, began = {"machine": machine(), "versions": versions()}, time.perf_counter()
    found = run("quick" if options.quick else "full", options.only)
    report |= {
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seconds": round(time.perf_counter() - began),
        "quick": options.quick,
        "rows": [asdict(one) for one in found],
    }
    with atomic_write(options.out) as path:
        path.write_text(json.dumps(report, indent=1) + "\n")
    print(markdown(["benchmark", "measured", "median", "spread"], map(line, found)))
    print(f"\n{report['seconds']} s on {report['machine']}; written to {options.out}")


if __name__ == "__main__":
    main()
