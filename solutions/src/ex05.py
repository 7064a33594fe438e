# %% [markdown]
# # Exercise 05 · From map to tensor
#
# **You will be able to** slide a window over a map, see a network's first layer as a convolution,
# turn a tensor together with its headings, and reconstruct without decoding.
#
# About 40 minutes. Needs notebook 05, numpy, and no GPU.
#
# Write each function below its question, then run its `check`; `hint("ex05.q1")` gives one more
# hint at each call, and `solution("ex05.q1")` opens once the check has passed.

# %%
import numpy as np

from fgtutor.course.checks import check, hint, solution

# %% [markdown]
# ## ex05.q1
#
# To assess a map, a window of `rows` x `columns` cells slides over `heights [nx, ny]`, one cell at
# a time. The window at `[i, j]` has its lowest corner at cell `(i, j)`: it holds
# `heights[i : i + rows, j : j + columns]`, flattened as it lies, so y (the second axis) runs
# fastest.
#
# Return all windows that fit: `[nx - rows + 1, ny - columns + 1, rows * columns]`.


# %%
def windows(heights, rows, columns):
    """Return every window of the map, flattened."""
    # BEGIN SOLUTION
    view = np.lib.stride_tricks.sliding_window_view(heights, (rows, columns))
    return view.reshape(*view.shape[:2], rows * columns)
    # END SOLUTION


# %%
check("ex05.q1", windows)

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
# ## What to try
#
# - Check `first_layer` against `windows(...) @ kernel.ravel() + bias`, and time both on a map of
#   300 x 300 cells with a kernel of 17 x 11.

# %%
solution("ex05.q4")
