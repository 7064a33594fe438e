"""Pictures of everything between a map and a route, for notebooks, files and threads alike.

Reads maps, tensors [nx, ny, d] and plans; gives matplotlib figures that a notebook
shows by themselves.
Source: the quantities of the paper's Sec. III; the petal glyphs are ours.

Arrays are [ix, iy], but an image has y first: the transposes are here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import ArrayLike

from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, DoubtfulRouteError
from fgtutor.figures.panels import (
    BLOCKED,
    hatch_unknown,
    legend,
    page_size,
    paint_route,
    root,
    say,
    show_cells,
    stage,
)
from fgtutor.figures.relief import height_bar, relief
from fgtutor.figures.style import TITLE, Picture, policy_colours
from fgtutor.io.validation import Count, check_arguments
from fgtutor.routes import Route

if TYPE_CHECKING:
    from fgtutor.planning import Plan
    from fgtutor.world.terrain import Section

FEASIBLE, CLOSED = "#0072B2", "#D9D9D9"
"""The same where walls are dark: full feasibility, and cells that no policy may leave."""
HEIGHT: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 8, "color": "white"}
HEIGHT["path_effects"] = [Stroke(linewidth=3, foreground=BLOCKED), Normal()]
"""How heights are written on a map."""
GLYPHS = 36
"""Petal glyphs along the longer side of a map: more could not be told apart."""


# One object, one picture --------------------------------------------------------------------------
# Each draws on the axes it is given, else on a picture of its own, and returns the whole figure.
# `bare` leaves out title, labels, colour bar and legend, for pictures that write their own.


def draw_elevation(
    elevation: ElevationMap,
    *,
    title: str = "Elevation map",
    caption: str = "White: the most common height. Blue lies below it, brown above",
    label: str = "height (m)",
    usual: float | None = None,
    axes: Axes | None = None,
    bare: bool = False,
) -> Figure:
    """Draw the heights of a map, in relief; cells that were never observed are hatched.

    `usual` (m) is the height that is white; by default the most common one. `label` names what the
    colours mean.
    """
    axes = stage(elevation, axes)
    colours, norm = relief(elevation, usual)
    show_cells(axes, elevation, colours)
    hatch_unknown(axes, elevation)
    if not bare:
        height_bar(axes, elevation, norm, label)
        say(axes, title, caption, elevation)
    return root(axes)


def draw_route(
    route: Route, elevation: ElevationMap, *, axes: Axes | None = None, bare: bool = False
) -> Figure:
    """Draw a route in the colours of its policies: on the map, or on top of what `axes` hold."""
    if axes is None:
        axes = stage(elevation, None)
        draw_elevation(elevation, axes=axes, bare=bare)
    colours = policy_colours(route.names)
    ends = paint_route(axes, route, [colours[route.names[policy]] for policy in route.policies])
    if not bare:
        used = {name: colours[name] for i, name in enumerate(route.names) if i in route.policies}
        legend(axes, used, ends)
        caption = f"{route.length:.1f} m, cost {route.cost:.1f}, policy switches: {route.switches}"
        say(axes, "The route, coloured by the policy that drives it", caption, elevation)
    return root(axes)


def draw_weight(
    w_ood: ArrayLike,
    grid: ElevationMap,
    name: str = "general",
    *,
    axes: Axes | None = None,
    bare: bool = False,
) -> Figure:
    """Draw w_ood, the mean over the headings: where a policy has seen terrain like this before."""
    axes = stage(grid, axes)
    weight = _fit("w_ood", w_ood, grid).mean(axis=-1)
    own = np.array(to_rgb(policy_colours([name])[name]))
    show_cells(axes, grid, 1 - weight[..., None] * (1 - own))
    hatch_unknown(axes, grid)
    if not bare:
        caption = "Full colour (1): knows such ground. White (0): not at all"
        say(axes, f"w_ood of {name!r}", caption, grid)
    return root(axes)


def draw_petals(
    fused: ArrayLike,
    grid: ElevationMap,
    policy_map: ArrayLike | None = None,
    names: Sequence[str] = (),
    *,
    f_min: float = 0.1,
    every: Count | None = None,
    axes: Axes | None = None,
) -> Figure:
    """Draw a tensor F [nx, ny, d] as one flower per cell: a petal's length is F along its heading.

    With `policy_map` and `names` petals have the colour of the best policy, else all the same.
    `every` draws every n-th cell along x and y, by default as few as can be told apart.
    """
    check_arguments(draw_petals, locals(), ConfigError)
    axes = stage(grid, axes)
    tensor = _fit("F", fused, grid)
    every = every or max(1, -(-max(grid.shape) // GLYPHS))
    ix, iy = (np.arange((every - 1) // 2, n, every) for n in grid.shape)
    at = np.ix_(ix, iy)
    centres = np.stack(np.meshgrid(*(c[i] for c, i in zip(grid.centres, (ix, iy), strict=True)),
                                   indexing="ij"), axis=-1)  # fmt: skip
    f = tensor[at]
    open_ = f >= f_min
    headings = Headings.of(tensor)
    # A petal along +x, from its stem to its tip and back; [point, (along, across)].
    along = np.array([0.0, 0.3, 0.65, 0.9, 1.0, 0.9, 0.65, 0.3])
    across = np.array([0.0, 0.11, 0.18, 0.12, 0.0, -0.12, -0.18, -0.11])
    across *= 8 / headings.count  # the more petals, the slimmer
    cos, sin = np.cos(headings.yaws)[:, None], np.sin(headings.yaws)[:, None]
    shape = np.stack((along * cos - across * sin, along * sin + across * cos), axis=-1)
    radius = 0.56 * every * grid.resolution
    petals = centres[:, :, None, None] + f[..., None, None] * shape * radius
    if policy_map is None:
        palette = np.array([to_rgb(FEASIBLE)])
        kind = np.zeros(f.shape, dtype=int)
        caption = ""
    else:
        palette = _palette(names)
        kind = _policies(policy_map, grid, names)[at]
        legend(axes, policy_colours(names))
        caption = ", in the colour of the policy that does it best"
    flowers = PolyCollection(list(petals[open_]), facecolors=palette[kind[open_]], linewidths=0)
    axes.add_collection(flowers)
    closed = centres[~open_.any(axis=-1)]
    axes.plot(*closed.T, ".", color=BLOCKED, markersize=2.5)
    hatch_unknown(axes, grid)
    which = "Every cell" if every == 1 else f"One cell in {every} x {every}"
    title = "F as petals: the longer a petal, the higher F in that direction"
    say(axes, title, f"{which}{caption}. A dot: no way out", grid)
    return root(axes)


def draw_policy_map(
    policy_map: ArrayLike,
    fused: ArrayLike,
    grid: ElevationMap,
    names: Sequence[str],
    *,
    f_min: float = 0.1,
    axes: Axes | None = None,
    bare: bool = False,
) -> Figure:
    """Draw P [nx, ny, d]: in each cell the policy of its best heading, paler where F is low."""
    axes = stage(grid, axes)
    tensor, policies = _fit("F", fused, grid), _policies(policy_map, grid, names)
    best = tensor.argmax(axis=-1)[..., None]
    policy = np.take_along_axis(policies, best, axis=-1)[..., 0]
    strength = (0.2 + 0.8 * np.take_along_axis(tensor, best, axis=-1)).clip(0, 1)
    colours = 1 - strength * (1 - _palette(names)[policy])
    blocked = tensor.max(axis=-1) < f_min
    colours[blocked] = to_rgb(BLOCKED)
    show_cells(axes, grid, colours)
    hatch_unknown(axes, grid)
    if not bare:
        legend(axes, policy_colours(names) | ({"blocked": BLOCKED} if blocked.any() else {}))
        caption = f"Paler: less feasible. Blocked: no heading reaches F = {f_min:g}"
        say(axes, "Policy map P: the best policy in each cell", caption, grid)
    return root(axes)


def plan_figure(elevation: ElevationMap, plan: Plan, *, f_min: float = 0.1) -> Picture:
    """Draw a whole plan in four panels: M with the route, w_ood of every policy, F_max, P.

    Raises `ConfigError` if the plan holds no w_ood of a policy.
    """
    if missing := [name for name in plan.names if name not in plan.weights]:
        raise ConfigError(f"plan_figure needs w_ood of every policy, got none of {missing}")
    figure = Picture(*np.multiply(2, page_size(elevation, 7.2)).tolist())
    panels = cast(np.ndarray, figure.subfigures(2, 2, wspace=0.02, hspace=0.02))

    first = panels[0, 0].subplots()
    draw_elevation(elevation, axes=first)
    if isinstance(plan.answer, Route):
        draw_route(plan.answer, elevation, axes=first)
    elif plan.answer.nearest:
        first.plot(*plan.answer.nearest, "X", color=BLOCKED, markersize=11)
        if isinstance(plan.answer.error, DoubtfulRouteError):
            words = "X: the worst step of a route that promises too little"
        else:
            words = "No route leads nearer to the goal than X"
        first.set_title(words, **TITLE, loc="left")
    columns = int(np.ceil(np.sqrt(len(plan.names))))
    rows = -(-len(plan.names) // columns)
    panels[0, 1].suptitle("2  Have I seen this before? w_ood of each policy", **TITLE, x=0.02)
    caption = "Full colour (1): the policy knows such ground. White (0): not at all"
    panels[0, 1].supxlabel(caption, fontsize=9)
    small = panels[0, 1].subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, name in zip(small, plan.names, strict=False):
        draw_weight(plan.weights[name], elevation, name, axes=axes, bare=True)
        axes.set_title(name, **TITLE | {"color": policy_colours([name])[name]}, loc="left")
    for axes in small[len(plan.names) :]:
        axes.remove()
    third, fourth = (panel.subplots() for panel in panels[1])
    draw_petals(plan.fused, elevation, plan.policy_map, plan.names, f_min=f_min, axes=third)
    draw_policy_map(plan.policy_map, plan.fused, elevation, plan.names, f_min=f_min, axes=fourth)
    for axes, number in ((first, 1), (third, 3), (fourth, 4)):
        axes.set_title(f"{number}  {axes.get_title(loc='left')}", **TITLE, loc="left")
    return figure


def draw_plans(
    elevation: ElevationMap,
    plans: Mapping[str, tuple[ArrayLike, Route | None]],
    *,
    title: str,
    f_min: float,
    walls: Bool[np.ndarray, "nx ny"],
    places: Iterable[Section],
) -> Picture:
    """Draw the same map once per plan, with its F [nx, ny, d] and its route, side by side.

    F is shown as its mean over the headings; a cell is closed where none reaches `f_min`.
    `places` are framed, and the height of what lies there is written below them.
    """
    width, height = page_size(elevation, 3.2)
    figure = Picture(max(len(plans) * width, 6.4), height + 0.5)
    panels = figure.subplots(1, len(plans), sharey=True, squeeze=False)[0]
    for axes, (name, (fused, route)) in zip(panels, plans.items(), strict=True):
        stage(elevation, axes)
        tensor = _fit("F", fused, elevation)
        colours = 1 - tensor.mean(axis=-1)[..., None] * (1 - np.array(to_rgb(FEASIBLE)))
        colours[tensor.max(axis=-1) < f_min] = to_rgb(CLOSED)
        colours[walls] = to_rgb(BLOCKED)
        show_cells(axes, elevation, colours)
        for place in places:
            corner, size = (place.x0, place.y0), (place.x1 - place.x0, place.y1 - place.y0)
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=BLOCKED))
            top = elevation.crop(place.x0, place.y0, place.x1, place.y1).heights.max()
            middle, below = (place.x0 + place.x1) / 2, place.y0 - 0.1
            axes.text(middle, below, f"{100 * top:.0f} cm high", **HEIGHT)
        if route is not None:
            paint_route(axes, route, ["#D55E00"] * len(route.policies))
        found = "no route" if route is None else f"{route.length:.1f} m"
        axes.set_title(f"{name}: {found}", **TITLE, loc="left")
    figure.suptitle(title, **TITLE, x=0.01)
    figure.supxlabel(
        "in metres; blue: feasibility, mean of the headings; grey: closed; dark: wall; star: goal",
        fontsize=9,
    )
    return figure


# What the pictures check -----------------------------------------------------------------------


def _fit(name: str, values: ArrayLike, grid: ElevationMap) -> Float[np.ndarray, "nx ny d"]:
    """Return a tensor in numpy; raises `ConfigError` if it is not of this map."""
    array = np.asarray(values)
    shape = (*grid.shape, *array.shape[-1:])
    if array.shape != shape:
        raise ConfigError(f"{name} has shape {array.shape}, its map asks for {shape}")
    return array


def _policies(policy_map: ArrayLike, grid: ElevationMap, names: Sequence[str]) -> np.ndarray:
    """Return P in numpy; raises `ConfigError` if a policy in it has no name."""
    policies = _fit("P", policy_map, grid)
    if policies.min() < 0 or policies.max() >= len(names):
        raise ConfigError(f"P counts policies up to {policies.max()}, names has {len(names)}")
    return policies


def _palette(names: Sequence[str]) -> Float[np.ndarray, "policies 3"]:
    """Return the policies' colours as numbers."""
    return np.array([to_rgb(colour) for colour in policy_colours(names).values()])
