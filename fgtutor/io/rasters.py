"""Pictures of heights: their rows to a map's columns and back, and what their readers raise.

Images run row by row from north to south, maps [ix, iy] from south to north; only this file turns
one into the other.
"""

import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from fgtutor.errors import MapError

if TYPE_CHECKING:
    from fgtutor.elevation import ElevationMap

T = TypeVar("T")

_STRIP = 2_000_000
"""Cells that are turned into metres at a time, which bounds the memory for numbers in between."""


def rows_of(elevation: "ElevationMap") -> np.ndarray:
    """Return the observed heights as the rows of an image; unknown cells are NaN."""
    observed = np.where(elevation.known, elevation.heights, np.float32(np.nan))
    return np.ascontiguousarray(observed.T[::-1])


def heights_of(
    shape: tuple[int, int],
    strip: Callable[[slice], tuple[np.ndarray, np.ndarray]],
    scale: float,
    offset: float,
) -> np.ndarray:
    """Return offset + scale * value of an image [rows, columns] as heights [ix, iy].

    `strip` reads some of its rows and gives their values, and which of them are known.
    """
    rows, columns = shape
    heights = np.empty((columns, rows), dtype=np.float32)
    step = max(_STRIP // columns, 1)
    for first in range(0, rows, step):
        some = slice(first, min(first + step, rows))
        values, known = strip(some)
        with np.errstate(over="ignore", invalid="ignore"):  # the map refuses what is not finite
            metres = offset + scale * values.astype(np.float64)
            heights[:, rows - some.stop : rows - some.start] = np.where(known, metres, np.nan)[
                ::-1
            ].T
    return heights


def decoding(load: Callable[[Path], T]) -> Callable[[Path], T]:
    """Turn whatever the libraries raise on damaged files, which has no end, into a `MapError`."""

    @wraps(load)
    def loaded(path: Path) -> T:
        try:
            return load(path)
        except MapError:
            raise
        except Exception as error:
            problem = error
        if isinstance(problem, OSError) and problem.strerror:
            raise MapError(f"cannot be read: {problem.strerror}")
        reason = re.sub(r"[^ -~]+", " ", f"{type(problem).__name__}: {problem}")[:200]
        reason = reason.replace("Out of memory", "Too much memory for")  # libtiff's way to say no
        raise MapError(
            f"cannot be read as a {path.suffix} map ({reason}); the file is corrupt or of another "
            "kind: write it again with ElevationMap.save"
        )

    return loaded
