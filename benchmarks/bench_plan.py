"""Planning against networkx, rustworkx, igraph and scipy, on the same graph.

Ours is `plan`: from the tensors to the route. The others are given the edges as arrays, build their
own graph of them and search it; "search" leaves the building out. All must find the same cost.
rustworkx and igraph come with the extra `bench`, and are left out where they are absent.
"""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from harness import Row, Size, in_turns, ratios, row
from scipy.sparse import coo_array, csgraph, csr_array
from worlds import layers

from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.fusion import fuse
from fgtutor.graphs import reversed_graph
from fgtutor.planning import plan
from fgtutor.settings import PlanSettings

SLOW = 200_000
"""Edges beyond which every library is timed once: networkx takes seconds."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Edges of one graph, searched backwards: from any of `goals` to the nearest of `starts`."""

    graph: Any
    """A `csr_array` [states, states]: row tail, column head."""
    starts: np.ndarray
    goals: np.ndarray

    @property
    def edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tails, heads and weights; free edges lead from one more node to all goals."""
        coo, count = coo_array(self.graph), len(self.goals)
        tails = np.append(coo.row, np.full(count, self.graph.shape[0]))
        return tails, np.append(coo.col, self.goals), np.append(coo.data, np.zeros(count))


def networkx_graph(problem: Problem) -> Any:
    networkx = importlib.import_module("networkx")
    graph = networkx.DiGraph()
    graph.add_weighted_edges_from(zip(*(one.tolist() for one in problem.edges), strict=True))
    return graph


def networkx_cost(graph: Any, problem: Problem) -> float:
    networkx = importlib.import_module("networkx")
    if len(problem.starts) == 1:  # as a person would ask
        first = problem.graph.shape[0]
        return networkx.single_source_dijkstra(graph, first, int(problem.starts[0]))[0]
    costs = networkx.single_source_dijkstra_path_length(graph, problem.graph.shape[0])
    return min(costs[int(start)] for start in problem.starts)


def rustworkx_graph(problem: Problem) -> Any:
    graph = importlib.import_module("rustworkx").PyDiGraph()
    graph.add_nodes_from(range(problem.graph.shape[0] + 1))
    graph.add_edges_from(list(zip(*(one.tolist() for one in problem.edges), strict=True)))
    return graph


def rustworkx_cost(graph: Any, problem: Problem) -> float:
    lengths = importlib.import_module("rustworkx").dijkstra_shortest_path_lengths
    goal = int(problem.starts[0]) if len(problem.starts) == 1 else None
    costs = lengths(graph, problem.graph.shape[0], float, goal)
    return min(costs[int(start)] for start in problem.starts)


def igraph_graph(problem: Problem) -> Any:
    tails, heads, weights = problem.edges
    edges = np.stack((tails, heads), axis=-1)
    graph = importlib.import_module("igraph").Graph(problem.graph.shape[0] + 1, edges, True)
    graph.es["weight"] = weights
    return graph


def igraph_cost(graph: Any, problem: Problem) -> float:
    first, starts = problem.graph.shape[0], problem.starts.tolist()
    return min(graph.distances([first], starts, weights="weight")[0])


def scipy_graph(problem: Problem) -> csr_array:
    tails, heads, weights = problem.edges
    nodes = problem.graph.shape[0] + 1
    # Zero is an edge to scipy's search as long as it is stored.
    return csr_array((weights, (tails, heads)), shape=(nodes, nodes))


def scipy_cost(graph: csr_array, problem: Problem) -> float:
    costs = csgraph.dijkstra(graph, indices=problem.graph.shape[0])
    return float(costs[problem.starts].min())


LIBRARIES: dict[str, tuple[Callable[[Problem], Any], Callable[[Any, Problem], float]]] = {
    "networkx": (networkx_graph, networkx_cost),
    "rustworkx": (rustworkx_graph, rustworkx_cost),
    "igraph": (igraph_graph, igraph_cost),
    "scipy": (scipy_graph, scipy_cost),
}


def compare(cells: int, headings: int, switch_cost: float, rounds: int) -> Iterator[Row]:
    """Time one route from corner to corner, by `plan` and by each library that is there."""
    tensors = layers(cells, headings)
    fused, policy_map = fuse(list(tensors))
    grid = ElevationMap(np.zeros((cells, cells)))
    ends = {"start": grid.centre_of(1, 1), "goal": grid.centre_of(cells - 2, cells - 2)}

    def ours() -> float:
        options = {"tensors": list(tensors), "switch_cost": switch_cost}
        return plan(fused, policy_map, grid=grid, **ends, **options).raise_for().cost

    problem = same_graph(tensors if switch_cost else fused[None], grid, switch_cost)
    there = {name: way for name, way in LIBRARIES.items() if present(name)}
    graphs = {name: build(problem) for name, (build, _) in there.items()}
    cost = ours()
    for name, (_, search) in there.items():
        if not np.isclose(search(graphs[name], problem), cost, rtol=1e-6):
            raise AssertionError(f"{name} does not find the cost of plan, {cost}")
    ways: dict[str, Callable[[], object]] = {"ours": ours}
    for name, (build, search) in there.items():
        ways[name] = lambda b=build, s=search: s(b(problem), problem)
        ways[f"{name} search"] = lambda n=name, s=search: s(graphs[n], problem)
    times = in_turns(ways, 1 if problem.graph.nnz > SLOW else rounds)
    paid = "paid" if switch_cost else "free"
    place = f"{cells} x {cells}, {headings} headings, switching {paid}"
    for name in there:
        yield row("plan", f"{name} / ours, {place}", ratios(times, name, "ours"))
        alone = ratios(times, f"{name} search", "ours")
        yield row("plan", f"{name}, its search alone / ours, {place}", alone)


def same_graph(tensors: np.ndarray, grid: ElevationMap, switch_cost: float) -> Problem:
    """Return the graph that `plan` stands on, backwards from the goal in the far corner."""
    within = Headings.of(tensors).steps_within(grid.known)
    usable = within & (tensors >= PlanSettings().f_min)
    steps = np.where(usable, tensors, 0)
    graph = reversed_graph(steps, switch_cost, PlanSettings().cost, grid.resolution)
    first = np.arange(len(tensors)) * grid.heights.size
    near, far = (np.ravel_multi_index((at, at), grid.shape) for at in (1, grid.shape[0] - 2))
    return Problem(graph, first + near, first + far)


def present(name: str) -> bool:
    """Return whether a package is installed."""
    return importlib.util.find_spec(name) is not None


def rows(size: Size) -> Iterator[Row]:
    """Compare on maps of several sizes, 8 and 16 headings, free and paid switching."""
    sides, rounds = {"full": ((25, 256, 512), 5), "quick": ((25, 64), 3), "tiny": ((9,), 1)}[size]
    for cells in sides:
        for headings in (8, 16):
            for switch_cost in (0.0, 1.0):
                yield from compare(cells, headings, switch_cost, rounds)
