"""What every benchmark shares: rivals timed in turns, ratios with their spread, fitted exponents.

A time alone says little of a machine that others use too. So what is compared is run in turns, one
round after the other, in CPU seconds of one process with one thread; a ratio is taken within each
round, and its median is told with the smallest and the largest.
"""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

Size = Literal["full", "quick", "tiny"]
"""How large the benchmarks are: all of it, what fits into three minutes, or what a test can run."""
Name = TypeVar("Name", bound=Hashable)
"""What names a way."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One measured number, with its spread over the rounds."""

    bench: str
    """The benchmark."""
    what: str
    """What was measured, and on what."""
    unit: str = "x"
    """Unit of the numbers: "x" for a ratio, "s", "ms", "MB" or "exponent"."""
    low: float
    """The smallest."""
    median: float
    """The one in the middle."""
    high: float
    """The largest."""


def row(bench: str, what: str, values: Sequence[float], unit: str = "x") -> Row:
    """Return the row of several values of one number."""
    low, median, high = (float(np.quantile(values, q)) for q in (0.0, 0.5, 1.0))
    return Row(bench=bench, what=what, unit=unit, low=low, median=median, high=high)


def in_turns(ways: Mapping[Name, Callable[[], object]], rounds: int) -> dict[Name, list[float]]:
    """Run every way once to warm up if there are several rounds, then once per round, in turns.

    Returns the CPU seconds of each round.
    """
    times = {name: [] for name in ways}
    for number in range(rounds + (rounds > 1)):
        for name, way in ways.items():
            began = time.process_time()
            way()
            if number or rounds == 1:
                times[name].append(time.process_time() - began)
    return times


def ratios(times: Mapping[str, list[float]], slow: str, fast: str) -> list[float]:
    """Return how many times longer `slow` took than `fast`, round by round."""
    return [a / max(b, 1e-9) for a, b in zip(times[slow], times[fast], strict=True)]


def exponent(amounts: Sequence[float], seconds: Sequence[float]) -> float:
    """Fit seconds = a * amount ** exponent by least squares of the logarithms."""
    return float(np.polyfit(np.log(amounts), np.log(seconds), 1)[0])
