# %% [markdown]
# # Exercise 04 · Have I seen this before?
#
# **You will be able to** turn a reconstruction loss into a weight, choose its thresholds from data,
# and say when a place closes.
#
# About 25 minutes. Needs [notebook 04](../notebooks/04_have_i_seen_this_before.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex04.q1")` gives one more
# hint at each call, and `solution("ex04.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex04.q1
#
# A VAE that has seen only steps paints steps. How badly it repaints a patch says how foreign the
# patch is: $L_{recon}$ is the **sum** over the patch's points of the squared error. Units matter,
# or thresholds like 0.1 and 2.0 mean nothing: the network sees `height_scale * patch` (at a scale
# of 4, a unit is a quarter of a metre), and `decoded` is in those units already.


# %%
def reconstruction_loss(patch, decoded, height_scale):
    """Return L_recon of every patch, [n]; patch [n, points] in metres, decoded in scaled units."""
    # BEGIN SOLUTION
    return ((height_scale * patch - decoded) ** 2).sum(axis=-1)
    # END SOLUTION


# %%
check("ex04.q1", reconstruction_loss)

# %%
hint("ex04.q1")

# %% [markdown]
# ## ex04.q2
#
# Eq. 4 makes a weight of the loss:
#
# $$w_{ood} = \operatorname{clip}\left(1 - \frac{L_{recon} - \tau_{low}}{\tau_{high} - \tau_{low}},\
# 0,\ 1\right).$$
#
# Below $\tau_{low}$ the terrain is as good as known, above $\tau_{high}$ the net's prediction is
# not believed at all. At 1.05, half way between the paper's 0.1 and 2.0, it counts half.


# %%
def ood_weight(loss, tau_low, tau_high):
    """Return w_ood, an array of the loss's shape."""
    # BEGIN SOLUTION
    return np.clip(1 - (loss - tau_low) / (tau_high - tau_low), 0, 1)
    # END SOLUTION


# %%
check("ex04.q2", ood_weight)

# %% [markdown]
# ## ex04.q3
#
# The paper's thresholds suit the paper's networks. A specialist of ours was driven over held-out
# terrain of its own kind, and remembers the losses it found there. Then a patch needs no threshold:
# its **p-value** is the share of those own losses that are at least as large as its own loss (a
# count over a count: nothing is interpolated), and its weight is
# $\operatorname{clip}(p / \alpha, 0, 1)$. So at most a share of $\alpha$ of the own terrain loses
# weight, whatever the network.


# %%
def conformal_weight(losses, own, alpha):
    """Return the weight of each of `losses` [m]; `own` [n] are those on the own terrain."""
    # BEGIN SOLUTION
    p = (own[None, :] >= losses[:, None]).mean(axis=1)
    return np.clip(p / alpha, 0, 1)
    # END SOLUTION


# %%
check("ex04.q3", conformal_weight)

# %% [markdown]
# ## ex04.q4
#
# A judgement, with a number and a reason. On a certain patch the net predicts $f = 0.9$. The
# planner uses $F = w_{ood} f$ and closes an edge where $F < f_{min} = 0.1$. With the paper's
# thresholds 0.1 and 2.0: up to which $L_{recon}$ does the place stay open? (Half a percent off is
# close enough.) And: would you want it to stay open that long?

# %%
# BEGIN SOLUTION
# F = 0.1 needs w_ood = 0.1 / 0.9 = 1/9; solve 1 - (L - 0.1) / 1.9 = 1/9 for L.
# A place that the net likes stays open until it is nearly as foreign as tau_high: f is believed to
# the last, although just there it means least. What protects the robot is the price: F = 0.1 costs
# as much as ten good steps, so the route goes there only if the detour is longer than that.
largest_loss = 0.1 + 1.9 * (1 - 0.1 / 0.9)
# END SOLUTION

# %%
check("ex04.q4", largest_loss)

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
with_mine("ex04")

# %% [markdown]
# ## What to try
#
# - With tau_high *at* the 99 % quantile, how likely is a route of a hundred places to have none
#   that is closed? (Take the places as independent. Are they?)

# %%
solution("ex04.q4")
