# %% [markdown]
# # Exercise 08 · Meet the A1
#
# **You will be able to** turn actions into torques, tell where down is from a quaternion,
# mirror the robot, and watch a joint swing to its target.
#
# About 45 minutes. Needs [notebook 08](../notebooks/08_meet_the_a1.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex08.q1")` gives one more
# hint at each call, and `solution("ex08.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex08.q1
#
# The policy does not command torques. Its action moves the **target** of a spring and damper in
# each joint: target = stance + 0.5 action (rad), and
#
# $$\text{torque} = k_p (\text{target} - q) - k_d\, \dot q, \qquad k_p = 35 \text{ N m/rad}, \quad
# k_d = 0.5 \text{ N m s/rad},$$
#
# at most 33.5 N m either way. So an action of zero stands, and a push is answered within five
# milliseconds, long before the policy hears of it.


# %%
def joint_torques(q, dq, action, stance):
    """Return the torques, N m; all arrays are [12]."""
    # BEGIN SOLUTION
    target = stance + 0.5 * action
    return np.clip(35.0 * (target - q) - 0.5 * dq, -33.5, 33.5)
    # END SOLUTION


# %%
check("ex08.q1", joint_torques)

# %%
hint("ex08.q1")

# %% [markdown]
# ## ex08.q2
#
# A policy should not need to know where north is, but it must know where down is. So it
# observes the direction of gravity in the trunk's own frame: $R^\top (0, 0, -1)$, where $R$ turns
# vectors of the trunk into the world. MuJoCo gives the posture as a quaternion $(w, x, y, z)$ of
# length 1, and the third row of $R$ is
#
# $$\bigl(2 (xz - wy),\quad 2 (yz + wx),\quad 1 - 2 (x^2 + y^2)\bigr).$$


# %%
def gravity_in_body(quaternion):
    """Return the direction of gravity in the trunk's frame, [n, 3]; quaternion is [n, 4]."""
    # BEGIN SOLUTION
    w, x, y, z = quaternion.T
    # R^T (0, 0, -1) is minus the third column of R^T, which is the third row of R.
    return -np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=-1)
    # END SOLUTION


# %%
check("ex08.q2", gravity_in_body)

# %% [markdown]
# ## ex08.q3
#
# The A1 is its own mirror image, so half of what it learns on one side it should know on the other.
# Joints come as FR, FL, RR, RL (front/rear, right/left), and in each leg hip, thigh, calf. In the
# mirror, left and right legs change places, and a hip that swings outwards to the left swings
# outwards to the right: its angle changes sign. Thighs and calves bend forwards and backwards:
# theirs does not.


# %%
def mirrored(joints):
    """Return the joint angles [n, 12] of the mirrored robot."""
    # BEGIN SOLUTION
    legs = joints.reshape(-1, 4, 3)[:, [1, 0, 3, 2]]
    return (legs * (-1.0, 1.0, 1.0)).reshape(-1, 12)
    # END SOLUTION


# %%
check("ex08.q3", mirrored)

# %% [markdown]
# ## ex08.q4
#
# How fast is a joint where it should be, and how far does it swing beyond? A joint with `inertia`
# (kg m^2) begins at rest at the angle 0, and its spring and damper pull it to `target` (rad,
# positive). In each of `steps` steps of `dt` seconds
#
# 1. the torque is `kp * (target - q) - kd * dq`, at most `limit` either way;
# 2. the speed `dq` changes by torque / inertia, times `dt`;
# 3. the angle `q` changes by the **new** speed, times `dt`. (With the old speed the swing would
#    gain energy from nothing.)
#
# Return the angles after each step; the overshoot, which is how far beyond the target the largest
# angle lies (0 if never); and the settling time. The joint has settled at the end of the first step
# from which on it stays within 5 % of the target. If it is not there at the end: NaN.


# %%
def step_response(target, inertia, kp, kd, limit, dt, steps):
    """Return (angles [steps], overshoot in rad, settling time in s)."""
    # BEGIN SOLUTION
    angles, q, dq = np.zeros(steps), 0.0, 0.0
    for i in range(steps):
        torque = np.clip(kp * (target - q) - kd * dq, -limit, limit)
        dq += torque / inertia * dt
        q += dq * dt
        angles[i] = q
    overshoot = max(angles.max() - target, 0.0)
    outside = np.flatnonzero(np.abs(angles - target) > 0.05 * target)
    settled = outside[-1] + 1 if len(outside) else 0
    if settled == steps:
        return angles, overshoot, np.nan
    return angles, overshoot, (settled + 1) * dt
    # END SOLUTION


# %%
check("ex08.q4", step_response)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex08")

# %% [markdown]
# ## What to try
#
# - How far from its target must a joint be for the spring alone to reach the torque limit? How
#   large an action is that?

# %%
solution("ex08.q4")
