"""Obstacles in the manner of NIST's test lanes, none of which any specialist was trained on.

Reads a `Course`; lays a field of posts, continuous ramps, or stairs round a corner, as the
functions of `obstacles` do. Sources: ASTM E2828 (stepfields) and E2826 (continuous pitch and roll
ramps) by their names; the stepfield's dimensions are those of the mesh in
tu-darmstadt-ros-pkg/hector_nist_arenas_gazebo (BSD), at half its height.
"""

import math
from collections.abc import Callable

import numpy as np

from fgtutor.world.obstacles import Course

POST = 0.1
"""Side of a post of the stepfield, m."""
STEPFIELD = 0.005 * np.array(
    [
        [0, 10, 0, 10, 10, 10, 20, 20, 20, 40],
        [10, 20, 10, 0, 20, 20, 10, 30, 40, 20],
        [20, 30, 30, 20, 10, 30, 20, 40, 30, 20],
        [10, 10, 20, 0, 20, 30, 40, 20, 10, 0],
        [30, 20, 20, 10, 30, 40, 30, 10, 20, 10],
        [10, 30, 30, 20, 40, 20, 10, 10, 20, 10],
        [10, 20, 30, 40, 20, 20, 30, 10, 10, 30],
        [30, 30, 40, 30, 20, 30, 10, 0, 20, 10],
        [20, 40, 30, 20, 0, 20, 10, 20, 0, 10],
        [40, 20, 20, 30, 20, 30, 20, 10, 10, 0],
    ]
)
"""Heights of a tile's posts, m: half of the original's 10 to 40 cm, which are beyond an A1."""
RAMP, INCLINE = 0.6, math.radians(15)
"""Length of a ramp, m, and its slope; two lie in a cell of 1.2 m."""
RISE, TREAD, AISLE, WALL = 0.1, 0.3, 1.2, 0.9
"""The stairs round a corner: riser, tread, width, and height of the walls beside them, m."""
CORNER_WIDTH = 3.5
"""Width that the stairs round a corner take, m; their length is at least 2.2 m."""


def _stepfield(course: Course, x0: float, x1: float) -> float:
    """Lay tiles of 10 x 10 posts, each turned by some quarters."""
    course.full(x0, x1)
    columns, rows = (int(length + 1e-6) for length in (x1 - x0, course.width))
    left, right = x0 + (x1 - x0 - columns) / 2, (course.width - rows) / 2
    for column in range(columns):
        for row in range(rows):
            tile = np.rot90(STEPFIELD, int(course.rng.integers(4)))
            for (i, j), top in np.ndenumerate(tile):
                x, y = left + column + i * POST, right + row + j * POST
                course.block(x, x + POST, y, y + POST, float(top))
    return course.middle


def _ramps(course: Course, x0: float, x1: float) -> float:
    """Lay ramps up and down without a landing, in lanes that begin with either."""
    course.full(x0, x1)
    pairs, lanes = int((x1 - x0) / (2 * RAMP) + 1e-6), max(int(course.width / (2 * RAMP) + 1e-6), 1)
    left, width, top = (
        x0 + (x1 - x0) / 2 - pairs * RAMP,
        course.width / lanes,
        RAMP * math.tan(INCLINE),
    )
    for lane in range(lanes):
        for k in range(2 * pairs):
            low, high = (0.0, top) if (k + lane) % 2 == 0 else (top, 0.0)
            x, y = left + k * RAMP, lane * width
            course.ramp(x, x + RAMP, y, y + width, low, high, along="x")
    return course.middle


def _corner(course: Course, x0: float, x1: float) -> float:
    """Lay stairs up to a landing and, at a right angle, down again, between walls."""
    width, foot = course.width, x0 + 3 * TREAD
    end, aside = foot + AISLE, AISLE + 3 * TREAD
    for k in range(3):
        course.block(x0 + k * TREAD, x0 + (k + 1) * TREAD, 0.0, AISLE, (k + 1) * RISE)
        y = AISLE + k * TREAD
        course.block(foot, end, y, y + TREAD, (3 - k) * RISE)
    course.block(foot, end, 0.0, AISLE, 4 * RISE)
    course.block(foot, x1, aside, width, 0.0)
    course.block(x0, foot, AISLE, width, WALL)
    course.block(end, x1, 0.0, aside, WALL)
    return AISLE / 2


def corner_lanes(
    width: float, x0: float, x1: float, margin: float
) -> list[tuple[float, float, float, float]]:
    """Return where a robot can go on the stairs round a corner: rectangles x0, x1, y0, y1, m.

    `margin` is how far it keeps from walls and edges; the first and the last reach beyond the ends.
    """
    foot, aside = x0 + 3 * TREAD, AISLE + 3 * TREAD
    within = foot + margin, foot + AISLE - margin
    return [
        (x0 - 2 * margin, within[1], margin, AISLE - margin),
        (*within, margin, width - margin),
        (within[0], x1 + 2 * margin, aside + margin, width - margin),
    ]


NIST: dict[str, Callable[[Course, float, float], float]] = {
    "stepfield": _stepfield,
    "ramps": _ramps,
    "corner": _corner,
}
"""Each lays its obstacle over the full width from x0 to x1; gives the y where its way begins."""
