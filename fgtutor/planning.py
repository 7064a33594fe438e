"""Plan a route: Dijkstra's search over the fused feasibility tensor.

Reads F_max and the policy map P (numpy or torch, [nx, ny, 8]), the map they belong to, a start and
a goal in metres; gives a `Route` that says for every step the heading, the policy and why.
Source: paper, Sec. III-C (edge cost 1 / F_max, policy by Eq. 7). The switching cost is ours: the
paper names its absence as a limit of the method.

Every cell is a node, and F_max[ix, iy, k] >= f_min makes an edge to the neighbour along heading k.
`as_networkx` builds that graph for reading; for speed, `Planner` hands the same graph to scipy and
searches it once, backwards from the goal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import networkx
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csgraph, csr_array

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
from fgtutor.routes import Route

__all__ = ["Planner", "Route", "as_networkx", "as_switching_networkx", "plan"]

Cell = tuple[int, int]
Point = tuple[float, float]


def plan(
    fused: ArrayLike,
    policy_map: ArrayLike,
    *,
    grid: ElevationMap,
    start: Point,
    goal: Point,
    backend: str = "auto",
    cost: str = "inverse",
    f_min: float = 0.1,
    switch_cost: float = 0.0,
    tensors: Sequence[ArrayLike] | None = None,
    ood: Sequence[ArrayLike] | None = None,
    names: Sequence[str] | None = None,
    unknown: str = "block",
) -> Route:
    """Return the cheapest route from `start` to `goal`, points (x, y) in metres.

    `backend` is "networkx", "scipy" or "auto"; both find the same cost, and "auto" is scipy, which
    won at every size measured (benchmarks/bench_plan.py). The other settings are `Planner`'s.

    Raises:
        OffMapError, UnknownCellError, InfeasibleCellError: Start or goal cannot be used.
        UnreachableError: No chain of edges joins them.
        ConfigError: A setting has a value without meaning.
        PlanningError: An array does not fit the map.
    """
    planner = Planner(
        fused=fused,
        policy_map=policy_map,
        grid=grid,
        cost=cost,
        f_min=f_min,
        switch_cost=switch_cost,
        tensors=tensors,
        ood=ood,
        names=names,
        unknown=unknown,
    )
    _choose("backend", backend, ("auto", "networkx", "scipy"))
    if backend == "networkx":
        return planner.search_networkx(start, goal)
    planner.cell_of(start, "start")  # an unusable start need not wait for the search
    return planner.towards(goal).route(start)


def as_networkx(
    fused: Float[np.ndarray, "nx ny 8"],
    policy_map: Int[np.ndarray, "nx ny 8"],
    *,
    f_min: float = 0.1,
    cost: str = "inverse",
    resolution: float = 1.0,
) -> networkx.DiGraph:
    """Build the graph the paper describes: node (ix, iy), one edge for every feasible step.

    Edges carry `weight`, `heading`, `policy` and `feasibility`. `resolution` (m) matters only for
    `cost="length"`.
    """
    graph = networkx.DiGraph()
    graph.add_nodes_from(np.ndindex(fused.shape[:2]))
    for ix, iy, heading in np.argwhere(fused >= f_min).tolist():
        dx, dy = directions.STEPS[heading].tolist()
        neighbour = (ix + dx, iy + dy)
        if neighbour in graph:
            feasibility = float(fused[ix, iy, heading])
            graph.add_edge(
                (ix, iy),
                neighbour,
                weight=float(_step_cost(feasibility, heading, cost, resolution)),
                heading=heading,
                policy=int(policy_map[ix, iy, heading]),
                feasibility=feasibility,
            )
    return graph


def as_switching_networkx(
    tensors: Float[np.ndarray, "policies nx ny 8"],
    switch_cost: float,
    *,
    f_min: float = 0.1,
    cost: str = "inverse",
    resolution: float = 1.0,
) -> networkx.DiGraph:
    """Build the graph whose node (ix, iy, policy) also remembers which policy led to the cell.

    A step with another policy costs `switch_cost` more, and exists only where both are feasible.
    """
    graph = networkx.DiGraph()
    for new, tensor in enumerate(tensors):
        one_policy = as_networkx(
            tensor, np.full(tensor.shape, new), f_min=f_min, cost=cost, resolution=resolution
        )
        graph.add_nodes_from((*cell, new) for cell in one_policy)
        for tail, head, edge in one_policy.edges(data=True):
            for old, old_tensor in enumerate(tensors):
                if old_tensor[(*tail, edge["heading"])] >= f_min:
                    weight = edge["weight"] + switch_cost * (old != new)
                    graph.add_edge((*tail, old), (*head, new), **edge | {"weight": weight})
    return graph


@dataclass(kw_only=True, eq=False)
class Planner:
    """Everything a search needs to know, checked once; `towards` a goal it answers many starts."""

    fused: ArrayLike
    """F_max [nx, ny, 8], from `fusion.fuse`."""
    policy_map: ArrayLike
    """P [nx, ny, 8], from `fusion.fuse`."""
    grid: ElevationMap
    """The map that was tensorized."""
    cost: str = "inverse"
    """Edge cost: "inverse" is 1 / F (the paper), "length" is that times the step's metres."""
    f_min: float = 0.1
    """Edges with a lower F do not exist; above 0."""
    switch_cost: float = 0.0
    """Cost of changing the policy, in the unit of `cost`; above 0 the search needs `tensors`, and
    the policy changes only for a step that the old and the new policy can both take."""
    tensors: Sequence[ArrayLike] | None = None
    """F_i [nx, ny, 8] of every policy."""
    ood: Sequence[ArrayLike] | None = None
    """w_ood [nx, ny, 8] of every policy, for explanations only."""
    names: Sequence[str] | None = None
    """Names of the policies; default: "policy 0" and so on."""
    unknown: str = "block"
    """What to do with unknown cells: "block" closes them, "fill" trusts the tensors there."""

    def __post_init__(self) -> None:
        _choose("cost", self.cost, ("inverse", "length"))
        _choose("unknown", self.unknown, ("block", "fill"))
        if not (math.isfinite(self.f_min) and self.f_min > 0):
            raise ConfigError(f"f_min must be above 0 (an edge costs 1 / F), got {self.f_min}")
        if not (math.isfinite(self.switch_cost) and self.switch_cost >= 0):
            raise ConfigError(f"switch_cost must be finite and >= 0, got {self.switch_cost}")
        if self.switch_cost > 0 and self.tensors is None:
            raise ConfigError("switch_cost > 0 needs the F_i of all policies: tensors=[F_1, ...]")
        self._fused = self._fit("fused", [self.fused])[0]
        self._policy_map = self._fit("policy_map", [self.policy_map])[0].astype(np.int64)
        self._tensors = None if self.tensors is None else self._fit("tensors", self.tensors)
        self._ood = None if self.ood is None else self._fit("ood", self.ood)
        count = len(self._tensors) if self._tensors is not None else self._policy_map.max() + 1
        self._names = tuple(self.names or (f"policy {i}" for i in range(count)))
        if self._policy_map.min() < 0 or not self._policy_map.max() < count <= len(self._names):
            raise PlanningError(
                f"P holds policies {self._policy_map.min()} to {self._policy_map.max()}, with "
                f"{count} tensors and {len(self._names)} names: give one of each for every policy"
            )

    def _fit(self, name: str, arrays: Sequence[ArrayLike]) -> np.ndarray:
        """Stack arrays in float64, or raise `PlanningError` if they do not fit the map."""
        shape = (*self.grid.shape, directions.NUM_HEADINGS)
        stacked = [np.asarray(array) for array in arrays]
        for array in stacked:
            if array.shape != shape:
                raise PlanningError(
                    f"{name}: expected shape {shape} from the map, got {array.shape}; "
                    "tensorize and plan on the same map"
                )
            if not np.isfinite(array).all():
                raise PlanningError(f"{name} holds NaN or infinity: check the Feasibility-Nets")
        return np.stack(stacked).astype(np.float64)

    @cached_property
    def layers(self) -> Float[np.ndarray, "layers nx ny 8"]:
        """The tensors that are searched: F where there is an edge, 0 elsewhere.

        One layer, F_max, while switching is free: then P decides. Else one layer a policy.
        """
        layers = self._fused[None]
        if self.switch_cost > 0 and self._tensors is not None:
            layers = self._tensors
        usable = self.grid.known | (self.unknown == "fill")
        allowed = np.zeros(self._fused.shape, dtype=bool)
        for heading, tail, head in _steps(self.grid.shape):
            allowed[(*tail, heading)] = usable[tail] & usable[head]
        return np.where(allowed & (layers >= self.f_min), layers, 0.0)

    def towards(self, goal: Point) -> Tree:
        """Search backwards from the goal to every cell, with scipy."""
        tail, head, weight = self._edges()
        states = self.layers[..., 0].size
        # Rows of the matrix are where an edge starts: swapping tail and head reverses the search.
        reverse = csr_array((weight, (head, tail)), shape=(states, states))
        distance, towards, _ = csgraph.dijkstra(
            reverse,
            indices=self._states(self.cell_of(goal, "goal")),
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

    def _edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """List tail, head and weight of every edge between states (layer, ix, iy), flattened."""
        states = np.arange(self.layers[..., 0].size).reshape(self.layers.shape[:3])
        tails, heads, weights = [], [], []
        for heading, tail, head in _steps(self.grid.shape):
            for new, layer in enumerate(self.layers):
                feasibility = layer[(*tail, heading)]
                for old, old_layer in enumerate(self.layers):
                    edge = (feasibility > 0) & (old_layer[(*tail, heading)] > 0)
                    tails.append(states[old][tail][edge])
                    heads.append(states[new][head][edge])
                    weights.append(
                        _step_cost(feasibility[edge], heading, self.cost, self.grid.resolution)
                        + self.switch_cost * (old != new)
                    )
        return np.concatenate(tails), np.concatenate(heads), np.concatenate(weights)

    def _states(self, cell: Cell) -> list[int]:
        """Return the states of a cell, one a layer."""
        cells = self.grid.heights.size
        flat = int(np.ravel_multi_index(cell, self.grid.shape))
        return [layer * cells + flat for layer in range(len(self.layers))]

    def _route(self, states: ArrayLike) -> Route:
        """Tell the story of a chain of states."""
        layer, ix, iy = np.unravel_index(np.asarray(states), self.layers.shape[:3])
        cells = np.stack((ix, iy), axis=-1)
        match = (np.diff(cells, axis=0)[:, None] == directions.STEPS).all(axis=-1)
        headings = match.argmax(axis=-1)
        at = (ix[:-1], iy[:-1], headings)
        x, y = self.grid.centres
        many = len(self.layers) > 1
        feasibility = self.layers[(layer[1:], *at)]
        costs = _step_cost(feasibility, headings, self.cost, self.grid.resolution)
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
        x, y = point
        if not self.grid.contains(x, y):
            x0, y0, x1, y1 = self.grid.extent
            raise OffMapError(
                f"the {role} ({x:g}, {y:g}) m is off the map, which covers x {x0:g}..{x1:g} m and "
                f"y {y0:g}..{y1:g} m: move the {role} inside, or load a larger map"
            )
        cell = self.grid.cell_of(x, y)
        if self.unknown == "block" and not self.grid.known[cell]:
            raise UnknownCellError(
                f"the {role} ({x:g}, {y:g}) m lies on cell {cell}, which was never observed: move "
                f'the {role}, scan that place, or trust filled heights with unknown="fill"'
            )
        return cell

    def _check_open(self, start: Point, goal: Point) -> None:
        """Raise unless some step leaves the start and some step enters the goal."""
        cell, end = self.grid.cell_of(*start), self.grid.cell_of(*goal)
        leaving = self.layers.max(axis=0)
        cure = f"lower f_min = {self.f_min:g}, or add a specialist for this terrain"
        if not leaving[cell].any():
            best = int(self._fused[cell].argmax())
            raise InfeasibleCellError(
                f"no policy can leave the start ({start[0]:g}, {start[1]:g}) m, cell {cell}: its "
                f"best F_max is {self._fused[cell][best]:.3g}, towards {directions.NAMES[best]}; "
                f"move the start, {cure}"
            )
        entered = np.zeros(self.grid.shape, dtype=bool)
        for heading, tail, head in _steps(self.grid.shape):
            entered[head] |= leaving[(*tail, heading)] > 0
        if not entered[end]:
            raise InfeasibleCellError(
                f"no policy can enter the goal ({goal[0]:g}, {goal[1]:g}) m, cell {end}, from any "
                f"of its neighbours; move the goal, {cure}"
            )

    def _unreachable(self, start: Point, goal: Point) -> UnreachableError:
        return UnreachableError(
            f"start ({start[0]:g}, {start[1]:g}) m, cell {self.grid.cell_of(*start)}, and goal "
            f"({goal[0]:g}, {goal[1]:g}) m, cell {self.grid.cell_of(*goal)}, can both be used, but "
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


def _steps(shape: tuple[int, int]) -> Iterator[tuple[int, tuple, tuple]]:
    """Give for every heading the cells that have a neighbour there, and those neighbours."""
    for heading, step in enumerate(directions.STEPS.tolist()):
        tail = tuple(slice(max(-d, 0), n - max(d, 0)) for d, n in zip(step, shape, strict=True))
        head = tuple(slice(max(d, 0), n - max(-d, 0)) for d, n in zip(step, shape, strict=True))
        yield heading, tail, head


def _step_cost(
    feasibility: ArrayLike, heading: int | np.ndarray, cost: str, resolution: float
) -> np.ndarray:
    """Return 1 / F, times the step's length in metres for `cost="length"`."""
    inverse = 1.0 / np.asarray(feasibility, dtype=np.float64)
    if cost == "inverse":
        return inverse
    return inverse * directions.STEP_LENGTHS[heading] * resolution


def _choose(setting: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise `ConfigError` unless `value` is one of `choices`."""
    if value not in choices:
        raise ConfigError(f"{setting} must be one of {', '.join(choices)}, got {value!r}")
