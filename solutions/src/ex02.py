# %% [markdown]
# # Exercise 02 · A robot that falls
#
# **You will be able to** compute the tracking reward, turn a rollout into labels that do not hide a
# fall, write the two formulas at the heart of PPO, and compute a point of a learning curve.
#
# About 50 minutes. Needs [notebook 02](../notebooks/02_a_robot_that_falls.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex02.q1")` gives one more
# hint at each call, and `solution("ex02.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex02.q1
#
# The paper's Eq. 1 rewards a robot that moves as it was told:
#
# $$r_v = \exp\left(-\frac{\lVert v - \hat v \rVert_2}{\sigma}\right), \qquad \sigma = 0.25
# \text{ m/s}.$$
#
# It is the norm, not its square: an error of 0.25 m/s leaves $1/e \approx 0.37$, one of 0.05 m/s
# already costs 18 %. Velocities are planar, `[n, 2]`: one row per robot.


# %%
def tracking_reward(velocity, command):
    """Return r_v of every robot, [n]."""
    # BEGIN SOLUTION
    return np.exp(-np.linalg.norm(velocity - command, axis=-1) / 0.25)
    # END SOLUTION


# %%
check("ex02.q1", tracking_reward)

# %%
hint("ex02.q1")

# %% [markdown]
# ## ex02.q2
#
# A Feasibility-Net learns to predict $r_v$ on a patch. The label of step $t$ is the mean of `r_v`
# over the next `window` steps, from $t$ on. `fell` is True from the step of the fall to the end,
# and a robot on its back has $r_v = 0$, whatever the simulator says.
#
# Why not leave out the steps after the fall? Suppose a robot runs perfectly up to a gap and falls
# in. Averaged over the steps it survived, the label in front of the gap is 1: feasible!
#
# At the end of the rollout the window is shorter: take the mean of what is left. (Here `r_v[t]` is
# what step $t$ itself has earned. In notebook 03 row $t$ tells of the step before, so that labels
# begin one row later, and where too little is left there is none.)


# %%
def labels(r_v, fell, window):
    """Return the label of every step, [T]."""
    # BEGIN SOLUTION
    counted = np.where(fell, 0.0, r_v)
    return np.array([counted[t : t + window].mean() for t in range(len(counted))])
    # END SOLUTION


# %%
check("ex02.q2", labels)

# %% [markdown]
# ## ex02.q3
#
# What was a step worth? Its own reward, and what came after it, each step later counting $\gamma$
# times less: $G_t = r_t + \gamma\, G_{t+1}$. A rollout holds several episodes in a row; `done[t]`
# marks the last step of one. What follows belongs to the next episode, so there $G_t = r_t$. At the
# end of the rollout too.
#
# With rewards (1, 1, 1), $\gamma = 0.5$ and no end: $G = (1.75, 1.5, 1)$. With done after the
# second: $G = (1.5, 1, 1)$.


# %%
def discounted_returns(rewards, done, gamma):
    """Return G of every step, [T]."""
    # BEGIN SOLUTION
    returns, following = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        following = rewards[t] + gamma * following * (not done[t])
        returns[t] = following
    return returns
    # END SOLUTION


# %%
check("ex02.q3", discounted_returns)

# %% [markdown]
# ## ex02.q4
#
# PPO raises the probability of actions that went better than expected (advantage $A > 0$) and
# lowers that of the others. `ratio` is new probability over old. So that one rollout cannot carry
# the policy far away, gain beyond a ratio of $1 \pm \epsilon$ does not count:
#
# $$L = \operatorname{mean}\bigl(\min(\rho A,\ \operatorname{clip}(\rho, 1 - \epsilon, 1 + \epsilon)
# A)\bigr).$$
#
# Work out $\rho = 2$, $\epsilon = 0.2$ for $A = 1$ and for $A = -1$ by hand before you write it.
# What would be lost without the min?


# %%
def clipped_objective(ratio, advantage, epsilon):
    """Return PPO's clipped objective, a number."""
    # BEGIN SOLUTION
    clipped = np.clip(ratio, 1 - epsilon, 1 + epsilon)
    # rho = 2: A = 1 gives min(2, 1.2) = 1.2, A = -1 gives min(-2, -1.2) = -2. Clipped alone, an
    # action that became twice as likely although it was bad would cost only 1.2, and cost no more
    # however likely it became: there would be no way back.
    return np.minimum(ratio * advantage, clipped * advantage).mean()
    # END SOLUTION


# %%
check("ex02.q4", clipped_objective)

# %% [markdown]
# ## ex02.q5
#
# A learning curve has one point per rollout. All tables are `[T, n]`: $T$ steps of $n$ robots that
# move at the same time, each with episodes of its own. `fell` marks the step in which a robot
# falls, `timed_out` the step in which its time is up; either ends the episode, and the robot's next
# step begins a new one.
#
# Over all episodes that ended, return the mean **sum** of rewards, the share that ended by a fall,
# and the mean number of steps. The episode that a robot is in at the end of the rollout has not
# ended and does not count. If none has ended, return NaN three times.


# %%
def episode_statistics(rewards, fell, timed_out):
    """Return (mean return, share that fell, mean length) of the episodes that ended."""
    # BEGIN SOLUTION
    returns, falls, lengths = [], [], []
    steps, robots = rewards.shape
    for robot in range(robots):
        earned, length = 0.0, 0
        for t in range(steps):
            earned += rewards[t, robot]
            length += 1
            if fell[t, robot] or timed_out[t, robot]:
                returns.append(earned)
                falls.append(fell[t, robot])
                lengths.append(length)
                earned, length = 0.0, 0
    if not lengths:
        return np.nan, np.nan, np.nan
    return np.mean(returns), np.mean(falls), np.mean(lengths)
    # END SOLUTION


# %%
check("ex02.q5", episode_statistics)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex02")

# %% [markdown]
# ## What to try
#
# - Plot `labels` for a fall at step 30 of 60 and windows of 1, 10 and 25 steps. What does the
#   paper's label (a window of 1) say one step before the fall?

# %%
solution("ex02.q4")
