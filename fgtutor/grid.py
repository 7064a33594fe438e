"""Arithmetic of the grid: which cell holds a coordinate, how many are too many, places as text.

Reads coordinates in metres; gives cell numbers and words. Everything that sorts into cells does it
here, so that all agree on which cell a border belongs to.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from fgtutor.errors import FgtutorError, MapError

MOST_CELLS = 50_000_000
"""Larger maps are refused, since they almost always come from a wrong unit: 350 m x 350 m at 5 cm.
"""
_SLACK, _ULPS, _MOST_SLACK = 1e-8, 8.0, 5e-4
"""The slack in cells: a share for origins that are rounded to a nanometre, so many times what the
coordinates themselves are rounded by, and at most half a thousandth of a cell."""


def cells_of(coordinates: ArrayLike, corner: ArrayLike, resolution: float) -> np.ndarray:
    """Return floor((coordinates - corner) / resolution); a border belongs to the upper cell.

    Decimals are no floats: 0.15 / 0.05 is 2.9999999999999996, and at y = 4.6e6 m two floats lie
    1e-9 m apart. So the border of a cell reaches as far down as coordinates may be off by their
    type's rounding: of a written decimal, of LAS's whole number times scale plus offset.
    Numbers beyond 2**61 cells are cut off there.

    Raises:
        MapError: A coordinate or a corner is NaN.
    """
    given, first = np.asarray(coordinates), np.asarray(corner, dtype=np.float64)
    precision = np.finfo(given.dtype if given.dtype.kind == "f" else np.float64).eps
    values = given.astype(np.float64, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = np.maximum(np.abs(values), np.abs(first))
        slack = np.minimum(_SLACK + _ULPS * precision * largest / resolution, _MOST_SLACK)
        cells = np.floor((values - first) / resolution + slack)
    if np.isnan(cells).any():
        raise MapError("a coordinate that is NaN lies in no cell: leave such points out")
    return np.clip(cells, -(2.0**61), 2.0**61).astype(np.int64)


def check_cells(shape: Sequence[int], error: type[FgtutorError] = MapError) -> None:
    """Raise `error` if a grid has more than `MOST_CELLS` cells, before memory is taken for it."""
    if math.prod(int(n) for n in shape) > MOST_CELLS:
        raise error(
            f"{' x '.join(str(n) for n in shape)} cells are more than {MOST_CELLS}, the most that "
            "a map may have: cut out a part, or take coarser cells"
        )


def coordinate_text(value: float, resolution: float) -> str:
    """Return a coordinate with digits down to half a cell, at least to the centimetre."""
    if not abs(value) < 1e12:
        return f"{value:g}"
    digits = max(2, min(math.ceil(-math.log10(resolution / 2)), 9))
    return f"{round(value, digits) + 0.0:.{digits}f}"


def point_text(point: Sequence[float], resolution: float) -> str:
    """Return a point as text, such as (500001.00, 4649775.00)."""
    return f"({', '.join(coordinate_text(value, resolution) for value in point)})"
