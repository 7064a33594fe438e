# %% [markdown]
# # Exercise 07 · Drive the plan
#
# **You will be able to** follow a route by pure pursuit, turn towards an aim on the nearer side,
# and switch policies without flicker.
#
# About 50 minutes. Needs [notebook 07](../notebooks/07_drive_the_plan.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex07.q1")` gives one more
# hint at each call, and `solution("ex07.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex07.q1
#
# A follower steers for a point **ahead on the route**. Find the vertex of `route [n, 2]`
# nearest to `position`; from there, go along the route until you have come at least `distance`
# metres; return that vertex. If the route ends before, return its last one.
#
# Along the route, not as the crow flies: at a hairpin, a point that is near may be behind you.


# %%
def aim_point(route, position, distance):
    """Return the vertex (x, y) to steer for."""
    # BEGIN SOLUTION
    nearest = np.linalg.norm(route - position, axis=-1).argmin()
    steps = np.linalg.norm(np.diff(route, axis=0), axis=-1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    ahead = np.flatnonzero(along >= along[nearest] + distance)
    return route[ahead[0]] if len(ahead) else route[-1]
    # END SOLUTION


# %%
check("ex07.q1", aim_point)

# %%
hint("ex07.q1")

# %% [markdown]
# ## ex07.q2
#
# The robot faces `yaw` and wants to face `wanted`, both in radians, and both perhaps several turns
# beyond $\pm\pi$, and several turns apart. It turns at 3 rad/s for every radian of error, but at
# most at `limit` either way; positive is to the left. And it turns **to the nearer side**: from 179
# to -179 degrees is 2 degrees.


# %%
def turn_rate(wanted, yaw, limit):
    """Return the turn rates, rad/s; wanted and yaw are arrays [n]."""
    # BEGIN SOLUTION
    error = (wanted - yaw + np.pi) % (2 * np.pi) - np.pi
    return np.clip(3.0 * error, -limit, limit)
    # END SOLUTION


# %%
check("ex07.q2", turn_rate)

# %% [markdown]
# ## ex07.q3
#
# Where two policies are about as good, the policy map flickers: 0 1 0 1. A switch is
# a moment in which the robot may stumble, so a policy takes over only once it has been wanted for
# `hold` steps **in a row**: in the step that completes the row. The first step runs `wanted[0]`.
#
# With wanted = 0 1 0 1 1 1 1 and hold = 3, the active policies are 0 0 0 0 0 1 1. Only the numbers
# 0 and 1 occur.


# %%
def active_policies(wanted, hold):
    """Return the active policy of every step, integers [T]."""
    # BEGIN SOLUTION
    active, waiting, answer = wanted[0], 0, []
    for policy in wanted:
        waiting = waiting + 1 if policy != active else 0
        if waiting >= hold:
            active, waiting = policy, 0
        answer.append(active)
    return np.array(answer)
    # END SOLUTION


# %%
check("ex07.q3", active_policies)

# %% [markdown]
# ## ex07.q4
#
# Put the parts together: a robot that follows a route. It is at `pose` = (x, y, yaw) and moves at
# `speed`. In each step of `dt` seconds
#
# 1. it looks whether the route's last vertex is at most `near` metres away; if so, it stops;
# 2. it finds its aim point, `distance` metres ahead on the route;
# 3. it turns: the yaw changes by the turn rate of question 2 towards the aim, at most `limit`,
#    times `dt`;
# 4. it moves by `speed * dt` along the **new** yaw.
#
# After `most` steps it stops wherever it is. Return all its poses, the first one included.


# %%
def drive(route, pose, speed, distance, limit, near, dt, most):
    """Return the poses (x, y, yaw) of the drive, [steps + 1, 3]."""
    # BEGIN SOLUTION
    poses = [np.array(pose, dtype=float)]
    for _ in range(most):
        x, y, yaw = poses[-1]
        position = np.array([x, y])
        if np.linalg.norm(route[-1] - position) <= near:
            break
        aim = aim_point(route, position, distance)
        wanted = np.arctan2(aim[1] - y, aim[0] - x)
        yaw = yaw + turn_rate(wanted, yaw, limit) * dt
        x, y = x + speed * dt * np.cos(yaw), y + speed * dt * np.sin(yaw)
        poses.append(np.array([x, y, yaw]))
    return np.array(poses)
    # END SOLUTION


# %%
check("ex07.q4", drive)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex07")

# %% [markdown]
# ## What to try
#
# - Hysteresis delays every switch, also the right ones. At 0.85 m/s and 25 steps a second, how far
#   does the robot drive with the wrong policy for `hold` = 3? Is that more than a cell?

# %%
solution("ex07.q3")
