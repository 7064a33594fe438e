"""Pictures of everything between a map and a route, for notebooks, files and threads alike.

Reads maps, tensors [nx, ny, 8], plans and training rows; gives matplotlib figures that a notebook
shows by themselves.
Source: the quantities of the paper's Sec. III; the 8-petal glyphs are ours.

Arrays are [ix, iy], but an image has y first: the transposes are here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import FuncNorm, LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter
from numpy.typing import ArrayLike

from fgtutor import directions
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.canvas import POLICY_COLOURS, TITLE, Picture, policy_colours, save_figure
from fgtutor.io.validation import Count, check_arguments

if TYPE_CHECKING:
    from fgtutor.planning import Plan
    from fgtutor.routes import Route

__all__ = [
    "POLICY_COLOURS",
    "Picture",
    "calibration_plot",
    "draw_elevation",
    "draw_petals",
    "draw_policy_map",
    "draw_route",
    "draw_weight",
    "plan_figure",
    "policy_colours",
    "save_figure",
    "training_curve",
]

HEADING_COLOURS = (
    "#E69F00", "#B8A23A", "#009E73", "#56B4E9", "#0072B2", "#6F6DAE", "#CC79A7", "#D55E00",
)  # fmt: skip
"""One colour a heading, in a circle: neighbours resemble each other."""
BLOCKED, UNKNOWN = "#33363B", "#C4C4C4"
"""Cells that no policy may leave, and cells that were never observed."""
GROUND = LinearSegmentedColormap.from_list(
    "ground", ["#16324A", "#5F87A6", "#F4F1EA", "#B08D5E", "#4F3517"]
)
"""Below the usual ground blue, above it brown; level ground is light, so that routes stand out."""
DETAIL = 0.1
"""Heights within this many metres of the usual ground get the larger part of the colours."""
GLYPHS = 36
"""Petal glyphs along the longer side of a map: more could not be told apart."""


# One object, one picture --------------------------------------------------------------------------
# Each draws on the axes it is given, else on a picture of its own, and returns the whole figure.


def draw_elevation(elevation: ElevationMap, *, axes: Axes | None = None) -> Figure:
    """Draw the heights of a map, in relief; cells that were never observed are hatched."""
    axes = _stage(elevation, axes)
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
    colours = GROUND(norm(heights))[..., :3] * light[..., None]
    _show(axes, elevation, np.clip(colours, 0, 1))
    _hatch_unknown(axes, elevation)
    bar = _root(axes).colorbar(ScalarMappable(norm, GROUND), ax=axes, shrink=0.8, pad=0.01)
    marks = np.array([0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0])
    marks = marks[marks <= reach * 1.001][-4:]
    bar.locator = FixedLocator([*(usual - marks), usual, *(usual + marks)])
    bar.formatter = FuncFormatter(lambda z, _: f"{z:.2f}")
    bar.update_ticks()
    bar.ax.minorticks_off()
    bar.set_label("height (m)")
    _say(axes, "Elevation map M", "Blue lies below the usual ground, brown above it")
    return _root(axes)


def draw_route(route: Route, elevation: ElevationMap, *, axes: Axes | None = None) -> Figure:
    """Draw a route in the colours of its policies: on the map, or on top of what `axes` hold."""
    if axes is None:
        axes = _stage(elevation, None)
        draw_elevation(elevation, axes=axes)
    colours = policy_colours(route.names)
    edges = np.stack((route.xy[:-1], route.xy[1:]), axis=1)
    axes.add_collection(LineCollection(list(edges), colors="white", linewidths=6, capstyle="round"))
    axes.add_collection(
        LineCollection(
            list(edges),
            colors=[colours[route.names[policy]] for policy in route.policies],
            linewidths=3.2,
            capstyle="round",
        )
    )
    used = [name for i, name in enumerate(route.names) if i in route.policies]
    ends = []
    for (x, y), marker, size, role in (
        (route.xy[0], "o", 9, "start"),
        (route.xy[-1], "*", 15, "goal"),
    ):
        style = {"marker": marker, "markersize": size, "color": "white", "markeredgecolor": "black"}
        axes.plot([x], [y], linestyle="none", zorder=5, **style)
        ends.append(Line2D([], [], linestyle="none", label=role, **style))
    _legend(axes, {name: colours[name] for name in used}, ends)
    _say(
        axes,
        "The route, coloured by the policy that drives it",
        f"{route.length:.1f} m, cost {route.cost:.1f}, policy switches: {route.switches}",
    )
    return _root(axes)


def draw_weight(
    w_ood: ArrayLike, grid: ElevationMap, name: str = "general", *, axes: Axes | None = None
) -> Figure:
    """Draw w_ood, the mean over the headings: where a policy has seen terrain like this before."""
    axes = _stage(grid, axes)
    weight = _fit("w_ood", w_ood, grid).mean(axis=-1)
    own = np.array(to_rgb(policy_colours([name])[name]))
    _show(axes, grid, 1 - weight[..., None] * (1 - own))
    _hatch_unknown(axes, grid)
    _say(axes, f"w_ood of {name!r}", "Full colour (1): knows such ground. White (0): not at all")
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
    """Draw a tensor F [nx, ny, 8] as one flower a cell: a petal's length is F along its heading.

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
    # A petal along +x, from its stem to its tip and back; [point, (along, across)].
    along = np.array([0.0, 0.3, 0.65, 0.9, 1.0, 0.9, 0.65, 0.3])
    across = np.array([0.0, 0.11, 0.18, 0.12, 0.0, -0.12, -0.18, -0.11])
    cos, sin = np.cos(directions.YAWS)[:, None], np.sin(directions.YAWS)[:, None]
    shape = np.stack((along * cos - across * sin, along * sin + across * cos), axis=-1)
    radius = 0.56 * every * grid.resolution
    petals = centres[:, :, None, None] + f[..., None, None] * shape * radius
    if policy_map is None:
        palette = np.array([to_rgb(colour) for colour in HEADING_COLOURS])
        kind = np.broadcast_to(np.arange(directions.NUM_HEADINGS), f.shape)
        caption = "One colour a heading"
    else:
        palette = _palette(names)
        kind = _policies(policy_map, grid, names)[at]
        _legend(axes, policy_colours(names))
        caption = "In the colour of the policy that does it best"
    axes.add_collection(
        PolyCollection(list(petals[open_]), facecolors=palette[kind[open_]], linewidths=0)
    )
    closed = centres[~open_.any(axis=-1)]
    axes.plot(*closed.T, ".", color=BLOCKED, markersize=2.5)
    _hatch_unknown(axes, grid)
    which = "every cell" if every == 1 else f"one cell in {every} x {every}"
    _say(
        axes,
        "F as petals: the longer a petal, the better that way",
        f"{caption}; {which}. A dot: no way out",
    )
    return _root(axes)


def draw_policy_map(
    policy_map: ArrayLike,
    fused: ArrayLike,
    grid: ElevationMap,
    names: Sequence[str],
    *,
    f_min: float = 0.1,
    axes: Axes | None = None,
) -> Figure:
    """Draw P [nx, ny, 8]: in each cell the policy of its best heading, paler where F is low."""
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
    _legend(axes, policy_colours(names) | ({"blocked": BLOCKED} if blocked.any() else {}))
    _say(
        axes,
        "Policy map P: who would drive here",
        f"Paler: less feasible. Blocked: no heading reaches F = {f_min:g}",
    )
    return _root(axes)


def plan_figure(
    elevation: ElevationMap, plan: Plan, weights: Mapping[str, ArrayLike], *, f_min: float = 0.1
) -> Picture:
    """Draw a whole plan in four panels: M with the route, w_ood of every policy, F_max, P.

    `weights` holds w_ood [nx, ny, 8] by policy name. Raises `ConfigError` if one is missing.
    """
    missing = [name for name in plan.names if name not in weights]
    if missing:
        raise ConfigError(f"plan_figure needs w_ood of every policy, got none of {missing}")
    width, height = _size(elevation, 7.2)
    figure = Picture(2 * width, 2 * height)
    panels = cast(np.ndarray, figure.subfigures(2, 2, wspace=0.02, hspace=0.02))

    first = panels[0, 0].subplots()
    draw_elevation(elevation, axes=first)
    draw_route(plan.route, elevation, axes=first)
    columns = int(np.ceil(np.sqrt(len(plan.names))))
    rows = -(-len(plan.names) // columns)
    panels[0, 1].suptitle("2  Have I seen this before? w_ood of each policy", **TITLE, x=0.02)
    panels[0, 1].supxlabel(
        "Full colour (1): the policy knows such ground. White (0): not at all",
        fontsize=9,
    )
    small = panels[0, 1].subplots(rows, columns, squeeze=False).ravel()
    for axes, name in zip(small, plan.names, strict=False):
        draw_weight(weights[name], elevation, name, axes=axes)
        axes.set_title(name, **TITLE | {"color": policy_colours([name])[name]}, loc="left")
        axes.set(xlabel="", ylabel="")
    for axes in small[len(plan.names) :]:
        axes.remove()
    third, fourth = panels[1, 0].subplots(), panels[1, 1].subplots()
    draw_petals(plan.fused, elevation, plan.policy_map, plan.names, f_min=f_min, axes=third)
    draw_policy_map(plan.policy_map, plan.fused, elevation, plan.names, f_min=f_min, axes=fourth)
    for axes, number in ((first, 1), (third, 3), (fourth, 4)):
        axes.set_title(f"{number}  {axes.get_title(loc='left')}", **TITLE, loc="left")
    return figure


# Training -----------------------------------------------------------------------------------------


def training_curve(rows: Sequence[Mapping[str, float]]) -> Picture:
    """Draw what training reported (`on_iteration`, or a specialist's provenance["curve"])."""
    if not rows:
        raise ConfigError("training_curve needs at least one row: let the training run longer")
    figure = Picture(7.0, 6.5)
    tracking, level, loss = figure.subplots(3, 1, sharex=True)
    samples = np.array([row["samples"] for row in rows])
    for axes, key, label, colour in (
        (tracking, "r_v", "tracking reward r_v", "#0072B2"),
        (tracking, "failed", "share of episodes that fail", "#D55E00"),
        (level, "row", "mean difficulty row", "#009E73"),
        (loss, "feasibility_feasibility", "(f - r_v)²", "#0072B2"),
        (loss, "feasibility_reconstruction", "L_recon (m²)", "#E69F00"),
    ):
        if all(key in row for row in rows):
            values = [row[key] for row in rows]
            axes.plot(samples, values, ".-" if len(rows) < 3 else "-", color=colour, label=label)
            axes.legend(loc="best", fontsize=8, frameon=False)
        axes.grid(alpha=0.25)
    tracking.set(ylim=(0, 1.02))
    tracking.set_title("The policy learns to track its command ...", **TITLE, loc="left")
    level.set(ylim=(0, None))
    level.set_title("... on ever harder ground ...", **TITLE, loc="left")
    loss.set(yscale="log", xlabel="samples")
    loss.set_title("... and its Feasibility-Net learns from the same data", **TITLE, loc="left")
    return figure


def calibration_plot(table: Float[np.ndarray, "bins 3"], error: float) -> Picture:
    """Draw predicted against measured feasibility, from `evaluation.metrics.calibration`."""
    figure = Picture(5.0, 6.2)
    axes, counts = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    predicted, measured, count = np.asarray(table, dtype=float).T
    filled = count > 0
    axes.plot((0, 1), (0, 1), "--", color="grey", label="perfect: what is promised comes true")
    axes.plot(predicted[filled], measured[filled], "o-", color="#0072B2", label="this network")
    axes.vlines(predicted[filled], predicted[filled], measured[filled], color="#D55E00", alpha=0.6)
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="measured r_v")
    axes.legend(loc="upper left", frameon=False, fontsize=9)
    axes.set_title(f"Calibration: off by {error:.3f} on average", **TITLE, loc="left")
    edges = np.linspace(0, 1, len(count) + 1)
    counts.bar(edges[:-1], count, np.diff(edges), align="edge", color="#9DB8C9", edgecolor="white")
    counts.set(xlabel="predicted feasibility f", ylabel="patches")
    return figure


# What the pictures share --------------------------------------------------------------------------


def _size(grid: ElevationMap, width: float) -> tuple[float, float]:
    """Return the size of a picture of this map in inches, words included."""
    return width, float(np.clip((width - 1.2) * grid.size[1] / grid.size[0], 1.2, 9.0)) + 1.3


def _stage(grid: ElevationMap, axes: Axes | None) -> Axes:
    """Return axes in metres with the map's frame, on a new picture if there are none."""
    axes = axes or Picture(*_size(grid, 7.2)).subplots()
    x0, y0, x1, y1 = grid.extent
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", ylabel="y (m)")
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


def _legend(axes: Axes, colours: Mapping[str, str], more: Sequence[Line2D] = ()) -> None:
    """Name colours below the picture."""
    handles = [Patch(color=colour, label=name) for name, colour in colours.items()]
    panel = axes.get_figure(root=False)
    if panel is not None:
        panel.legend(
            handles=[*handles, *more],
            loc="outside lower center",
            ncols=len(handles) + len(more),
            frameon=False,
            fontsize=9,
            columnspacing=1.2,
            handlelength=1.2,
        )


def _show(axes: Axes, grid: ElevationMap, colours: Float[np.ndarray, "nx ny 3"]) -> None:
    """Show one colour a cell."""
    x0, y0, x1, y1 = grid.extent
    # An image is [row = y, column = x]: transpose; its first row lies at the bottom: origin lower.
    axes.imshow(
        colours.transpose(1, 0, 2), origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest"
    )


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


def _fit(name: str, values: ArrayLike, grid: ElevationMap) -> Float[np.ndarray, "nx ny 8"]:
    """Return a tensor in numpy; raises `ConfigError` if it is not of this map."""
    array = np.asarray(values)
    shape = (*grid.shape, directions.NUM_HEADINGS)
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
