"""Exercise 06, "Fuse and plan": max, argmax, edge costs, Dijkstra (Sec. III-C, Eqs. 6-7)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question
from fgtutor.directions import STEP_LENGTHS, STEPS


def _tensors(rng: np.random.Generator) -> tuple:
    # One decimal, so that policies tie here and there.
    return (rng.uniform(0, 1, (3, 4, 3, 8)).round(1),)


def _fused(rng: np.random.Generator) -> tuple:
    fused = rng.uniform(0, 1, (3, 4, 8))
    fused[0, 0, :2] = 0.0, 0.2
    return fused, 0.2


def _costs(rng: np.random.Generator) -> tuple:
    costs = 1 / rng.uniform(0.12, 1, (5, 4, 8))
    costs[rng.uniform(size=costs.shape) < 0.25] = np.inf
    return costs, (0, int(rng.integers(4))), (4, int(rng.integers(4)))


def _cheapest(costs: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    """Relax all edges until nothing changes (Bellman-Ford)."""
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


def _fewest_steps(costs: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    toll = 1e4  # dearer than any route, so that the number of steps decides
    return _cheapest(costs + toll, start, goal) % toll


def _both_ways(costs: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    """The cheaper of an edge's two directions, taken for both."""
    around = np.pad(costs, ((1, 1), (1, 1), (0, 0)), constant_values=np.inf)
    nx, ny, _ = costs.shape
    back = [
        around[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny, (k + 4) % 8]
        for k, (dx, dy) in enumerate(STEPS)
    ]
    return _cheapest(np.minimum(costs, np.stack(back, axis=-1)), start, goal)


def _route(rng: np.random.Generator) -> tuple:
    fused = rng.uniform(0.1, 1, (6, 6, 8))
    cells = [np.array([2, 3])]
    while len(cells) < 6:
        onward = cells[-1] + STEPS[rng.integers(8)]
        if ((onward >= 0) & (onward < 6)).all():
            cells.append(onward)
    return fused, np.array(cells)


def _edges(fused: np.ndarray, cells: np.ndarray, turn: int = 0, late: int = 0) -> np.ndarray:
    steps = np.diff(cells, axis=0)
    heading = (steps[:, None] == STEPS).all(axis=-1).argmax(axis=-1)
    at = cells[late : len(cells) - 1 + late]
    return fused[at[:, 0], at[:, 1], (heading + turn) % 8]


def _lengths(cells: np.ndarray) -> np.ndarray:
    return np.hypot(*np.diff(cells, axis=0).T)


QUESTIONS = (
    Question(
        id="ex06.q1",
        name="fuse",
        points=2,
        title="the best policy, and how good it is",
        expects="fused[x, y, k] is the largest F_i[x, y, k] over the policies i, and the policy "
        "map the number of that policy (of the first, where they tie).",
        draw=_tensors,
        truth=lambda tensors: (tensors.max(axis=0), tensors.argmax(axis=0)),
        mistakes=(
            Mistake(
                "mean for max: a good policy is not made worse by bad colleagues.",
                lambda t: (t.mean(axis=0), t.argmax(axis=0)),
            ),
            Mistake(
                "argmin for argmax: F is feasibility: high is good.",
                lambda t: (t.max(axis=0), t.argmin(axis=0)),
            ),
            Mistake(
                "max for argmax: the policy map holds the NUMBER of the best policy, not its "
                "value.",
                lambda t: (t.max(axis=0), t.max(axis=0)),
            ),
            Mistake(
                "the best heading for the best policy: it compares along the headings (axis -1); "
                "policies are the first axis.",
                lambda t: (t.max(axis=-1), t.argmax(axis=-1)),
            ),
            Mistake(
                "the last of equals: where policies tie, the first is taken.",
                lambda t: (t.max(axis=0), len(t) - 1 - t[::-1].argmax(axis=0)),
            ),
            Mistake(
                "swapped answers: the fused tensor comes first, then the policy map.",
                lambda t: (t.argmax(axis=0), t.max(axis=0)),
            ),
        ),
        hints=(
            "Which axis of tensors [policies, nx, ny, 8] counts the policies?",
            "tensors.max(axis=0) and tensors.argmax(axis=0)",
        ),
    ),
    Question(
        id="ex06.q2",
        name="edge_costs",
        points=2,
        title="from feasibility to cost",
        expects="an edge costs 1 / F where F >= f_min; any other edge does not exist, so it costs "
        "infinity.",
        draw=_fused,
        truth=lambda fused, f_min: np.where(fused >= f_min, 1 / fused, np.inf),
        mistakes=(
            Mistake(
                "1 - F for 1 / F: the paper takes the inverse: a hardly feasible step must cost "
                "far more.",
                lambda f, m: np.where(f >= m, 1 - f, np.inf),
            ),
            Mistake(
                "edges that should be closed: below f_min there is no edge, whatever it would "
                "cost.",
                lambda f, m: 1 / f,
            ),
            Mistake(
                "an edge closed at f_min: F >= f_min is open: exactly f_min too.",
                lambda f, m: np.where(f > m, 1 / f, np.inf),
            ),
            Mistake(
                "closed edges for free: 0 is the CHEAPEST cost there is; a closed edge costs "
                "infinity.",
                lambda f, m: np.where(f >= m, 1 / f, 0.0),
            ),
            Mistake(
                "feasibility for cost: high F is good, high cost is bad.",
                lambda f, m: np.where(f >= m, f, np.inf),
            ),
        ),
        hints=(
            "np.where(condition, value if true, value if false)",
            "1 / 0 warns; np.divide(1, fused, where=..., out=np.full(...)) does not.",
        ),
    ),
    Question(
        id="ex06.q3",
        name="cheapest",
        points=3,
        title="Dijkstra",
        expects="the cost of the cheapest chain of edges from start to goal, where costs[ix, iy, "
        "k] is paid for LEAVING a cell along heading k; infinity if no chain joins them.",
        draw=_costs,
        truth=_cheapest,
        mistakes=(
            Mistake(
                "a search for the fewest steps: a longer way over easy ground may be cheaper.",
                _fewest_steps,
            ),
            Mistake(
                "the way back: it leads from goal to start: up a step is not down a step.",
                lambda costs, start, goal: _cheapest(costs, goal, start),
            ),
            Mistake(
                "an undirected graph: an edge and its reverse have costs of their own: use a "
                "DiGraph.",
                _both_ways,
            ),
            Mistake(
                "costs times step length: the paper's edge cost is 1 / F for diagonals too.",
                lambda costs, start, goal: _cheapest(costs * STEP_LENGTHS, start, goal),
            ),
            Mistake(
                "a heading off by one: costs[..., k] belongs to STEPS[k].",
                lambda costs, start, goal: _cheapest(np.roll(costs, 1, axis=-1), start, goal),
            ),
        ),
        hints=(
            "networkx.DiGraph with one edge per finite cost, then networkx.dijkstra_path_length.",
            "The neighbour along k is (ix + STEPS[k][0], iy + STEPS[k][1]); skip it off the map.",
            "networkx.NetworkXNoPath (or a goal without edges) means infinity.",
        ),
    ),
    Question(
        id="ex06.q4",
        name="route_cost",
        points=2,
        title="what does a route cost?",
        expects="the sum over its steps of 1 / F of the cell that is LEFT, along the step's "
        "heading: a route of n cells has n - 1 steps.",
        draw=_route,
        truth=lambda fused, cells: (1 / _edges(fused, cells)).sum(),
        mistakes=(
            Mistake(
                "the cell that is entered: F[ix, iy, k] is the feasibility of LEAVING (ix, iy).",
                lambda f, c: (1 / _edges(f, c, late=1)).sum(),
            ),
            Mistake(
                "the opposite heading: the step leads from cells[i] to cells[i + 1], not back.",
                lambda f, c: (1 / _edges(f, c, turn=4)).sum(),
            ),
            Mistake(
                "a heading off by one: heading 0 is +x.",
                lambda f, c: (1 / _edges(f, c, turn=1)).sum(),
            ),
            Mistake(
                "the inverse of the sum: sum the costs of the steps, not their feasibilities.",
                lambda f, c: 1 / _edges(f, c).sum(),
            ),
            Mistake(
                "mean for sum: every step has to be paid.", lambda f, c: (1 / _edges(f, c)).mean()
            ),
            Mistake(
                "costs times step length: the paper's edge cost is 1 / F for diagonals too.",
                lambda f, c: (_lengths(c) / _edges(f, c)).sum(),
            ),
        ),
        hints=(
            "np.diff(cells, axis=0) are the steps: which row of STEPS is each?",
            "(step == STEPS).all(axis=-1).argmax() is the heading of one step.",
        ),
    ),
)
