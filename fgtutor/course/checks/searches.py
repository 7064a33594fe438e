"""Searches of exercise 06: right answers and typical mistakes of its questions about routes.

Gives costs and cells of cheapest routes without a heap: all edges are relaxed until nothing changes
(Bellman-Ford), so that they share nothing with what learners write. `costs[ix, iy, k]` is paid for
leaving a cell along heading k; infinity says that there is no route (Sec. III-C).
"""

import numpy as np

from fgtutor.directions import STEPS

Cell = tuple[int, int]
"""A cell (ix, iy)."""


def cheapest(costs: np.ndarray, start: Cell, goal: Cell) -> float:
    """Return the cost of the cheapest route."""
    nx, ny, _ = costs.shape
    best = np.full((nx + 2, ny + 2), np.inf)
    best[goal[0] + 1, goal[1] + 1] = 0.0
    for _ in range(nx * ny):
        onward = [
            costs[..., k] + best[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny]
            for k, (dx, dy) in enumerate(STEPS)
        ]
        inner = best[1:-1, 1:-1]
        better = np.minimum(inner, np.min(onward, axis=0))
        if np.array_equal(better, inner):
            break
        best[1:-1, 1:-1] = better
    return float(best[start[0] + 1, start[1] + 1])


def fewest_steps(costs: np.ndarray, start: Cell, goal: Cell) -> float:
    """Return the cost of the route of fewest steps: a mistake."""
    toll = 1e4  # dearer than any route, so that the number of steps decides
    return cheapest(costs + toll, start, goal) % toll


def both_ways(costs: np.ndarray, start: Cell, goal: Cell) -> float:
    """Return the cost if the cheaper of an edge's two directions is taken for both: a mistake."""
    around = np.pad(costs, ((1, 1), (1, 1), (0, 0)), constant_values=np.inf)
    nx, ny, _ = costs.shape
    back = [
        around[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny, (k + 4) % 8]
        for k, (dx, dy) in enumerate(STEPS)
    ]
    return cheapest(np.minimum(costs, np.stack(back, axis=-1)), start, goal)


def cells_of_route(costs: np.ndarray, start: Cell, goal: Cell, last: bool = True) -> np.ndarray:
    """Return the cells [n, 2] of the cheapest route, the goal with `last` only; (0, 2) if none."""
    if not np.isfinite(cheapest(costs, start, goal)):
        return np.zeros((0, 2), dtype=int)
    cells, shape = [start], costs.shape[:2]
    while cells[-1] != goal:
        here = cells[-1]
        onward = [(here[0] + int(dx), here[1] + int(dy)) for dx, dy in STEPS]
        left = [
            costs[(*here, k)] + cheapest(costs, cell, goal)
            if all(0 <= i < n for i, n in zip(cell, shape, strict=True))
            else np.inf
            for k, cell in enumerate(onward)
        ]
        cells.append(onward[int(np.argmin(left))])
    return np.array(cells if last else cells[:-1])


def switching(
    tensors: np.ndarray,
    f_min: float,
    switch_cost: float,
    start: Cell,
    goal: Cell,
    *,
    first: bool = False,
    forbidden: bool = False,
    every: bool = False,
) -> float:
    """Return the least cost of a route with its switches; tensors are [policies, nx, ny, 8].

    The options are mistakes: a `first` policy that is paid for, switches `forbidden`, a price on
    `every` step.
    """
    policies, nx, ny, _ = tensors.shape
    best = np.full((policies, nx + 2, ny + 2), np.inf)
    best[:, goal[0] + 1, goal[1] + 1] = 0.0
    costs = np.where(tensors >= f_min, 1 / tensors, np.inf) + (switch_cost if every else 0.0)
    for _ in range(policies * nx * ny):
        onward = [
            costs[..., k] + best[:, 1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny]
            for k, (dx, dy) in enumerate(STEPS)
        ]
        moved = np.minimum(best[:, 1:-1, 1:-1], np.min(onward, axis=0))
        if not forbidden:
            moved = np.minimum(moved, moved.min(axis=0) + (0.0 if every else switch_cost))
        if np.array_equal(moved, best[:, 1:-1, 1:-1]):
            break
        best[:, 1:-1, 1:-1] = moved
    return float(best[:, start[0] + 1, start[1] + 1].min() + first * switch_cost)


def after_fusing(
    tensors: np.ndarray,
    f_min: float,
    switch_cost: float,
    start: Cell,
    goal: Cell,
) -> float:
    """Return the cost if switches are paid after planning on the fused tensor: a mistake."""
    fused = tensors.max(axis=0)
    cells = cells_of_route(np.where(fused >= f_min, 1 / fused, np.inf), start, goal)
    if not len(cells):
        return np.inf
    headings = (np.diff(cells, axis=0)[:, None] == STEPS).all(axis=-1).argmax(axis=-1)
    policies = tensors.argmax(axis=0)[cells[:-1, 0], cells[:-1, 1], headings]
    cost = (1 / along_route(fused, cells)).sum()
    return float(cost + switch_cost * np.count_nonzero(np.diff(policies)))


def along_route(fused: np.ndarray, cells: np.ndarray, turn: int = 0, late: int = 0) -> np.ndarray:
    """Return F of every step of a route; `turn` and `late` are mistakes.

    They turn each step's heading, and read the cell that is entered in place of the one left.
    """
    steps = np.diff(cells, axis=0)
    heading = (steps[:, None] == STEPS).all(axis=-1).argmax(axis=-1)
    at = cells[late : len(cells) - 1 + late]
    return fused[at[:, 0], at[:, 1], (heading + turn) % 8]


def step_lengths(cells: np.ndarray) -> np.ndarray:
    """Return the length of every step of a route, in cells."""
    return np.hypot(*np.diff(cells, axis=0).T)
