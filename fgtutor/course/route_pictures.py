"""Pictures of planning and driving: the graph, routes side by side, a drive over its route.

Reads graphs, routes, episodes and the map below them; gives matplotlib figures, as `figures.maps`
does for one route.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import networkx
import numpy as np
from matplotlib.collections import LineCollection

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import draw_elevation, draw_route
from fgtutor.figures.panels import legend
from fgtutor.figures.style import INK, TITLE, Panels, Picture, policy_colours
from fgtutor.io.validation import check_arguments
from fgtutor.routes import Refusal, Route

if TYPE_CHECKING:
    from fgtutor.execution import Episode

WORDS = 100
"""Letters that fit below a picture as wide as the page."""


def draw_graph(
    graph: networkx.DiGraph,
    grid: ElevationMap,
    path: Sequence[tuple[int, int]] = (),
    names: Sequence[str] = (),
) -> Picture:
    """Draw a small graph on its map: an arrow for every step, the wider the more feasible.

    The arrows of `path` carry their costs; `names` are the policies, which give the colours.
    """
    title = "The graph: one node per cell, one arrow per step"
    figure = draw_elevation(grid, title=title, caption="The fuller an arrow, the cheaper")
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
    legend(axes, colours)
    return figure  # pyright: ignore[reportReturnType]


def compare_routes(
    elevation: ElevationMap, routes: Mapping[str, Route | Refusal | str], *, columns: Panels = 2
) -> Picture:
    """Draw routes over one map side by side; where there is none, say why, or the given words."""
    check_arguments(compare_routes, locals(), ConfigError)
    rows = -(-len(routes) // columns)
    width = 7.6 / columns
    figure = Picture(7.6, rows * (width * elevation.size[1] / elevation.size[0] + 0.8) + 0.4)
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    used: dict[str, str] = {}
    for axes, (caption, route) in zip(panels, routes.items(), strict=False):
        draw_elevation(elevation, axes=axes, bare=True)
        words = route
        if isinstance(route, Refusal):
            reason = route.reason.partition(": ")[0]  # what to change is for another place
            words = textwrap.fill(reason, WORDS // columns)
        elif isinstance(route, Route):
            draw_route(route, elevation, axes=axes, bare=True)
            words = f"{route.length:.1f} m, policy switches: {route.switches}"
            colours = list(policy_colours(route.names).values())
            used |= {route.names[i]: colours[i] for i in np.unique(route.policies).tolist()}
        axes.set_title(caption, **TITLE, loc="left")
        axes.set_xlabel(f"x (m)\n{words}", fontsize=9)
    panels[0].set_ylabel("y (m)", fontsize=9)
    for axes in panels[len(routes) :]:
        axes.remove()
    legend(panels[0], used)
    return figure


def draw_drive(episode: Episode, route: Route, elevation: ElevationMap) -> Picture:
    """Draw the driven way, coloured by the active policy, over the planned route in white."""
    caption = "White: the route. Colour: the policy that drove. "
    caption += f"{episode.length:.1f} m in {episode.seconds:.0f} s, "
    caption += f"policy switches: {episode.switches}"
    title = f"Driven ({episode.reason}) over planned"
    figure = draw_elevation(elevation, title=title, caption=caption)
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
    legend(axes, {route.names[i]: colours[i] for i in np.unique(episode.policies).tolist()})
    return figure  # pyright: ignore[reportReturnType]
