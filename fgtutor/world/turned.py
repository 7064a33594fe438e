"""Obstacles at any angle: boxes turned about a point, kept to a map, and one obstacle laid so.

Reads a kind of obstacle, where it lies and its yaw; gives its boxes and the way over it, for
`make_turned` (one obstacle, which spans the map) and for whoever lays several on one map.
The obstacles are those of `obstacles`, with the paper's geometry (Sec. IV-A).
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Annotated

import numpy as np
from annotated_types import Interval

from fgtutor.errors import TerrainError
from fgtutor.io.validation import Share, check_arguments
from fgtutor.robots import ROBOTS
from fgtutor.world.boxes import Box, rasterise
from fgtutor.world.obstacles import OBSTACLES, Course, TerrainScale
from fgtutor.world.terrain import TERRAINS, Point, Terrain, TerrainSeed

Degrees = Annotated[float, Interval(ge=-360, le=360)]
"""An angle, degrees counter-clockwise from +x."""
OVERHANG = 0.25
"""How far a box may reach beyond its map, m; less than the margin that a `World` lays around it."""


def turned(boxes: Iterable[Box], yaw: float, about: Point, to: Point | None = None) -> list[Box]:
    """Return boxes turned by `yaw` (rad, counter-clockwise) about a point, which then lies at `to`.

    Edges stay exact: a turned box is a box.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    to = to or about
    out = []
    for box in boxes:
        (x, y, z), (roll, pitch, own) = box.centre, box.rpy
        dx, dy = x - about[0], y - about[1]
        centre = (to[0] + cos * dx - sin * dy, to[1] + sin * dx + cos * dy, z)
        out.append(Box(centre=centre, size=box.size, rpy=(roll, pitch, own + yaw)))
    return out


def trimmed(boxes: Iterable[Box], size: tuple[float, float]) -> list[Box]:
    """Return the part of boxes that lies on a map from (0, 0) to `size`, m.

    A box that reaches beyond is cut into smaller ones, and those beside the map are left out. Boxes
    of half `OVERHANG` are cut no further, so the map's edge is ragged, the ground on it exact.
    """
    return [part for box in boxes for part in _trimmed(box, size)]


def _trimmed(box: Box, size: tuple[float, float]) -> Iterator[Box]:
    rotation = box.rotation
    reach = (np.abs(rotation) @ (0.5 * np.array(box.size)))[:2]
    low, high = box.centre[:2] - reach, box.centre[:2] + reach
    if (high <= 0).any() or (low >= size).any():
        return
    inside = (low >= -OVERHANG).all() and (high <= np.add(size, OVERHANG)).all()
    axis = int(np.argmax(box.size[:2]))
    if inside or box.size[axis] <= OVERHANG / 2:
        yield box
        return
    half = box.size[axis] / 2
    length, width, height = box.size
    part = (half, width, height) if axis == 0 else (length, half, height)
    for side in (-half / 2, half / 2):
        x, y, z = (box.centre + side * rotation[:, axis]).tolist()
        yield from _trimmed(Box(centre=(x, y, z), size=part, rpy=box.rpy), size)


def lay_turned(
    kind: str, course: Course, length: float, centre: Point, yaw: float
) -> tuple[list[Box], tuple[Point, Point]]:
    """Lay an obstacle of `length` (m) along its own axis, which points along `yaw` (rad).

    It is as wide as the course, whose rng draws it, and lies with its middle at `centre` (m); the
    course's own boxes stay as they are. Returns its boxes, and where the way over it begins and
    ends. The ground around it is the caller's: a chasm is a hole only where there is no other box.
    """
    own = Course(course.scale, course.difficulty, course.rng)
    y = OBSTACLES[kind](own, 0.0, length)
    middle = (length / 2, own.width / 2)
    cos, sin = math.cos(yaw), math.sin(yaw)

    def place(along: float) -> Point:
        dx, dy = along - middle[0], y - middle[1]
        return centre[0] + cos * dx - sin * dy, centre[1] + sin * dx + cos * dy

    return turned(own.boxes, yaw, middle, centre), (place(0.0), place(length))


def make_turned(
    kind: str,
    *,
    robot: str = "a1",
    angle: Degrees = 0.0,
    difficulty: Share = 1.0,
    seed: TerrainSeed = 0,
    scale: TerrainScale | None = None,
) -> Terrain:
    """Make a square map which one obstacle crosses from border to border, turned about its centre.

    The square's side is the length of `make_terrain`'s corridor. At an angle of 0 degrees the way
    leads along +x, as there; start and goal lie on the axis through the centre, as far apart as
    there. No way leads round the obstacle: its chasm, walls, slots or treads end at the borders.
    `lane` is the shortest way: straight to where the beam or the valley begins, along its middle,
    straight on to the goal; over others, which may be crossed anywhere, the straight line.

    Raises:
        TerrainError: A name is unknown, a number is out of range, or the map has no room.
    """
    check_arguments(make_turned, locals(), TerrainError)
    if kind not in OBSTACLES:
        raise TerrainError(f"unknown obstacle {kind!r}: choose one of {', '.join(OBSTACLES)}")
    if robot not in ROBOTS:
        raise TerrainError(f"unknown robot {robot!r}: choose one of {', '.join(ROBOTS)}")
    scale = scale or ROBOTS[robot].scale
    room = scale.length - 2 * scale.apron
    if room < 1.0:
        raise TerrainError(
            f"a map of {scale.length:g} m has no room for an obstacle between two aprons of "
            f"{scale.apron:g} m: choose a length with at least 1 m to spare"
        )
    rng = np.random.default_rng((seed, TERRAINS.index(kind)))
    # From border to border at any angle, however far beside the centre it lies.
    course = Course(replace(scale, width=2 * scale.length), difficulty, rng)
    side, length = course.snap(scale.length), course.snap(min(room, scale.longest(kind)))
    begin = course.snap(scale.apron + rng.uniform(0.0, room - length)) - side / 2
    yaw, middle = math.radians(angle), (side / 2, side / 2)

    def on_axis(along: float) -> Point:
        return middle[0] + along * math.cos(yaw), middle[1] + along * math.sin(yaw)

    boxes, way = lay_turned(kind, course, length, on_axis(begin + length / 2), yaw)
    course.full(-side, begin + side / 2)
    course.full(begin + length + side / 2, 2 * side)
    boxes += turned(course.boxes, yaw, (side / 2, course.width / 2), middle)
    boxes = trimmed(boxes, (side, side))
    half = (side - scale.apron) / 2
    start, goal = on_axis(-half), on_axis(half)
    return Terrain(
        name=kind,
        robot=robot,
        difficulty=difficulty,
        seed=seed,
        elevation=rasterise(boxes, (side, side), scale.resolution),
        boxes=tuple(boxes),
        start=start,
        goal=goal,
        lane=(start, *(way if kind in ("bridge", "valley") else ()), goal),
    )
