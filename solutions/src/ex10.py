# %% [markdown]
# # Exercise 10 · Planning adapts
#
# **You will be able to** measure a walk, compute SPL, and read a published table backwards.
#
# About 20 minutes. Needs [notebook 10](../notebooks/10_planning_adapts.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex10.q1")` gives one more
# hint at each call, and `solution("ex10.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex10.q1
#
# An episode records a position at every control step. How long was the walk, in metres?


# %%
def path_length(xy):
    """Return the length of the path through the positions [n, 2], m."""
    # BEGIN SOLUTION
    return np.linalg.norm(np.diff(xy, axis=0), axis=-1).sum()
    # END SOLUTION


# %%
check("ex10.q1", path_length)

# %%
hint("ex10.q1")

# %% [markdown]
# ## ex10.q2
#
# A planner that always arrives, after any detour, has a success rate of 100 %. SPL (Anderson et
# al., 2018) weighs each success by how direct the walk was:
#
# $$\mathrm{SPL} = \frac1N \sum_i S_i\, \frac{\ell_i}{\max(p_i, \ell_i)},$$
#
# $S$ = success, $p$ = length of the walk, $\ell$ = length of a reference route. A failure counts 0,
# and a walk shorter than its reference counts 1, not more.


# %%
def spl(success, length, reference):
    """Return SPL, a number; all arrays are [n], success holds booleans."""
    # BEGIN SOLUTION
    return np.mean(success * reference / np.maximum(length, reference))
    # END SOLUTION


# %%
check("ex10.q2", spl)

# %% [markdown]
# ## ex10.q3
#
# A judgement, with a number and a reason. This is the paper's Table I, for one start and goal:
#
# | | epoch 1.5K | epoch 5K | epoch 20K |
# |---|---|---|---|
# | path length | 26.75 m | 14.84 m | 9.73 m |
# | success rate | 100 % | 100 % | 100 % |
# | SPL | 0.19 | 0.34 | 0.51 |
#
# The paper does not say which reference length its SPL uses. The table does. How long is it, in
# metres? (2 % off is close enough.) And which line through the world is that likely to be?

# %%
# BEGIN SOLUTION
# All trials succeeded, so SPL is about reference / length, and the reference SPL * length: 5.08,
# 5.05 and 4.96 m. The columns agree. Even the best route is twice as long as the reference, so that
# is likely the straight line from start to goal.
reference_length = (26.75 * 0.19 + 14.84 * 0.34 + 9.73 * 0.51) / 3
# END SOLUTION

# %%
check("ex10.q3", reference_length)

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
with_mine("ex10")

# %% [markdown]
# ## What to try
#
# - Could any planner reach an SPL of 1 in that table, if the straight line is blocked?

# %%
solution("ex10.q3")
