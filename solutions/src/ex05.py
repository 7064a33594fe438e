# %% [markdown]
# # Exercise 05 · From map to tensor
#
# **You will be able to** slide a window over a map with as little work as possible, see a network's
# first layer as a convolution, turn a tensor together with its headings, reconstruct without
# decoding, and update a tensor where the map has changed.
#
# About 75 minutes. Needs [notebook 05](../notebooks/05_from_map_to_tensor.ipynb),
# numpy, and no GPU. You may import
# what [exercise 01](ex01.ipynb) lists.
#
# Write each function below its question, then run its `check`; `hint("ex05.q1")` gives one more
# hint at each call, and `solution("ex05.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution, with_mine

# %% [markdown]
# ## ex05.q1
#
# To assess a map, a window slides over `heights [nx, ny]`, one cell at a time, for each heading.
# Here there are four: index 0 is +x, 1 is +y, 2 is -x, 3 is -y. The window of a robot at cell (ix,
# iy) has `rows` x `columns` cells (`columns` is odd): the robot stands in the middle of the first
# row, rows follow **ahead**, columns run from its right to its left. Along +x that is
# `heights[ix : ix + rows, iy - columns // 2 : iy + columns // 2 + 1]`; along the other headings the
# window turns with the robot. Its heights are taken relative to the robot's own cell.
#
# `ask(windows)` is the network: it takes windows `[n, rows * columns]`, flattened, and returns
# their feasibilities `[n]`. It is expensive, so your work is **counted**, whatever the clock says:
# at most four calls, every window asked exactly once. A window that leaves the map, or holds an
# unknown cell (NaN), is not asked; its feasibility is 0.


# %%
def tensorize(heights, rows, columns, ask):
    """Return the feasibilities [nx, ny, 4] of all cells along the four headings."""
    # BEGIN SOLUTION
    tensor, half = np.zeros((*heights.shape, 4)), columns // 2
    for k in range(4):
        # Turned back by k quarters, the robot looks along +x.
        turned_map = np.rot90(heights, -k)
        view = np.lib.stride_tricks.sliding_window_view(turned_map, (rows, columns))
        windows = view.reshape(*view.shape[:2], rows * columns)
        own = turned_map[: len(windows), half : half + windows.shape[1]]
        relative = windows - own[..., None]
        known = np.isfinite(relative).all(axis=-1)
        plane = np.zeros(turned_map.shape)
        inner = plane[: len(windows), half : half + windows.shape[1]]
        inner[known] = ask(relative[known])
        tensor[..., k] = np.rot90(plane, k)
    return tensor
    # END SOLUTION


# %%
check("ex05.q1", tensorize)

# %%
hint("ex05.q1")

# %% [markdown]
# ## ex05.q2
#
# A neuron of the first layer sums a patch's heights, each times a weight, and adds a bias. Asked of
# every window, that is a convolution of the map with the weights as its kernel. Written so, no
# window is ever cut out: for each kernel entry `[i, j]`, add `kernel[i, j]` times the map
# **shifted** by `(i, j)`. Nine shifted maps for a 3 x 3 kernel, instead of one window for every
# cell.
#
# (Mathematicians flip the kernel in a convolution. Networks do not.)


# %%
def first_layer(heights, kernel, bias):
    """Return what the neuron says to the window at every [i, j]."""
    # BEGIN SOLUTION
    rows, columns = kernel.shape
    nx, ny = heights.shape[0] - rows + 1, heights.shape[1] - columns + 1
    answer = np.full((nx, ny), bias)
    for i in range(rows):
        for j in range(columns):
            answer += kernel[i, j] * heights[i : i + nx, j : j + ny]
    return answer
    # END SOLUTION


# %%
check("ex05.q2", first_layer)

# %% [markdown]
# ## ex05.q3
#
# A feasibility tensor `[nx, ny, 8]` says how well each cell can be left along each heading. If the
# whole world is turned by quarter turns, counter-clockwise, the cells move as `np.rot90` moves
# them. And the headings? What could be left along +x (heading 0) can now be left along +y: heading
# 2.
#
# This is a test of the library, too: assess the turned map, or turn the assessed tensor.


# %%
def turned(tensor, quarters):
    """Return the tensor of the world after `quarters` quarter turns counter-clockwise."""
    # BEGIN SOLUTION
    return np.roll(np.rot90(tensor, quarters), 2 * quarters, axis=-1)
    # END SOLUTION


# %%
check("ex05.q3", turned)

# %% [markdown]
# ## ex05.q4
#
# $L_{recon} = \lVert a - D g \rVert^2$ compares a patch $a$ with what the decoder's last, linear
# layer makes of its hidden values $g$. Decoding needs $D g$: as many numbers as the patch has
# points. But multiply it out,
#
# $$\lVert a - D g \rVert^2 = \lVert a \rVert^2 - 2\,(D^\top a) \cdot g + g \cdot (D^\top D)\, g,$$
#
# and only small things are left: `squares` $= \lVert a \rVert^2$ `[n]`, `products` $= D^\top a$
# `[n, hidden]`, and the Gram matrix `gram` $= D^\top D$ `[hidden, hidden]`, the same for all
# patches. `codes [n, hidden]` are the $g$.


# %%
def reconstruction(codes, squares, products, gram):
    """Return L_recon of every patch, [n]."""
    # BEGIN SOLUTION
    return squares - 2 * (products * codes).sum(axis=-1) + ((codes @ gram) * codes).sum(axis=-1)
    # END SOLUTION


# %%
check("ex05.q4", reconstruction)

# %% [markdown]
# ## ex05.q5
#
# You paint a step into the map. Must everything be asked again? `answers[i, j]` is what `ask` said
# of the window `before[i : i + rows, j : j + columns]`, or 0 where that held an unknown cell (NaN).
# The map is now `after`. Return the new answers, and again your work is counted: one call of `ask`,
# with those windows only that hold a **changed** cell and no unknown one. A window with an unknown
# cell has 0. `answers` belongs to the caller: leave it as it is.


# %%
def reassess(answers, before, after, rows, columns, ask):
    """Return the answers for the map `after`, an array like `answers`."""
    # BEGIN SOLUTION
    changed = before != after
    touched = np.lib.stride_tricks.sliding_window_view(changed, (rows, columns))
    touched = touched.any(axis=(-2, -1))
    view = np.lib.stride_tricks.sliding_window_view(after, (rows, columns))
    windows = view.reshape(*view.shape[:2], rows * columns)
    known = np.isfinite(windows).all(axis=-1)
    updated = answers.copy()
    updated[touched] = 0.0
    asked = touched & known
    if asked.any():
        updated[asked] = ask(windows[asked])
    return updated
    # END SOLUTION


# %%
check("ex05.q5", reassess)

# %% [markdown]
# ## Your own planner
#
# What has passed is kept in `mine.py`, beside this notebook. Here the planner runs with your
# functions in place of the library's, and the lines above the picture say which stages are yours.
# The first run takes some ten seconds or more: it loads torch and the specialists.

# %%
with_mine("ex05")

# %% [markdown]
# ## What to try
#
# - One cell of a map of 300 x 300 changes, and the window has 17 x 11 cells. Which share of all
#   windows has to be asked?

# %%
solution("ex05.q4")
