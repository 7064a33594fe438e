# %% [markdown]
# # Exercise 09 · Train a specialist
#
# **You will be able to** move robots through a curriculum, estimate advantages, and explain why the
# learning rate in the log goes up and down.
#
# About 30 minutes. Needs notebook 09, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex09.q1")` gives one more
# hint at each call, and `solution("ex09.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution

# %% [markdown]
# ## ex09.q1
#
# Nobody learns on a cliff. The training world has rows of growing difficulty, 0 to `last`. After an
# episode, a robot moves one row **up** if its mean $r_v$ was above 0.5 and it did not fall, one row
# **down** if its mean $r_v$ was below 0.3 or it fell, and else it stays. Nobody leaves the world.
# (The thresholds are the toy's, and the rule a little simpler than the one of notebook 09.)


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
# advantage estimation adds up the later surprises, each $\gamma\lambda$ times fainter:
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
# How long may a step of learning be? rsl_rl watches how far the policy has moved, by the KL
# divergence between old and new: if `kl` is above twice the `desired` one, the learning rate is
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
# ## What to try
#
# - Let 1000 robots of equal skill (each masters row 3, fails row 5, and row 4 half of the time) run
#   through `next_rows` for 50 episodes. Where do they end up?

# %%
solution("ex09.q3")
