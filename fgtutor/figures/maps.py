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
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import FuncNorm, LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import ArrayLike

from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.style import TITLE, Picture, heading_colours, policy_colours
from fgtutor.io.validation import Count, check_arguments
from fgtutor.routes import Route

if TYPE_CHECKING:
    from fgtutor.planning import Plan
    from fgtutor.world.terrain import Section

BLOCKED, UNKNOWN = "#33363B", "#C4C4C4"
"""Cells that no policy may leave, and cells that were never observed."""
FEASIBLE, CLOSED = "#0072B2", "#D9D9D9"
"""The same where walls are dark: full feasibility, and cells that no policy may leave."""
GROUND = LinearSegmentedColormap.from_list(
    "ground", ["#16324A", "#5F87A6", "#F4F1EA", "#B08D5E", "#4F3517"]
)
"""Below the usual ground blue, above it brown; level ground is light, so that routes stand out."""
DETAIL = 0.1
"""Heights within this many metres of the usual ground get the larger part of the colours."""
HEIGHT: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 8, "color": "white"}
HEIGHT["path_effects"] = [Stroke(linewidth=3, foreground=BLOCKED), Normal()]
"""How heights are written on a map."""
GLYPHS = 36
"""Petal glyphs along the longer side of a map: more could not be told apart."""


# One object, one picture --------------------------------------------------------------------------
# Each draws on the axes it is given, else on a picture of its own, and returns the whole figure.
# `bare` leaves out title, labels, colour bar and legend, for pictures that write their own.


def relief(elevation: ElevationMap) -> tuple[Float[np.ndarray, "nx ny 3"], FuncNorm]:
    """Return a map's cells in the colours of `GROUND`, shaded, and the scale of the colours."""
    heights = elevation.filled().heights.astype(np.float64)
    usual = float(np.median(heights[elevation.known]))
    reach = max(float(np.abs(heights - usual).max()), DETAIL)
    # A wall of 1 m must not wash out a ledge of 5 cm: colours follow an inverse sinh.
    norm = FuncNorm(
        (lambda z: np.arcsinh((z - usual) / DETAIL), lambda c: np.sinh(c) * DETAIL + usual),
        vmin=usual - reach,
        vmax=usual + reach,
    )
    # Light from the upper left: ground that rises to the right or falls towards the top is bright.
    rise_x, rise_y = np.gradient(heights, elevation.resolution)
    light = 1 + 0.25 * np.tanh((rise_x - rise_y) / 2)
    return np.clip(GROUND(norm(heights))[..., :3] * light[..., None], 0, 1), norm


def draw_elevation(
    elevation: ElevationMap, *, axes: Axes | None = None, bare: bool = False
) -> Figure:
    """Draw the heights of a map, in relief; cells that were never observed are hatched."""
    axes = _stage(elevation, axes)
    colours, norm = relief(elevation)
    _show(axes, elevation, colours)
    _hatch_unknown(axes, elevation)
    if bare:
        return _root(axes)
    low, high = norm.vmin or 0.0, norm.vmax or 0.0
    usual, reach = (high + low) / 2, (high - low) / 2
    marks = np.array([0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0])
    marks = marks[marks <= reach * 1.001][-4:]
    bar = _root(axes).colorbar(
        ScalarMappable(norm, GROUND),
        ax=axes,
        shrink=0.8,
        pad=0.01,
        label="height (m)",
        ticks=[*(usual - marks), usual, *(usual + marks)],
        format="%.2f",
    )
    bar.ax.minorticks_off()
    _say(axes, "Elevation map M", "Blue lies below the usual ground, brown above it")
    return _root(axes)


def draw_route(
    route: Route, elevation: ElevationMap, *, axes: Axes | None = None, bare: bool = False
) -> Figure:
    """Draw a route in the colours of its policies: on the map, or on top of what `axes` hold."""
    if axes is None:
        axes = _stage(elevation, None)
        draw_elevation(elevation, axes=axes, bare=bare)
    colours = policy_colours(route.names)
    ends = _paint_route(axes, route, [colours[route.names[policy]] for policy in route.policies])
    if not bare:
        used = {name: colours[name] for i, name in enumerate(route.names) if i in route.policies}
        _legend(axes, used, ends)
        caption = f"{route.length:.1f} m, cost {route.cost:.1f}, policy switches: {route.switches}"
        _say(axes, "The route, coloured by the policy that drives it", caption)
    return _root(axes)


def draw_weight(
    w_ood: ArrayLike,
    grid: ElevationMap,
    name: str = "general",
    *,
    axes: Axes | None = None,
    bare: bool = False,
) -> Figure:
    """Draw w_ood, the mean over the headings: where a policy has seen terrain like this before."""
    axes = _stage(grid, axes)
    weight = _fit("w_ood", w_ood, grid).mean(axis=-1)
    own = np.array(to_rgb(policy_colours([name])[name]))
    _show(axes, grid, 1 - weight[..., None] * (1 - own))
    _hatch_unknown(axes, grid)
    if not bare:
        caption = "Full colour (1): knows such ground. White (0): not at all"
        _say(axes, f"w_ood of {name!r}", caption)
    return _root(axes)


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

    With `policy_map` and `names` petals have the colour of the best policy, else of their heading.
    `every` draws every n-th cell along x and y, by default as few as can be told apart.
    """
    check_arguments(draw_petals, locals(), ConfigError)
    axes = _stage(grid, axes)
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
        palette = heading_colours(headings)
        kind = np.broadcast_to(np.arange(headings.count), f.shape)
        caption = "One colour per heading"
    else:
        palette = _palette(names)
        kind = _policies(policy_map, grid, names)[at]
        _legend(axes, policy_colours(names))
        caption = "In the colour of the policy that does it best"
    flowers = PolyCollection(list(petals[open_]), facecolors=palette[kind[open_]], linewidths=0)
    axes.add_collection(flowers)
    closed = centres[~open_.any(axis=-1)]
    axes.plot(*closed.T, ".", color=BLOCKED, markersize=2.5)
    _hatch_unknown(axes, grid)
    which = "every cell" if every == 1 else f"one cell in {every} x {every}"
    title = "F as petals: the longer a petal, the better that way"
    _say(axes, title, f"{caption}; {which}. A dot: no way out")
    return _root(axes)


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
    axes = _stage(grid, axes)
    tensor, policies = _fit("F", fused, grid), _policies(policy_map, grid, names)
    best = tensor.argmax(axis=-1)[..., None]
    policy = np.take_along_axis(policies, best, axis=-1)[..., 0]
    strength = (0.2 + 0.8 * np.take_along_axis(tensor, best, axis=-1)).clip(0, 1)
    colours = 1 - strength * (1 - _palette(names)[policy])
    blocked = tensor.max(axis=-1) < f_min
    colours[blocked] = to_rgb(BLOCKED)
    _show(axes, grid, colours)
    _hatch_unknown(axes, grid)
    if not bare:
        _legend(axes, policy_colours(names) | ({"blocked": BLOCKED} if blocked.any() else {}))
        caption = f"Paler: less feasible. Blocked: no heading reaches F = {f_min:g}"
        _say(axes, "Policy map P: the best policy in each cell", caption)
    return _root(axes)


def plan_figure(elevation: ElevationMap, plan: Plan, *, f_min: float = 0.1) -> Picture:
    """Draw a whole plan in four panels: M with the route, w_ood of every policy, F_max, P.

    Raises `ConfigError` if the plan holds no w_ood of a policy.
    """
    if missing := [name for name in plan.names if name not in plan.weights]:
        raise ConfigError(f"plan_figure needs w_ood of every policy, got none of {missing}")
    figure = Picture(*np.multiply(2, _size(elevation, 7.2)).tolist())
    panels = cast(np.ndarray, figure.subfigures(2, 2, wspace=0.02, hspace=0.02))

    first = panels[0, 0].subplots()
    draw_elevation(elevation, axes=first)
    if isinstance(plan.answer, Route):
        draw_route(plan.answer, elevation, axes=first)
    elif plan.answer.nearest:
        first.plot(*plan.answer.nearest, "X", color=BLOCKED, markersize=11)
        first.set_title("No route leads nearer to the goal than X", **TITLE, loc="left")
    columns = int(np.ceil(np.sqrt(len(plan.names))))
    rows = -(-len(plan.names) // columns)
    panels[0, 1].suptitle("2  Have I seen this before? w_ood of each policy", **TITLE, x=0.02)
    caption = "Full colour (1): the policy knows such ground. White (0): not at all"
    panels[0, 1].supxlabel(caption, fontsize=9)
    small = panels[0, 1].subplots(rows, columns, squeeze=False).ravel()
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
    width, height = _size(elevation, 3.2)
    figure = Picture(max(len(plans) * width, 6.4), height + 0.5)
    panels = figure.subplots(1, len(plans), sharey=True, squeeze=False)[0]
    for axes, (name, (fused, route)) in zip(panels, plans.items(), strict=True):
        _stage(elevation, axes)
        tensor = _fit("F", fused, elevation)
        colours = 1 - tensor.mean(axis=-1)[..., None] * (1 - np.array(to_rgb(FEASIBLE)))
        colours[tensor.max(axis=-1) < f_min] = to_rgb(CLOSED)
        colours[walls] = to_rgb(BLOCKED)
        _show(axes, elevation, colours)
        for place in places:
            corner, size = (place.x0, place.y0), (place.x1 - place.x0, place.y1 - place.y0)
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=BLOCKED))
            top = elevation.crop(place.x0, place.y0, place.x1, place.y1).heights.max()
            middle, below = (place.x0 + place.x1) / 2, place.y0 - 0.1
            axes.text(middle, below, f"{100 * top:.0f} cm high", **HEIGHT)
        if route is not None:
            _paint_route(axes, route, ["#D55E00"] * len(route.policies))
        found = "no route" if route is None else f"{route.length:.1f} m"
        axes.set_title(f"{name}: {found}", **TITLE, loc="left")
    figure.suptitle(title, **TITLE, x=0.01)
    figure.supxlabel(
        "in metres; blue: feasibility, mean of the headings; grey: closed; dark: wall; star: goal",
        fontsize=9,
    )
    return figure


# What the pictures share --------------------------------------------------------------------------


def _size(grid: ElevationMap, width: float) -> tuple[float, float]:
    """Return the size of a picture of this map in inches, words included."""
    return width, float(np.clip((width - 1.2) * grid.size[1] / grid.size[0], 1.2, 9.0)) + 1.3


def _stage(grid: ElevationMap, axes: Axes | None) -> Axes:
    """Return axes in metres with the map's frame, on a new picture if there are none."""
    axes = axes or Picture(*_size(grid, 7.2)).subplots()
    x0, y0, x1, y1 = grid.extent
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.tick_params(labelsize=8)
    return axes


def _root(axes: Axes) -> Figure:
    """Return the whole figure that axes lie on."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ConfigError("these axes were removed from their figure: draw on others")
    return figure


def _say(axes: Axes, title: str, caption: str) -> None:
    """Write what is drawn above the picture, and what to see in it below."""
    axes.set_title(title, **TITLE, loc="left")
    axes.set_xlabel(f"x (m)\n{caption}", fontsize=9)
    axes.set_ylabel("y (m)")


def _legend(axes: Axes, colours: Mapping[str, str], more: Sequence[Line2D] = ()) -> None:
    """Name colours below the picture."""
    handles = [Patch(color=colour, label=name) for name, colour in colours.items()]
    panel, ncols = axes.get_figure(root=False), len(handles) + len(more)
    if panel is not None:
        style = {"fontsize": 9, "columnspacing": 1.2, "handlelength": 1.2, "frameon": False}
        panel.legend(handles=[*handles, *more], loc="outside lower center", ncols=ncols, **style)


def _show(axes: Axes, grid: ElevationMap, colours: Float[np.ndarray, "nx ny 3"]) -> None:
    """Show one colour per cell."""
    x0, y0, x1, y1 = grid.extent
    # An image is [row = y, column = x]: transpose; its first row lies at the bottom: origin lower.
    axes.imshow(
        colours.transpose(1, 0, 2), origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest"
    )


def _paint_route(axes: Axes, route: Route, colours: Sequence[str]) -> list[Line2D]:
    """Draw a route, one colour per edge; return its start and goal for a legend."""
    edges = list(np.stack((route.xy[:-1], route.xy[1:]), axis=1))
    for line in ({"colors": "white", "linewidths": 6}, {"colors": colours, "linewidths": 3.2}):
        axes.add_collection(LineCollection(edges, capstyle="round", **line))
    ends: list[Line2D] = []
    style: dict[str, Any] = {"linestyle": "none", "color": "white", "markeredgecolor": "black"}
    for at, role, marker, size in ((0, "start", "o", 9), (-1, "goal", "*", 15)):
        x, y = route.xy[at]
        ends += axes.plot([x], [y], label=role, marker=marker, markersize=size, zorder=5, **style)
    return ends


def _hatch_unknown(axes: Axes, grid: ElevationMap) -> None:
    """Cover the cells that were never observed with grey hatching."""
    if grid.known.all():
        return
    half = grid.resolution / 2
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    centres = np.stack(grid.centre_of(*np.nonzero(~grid.known)), axis=-1)  # pyright: ignore
    squares = PolyCollection(
        list(centres[:, None] + corners), facecolors=UNKNOWN, edgecolors="#777777", linewidths=0
    )
    squares.set_hatch("////")
    axes.add_collection(squares)


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
