"""The graphs that planning searches: one in networkx to read, the same one in scipy to be fast.

Reads feasibility tensors [nx, ny, 8]; gives graphs whose nodes are cells, or cells with a policy
once a change of policy costs something.
Source: paper, Sec. III-C (edge cost 1 / F_max). The switching cost is ours.
"""

from collections.abc import Iterator

import networkx
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from fgtutor import directions
from fgtutor.io.machine import require_memory

READABLE_STEP, EDGE, STATE = 700, 14, 64
"""Bytes that a search needs: per step of a networkx graph, per edge and per state of scipy's (an
index, a weight and its check; a node of its heap, a distance and the next state). Measured."""
STRIP_CELLS = 1 << 13
"""Cells whose edges are listed at a time."""
_ORDER = np.argsort(directions.STEPS @ (-(1 << 20), -1))
"""Headings by the cell they come from: scipy keeps the edges that enter a cell in that order."""
_RANKS = np.argsort(_ORDER)
CURE = "plan on a part of the map (ElevationMap.crop), on coarser cells, or with switch_cost=0"


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
                weight=float(step_cost(feasibility, heading, cost, resolution)),
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


def steps_of(shape: tuple[int, int]) -> Iterator[tuple[int, tuple, tuple]]:
    """Give for every heading the cells that have a neighbour there, and those neighbours."""
    for heading, step in enumerate(directions.STEPS.tolist()):
        tail = tuple(slice(max(-d, 0), n - max(d, 0)) for d, n in zip(step, shape, strict=True))
        head = tuple(slice(max(d, 0), n - max(-d, 0)) for d, n in zip(step, shape, strict=True))
        yield heading, tail, head


def step_cost(
    feasibility: ArrayLike, heading: int | np.ndarray, cost: str, resolution: float
) -> np.ndarray:
    """Return 1 / F, times the step's length in metres for `cost="length"`."""
    inverse = 1.0 / np.asarray(feasibility, dtype=np.float64)
    if cost == "inverse":
        return inverse
    return inverse * directions.STEP_LENGTHS[heading] * resolution


def reversed_graph(
    layers: Float[np.ndarray, "layers nx ny 8"], switch_cost: float, cost: str, resolution: float
) -> csr_array:
    """Build the graph of all layers backwards, for a search from the goal: row head, column tail.

    States are (layer, ix, iy), flattened; a value of 0 is no edge. Costs are those of
    `as_networkx`, and of `as_switching_networkx` where there are several layers. An edge for every
    pair of policies and heading would be 8 K^2 a cell. Mostly the old policy can take every step
    that the new one can: then one edge, which stays in the cell, changes the policy for all of
    them. Raises `TooLargeError` if the graph does not fit into memory.
    """
    count, nx, ny, _ = layers.shape
    able = layers > 0
    pairs = {
        new: [(old, *_changes(able[old], able[new])) for old in range(count) if old != new]
        for new in range(count)
    }
    total = int(np.count_nonzero(able)) + sum(
        int(np.count_nonzero(part)) for rows in pairs.values() for _, *both in rows for part in both
    )
    states = count * nx * ny
    require_memory(
        total * EDGE + states * STATE,
        f"searching {nx} x {ny} cells with {total} edges of {count} layer(s)",
        CURE,
        fits=total < 2**31,  # scipy's search counts edges in 32 bits
    )
    columns, weights = np.empty(total, dtype=np.int32), np.empty(total)
    starts, filled = [np.zeros(1, dtype=np.int32)], 0
    for new, rows in pairs.items():
        entering = _entering(layers[new])
        along = [(old, inside, _entering(steps)) for old, inside, steps in rows]
        for first in range(0, nx, max(1, STRIP_CELLS // ny)):
            strip = slice(first, min(first + max(1, STRIP_CELLS // ny), nx))
            ends, column, weight = _edges_into(
                entering[strip],
                [(old, inside[strip], steps[strip]) for old, inside, steps in along],
                new=new,
                switch_cost=switch_cost,
                cost=cost,
                resolution=resolution,
                cells=(first * ny, nx * ny),
            )
            columns[filled : filled + len(column)] = column
            weights[filled : filled + len(column)] = weight
            starts.append((filled + ends).astype(np.int32))
            filled += len(column)
    graph = csr_array((states, states))
    graph.indptr, graph.indices, graph.data = np.concatenate(starts), columns, weights
    return graph


def _changes(
    old: Bool[np.ndarray, "nx ny 8"], new: Bool[np.ndarray, "nx ny 8"]
) -> tuple[Bool[np.ndarray, "nx ny"], Bool[np.ndarray, "nx ny 8"]]:
    """Say where the policy may change for every step of the new one, and else for which steps."""
    inside = np.asarray((old | ~new).all(axis=-1) & new.any(axis=-1))
    return inside, old & new & ~inside[..., None]


def _entering(leaving: np.ndarray) -> np.ndarray:
    """Move what is said of the step that leaves a cell to where it ends, in the order of tails."""
    moved = np.zeros_like(leaving)
    for heading, tail, head in steps_of(leaving.shape[:2]):
        moved[(*head, _RANKS[heading])] = leaving[(*tail, heading)]
    return moved


def _edges_into(
    feasibility: Float[np.ndarray, "rows ny 8"],
    changes: list[tuple[int, np.ndarray, np.ndarray]],
    *,
    new: int,
    switch_cost: float,
    cost: str,
    resolution: float,
    cells: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the edges that end in a strip of one layer: their number up to each state, tail, weight.

    `cells` are the first cell of the strip and the number of all cells. Steps stand in the order
    of `_entering`.
    """
    first, layer = cells
    steps = -(directions.STEPS[_ORDER] @ (feasibility.shape[1], 1))  # from its end to its start
    # A ninth kind of edge stays in the cell and costs nothing but the change.
    costs = np.zeros((feasibility[..., 0].size, 9))
    with np.errstate(divide="ignore"):  # a step that is not there has F = 0, and is not taken
        costs[:, :8] = step_cost(feasibility, _ORDER, cost, resolution).reshape(-1, 8)
    # One slot for each edge that a state can have: is it there, its tail, its kind, its extra.
    there, offset = [feasibility > 0], [new * layer + steps]
    for old, inside, along in changes:
        there += [along, inside[..., None]]
        offset.append(old * layer + np.append(steps, 0))
    offset = np.concatenate(offset)
    kind = np.append(np.arange(8), np.tile(np.arange(9), len(changes)))
    extra = np.where(np.arange(len(kind)) < 8, 0.0, switch_cost)
    mask = np.concatenate(there, axis=-1).reshape(-1, len(kind))
    count = np.count_nonzero(mask, axis=1)
    cell = np.repeat(np.arange(len(mask)), count)
    slot = np.flatnonzero(mask) - cell * len(kind)
    weight = costs.ravel()[cell * 9 + kind[slot]] + extra[slot]
    return count.cumsum(), cell + (first + offset)[slot], weight
