# %% [markdown]
# # Exercise 01 · Elevation maps and patches
#
# **You will be able to** find the cell of a point, cut a patch out of a map, and say in numbers why
# up a step is not down a step.
#
# About 50 minutes. Needs [notebook 01](../notebooks/01_elevation_maps.ipynb),
# numpy, and no GPU.
#
# Write each function below its question, then run the `check` beneath it: it says at once what
# holds and what does not. Each call of `hint` gives one more hint. The grader runs this notebook
# from top to bottom and offers it numpy, scipy, networkx, torch and `fgtutor.directions`; functions
# must not change the arrays they are given.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine
from fgtutor.directions import STEPS

# %% [markdown]
# ## ex01.q1
#
# A map begins at its `origin` $(x_0, y_0)$, the lower left **corner** of cell (0, 0), and a cell is
# `resolution` metres wide. With the origin at (1, 2) and cells of 0.5 m, the point (1.7, 2.2) lies
# 0.7 m right of the corner: in cell 1, since $0.7 / 0.5 = 1.4$. Its row is 0.
#
# Return the cells `[n, 2]` of the points `xy [n, 2]` as integers, also for points left of the map:
# 0.1 m left of the corner is cell -1.


# %%
def cells_of(xy, origin, resolution):
    """Return the cell (ix, iy) of every point, as integers [n, 2]."""
    # BEGIN SOLUTION
    return np.floor((xy - origin) / resolution).astype(int)
    # END SOLUTION


# %%
check("ex01.q1", cells_of)

# %%
hint("ex01.q1")

# %% [markdown]
# ## ex01.q2
#
# A patch looks where the robot looks. Its points are given in the robot's frame, as offsets
# (ahead, left); the robot stands at `pose = (x, y, yaw)`, yaw in radians, counter-clockwise from
# +x. So the offsets are turned by the yaw,
#
# $$\begin{pmatrix} x' \\ y' \end{pmatrix} = \begin{pmatrix} \cos\psi & -\sin\psi \\ \sin\psi &
# \cos\psi \end{pmatrix} \begin{pmatrix} \text{ahead} \\ \text{left} \end{pmatrix},$$
#
# and then moved to where the robot is. A robot at (2, 3) that faces +y has the point one metre
# ahead of it at (2, 4), and the point one metre to its left at (1, 3).


# %%
def patch_points(offsets, pose):
    """Return the world positions [n, 2] of the offsets [n, 2] of a robot at a pose (x, y, yaw)."""
    # BEGIN SOLUTION
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    ahead, left = offsets[:, 0], offsets[:, 1]
    turned = np.stack((cos * ahead - sin * left, sin * ahead + cos * left), axis=-1)
    return turned + pose[:2]
    # END SOLUTION


# %%
check("ex01.q2", patch_points)

# %% [markdown]
# ## ex01.q3
#
# Now cut the patch. `heights [nx, ny]` belong to the **centres** of the cells: that of cell (0, 0)
# lies at `origin + resolution / 2`. Between four centres the height is bilinear: with $a$ and $b$
# the fractions of a cell by which the point lies beyond the lower centre along x and along y, the
# four heights have the weights $(1-a)(1-b)$, $(1-a)\,b$, $a\,(1-b)$ and $a\,b$. If one of the four
# cells is off the map, the height is unknown: NaN.
#
# A step of 12 cm is the same step on every floor. So return heights **relative to the ground under
# the robot**: the median of the heights of the points that `under [n]` marks, which lie below its
# body. The median, because one stone under a foot must not lift the whole world. (The points under
# the robot are always on the map.)


# %%
def cut_patch(heights, origin, resolution, pose, offsets, under):
    """Return the heights [n] at the offsets [n, 2] of a robot, relative to its ground."""
    # BEGIN SOLUTION
    cells = (patch_points(offsets, pose) - origin) / resolution - 0.5
    low = np.floor(cells).astype(int)
    beyond = cells - low
    patch = np.zeros(len(offsets))
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        cell = low + corner
        inside = ((cell >= 0) & (cell < heights.shape)).all(axis=-1)
        height = np.full(len(offsets), np.nan)
        height[inside] = heights[cell[inside, 0], cell[inside, 1]]
        share = np.where(np.array(corner) == 1, beyond, 1 - beyond).prod(axis=-1)
        patch += share * height
    return patch - np.median(patch[under])
    # END SOLUTION


# %%
check("ex01.q3", cut_patch)

# %% [markdown]
# ## ex01.q4
#
# Heading $k$ points $45k$ degrees counter-clockwise from +x, and `STEPS[k]` is its step
# `(dix, diy)`. For every cell of `heights [nx, ny]`, return how much higher the neighbour along the
# heading is. The same border between two cells is +0.2 along heading 0 and -0.2 along heading 4: a
# costmap, with a single number per cell, cannot hold both.
#
# Off the map there is no neighbour: NaN.

# %%
STEPS


# %%
def rise(heights, heading):
    """Return [nx, ny]: height of the neighbour along the heading minus that of the cell."""
    # BEGIN SOLUTION
    nx, ny = heights.shape
    dx, dy = STEPS[heading]
    around = np.pad(heights, 1, constant_values=np.nan)
    return around[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny] - heights
    # END SOLUTION


# %%
check("ex01.q4", rise)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex01")

# %% [markdown]
# ## What to try
#
# - Compare your `rise` of `make_terrain("steps", robot="toy").elevation.heights` for headings 0 and
#   4.
# - Once a check has passed, its worked solution opens. Compare it with yours.

# %%
solution("ex01.q4")
