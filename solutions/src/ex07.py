# %% [markdown]
# # Exercise 07 · Drive the plan
#
# **You will be able to** follow a route by pure pursuit, turn the shorter way, and switch policies
# without flicker.
#
# About 30 minutes. Needs notebook 07, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex07.q1")` gives one more
# hint at each call, and `solution("ex07.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution

# %% [markdown]
# ## ex07.q1
#
# A follower steers for a point some way **ahead on the route**. Find the vertex of `route [n, 2]`
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
# beyond $\pm\pi$. It turns at 3 rad/s for every radian of error, but at most at `limit` either way;
# positive is to the left. And it turns **the shorter way**: from 179 to -179 degrees is 2 degrees.


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
# Where two policies are about as good, the policy map flickers: 0 1 0 1. Each switch is a small
# adventure for the robot, so a policy takes over only once it has been wanted for `hold` steps **in
# a row**: in the step that completes the row. The first step runs `wanted[0]`.
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
# ## What to try
#
# - Hysteresis delays every switch, also the right ones. At 0.85 m/s and 25 steps a second, how far
#   does the robot drive with the wrong policy for `hold` = 3? Is that more than a cell?

# %%
solution("ex07.q3")
