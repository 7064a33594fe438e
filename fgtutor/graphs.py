"""The graphs that planning searches, and Dijkstra's search: networkx to read, scipy to be fast.

Reads feasibility tensors [nx, ny, d]; gives graphs whose nodes are cells, or cells with a policy
once a change of policy costs something, and the cheapest chain of nodes between two cells.
Source: paper, Sec. III-C (edge cost 1 / F_max). The switching cost is ours.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import networkx
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csgraph, csr_array

from fgtutor.directions import Headings, Window, overlap
from fgtutor.io.machine import require_memory

Cell = tuple[int, int]

READABLE_STEP, EDGE, STATE = 700, 14, 64
"""Bytes that a search needs: per step of a networkx graph, per edge and per state of scipy's (an
index, a weight and its check; a node of its heap, a distance and the next state). Measured."""
LOOSE = 1.25
"""Beyond this multiple of the cost with free switching, a bound spares too few steps to pay."""
STRIP_CELLS = 1 << 13
"""Cells whose edges are listed at a time."""
CURE = "plan on a part of the map (ElevationMap.crop), on coarser cells, or with switch_cost=0"


def check_memory(
    shape: tuple[int, int], policies: int, switch_cost: float, headings: Headings
) -> None:
    """Raise `TooLargeError` if an open map of this shape is too large to plan on.

    Without free memory Linux would end the process, after it has tensorized for minutes.
    """
    cells = shape[0] * shape[1]
    layers = policies if switch_cost else 1
    arrays = (4 + 2 * policies) * cells * headings.count * 8
    edges = cells * layers * (headings.count + layers - 1)
    search = edges * EDGE + cells * layers * STATE
    work = f"planning over {shape[0]} x {shape[1]} cells for {policies}"
    require_memory(arrays + search, work, CURE)


def as_networkx(
    fused: Float[np.ndarray, "nx ny d"],
    policy_map: Int[np.ndarray, "nx ny d"],
    *,
    f_min: float = 0.1,
    cost: str = "inverse",
    resolution: float = 1.0,
) -> networkx.DiGraph:
    """Build the graph the paper describes: node (ix, iy), one edge for every feasible step.

    Edges carry `weight`, `heading`, `policy` and `feasibility`. `resolution` (m) matters only for
    `cost="length"`.
    """
    headings = Headings.of(fused)
    graph = networkx.DiGraph()
    graph.add_nodes_from(np.ndindex(fused.shape[:2]))
    for ix, iy, heading in np.argwhere(fused >= f_min).tolist():
        dx, dy = headings.steps[heading].tolist()
        neighbour = (ix + dx, iy + dy)
        if neighbour in graph:
            feasibility = float(fused[ix, iy, heading])
            graph.add_edge(
                (ix, iy),
                neighbour,
                weight=float(step_cost(feasibility, headings, heading, cost, resolution)),
                heading=heading,
                policy=int(policy_map[ix, iy, heading]),
                feasibility=feasibility,
            )
    return graph


def as_switching_networkx(
    tensors: Float[np.ndarray, "policies nx ny d"],
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


def steps_of(shape: tuple[int, int], headings: Headings) -> Iterator[tuple[int, Window, Window]]:
    """Give for every heading the cells whose step stays on the map, and where the steps end."""
    for heading, step in enumerate(headings.steps.tolist()):
        yield heading, *overlap(shape, step)


def step_cost(
    feasibility: ArrayLike,
    headings: Headings,
    heading: int | np.ndarray,
    cost: str,
    resolution: float,
) -> np.ndarray:
    """Return 1 / F, times the step's length in metres for `cost="length"`.

    The paper's eight headings all lead to a neighbour. A longer step replaces several of those and
    is no cheaper: for `cost="inverse"` it costs 1 / F for each of its king's moves.
    """
    inverse = 1.0 / np.asarray(feasibility, dtype=np.float64)
    if cost == "inverse":
        return inverse * headings.moves[heading]
    return inverse * headings.lengths[heading] * resolution


def reversed_graph(
    layers: Float[np.ndarray, "layers nx ny d"], switch_cost: float, cost: str, resolution: float
) -> csr_array:
    """Build the graph of all layers backwards, for a search from the goal: row head, column tail.

    States are (layer, ix, iy), flattened; a value of 0 is no edge. Costs are those of
    `as_networkx`, and of `as_switching_networkx` where there are several layers. An edge for every
    pair of policies and heading would be d K^2 per cell. Mostly the old policy can take every step
    that the new one can: then one edge, which stays in the cell, changes the policy for all of
    them. Raises `TooLargeError` if the graph does not fit into memory.
    """
    headings, (count, nx, ny, d) = Headings.of(layers), layers.shape
    able = _as_numbers(layers > 0)
    changes = {
        (old, new): _changes(able[old], able[new]) for old, new in permutations(range(count), 2)
    }
    total = int(np.count_nonzero(layers)) + sum(
        int(np.count_nonzero(inside)) + int(np.bitwise_count(along).sum())
        for inside, along in changes.values()
    )
    states = count * nx * ny
    require_memory(
        total * EDGE + states * STATE,
        f"searching {nx} x {ny} cells with {total} edges of {count} layer(s)",
        CURE,
        fits=total < 2**31,  # scipy's search counts edges in 32 bits
    )
    columns, weights = np.empty(total, dtype=np.int32), np.empty(total)
    degrees, filled = np.zeros(states + 1, dtype=np.int32), 0
    order = _order(headings)
    into = np.append(-(headings.steps[order] @ (ny, 1)), 0)  # from a step's end to its start
    for new in range(count):
        entering = _entering(layers[new], headings).reshape(-1, d)
        there, tails = [entering > 0], [new * nx * ny + into[:d]]
        for old in (old for old in range(count) if old != new):
            # One more kind of edge stays in the cell and costs nothing but the change.
            inside, along = changes[old, new]
            leaving = np.unpackbits(along.view(np.uint8), axis=-1, count=d).view(bool)
            there += [_entering(leaving, headings).reshape(-1, d), inside.reshape(-1, 1)]
            tails.append(old * nx * ny + into)
        tail = np.concatenate(tails).astype(np.int32)
        cells = np.flatnonzero((able[new].ravel() != 0) | there[0].any(axis=1)).astype(np.int32)
        for some in np.array_split(cells, -(-len(cells) // STRIP_CELLS) or 1):
            mask = np.concatenate([part[some] for part in there], axis=1)
            with np.errstate(divide="ignore"):  # where there is no step F is 0, and the mask False
                step = step_cost(entering[some], headings, order, cost, resolution)
            change = np.full((len(step), d + 1), float(switch_cost))
            change[:, :d] += step
            chosen = np.flatnonzero(mask)
            end = filled + len(chosen)
            columns[filled:end] = (some[:, None] + tail).ravel().take(chosen)
            cost_of = np.concatenate([step] + [change] * (count - 1), axis=1)
            weights[filled:end] = cost_of.ravel().take(chosen)
            degrees[1 + new * nx * ny + some] = mask.sum(axis=1, dtype=np.int32)
            filled = end
    starts = np.cumsum(degrees, dtype=np.int32)
    graph = csr_array((states, states))
    graph.indptr, graph.indices, graph.data = starts, columns, weights
    return graph


def _as_numbers(steps: Bool[np.ndarray, "*cells d"]) -> Int[np.ndarray, "*cells 1"]:
    """Return each set of steps as one number, a bit per heading: 1, 2, 4 or 8 bytes."""
    packed = np.packbits(steps, axis=-1)
    size = 1 << (packed.shape[-1] - 1).bit_length()
    wide = np.zeros((*packed.shape[:-1], size), dtype=np.uint8)
    wide[..., : packed.shape[-1]] = packed
    return wide.view(f"u{size}")


def _changes(
    old: Int[np.ndarray, "nx ny 1"], new: Int[np.ndarray, "nx ny 1"]
) -> tuple[Bool[np.ndarray, "nx ny 1"], Int[np.ndarray, "nx ny 1"]]:
    """Say where the policy may change for every step of the new one, and else for which steps."""
    inside = (new != 0) & (new & ~old == 0)
    return inside, np.where(inside, 0, old & new).astype(old.dtype)


def _order(headings: Headings) -> Int[np.ndarray, " d"]:
    """Sort headings by the cell they come from, as scipy keeps the edges that enter a cell."""
    return np.argsort(headings.steps @ (-(1 << 20), -1))


def _entering(leaving: np.ndarray, headings: Headings) -> np.ndarray:
    """Move what is said of the step that leaves a cell to where it ends, in the order of tails."""
    entering, ranks = np.zeros_like(leaving), np.argsort(_order(headings))
    for heading, tail, head in steps_of(leaving.shape[:2], headings):
        entering[(*head, ranks[heading])] = leaving[(*tail, heading)]
    return entering


@dataclass(frozen=True, eq=False)
class Search:
    """Dijkstra's search over layers of feasibility: one for free switching, else one per policy."""

    layers: Float[np.ndarray, "layers nx ny d"]
    """F of each step, 0 where there is none."""
    switch_cost: float
    """Cost of changing the layer, in the unit of `cost`."""
    cost: str
    """Cost of a step, as in `step_cost`."""
    resolution: float
    """Side of a cell, m."""

    @cached_property
    def headings(self) -> Headings:
        """What the layers' last axis counts."""
        return Headings.of(self.layers)

    def step_cost(self, feasibility: ArrayLike, heading: int | np.ndarray) -> np.ndarray:
        """Return what steps cost, as `step_cost` does."""
        return step_cost(feasibility, self.headings, heading, self.cost, self.resolution)

    def networkx(self, start: Cell, goal: Cell) -> Int[np.ndarray, "n 3"] | None:
        """Search forwards in the graph that people read; answer as `scipy`."""
        count = len(self.layers)
        steps = int(np.count_nonzero(self.layers)) * count
        cells = " x ".join(map(str, self.layers.shape[1:3]))
        cure = f'{CURE}, or with backend="scipy"'
        require_memory(steps * READABLE_STEP, f"a networkx graph of {cells} cells", cure)
        # What is closed has F = 0: any limit above 0 leaves it out.
        rules = {"f_min": np.finfo(float).tiny, "cost": self.cost, "resolution": self.resolution}
        if count > 1:
            graph = as_switching_networkx(self.layers, self.switch_cost, **rules)
        else:
            graph = as_networkx(self.layers[0], np.zeros(self.layers[0].shape, int), **rules)
        sources, targets = (
            [(*cell, layer) for layer in range(count)] if count > 1 else [cell]
            for cell in (start, goal)
        )
        # Any policy may arrive: free edges lead from all of them to one last node.
        graph.add_edges_from(((target, "goal") for target in targets), weight=0.0)
        try:
            _, path = networkx.multi_source_dijkstra(graph, sources, target="goal")
        except networkx.NetworkXNoPath:
            return None
        nodes = [tuple(node) for node in path if node != "goal"]
        return np.array([(*node[2:], *node[:2]) if count > 1 else (0, *node) for node in nodes])

    def scipy(self, start: Cell, goal: Cell) -> Int[np.ndarray, "n 3"] | None:
        """Return the cheapest chain of (layer, ix, iy), or None; searched backwards from the goal.

        With several layers it is searched only where it can lie. Switching for free is a graph with
        fewer nodes; driving its cheapest route with the best policies for it, every switch paid,
        costs `bound`. A step is of no use if the cheapest way to it, the step itself and the
        cheapest way on to the goal cost more than that even with free switching.
        """
        best = Search(self.layers.max(axis=0)[None], 0.0, self.cost, self.resolution)
        graph = best._reversed()
        free, distance = best._backwards(graph, start, goal)
        if free is None or len(self.layers) == 1:
            return free
        # Sums in another order differ in the last digits: nothing may be lost to that.
        bound = self._cost_along(free[:, 1:]) * (1 + 1e-9)
        if bound > LOOSE * distance.reshape(best.layers.shape[1:3])[start]:
            return self._backwards(self._reversed(), start, goal, bound)[0]
        keep = best._within(graph, start, distance, bound)
        used = np.append(np.argwhere(keep)[:, :2], [goal], axis=0)
        low, high = used.min(axis=0), used.max(axis=0)
        window = tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))
        part = np.where(keep[window], self.layers[(slice(None), *window)], 0)
        narrowed = replace(self, layers=part)
        ends = _minus(start, low), _minus(goal, low)
        states, _ = narrowed._backwards(narrowed._reversed(), *ends, bound)
        return None if states is None else states + np.array([0, *low])

    def reached(self, start: Cell) -> Bool[np.ndarray, "nx ny"]:
        """Return the cells that some chain of steps leads to."""
        graph, shape = self._reversed().T.tocsr(), self.layers.shape[:3]
        reached = np.zeros(shape, dtype=bool)
        for layer in range(shape[0]):
            first = int(np.ravel_multi_index((layer, *start), shape))
            states = csgraph.breadth_first_order(graph, first, return_predecessors=False)
            reached.flat[states] = True
        return np.logical_or.reduce(reached)

    def _reversed(self) -> csr_array:
        return reversed_graph(self.layers, self.switch_cost, self.cost, self.resolution)

    def _backwards(
        self, graph: csr_array, start: Cell, goal: Cell, limit: float = math.inf
    ) -> tuple[Int[np.ndarray, "n 3"] | None, Float[np.ndarray, " states"]]:
        """Search from the goal to every state nearer than `limit`: the chain, all distances."""
        count, nx, ny = shape = self.layers.shape[:3]
        first, last = (np.arange(count) * nx * ny + ix * ny + iy for ix, iy in (start, goal))
        distance, towards, _ = csgraph.dijkstra(
            graph, indices=last, return_predecessors=True, min_only=True, limit=limit
        )
        if not np.isfinite(distance[first]).any():
            return None, distance
        states = [int(first[distance[first].argmin()])]
        while (state := int(towards[states[-1]])) >= 0:
            states.append(state)
        return np.stack(np.unravel_index(states, shape), axis=-1), distance

    def _cost_along(self, cells: Int[np.ndarray, "n 2"]) -> float:
        """Return the least cost of driving along `cells`; infinite if policies cannot hand over."""
        headings = self.headings.index_of(np.diff(cells, axis=0))
        f = self.layers[:, cells[:-1, 0], cells[:-1, 1], headings]
        with np.errstate(divide="ignore"):
            costs = self.step_cost(f, headings)
        least = np.zeros(len(f))
        for cost in costs.T:  # a change needs the old and the new policy to be able to take a step
            able = np.isfinite(cost)
            if not able.any():
                return math.inf
            least = cost + np.minimum(least, least[able].min() + self.switch_cost)
        return float(least.min())

    def _within(
        self, graph: csr_array, start: Cell, distance: Float[np.ndarray, " cells"], bound: float
    ) -> Bool[np.ndarray, "nx ny d"]:
        """Return the steps of the only layer that lie on a chain which costs `bound` or less."""
        layer = self.layers[0]
        shape = layer.shape[:2]
        first = int(np.ravel_multi_index(start, shape))
        there = csgraph.dijkstra(graph.T.tocsr(), indices=first, limit=bound).reshape(shape)
        onward = distance.reshape(shape)
        keep = layer > 0
        with np.errstate(divide="ignore"):
            for heading, tail, head in steps_of(shape, self.headings):
                cost = self.step_cost(layer[(*tail, heading)], heading)
                keep[(*tail, heading)] &= there[tail] + cost + onward[head] <= bound
        return keep


def _minus(cell: Cell, corner: np.ndarray) -> Cell:
    """Count a cell from a corner of the map."""
    return int(cell[0] - corner[0]), int(cell[1] - corner[1])
