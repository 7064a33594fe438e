"""Open ground: maps with several ways across, at any yaw, and tasks some of which are impossible.

Reads a seed; gives an `OpenGround`: a terrain of exact boxes, the cells over which its obstacles
can be crossed, and tasks on it. Rivers (chasms) and walls cut the map from border to border and
can be crossed only where an obstacle is let into them; no way leads to one place, an island. Which
cells are traversable follows from what was laid, never from what a policy says of it.
Source: the size follows Verti-Bench (arXiv 2502.11426), 100 maps and 1,000 tasks.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float
from scipy import ndimage

from fgtutor.errors import TerrainError
from fgtutor.io.validation import check_arguments
from fgtutor.robots import ROBOTS
from fgtutor.world.boxes import rasterise
from fgtutor.world.nist import CORNER_WIDTH, NIST, corner_lanes
from fgtutor.world.obstacles import OBSTACLES, Course
from fgtutor.world.terrain import Point, Terrain, TerrainSeed
from fgtutor.world.turned import trimmed, turned

Group = Literal["seen", "unseen"]
Rect = tuple[float, float, float, float]
"""A rectangle x0, x1, y0, y1 in the map's own frame, m: its origin is the map's middle, its x leads
across rivers and walls."""

SIDES = 12.0, 20.0
"""Shortest and longest side of a map, m."""
UNSEEN = ("stairs", "slopes", "rubble", *NIST)
"""Kinds of obstacles beyond those of the paper's specialists; without those of a robot's own."""
NARROW = {"bridge": 0.075, "valley": 0.075}
"""How far beside their middle these can be walked on, m; others up to `MARGIN` from their sides."""
MARGIN = 0.25
"""How far the robot's middle keeps from chasms and walls, m: half its width and a hand."""
DEPTH = 2.3, 3.0
"""Shortest and longest way over a river or a wall, m."""
WIDTH = 1.6, 3.0
"""Narrowest and widest obstacle that is let into one, m."""
WALL = 0.9
"""Height of a wall, m: six times the highest step in training, and too high from every obstacle."""
MOAT, RING, ISLAND = 1.0, 0.5, 1.6
"""Width of the chasm or of the wall round an island, and the island's side, m."""
BANK = 1.5
"""Least ground before and behind a river or wall, m."""
PATCH, NOISE, COLUMN = 2.4, 0.03, 0.1
"""Natural ground: side of a patch, standard deviation of its heights, and side of a column, m."""
CELL = 0.1
"""Side of a cell of `OpenGround.passable`, m."""
ROOM, LEAST = 0.6, 4.0
"""Least distance of starts and goals from what cannot be walked on, and from each other, m."""
IMPOSSIBLE = 5
"""Every so manieth task is impossible."""
TRIES = 50


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """An obstacle that is let into a river or a wall."""

    kind: str
    """A name of `OBSTACLES` or of `NIST`."""
    barrier: Literal["river", "wall"]
    """What it leads over."""
    area: Rect
    """Where it lies."""
    lanes: tuple[Rect, ...]
    """Where a robot can go on it; they reach beyond its ends."""


@dataclass(frozen=True, kw_only=True)
class OpenTask:
    """From here to there; or not, if nothing leads there."""

    start: Point
    goal: Point
    feasible: bool
    """Whether traversable cells join both."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenGround:
    """A map, what is known of it by construction, and tasks on it."""

    terrain: Terrain
    """Its boxes and heights; start and goal are the first task's."""
    group: Group
    """Whether its crossings are of kinds that specialists were trained on."""
    yaw: float
    """By how much the map's own frame is turned, rad."""
    crossings: tuple[Crossing, ...]
    """The ways over its rivers and walls."""
    passable: Bool[np.ndarray, "nx ny"]
    """Where the robot's middle can be, in cells of `CELL` m."""
    tasks: tuple[OpenTask, ...]
    """Every `IMPOSSIBLE`-th is impossible."""

    def crossing_near(self, place: Point) -> Crossing:
        """Return the crossing nearest to a place, m."""
        x, y = own_frame(np.array(place), self.yaw, self.terrain.elevation.size)
        return min(self.crossings, key=lambda one: float(away(one.area, x, y)))


def make_open_ground(
    seed: TerrainSeed,
    *,
    robot: str = "a1",
    group: Group = "seen",
    tasks: Annotated[int, Interval(ge=1, le=1000)] = 10,
) -> OpenGround:
    """Draw a map of 12 x 12 to 20 x 20 m and `tasks` tasks on it.

    With "unseen", all its crossings are of kinds never seen in training, and natural ground lies
    between them. Raises `TerrainError` for an unknown robot or a wrong seed.
    """
    check_arguments(make_open_ground, locals(), TerrainError)
    if robot not in ROBOTS:
        raise TerrainError(f"unknown robot {robot!r}: choose one of {', '.join(ROBOTS)}")
    rng = np.random.default_rng((seed, 23, group == "unseen"))
    for _ in range(TRIES):  # a layout may leave too little ground for its tasks
        layout = _Layout(robot, group, rng)
        layout.lay()
        passable = layout.passable()
        if drawn := layout.draw_tasks(passable, tasks):
            break
    else:
        raise TerrainError(f"seed {seed} gave no open ground in {TRIES} tries: choose another one")
    size, middle = layout.size, (layout.size[0] / 2, layout.size[1] / 2)
    boxes = trimmed(turned(layout.course.boxes, layout.yaw, (0.0, 0.0), middle), size)
    terrain = Terrain(
        name=group,
        robot=robot,
        difficulty=1.0,
        seed=seed,
        elevation=rasterise(boxes, size, layout.course.scale.resolution),
        boxes=tuple(boxes),
        start=drawn[0].start,
        goal=drawn[0].goal,
        lane=(drawn[0].start, drawn[0].goal),
    )
    return OpenGround(
        terrain=terrain,
        group=group,
        yaw=layout.yaw,
        crossings=tuple(layout.crossings),
        passable=passable,
        tasks=drawn,
    )


def own_frame(
    xy: Float[np.ndarray, "*n 2"], yaw: float, size: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y in a map's own frame of places on the map, m."""
    (x, y), cos, sin = np.moveaxis(xy - np.array(size) / 2, -1, 0), math.cos(yaw), math.sin(yaw)
    return cos * x + sin * y, cos * y - sin * x


def away(area: Rect, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return how far places are from a rectangle, m; 0 inside."""
    x0, x1, y0, y1 = area
    return np.hypot(x - np.clip(x, x0, x1), y - np.clip(y, y0, y1))


class _Layout:
    """A map under construction, in its own frame."""

    def __init__(self, robot: str, group: Group, rng: np.random.Generator) -> None:
        self.group, self.rng = group, rng
        self.course = Course(ROBOTS[robot].scale, 1.0, rng)
        self.size = self.course.draw(*SIDES), self.course.draw(*SIDES)
        self.yaw = float(rng.uniform(-math.pi, math.pi))
        self.reach = math.hypot(*self.size) / 2 + 0.5
        self.inside = min(self.size) / 2  # a circle that lies on the map at any yaw
        known = self.course.scale.mixed
        self.kinds = known if group == "seen" else [kind for kind in UNSEEN if kind not in known]
        self.crossings: list[Crossing] = []
        self.closed: list[Rect] = []
        self.island: Rect = (0.0, 0.0, 0.0, 0.0)

    def lay(self) -> None:
        """Lay rivers or walls, and the ground between them, with an island in the widest band."""
        rng, snap = self.rng, self.course.snap
        depths = [self.course.draw(*DEPTH) for _ in range(2 if self.inside > 7.0 else 1)]
        need = ISLAND + 2 * MOAT + BANK
        spare = 2 * self.inside - sum(depths) - need - BANK * len(depths)
        shares = rng.dirichlet(np.ones(len(depths) + 1)) * max(spare, 0.0)
        bands = BANK + shares
        with_island = int(rng.integers(len(bands)))
        bands[with_island] += need - BANK
        x, edges = -self.inside, []
        for band, depth in zip(bands, depths, strict=False):
            x0 = snap(x + band)
            x = x0 + depth
            edges += [x0, x]
            self._barrier(x0, x)
        edges = [-self.reach, *edges, self.reach]
        for index, (x0, x1) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            near, far = max(x0, -self.inside), min(x1, self.inside)
            things = [self._island(near, far)] if index == with_island else []
            if self.group == "unseen":
                things += self._natural(near, far, things)
            self._ground((x0, x1, -self.reach, self.reach), things)

    def _block(self, area: Rect, top: float) -> None:
        self.course.block(*area, top)

    def _barrier(self, x0: float, x1: float) -> None:
        """Lay a river or a wall from border to border, with one or two obstacles let into it."""
        rng, reach = self.rng, self.reach
        barrier = str(rng.choice(("river", "wall")))
        top = WALL if barrier == "wall" else -self.course.depth
        half = math.sqrt(max(self.inside**2 - max(abs(x0), abs(x1)) ** 2, 0.0)) - 0.3
        half = max(half, 0.5 * WIDTH[1])
        kinds = [str(kind) for kind in rng.permutation(list(self.kinds))[:2]]
        widths = [CORNER_WIDTH if kind == "corner" else self.course.draw(*WIDTH) for kind in kinds]
        if sum(widths) + 0.6 > 2 * half:
            kinds, widths = kinds[:1], widths[:1]
        spare = 2 * half - sum(widths) - 0.6 * (len(kinds) - 1)
        gaps = rng.dirichlet(np.ones(len(kinds) + 1)) * max(spare, 0.0)
        y, end = -half, -reach
        for kind, width, gap in zip(kinds, widths, gaps, strict=False):
            y0 = self.course.snap(y + gap)
            self._block((x0, x1, end, y0), top)
            self._let_in(kind, barrier, (x0, x1, y0, y0 + width))
            end = y0 + width
            y = end + 0.6
        self._block((x0, x1, end, reach), top)
        self.closed.append((x0, x1, -reach, reach))

    def _let_in(self, kind: str, barrier: str, area: Rect) -> None:
        """Lay an obstacle over the whole of a rectangle."""
        x0, x1, y0, y1 = area
        width = y1 - y0
        own = Course(replace(self.course.scale, width=width), 1.0, self.rng)
        way = (OBSTACLES | NIST)[kind](own, x0, x1)
        self.course.boxes += (box.shifted(0.0, y0) for box in own.boxes)
        if kind == "corner":
            lanes = corner_lanes(width, x0, x1, MARGIN)
        else:
            beside = NARROW.get(kind)
            low, high = (MARGIN, width - MARGIN) if beside is None else (way - beside, way + beside)
            lanes = [(x0 - 2 * MARGIN, x1 + 2 * MARGIN, low, high)]
        shifted = tuple((a, b, y0 + c, y0 + d) for a, b, c, d in lanes)
        self.crossings.append(Crossing(kind=kind, barrier=barrier, area=area, lanes=shifted))  # pyright: ignore[reportArgumentType]

    def _ground(self, area: Rect, things: Sequence[Rect]) -> None:
        """Lay level ground round rectangles, which lie in it one beside the other along y."""
        x0, x1, y0, y1 = area
        for left, right, low, high in sorted(things, key=lambda thing: thing[2]):
            self._block((x0, x1, y0, low), 0.0)
            self._block((x0, left, low, high), 0.0)
            self._block((right, x1, low, high), 0.0)
            y0 = high
        self._block((x0, x1, y0, y1), 0.0)

    def _island(self, near: float, far: float) -> Rect:
        """Lay a place to which no way leads, between two x; return what it takes up."""
        rng, snap = self.rng, self.course.snap
        chasm = rng.random() < 0.5
        beyond = MOAT if chasm else RING
        half = ISLAND / 2 + beyond
        x = snap(rng.uniform(near + half + 0.3, max(far - half - 0.3, near + half + 0.3)))
        room = math.sqrt(max((self.inside - ISLAND) ** 2 - x**2, 0.0))
        y = snap(rng.uniform(-room, room))
        outer = (x - half, x + half, y - half, y + half)
        self.island = (x - ISLAND / 2, x + ISLAND / 2, y - ISLAND / 2, y + ISLAND / 2)
        top = -self.course.depth if chasm else WALL
        (a, b, c, d), (left, right, low, high) = outer, self.island
        for ring in (
            (a, left, c, d),
            (right, b, c, d),
            (left, right, c, low),
            (left, right, high, d),
        ):
            self._block(ring, top)
        self._block(self.island, 0.0)
        self.closed.append(outer)
        return outer

    def _natural(self, near: float, far: float, things: Sequence[Rect]) -> list[Rect]:
        """Lay patches of natural ground beside what lies between two x; return where they lie."""
        snap, patches = self.course.snap, []
        side = min(PATCH, snap(far - near - 0.4) // COLUMN * COLUMN)
        if side < 1.0:
            return patches
        taken = [(low - 0.2, high + 0.2) for _, _, low, high in things]
        x = snap(self.rng.uniform(near + 0.2, far - 0.2 - side))
        for y in np.arange(-self.inside + 0.3, self.inside - side, side + 1.0):
            low = snap(float(y))
            if any(low < end and begin < low + side for begin, end in taken):
                continue
            patches.append((x, x + side, low, low + side))
            self._noise(x, low, round(side / COLUMN))
        return patches

    def _noise(self, x0: float, y0: float, count: int) -> None:
        """Lay columns whose heights are fractal noise, level at the border."""
        heights = np.zeros((count, count))
        for octave in range(3):
            white = self.rng.standard_normal((count, count))
            layer = ndimage.gaussian_filter(white, 4.0 / 2**octave, mode="wrap")
            heights += layer / layer.std() / 2**octave
        ramp = np.minimum(1.0, np.minimum(np.arange(count), np.arange(count)[::-1]) / 4)
        heights *= NOISE / heights.std() * ramp * ramp[:, None]
        for (i, j), top in np.ndenumerate(heights):
            x, y = x0 + i * COLUMN, y0 + j * COLUMN
            self._block((x, x + COLUMN, y, y + COLUMN), float(top))

    def _cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y of every cell of `passable`, [nx, ny], in the own frame."""
        shape = [round(side / CELL) for side in self.size]
        xy = np.stack(np.meshgrid(*((np.arange(n) + 0.5) * CELL for n in shape), indexing="ij"), -1)
        return own_frame(xy, self.yaw, self.size)

    def passable(self) -> Bool[np.ndarray, "nx ny"]:
        """Return where the robot's middle can be."""
        x, y = self._cells()
        free = np.ones(x.shape, dtype=bool)
        for area in self.closed:
            free &= away(area, x, y) > MARGIN
        for lane in (lane for crossing in self.crossings for lane in crossing.lanes):
            # A way of 15 cm at any yaw must not fall between the cells.
            free |= away(lane, x, y) <= CELL / 4
        x0, x1, y0, y1 = self.island
        return free | (away((x0 + MARGIN, x1 - MARGIN, y0 + MARGIN, y1 - MARGIN), x, y) == 0)

    def draw_tasks(
        self, passable: Bool[np.ndarray, "nx ny"], count: int
    ) -> tuple[OpenTask, ...] | None:
        """Draw tasks, or return None if there is too little ground for them."""
        x, y = self._cells()
        places = np.zeros(x.shape, dtype=int)
        ndimage.label(passable, np.ones((3, 3)), output=places)
        roomy = np.asarray(ndimage.distance_transform_edt(np.pad(passable, 1)))[1:-1, 1:-1]
        roomy = roomy * CELL >= ROOM
        for crossing in self.crossings:  # nor on an obstacle
            roomy &= away(crossing.area, x, y) > ROOM
        islands = away(self.island, x, y) == 0
        x0, x1, y0, y1 = self.island
        on_island = np.argwhere(np.hypot(x - (x0 + x1) / 2, y - (y0 + y1) / 2) < ISLAND / 4)
        main = int(np.argmax(np.bincount(places[roomy & ~islands], minlength=2)[1:])) + 1
        ashore = np.argwhere(roomy & ~islands & (places == main))
        if len(on_island) == 0 or len(ashore) < 100:
            return None
        bands = np.searchsorted(sorted(c.area[0] for c in self.crossings), x)
        tasks = []
        for index in range(count):
            feasible = index % IMPOSSIBLE != IMPOSSIBLE - 1
            for _ in range(1000):
                a = self.rng.choice(ashore)
                b = self.rng.choice(ashore if feasible else on_island)
                far = math.hypot(*(a - b)) * CELL >= LEAST
                if far and (not feasible or index % 4 == 3 or bands[tuple(a)] != bands[tuple(b)]):
                    break
            else:
                return None
            ends = [tuple(((cell + 0.5) * CELL).tolist()) for cell in (a, b)]
            if not feasible and self.rng.random() < 0.5:
                ends.reverse()
            tasks.append(OpenTask(start=ends[0], goal=ends[1], feasible=feasible))
        return tuple(tasks)
