"""The point cloud as a value: its points, how finely they were stored, what was left out of them.

Reads arrays; gives a `Cloud`, or a `CloudError` that says why the numbers are no points in metres.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fgtutor.errors import CloudError
from fgtutor.io.validation import numbers

Points = Float[np.ndarray, "n 3"]

_FREE, _RATIO = 64_000_000, 100
"""A compressed file may hold so many bytes, or this many times its own size. Scans compress to a
twentieth at best; a file that claims more was made to fill the memory."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Finite points, and what is known of where they came from."""

    points: Points
    """x, y, z in metres, z up."""
    step: float = 0.0
    """How far apart neighbouring values of a coordinate lie as they were stored, m."""
    single: bool = False
    """Whether they were stored as floats of 32 bits or fewer."""
    notes: tuple[str, ...] = ()
    """What was left out or converted, and why."""

    def __repr__(self) -> str:
        return f"Cloud({', '.join((f'{len(self.points)} points', *self.notes))})"


def cloud_of(values: object, *, step: float = 0.0, notes: tuple[str, ...] = ()) -> Cloud:
    """Return points [n, 3] as a cloud, without rows that are masked or not finite.

    Args:
        values: The points, or a table with fields x, y and z, or a cloud: it is returned as it is.
        step: Distance of neighbouring values, m, if it is more than that of the array's type.
        notes: What was left out before.

    Raises:
        CloudError: These are not real numbers [n, 3], or no row is finite.
    """
    if isinstance(values, Cloud):
        return values
    table = getattr(getattr(values, "dtype", None), "names", None)
    kinds = [values.dtype[axis] for axis in "xyz"] if table else []  # pyright: ignore
    if table:
        values = np.stack([values[axis] for axis in "xyz"], axis=-1)  # pyright: ignore
    array = numbers("points", values, CloudError, unknown=True)
    if array.ndim != 2 or array.shape[1] != 3:
        raise CloudError(f"points must have shape [n, 3] (x, y, z in metres), got {array.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        points = array.astype(np.float64, copy=False)
    whole = np.isfinite(points).all(axis=1)
    notes += note((~whole).sum(), "point", " not finite")
    if not whole.any():
        without = f" ({', '.join(notes)})" if notes else ""
        raise CloudError(
            f"none of the {len(points)} points is finite{without}: scan or export again"
        )
    points = points if whole.all() else points[whole]
    small = [kind for kind in kinds or [array.dtype] if kind.kind == "f" and kind.itemsize < 8]
    coarsest = min(small, default=points.dtype, key=lambda kind: kind.itemsize)
    spacing = np.spacing(coarsest.type(max(points.max(), -points.min())))
    return Cloud(points, max(step, float(spacing)), bool(small), notes)


def note(count: int, what: str, more: str = "") -> tuple[str, ...]:
    """Return the note that so many of something were left out, or none if it is 0."""
    return (f"{count} {what}{'' if count == 1 else 's'}{more}",) if count else ()


def check_claim(claimed: int, size: int) -> None:
    """Raise `CloudError` if a file of `size` bytes cannot hold what it claims to, compressed.

    To be called before memory is taken for it.
    """
    if claimed > max(_FREE, _RATIO * size):
        raise CloudError(
            f"the file has {size} bytes and claims to hold {claimed}, more than {_RATIO} times as "
            "many: no scan compresses so well, it is corrupt or made to fill the memory"
        )


def check_count(found: int, promised: int) -> None:
    """Raise `CloudError` unless as many points are there as the header promises."""
    if found < promised:
        raise CloudError(
            f"the header promises {promised} points and {found} are there: the file was cut off, "
            "copy it again"
        )
    if found > promised:
        raise CloudError(
            f"the file has more points than its header says, {found} instead of {promised}: "
            "correct the header, or export it again"
        )


def axes_of(names: Sequence[str]) -> list[int]:
    """Return where x, y and z stand in a table; raises `CloudError` unless each is there once."""
    if any(names.count(axis) != 1 for axis in "xyz"):
        lacks = ", ".join(axis for axis in "xyz" if axis not in names) or "one of each"
        raise CloudError(
            f"the points have {', '.join(names)[:60]!r}, without {lacks}: expected each of x, y "
            "and z once"
        )
    return [names.index(axis) for axis in "xyz"]


def read_rows(data: bytes, at: int, count: int, row: np.dtype) -> tuple[np.ndarray, int]:
    """Return the table of `count` rows that begins at a byte, and how many bytes follow it."""
    check_count(min(max(len(data) - at, 0) // row.itemsize, count), count)
    table = np.frombuffer(data, row, count, min(at, len(data)))
    return table, len(data) - at - table.nbytes


def whole_number(text: str, what: str) -> int:
    """Return a number of things in a header, or raise `CloudError`."""
    if not re.fullmatch(r"[0-9]{1,15}", text):
        raise CloudError(f"{what} is {text[:40]!r} in the header, expected a whole number from 0")
    return int(text)
