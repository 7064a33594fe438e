# %% [markdown]
# # Exercise 12 · From a scan to a walk
#
# **You will be able to** make a map from a point cloud with stray points, foresee how lost a robot
# gets, plan with a price on switching, and read Table III.
#
# About 50 minutes. Needs [notebook 12](../notebooks/12_from_a_scan_to_a_walk.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex12.q1")` gives one more
# hint at each call, and `solution("ex12.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex12.q1
#
# A LiDAR gives points `[n, 3]`, a planner wants heights `[nx, ny]`. A foot is stopped by the
# **highest** point over a cell. But scans have stray points, a raindrop or an echo, high above the
# ground, and the highest of all would be one of those. So a point counts only if at least `support`
# points of its cell, itself included, lie within 5 cm of its height, above or below. The cell's
# height is that of the highest point that counts.
#
# The map's corner is at (0, 0), and its `shape` is given. Points beside the map are left out. A
# cell without a point that counts is unknown: NaN, never 0.


# %%
def rasterise(points, shape, resolution, support):
    """Return the heights [nx, ny] of a point cloud."""
    # BEGIN SOLUTION
    cells = np.floor(points[:, :2] / resolution).astype(int)
    inside = ((cells >= 0) & (cells < shape)).all(axis=-1)
    cells, z = cells[inside], points[inside, 2]
    heights = np.full(shape, np.nan)
    for cell in np.unique(cells, axis=0):
        own = z[(cells == cell).all(axis=-1)]
        near = np.abs(own[:, None] - own) <= 0.05
        counts = near.sum(axis=-1)
        held = own[counts >= support]
        if len(held):
            heights[cell[0], cell[1]] = held.max()
    return heights
    # END SOLUTION


# %%
check("ex12.q1", rasterise)

# %%
hint("ex12.q1")

# %% [markdown]
# ## ex12.q2
#
# The robot is mistaken about where it is. Each position fix has an error of standard deviation
# `fix` (m), new every time; and an error that drifts as a random walk, `drift` metres per square
# root of a second. After four seconds a random walk has got twice as far as after one, not four
# times: its steps partly undo each other.
#
# What is the standard deviation of the whole error after `t` seconds? The two errors are
# independent.


# %%
def localisation_std(t, fix, drift):
    """Return the standard deviation of the error at the times t [n], m."""
    # BEGIN SOLUTION
    return np.sqrt(fix**2 + drift**2 * t)
    # END SOLUTION


# %%
check("ex12.q2", localisation_std)

# %% [markdown]
# ## ex12.q3
#
# The paper names it as a limit of its method: switching costs nothing, so the policy map may switch
# at every step. Put a price on it. A route has $n$ steps, and `feasibility [n, policies]` says how
# well each policy does each of them. Choose a policy for every step, so that the sum of $1/F$ plus
# `switch_cost` for every **change** of policy is smallest, and return that sum. The first policy is
# free.
#
# Trying all sequences takes $2^n$ sums for two policies. Go forward instead, and remember for each
# policy the lowest cost of having arrived with it: $n$ small steps.


# %%
def cheapest_with_switches(feasibility, switch_cost):
    """Return the smallest cost of the route, a number."""
    # BEGIN SOLUTION
    cost = 1 / feasibility[0]
    for step in feasibility[1:]:
        # Arrive with the same policy for free, or with the best one and switch.
        cost = np.minimum(cost, cost.min() + switch_cost) + 1 / step
    return cost.min()
    # END SOLUTION


# %%
check("ex12.q3", cheapest_with_switches)

# %% [markdown]
# ## ex12.q4
#
# A judgement, with a number and a reason. The paper's Table III, success of switching on the real
# robot:
#
# | from | steps | valley | steps | gaps | bridge |
# |---|---|---|---|---|---|
# | to | valley | steps | gaps | bridge | steps |
# | success | 95 % | 100 % | 100 % | 85 % | 100 % |
#
# If the five switches succeed independently, with what probability do all five succeed in one walk?
# (The paper measured 70 % for the whole walk.) What could explain the rest?

# %%
# BEGIN SOLUTION
# 0.8075. The whole walk succeeded in 70 %. Either the walking between the switches failed in one of
# eight walks (0.70 / 0.81 = 0.87), or failures come together: a robot that stumbles out of one
# switch enters the next one badly. With 20 attempts each, chance alone would explain it too: the
# interval of 70 % of 20 reaches from 48 to 85 %.
all_switches = 0.95 * 1.0 * 1.0 * 0.85 * 1.0
# END SOLUTION

# %%
check("ex12.q4", all_switches)

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
with_mine("ex12")

# %% [markdown]
# ## What to try
#
# - Each rate in Table III comes from 20 attempts. With the interval of exercise 11: could the true
#   rates of 85 % and 95 % be the same?

# %%
solution("ex12.q4")
