"""Rasters of heights: the rows of an image to a map's columns and back.

Images run row by row from north to south, maps [ix, iy] from south to north; only this file turns
one into the other.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fgtutor.elevation import ElevationMap

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
