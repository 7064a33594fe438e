# %% [markdown]
# # Exercise 06 · Fuse and plan
#
# **You will be able to** fuse several policies into one tensor, make costs of it, find the cheapest
# route, and check a route's cost by hand.
#
# About 45 minutes. Needs notebook 06, numpy and networkx, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex06.q1")` gives one more
# hint at each call, and `solution("ex06.q1")` opens once the check has passed.

# %%
import networkx
import numpy as np

from fgtutor.course.checks import check, hint, solution
from fgtutor.directions import STEPS

# %% [markdown]
# ## ex06.q1
#
# Every policy $i$ has a tensor $F_i$ `[nx, ny, 8]`. For each cell and heading, who does it best,
# and how well (Eqs. 6-7)?
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
# leads to `(ix, iy) + STEPS[k]`; infinite costs are no edges. Return the cost of the cheapest way
# from `start` to `goal`, both `(ix, iy)`; infinity if there is none.
#
# The graph is directed: $(2, 3) \to (3, 3)$ and $(3, 3) \to (2, 3)$ are two edges with costs of
# their own. Write Dijkstra yourself with `heapq`, or let networkx search a `DiGraph`.


# %%
def cheapest(costs, start, goal):
    """Return the cost of the cheapest route from start to goal."""
    # BEGIN SOLUTION
    graph = networkx.DiGraph()
    graph.add_nodes_from(np.ndindex(costs.shape[:2]))
    for ix, iy, k in np.argwhere(np.isfinite(costs)):
        neighbour = (int(ix + STEPS[k][0]), int(iy + STEPS[k][1]))
        if neighbour in graph:
            graph.add_edge((int(ix), int(iy)), neighbour, weight=costs[ix, iy, k])
    try:
        return networkx.dijkstra_path_length(graph, start, goal)
    except networkx.NetworkXNoPath:
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
# ## What to try
#
# - Plan with `cost="length"` in the library and compare: when does the paper's cost prefer a
#   diagonal that a walker would not?

# %%
solution("ex06.q4")
