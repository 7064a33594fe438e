# %% [markdown]
# # 05 · From map to tensor
#
# - **You will be able to** ask a specialist about every cell and heading of a map, read the
#   answer as flowers, and show that this large loop is a convolution
# - **Time** 40 minutes to read and try; about 30 seconds on two CPU cores
# - **Needs** notebooks [03](03_feasibility_net.ipynb) and [04](04_have_i_seen_this_before.ipynb)
#   for $f$ and $w_\text{ood}$; uses the shipped specialists
# - **If a part is slow** nothing here simulates a robot; the slowest cell asks about 150,000
#   patches and says how long that took
#
# So far we asked about one patch at a time. A planner wants an answer for every cell and every
# heading. All these answers together are the **feasibility tensor** (paper, Sec. III-B, Fig. 3).

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=5)

# %% [markdown]
# Symbols are those of the [notation page](../docs/notation.md); equation numbers are the paper's.
#
# ## One question
#
# A small world: a plateau of 16 cm, with steep sides all round.

# %%
import numpy as np

from fgtutor import ElevationMap, load_zoo  # loads the robots: some seconds, once
from fgtutor.figures.maps import draw_elevation

heights = np.zeros((22, 16))
heights[8:14, 5:11] = 0.16
M = ElevationMap(heights, resolution=0.1)
draw_elevation(M)

# %% [markdown]
# The robot stands before the plateau, at (0.45, 0.75) m. It asks its steps specialist twice: once
# facing the plateau, once with its back to it.

# %%
import torch

from fgtutor.course.patch_pictures import patch_at

steps = load_zoo("toy")["steps"]
net, grid = steps.feasibility, steps.grid
command = torch.tensor(steps.command)
towards = patch_at(M, (0.45, 0.75, 0.0), grid)
away = patch_at(M, (0.45, 0.75, np.pi), grid)

# %%
with torch.no_grad():
    f_towards, f_away = net.feasibility(towards, command), net.feasibility(away, command)
print(f"towards the plateau: f = {f_towards:.2f}, away from it: f = {f_away:.2f}")
assert f_away > f_towards + 0.3

# %% [markdown]
# ## All questions: a window slides over the map
#
# For each heading $k$, put the robot on each cell, cut its patch, ask. The paper writes the $d = 8$
# answers of a cell as $\mathbf f_{x,y} \in \mathbb R^8$. All together they are a function of place
# and heading, stored as an array of $n_x \times n_y \times 8$ numbers from 0 to 1:
#
# $$ \mathbf f[i_x, i_y, k] = f\big(H_{x,y}(\psi_k),\ c\big), \qquad \psi_k = k \cdot 45° $$
#
# The patch is turned to the heading, so the command $c$ is always the same: straight ahead.

# %%
from fgtutor import directions


@torch.no_grad()
def slide(elevation, specialist, command):
    x, y = (torch.tensor(c, dtype=torch.float32) for c in elevation.centres)
    f = torch.empty(*elevation.shape, directions.NUM_HEADINGS)
    for heading, yaw in enumerate(directions.YAWS):
        poses = torch.cartesian_prod(x, y, torch.tensor([yaw], dtype=torch.float32))
        patch = patch_at(elevation, poses, specialist.grid)
        answers = specialist.feasibility.feasibility(patch, command.expand(len(patch), -1))
        f[..., heading] = answers.reshape(elevation.shape)
    return f


f = slide(M, steps, command)
print("shape", tuple(f.shape), "=", f.numel(), "questions")

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "One robot stands at the foot of the plateau's left side, one on its top, at the same edge. "
    "Which of them gets the higher f for crossing that edge?",
    ["the one at the foot (up)", "the one on top (down)", "both the same"],
)

# %% [markdown]
# ## Read it as flowers
#
# Each cell has eight numbers. Draw them as eight petals, each as long as $f$ along its heading.
# Here is the left side of the plateau.

# %%
from fgtutor.figures.maps import draw_petals

ix, iy = slice(2, 13), slice(5, 11)
side = M.crop(0.2, 0.5, 1.3, 1.1)
draw_petals(f[ix, iy], side, every=1, axes=draw_elevation(side).axes[0])

# %%
up, down = f[4:8, 7, 0].min(), f[8:12, 7, 4].min()
assert down > up
print(f"lowest f on the way up: {up:.2f}, on the way down: {down:.2f}")
reveal("the one on top (down)")

# %% [markdown]
# *What to see:* the edge lies at x = 0.8 m. Left of it, the petals that point at it (to the right)
# are short. On top, the petals that point off it (to the left) are longer.
#
# The other view of the same tensor is one map for each heading.

# %%
from fgtutor.course.patch_pictures import heading_maps

assert f[4, 7, 0] < 0.3 < 0.7 < f[17, 7, 0]  # heading +x: dark on the left, bright on the right
assert f[17, 7, 4] < 0.3 < 0.7 < f[4, 7, 4]  # heading -x: the other way round
heading_maps(f, M, label="f")

# %% [markdown]
# *What to see:* in each map the dark shadow lies *before* the plateau, as seen along the heading.
# $f$ predicts the next second, so the shadow is about as deep as the robot drives in a second. It
# is darkest where the front wheel meets the edge, some 35 cm before the trunk's centre does.
# Opposite headings have their shadows on opposite sides.

# %% [markdown]
# ## Turn the world
#
# The check of notebook 01, now for the whole tensor: rotate the map by 90 degrees, and the tensor
# rotates with it, and heading $k$ becomes heading $k + 2$. Mix up an axis, and this fails.

# %%
turned = slide(M.rotated90(), steps, command)
expected = torch.rot90(f, 1, dims=(0, 1)).roll(2, dims=2)
assert torch.allclose(turned, expected, atol=1e-4)
print(f"largest difference: {(turned - expected).abs().max():.1e}")

# %% [markdown]
# ## The loop is a convolution
#
# A map of 128 x 128 cells means 131,072 patches, and neighbouring patches share most of their
# heights. Do we have to cut them all? Look at what the network does first: each unit of its first
# layer takes a *weighted sum* of the patch's points. Here are the weights of the six units with the
# largest weights, laid out like a patch.

# %%
from fgtutor.course.patch_pictures import patch_gallery

first = net.head[0]
weights = first.weight.detach()[:, : grid.num_points] * net.height_scale
strongest = weights.abs().amax(dim=1).argsort(descending=True)[:6]
patch_gallery(
    weights[strongest],
    grid,
    [f"unit {i}" for i in strongest.tolist()],
    columns=3,
    title="First layer: brown weights add heights, blue ones subtract them",
    unit="weight",
)

# %% [markdown]
# *What to see:* no unit is a picture of a step. Each adds some heights and subtracts others. Where
# the ground is flat, the sum stays put; where there is an edge, it jumps.
#
# A weighted sum of neighbours with the same weights at every cell **is a convolution**, the one
# from image processing. All cells and all units for heading 0, in one call:

# %%
from torch.nn import functional

from fgtutor import patches

rows, columns = grid.shape
behind, aside = round(grid.behind / grid.spacing), columns // 2
surface = torch.tensor(patches.prepare(M).heights)[None, None]
around = (aside, aside, behind, rows - 1 - behind)  # the edge cell continues beyond the map
padded = functional.pad(surface, around, mode="replicate")
responses = functional.conv2d(padded, weights.reshape(-1, 1, rows, columns))[0]
print("responses", tuple(responses.shape), ": one map for each unit of the first layer")

# %% [markdown]
# One thing is missing: a patch counts heights from the ground $g$ under the robot. That ground is a
# map too (a median filter), and subtracting it from every point subtracts *the sum of the weights*
# times it:
#
# $$
# \sum_p W_p\,(h_p - g) \;=\; \underbrace{\sum_p W_p\,h_p}_{\text{convolution}} \;-\; g \sum_p W_p
# $$

# %%
from scipy.ndimage import median_filter

under = [2 * round(half / grid.spacing) + 1 for half in grid.footprint]
ground = torch.tensor(median_filter(surface[0, 0].numpy(), size=under, mode="nearest"))
responses -= weights.sum(dim=1)[:, None, None] * ground

# %% [markdown]
# The command and the bias are the same everywhere. The later layers look at one cell at a time, so
# they simply follow.

# %%
with torch.no_grad():
    constant = first.weight[:, grid.num_points :] @ command + first.bias
    hidden = (responses + constant[:, None, None]).movedim(0, -1)
    at_once = torch.sigmoid(net.head[1:](hidden)).squeeze(-1)
assert torch.allclose(at_once, f[..., 0], atol=1e-4)
print(f"largest difference from the sliding window: {(at_once - f[..., 0]).abs().max():.1e}")

# %% [markdown]
# No patch was cut, and the numbers are the same. It works because nothing in this head clips or
# rescales a single patch: that would not be linear.
#
# ## And the diagonals?
#
# Turn the patch by 45 degrees, and its points fall *between* the cells. The point 10 cm ahead lies
# at (0.071, 0.071) m, and bilinear interpolation reads it from four cells:

# %%
a = b = np.sqrt(0.5)  # of a cell, along x and y
shares = np.outer((1 - a, a), (1 - b, b))
print(shares.round(3), "sum", shares.sum())

# %% [markdown]
# So a diagonal kernel has more taps: every weight $W_p$ is shared out among four cells, always in
# the same way. It is still one kernel for the whole map.

# %%
turned_points = patches.rotate(grid.points, torch.tensor(np.pi / 4)) / grid.spacing
corner = turned_points.floor()
reach = int(corner.abs().max()) + 1
kernel = torch.zeros(len(weights), 2 * reach + 1, 2 * reach + 1)
for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
    cell = corner + torch.tensor(step)
    share = (1 - (turned_points - cell).abs()).prod(dim=1)
    at = (cell + reach).long()
    for unit in range(len(weights)):
        kernel[unit].index_put_((at[:, 0], at[:, 1]), weights[unit] * share, accumulate=True)

# %%
padded = functional.pad(surface, (reach,) * 4, mode="replicate")
diagonal = functional.conv2d(padded, kernel[:, None])[0]
x, y = (torch.tensor(c, dtype=torch.float32) for c in M.centres)
places = torch.cartesian_prod(x, y)[:, None] + grid.spacing * turned_points
raw = patches.sample_heights(surface[0, 0], places, resolution=M.resolution, origin=M.origin)
assert torch.allclose(diagonal.flatten(1).T, raw @ weights.T, atol=1e-3)
print(f"taps: {rows * columns} along the axes, {int((kernel[0] != 0).sum())} along the diagonals")

# %% [markdown]
# ## How much faster?
#
# `assess` asks for $f$ and for $\mathcal L_\text{recon}$, of all cells and headings. Its
# *reference* way cuts each patch. Its *fast* way uses what you have just seen: one point of the
# patch, for all cells at once, is the whole map, shifted.

# %%
predict("By which factor is the fast way faster?")

# %%
import time

from fgtutor import assess
from fgtutor.cli.demo import MAP

big = ElevationMap.load(MAP)
seconds = {}
for method in ("reference", "fast"):
    began = time.perf_counter()
    opinion = assess(big, steps, method=method)
    seconds[method] = time.perf_counter() - began
    print(f"{method:9} {opinion.f.numel():,} questions in {seconds[method]:.2f} s")

# %%
x, y = (torch.tensor(c, dtype=torch.float32) for c in big.centres)
poses = torch.cartesian_prod(x, y, torch.tensor([np.pi / 4], dtype=torch.float32))
began = time.perf_counter()
cut = patch_at(big, poses, grid)
halfway = time.perf_counter()
with torch.no_grad():
    net.feasibility(cut, command.expand(len(cut), -1)), net.reconstruction(cut)
cutting, asking = halfway - began, time.perf_counter() - halfway
print(f"one heading: {cutting:.2f} s to cut, {asking:.2f} s to ask the two networks")
reveal(f"{seconds['reference'] / seconds['fast']:.1f} times, on this machine")

# %% [markdown]
# Why not a hundred times? Only the *cutting* is saved. The layers after the first, and the whole
# autoencoder, still work through every cell. If cutting takes $c$ seconds and asking takes $a$, no
# trick with the patches can gain more than a factor of $(c + a) / a$ (Amdahl's law). What helps
# on top: equal patches, such as those on flat ground, are asked about once.

# %% [markdown]
# ## What the planner gets
#
# The last step adds the distrust of notebook 04:
#
# $$ F_i(x, y) = w_\text{ood}(x, y) \cdot \mathbf f_{x,y} \tag{5} $$
#
# for policy $i$. Our patches are turned to the heading, so here $w_\text{ood}$ has a heading too.
# **Your line:** complete Eq. 5 with the two arrays.

# %%
f_big, w_ood = opinion.f, opinion.ood()
yours = ...  # a formula of f_big and w_ood

# %%
from fgtutor import tensorize

F = tensorize(big, steps, taus="calibrated")
inside = torch.tensor(directions.Headings.of(F).steps_within(big.known))
if yours is ...:
    print("Not filled in yet: replace the three dots.")
else:
    assert torch.allclose(yours[inside], F[inside]), "Eq. 5 multiplies, cell by cell"
    print("Right.")
assert not F[~inside].any()
print(f"closed, since they leave known ground: {(~inside).sum():,} of {inside.numel():,} steps")

# %%
assert F[5, 40].min() > 0.5  # flat ground: all eight are high
assert F[30, 40:44].max() < 0.1  # the edge of the ridge: all eight are closed
assert F[30:90, 75, [0, 4]].mean() > 0.4  # its own lane
heading_maps(F, big, label="F of the steps specialist")

# %% [markdown]
# *What to see:* flat ground is bright in all eight maps. What the steps specialist does not know is
# dark: the ridge, the rubble, the gaps. Its own lane lies at the top, above y = 7 m: bright along
# +x and -x. The dark areas reach out against the heading, since the robot sees what lies ahead.

# %% [markdown]
# ## The paper, in code
#
# `fgtutor/paper.py` is the paper's planner as it is written down: slow, complete, 91 lines long.
# Its first function is Sec. III-B. You know each of its lines by now: the loop over headings, the
# patches, $f$, Eq. 4 and Eq. 5.

# %%
import inspect

from fgtutor import paper

print(inspect.getsource(paper.feasibility_tensor))

# %%
slow = torch.tensor(paper.feasibility_tensor(M, steps))
quick = tensorize(M, steps, taus="paper")
inside = torch.tensor(directions.Headings.of(quick).steps_within(M.known))
assert torch.allclose(slow[inside], quick[inside], atol=1e-4)
print(f"paper.py and tensorize differ by {(slow - quick)[inside].abs().max():.1e} at most")

# %% [markdown]
# ## Paint it
#
# With a running kernel, paint on the map and watch $F$ and the route follow. A stroke changes only
# the cells whose window sees it; the line above the map says how many. *Drive* sends the robot.

# %%
from fgtutor.course.widgets.jupyter import TerrainPainter

heights = np.zeros((80, 40))
heights[36:44, 16:24] = 0.16
wide = ElevationMap(heights, resolution=0.1)
TerrainPainter(wide, steps, start=(1.0, 2.0), goal=(7.0, 2.0))

# %% [markdown]
# ## What you now know
#
# - A tensor has an answer for every cell and heading: $n_x \times n_y \times 8$ numbers.
# - The first layer of the net, slid over the map, is a convolution, along the diagonals as well.
# - That saves cutting patches. It does not save asking the later layers.
# - $F_i = w_\text{ood} \cdot f$ (Eq. 5), and steps onto unknown ground are closed.
#
# **Test yourself**
#
# <details><summary>1. A map has 200 x 100 cells. How many numbers does its tensor hold, and how
# many does the planner get from four specialists?</summary>
#
# 200 x 100 x 8 = 160,000, and four times as many: 640,000.
# </details>
#
# <details><summary>2. Why would scaling each patch to a spread of 1 break the
# convolution?</summary>
#
# The factor would depend on the patch, so the first layer would no longer be one fixed weighted sum
# of heights. (Flat and steep ground would also look alike.)
# </details>
#
# <details><summary>3. The map of heading 2 (+y) is dark just below an obstacle. Where is the map of
# heading 6 dark?</summary>
#
# Just above it: heading 6 points towards -y, so the robot meets the obstacle from above.
# </details>

# %% [markdown]
# ## What to try
#
# - Make the plateau 5 cm high, then 20 cm. Is it $f$ or $w_\text{ood}$ that says no?
#   <details><summary>Answer</summary>Print <code>assess(M, steps).f</code> and <code>.ood()</code>
#   at cell (7, 7), heading 0. Steps are this specialist's own terrain, so look at f first: it falls
#   with the height. Then look at w_ood of the diagonals, which see a corner of the plateau, a shape
#   that its training terrain does not have.</details>
# - Draw the petals of the slopes specialist on the same plateau: `load_zoo("toy")["slopes"]`.
#   <details><summary>Answer</summary>Its f near the edge answers a question that it was never
#   trained for. Multiply by w_ood before you believe it.</details>
# - The convolution is exact because map and patch both have a spacing of 10 cm. What changes on a
#   map with cells of 5 cm?
#   <details><summary>Answer</summary>The points of the patch lie two cells apart, so the kernel is
#   dilated: <code>conv2d(..., dilation=2)</code>. And each point lies on a cell's centre still, as
#   long as the robot does.</details>
# - `tensorize(big, steps, headings=16)` asks for more headings; there are 8, 16, 32 and 48.
#   <details><summary>Answer</summary>Routes may then leave the eight compass directions. The
#   in-between steps are longer, (2, 1) instead of (1, 0), and as feasible as the worst cell that
#   they leave.</details>
#
# **Exercises:** [exercises/ex05.ipynb](../exercises/ex05.ipynb). **Next:** four tensors, one
# plan, [06_fuse_and_plan.ipynb](06_fuse_and_plan.ipynb).
