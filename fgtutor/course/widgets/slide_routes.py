"""Pictures of the slides that show routes: the price of a switch, gates, and who knows the ground.

Reads plans, tensors [nx, ny, d] and the values of the sliders; gives a picture whose `alt` says in
one sentence what came out. Routes are planned once per value. Nothing here knows the notebook.
Source: paper, Sec. III-C; the price of a switch is ours.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike

from fgtutor.course.widgets.panels import Point, feasibility_colours
from fgtutor.course.widgets.slide_curves import WIDTH, name_panel, sheet
from fgtutor.course.widgets.slide_maps import TALLEST, map_height, show_cells, show_map
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.style import INK, LINES, Picture, policy_colours
from fgtutor.planning import Plan, plan
from fgtutor.routes import Refusal, Route

SWITCH_COSTS = (0.0, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Costs of a switch that are tried, in the unit of the cost: metres of ground with F = 1."""
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
"""Curves differ in their dashes too, not in colour alone."""


class SwitchPrices:
    """One map planned with every cost of a switch in `SWITCH_COSTS`."""

    def __init__(
        self, elevation: ElevationMap, planned: Plan, start: Point, goal: Point, **changes: Any
    ) -> None:
        """Keep what `plan_on_map` gave; `changes` are fields of `PlanSettings`.

        Raises `ConfigError` if there is no route even where switching is free.
        """
        self.elevation = elevation
        answers = []
        for cost in SWITCH_COSTS:
            options: dict[str, Any] = changes | {"switch_cost": cost}
            options |= {"tensors": planned.tensors, "names": planned.names}
            fused, policies = planned.fused, planned.policy_map
            answers.append(plan(fused, policies, grid=elevation, start=start, goal=goal, **options))
        routes = [answer for answer in answers if isinstance(answer, Route)]
        if len(routes) < len(answers):
            refused = next(answer for answer in answers if isinstance(answer, Refusal))
            raise ConfigError(f"there is no route at every price of a switch: {refused.reason}")
        self.routes: dict[float, Route] = dict(zip(SWITCH_COSTS, routes, strict=True))
        """The cheapest route at each price."""

    def ground_cost(self, price: float) -> float:
        """Return what a route costs without its switches."""
        route = self.routes[price]
        return route.cost - price * route.switches

    def draw(self, price: float) -> Picture:
        """Draw the route at a price above, and below how switches and cost depend on the price."""
        route, tall = self.routes[price], map_height(self.elevation, TALLEST - 1.6)
        picture, (above, below) = sheet(tall + 2.1, rows=2, heights=(tall - 0.7, 1.4), gap=0.85)
        show_map(above, self.elevation)
        _route(above, route)
        at = np.arange(len(SWITCH_COSTS))
        switches = [self.routes[one].switches for one in SWITCH_COSTS]
        below.bar(at, switches, color="#9DB8C9")
        chosen = SWITCH_COSTS.index(price)
        below.bar(chosen, switches[chosen], color=LINES[0], hatch="//", edgecolor=INK)
        below.set_xticks(at, [f"{one:g}" for one in SWITCH_COSTS])
        other = below.twinx()
        extra = [self.ground_cost(one) - self.ground_cost(0.0) for one in SWITCH_COSTS]
        other.plot(at, extra, "o--", color=LINES[1])
        other.tick_params(labelsize=8)
        other.set_ylabel("harder ground (o)", fontsize=9)
        order = " → ".join(
            route.names[i]
            for i in route.policies[np.flatnonzero(np.diff(route.policies, prepend=-1))]
        )
        name_panel(above, f"A switch costs {price:g}: {order if len(order) < 75 else '...'}",
                   "x (m)", "y (m)")  # fmt: skip
        name_panel(below, "What a price on switching does", "cost of a switch", "switches (bars)")
        box = below.get_position()
        for axes in (below, other):
            axes.set_position((box.x0, box.y0, box.width - 0.06, box.height))
        picture.alt = (
            f"A switch costs {price:g}: {route.switches} switches, {route.length:.2f} m, cost of "
            f"the ground {self.ground_cost(price):.2f}"
        )
        return picture


class Gates:
    """Routes of several policies over one map, each by its own tensor, for any f_min."""

    def __init__(
        self,
        elevation: ElevationMap,
        tensors: Mapping[str, ArrayLike],
        start: Point,
        goal: Point,
    ) -> None:
        """Keep the tensors F [nx, ny, d] by name; raises `ConfigError` if there is none."""
        if not tensors:
            raise ConfigError("need at least one tensor F, by name: {name: plans[name][0]}")
        self.elevation, self.start, self.goal = elevation, start, goal
        self.tensors = {name: np.asarray(one) for name, one in tensors.items()}
        self.answer = lru_cache(maxsize=None)(self._answer)
        """The route of a policy at an f_min, or the refusal."""

    def _answer(self, name: str, f_min: float) -> Route | Refusal:
        F = self.tensors[name]
        return plan(F, np.zeros(F.shape, dtype=int), grid=self.elevation, start=self.start,
                    goal=self.goal, names=(name,), f_min=f_min)  # fmt: skip

    def draw(self, f_min: float) -> Picture:
        """Draw F of each policy with what `f_min` leaves open, and its route."""
        count = len(self.tensors)
        tall = map_height(self.elevation, TALLEST, (WIDTH - 0.75) / count - 0.35)
        picture, panels = sheet(tall, columns=count)
        said = []
        for axes, (name, F) in zip(panels, self.tensors.items(), strict=True):
            show_cells(axes, self.elevation, feasibility_colours(F.max(axis=-1), f_min))
            answer = self.answer(name, f_min)
            found = "no route"
            if isinstance(answer, Route):
                _route(axes, answer, "#D55E00")
                found = f"{answer.length:.1f} m"
            name_panel(axes, f"{name}: {found}", "x (m)", "y (m)" if axes is panels[0] else "")
            said.append(f"{name} {found}")
        picture.alt = f"f_min {f_min:.2f}: {', '.join(said)}. Bright: feasible; dark: closed"
        return picture


class Familiarity:
    """How familiar each policy finds the ground along a route: its w_ood at every step."""

    def __init__(
        self, route: Route, elevation: ElevationMap, weights: Mapping[str, ArrayLike]
    ) -> None:
        """Read w_ood [nx, ny, d] of each policy at the cells and headings of a route.

        Raises `ConfigError` for a route without steps, and without weights.
        """
        if not weights or not len(route.headings):
            raise ConfigError("need a route with steps, and w_ood of at least one policy")
        at = (*route.cells[:-1].T, route.headings)
        self.route, self.elevation = route, elevation
        self.along = {name: np.asarray(one)[at] for name, one in weights.items()}
        """w_ood at each step, by policy."""
        steps = np.hypot(*np.diff(route.xy, axis=0).T)
        self.metres = np.cumsum(steps) - steps
        """Distance at which each step begins, m."""

    def draw(self, metre: float) -> Picture:
        """Draw the place on the route after some metres, and what every policy knows there."""
        route, at = self.route, int(np.searchsorted(self.metres, metre, side="right")) - 1
        tall = map_height(self.elevation, TALLEST - 1.8)
        picture, (above, below) = sheet(tall + 2.4, rows=2, heights=(tall - 0.7, 1.6), gap=0.85)
        show_map(above, self.elevation)
        _route(above, route)
        x, y = route.xy[at]
        above.plot(x, y, "D", color="white", markeredgecolor="black", markersize=9, zorder=6)
        colours = policy_colours([*self.along])
        for (name, w_ood), dashes in zip(
            self.along.items(), DASHES * len(self.along), strict=False
        ):
            below.plot(self.metres, w_ood, linestyle=dashes, color=colours[name], label=name)
        theirs = policy_colours(route.names)
        bars = [theirs[route.names[i]] for i in route.policies]
        below.scatter(self.metres, np.full(len(bars), -0.09), c=bars, marker="s", s=14)
        below.axvline(self.metres[at], color=INK)
        below.set(ylim=(-0.16, 1.05), xlim=(0, route.length))
        below.legend(frameon=False, fontsize=8, ncols=len(self.along), loc="upper center",
                     bbox_to_anchor=(0.5, 1.26))  # fmt: skip
        name_panel(below, "", "metres along the route; squares: who drives", "w_ood")
        driver = route.names[route.policies[at]]
        name_panel(above, f"At {self.metres[at]:.1f} m drives {driver}", "x (m)", "y (m)")
        each = ", ".join(f"{name} {w_ood[at]:.2f}" for name, w_ood in self.along.items())
        picture.alt = f"At {self.metres[at]:.1f} m, x {x:.2f} m, drives {driver}; w_ood: {each}"
        return picture


def _route(axes: Axes, route: Route, colour: str = "") -> None:
    """Draw a route in one colour, or in those of its policies."""
    own = policy_colours(route.names)
    colours = [colour or own[route.names[policy]] for policy in route.policies]
    edges = list(np.stack((route.xy[:-1], route.xy[1:]), axis=1))
    for line in ({"colors": "white", "linewidths": 5}, {"colors": colours, "linewidths": 2.8}):
        axes.add_collection(LineCollection(edges, capstyle="round", **line))
    for (x, y), marker, size in ((route.xy[0], "o", 7), (route.xy[-1], "*", 13)):
        axes.plot(x, y, marker, color="white", markeredgecolor="black", markersize=size, zorder=5)
