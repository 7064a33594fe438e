"""Unseen maps of the capstone: their cases, right routes, and what is wrong with others.

Draws mixed maps of the toy from the seed of an instructor, assessed by the shipped specialists
(Sec. III-B); judges a route by its own cost and by that of the cheapest one, which scipy finds.
"""

from functools import lru_cache
from typing import Any

import numpy as np

from fgtutor.directions import STEPS
from fgtutor.io.machine import one_thread

F_MIN = 0.1
"""Least feasibility of an edge."""
TOLERANCE = 1.01
"""How much dearer than the cheapest a route may be."""
NEWCOMERS = "gaps", "rubble"
"""Without either of them no mixed map can be crossed."""
BESIDE = 3
"""Rows of cells at either side of a map that are left out: no patch fits there."""

Cell = tuple[int, int]
"""A cell (ix, iy)."""


def map_case(rng: np.random.Generator) -> tuple:
    """Draw a mixed map: F of three specialists, F of the newcomer, f_min, start and goal."""
    newcomer = str(rng.choice(NEWCOMERS))
    tensors, start, goal = _assessed(int(rng.integers(2**31)))
    others = [tensor.copy() for name, tensor in tensors.items() if name != newcomer]
    return others, tensors[newcomer].copy(), F_MIN, start, goal


@lru_cache(maxsize=8)
@one_thread()
def _assessed(seed: int) -> tuple[dict[str, np.ndarray], Cell, Cell]:
    """Return F of each shipped specialist on a mixed map, and the cells of start and goal."""
    from fgtutor.specialist import load_zoo
    from fgtutor.tensorization import assess_all
    from fgtutor.world.terrain import make_terrain

    terrain = make_terrain("mixed", robot="toy", seed=seed)
    grid = terrain.elevation
    inner = slice(BESIDE, grid.shape[1] - BESIDE)
    tensors = {
        name: assessment.weighted()[:, inner].numpy().copy()
        for name, assessment in assess_all(grid, load_zoo("toy")).items()
    }
    for tensor in tensors.values():  # steps to where the map was cut off
        tensor[:, 0, STEPS[:, 1] < 0] = 0.0
        tensor[:, -1, STEPS[:, 1] > 0] = 0.0
    (sx, sy), (gx, gy) = grid.cell_of(*terrain.start), grid.cell_of(*terrain.goal)
    return tensors, (sx, sy - BESIDE), (gx, gy - BESIDE)


def map_answers(
    target: "Any",
    others: "list[np.ndarray]",
    newcomer: "np.ndarray",
    f_min: float,
    start: tuple,
    goal: tuple,
) -> tuple:
    """Return the learner's routes before and after the newcomer joins the others."""
    import numpy as np

    answers = []
    for tensors in (others, [*others, newcomer]):
        cells, policies = target(np.stack(tensors), f_min, start, goal)
        answers += [np.asarray(cells).reshape(-1, 2), np.asarray(policies).reshape(-1)]
    return tuple(answers)


def map_faults(
    answer: Any,
    others: list[np.ndarray],
    newcomer: np.ndarray,
    f_min: float,
    start: Cell,
    goal: Cell,
) -> dict[str, str]:
    """Return what is wrong with the routes before and after the newcomer joins."""
    found = {}
    for when, tensors, route in (
        ("Before the newcomer joins", np.stack(others), answer[:2]),
        ("With the newcomer", np.stack([*others, newcomer]), answer[2:]),
    ):
        cells, policies = route
        for kind, says in _route_faults(cells, policies, tensors, f_min, start, goal).items():
            found[f"{kind}, {when}"] = f"{when}: {says}"
    return found


def _route_faults(
    cells: Any, policies: Any, tensors: np.ndarray, f_min: float, start: Cell, goal: Cell
) -> dict[str, str]:
    """Return what is wrong with one route, the gravest fault alone."""
    cells, policies = np.asarray(cells), np.asarray(policies)
    best, _ = _cheapest(_costs(tensors.max(axis=0), f_min), start, goal)
    if not len(cells):
        missed = f"the route was refused, although there is one that costs {best:.1f}."
        return {"refused": missed} if np.isfinite(best) else {}
    if [tuple(cells[0].tolist()), tuple(cells[-1].tolist())] != [start, goal]:
        said = f"the route leads from {cells[0].tolist()} to {cells[-1].tolist()}"
        return {"ends": f"{said}, not from {list(start)} to {list(goal)}."}
    headings = (np.diff(cells, axis=0)[:, None] == STEPS).all(axis=-1)
    if not headings.any(axis=-1).all():
        jump = int((~headings.any(axis=-1)).argmax())
        pair = f"{cells[jump].tolist()} and {cells[jump + 1].tolist()}"
        return {"steps": f"cells {pair} follow each other, and are no neighbours."}
    if len(policies) != len(cells) - 1:
        return {"count": f"{len(policies)} policies for {len(cells) - 1} steps: one for each step."}
    if cells.min() < 0 or (cells >= tensors.shape[1:3]).any():
        return {"map": "the route leaves the map."}
    along = tensors[policies.astype(int), cells[:-1, 0], cells[:-1, 1], headings.argmax(axis=-1)]
    shut = np.flatnonzero(along < f_min)
    if len(shut):
        where = f"step {shut[0]}, out of {cells[shut[0]].tolist()}, by policy {policies[shut[0]]}"
        kind = "closed" if np.isfinite(best) else "reckless"
        return {kind: f"{where}, has F = {along[shut[0]]:.2g}, below f_min = {f_min}."}
    cost = float((1 / along.astype(float)).sum())
    if cost > TOLERANCE * best:
        return {"dear": f"the route costs {cost:.1f}; the cheapest one costs {best:.1f}."}
    return {}


# Right answers ------------------------------------------------------------------------------------


def _costs(fused: np.ndarray, f_min: float) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.where(fused >= f_min, 1 / fused.astype(float), np.inf)


def _cheapest(costs: np.ndarray, start: Cell, goal: Cell) -> tuple[float, np.ndarray]:
    """Return the cost of the cheapest route and its cells [n, 2]; infinity and none without one."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    nx, ny, _ = costs.shape
    ix, iy, k = np.nonzero(np.isfinite(costs))
    there = np.stack((ix, iy), axis=-1) + STEPS[k]
    inside = ((there >= 0) & (there < (nx, ny))).all(axis=-1)
    ix, iy, k, there = ix[inside], iy[inside], k[inside], there[inside]
    edges = costs[ix, iy, k], (ix * ny + iy, there[:, 0] * ny + there[:, 1])
    first, last = start[0] * ny + start[1], goal[0] * ny + goal[1]
    cost, before = dijkstra(
        csr_array(edges, shape=(nx * ny, nx * ny)), indices=first, return_predecessors=True
    )
    if not np.isfinite(cost[last]):
        return np.inf, np.zeros((0, 2), dtype=int)
    nodes = [last]
    while nodes[-1] != first:
        nodes.append(before[nodes[-1]])
    return float(cost[last]), np.array([divmod(int(node), ny) for node in nodes[::-1]])


def face_map(
    tensors: np.ndarray, f_min: float, start: Cell, goal: Cell, flaw: str = ""
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of the cheapest route and the policy of each step, or with a flaw."""
    fused, policy = tensors.max(axis=0), tensors.argmax(axis=0)
    if flaw == "worst":
        policy = tensors.argmin(axis=0)
    costs = _costs(fused, f_min)
    if flaw == "steps":
        costs = np.where(np.isfinite(costs), 1.0, np.inf)
    if flaw == "reckless":
        costs = 1 / np.maximum(fused.astype(float), 1e-4)
    if flaw == "one":
        every = [_cheapest(_costs(tensor, f_min), start, goal) for tensor in tensors]
        number = int(np.argmin([cost for cost, _ in every]))
        cells, policy = every[number][1], np.full(policy.shape, number)
    else:
        _, cells = _cheapest(costs, start, goal)
    headings = (np.diff(cells, axis=0)[:, None] == STEPS).all(axis=-1).argmax(axis=-1)
    at = cells[:-1]
    policies = policy[at[:, 0], at[:, 1], headings] if len(cells) else np.zeros(0, dtype=int)
    if flaw == "backwards":
        return cells[::-1], policies[::-1]
    if flaw == "cells":
        return cells, np.append(policies, policies[-1:])
    return cells, policies


def flawed_route(flaw: str) -> Any:
    """Return a planner with a flaw."""
    return lambda *given: face_map(*given, flaw=flaw)
