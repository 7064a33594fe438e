"""Pictures of the slides that show a map: a patch, a search and a scan.

Reads maps, F_max [nx, ny, d], scans and the values of the sliders; gives a picture whose `alt` says
in one sentence what came out. What every value of a slider needs is computed once. Nothing here
knows the notebook. Source: paper, Secs. III-B and III-C, and Sec. IV-C for the scan.
"""

import math
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import ArrayLike
from scipy.sparse import csgraph, csr_array

from fgtutor.course.patch_pictures import patch_at
from fgtutor.course.widgets.panels import VIRIDIS, Point
from fgtutor.course.widgets.slide_curves import WIDTH, name_panel, sheet
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.panels import UNKNOWN
from fgtutor.figures.relief import GROUND, relief
from fgtutor.figures.style import INK, LINES, Picture
from fgtutor.graphs import step_cost, steps_of
from fgtutor.patches import PatchGrid
from fgtutor.robots.lidar import LidarConfig, scan_terrain
from fgtutor.world.scanning import ScanConfig, map_points
from fgtutor.world.terrain import Terrain

TALLEST = 4.6
"""Greatest height of a map on a slide, inches."""


# A pose and its patch -----------------------------------------------------------------------------


def draw_pose(elevation: ElevationMap, grid: PatchGrid, x: float, y: float, yaw: float) -> Picture:
    """Draw a pose (x and y in m, yaw in degrees) on the map, and beside it the patch seen there."""
    turn = math.radians(yaw)
    heights = patch_at(elevation, (x, y, turn), grid).numpy()
    tall = map_height(elevation, TALLEST, 0.6 * (WIDTH - 0.75) - 0.35)
    picture, (left, right) = sheet(max(tall, 2.9), columns=2, widths=(1.5, 1))
    show_map(left, elevation)
    half = grid.spacing / 2
    (x0, y0), (x1, y1) = (end.tolist() for end in (grid.points.amin(0), grid.points.amax(0)))
    corners = np.array(
        [(u, v) for u, v in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    ) + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    cos, sin = math.cos(turn), math.sin(turn)
    world = corners @ np.array(((cos, sin), (-sin, cos))) + (x, y)
    left.add_patch(Polygon(world, fill=False, edgecolor=LINES[1], linewidth=2))
    left.annotate("", (x + 0.8 * x1 * cos, y + 0.8 * x1 * sin), (x, y), arrowprops={
        "arrowstyle": "->", "color": LINES[1], "linewidth": 2})  # fmt: skip
    name_panel(left, f"({x:.2f}, {y:.2f}) m, yaw {yaw:.0f}°", "x (m)", "y (m)")
    reach = max(0.1, float(np.ptp(elevation.heights[elevation.known], axis=None)))
    right.imshow(
        heights.reshape(grid.shape).T,
        cmap=GROUND,
        norm=Normalize(-reach, reach),
        origin="lower",
        extent=(x0 - half, x1 + half, y0 - half, y1 + half),
    )
    length, width = grid.footprint
    right.add_patch(Rectangle((-length, -width), 2 * length, 2 * width, fill=False, edgecolor=INK))
    right.plot((0, length), (0, 0), color=INK)
    low, high = float(heights.min()), float(heights.max())
    name_panel(right, f"Patch: {low:+.2f} to {high:+.2f} m", "ahead (m)", "to the left (m)")
    where = grid.points[int(np.abs(heights).argmax())].tolist()
    picture.alt = (
        f"At ({x:.2f}, {y:.2f}) m, yaw {yaw:.0f} degrees: the patch holds heights from {low:+.2f} "
        f"to {high:+.2f} m; what stands out most lies {where[0]:+.2f} m ahead, {where[1]:+.2f} m "
        "to the left"
    )
    return picture


# Dijkstra's search --------------------------------------------------------------------------------


class Frontier:
    """A search from a start to a goal, stopped after any number of cells.

    Dijkstra settles cells in the order of their cost from the start; A* in the order of that plus
    the straight line to the goal, which never exceeds the cost still to come: F is at most 1 and a
    step costs its metres over F.
    """

    def __init__(
        self,
        elevation: ElevationMap,
        fused: ArrayLike,
        start: Point,
        goal: Point,
        *,
        f_min: float = 0.1,
    ) -> None:
        """Search the whole map once.

        Args:
            elevation: The map.
            fused: F_max [nx, ny, d].
            start: Start (x, y), m.
            goal: Goal (x, y), m.
            f_min: Steps with a lower F do not exist.

        Raises:
            ConfigError: `fused` does not belong to the map, or no route leads to the goal.
            OffMapError: Start or goal is off the map.
        """
        self.elevation, F = elevation, np.asarray(fused, dtype=float)
        if F.ndim != 3 or F.shape[:2] != elevation.shape:
            raise ConfigError(f"F_max has shape {F.shape}, the map {elevation.shape} cells")
        self.best, self.f_min = F.max(axis=-1), f_min
        cells = np.arange(self.best.size).reshape(elevation.shape)
        headings, tails, heads, costs = Headings.of(F), [], [], []
        for heading, tail, head in steps_of(elevation.shape, headings):
            leaving = F[(*tail, heading)]
            there = (leaving >= f_min) & elevation.known[tail] & elevation.known[head]
            tails.append(cells[tail][there])
            heads.append(cells[head][there])
            costs.append(
                step_cost(leaving[there], headings, heading, "length", elevation.resolution)
            )
        self._tail, self._head = np.concatenate(tails), np.concatenate(heads)
        graph = csr_array(
            (np.concatenate(costs), (self._tail, self._head)), shape=(cells.size, cells.size)
        )
        ends = [int(cells[elevation.cell_of(*point)]) for point in (start, goal)]
        self.start, self.goal = ends
        cost, self._before = csgraph.dijkstra(graph, indices=ends[0], return_predecessors=True)
        self.cost: Float[np.ndarray, " cells"] = cost
        """Cost of the cheapest way from the start to each cell; inf if there is none."""
        if not np.isfinite(cost[self.goal]):
            raise ConfigError(
                f"no chain of steps with F >= {f_min:g} leads from {start} to {goal}: choose other "
                "ends, or a lower f_min"
            )

    @cached_property
    def orders(self) -> dict[str, Int[np.ndarray, " cells"]]:
        """The cells in the order in which each search settles them, until the goal."""
        x, y = np.meshgrid(*self.elevation.centres, indexing="ij")
        straight = np.hypot(x - x.flat[self.goal], y - y.flat[self.goal]).ravel()
        orders = {}
        for name, still in (("Dijkstra", 0.0), ("A*", straight)):
            order = np.lexsort((self.cost, self.cost + still))  # of two alike the nearer one first
            orders[name] = order[: int(np.flatnonzero(order == self.goal)[0]) + 1]
        return orders

    def stopped(
        self, search: str, count: int
    ) -> tuple[Bool[np.ndarray, " cells"], Bool[np.ndarray, " cells"]]:
        """Return which cells are settled after `count` of them, and which lie on the frontier."""
        settled = np.zeros(self.best.size, dtype=bool)
        settled[self.orders[search][:count]] = True
        frontier = np.zeros_like(settled)
        frontier[self._head[settled[self._tail]]] = True
        return settled, frontier & ~settled

    def path_to(self, cell: int) -> Float[np.ndarray, "n 2"]:
        """Return the cheapest way from the start to a cell, m."""
        path = [cell]
        while path[-1] != self.start:
            path.append(int(self._before[path[-1]]))
        ix, iy = np.unravel_index(path[::-1], self.best.shape)
        x, y = self.elevation.centres
        return np.stack((x[ix], y[iy]), axis=-1)

    def draw(self, search: str, share: float) -> Picture:
        """Draw the search after a share (%) of the cells that it settles until the goal."""
        order, shape = self.orders[search], self.best.shape
        count = max(1, round(share / 100 * len(order)))
        settled, frontier = self.stopped(search, count)
        closed = self.best < self.f_min
        colours = np.full((*shape, 3), 0.93)
        colours[closed] = 0.35
        colours[~self.elevation.known] = to_rgb(UNKNOWN)
        scale = self.cost[self.goal]
        seen = settled.reshape(shape)
        colours[seen] = VIRIDIS(self.cost.reshape(shape)[seen] / scale)[:, :3]
        colours[frontier.reshape(shape)] = (0.84, 0.37, 0.0)
        picture, (axes,) = sheet(map_height(self.elevation))
        show_cells(axes, self.elevation, colours)
        last = int(order[count - 1])
        way = self.path_to(last)
        axes.plot(*way.T, color="white", linewidth=4)
        axes.plot(*way.T, color=INK, linewidth=1.8)
        x, y = self.elevation.centres
        for cell, marker, size in ((self.start, "o", 8), (self.goal, "*", 14)):
            ix, iy = np.unravel_index(cell, shape)
            axes.plot(x[ix], y[iy], marker, color="white", markeredgecolor="black", markersize=size)
        title = f"{search}: {count:,} cells settled, {int(frontier.sum()):,} on the frontier"
        name_panel(axes, title, "x (m); settled: dark near, bright far; orange: frontier", "y (m)")
        known = int(np.isfinite(self.cost).sum())
        done = f"the goal is settled, cost {scale:.2f}" if last == self.goal else "still searching"
        picture.alt = (
            f"{search}: {count:,} of {known:,} reachable cells settled, the last at cost "
            f"{self.cost[last]:.2f}; {done}"
        )
        return picture


# A scan -------------------------------------------------------------------------------------------


class Survey:
    """A terrain scanned from one pose after the other."""

    def __init__(
        self,
        terrain: Terrain,
        poses: Float[np.ndarray, "poses 6"],
        *,
        config: LidarConfig | None = None,
        seed: int = 0,
    ) -> None:
        """Scan from every pose; raises what `scan_terrain` raises."""
        self.terrain, self.poses = terrain, np.asarray(poses, dtype=float)
        self.clouds = [
            scan_terrain(terrain, poses=pose[None], seed=seed + i, config=config)
            for i, pose in enumerate(self.poses)
        ]
        """The points of each pose."""
        self.settings = ScanConfig(resolution=terrain.elevation.resolution, neighbours=0)
        self.mapped = lru_cache(maxsize=None)(self._mapped)
        """The map after some poses."""

    def _mapped(self, count: int) -> ElevationMap:
        points = np.concatenate(self.clouds[:count])
        area = self.terrain.elevation.extent
        return map_points(points, config=self.settings, area=area).elevation

    def draw(self, count: int) -> Picture:
        """Draw the map after `count` poses: grey cells were not seen yet."""
        elevation = self.mapped(count)
        picture, (axes,) = sheet(map_height(elevation))
        show_map(axes, elevation)
        axes.plot(*self.poses[:count, :2].T, "x", color=LINES[1], markersize=8, markeredgewidth=2)
        known = float(elevation.known.mean())
        points = sum(map(len, self.clouds[:count]))
        name_panel(
            axes,
            f"{count} poses, {points:,} points: {known:.0%} of the cells known",
            "x (m); crosses: the sensor; hatched: never seen",
            "y (m)",
        )
        error = np.abs(elevation.heights - self.terrain.elevation.heights)[elevation.known]
        picture.alt = (
            f"{count} poses, {points:,} points: {known:.1%} of the cells are known; 95 % of those "
            f"are within {100 * np.nanquantile(error, 0.95):.1f} cm of the truth"
        )
        return picture


# What the pictures share --------------------------------------------------------------------------


def map_height(
    elevation: ElevationMap, most: float = TALLEST, width: float = WIDTH - 0.75
) -> float:
    """Return the height in inches of a slide that is filled by a map `width` inches wide."""
    return min(most, width * elevation.size[1] / elevation.size[0]) + 0.9


def show_map(axes: Axes, elevation: ElevationMap) -> None:
    """Show the heights of a map in metres; cells that were never observed are hatched."""
    colours = relief(elevation)[0]
    ix, iy = np.indices(elevation.shape)
    # Stripes of cells: hatching thousands of squares takes seconds.
    stripes = np.where((ix + iy) % 4 == 0, 0.55, 1.0)[..., None] * np.array(to_rgb(UNKNOWN))
    show_cells(axes, elevation, np.where(elevation.known[..., None], colours, stripes))


def show_cells(axes: Axes, elevation: ElevationMap, colours: Float[np.ndarray, "nx ny 3"]) -> None:
    """Show one colour per cell, in metres."""
    x0, y0, x1, y1 = elevation.extent
    # An image is [row = y, column = x]: transpose; its first row lies at the bottom: origin lower.
    axes.imshow(np.clip(colours, 0, 1).transpose(1, 0, 2), origin="lower",
                extent=(x0, x1, y0, y1), interpolation="nearest")  # fmt: skip
