"""Plan a route: Dijkstra's search over the fused feasibility tensor, or the reason there is none.

Reads F_max and the policy map P (numpy or torch, [nx, ny, d]), the map they belong to, a start and
a goal in metres; gives a `Route` that says for every step the heading, the policy and why, or a
`Refusal`. `plan_on_map` does every stage, from the map to the route.
Source: paper, Sec. III-C (edge cost 1 / F_max, policy by Eq. 7). The switching cost is ours: the
paper names its absence as a limit of the method.

Every cell is a node, and F_max[ix, iy, k] >= f_min makes an edge to the cell that the
step along heading k leads to.
`graphs` builds that graph and searches it, in networkx for reading and in scipy for speed; once
switching costs something, a node is a cell with a policy.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import (
    ConfigError,
    DoubtfulRouteError,
    InfeasibleCellError,
    OffMapError,
    PlanningError,
    TooLargeError,
    UnknownCellError,
    UnreachableError,
)
from fgtutor.fusion import fuse
from fgtutor.graphs import (
    Cell,
    Search,
    as_networkx,
    as_switching_networkx,
    check_memory,
    steps_of,
)
from fgtutor.grid import coordinate_text, point_text
from fgtutor.io.progress import QUICK, duration
from fgtutor.io.validation import numbers
from fgtutor.routes import Refusal, Route
from fgtutor.settings import HEADINGS, PAPER, SETTINGS, PlanSettings, Unknown
from fgtutor.specialist import Specialist
from fgtutor.tensorization import assess_all

__all__ = [
    "PAPER",
    "SETTINGS",
    "Plan",
    "PlanSettings",
    "Refusal",
    "Route",
    "as_networkx",
    "as_switching_networkx",
    "plan",
    "plan_on_map",
]

Point = tuple[float, float]

SURE = 0.5
"""A route that promises less fails more often than it arrives: `finer_headings` are tried too."""
RAISE = 0.05
"""By how much the least F of a step is raised to find a route that promises more."""
SECONDS_PER_STEP = 1.9e-7
"""What a search takes, in one call that cannot show how far it is (measured, 4 policies)."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The answer of `plan_on_map`, with every stage that led to it.

    The stages are empty where start or goal was never observed: then nothing was assessed.
    """

    names: tuple[str, ...]
    """The policies, in the order that indices count."""
    tensors: list[Tensor]
    """F_i of each policy, [nx, ny, d]."""
    weights: dict[str, Tensor]
    """w_ood of each policy that was assessed, [nx, ny, d], by name."""
    fused: Tensor
    """F_max, [nx, ny, d]."""
    policy_map: Tensor
    """P, [nx, ny, d]."""
    answer: Route | Refusal
    """The cheapest route, or why there is none."""

    @property
    def route(self) -> Route:
        """The cheapest route; raises the `PlanningError` of the refusal if there is none."""
        return self.answer.raise_for()

    def why_not(self, elevation: ElevationMap) -> list[str]:
        """Say for each policy what it finds of the step on from where the refusal says it fails.

        Empty where there is a route, or where the refusal is about the start or the goal itself.
        """
        if isinstance(self.answer, Route) or self.answer.nearest is None:
            return []
        headings = Headings.of(self.fused)
        at = (*elevation.cell_of(*self.answer.nearest), self.answer.heading)
        if not headings.steps_within(elevation.known)[at]:
            return ["The step on from there leads onto ground that was never observed."]
        place = point_text(self.answer.nearest, elevation.resolution)
        reasons = [f"On from {place} m towards {headings.names[at[-1]]}:"]
        for name, tensor in zip(self.names, self.tensors, strict=True):
            reason = f"{name}: F = {float(tensor[at]):.2f}"
            if name in self.weights:  # not of a tensor that was given
                w_ood = float(headings.least(self.weights[name].numpy())[at])
                known = "it knows such ground" if w_ood >= 0.5 else "it has hardly seen such ground"
                reason += f", w_ood = {w_ood:.2f} ({known})"
            reasons.append(reason)
        return reasons


def plan_on_map(
    elevation: ElevationMap,
    zoo: Mapping[str, Specialist],
    start: Point,
    goal: Point,
    *,
    settings: PlanSettings | None = None,
    tensors: Mapping[str, Tensor] | None = None,
    progress: bool = False,
    **changes: Any,
) -> Plan:
    """Tensorize `elevation` for every policy of `zoo`, fuse, and plan from `start` to `goal`.

    Where that finds no route, or one that promises less than `SURE`, it is done again along
    `finer_headings`, if those are more and fit into memory; the route that promises more is taken.
    `settings` are `PlanSettings()` unless given, `changes` change single ones of them by name.
    `tensors` may hold F_i already computed, by name: then their headings are the only ones tried.
    `progress` shows a bar if it takes long.

    Raises what `plan` and `assess_all` raise, at once where it can be known before the map is
    tensorized, and `ConfigError` for an empty zoo.
    """
    if not zoo:
        raise ConfigError("planning needs at least one specialist, the zoo is empty")
    settings = replace(settings or PlanSettings(), **changes)
    headings = Headings(settings.headings)
    check_memory(elevation.shape, len(zoo), settings.switch_cost, headings)
    try:
        for point, role in ((start, "start"), (goal, "goal")):
            usable_cell(elevation, point, role, settings.unknown)
    except UnknownCellError as error:  # known before the map is assessed, which may take minutes
        nothing = torch.empty(0)
        return Plan(tuple(zoo), [], {}, nothing, nothing, Refusal(error))
    known, weights = dict(tensors or {}), {}
    asked = {name: one for name, one in zoo.items() if name not in known}
    options = {"taus": settings.taus, "headings": settings.headings, "progress": progress}
    assessments = assess_all(elevation, asked, **options)
    for name in asked:  # each is let go as soon as it is weighted: large maps need the memory
        weights[name], known[name] = assessments.pop(name).weigh(unknown=settings.unknown)
    each = [known[name] for name in zoo]
    fused, policy_map = fuse(each)
    steps = elevation.heights.size * headings.count * (len(zoo) if settings.switch_cost else 1)
    if progress and steps * SECONDS_PER_STEP > QUICK:
        expected = duration(steps * SECONDS_PER_STEP)
        print(f"searching the route: about {expected}", file=sys.stderr)
    answer = plan(
        fused,
        policy_map,
        grid=elevation,
        start=start,
        goal=goal,
        settings=settings,
        tensors=each,
        names=tuple(zoo),
    )
    planned = Plan(tuple(zoo), each, weights, fused, policy_map, answer)
    more = finer(settings, answer)
    if more is None or tensors:
        return planned
    if progress:
        found = "a doubtful route" if answer else "no route"
        trying = f"trying {more.headings} headings"
        print(f"{found} along {settings.headings} headings: {trying}", file=sys.stderr)
    try:
        other = plan_on_map(elevation, zoo, start, goal, settings=more, progress=progress)
    except TooLargeError:  # then the first answer stands
        return planned
    return planned if stands(answer, other.answer) else other


def finer(settings: PlanSettings, answer: Route | Refusal) -> PlanSettings | None:
    """Return the settings to try after `answer`, those with `finer_headings` if they are more.

    None after a route that promises `SURE` (any, where `least_promise` is 0), and where the start
    or the goal was never observed.
    """
    if isinstance(answer, Route):
        enough = answer.promise >= SURE or not settings.least_promise
    else:
        enough = isinstance(answer.error, UnknownCellError)
    if enough or settings.finer_headings <= settings.headings:
        return None
    return replace(settings, headings=settings.finer_headings)


def stands(answer: Route | Refusal, other: Route | Refusal) -> bool:
    """Return whether an answer is no worse than what was tried after it."""
    if isinstance(answer, Route) and isinstance(other, Route):
        return answer.promise >= other.promise
    return isinstance(answer, Route)


def plan(
    fused: ArrayLike,
    policy_map: ArrayLike,
    *,
    grid: ElevationMap,
    start: Point,
    goal: Point,
    settings: PlanSettings | None = None,
    tensors: Sequence[ArrayLike] | None = None,
    ood: Sequence[ArrayLike] | None = None,
    names: Sequence[str] | None = None,
    **changes: Any,
) -> Route | Refusal:
    """Return the cheapest route from `start` to `goal`, points (x, y) in metres, or a `Refusal`.

    It is refused where start or goal was never observed or cannot be left or entered, where no
    chain of steps joins them, or where none was found that promises `least_promise`;
    `.raise_for()` of the answer gives the route or raises the reason.

    Args:
        fused: F_max [nx, ny, d], from `fusion.fuse`.
        policy_map: P [nx, ny, d], from `fusion.fuse`.
        grid: The map that was tensorized.
        start: Where the robot stands, m.
        goal: Where it shall go, m.
        settings: How to plan; default: `PlanSettings()`, which is ours.
        tensors: F_i [nx, ny, d] of every policy. A cost of switching needs them; without them, and
            if nothing else is asked for, switching is free.
        ood: w_ood [nx, ny, d] of every policy, for explanations only.
        names: Names of the policies; default: "policy 0" and so on.
        changes: Single fields of `PlanSettings` to change, such as `f_min=0.3`. The headings are
            those of the tensors; to ask for others is an error.

    Raises:
        OffMapError: Start or goal is off the map.
        ConfigError: A setting has a value without meaning.
        PlanningError: An array does not fit the map.
        TooLargeError: The graph does not fit into memory.
    """
    if settings is None and tensors is None:
        changes = {"switch_cost": 0.0} | changes
    chosen = replace(settings or PlanSettings(), **changes)
    said = "headings" in changes or chosen.headings != HEADINGS
    problem = _Problem(
        chosen,
        fused,
        policy_map,
        grid,
        tensors,
        ood,
        names,
        chosen.headings if said else None,
    )
    try:
        return problem.cheapest(start, goal)
    except (UnknownCellError, InfeasibleCellError) as error:
        return Refusal(error)


class _Problem:
    """What `plan` was given, checked, and the search over it."""

    def __init__(
        self,
        settings: PlanSettings,
        fused: ArrayLike,
        policy_map: ArrayLike,
        grid: ElevationMap,
        tensors: Sequence[ArrayLike] | None,
        ood: Sequence[ArrayLike] | None,
        names: Sequence[str] | None,
        headings: int | None,
    ) -> None:
        self.settings, self.grid = settings, grid
        if settings.switch_cost > 0 and tensors is None:
            raise ConfigError("switch_cost > 0 needs the F_i of all policies: tensors=[F_1, ...]")
        lists = {"tensors": tensors, "ood": ood, "names": names}
        given = {what: len(one) for what, one in lists.items() if one is not None}
        kept = given.get("tensors", 0) + given.get("ood", 0)
        fused = numbers("fused", fused, PlanningError)
        self.headings = Headings.of(fused)
        if headings not in (None, self.headings.count):
            raise ConfigError(
                f"fused holds {self.headings.count} headings, not {headings}: give "
                f"headings={headings} to tensorize, or leave it out here"
            )
        check_memory(grid.shape, kept, settings.switch_cost, self.headings)
        self.fused = self._fit("fused", [fused])[0]
        policies = self._fit("policy_map", [policy_map])[0]
        self.policy_map = policies.astype(np.int64, copy=False)
        if (policies != self.policy_map).any():
            raise ConfigError("policy_map holds fractions: give each policy's index, as fuse does")
        self.tensors = None if tensors is None else self._fit("tensors", tensors)
        self.ood = None if ood is None else self._fit("ood", ood)
        low, high = int(self.policy_map.min()), int(self.policy_map.max())
        if low < 0 or len(set(given.values())) > 1 or high >= min(given.values(), default=high + 1):
            counts = ", ".join(f"{number} {what}" for what, number in given.items())
            raise PlanningError(
                f"P holds policies {low} to {high}, with {counts or 'nothing else'} given: "
                "policies count from 0, give one of each for every policy"
            )
        count = min(given.values(), default=high + 1)
        self.names = tuple(names or (f"policy {i}" for i in range(count)))
        texts = all(isinstance(name, str) for name in self.names)
        if not texts or isinstance(names, str) or len(set(self.names)) < len(self.names):
            raise ConfigError(f"each policy needs a name of its own, got {names!r}")
        # What is searched: F where there is an edge, 0 elsewhere. One layer, F_max, while switching
        # is free: then P decides. Else one layer per policy.
        paid = self.tensors if settings.switch_cost > 0 else None
        layers = self.fused[None] if paid is None else paid
        layers = layers.astype(np.result_type(layers.dtype, np.float32), copy=False)
        trusted = np.logical_or(grid.known, settings.unknown == "fill")
        usable = self.headings.steps_within(trusted) & (layers >= np.float64(settings.f_min))
        self.layers = np.where(usable, layers, layers.dtype.type(0))
        self.search = Search(self.layers, settings.switch_cost, settings.cost, grid.resolution)

    def _fit(self, name: str, arrays: Sequence[ArrayLike]) -> np.ndarray:
        """Stack arrays, or raise `PlanningError` if they do not fit the map."""
        if not len(arrays):
            raise PlanningError(f"{name} is empty: give one array for every policy")
        shape = (*self.grid.shape, self.headings.count)
        each = [numbers(name, array, PlanningError) for array in arrays]
        for array in each:
            if array.shape != shape:
                raise PlanningError(
                    f"{name}: expected shape {shape} from the map, got {array.shape}; "
                    "tensorize and plan on the same map"
                )
        return np.stack(each)

    def cheapest(self, start: Point, goal: Point) -> Route | Refusal:
        """Return the cheapest route; an end that cannot be used is raised as `PlanningError`."""
        unknown = self.settings.unknown
        ends = tuple(
            usable_cell(self.grid, point, role, unknown)
            for point, role in ((start, "start"), (goal, "goal"))
        )
        if ends[0] == ends[1]:
            return self._route(np.array([[0, *ends[0]]]))
        self._check_open(start, goal)
        states = self._searched(self.search, *ends)
        if states is None:
            nearest, heading = self._nearest(self.search.reached(ends[0]), ends[1])
            most = max(get_args(HeadingCount))
            few = self.headings.count < most
            more = f"use headings={most}, which see ways between these, " if few else ""
            error = UnreachableError(
                f"start {self._text(start)} m, cell {ends[0]}, and goal {self._text(goal)} m, cell "
                f"{ends[1]}, can both be used, but no chain of steps with F >= "
                f"{self.settings.f_min:g} joins them: the place nearest to the goal that can be "
                f"reached is {self._text(nearest)} m; {more}lower f_min, move one of them or add a "
                "specialist (tensorization.why_blocked names what closes a cell)"
            )
            return Refusal(error, nearest, heading)
        return self._surer(self._route(states), *ends)

    def _searched(self, search: Search, start: Cell, goal: Cell) -> np.ndarray | None:
        """Return the cheapest chain of states."""
        networked = self.settings.backend == "networkx"
        return search.networkx(start, goal) if networked else search.scipy(start, goal)

    def _surer(self, cheapest: Route, start: Cell, goal: Cell) -> Route | Refusal:
        """Return the route; if it promises too little, one without its worst steps, or a refusal.

        The least F of a step is raised until the cheapest route promises enough or none is left.
        """
        route, floor = cheapest, self.settings.f_min
        while route.promise < self.settings.least_promise:
            floor += RAISE
            surer = replace(self.search, layers=np.where(self.layers >= floor, self.layers, 0))
            if (states := self._searched(surer, start, goal)) is None:
                return self._doubt(cheapest)
            route = self._route(states)
        return route

    def _doubt(self, route: Route) -> Refusal:
        """Refuse a route that promises too little, and say which of its steps is the worst."""
        worst = int(route.feasibility.argmin())
        place, F = self.grid.centre_of(*route.cells[worst].tolist()), route.feasibility[worst]
        error = DoubtfulRouteError(
            f"the cheapest route, {route.length:.2f} m long, promises {route.promise:.2f}, less "
            f"than least_promise = {self.settings.least_promise:g}, and no way round its worst "
            f"steps was found: the worst, with F = {F:.2f}, begins at {self._text(place)} m; move "
            "start or goal, add a specialist, or lower least_promise to walk it all the same"
        )
        return Refusal(error, place, int(route.headings[worst]))

    def _nearest(self, reached: np.ndarray, goal: Cell) -> tuple[Point, int]:
        """Return the reached cell nearest to the goal, m, and the heading on from it."""
        cells = np.argwhere(reached)
        cell = cells[((cells - goal) ** 2).sum(axis=1).argmin()]
        return self.grid.centre_of(*cell.tolist()), self.headings.towards(goal - cell)

    def _route(self, states: np.ndarray) -> Route:
        """Describe a chain of states (layer, ix, iy); of a cell's states the first came there."""
        came = np.append(True, np.diff(states[:, 1:], axis=0).any(axis=1))
        layer, cells = states[came, 0], states[came, 1:]
        headings = self.headings.index_of(np.diff(cells, axis=0))
        at = (*cells[:-1].T, headings)
        x, y = self.grid.centres
        policies = layer[1:] if self.settings.switch_cost > 0 else self.policy_map[at]
        feasibility = self.layers[(layer[1:], *at)]
        costs = self.search.step_cost(feasibility, headings)
        return Route(
            cells=cells,
            xy=np.stack((x[cells[:, 0]], y[cells[:, 1]]), axis=-1),
            headings=headings,
            policies=policies,
            feasibility=feasibility,
            costs=costs + self.settings.switch_cost * (np.diff(layer) != 0),
            length=float(self.headings.lengths[headings].sum() * self.grid.resolution),
            names=self.names,
            num_headings=self.headings.count,
            choices=None if self.tensors is None else self.tensors[(slice(None), *at)].T,
            ood=None if self.ood is None else self.ood[(slice(None), *at)].T,
        )

    def _check_open(self, start: Point, goal: Point) -> None:
        """Raise unless some step leaves the start and some step enters the goal."""
        cell, end = self.grid.cell_of(*start), self.grid.cell_of(*goal)
        leaving = self.layers.max(axis=0)
        cure = f"lower f_min = {self.settings.f_min:g}, or add a specialist for this terrain"
        if not leaving[cell].any():
            best = int(self.fused[cell].argmax())
            raise InfeasibleCellError(
                f"no policy can leave the start {self._text(start)} m, cell {cell}: its "
                f"best F_max is {self.fused[cell][best]:.3g}, towards {self.headings.names[best]}; "
                f"move the start, {cure}"
            )
        entered = np.zeros(self.grid.shape, dtype=bool)
        for heading, tail, head in steps_of(self.grid.shape, self.headings):
            entered[head] |= leaving[(*tail, heading)] > 0
        if not entered[end]:
            raise InfeasibleCellError(
                f"no policy can enter the goal {self._text(goal)} m, cell {end}, from any "
                f"of its neighbours; move the goal, {cure}"
            )

    def _text(self, point: Point) -> str:
        return point_text(point, self.grid.resolution)


def usable_cell(grid: ElevationMap, point: Point, role: str, unknown: Unknown) -> Cell:
    """Return the cell of the start or goal (`role`), or say why it cannot be one.

    Raises:
        OffMapError, UnknownCellError: The point is off the map, or was never observed.
        ConfigError: It is no point.
    """
    try:
        x, y = (float(value) for value in point)
    except (TypeError, ValueError):
        raise ConfigError(f"the {role} must be a point (x, y) in metres, got {point!r}") from None
    place = f"the {role} {point_text((x, y), grid.resolution)} m"
    if not grid.contains(x, y):
        x0, y0, x1, y1 = (coordinate_text(value, grid.resolution) for value in grid.extent)
        raise OffMapError(
            f"{place} is off the map, which covers x {x0}..{x1} m and y {y0}..{y1} m: move the "
            f"{role} inside, or load a larger map"
        )
    cell = grid.cell_of(x, y)
    if unknown == "block" and not grid.known[cell]:
        raise UnknownCellError(
            f"{place} lies on cell {cell}, which was never observed: move the {role}, scan that "
            'place, or trust filled heights with unknown="fill"'
        )
    return cell
