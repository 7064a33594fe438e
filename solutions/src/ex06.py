# %% [markdown]
# # Exercise 06 · Fuse and plan
#
# **You will be able to** fuse several policies into one tensor, make costs of it, write Dijkstra's
# search with a heap, check a route's cost by hand, and plan with a price on switching.
#
# About 100 minutes. Needs [notebook 06](../notebooks/06_fuse_and_plan.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex06.q1")` gives one more
# hint at each call, and `solution("ex06.q1")` opens once the check has passed.

# %%
import heapq

import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine
from fgtutor.directions import STEPS

# %% [markdown]
# ## ex06.q1
#
# Every policy $i$ has a tensor $F_i$ `[nx, ny, 8]`. For each cell and heading, which policy does it
# best, and how well (Eqs. 6-7)?
#
# $$F_{max} = \max_i F_i, \qquad P = \arg\max_i F_i.$$
#
# `tensors` is `[policies, nx, ny, 8]`. Return both, $F_{max}$ first. Where policies tie, the first
# one is taken.


# %%
def fuse(tensors):
    """Return (fused, policy_map), both [nx, ny, 8]."""
    # BEGIN SOLUTION
    return tensors.max(axis=0), tensors.argmax(axis=0)
    # END SOLUTION


# %%
check("ex06.q1", fuse)

# %%
hint("ex06.q1")

# %% [markdown]
# ## ex06.q2
#
# A step with feasibility $F$ costs $1/F$: 1 where a policy is perfect, 10 where it barely holds.
# Below `f_min` there is no edge at all; infinity says so.


# %%
def edge_costs(fused, f_min):
    """Return the cost of every edge, [nx, ny, 8]."""
    # BEGIN SOLUTION
    # `where` keeps 1 / 0 from being computed at all, so that nothing warns.
    costs = np.full(fused.shape, np.inf)
    return np.divide(1.0, fused, out=costs, where=fused >= f_min)
    # END SOLUTION


# %%
check("ex06.q2", edge_costs)

# %% [markdown]
# ## ex06.q3
#
# Now plan. `costs[ix, iy, k]` is paid for **leaving** cell `(ix, iy)` along heading `k`, which
# leads to `(ix, iy) + STEPS[k]`; infinite costs are no edges. Return the cost of the cheapest route
# from `start` to `goal`, both `(ix, iy)`; infinity if there is none. If the robot is there
# already, that costs 0.
#
# The graph is directed: $(2, 3) \to (3, 3)$ and $(3, 3) \to (2, 3)$ are two edges with costs of
# their own. Write Dijkstra's search yourself: a heap (`heapq`) holds the cells that were reached,
# with their cost so far; the cheapest of them is final, since every detour could only add to it.


# %%
def cheapest(costs, start, goal):
    """Return the cost of the cheapest route from start to goal."""
    # BEGIN SOLUTION
    best, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        cost, cell = heapq.heappop(heap)
        if cell == goal:
            return cost
        if cost > best[cell]:
            continue  # an old entry: a cheaper one was popped before
        for k, (dx, dy) in enumerate(STEPS):
            onward = (cell[0] + int(dx), cell[1] + int(dy))
            if not (0 <= onward[0] < costs.shape[0] and 0 <= onward[1] < costs.shape[1]):
                continue
            price = cost + costs[cell[0], cell[1], k]
            if price < best.get(onward, np.inf):
                best[onward] = price
                heapq.heappush(heap, (price, onward))
    return np.inf
    # END SOLUTION


# %%
check("ex06.q3", cheapest)

# %% [markdown]
# ## ex06.q4
#
# Never believe a planner: recompute its cost. `cells [n, 2]` are the cells of a route; every step
# leads to a neighbour. Return the sum of $1/F$ over its $n - 1$ steps, $F$ taken from the cell that
# is left, along the heading of the step.


# %%
def route_cost(fused, cells):
    """Return the cost of a route through the fused tensor [nx, ny, 8]."""
    # BEGIN SOLUTION
    cost = 0.0
    for cell, step in zip(cells[:-1], np.diff(cells, axis=0), strict=True):
        heading = (step == STEPS).all(axis=-1).argmax()
        cost += 1 / fused[cell[0], cell[1], heading]
    return cost
    # END SOLUTION


# %%
check("ex06.q4", route_cost)

# %% [markdown]
# ## ex06.q5
#
# A cost is no route. Return the **cells** of the cheapest route, `[n, 2]`, from start to goal, both
# included. For each cell, remember from which one it was reached; at the end follow these notes
# back. If there is no route, return an array of shape (0, 2).


# %%
def cheapest_route(costs, start, goal):
    """Return the cells (ix, iy) of the cheapest route, integers [n, 2]."""
    # BEGIN SOLUTION
    best, came_from, queue = {start: 0.0}, {}, [(0.0, start)]
    while queue:
        cost, cell = heapq.heappop(queue)
        if cell == goal:
            cells = [goal]
            while cells[-1] != start:
                cells.append(came_from[cells[-1]])
            return np.array(cells[::-1])
        for k, (dx, dy) in enumerate(STEPS):
            onward = (cell[0] + int(dx), cell[1] + int(dy))
            if min(onward) < 0 or onward[0] >= len(costs) or onward[1] >= len(costs[0]):
                continue
            price = cost + costs[cell[0], cell[1], k]
            if price < best.get(onward, np.inf):
                best[onward], came_from[onward] = price, cell
                heapq.heappush(queue, (price, onward))
    return np.zeros((0, 2), dtype=int)
    # END SOLUTION


# %%
check("ex06.q5", cheapest_route)

# %% [markdown]
# ## ex06.q6
#
# The fused tensor switches for nothing: whichever policy is best takes each step. If every switch
# has a price, the planner must know **which policy is in charge** while it searches. So a state is
# a cell and a policy. From a state there are two kinds of edges:
#
# - a step along heading $k$ with policy $p$ costs $1/F_p$, if $F_p \ge f_{min}$;
# - a switch to a different policy, on the same cell, costs `switch_cost`.
#
# The first policy is free, and at the goal any policy will do. `tensors` is
# `[policies, nx, ny, 8]`. Return the smallest cost; infinity if there is no route.
# (The library is stricter: it switches only where both policies can take the step.)


# %%
def cheapest_switching(tensors, f_min, switch_cost, start, goal):
    """Return the smallest cost from start to goal, switches included."""
    # BEGIN SOLUTION
    policies, nx, ny, _ = tensors.shape
    best = {(start, p): 0.0 for p in range(policies)}
    heap = [(0.0, start, p) for p in range(policies)]
    while heap:
        cost, cell, policy = heapq.heappop(heap)
        if cell == goal:
            return cost
        edges = [(switch_cost, cell, p) for p in range(policies) if p != policy]
        for k, (dx, dy) in enumerate(STEPS):
            onward = (cell[0] + int(dx), cell[1] + int(dy))
            feasibility = tensors[policy, cell[0], cell[1], k]
            if 0 <= onward[0] < nx and 0 <= onward[1] < ny and feasibility >= f_min:
                edges.append((1 / feasibility, onward, policy))
        for price, place, p in edges:
            if cost + price < best.get((place, p), np.inf):
                best[place, p] = cost + price
                heapq.heappush(heap, (cost + price, place, p))
    return np.inf
    # END SOLUTION


# %%
check("ex06.q6", cheapest_switching)

# %% [markdown]
# ## ex06.q7
#
# A judgement, with a number and a reason. Straight ahead lies one step over an obstacle, with
# feasibility $F$. Around it lead four steps in place of this one, each with feasibility 1. At which
# $F$ do both cost the same, by the paper's edge cost?
#
# And: with $-\log F$ in place of $1/F$, when would the detour be taken? Which of the two costs
# would you choose if $F$ were the probability that a step succeeds, and which if it says how well
# the robot keeps its speed?

# %%
# BEGIN SOLUTION
# Four steps with F = 1 cost 4, so 1 / F = 4. With -log F they cost nothing: any detour, however
# long, is better than a step with F < 1. If F were the probability of success, steps being
# independent, that would be right: the sum of -log F is least where the product of all F, the
# probability of arriving, is largest. But f is a tracking reward: at F = 0.5 the robot is slower,
# not lost. 1 / F grows like the time that a step takes, and then a detour has a price of its own.
detour_at = 1 / 4
# END SOLUTION

# %%
check("ex06.q7", detour_at)

# %% [markdown]
# *Why? Two or three sentences. The check marks the number only; your reason is measured by a
# tutor, or by yourself against the argument in the solution.*

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex06")

# %% [markdown]
# ## What to try
#
# - Plan with `cost="length"` in the library and compare: when does the paper's cost prefer a
#   diagonal that a walker would not?

# %%
solution("ex06.q4")
