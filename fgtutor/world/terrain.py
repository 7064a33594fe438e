"""Terrains: boxes, and the elevation map they rasterise to, with a start, a goal and a way between.

Reads a name, a robot, a difficulty in [0, 1] and a seed; gives a `Terrain`, or a `World` of many.
The boxes are authored first, because physics wants exact edges; the map is what they look like from
above. Kinds: the paper's steps, gaps, bridge and valley (Sec. IV-A), and slopes, stairs, rubble.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Interval
from jaxtyping import Float

from fgtutor.elevation import ElevationMap
from fgtutor.errors import TerrainError
from fgtutor.io.validation import Share, check_arguments, check_fields
from fgtutor.robots import ROBOTS
from fgtutor.world.boxes import Box, boxes_from_elevation, rasterise
from fgtutor.world.obstacles import OBSTACLES, SPREAD, Course, Resolution, TerrainScale

Point = tuple[float, float]
TerrainSeed = Annotated[int, Interval(ge=0, lt=2**63)]
"""What a layout is drawn from: odd ones where terrain is evaluated, even ones in training."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """The rectangle in which one kind of obstacle lies."""

    name: str
    """The kind of obstacle, one of `TERRAINS`."""
    x0: float
    """Where it begins along the way, m."""
    y0: float
    """Its right-hand border, m."""
    x1: float
    """Where it ends along the way, m."""
    y1: float
    """Its left-hand border, m."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """One piece of ground: what physics stands on, what the planner sees, and a task on it."""

    name: str
    """The kind of terrain, one of `TERRAINS`, or "map" for one from a file."""
    robot: str
    """The robot whose size it is made for."""
    difficulty: float
    """From 0 (almost flat) to 1 (the paper's geometry)."""
    seed: int
    """What the random layout was drawn from."""
    elevation: ElevationMap
    """The heights that the boxes rasterise to."""
    boxes: tuple[Box, ...]
    """The ground and everything on it."""
    start: Point
    """Where an episode begins, m."""
    goal: Point
    """Where it should end, m."""
    sections: tuple[Section, ...] = ()
    """Which obstacle lies where."""
    lane: tuple[Point, ...] = ()
    """A way from start to goal that the terrain was made for: over the beam, along the valley."""
    limits: tuple[float, float] | None = None
    """Between which x that way lies, m, if neighbours lie beyond; None is the whole length."""

    @property
    def spread(self) -> float:
        """How far beside the lane a robot may walk, m."""
        anywhere = 0.3 * self.elevation.size[1]
        mine = SPREAD.get(self.name, anywhere)
        return min((SPREAD.get(part.name, anywhere) for part in self._own), default=mine)

    @property
    def span(self) -> tuple[float, float]:
        """Between which x its obstacles lie, m; from start to goal where there is none."""
        edges = [x for part in self._own for x in (part.x0, part.x1)]
        return min(edges, default=self.start[0]), max(edges, default=self.goal[0])

    @property
    def _own(self) -> list[Section]:
        """Its sections without the neighbours'."""
        x0, x1 = self.limits or (0.0, self.elevation.size[0])
        return [part for part in self.sections if x0 <= part.x0 and part.x1 <= x1]

    @classmethod
    def from_elevation(
        cls, elevation: ElevationMap, start: Point, goal: Point, *, robot: str = "toy"
    ) -> Self:
        """Return a terrain for a map that came from elsewhere; it has no boxes.

        Raises:
            OffMapError: The start or the goal lies off the map.
        """
        for point in (start, goal):
            elevation.cell_of(*point)
        return cls(
            name="map",
            robot=robot,
            difficulty=1.0,
            seed=0,
            elevation=elevation,
            boxes=(),
            start=start,
            goal=goal,
            lane=(start, goal),
        )


TERRAINS = (*OBSTACLES, "mixed")
"""The names that `make_terrain` knows."""


def make_terrain(
    name: str,
    *,
    robot: str = "toy",
    difficulty: Share = 1.0,
    seed: TerrainSeed = 0,
    resolution: Resolution | None = None,
    scale: TerrainScale | None = None,
    neighbours: bool = False,
    unlike: bool = False,
) -> Terrain:
    """Make a corridor along x: flat ground, the obstacle over the full width, flat ground.

    The seed fixes the layout (order, number, places, proportions); the difficulty only stretches
    it, so that the same seed at a higher difficulty is the same place, harder.

    Args:
        name: One of `TERRAINS`.
        robot: Whose scale to use, one of `robots.ROBOTS`.
        difficulty: From 0 (almost flat) to 1 (the full size in the scale).
        seed: Any integer from 0 that has 63 bits.
        resolution: Side of a cell, m; default: the scale's.
        scale: Sizes to use instead of the robot's preset.
        neighbours: Lay other obstacles of the mixed terrain at both ends, a landing away. For
            training: the way goes from landing to landing, and sees what a mixed route shows.
        unlike: Lay an obstacle that no seed gives without it, so that its map equals none of any
            training. Beams and valleys are longer than the scale's by 1 to 6 cells, and slots step
            aside by a cell; other kinds have heights that two seeds share with probability 0, and
            so has the mixed terrain, by its steps. Flat ground is flat.

    Raises:
        TerrainError: A name is unknown, a number is out of range, or the mixed terrain has no
            neighbours for this obstacle.
    """
    check_arguments(make_terrain, locals(), TerrainError)
    if name not in TERRAINS:
        raise TerrainError(f"unknown terrain {name!r}: choose one of {', '.join(TERRAINS)}")
    if robot not in ROBOTS:
        raise TerrainError(f"unknown robot {robot!r}: choose one of {', '.join(ROBOTS)}")
    scale = scale or ROBOTS[robot].scale
    if resolution is not None:
        scale = replace(scale, resolution=resolution)
    rng = np.random.default_rng((seed, TERRAINS.index(name)))
    other = None
    if unlike and name != "mixed":
        other = np.random.default_rng((seed, TERRAINS.index(name), 1))
    course = Course(scale, difficulty, rng, other)
    sections: list[Section] = []
    lane: list[Point] = []
    apron, width = course.snap(scale.apron), course.snap(scale.width)
    plan = _plan_between(course, name) if neighbours else _plan(course, name, apron)
    x = 0.0
    for kind, x0, x1 in plan:
        y = OBSTACLES[kind](course, x0, x1)
        course.full(x, x0)
        x = x1
        sections.append(Section(name=kind, x0=x0, y0=0.0, x1=x1, y1=width))
        if kind == name or name == "mixed":
            # Straight before and after the obstacle: a robot must not step onto a beam at an angle.
            lane += [(x0 - 0.3, y), (x1 + 0.3, y)]
    length = course.snap(x + apron if name == "mixed" else scale.length)
    course.full(x, length)
    start, goal = (apron / 2, course.middle), (length - apron / 2, course.middle)
    limits = None
    if neighbours:
        (_, x0, x1), (_, y) = plan[1], lane[0]
        landing = scale.mixed_landing
        # To where no foot touches a neighbour; from where none does at rest, askew or not.
        start, goal = (x0 - 0.6 * landing, y), (x1 + 0.6 * landing, y)
        limits = (x0 - 0.7 * landing, x1 + 0.7 * landing)
    return finish_course(
        course,
        name=name,
        robot=robot,
        seed=seed,
        length=length,
        start=start,
        goal=goal,
        sections=sections,
        lane=lane,
        limits=limits,
    )


def finish_course(
    course: Course,
    *,
    length: float,
    start: Point,
    goal: Point,
    sections: Sequence[Section],
    lane: Sequence[Point] = (),
    **fields: Any,
) -> Terrain:
    """Return the terrain that a course of `length` (m) makes, with the map of its boxes.

    The lane leads from the start over the points given to the goal; `fields` are the terrain's own.
    """
    return Terrain(
        difficulty=course.difficulty,
        elevation=rasterise(course.boxes, (length, course.width), course.scale.resolution),
        boxes=tuple(course.boxes),
        start=start,
        goal=goal,
        sections=tuple(sections),
        lane=(start, *lane, goal),
        **fields,
    )


def _plan(course: Course, name: str, apron: float) -> list[tuple[str, float, float]]:
    """Return which obstacle lies from where to where."""
    scale, rng = course.scale, course.rng
    if name != "mixed":
        room = scale.length - 2 * apron
        if room < 1.0:
            raise TerrainError(
                f"a terrain of {scale.length:g} m has no room for an obstacle between two aprons "
                f"of {apron:g} m: choose a length with at least 1 m to spare"
            )
        length = min(room, scale.longest(name))
        x0 = course.snap(apron + rng.uniform(0.0, room - length))
        if course.unlike and length < room:
            length += scale.resolution * int(course.unlike.integers(1, 7))
        return [(name, x0, course.snap(x0 + length))]
    # Lengths vary, their sum does not: all mixed terrains of a robot have the same size.
    shares = rng.uniform(-0.4, 0.4, len(scale.mixed))
    lengths = [course.snap(scale.mixed_section + share) for share in shares - shares.mean()]
    lengths[-1] += course.snap(scale.mixed_section * len(lengths)) - sum(lengths)
    plan, x = [], apron
    for kind, length in zip(rng.permutation(scale.mixed), lengths, strict=True):
        plan.append((str(kind), course.snap(x), course.snap(x + length)))
        x += length + scale.mixed_landing
    return plan


def _plan_between(course: Course, name: str) -> list[tuple[str, float, float]]:
    """Return where the obstacle lies, and where its neighbours before and after it."""
    scale, rng = course.scale, course.rng
    others = [kind for kind in scale.mixed if kind != name]
    landing = course.snap(scale.mixed_landing)
    room = scale.length - 4 * landing  # a neighbour is at least as long as a landing
    if name not in scale.mixed or not others or room < 1.0:
        raise TerrainError(
            f"no neighbours for {name!r}: it must be one of {', '.join(scale.mixed)}, not the only "
            f"one, and a terrain of {scale.length:g} m must have 1 m besides 4 landings"
        )
    length = course.snap(min(rng.uniform(0.75, 1.0) * room, scale.longest(name)))
    x0 = course.snap(2 * landing + rng.uniform(0.0, room - length))
    x1 = course.snap(x0 + length)
    before, after = (str(kind) for kind in rng.choice(others, 2))
    return [
        (before, 0.0, course.snap(x0 - landing)),
        (name, x0, x1),
        (after, course.snap(x1 + landing), course.snap(scale.length)),
    ]


@dataclass(frozen=True, eq=False)
class World:
    """Rows (along y) and columns (along x) of equally large terrains on one map, for training.

    Every terrain gets a margin at the height of its edge, so that a patch near the edge reads what
    it reads on the terrain's own map, where the edge cell continues.

    Raises:
        TerrainError: There is no terrain, the rows differ in length, or the terrains in size.
    """

    tiles: Sequence[Sequence[Terrain]]
    """The terrains, [row][column]."""
    margin: Annotated[float, Interval(ge=0, le=50)] = 1.5
    """Width of the margin around each terrain, m; rounded to whole cells."""

    def __post_init__(self) -> None:
        check_fields(self, TerrainError)
        if not self.tiles or len({len(row) for row in self.tiles}) != 1 or not self.tiles[0]:
            raise TerrainError("a World needs rows of terrains, at least one, all equally long")
        kinds = {(tile.elevation.shape, tile.elevation.resolution) for tile in self._flat}
        if len(kinds) != 1:
            raise TerrainError(f"the terrains of a World must share shape and resolution: {kinds}")

    @property
    def _flat(self) -> list[Terrain]:
        return [tile for row in self.tiles for tile in row]

    @property
    def _cells(self) -> int:
        return round(self.margin / self.tiles[0][0].elevation.resolution)

    @cached_property
    def offset(self) -> Float[np.ndarray, "rows columns 2"]:
        """Where each terrain's corner (0, 0) lies in the world, m."""
        rows, columns = len(self.tiles), len(self.tiles[0])
        first = self.tiles[0][0].elevation
        pitch = np.array(first.shape) + 2 * self._cells
        indices = np.stack(np.meshgrid(range(columns), range(rows)), axis=-1)
        return (indices * pitch + self._cells) * first.resolution

    @cached_property
    def elevation(self) -> ElevationMap:
        """The map of the whole world; its corner is (0, 0)."""
        return self.lay()

    def lay(self, change: Callable[[ElevationMap], ElevationMap] | None = None) -> ElevationMap:
        """Return the world's map with `change` made to each terrain's map before it is laid.

        `lay(patches.prepare)` levels holes as on the single maps, blind to the neighbours.
        """
        maps = [[change(t.elevation) if change else t.elevation for t in row] for row in self.tiles]
        # Columns go along x, the first index, and rows along y.
        heights = [
            np.concatenate([np.pad(m.heights, self._cells, mode="edge") for m in row])
            for row in maps
        ]
        return ElevationMap(np.concatenate(heights, axis=1), resolution=maps[0][0].resolution)

    @cached_property
    def boxes(self) -> tuple[Box, ...]:
        """The boxes of all terrains, and those that the margins consist of."""
        boxes: list[Box] = []
        n = self._cells
        for tile, (dx, dy) in zip(self._flat, self.offset.reshape(-1, 2).tolist(), strict=True):
            ground = tile.elevation.filled()
            step = ground.resolution
            padded = ElevationMap(
                np.pad(ground.heights, n, mode="edge"), step, (-n * step, -n * step)
            )
            margin = np.ones(padded.shape, dtype=bool)
            margin[n : n + ground.shape[0], n : n + ground.shape[1]] = False
            inside = tile.boxes or boxes_from_elevation(ground)
            boxes += [
                box.shifted(dx, dy) for box in (*inside, *boxes_from_elevation(padded, margin))
            ]
        return tuple(boxes)
