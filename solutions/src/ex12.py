# %% [markdown]
# # Exercise 12 · From a scan to a walk
#
# **You will be able to** make a map from a point cloud, foresee how lost a robot gets, plan with a
# price on switching, and read Table III.
#
# About 40 minutes. Needs notebook 12, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex12.q1")` gives one more
# hint at each call, and `solution("ex12.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution

# %% [markdown]
# ## ex12.q1
#
# A LiDAR gives points `[n, 3]`, a planner wants heights `[nx, ny]`. Take the **highest** point over
# each cell: a foot is stopped by it. The map's corner is at (0, 0), its `shape` is given, and all
# points lie over it. Cells without a point are unknown: NaN, never 0.


# %%
def rasterise(points, shape, resolution):
    """Return the heights [nx, ny] of a point cloud."""
    # BEGIN SOLUTION
    ix, iy = np.floor(points[:, :2] / resolution).astype(int).T
    heights = np.full(shape, -np.inf)
    np.maximum.at(heights, (ix, iy), points[:, 2])
    return np.where(np.isfinite(heights), heights, np.nan)
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
# policy the cheapest way to have arrived with it: $n$ small steps.


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
# A judgement, with a number. The paper's Table III, success of switching on the real robot:
#
# | from | steps | valley | steps | gaps | bridge |
# |---|---|---|---|---|---|
# | to | valley | steps | gaps | bridge | steps |
# | success | 95 % | 100 % | 100 % | 85 % | 100 % |
#
# If the five switches succeed independently, with what probability do all five succeed in one walk?
# (The paper measured 70 % for the whole walk.)

# %%
# BEGIN SOLUTION
# 0.8075. The whole walk succeeded in 70 %: what is between the switches costs another tenth.
all_switches = 0.95 * 1.0 * 1.0 * 0.85 * 1.0
# END SOLUTION

# %%
check("ex12.q4", all_switches)

# %% [markdown]
# ## What to try
#
# - Each rate in Table III comes from 20 attempts. With the interval of exercise 11: could the true
#   rates of 85 % and 95 % be the same?

# %%
solution("ex12.q4")
