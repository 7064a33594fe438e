"""What the course's notebooks draw and drive beside maps, tensors and routes (see `figures`).

Reads patches, tensors, graphs, routes and episodes; gives pictures, each of one object, and a few
helpers that keep a lesson's cells short: a driver that is a plain function, a route straight ahead,
a rollout. `charts` draws what has no map.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import networkx
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from fgtutor import directions, patches
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.canvas import TITLE, Panels, Picture, policy_colours
from fgtutor.figures.charts import INK
from fgtutor.figures.maps import GROUND, draw_elevation, draw_route
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.patches import PatchGrid, sample_patches
from fgtutor.robots.base import LocomotionEnv
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

if TYPE_CHECKING:
    from fgtutor.execution import Episode

COMPASS = ((1, 2), (0, 2), (0, 1), (0, 0), (1, 0), (2, 0), (2, 1), (2, 2))
"""Row and column of each heading in a 3 x 3 picture: +x on the right, +y above."""


# Patches ------------------------------------------------------------------------------------------


def patch_at(elevation: ElevationMap, pose: ArrayLike, grid: PatchGrid) -> Float[Tensor, " points"]:
    """Return the patch H_xy at a pose (x, y, yaw), cut from the prepared map as training does."""
    ground = patches.prepare(elevation)
    return sample_patches(
        torch.tensor(ground.heights),
        torch.tensor(np.asarray(pose), dtype=torch.float32),
        grid,
        resolution=ground.resolution,
        origin=ground.origin,
    )


def draw_windows(elevation: ElevationMap, poses: ArrayLike, grid: PatchGrid) -> Picture:
    """Draw on the map where the patches at some poses (x, y, yaw) lie, and where each one looks."""
    figure = draw_elevation(elevation)
    for pose in np.atleast_2d(np.asarray(poses, dtype=float)):
        _window(figure.axes[0], pose, grid)
    _say(figure.axes[0], "The windows that patches are cut from", "The arrow points ahead")
    return figure  # pyright: ignore[reportReturnType]


def patch_gallery(
    shown: Sequence[ArrayLike],
    grid: PatchGrid,
    captions: Sequence[str],
    *,
    columns: Panels = 4,
    title: str = "",
    unit: str = "height (m)",
) -> Picture:
    """Draw patches side by side, all in one scale of colours; the robot looks to the right.

    Whatever has one number a point may be shown so, such as the weights of a network's first layer.
    """
    check_arguments(patch_gallery, locals(), ConfigError)
    rows = -(-len(shown) // columns)
    x, y = _span(grid)
    figure = Picture(7.2, 0.45 + rows * (0.35 + 6.2 / columns * (y[1] - y[0]) / (x[1] - x[0])))
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    reach = max(0.1, *(float(np.abs(np.asarray(values)).max()) for values in shown))
    image = None
    for axes, values, caption in zip(panels, shown, captions, strict=False):
        image = _patch(axes, values, grid, reach)
        axes.set_title(caption, fontsize=8.5, loc="left")
    for axes in panels[len(shown) :]:
        axes.remove()
    if image is not None:
        figure.colorbar(image, ax=figure.axes, shrink=0.8, pad=0.01, label=unit)
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def patch_rose(elevation: ElevationMap, x: float, y: float, grid: PatchGrid) -> Picture:
    """Draw the eight patches of one place, each at its side of the map's window around the place.

    Every patch is turned so that the robot looks to the right: this is what a network is shown.
    """
    figure = Picture(7.6, 6.2)
    panels = figure.subplots(3, 3)
    poses = np.column_stack((np.tile((x, y), (directions.NUM_HEADINGS, 1)), directions.YAWS))
    shown = patch_at(elevation, poses, grid).numpy()
    reach = max(0.1, float(np.abs(shown).max()))
    image = None
    for heading, (row, column) in enumerate(COMPASS):
        image = _patch(panels[row, column], shown[heading], grid, reach)
        panels[row, column].set_title(
            f"heading {heading}: {directions.NAMES[heading]}", fontsize=8.5, loc="left"
        )
    around = 1.1 * patches.reach(grid)
    middle = panels[1, 1]
    draw_elevation(elevation.crop(x - around, y - around, x + around, y + around), axes=middle)
    figure.axes[-1].remove()  # the map's colour bar: the patches' own says enough
    middle.set(xlabel="", ylabel="", xticks=(), yticks=())
    middle.set_title("the place on the map", fontsize=8.5, loc="left")
    for pose in poses:
        _window(middle, pose, grid, colour="#00000055")
    if image is not None:
        figure.colorbar(image, ax=figure.axes, shrink=0.6, pad=0.01, label="height (m)")
    figure.suptitle("One place, eight headings, eight patches", **TITLE, x=0.01)
    return figure


def heading_maps(tensor: ArrayLike, grid: ElevationMap, *, label: str = "F") -> Picture:
    """Draw the eight channels of a tensor [nx, ny, 8], each at the side that its heading points to.

    In the middle lies the map.
    """
    values = np.asarray(tensor)
    width, height = grid.size
    figure = Picture(7.6, float(np.clip(7.0 * height / width, 2.0, 7.0)) + 0.8)
    panels = figure.subplots(3, 3, sharex=True, sharey=True)
    x0, y0, x1, y1 = grid.extent
    image = None
    for heading, (row, column) in enumerate(COMPASS):
        # An image is [row = y, column = x]: transpose, with its first row at the bottom.
        image = panels[row, column].imshow(
            values[..., heading].T, origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=1
        )
        panels[row, column].set_title(
            f"heading {heading}: {directions.NAMES[heading]}", fontsize=8.5, loc="left"
        )
    draw_elevation(grid, axes=panels[1, 1])
    figure.axes[-1].remove()
    panels[1, 1].set(xlabel="", ylabel="")
    panels[1, 1].set_title("the map", fontsize=8.5, loc="left")
    if image is not None:
        figure.colorbar(image, ax=figure.axes, shrink=0.6, pad=0.01, label=label)
    figure.suptitle(f"{label}: one map a heading", **TITLE, x=0.01)
    return figure


# Driving ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scripted:
    """A driver that is a plain function: it can stand where `execute` wants a specialist."""

    act: Callable[[TensorDict], Float[Tensor, "robots actions"]]
    """Observations to actions."""
    robot: str = "toy"
    """What it drives."""
    command: tuple[float, float, float] = (0.85, 0.0, 0.0)
    """Commanded velocity (vx, vy, wz); m/s, m/s, rad/s."""
    history: int = 0
    """Frames of the past that it asks for."""


def straight_route(terrain: Terrain, name: str) -> Route:
    """Return the route that goes from start to goal along x as the crow flies, with one policy."""
    grid = terrain.elevation
    (first, row), (last, _) = grid.cell_of(*terrain.start), grid.cell_of(*terrain.goal)
    ix = np.arange(first, last + 1)
    cells = np.column_stack((ix, np.full_like(ix, row)))
    steps = len(ix) - 1
    return Route(
        cells=cells,
        xy=np.array([grid.centre_of(i, row) for i in ix.tolist()]),
        headings=np.zeros(steps, dtype=int),
        policies=np.zeros(steps, dtype=int),
        feasibility=np.ones(steps),
        costs=np.ones(steps),
        length=steps * grid.resolution,
        names=(name,),
    )


def collect(
    env: LocomotionEnv, act: Callable[[TensorDict], Tensor], seconds: Positive
) -> dict[str, Float[Tensor, "time envs _"]]:
    """Let the robots of `env` act for a while; return every observation group over time."""
    check_arguments(collect, locals(), ConfigError)
    steps = round(seconds / env.control_dt)
    observations = [env.get_observations()]
    for _ in tqdm(range(steps - 1), unit="step"):
        observations.append(env.step(act(observations[-1]))[0])
    groups = list(observations[0].keys())  # a TensorDict iterates over its batch, not its names
    return {name: torch.stack([step[name] for step in observations]) for name in groups}


# Graphs and routes --------------------------------------------------------------------------------


def draw_graph(
    graph: networkx.DiGraph,
    grid: ElevationMap,
    path: Sequence[tuple[int, int]] = (),
    names: Sequence[str] = (),
) -> Picture:
    """Draw a small graph on its map: an arrow for every step, the wider the more feasible.

    The arrows of `path` carry their costs; `names` are the policies, which give the colours.
    """
    figure = draw_elevation(grid)
    axes = figure.axes[0]
    edges = list(graph.edges(data=True))
    tails = np.array([grid.centre_of(*tail) for tail, _, _ in edges])
    heads = np.array([grid.centre_of(*head) for _, head, _ in edges])
    step = heads - tails
    aside = 0.09 * step @ np.array(((0.0, -1.0), (1.0, 0.0)))  # there and back side by side
    colours = policy_colours(names)
    axes.quiver(
        *(tails + 0.14 * step + aside).T,
        *(0.6 * step).T,
        angles="xy",
        scale_units="xy",
        scale=1,
        color=[colours[names[int(edge["policy"])]] for _, _, edge in edges],
        alpha=[0.15 + 0.75 * edge["feasibility"] for _, _, edge in edges],
        width=0.0045,
        headwidth=4,
    )
    nodes = np.array([grid.centre_of(*node) for node in graph.nodes])
    axes.plot(*nodes.T, "o", color="white", markeredgecolor=INK, markersize=7)
    for tail, head in itertools.pairwise(path):
        a, b = np.array(grid.centre_of(*tail)), np.array(grid.centre_of(*head))
        axes.plot(*np.stack((a, b)).T, color=INK, linewidth=2.5, alpha=0.8)
        weight = graph.edges[tail, head]["weight"]
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": INK}
        x, y = (a + b) / 2
        axes.text(x, y, f"{weight:.2f}", ha="center", va="center", fontsize=8, bbox=box)
    _legend(figure, colours)
    _say(axes, "The graph: a node a cell, an arrow a step", "The fuller an arrow, the cheaper")
    return figure  # pyright: ignore[reportReturnType]


def compare_routes(
    elevation: ElevationMap, routes: Mapping[str, Route | str], *, columns: Panels = 2
) -> Picture:
    """Draw routes over one map side by side; where there is none, give the reason as a text."""
    check_arguments(compare_routes, locals(), ConfigError)
    rows = -(-len(routes) // columns)
    width = 7.6 / columns
    figure = Picture(7.6, rows * (width * elevation.size[1] / elevation.size[0] + 0.6) + 0.4)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    used: dict[str, str] = {}
    for axes, (caption, route) in zip(panels, routes.items(), strict=False):
        draw_elevation(elevation, axes=axes)
        figure.axes[-1].remove()
        words = route
        if isinstance(route, Route):
            draw_route(route, elevation, axes=axes)
            words = f"{route.length:.1f} m, policy switches: {route.switches}"
            colours = list(policy_colours(route.names).values())
            used |= {route.names[i]: colours[i] for i in np.unique(route.policies).tolist()}
        axes.set_title(caption, **TITLE, loc="left")
        axes.set_xlabel(str(words), fontsize=9)
        axes.set(ylabel="", xticks=(), yticks=())
    for axes in panels[len(routes) :]:
        axes.remove()
    figure.legends.clear()  # each route brought one of its own
    _legend(figure, used)
    return figure


def draw_drive(episode: Episode, route: Route, elevation: ElevationMap) -> Picture:
    """Draw the driven way, coloured by the active policy, over the planned route in white."""
    figure = draw_elevation(elevation)
    axes = figure.axes[0]
    axes.plot(*route.xy.T, color="white", linewidth=7, alpha=0.9, solid_capstyle="round")
    xy = episode.poses[:, :2]
    colours = list(policy_colours(route.names).values())
    axes.add_collection(
        LineCollection(
            list(np.stack((xy[:-1], xy[1:]), axis=1)),
            colors=[colours[policy] for policy in episode.policies[1:]],
            linewidths=3,
        )
    )
    axes.plot(*xy[-1], "o" if episode.success else "X", color=INK, markersize=10)
    _legend(figure, {route.names[i]: colours[i] for i in np.unique(episode.policies).tolist()})
    _say(
        axes,
        f"Driven ({episode.reason}) over planned",
        f"White: the route. Colour: the policy that drove. {episode.length:.1f} m in "
        f"{episode.seconds:.0f} s, policy switches: {episode.switches}",
    )
    return figure  # pyright: ignore[reportReturnType]


# What the pictures share --------------------------------------------------------------------------


def _legend(figure: Figure, colours: Mapping[str, str]) -> None:
    """Name the colours of lines below the picture."""
    lines = [Line2D([], [], color=colour, lw=3, label=name) for name, colour in colours.items()]
    figure.legend(
        handles=lines, loc="outside lower center", ncols=len(lines), frameon=False, fontsize=9
    )


def _say(axes: Axes, title: str, caption: str) -> None:
    """Write what is drawn above the map, and what to see in it below."""
    axes.set_title(title, **TITLE, loc="left")
    axes.set_xlabel(f"x (m)\n{caption}", fontsize=9)


def _span(grid: PatchGrid) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the area that a patch's points stand for, in the robot's yaw frame, m."""
    half = grid.spacing / 2
    (x0, y0), (x1, y1) = grid.points.amin(0).tolist(), grid.points.amax(0).tolist()
    return (x0 - half, x1 + half), (y0 - half, y1 + half)


def _patch(axes: Axes, values: ArrayLike, grid: PatchGrid, reach: float) -> AxesImage:
    """Show one number a point, with the robot's footprint and where it looks."""
    (x0, x1), (y0, y1) = _span(grid)
    # Points are [x, y]; an image is [row = y, column = x]: transpose, first row at the bottom.
    image = axes.imshow(
        np.asarray(values).reshape(grid.shape).T,
        cmap=GROUND,
        norm=Normalize(-reach, reach),
        origin="lower",
        extent=(x0, x1, y0, y1),
    )
    length, width = grid.footprint
    axes.add_patch(
        Rectangle((-length, -width), 2 * length, 2 * width, fill=False, edgecolor=INK, linewidth=1)
    )
    axes.plot((0, length), (0, 0), color=INK, linewidth=1)
    axes.set(xticks=(), yticks=())
    return image


def _window(axes: Axes, pose: ArrayLike, grid: PatchGrid, colour: str = "#D55E00") -> None:
    """Outline on a map the area of a patch, and point ahead."""
    x, y, yaw = np.asarray(pose, dtype=float)
    (x0, x1), (y0, y1) = _span(grid)
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = np.array(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    outline = corners @ np.array(((cos, sin), (-sin, cos))) + (x, y)
    axes.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.5))
    axes.annotate(
        "",
        (x + 0.8 * x1 * cos, y + 0.8 * x1 * sin),
        (x, y),
        arrowprops={"arrowstyle": "->", "color": colour},
    )
