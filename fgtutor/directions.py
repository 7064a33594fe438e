"""The d headings: their order, yaw angles and cell steps (paper, Sec. III-B, where d is 8).

Headings are ordered counter-clockwise from +x: of eight, heading k points k * 45 degrees, so that
0 = +x, 2 = +y, 4 = -x, 6 = -y. The opposite of k is k + d / 2, and a quarter turn adds d / 4. This
is the only file that knows the order; everything else asks it. 16, 32 and 48 headings are ours.

A step longer than its neighbours leads over cells between its ends. It passes through those whose
interior the straight segment from centre to centre meets: touching a corner is not passing, as on a
diagonal step of the paper's. Turns and mirror images of the grid keep that rule.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Self, get_args

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from fgtutor.errors import ConfigError, PlanningError

HeadingCount = Literal[8, 16, 32, 48]
"""How many headings there can be."""
Step = tuple[int, int]
"""A difference of cells (dix, diy)."""
Window = tuple[slice, slice]
"""A rectangle of cells."""
_EIGHTHS: dict[int, tuple[Step, ...]] = {
    8: ((1, 0),),
    16: ((1, 0), (2, 1)),
    32: ((1, 0), (3, 1), (2, 1), (3, 2)),
    48: ((1, 0), (6, 1), (3, 1), (2, 1), (3, 2), (5, 4)),
}
"""The steps of each number of headings from +x to before the diagonal; the others are mirror images
and turns of them. No direction is further from a heading than 22.5, 13.3, 9.2 and 4.8 degrees."""


@dataclass(frozen=True)
class Headings:
    """The headings that a robot may leave a cell along.

    Raises:
        ConfigError: There are no such headings.
    """

    count: HeadingCount = 8
    """d: 8 (the paper's), 16, 32 or 48."""

    def __post_init__(self) -> None:
        if self.count not in get_args(HeadingCount):
            raise ConfigError(f"the number of headings is 8, 16, 32 or 48, got {self.count!r}")

    @classmethod
    def of(cls, tensor: Any) -> Self:
        """Return the headings of a tensor or array [..., nx, ny, d].

        Raises `PlanningError` if its last axis cannot be that of headings.
        """
        if len(tensor.shape) < 3 or tensor.shape[-1] not in get_args(HeadingCount):
            raise PlanningError(
                f"the last axis of {tuple(tensor.shape)} does not count headings, of which there "
                "are 8, 16, 32 or 48: pass what tensorize gave, (nx, ny, 8)"
            )
        return cls(tensor.shape[-1])

    @cached_property
    def steps(self) -> Int[np.ndarray, "d 2"]:
        """Cell step (dix, diy) of each heading."""
        eighth = _EIGHTHS[self.count]
        quarter = [*eighth, (1, 1), *((b, a) for a, b in reversed(eighth[1:]))]
        turns = [(1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)]
        return np.array(
            [(p * a + q * b, r * a + s * b) for p, q, r, s in turns for a, b in quarter]
        )

    @cached_property
    def yaws(self) -> Float[np.ndarray, " d"]:
        """Yaw of each heading, radians from 0 to 2 pi counter-clockwise from +x (REP-103).

        Of more than eight they are not evenly spaced: (2, 1) points 26.6 degrees, not 22.5.
        """
        return np.arctan2(self.steps[:, 1], self.steps[:, 0]) % (2 * math.pi)

    @cached_property
    def lengths(self) -> Float[np.ndarray, " d"]:
        """Length of each step in cells, such as 1, sqrt(2), sqrt(5)."""
        return np.hypot(self.steps[:, 0], self.steps[:, 1])

    @cached_property
    def moves(self) -> Int[np.ndarray, " d"]:
        """How many of the paper's steps each step counts for: a king's moves, max(|dix|, |diy|)."""
        return np.abs(self.steps).max(axis=1)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """How figures and messages name the headings: "+x", "+2x+y", "+x+y"."""
        return tuple(
            "".join(
                f"{'+' if n > 0 else '-'}{abs(n) if abs(n) > 1 else ''}{axis}"
                for n, axis in zip(step, "xy", strict=True)
                if n
            )
            for step in self.steps.tolist()
        )

    @cached_property
    def between(self) -> tuple[tuple[Step, ...], ...]:
        """The cells that each step passes through between its ends, seen from where it starts.

        A cell (i, j) in the rectangle of the step (a, b) is one if |i b - j a| < (|a| + |b|) / 2:
        its centre is then nearer to the segment than its corners reach.
        """
        return tuple(
            tuple(
                (i, j)
                for i in range(min(a, 0), max(a, 0) + 1)
                for j in range(min(b, 0), max(b, 0) + 1)
                if 2 * abs(i * b - j * a) < abs(a) + abs(b) and (i, j) not in ((0, 0), (a, b))
            )
            for a, b in self.steps.tolist()
        )

    def index_of(self, steps: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """Return the heading of each step, which must be one of ours."""
        return np.equal(steps[:, None], self.steps).all(axis=-1).argmax(axis=-1)

    def towards(self, step: Float[np.ndarray, "2"]) -> int:
        """Return the heading that points most nearly the way of `step`."""
        return int((self.steps / self.lengths[:, None] @ step).argmax())

    def steps_within(self, usable: Bool[np.ndarray, "nx ny"]) -> Bool[np.ndarray, "nx ny d"]:
        """Return which steps start from, pass through and end on usable cells of the map only."""
        within = np.zeros((*usable.shape, self.count), dtype=bool)
        for heading, step in enumerate(self.steps.tolist()):
            tail, head = overlap(usable.shape, step)
            there = usable[tail] & usable[head]
            for cell in self.between[heading]:
                there &= usable[moved(tail, cell)]
            within[(*tail, heading)] = there
        return within

    def least(self, values: Num[np.ndarray, "nx ny d"]) -> Num[np.ndarray, "nx ny d"]:
        """Return, for each step, the least value along its heading of the cells that it leaves.

        Those are its first cell and the ones between its ends. So a step is as feasible as the
        least feasible part of it. Of eight headings no step has a part: `values` itself is given.
        """
        if not any(self.between):
            return values
        least = values.copy()
        for heading, step in enumerate(self.steps.tolist()):
            tail, _ = overlap(values.shape[:2], step)
            for cell in self.between[heading]:
                there = values[(*moved(tail, cell), heading)]
                least[(*tail, heading)] = np.minimum(least[(*tail, heading)], there)
        return least


def overlap(shape: tuple[int, ...], step: Step) -> tuple[Window, Window]:
    """Return the cells of a map from which `step` stays on it, and the cells that it leads to."""
    tail, head = (
        tuple(
            slice(start := max(sign * d, 0), start + max(n - abs(d), 0))
            for d, n in zip(step, shape, strict=True)
        )
        for sign in (-1, 1)
    )
    return tail, head  # pyright: ignore[reportReturnType]


def moved(window: Window, step: Step) -> Window:
    """Return the cells that `step` leads to from a window."""
    (ix, iy), (dx, dy) = window, step
    return slice(ix.start + dx, ix.stop + dx), slice(iy.start + dy, iy.stop + dy)


# The paper's eight, which the course teaches; the library itself asks the `Headings` in use.

_EIGHT = Headings(8)

NUM_HEADINGS = _EIGHT.count
"""d, the number of headings (paper, Sec. III-B)."""

YAWS = _EIGHT.yaws
"""Yaw of each heading, radians counter-clockwise from +x (REP-103)."""

STEPS = _EIGHT.steps
"""Cell step (dix, diy) of each heading."""

STEP_LENGTHS = _EIGHT.lengths
"""Length of each step in cells: 1 along an axis, sqrt(2) along a diagonal."""

NAMES = _EIGHT.names
"""How figures and messages name the headings."""
