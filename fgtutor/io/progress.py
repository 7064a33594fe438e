"""Progress on the terminal: a bar for work that lasts, after an estimate of its duration.

Reads the parts of the work as they are done; writes to stderr, and nothing about work of less than
two seconds.
"""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")

QUICK = 2.0
"""What is over within so many seconds shows no bar."""
TRIED = 0.5
"""Seconds of work after which the whole is estimated."""
LONG = 10.0
"""What takes more seconds than this is announced."""


def watch(
    parts: Iterable[T], total: int, what: str, *, show: bool, unit: str = "it"
) -> Iterator[T]:
    """Yield `total` parts of the work `what`, and show how many of them are done if `show`."""
    began, told = time.monotonic(), not show
    with tqdm(total=total, desc=what, unit=unit, delay=QUICK, disable=not show) as bar:
        for done, part in enumerate(parts, 1):
            yield part
            bar.update()
            spent = time.monotonic() - began
            if not told and spent > TRIED:
                told, expected = True, spent * total / done
                if expected > LONG:
                    tqdm.write(f"{what}: about {duration(expected)}", file=sys.stderr)


@contextmanager
def waiting(what: str) -> Iterator[threading.Timer]:
    """Say `what` is being done if the block is not over at once, where its parts do not show."""
    timer = threading.Timer(QUICK, lambda: print(f"{what} ...", file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield timer
    finally:
        timer.cancel()


def duration(seconds: float) -> str:
    """Return a duration, rounded for reading: "40 s", "12 min", "3.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
