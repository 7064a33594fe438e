# %% [markdown]
# # Exercise 11 · Mixed terrain
#
# **You will be able to** put an interval on a success rate, make Table II from raw trials, and test
# which of two planners is better.
#
# About 60 minutes. Needs [notebook 11](../notebooks/11_mixed_terrain.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex11.q1")` gives one more
# hint at each call, and `solution("ex11.q1")` opens once the check has passed.

# %%
import math

import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

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
# An evaluation leaves one row per trial: its `terrain` and its `policy` (numbers from 0), and its
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
# Two planners were driven over the **same** grounds; `first` and `second` say for each ground
# whether they reached the goal. Two intervals side by side waste what is best about such data: a
# ground that both cross, or none, is easy or hard, and says nothing about which planner is better.
# Count the grounds that only the first one crossed, and those that only the second one did. If both
# were equally good, each of these $n$ grounds would be the toss of a fair coin.
#
# Return both counts, and the probability $p$ that $n$ fair coins fall **at least** as unevenly, to
# either side:
#
# $$p = \min\Bigl(1,\ 2 \sum_{k=0}^{\min} \binom{n}{k} 2^{-n}\Bigr),$$
#
# with min the smaller of the two counts. With 7 to 1 that is $2 \cdot (1 + 8) / 256 = 0.07$.


# %%
def paired_test(first, second):
    """Return (only first, only second, p) of two arrays of booleans [n]."""
    # BEGIN SOLUTION
    only_first = 0
    only_second = 0
    for one, other in zip(first, second, strict=True):
        if one and not other:
            only_first += 1
        if other and not one:
            only_second += 1
    tosses = only_first + only_second
    fewer = min(only_first, only_second)
    outcomes = sum(math.comb(tosses, k) for k in range(fewer + 1))
    p = 2 * outcomes / 2**tosses
    return only_first, only_second, min(p, 1.0)
    # END SOLUTION


# %%
check("ex11.q3", paired_test)

# %% [markdown]
# ## ex11.q4
#
# A judgement, with a number and a reason. You want to write "succeeds in more than 99 % of cases",
# and mean that the **lower end** of the 95 % Wilson interval ($z = 1.96$) lies above 0.99. Suppose
# that every trial succeeds. How many trials do you need, at least? And: would you publish a table
# of 50 trials per cell?

# %%
# BEGIN SOLUTION
# With p = 1 the lower end is n / (n + z^2). It exceeds 0.99 for n > 99 z^2 = 380.3. The paper ran
# 10,000 trials per terrain. A table of 50 is worth printing if its intervals are printed with it:
# 50 of 50 still allows a rate of 93 %, which separates it from 60 %, but not from 95 %.
trials_needed = int(np.ceil(99 * 1.96**2))
# END SOLUTION

# %%
check("ex11.q4", trials_needed)

# %% [markdown]
# *Why? Two or three sentences. The check marks the number only; your reason is measured by a
# tutor, or by yourself against the argument in the solution.*

# %% [markdown]
# ## ex11.q5
#
# A specialist gets better from checkpoint to checkpoint, and Table I says by how much. Make such a
# table from raw walks. Each trial has the number of its `checkpoint`, its `success`, its positions
# `xy[trial]`, `[T, 2]`, and the length of its `reference`. Walks end at different times: after the
# end all positions are NaN. Row $c$ of the answer holds, of the trials of checkpoint $c$,
#
# - the mean length of the walks that **succeeded**, m (in every row at least one did),
# - the success rate,
# - SPL over all of them: the mean of success times reference / max(length, reference).
#
# A checkpoint without any trial has NaN three times. There are `count` checkpoints.


# %%
def table_one(checkpoint, success, xy, reference, count):
    """Return [count, 3]: mean length of successes, success rate, SPL."""
    # BEGIN SOLUTION
    steps = np.linalg.norm(np.diff(xy, axis=1), axis=-1)
    lengths = np.nansum(steps, axis=1)  # a step from or to NaN is none
    direct = reference / np.maximum(lengths, reference)
    table = np.full((count, 3), np.nan)
    for c in range(count):
        own = checkpoint == c
        if not own.any():
            continue
        table[c, 0] = lengths[own & success].mean()
        table[c, 1] = success[own].mean()
        table[c, 2] = (success * direct)[own].mean()
    return table
    # END SOLUTION


# %%
check("ex11.q5", table_one)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex11")

# %% [markdown]
# ## What to try
#
# - Two policies reached 47 and 43 of 50 goals. Do their intervals overlap? Does that settle which
#   is better, if both were driven over the same 50 grounds?

# %%
solution("ex11.q4")
