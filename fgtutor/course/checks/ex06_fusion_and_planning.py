"""Exercise 06, "Fuse and plan": max, argmax, edge costs, Dijkstra (Sec. III-C, Eqs. 6-7)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question
from fgtutor.course.checks.searches import (
    after_fusing,
    along_route,
    both_ways,
    cells_of_route,
    cheapest,
    fewest_steps,
    step_lengths,
    switching,
)
from fgtutor.directions import STEP_LENGTHS, STEPS


def _tensors(rng: np.random.Generator) -> tuple:
    # One decimal, so that policies tie here and there.
    tensors = rng.uniform(0, 1, (3, 4, 3, 8)).round(1)
    tensors[1, 0, 0] = tensors[2, 0, 0] = 1.0
    tensors[0, 0, 0] = 0.5
    return (tensors,)


def _fused(rng: np.random.Generator) -> tuple:
    fused = rng.uniform(0, 1, (3, 4, 8))
    fused[0, 0, :2] = 0.0, 0.2
    return fused, 0.2


def _costs(rng: np.random.Generator) -> tuple:
    costs = 1 / rng.uniform(0.12, 1, (5, 4, 8))
    costs[rng.uniform(size=costs.shape) < 0.25] = np.inf
    return costs, (0, int(rng.integers(4))), (4, int(rng.integers(4)))


_WALL = (np.where((np.arange(4) == 1)[:, None, None], np.inf, np.ones((4, 3, 8))), (0, 1), (3, 1))
"""No edge leaves column 1, so the far side is out of reach."""
_ON_THE_SPOT = (np.ones((3, 3, 8)), (1, 1), (1, 1))
"""Start and goal are one."""
_ONE_WAY = (np.where(np.arange(8) < 2, 1.0, 5.0) * np.ones((3, 2, 1)), (2, 0), (0, 0))
"""Towards +x is cheap, and back is dear."""


def _choices(rng: np.random.Generator) -> tuple:
    tensors = rng.uniform(0.05, 1, (2, 6, 3, 8))
    tensors[1, 0], tensors[0, 4] = 0.05, 0.05  # either policy has a column that it cannot leave
    return tensors, 0.3, float(rng.uniform(0.5, 2)), (0, int(rng.integers(3))), (5, 1)


def _route(rng: np.random.Generator) -> tuple:
    fused = rng.uniform(0.1, 1, (6, 6, 8))
    cells = [np.array([2, 3])]
    while len(cells) < 6:
        onward = cells[-1] + STEPS[rng.integers(8)]
        if ((onward >= 0) & (onward < 6)).all():
            cells.append(onward)
    return fused, np.array(cells)


QUESTIONS = (
    Question(
        id="ex06.q1",
        name="fuse",
        points=1,
        title="the best policy, and how good it is",
        expects="fused[x, y, k] is the largest F_i[x, y, k] over the policies i, and the policy "
        "map the number of that policy (of the first, where they tie).",
        draw=_tensors,
        truth=lambda tensors: (tensors.max(axis=0), tensors.argmax(axis=0)),
        mistakes=(
            Mistake(
                "a mean over the policies: take the best one; the others do not make it worse.",
                lambda t: (t.mean(axis=0), t.argmax(axis=0)),
            ),
            Mistake(
                "the worst policy: F is a feasibility, high is good: argmax, not argmin.",
                lambda t: (t.max(axis=0), t.argmin(axis=0)),
            ),
            Mistake(
                "values in the policy map: it holds the NUMBER of the best policy (argmax).",
                lambda t: (t.max(axis=0), t.max(axis=0)),
            ),
            Mistake(
                "the best heading in place of the best policy: it compares along the headings "
                "(axis -1); policies are the first axis.",
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
        points=1,
        title="from feasibility to cost",
        expects="the lower F, the dearer the edge: 1 at F = 1, 2 at F = 0.5; an edge with F < "
        "f_min does not exist, so it costs infinity.",
        draw=_fused,
        truth=lambda fused, f_min: np.where(fused >= f_min, 1 / fused, np.inf),
        mistakes=(
            Mistake(
                "1 - F for 1 / F: the paper takes the inverse: a hardly feasible step must cost "
                "far more.",
                lambda f, m: np.where(f >= m, 1 - f, np.inf),
            ),
            Mistake(
                "-log F in place of 1 / F: that is the cost if steps succeed independently with "
                "probability F; the paper's is the inverse.",
                lambda f, m: np.where(f >= m, -np.log(f), np.inf),
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
                "F itself as a cost: high F is good, high cost is bad.",
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
        title="Dijkstra, with a heap",
        expects="the cost of the cheapest chain of edges from start to goal, where costs[ix, iy, "
        "k] is paid for LEAVING a cell along heading k; infinity if no chain joins them.",
        draw=_costs,
        examples=(_WALL, _ON_THE_SPOT, _ONE_WAY),
        truth=cheapest,
        mistakes=(
            Mistake(
                "no answer where there is no route: a goal that cannot be reached costs infinity.",
                lambda *case: np.nan_to_num(cheapest(*case), posinf=0.0),
            ),
            Mistake(
                "steps counted: each edge has a cost of its own, and the sum is asked for.",
                lambda costs, start, goal: cheapest(
                    np.where(np.isfinite(costs), 1.0, np.inf), start, goal
                ),
            ),
            Mistake(
                "a search for the fewest steps: a longer route over easy ground may be cheaper.",
                fewest_steps,
            ),
            Mistake(
                "a route from goal to start: up a step is not down a step.",
                lambda costs, start, goal: cheapest(costs, goal, start),
            ),
            Mistake(
                "an undirected graph: an edge and its reverse have costs of their own: use a "
                "DiGraph.",
                both_ways,
            ),
            Mistake(
                "costs times step length: the paper's edge cost is 1 / F for diagonals too.",
                lambda costs, start, goal: cheapest(costs * STEP_LENGTHS, start, goal),
            ),
            Mistake(
                "a heading off by one: costs[..., k] belongs to STEPS[k].",
                lambda costs, start, goal: cheapest(np.roll(costs, 1, axis=-1), start, goal),
            ),
        ),
        hints=(
            "Keep a heap of (cost so far, cell), beginning with (0.0, start), and a dictionary of "
            "the best cost of each cell. heapq.heappop gives the cheapest entry.",
            "The neighbour along k is (ix + STEPS[k][0], iy + STEPS[k][1]); skip it off the map, "
            "or if the cost is infinite, or if it is no cheaper than what is known.",
            "The first time the goal is popped, its cost is final. An empty heap means infinity.",
        ),
    ),
    Question(
        id="ex06.q4",
        name="route_cost",
        points=1,
        title="what does a route cost?",
        expects="the sum over its steps of 1 / F of the cell that is LEFT, along the step's "
        "heading: a route of n cells has n - 1 steps.",
        draw=_route,
        truth=lambda fused, cells: (1 / along_route(fused, cells)).sum(),
        mistakes=(
            Mistake(
                "the cell that is entered: F[ix, iy, k] is the feasibility of LEAVING (ix, iy).",
                lambda f, c: (1 / along_route(f, c, late=1)).sum(),
            ),
            Mistake(
                "the opposite heading: the step leads from cells[i] to cells[i + 1], not back.",
                lambda f, c: (1 / along_route(f, c, turn=4)).sum(),
            ),
            Mistake(
                "a heading off by one: heading 0 is +x.",
                lambda f, c: (1 / along_route(f, c, turn=1)).sum(),
            ),
            Mistake(
                "the inverse of the sum: sum the costs of the steps, not their feasibilities.",
                lambda f, c: 1 / along_route(f, c).sum(),
            ),
            Mistake(
                "a mean over the steps: every step has to be paid.",
                lambda f, c: (1 / along_route(f, c)).mean(),
            ),
            Mistake(
                "costs times step length: the paper's edge cost is 1 / F for diagonals too.",
                lambda f, c: (step_lengths(c) / along_route(f, c)).sum(),
            ),
        ),
        hints=(
            "np.diff(cells, axis=0) are the steps: which row of STEPS is each?",
            "(step == STEPS).all(axis=-1).argmax() is the heading of one step.",
        ),
    ),
    Question(
        id="ex06.q5",
        name="cheapest_route",
        points=3,
        title="the route itself",
        expects="the cells [n, 2] of the cheapest route, start and goal included, each a "
        "neighbour of the one before; an array of shape (0, 2) if there is no route.",
        draw=_costs,
        examples=(_WALL,),
        truth=lambda costs, start, goal: cells_of_route(costs, start, goal),
        mistakes=(
            Mistake(
                "a route that begins at the goal: predecessors are followed backwards, so turn "
                "the list around.",
                lambda *case: cells_of_route(*case)[::-1],
            ),
            Mistake(
                "a route without its goal: the last cell belongs to it.",
                lambda *case: cells_of_route(*case, last=False),
            ),
            Mistake(
                "a route without its start: the first cell belongs to it.",
                lambda *case: cells_of_route(*case)[1:],
            ),
            Mistake(
                "the fewest steps: a longer route over easy ground may be cheaper.",
                lambda costs, start, goal: cells_of_route(costs + 1e4, start, goal),
            ),
            Mistake(
                "a route from goal to start: costs[ix, iy, k] is paid for LEAVING a cell.",
                lambda costs, start, goal: cells_of_route(costs, goal, start)[::-1],
            ),
            Mistake(
                "swapped axes: each row is (ix, iy).", lambda *case: cells_of_route(*case)[:, ::-1]
            ),
        ),
        hints=(
            "Dijkstra as in question 3; whenever a cell gets a better cost, note from which cell "
            "it was reached.",
            "From the goal, follow these notes back to the start, and turn the list around.",
            "np.zeros((0, 2), dtype=int) is an empty route.",
        ),
    ),
    Question(
        id="ex06.q6",
        name="cheapest_switching",
        points=3,
        title="a planner that thinks before it switches",
        expects="the smallest sum of 1 / F_p of every step, p the policy in charge, plus "
        "switch_cost for every change of policy; steps with F_p < f_min are closed for p, the "
        "first policy is free, and infinity says that there is no route.",
        draw=_choices,
        examples=((np.full((2, 3, 2, 8), 0.05), 0.1, 1.0, (0, 0), (2, 0)),),
        truth=lambda tensors, f_min, switch_cost, start, goal: switching(
            tensors, f_min, switch_cost, start, goal
        ),
        mistakes=(
            Mistake(
                "switches paid after the search: it must know of them while it searches, or it "
                "takes the cheapest route for a robot that switches for nothing.",
                after_fusing,
            ),
            Mistake(
                "switches for nothing: every change of policy costs switch_cost.",
                lambda t, f, s, start, goal: switching(t, f, 0.0, start, goal),
            ),
            Mistake(
                "one policy for the whole route: a switch is dear, not forbidden.",
                lambda t, f, s, start, goal: switching(t, f, s, start, goal, forbidden=True),
            ),
            Mistake(
                "a first policy that is paid for: the robot may start with any policy.",
                lambda t, f, s, start, goal: switching(t, f, s, start, goal, first=True),
            ),
            Mistake(
                "a price on every step: only a CHANGE of policy costs.",
                lambda t, f, s, start, goal: switching(t, f, s, start, goal, every=True),
            ),
            Mistake(
                "closed steps used: below f_min a policy has no such step.",
                lambda t, f, s, start, goal: switching(t, 0.0, s, start, goal),
            ),
        ),
        hints=(
            "A state is (ix, iy, policy). Put one state per policy on the heap at the start, all "
            "with cost 0.",
            "From a state there are two kinds of edges: to the neighbours, with the same policy, "
            "and to the other policies on the same cell, for switch_cost.",
            "The first state on the goal cell that is popped, whatever its policy, is the answer.",
        ),
    ),
    Question(
        id="ex06.q7",
        name="detour_at",
        points=2,
        title="when is a detour worth it?",
        expects="the F at which one step over the obstacle costs as much as the four steps around "
        "it, by the paper's edge cost.",
        truth=lambda: 1 / 4,
        mistakes=(
            Mistake(
                "the extra steps alone: around the obstacle there are four steps in place of one, "
                "and the one over it is saved.",
                lambda: 1 / 3,
            ),
            Mistake("a cost in place of a feasibility: at which F is 1 / F that?", lambda: 4.0),
            Mistake("1 - F in place of 1 / F: no such F would reach a cost of 4.", lambda: -3.0),
            Mistake(
                "-log F in place of 1 / F: steps with F = 1 would then cost nothing.", lambda: 1.0
            ),
            Mistake(
                "f_min in place of the balance: there the step closes altogether.", lambda: 0.1
            ),
        ),
        hints=("What do four steps with F = 1 cost?", "1 / F = 4"),
        rtol=5e-3,
    ),
)
