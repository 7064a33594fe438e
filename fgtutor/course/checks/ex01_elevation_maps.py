"""Exercise 01, "Elevation maps and patches": cells, ground, headings, directions (Sec. III-B)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question
from fgtutor.directions import NUM_HEADINGS, STEPS


def _points(rng: np.random.Generator) -> tuple:
    origin = rng.uniform(-3, 3, 2)
    resolution = float(rng.choice([0.05, 0.1, 0.25]))
    cells = rng.integers(-3, 20, (8, 2))
    cells[0] = -2, -1  # one point beyond the map's lower left corner, always
    # Well inside their cells: on a border, rounding decides.
    return origin + (cells + rng.uniform(0.15, 0.85, (8, 2))) * resolution, origin, resolution


def _patch(rng: np.random.Generator) -> tuple:
    patch = rng.uniform(-2, 2) + rng.exponential(0.2, (7, 5))
    footprint = np.zeros((7, 5), dtype=bool)
    footprint[2:5, 1:4] = True
    return patch, footprint


def _turned(offsets: np.ndarray, pose: np.ndarray) -> np.ndarray:
    turned = (offsets[:, 0] + 1j * offsets[:, 1]) * np.exp(1j * pose[2]) + complex(*pose[:2])
    return np.stack((turned.real, turned.imag), axis=-1)


def _rise(heights: np.ndarray, step: np.ndarray, outside: float = np.nan) -> np.ndarray:
    around = np.pad(heights, 1, constant_values=np.nan)
    (nx, ny), (dx, dy) = heights.shape, step
    rise = around[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny] - heights
    return np.where(np.isnan(rise), outside, rise)


QUESTIONS = (
    Question(
        id="ex01.q1",
        name="cells_of",
        points=2,
        title="which cell holds a point?",
        expects="a point is in cell (ix, iy) if ix * resolution <= x - x0 < (ix + 1) * resolution, "
        "and so for y; left of the map, indices are negative.",
        draw=_points,
        truth=lambda xy, origin, resolution: np.floor((xy - origin) / resolution).astype(int),
        mistakes=(
            Mistake(
                "rounding for floor: the origin is a cell's corner, not its centre, so no cell "
                "begins half a cell early.",
                lambda xy, o, r: np.round((xy - o) / r).astype(int),
            ),
            Mistake(
                "a forgotten origin: the map does not begin at (0, 0): subtract its corner first.",
                lambda xy, o, r: np.floor(xy / r).astype(int),
            ),
            Mistake(
                "swapped axes: x comes first: arrays here are [ix, iy], not [row, column].",
                lambda xy, o, r: np.floor((xy - o) / r).astype(int)[:, ::-1],
            ),
            Mistake(
                "truncation for floor: int() cuts towards zero, so points just left of the map "
                "land in cell 0.",
                lambda xy, o, r: ((xy - o) / r).astype(int),
            ),
            Mistake(
                "a product for a quotient: metres divided by metres per cell gives cells.",
                lambda xy, o, r: np.floor((xy - o) * r).astype(int),
            ),
        ),
        hints=(
            "How many metres is the point from the corner, and how many cells is that?",
            "np.floor rounds down, also below zero; int() does not.",
            "np.floor((xy - origin) / resolution).astype(int)",
        ),
    ),
    Question(
        id="ex01.q2",
        name="relative_patch",
        points=2,
        title="heights relative to the ground",
        expects="the median of the cells under the footprint is 0 after the subtraction, and "
        "height differences within the patch are unchanged.",
        draw=_patch,
        truth=lambda patch, footprint: patch - np.median(patch[footprint]),
        mistakes=(
            Mistake(
                "mean for median: one high cell under a foot would lift the whole ground.",
                lambda patch, under: patch - patch[under].mean(),
            ),
            Mistake(
                "the whole patch for the footprint: a wall ahead is no ground: only cells under "
                "the robot count.",
                lambda patch, under: patch - np.median(patch),
            ),
            Mistake(
                "the middle cell alone: a single cell may be a stone: take the median under the "
                "footprint.",
                lambda patch, under: patch - patch[3, 2],
            ),
            Mistake(
                "the lowest cell for the median: the ground is the median height under the robot.",
                lambda patch, under: patch - patch[under].min(),
            ),
            Mistake(
                "absolute heights: nothing was subtracted: the same step looks different on every "
                "floor.",
                lambda patch, under: patch,
            ),
        ),
        hints=(
            "footprint is a mask: patch[footprint] are the heights under the robot.",
            "np.median, not np.mean.",
        ),
    ),
    Question(
        id="ex01.q3",
        name="patch_points",
        points=3,
        title="where the points of a patch lie",
        expects="offsets (ahead, left) are turned counter-clockwise by the yaw, then moved to the "
        "robot: at yaw 90 degrees, ahead is +y and left is -x.",
        draw=lambda rng: (rng.uniform(-1, 1, (6, 2)), rng.uniform(-3, 3, 3)),
        examples=((np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([2.0, 3.0, np.pi / 2])),),
        truth=lambda offsets, pose: _turned(offsets, pose),
        mistakes=(
            Mistake(
                "a clockwise turn: the signs of the two sines have changed places; yaw counts "
                "counter-clockwise.",
                lambda offsets, pose: _turned(offsets, pose * (1, 1, -1)),
            ),
            Mistake(
                "a forgotten position: the points turn about the robot, and then lie around it, "
                "not around (0, 0).",
                lambda offsets, pose: _turned(offsets, pose * (0, 0, 1)),
            ),
            Mistake(
                "a forgotten turn: the patch looks along +x whatever the yaw is.",
                lambda offsets, pose: _turned(offsets, pose * (1, 1, 0)),
            ),
            Mistake(
                "turned after moving: turn the offsets first, then add the position; the position "
                "is not turned.",
                lambda offsets, pose: _turned(offsets + pose[:2], pose * (0, 0, 1)),
            ),
            Mistake(
                "radians taken for degrees: the yaw is in radians already.",
                lambda offsets, pose: _turned(offsets, pose * (1, 1, np.pi / 180)),
            ),
        ),
        hints=(
            "Where does (1, 0), one metre ahead, lie when the robot faces +y?",
            "x' = cos(yaw) ahead - sin(yaw) left, y' = sin(yaw) ahead + cos(yaw) left.",
            "Then add pose[:2].",
        ),
    ),
    Question(
        id="ex01.q4",
        name="rise",
        points=2,
        title="up or down depends on the heading",
        expects="rise[ix, iy] is the height of the neighbour along the heading minus the height of "
        "the cell itself, and NaN where that neighbour is off the map.",
        draw=lambda rng: (
            rng.uniform(0, 1, (int(rng.integers(4, 7)), int(rng.integers(3, 6)))),
            int(rng.integers(NUM_HEADINGS)),
        ),
        examples=(
            (np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]]), 0),
            (np.array([[0.0, 0.1, 0.3], [0.0, 0.1, 0.3], [0.0, 0.1, 0.3]]), 3),
        ),
        truth=lambda heights, heading: _rise(heights, STEPS[heading]),
        mistakes=(
            Mistake(
                "a reversed difference: it is the neighbour minus the cell: going up is positive.",
                lambda heights, k: -_rise(heights, STEPS[k]),
            ),
            Mistake(
                "the opposite heading: it looks at the neighbour behind.",
                lambda heights, k: _rise(heights, -STEPS[k]),
            ),
            Mistake(
                "swapped axes: STEPS[k] is (dix, diy), and the first index of heights is ix.",
                lambda heights, k: _rise(heights, STEPS[k][::-1]),
            ),
            Mistake(
                "a map that wraps around: np.roll brings the far border back in: off the map there "
                "is no neighbour.",
                lambda heights, k: np.roll(heights, tuple(-STEPS[k]), (0, 1)) - heights,
            ),
            Mistake(
                "zeros beyond the border: a rise of 0 says flat ground; what is not known is NaN.",
                lambda heights, k: _rise(heights, STEPS[k], outside=0.0),
            ),
            Mistake(
                "a heading off by one: heading 0 is +x, 1 is +x+y, and so on counter-clockwise.",
                lambda heights, k: _rise(heights, STEPS[(k + 1) % NUM_HEADINGS]),
            ),
        ),
        hints=(
            "fgtutor.directions.STEPS[heading] is the step (dix, diy).",
            "np.pad(heights, 1, constant_values=np.nan) puts unknown cells around the map.",
            "Cell (0, 0) is then at (1, 1): its neighbour at (1 + dix, 1 + diy).",
        ),
    ),
)
