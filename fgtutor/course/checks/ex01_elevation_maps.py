"""Exercise 01, "Elevation maps and patches": cells, ground, headings, directions (Sec. III-B)."""

from collections.abc import Callable

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


def _map_and_pose(rng: np.random.Generator) -> tuple:
    heights = rng.uniform(-1, 1) + rng.exponential(0.2, (12, 10))
    origin, resolution = rng.uniform(-3, 3, 2), 0.1
    pose = np.array([*(origin + rng.uniform(0.4, 0.6, 2)), rng.uniform(-3, 3)])
    offsets = np.array(
        [(x, y) for x in (-0.13, 0.02, 0.14, 0.3, 0.95) for y in (-0.11, 0.03, 0.12)]
    )
    return heights, origin, resolution, pose, offsets, offsets[:, 0] < 0.2


def _cut(
    heights: np.ndarray,
    origin: np.ndarray,
    resolution: float,
    pose: np.ndarray,
    offsets: np.ndarray,
    under: np.ndarray,
    *,
    nearest: bool = False,
    shift: float = 0.5,
    clamp: bool = False,
    ground: Callable[[np.ndarray], float] | None = np.median,
    under_only: bool = True,
    blank: bool = False,
) -> np.ndarray:
    """Return the patch, point by point; the options make it wrong."""
    patch = []
    for u, v in (_turned(offsets, pose) - origin) / resolution - shift:
        if nearest:
            u, v = round(u), round(v)
        corners = [(int(u // 1) + i, int(v // 1) + j) for i in (0, 1) for j in (0, 1)]
        shares = [abs((1 - i - u % 1) * (1 - j - v % 1)) for i in (0, 1) for j in (0, 1)]
        if clamp:
            corners = [tuple(np.clip(c, 0, np.array(heights.shape) - 1)) for c in corners]
        inside = [0 <= x < heights.shape[0] and 0 <= y < heights.shape[1] for x, y in corners]
        pairs = zip(corners, shares, strict=True)
        patch.append(sum(heights[c] * s for c, s in pairs) if all(inside) else np.nan)
    cut = np.array(patch)
    if ground is None:
        return cut
    if blank:
        return cut - np.nanmedian(cut * under)
    return cut - (ground(cut[under]) if under_only else np.nanmedian(cut))


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
        points=1,
        title="which cell holds a point?",
        expects="a point is in cell (ix, iy) if ix * resolution <= x - x0 < (ix + 1) * resolution, "
        "and so for y; left of the map, indices are negative.",
        draw=_points,
        integers=True,
        truth=lambda xy, origin, resolution: np.floor((xy - origin) / resolution).astype(int),
        mistakes=(
            Mistake(
                "rounding to the nearest: the origin is a cell's corner, not its centre, so round "
                "down.",
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
                "int() where np.floor is needed: int() cuts towards zero, so points just left of "
                "the map land in cell 0.",
                lambda xy, o, r: ((xy - o) / r).astype(int),
            ),
            Mistake(
                "a multiplication by the resolution: metres divided by metres per cell gives "
                "cells.",
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
        name="patch_points",
        points=2,
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
                "a yaw converted from degrees: it is in radians already.",
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
        id="ex01.q3",
        name="cut_patch",
        points=3,
        title="cut a patch out of a map",
        expects="each height is bilinear between the four cell CENTRES around its point, NaN if "
        "one of the four is off the map, and relative to the median of the points under the robot.",
        draw=_map_and_pose,
        truth=lambda heights, origin, resolution, pose, offsets, under: _cut(
            heights, origin, resolution, pose, offsets, under
        ),
        mistakes=(
            Mistake(
                "the cell's own height: a point between two centres has a height between theirs.",
                lambda *case: _cut(*case, nearest=True),
            ),
            Mistake(
                "corners taken for centres: cell (0, 0) has its height at origin + resolution / 2, "
                "so half a cell has to come off.",
                lambda *case: _cut(*case, shift=0.0),
            ),
            Mistake(
                "indices that wrap or stop at the border: off the map nothing is known: NaN.",
                lambda *case: _cut(*case, clamp=True),
            ),
            Mistake(
                "zeros off the map: that reads as flat ground; what is not known is NaN.",
                lambda *case: np.nan_to_num(_cut(*case)),
            ),
            Mistake(
                "absolute heights: nothing was subtracted, so the same step looks different on "
                "every floor.",
                lambda *case: _cut(*case, ground=None),
            ),
            Mistake(
                "the mean of the ground: one stone under a foot would lift the whole patch; take "
                "the median.",
                lambda *case: _cut(*case, ground=np.mean),
            ),
            Mistake(
                "the ground of the whole patch: a wall ahead is no ground; only the points under "
                "the robot count.",
                lambda *case: _cut(*case, under_only=False),
            ),
            Mistake(
                "heights blanked instead of selected: heights * mask puts zeros into the median; "
                "select them with heights[under].",
                lambda *case: _cut(*case, blank=True),
            ),
            Mistake(
                "a map seen from the wrong side: the points are not turned by the yaw.",
                lambda h, o, r, pose, offsets, u: _cut(h, o, r, pose * (1, 1, 0), offsets, u),
            ),
        ),
        hints=(
            "Where do the points lie in the world? patch_points says it. And in cells, counted "
            "from the centre of cell (0, 0)?",
            "low = np.floor(cells); the fractions cells - low are the weights of the upper "
            "neighbours, 1 minus them those of the lower ones.",
            "Four neighbours: low + (0, 0), (0, 1), (1, 0), (1, 1). Start each from an array of "
            "NaN, and fill in only those that are inside the map.",
        ),
    ),
    Question(
        id="ex01.q4",
        name="rise",
        points=1,
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
