# %% [markdown]
# # Exercise 09 · Train a specialist
#
# **You will be able to** move robots through a curriculum, estimate advantages over falls and
# time-outs, and explain why the learning rate in the log goes up and down.
#
# About 45 minutes. Needs [notebook 09](../notebooks/09_train_a_specialist.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex09.q1")` gives one more
# hint at each call, and `solution("ex09.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex09.q1
#
# A beginner learns nothing on a cliff. The training world has rows of growing difficulty, 0 to
# `last`. After an episode, a robot moves one row **up** if its mean $r_v$ was above 0.5 and it did
# not fall, one row **down** if its mean $r_v$ was below 0.3 or it fell, and otherwise it stays. No
# robot leaves the world. (The thresholds are the toy's, and the rule a little simpler than the one
# of notebook 09.)


# %%
def next_rows(row, mean_r_v, failed, last):
    """Return the rows [n] after the episode; row holds integers, failed booleans."""
    # BEGIN SOLUTION
    up = (mean_r_v > 0.5) & ~failed
    down = (mean_r_v < 0.3) | failed
    return np.clip(row + up.astype(int) - down.astype(int), 0, last)
    # END SOLUTION


# %%
check("ex09.q1", next_rows)

# %%
hint("ex09.q1")

# %% [markdown]
# ## ex09.q2
#
# Was an action better than expected? The critic expects $V_t$; what came is $r_t$ and a state worth
# $V_{t+1}$. The surprise of one step is $\delta_t = r_t + \gamma V_{t+1} - V_t$, and generalised
# advantage estimation adds up the later surprises, each $\gamma\lambda$ times less:
#
# $$A_t = \delta_t + \gamma\lambda A_{t+1}.$$
#
# `values` has one more entry than `rewards`: the value of the state after the last step. Where
# `done[t]`, the state after step $t$ belongs to a new episode: neither $V_{t+1}$ nor $A_{t+1}$
# counts.


# %%
def advantages(rewards, values, done, gamma, lam):
    """Return A of every step, [T]; values is [T + 1]."""
    # BEGIN SOLUTION
    answer, following = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        alive = 1.0 - done[t]
        surprise = rewards[t] + gamma * alive * values[t + 1] - values[t]
        following = surprise + gamma * lam * alive * following
        answer[t] = following
    return answer
    # END SOLUTION


# %%
check("ex09.q2", advantages)

# %% [markdown]
# ## ex09.q3
#
# By how much may one update change the policy? rsl_rl watches how far the policy has moved, by the
# KL divergence between old and new: if `kl` is above twice the `desired` one, the learning rate is
# divided by 1.5; if it is below half of it, multiplied by 1.5; else it stays. It never leaves
# $10^{-5} \ldots 10^{-2}$. All are single numbers.


# %%
def next_rate(rate, kl, desired):
    """Return the learning rate after an update."""
    # BEGIN SOLUTION
    if kl > 2 * desired:
        rate = rate / 1.5
    elif kl < desired / 2:
        rate = rate * 1.5
    return min(max(rate, 1e-5), 1e-2)
    # END SOLUTION


# %%
check("ex09.q3", next_rate)

# %% [markdown]
# ## ex09.q4
#
# In training the rollout is a table `[T, n]`, and episodes end in two ways. A robot that **fell**
# earns nothing more: its future is worth 0. A robot whose time is up could have gone on: its future
# is worth what the critic says of the state in which it was stopped. `next_values[t]` holds this
# value of the state that step $t$ led to, before any reset. So
#
# $$\delta_t = r_t + \gamma\,(1 - \text{fell}_t)\,V^{next}_t - V_t,$$
#
# and $A_t = \delta_t + \gamma\lambda A_{t+1}$, but nothing is carried back over an end of either
# kind.
#
# PPO then **normalises** the advantages: over the whole table, mean 0 and standard deviation 1
# (`np.std`).


# %%
def batch_advantages(rewards, values, next_values, fell, timed_out, gamma, lam):
    """Return the normalised advantages [T, n]; all tables are [T, n]."""
    # BEGIN SOLUTION
    ended = fell | timed_out
    table = np.zeros(rewards.shape)
    carried = np.zeros(rewards.shape[1])
    for t in reversed(range(len(rewards))):
        future = np.where(fell[t], 0.0, next_values[t])
        delta = rewards[t] + gamma * future - values[t]
        carried = np.where(ended[t], 0.0, carried)
        carried = delta + gamma * lam * carried
        table[t] = carried
    centred = table - table.mean()
    return centred / table.std()
    # END SOLUTION


# %%
check("ex09.q4", batch_advantages)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex09")

# %% [markdown]
# ## What to try
#
# - Let 1000 robots of equal skill (each masters row 3, fails row 5, and row 4 half of the time) run
#   through `next_rows` for 50 episodes. Where do they end up?

# %%
solution("ex09.q3")
