# %% [markdown]
# # Exercise 11 · Mixed terrain
#
# **You will be able to** put an interval on a success rate, make Table II from raw trials, and say
# who walked how far.
#
# About 35 minutes. Needs notebook 11, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex11.q1")` gives one more
# hint at each call, and `solution("ex11.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution
from fgtutor.directions import STEP_LENGTHS

# %% [markdown]
# ## ex11.q1
#
# 20 successes of 20: is that a rate of 100 %? The textbook interval $p \pm z \sqrt{p(1-p)/n}$ says
# so, and with certainty, since its width is 0. Wilson's interval asks instead which true rates
# would make the observation unsurprising:
#
# $$\frac{p + \frac{z^2}{2n} \pm z \sqrt{\frac{p(1-p)}{n} + \frac{z^2}{4n^2}}}{1 + \frac{z^2}{n}},
# \qquad z = 1.96.$$
#
# For 20 of 20 that is 0.84 to 1. `successes` and `trials` are arrays `[n]`.


# %%
def wilson_interval(successes, trials):
    """Return (low, high), two arrays [n]: the 95 % Wilson interval of each rate."""
    # BEGIN SOLUTION
    z = 1.96
    p = successes / trials
    centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return centre - half, centre + half
    # END SOLUTION


# %%
check("ex11.q1", wilson_interval)

# %%
hint("ex11.q1")

# %% [markdown]
# ## ex11.q2
#
# An evaluation leaves one row a trial: its `terrain` and its `policy` (numbers from 0), and its
# `outcome`: 0 reached, 1 no route found, 2 fell, 3 out of time. Make Table II of it:
# `table[terrain, policy]` is the share of trials that reached the goal. The paper counts "no route"
# as a failure, and so do we: a planner that only accepts easy tasks has not solved the hard ones.
#
# A pair that was never tried has no rate: NaN.


# %%
def success_table(terrain, policy, outcome, terrains, policies):
    """Return the success rates [terrains, policies]."""
    # BEGIN SOLUTION
    table = np.full((terrains, policies), np.nan)
    for i in range(terrains):
        for j in range(policies):
            mine = (terrain == i) & (policy == j)
            if mine.any():
                table[i, j] = (outcome[mine] == 0).mean()
    return table
    # END SOLUTION


# %%
check("ex11.q2", success_table)

# %% [markdown]
# ## ex11.q3
#
# A route has a heading and a policy for every step. How many metres does each of `count` policies
# walk? `STEP_LENGTHS[k]` is the length of a step along heading `k` in **cells**: 1 along an axis,
# $\sqrt 2$ along a diagonal; a cell is `resolution` metres. A policy that is never used walks 0 m.


# %%
def metres_by_policy(headings, policies, count, resolution):
    """Return the metres walked by each policy, [count]."""
    # BEGIN SOLUTION
    metres = STEP_LENGTHS[headings] * resolution
    return np.bincount(policies, weights=metres, minlength=count)
    # END SOLUTION


# %%
check("ex11.q3", metres_by_policy)

# %% [markdown]
# ## ex11.q4
#
# A judgement, with a number. You want to write "succeeds in more than 99 % of cases", and mean that
# the **lower end** of the 95 % Wilson interval ($z = 1.96$) lies above 0.99. Suppose that every
# trial succeeds. How many trials do you need, at least?

# %%
# BEGIN SOLUTION
# With p = 1 the lower end is n / (n + z^2). It exceeds 0.99 for n > 99 z^2 = 380.3. (The paper ran
# 10,000 trials a terrain; this is why a table from 50 trials needs its intervals printed.)
trials_needed = int(np.ceil(99 * 1.96**2))
# END SOLUTION

# %%
check("ex11.q4", trials_needed)

# %% [markdown]
# ## What to try
#
# - Two policies reached 47 and 43 of 50 goals. Do their intervals overlap? Does that settle which
#   is better, if both were driven over the same 50 grounds?

# %%
solution("ex11.q4")
