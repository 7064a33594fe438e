"""Plan a route: Dijkstra's search over the fused feasibility tensor.

Reads F_max and the policy map P (numpy or torch, [nx, ny, 8]), the map they belong to, a start and
a goal in metres; gives a `Route` that says for every step the heading, the policy and why.
Source: paper, Sec. III-C (edge cost 1 / F_max, policy by Eq. 7). The switching cost is ours: the
paper names its absence as a limit of the method.

Every cell is a node, and F_max[ix, iy, k] >= f_min makes an edge to the neighbour along heading k.
`graphs` builds that graph twice: for reading in networkx, and for speed in scipy, which `Planner`
searches once, backwards from the goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import networkx
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csgraph

from fgtutor import directions
from fgtutor.elevation import ElevationMap
from fgtutor.errors import (
    ConfigError,
    InfeasibleCellError,
    OffMapError,
    PlanningError,
    UnknownCellError,
    UnreachableError,
)
from fgtutor.graphs import (
    CURE,
    EDGE,
    READABLE_STEP,
    STATE,
    as_networkx,
    as_switching_networkx,
    reversed_graph,
    step_cost,
    steps_of,
)
from fgtutor.grid import coordinate_text, point_text
from fgtutor.io.machine import require_memory
from fgtutor.io.validation import NonNegative, Positive, check_fields, numbers
from fgtutor.routes import Route

__all__ = ["Planner", "Route", "as_networkx", "as_switching_networkx", "plan"]

Cell = tuple[int, int]
Point = tuple[float, float]
Backend = Literal["auto", "networkx", "scipy"]
Cost = Literal["inverse", "length"]
Unknown = Literal["block", "fill"]


def plan(
    fused: ArrayLike,
    policy_map: ArrayLike,
    *,
    grid: ElevationMap,
    start: Point,
    goal: Point,
    backend: Backend = "auto",
    cost: Cost = "inverse",
    f_min: Positive = 0.1,
    switch_cost: NonNegative = 0.0,
    tensors: Sequence[ArrayLike] | None = None,
    ood: Sequence[ArrayLike] | None = None,
    names: Sequence[str] | None = None,
    unknown: Unknown = "block",
) -> Route:
    """Return the cheapest route from `start` to `goal`, points (x, y) in metres.

    `backend` is "networkx", "scipy" or "auto"; both find the same cost, and "auto" is scipy, which
    won at every size measured (benchmarks/bench_plan.py). The other settings are `Planner`'s.

    Raises:
        OffMapError, UnknownCellError, InfeasibleCellError: Start or goal cannot be used.
        UnreachableError: No chain of edges joins them.
        ConfigError: A setting has a value without meaning.
        PlanningError: An array does not fit the map.
        TooLargeError: The graph does not fit into memory.
    """
    planner = Planner(
        fused=fused,
        policy_map=policy_map,
        grid=grid,
        backend=backend,
        cost=cost,
        f_min=f_min,
        switch_cost=switch_cost,
        tensors=tensors,
        ood=ood,
        names=names,
        unknown=unknown,
    )
    return planner.search(start, goal)


@dataclass(kw_only=True, eq=False)
class Search:
    """How a route is searched, whatever the map; checked when it is made."""

    backend: Backend = "auto"
    """Which library searches."""
    cost: Cost = "inverse"
    """Edge cost: "inverse" is 1 / F (the paper), "length" is that times the step's metres."""
    f_min: Positive = 0.1
    """Edges with a lower F do not exist; above 0."""
    switch_cost: NonNegative = 0.0
    """Cost of changing the policy, in the unit of `cost`; above 0 the search needs `tensors`, and
    the policy changes only for a step that the old and the new policy can both take."""
    unknown: Unknown = "block"
    """What to do with unknown cells: "block" closes them, "fill" trusts the tensors there."""

    def __post_init__(self) -> None:
        check_fields(self)

    def check_memory(self, grid: ElevationMap, policies: int) -> None:
        """Raise `TooLargeError` if an open map of this size is too large to plan on.

        Without free memory Linux would end the process, after it has tensorized for minutes.
        """
        cells = grid.heights.size
        layers = policies if self.switch_cost else 1
        arrays = (4 + 2 * policies) * cells * directions.NUM_HEADINGS * 8
        edges = cells * layers * (directions.NUM_HEADINGS + layers - 1)
        search = edges * EDGE + cells * layers * STATE
        require_memory(arrays + search, f"planning over {_size(grid)} for {policies}", CURE)


@dataclass(kw_only=True, eq=False)
class Planner(Search):
    """Everything a search needs to know, checked once; `towards` a goal it answers many starts."""

    fused: ArrayLike
    """F_max [nx, ny, 8], from `fusion.fuse`."""
    policy_map: ArrayLike
    """P [nx, ny, 8], from `fusion.fuse`."""
    grid: ElevationMap
    """The map that was tensorized."""
    tensors: Sequence[ArrayLike] | None = None
    """F_i [nx, ny, 8] of every policy."""
    ood: Sequence[ArrayLike] | None = None
    """w_ood [nx, ny, 8] of every policy, for explanations only."""
    names: Sequence[str] | None = None
    """Names of the policies; default: "policy 0" and so on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.switch_cost > 0 and self.tensors is None:
            raise ConfigError("switch_cost > 0 needs the F_i of all policies: tensors=[F_1, ...]")
        lists = {"tensors": self.tensors, "ood": self.ood, "names": self.names}
        given = {what: len(one) for what, one in lists.items() if one is not None}
        self.check_memory(self.grid, given.get("tensors", 0) + given.get("ood", 0))
        self._fused = self._fit("fused", [self.fused])[0]
        policy_map = self._fit("policy_map", [self.policy_map])[0]
        self._policy_map = policy_map.astype(np.int64, copy=False)
        if (policy_map != self._policy_map).any():
            raise ConfigError("policy_map holds fractions: give each policy's index, as fuse does")
        self._tensors = None if self.tensors is None else self._fit("tensors", self.tensors)
        self._ood = None if self.ood is None else self._fit("ood", self.ood)
        low, high = int(self._policy_map.min()), int(self._policy_map.max())
        if low < 0 or len(set(given.values())) > 1 or high >= min(given.values(), default=high + 1):
            counts = ", ".join(f"{number} {what}" for what, number in given.items())
            raise PlanningError(
                f"P holds policies {low} to {high}, with {counts or 'nothing else'} given: "
                "policies count from 0, give one of each for every policy"
            )
        count = min(given.values(), default=high + 1)
        names = (f"policy {i}" for i in range(count)) if self.names is None else self.names
        self._names = tuple(names)
        texts = all(isinstance(name, str) for name in self._names)
        if not texts or isinstance(self.names, str) or len(set(self._names)) < len(self._names):
            raise ConfigError(f"each policy needs a name of its own, got {self.names!r}")

    def _fit(self, name: str, arrays: Sequence[ArrayLike]) -> np.ndarray:
        """Stack arrays, or raise `PlanningError` if they do not fit the map."""
        if not len(arrays):
            raise PlanningError(f"{name} is empty: give one array for every policy")
        shape = (*self.grid.shape, directions.NUM_HEADINGS)
        each = [numbers(name, array, PlanningError) for array in arrays]
        for array in each:
            if array.shape != shape:
                raise PlanningError(
                    f"{name}: expected shape {shape} from the map, got {array.shape}; "
                    "tensorize and plan on the same map"
                )
        return np.stack(each)

    @cached_property
    def layers(self) -> Float[np.ndarray, "layers nx ny 8"]:
        """The tensors that are searched: F where there is an edge, 0 elsewhere.

        One layer, F_max, while switching is free: then P decides. Else one layer a policy.
        """
        layers = self._fused[None]
        if self.switch_cost > 0 and self._tensors is not None:
            layers = self._tensors
        layers = layers.astype(np.result_type(layers.dtype, np.float32), copy=False)
        usable = self.grid.known | (self.unknown == "fill")
        allowed = np.zeros(self._fused.shape, dtype=bool)
        for heading, tail, head in steps_of(self.grid.shape):
            allowed[(*tail, heading)] = usable[tail] & usable[head]
        return np.where(allowed & (layers >= np.float64(self.f_min)), layers, layers.dtype.type(0))

    def search(self, start: Point, goal: Point) -> Route:
        """Return the cheapest route, with the library that `backend` names; raises as `plan`."""
        if self.backend == "networkx":
            return self.search_networkx(start, goal)
        self.cell_of(start, "start")  # an unusable start need not wait for the search
        return self.towards(goal).route(start)

    def towards(self, goal: Point) -> Tree:
        """Search backwards from the goal to every cell, with scipy."""
        end = self.cell_of(goal, "goal")
        reverse = reversed_graph(self.layers, self.switch_cost, self.cost, self.grid.resolution)
        distance, towards, _ = csgraph.dijkstra(
            reverse,
            indices=self._states(end),
            return_predecessors=True,
            min_only=True,
        )
        return Tree(self, goal, distance.reshape(self.layers.shape[:3]), towards)

    def search_networkx(self, start: Point, goal: Point) -> Route:
        """Search forwards from the start in the graph that people read."""
        ends = self.cell_of(start, "start"), self.cell_of(goal, "goal")
        if ends[0] == ends[1]:
            return self._route([self._states(ends[0])[0]])
        self._check_open(start, goal)
        steps = int(np.count_nonzero(self.layers)) * len(self.layers)
        cure = f'{CURE}, or with backend="scipy"'
        require_memory(steps * READABLE_STEP, f"a networkx graph of {_size(self.grid)}", cure)
        settings = {"f_min": self.f_min, "cost": self.cost, "resolution": self.grid.resolution}
        many = len(self.layers) > 1
        if many:
            graph = as_switching_networkx(self.layers, self.switch_cost, **settings)
        else:
            graph = as_networkx(self.layers[0], self._policy_map, **settings)
        sources, targets = (
            [(*cell, layer) for layer in range(len(self.layers))] if many else [cell]
            for cell in ends
        )
        # Any policy may arrive: free edges lead from all of them to one last node.
        graph.add_edges_from(((target, "goal") for target in targets), weight=0.0)
        try:
            _, path = networkx.multi_source_dijkstra(graph, sources, target="goal")
        except networkx.NetworkXNoPath:
            raise self._unreachable(start, goal) from None
        nodes = np.array([node for node in path if node != "goal"])
        layer = nodes[:, 2] if many else np.zeros(len(nodes), dtype=int)
        cells = np.ravel_multi_index((layer, nodes[:, 0], nodes[:, 1]), self.layers.shape[:3])
        return self._route(cells)

    def _states(self, cell: Cell) -> list[int]:
        """Return the states of a cell, one a layer."""
        cells = self.grid.heights.size
        flat = int(np.ravel_multi_index(cell, self.grid.shape))
        return [layer * cells + flat for layer in range(len(self.layers))]

    def _route(self, states: ArrayLike) -> Route:
        """Tell the story of a chain of states; of a cell's states the first one came there."""
        layer, ix, iy = np.unravel_index(np.asarray(states), self.layers.shape[:3])
        came = np.append(True, (np.diff(ix) != 0) | (np.diff(iy) != 0))
        layer, ix, iy = layer[came], ix[came], iy[came]
        cells = np.stack((ix, iy), axis=-1)
        match = (np.diff(cells, axis=0)[:, None] == directions.STEPS).all(axis=-1)
        headings = match.argmax(axis=-1)
        at = (ix[:-1], iy[:-1], headings)
        x, y = self.grid.centres
        many = len(self.layers) > 1
        feasibility = self.layers[(layer[1:], *at)]
        costs = step_cost(feasibility, headings, self.cost, self.grid.resolution)
        return Route(
            cells=cells,
            xy=np.stack((x[ix], y[iy]), axis=-1),
            headings=headings,
            policies=layer[1:] if many else self._policy_map[at],
            feasibility=feasibility,
            costs=costs + self.switch_cost * (np.diff(layer) != 0),
            length=float(directions.STEP_LENGTHS[headings].sum() * self.grid.resolution),
            names=self._names,
            choices=None if self._tensors is None else self._tensors[(slice(None), *at)].T,
            ood=None if self._ood is None else self._ood[(slice(None), *at)].T,
        )

    def cell_of(self, point: Point, role: str) -> Cell:
        """Return the cell of the start or goal, or say why it cannot be one."""
        return usable_cell(self.grid, point, role, self.unknown)

    def _check_open(self, start: Point, goal: Point) -> None:
        """Raise unless some step leaves the start and some step enters the goal."""
        cell, end = self.grid.cell_of(*start), self.grid.cell_of(*goal)
        leaving = self.layers.max(axis=0)
        cure = f"lower f_min = {self.f_min:g}, or add a specialist for this terrain"
        if not leaving[cell].any():
            best = int(self._fused[cell].argmax())
            raise InfeasibleCellError(
                f"no policy can leave the start {self._text(start)} m, cell {cell}: its "
                f"best F_max is {self._fused[cell][best]:.3g}, towards {directions.NAMES[best]}; "
                f"move the start, {cure}"
            )
        entered = np.zeros(self.grid.shape, dtype=bool)
        for heading, tail, head in steps_of(self.grid.shape):
            entered[head] |= leaving[(*tail, heading)] > 0
        if not entered[end]:
            raise InfeasibleCellError(
                f"no policy can enter the goal {self._text(goal)} m, cell {end}, from any "
                f"of its neighbours; move the goal, {cure}"
            )

    def _text(self, point: Point) -> str:
        return point_text(point, self.grid.resolution)

    def _unreachable(self, start: Point, goal: Point) -> UnreachableError:
        return UnreachableError(
            f"start {self._text(start)} m, cell {self.grid.cell_of(*start)}, and goal "
            f"{self._text(goal)} m, cell {self.grid.cell_of(*goal)}, can both be used, but "
            f"no chain of steps with F >= {self.f_min:g} joins them: lower f_min, move one of them "
            "or add a specialist (tensorization.why_blocked names what closes a cell)"
        )


@dataclass(frozen=True, eq=False)
class Tree:
    """All cheapest ways to one goal: replanning from a new start is a walk down this tree."""

    planner: Planner
    """What was searched."""
    goal: Point
    """Where every way ends, m."""
    distance: Float[np.ndarray, "layers nx ny"]
    """Cost to the goal of each state; infinite where there is no way."""
    towards: Int[np.ndarray, " states"]
    """The next state on the way to the goal; negative at its end."""

    @property
    def cost_to_goal(self) -> Float[np.ndarray, "nx ny"]:
        """Cost to the goal from each cell, with the best first policy."""
        return self.distance.min(axis=0)

    def route(self, start: Point) -> Route:
        """Return the cheapest route from `start`; raises what `plan` raises."""
        planner = self.planner
        cell = planner.cell_of(start, "start")
        distance = self.distance[(slice(None), *cell)]
        if not np.isfinite(distance).any():
            planner._check_open(start, self.goal)
            raise planner._unreachable(start, self.goal)
        states = [planner._states(cell)[int(distance.argmin())]]
        while (state := int(self.towards[states[-1]])) >= 0:
            states.append(state)
        return planner._route(states)


def usable_cell(grid: ElevationMap, point: Point, role: str, unknown: Unknown = "block") -> Cell:
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


def _size(grid: ElevationMap) -> str:
    return f"{grid.shape[0]} x {grid.shape[1]} cells"
