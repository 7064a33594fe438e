"""The obstacles that terrains are made of, and the sizes that they may have.

Reads a `TerrainScale`, a difficulty and an rng; gives boxes laid over the full width of a corridor.
Kinds: the paper's steps, gaps, bridge and valley (Sec. IV-A), and slopes, stairs and rubble.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from annotated_types import Interval

from fgtutor.errors import TerrainError
from fgtutor.io.validation import Ascending, Share, check_fields
from fgtutor.world.boxes import Box

Resolution = Annotated[float, Interval(ge=0.005, le=0.2)]
"""Side of a terrain's cell, m: below 5 mm a corridor would have millions of cells."""
Metres = Annotated[float, Interval(ge=0.05, le=50)]
"""A length on the ground, m."""
Lengths = Annotated[tuple[Metres, Metres], Ascending]
"""The shortest and the longest, m."""
Height = Annotated[float, Interval(ge=0, le=20)]
"""A height or a depth, m."""
Angle = Annotated[float, Interval(gt=0, lt=90)]
"""A slope against the horizontal, degrees."""


@dataclass(frozen=True, kw_only=True)
class TerrainScale:
    """How large one robot's terrains are. A pair (easy, hard) holds at difficulty 0 and 1."""

    resolution: Resolution = 0.05
    """Side of a cell, m; the edges of all obstacles lie on cell borders."""
    length: Metres = 8.0
    """Length of a terrain with one kind of obstacle, along x, m."""
    width: Metres = 4.0
    """Width of a terrain, along y, m."""
    apron: Metres = 1.5
    """Length of the flat ground at either end, m; start and goal lie in the middle of it."""
    chasm_depth: tuple[Height, Height, Height] = (0.03, 0.4, 0.6)
    """Depth of gaps and of the chasm beside a bridge at difficulty 0, 0.7 and 1, m. The first must
    be survivable for a robot that falls in, or nothing is learned; the last is as good as none."""
    ease: Share = 0.2
    """Share of the full height that steps, stairs and rubble have at difficulty 0."""
    step_height: Annotated[tuple[Height, Height], Ascending] = (0.05, 0.15)
    """Lowest and highest riser at difficulty 1, m."""
    step_tread: Lengths = (0.35, 0.65)
    """Shortest and longest tread of a flight of steps, m."""
    block_share: Share = 0.4
    """Share of fields of blocks among steps; the others are flights."""
    lane_share: Share = 0.4
    """Share of flights and hills that differ between a left and a right lane."""
    bank_share: Share = 0.5
    """Share of hills whose plateau is banked sideways."""
    gap_width: tuple[Metres, Metres] = (0.1, 0.15)
    """Width of a gap, m."""
    platform: Lengths = (0.8, 1.6)
    """Shortest and longest platform between two gaps, m."""
    bridge_width: tuple[Metres, Metres] = (1.2, 0.35)
    """Width of the beam, m."""
    bridge_length: Metres = 3.0
    """Length of the beam, m."""
    valley_angle: tuple[Angle, Angle] = (15.0, 50.0)
    """Slope of the valley's walls against the horizontal, degrees."""
    valley_length: Metres = 3.0
    """Length of the valley, m."""
    valley_height: Height = 0.9
    """Height at which the walls end in a plateau, m; less where the terrain ends before."""
    slope_angle: tuple[Angle, Angle] = (6.0, 25.0)
    """Steepest ramp, degrees; each ramp draws between half of it and all of it."""
    slope_height: Height = 0.5
    """Highest plateau between two ramps, m."""
    stair_rise: Height = 0.12
    """Rise of a regular stair at difficulty 1, m."""
    stair_run: Metres = 0.3
    """Depth of a regular stair's tread, m."""
    rubble_height: Height = 0.12
    """Highest block of rubble at difficulty 1, m."""
    rubble_size: Lengths = (0.2, 0.5)
    """Shortest and longest side of a block of rubble, m."""
    rubble_density: Annotated[float, Interval(ge=0, le=3)] = 1.5
    """Area of all blocks of rubble over the area they lie on; above 1 hardly any ground is left."""
    mixed: tuple[str, ...] = ("steps", "gaps", "bridge", "valley")
    """The obstacles of the mixed terrain; their order is drawn from the seed."""
    mixed_section: Metres = 3.0
    """Mean length of an obstacle in the mixed terrain, m; each is up to 0.4 m longer or shorter."""
    mixed_landing: Metres = 1.0
    """Flat ground between two obstacles of the mixed terrain, m."""

    def __post_init__(self) -> None:
        check_fields(self, TerrainError)

    def longest(self, kind: str) -> float:
        """Return how long an obstacle may be, m."""
        return {"bridge": self.bridge_length, "valley": self.valley_length}.get(kind, self.length)


class Course:
    """A corridor under construction: collects boxes, and knows the scale, difficulty and rng.

    With `unlike`, another rng, its obstacles are none that could be drawn without: see
    `make_terrain`.
    """

    def __init__(
        self,
        scale: TerrainScale,
        difficulty: float,
        rng: np.random.Generator,
        unlike: np.random.Generator | None = None,
    ) -> None:
        self.scale = scale
        self.difficulty = difficulty
        self.rng, self.unlike = rng, unlike
        self.boxes: list[Box] = []
        self.depth = float(np.interp(difficulty, (0.0, 0.7, 1.0), scale.chasm_depth))
        self.severity = scale.ease + (1 - scale.ease) * difficulty
        self.width = self.snap(scale.width)
        self.middle = self.snap(scale.width / 2)

    def snap(self, length: float) -> float:
        """Round a length to whole cells, so that edges lie on cell borders."""
        # The second rounding removes 3 * 0.1 = 0.30000000000000004 and its like.
        return round(round(length / self.scale.resolution) * self.scale.resolution, 9)

    def draw(self, low: float, high: float) -> float:
        """Draw a length, in whole cells."""
        return self.snap(self.rng.uniform(low, high))

    def at(self, easy_hard: tuple[float, float]) -> float:
        """Interpolate a pair of the scale to the difficulty."""
        easy, hard = easy_hard
        return easy + (hard - easy) * self.difficulty

    def breadth(self, easy_hard: tuple[float, float]) -> float:
        """Interpolate a width to the difficulty, in whole cells and at least one."""
        return max(self.snap(self.at(easy_hard)), self.scale.resolution)

    def block(self, x0: float, x1: float, y0: float, y1: float, top: float) -> None:
        """Add an upright block from below the chasm's floor up to `top`."""
        bottom = -self.scale.chasm_depth[-1] - 0.5
        if x1 - x0 > 1e-6 and y1 - y0 > 1e-6:
            centre = ((x0 + x1) / 2, (y0 + y1) / 2, (bottom + top) / 2)
            self.boxes.append(Box(centre=centre, size=(x1 - x0, y1 - y0, top - bottom)))

    def full(self, x0: float, x1: float, top: float = 0.0) -> None:
        """Add a block over the full width."""
        self.block(x0, x1, 0.0, self.width, top)

    def ramp(
        self, x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, *, along: str
    ) -> None:
        """Add a slope: a surface from height z0 to z1 along "x" or "y"."""
        self.block(x0, x1, y0, y1, min(z0, z1))
        s0, s1 = (x0, x1) if along == "x" else (y0, y1)
        angle = math.atan2(z1 - z0, s1 - s0)
        length = math.hypot(z1 - z0, s1 - s0)
        # Thick enough that no robot can walk under the high end, which stands on the lower level.
        thickness = abs(z1 - z0) * math.cos(angle) + 0.05
        s = (s0 + s1) / 2 + math.sin(angle) * thickness / 2
        z = (z0 + z1) / 2 - math.cos(angle) * thickness / 2
        if along == "x":  # a positive pitch lowers the front (REP-103), hence the sign
            centre, size, rpy = (s, (y0 + y1) / 2, z), (length, y1 - y0, thickness), (0, -angle, 0)
        else:
            centre, size, rpy = ((x0 + x1) / 2, s, z), (x1 - x0, length, thickness), (angle, 0, 0)
        self.boxes.append(Box(centre=centre, size=size, rpy=rpy))

    def cuts(self, span: float, low: float, high: float) -> list[float]:
        """Return borders from 0 to `span` at random distances between `low` and `high`."""
        count = max(1, round(span / self.rng.uniform(low, high)))
        shares = self.rng.uniform(low, high, count)
        borders = np.concatenate(([0.0], np.cumsum(shares) / shares.sum())) * span
        return [self.snap(border) for border in borders]

    def lanes(self) -> list[tuple[float, float]]:
        """Return the whole width, or sometimes two lanes with the border beside the middle."""
        width = self.width
        cut = self.snap(width * (0.5 + self.rng.choice((-1, 1)) * self.rng.uniform(0.15, 0.3)))
        split = self.rng.random() < self.scale.lane_share
        return [(0.0, cut), (cut, width)] if split else [(0.0, width)]


def _flat(course: Course, x0: float, x1: float) -> float:
    course.full(x0, x1)
    return course.middle


def _steps(course: Course, x0: float, x1: float) -> float:
    """Lay flights of steps and fields of blocks, one after another, with short landings."""
    borders = course.cuts(x1 - x0, 1.8, 2.8)
    for near, far in pairwise(borders):
        kind = _blocks if course.rng.random() < course.scale.block_share else _flight
        # Without a landing, a flight up beside one down would make a riser of twice the height.
        end = far if far == borders[-1] else course.snap(far - 0.4)
        kind(course, x0 + near, x0 + end)
        course.full(x0 + end, x0 + far)
    return course.middle


def _riser(course: Course) -> float:
    return course.rng.uniform(*course.scale.step_height) * course.severity


def _flight(course: Course, x0: float, x1: float) -> None:
    """Lay steps up and down again, or down and up; where there are two lanes, they differ."""
    for y0, y1 in course.lanes():
        borders = course.cuts(x1 - x0, *course.scale.step_tread)
        treads = len(borders) - 1
        sign = course.rng.choice((1, -1), p=(0.7, 0.3))
        risers = np.array([_riser(course) for _ in range((treads + 1) // 2)])
        up = np.cumsum(risers)
        down = up[-1] - np.cumsum(course.rng.permutation(risers))[:-1]
        plateau = [up[-1]] * (treads % 2 == 0)
        levels = sign * np.concatenate((up, plateau, down))
        for near, far, top in zip(borders, borders[1:], levels, strict=False):
            course.block(x0 + near, x0 + far, y0, y1, float(top))


def _blocks(course: Course, x0: float, x1: float) -> None:
    """Lay a field of rectangular blocks of different heights, side by side."""
    course.full(x0, x1)
    columns = course.cuts(x1 - x0, *course.scale.step_tread)
    for near, far in pairwise(columns):
        rows = course.cuts(course.width, 0.6, 2.0)
        for low, high in pairwise(rows):
            course.block(x0 + near, x0 + far, low, high, _riser(course))


def _gaps(course: Course, x0: float, x1: float) -> float:
    """Cut slots over the full width, with platforms of random length between them."""
    course.full(x0, x1, -course.depth)
    width = course.breadth(course.scale.gap_width)
    widest = course.snap(max(course.scale.gap_width))
    shortest, longest = course.scale.platform
    longest = max(shortest, min(longest, (x1 - x0) / 2 - 0.5))  # two gaps in a short section too
    edges, slot = [x0], x0 + course.draw(0.2, 0.2 * (x1 - x0))
    for _ in range(5):
        if slot + widest > x1 - 0.2:
            break
        edges += [slot, slot + width]
        slot = slot + widest + course.draw(shortest, longest)
    edges.append(x1)
    lanes = [(0.0, course.width, 0.0)]
    if course.unlike:  # a slot is straight, or steps aside by a cell
        cut = course.snap(course.width * course.unlike.uniform(0.1, 0.9))
        lanes = [(0.0, cut, 0.0), (cut, course.width, course.scale.resolution)]
    for y0, y1, aside in lanes:
        bent = [x0, *(edge + aside for edge in edges[1:-1]), x1]
        for near, far in zip(bent[::2], bent[1::2], strict=True):
            course.block(near, far, y0, y1, 0.0)
    return course.middle


def _bridge(course: Course, x0: float, x1: float) -> float:
    """Lay a beam over a chasm."""
    course.full(x0, x1, -course.depth)
    breadth = course.breadth(course.scale.bridge_width)
    right = course.snap(course.middle + course.draw(-0.5, 0.5) - breadth / 2)
    course.block(x0, x1, right, right + breadth, 0.0)
    return right + breadth / 2


def _valley(course: Course, x0: float, x1: float) -> float:
    """Lean two walls against each other, the V's lowest line along the way at ground level."""
    angle = math.radians(course.at(course.scale.valley_angle))
    bottom = course.middle + course.draw(-0.4, 0.4)
    width = course.width
    foot = course.snap(course.scale.valley_height / math.tan(angle))
    left, right = min(foot, width - bottom), min(foot, bottom)
    course.ramp(x0, x1, bottom, bottom + left, 0.0, left * math.tan(angle), along="y")
    course.ramp(x0, x1, bottom - right, bottom, right * math.tan(angle), 0.0, along="y")
    course.block(x0, x1, bottom + left, width, left * math.tan(angle))
    course.block(x0, x1, 0.0, bottom - right, right * math.tan(angle))
    return bottom


def _slopes(course: Course, x0: float, x1: float) -> float:
    """Lay hills and dips: a ramp, a plateau (sometimes banked sideways), a ramp back."""
    borders = course.cuts(x1 - x0, 2.4, 3.4)
    for near, far in pairwise(borders):
        lanes = course.lanes()
        for y0, y1 in lanes:
            _hill(course, x0 + near, x0 + far, y0, y1, banked=len(lanes) == 1)
    return course.middle


def _hill(course: Course, x0: float, x1: float, y0: float, y1: float, *, banked: bool) -> None:
    rng, scale = course.rng, course.scale
    steepest = course.at(scale.slope_angle)
    slope_up, slope_down = np.tan(np.radians(steepest * rng.uniform(0.5, 1.0, 2)))
    plateau = rng.uniform(0.5, 1.0)
    wanted = rng.uniform(0.6, 1.0) * scale.slope_height
    height = min(wanted, (x1 - x0 - plateau) / (1 / slope_up + 1 / slope_down))
    # Rounded up to whole cells: a ramp may be a little flatter than drawn, never steeper.
    top0 = course.snap(x0 + height / slope_up + scale.resolution / 2)
    top1 = course.snap(x1 - height / slope_down - scale.resolution / 2)
    top = float(height * rng.choice((1, -1), p=(0.7, 0.3)))
    course.ramp(x0, top0, y0, y1, 0.0, top, along="x")
    course.ramp(top1, x1, y0, y1, top, 0.0, along="x")
    tilt = math.tan(math.radians(steepest * rng.uniform(0.15, 0.3))) * rng.choice((-1, 1))
    rise, flat = float(tilt * (y1 - y0) / 2), course.snap(0.2)
    if banked and rng.random() < scale.bank_share and top1 - top0 > 3 * flat:
        course.block(top0, top0 + flat, y0, y1, top)
        course.ramp(top0 + flat, top1 - flat, y0, y1, top - rise, top + rise, along="y")
        course.block(top1 - flat, top1, y0, y1, top)
    else:
        course.block(top0, top1, y0, y1, top)


def _stairs(course: Course, x0: float, x1: float) -> float:
    """Lay regular stairs up and down again."""
    course.full(x0, x1)
    borders = course.cuts(x1 - x0, 2.4, 4.0)
    for near, far in pairwise(borders):
        run = course.snap(course.scale.stair_run * course.rng.uniform(1.0, 1.4))
        rise = course.scale.stair_rise * course.rng.uniform(0.7, 1.0) * course.severity
        most = max(1, int((far - near - 0.5) / (2 * run)))
        count = int(course.rng.integers(max(1, most - 1), most + 1))
        slack = far - near - 0.4 - 2 * run * count
        left = x0 + near + course.draw(0.0, max(slack, 0.0))
        right = x0 + far - course.draw(0.0, max(x0 + far - left - 0.4 - 2 * run * count, 0.0))
        for step in range(count):
            course.full(left + step * run, right - step * run, (step + 1) * rise)
    return course.middle


def _rubble(course: Course, x0: float, x1: float) -> float:
    """Strew small blocks of random size and height."""
    course.full(x0, x1)
    width = course.width
    low, high = course.scale.rubble_size
    count = int(course.scale.rubble_density * (x1 - x0) * width / (0.5 * (low + high)) ** 2)
    for _ in range(count):
        length, breadth = course.draw(low, high), course.draw(low, high)
        # Blocks may begin before the border and are cut there, or the border would stay bare.
        x = course.draw(x0 - length, x1)
        y = course.draw(-breadth, width)
        top = course.rng.uniform(0.25, 1.0) * course.scale.rubble_height * course.severity
        course.block(max(x, x0), min(x + length, x1), max(y, 0.0), min(y + breadth, width), top)
    return course.middle


def _gentle(course: Course, x0: float, x1: float) -> float:
    """Lay low blocks along the way, and pits and walls beside it, seen but never stepped on."""
    columns = course.cuts(x1 - x0, 0.7, 1.4)
    for near, far in pairwise(columns):
        right = course.snap(course.middle - course.draw(0.45, 1.0))
        left = course.snap(course.middle + course.draw(0.45, 1.0))
        top = course.rng.uniform(0.0, 0.05) * course.severity
        course.block(x0 + near, x0 + far, right, left, top)
        for y0, y1 in ((0.0, right), (left, course.width)):
            beside = course.rng.choice((top, course.rng.uniform(0.0, 0.4), -0.4))
            course.block(x0 + near, x0 + far, y0, y1, float(beside))
    return course.middle


OBSTACLES: dict[str, Callable[[Course, float, float], float]] = {
    "flat": _flat,
    "gentle": _gentle,
    "steps": _steps,
    "gaps": _gaps,
    "bridge": _bridge,
    "valley": _valley,
    "slopes": _slopes,
    "stairs": _stairs,
    "rubble": _rubble,
}
"""Each lays its obstacle over the full width from x0 to x1 and returns the y of the way over it."""
SPREAD = {"gentle": 0.1, "bridge": 0.03, "valley": 0.05}
"""How far beside the way over an obstacle a robot may walk, m; over the others, anywhere."""
