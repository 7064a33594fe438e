# %% [markdown]
# # 05 · From map to tensor
#
# - **You will be able to** ask a specialist about every cell and heading of a map, read the
#   answer as flowers, and show that this huge loop is nothing but a convolution
# - **Time** half an hour to read; about 30 seconds on two CPU cores
# - **Needs** notebooks [03](03_feasibility_net.ipynb) and [04](04_have_i_seen_this_before.ipynb)
#   for $f$ and $w_\text{ood}$; uses the shipped specialists
# - **If a part is slow** nothing here simulates a robot; the slowest cell asks about some eighty
#   thousand patches and says how long that took
#
# So far we asked about one patch at a time. A planner wants to know *everything*: at every cell,
# in every heading. This is the step the paper calls the **feasibility tensor**.

# %% [markdown]
# ## One question
#
# A small world: a plateau one can climb on from four sides.

# %%
import numpy as np

from fgtutor import ElevationMap, load_zoo
from fgtutor.figures.maps import draw_elevation

heights = np.zeros((22, 16))
heights[8:14, 5:11] = 0.16
M = ElevationMap(heights, resolution=0.1)
draw_elevation(M)

# %% [markdown]
# The robot stands before the plateau and faces it. It asks its steps specialist:

# %%
import torch

from fgtutor.course.patch_pictures import patch_at

steps = load_zoo("toy")["steps"]
net, grid = steps.feasibility, steps.grid
command = torch.tensor(steps.command)
patch = patch_at(M, (0.45, 0.75, 0.0), grid)
with torch.no_grad():
    print(f"towards the plateau: f = {net.feasibility(patch, command):.2f}")
    away = patch_at(M, (0.45, 0.75, np.pi), grid)
    print(f"away from it:        f = {net.feasibility(away, command):.2f}")

# %% [markdown]
# ## All questions: a window slides over the map
#
# For each heading, put the robot on each cell, cut its patch, ask. The result has three axes:
# $x$, $y$ and heading.

# %%
from fgtutor import directions


@torch.no_grad()
def slide(elevation, specialist):
    x, y = (torch.tensor(c, dtype=torch.float32) for c in elevation.centres)
    f = torch.empty(*elevation.shape, directions.NUM_HEADINGS)
    for heading, yaw in enumerate(directions.YAWS):
        poses = torch.cartesian_prod(x, y, torch.tensor([yaw], dtype=torch.float32))
        patch = patch_at(elevation, poses, specialist.grid)
        answers = specialist.feasibility.feasibility(patch, command.expand(len(patch), -1))
        f[..., heading] = answers.reshape(elevation.shape)
    return f


f = slide(M, steps)
print("shape", tuple(f.shape), "=", f.numel(), "questions")

# %% [markdown]
# ## Read it as flowers
#
# Eight numbers in every cell: draw them as eight petals, each as long as the feasibility that
# way.

# %%
from fgtutor.figures.maps import draw_petals

plateau = draw_elevation(M)
draw_petals(f, M, every=1, axes=plateau.axes[0])

# %% [markdown]
# *What to see:* walk round the plateau's edge. Outside it, the petals that point *at* it are
# short; on top, those that point *off* it are longer: down is easier than up. Far away all
# flowers are round: on flat ground all ways are alike.
#
# The other way to look at the same tensor is one map for each heading.

# %%
from fgtutor.course.patch_pictures import heading_maps

heading_maps(f, M, label="f")

# %% [markdown]
# *What to see:* the dark shadow always lies *before* the obstacle, seen along the heading. It is
# as deep as the robot needs to notice what is coming. Opposite maps have their shadows on
# opposite sides: that is direction, in one picture.

# %% [markdown]
# ## Turn the world
#
# The check from notebook 01 again, now on the whole tensor: turn the map by 90 degrees, and the
# tensor turns with it, and its headings move on by two. Whoever mixes up an axis fails here.

# %%
turned = slide(M.rotated90(), steps)
expected = torch.rot90(f, 1, dims=(0, 1)).roll(2, dims=2)
print(f"largest difference: {(turned - expected).abs().max():.1e}")

# %% [markdown]
# ## The loop is a convolution
#
# A map of 128 x 128 cells means 131,072 patches, and most of their points are the same heights
# again and again. Do we really have to cut them all? Look at what the network does first: each
# unit of its first layer takes a *weighted sum* of the patch's points. Here are the weights of a
# few units, laid out like a patch.

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
    title="What the first layer looks for (brown: high ground excites it)",
    unit="weight",
)

# %% [markdown]
# *What to see:* no unit is a picture of a step. Each adds up heights, some with a plus and some
# with a minus, mostly those under the robot and just ahead of it; where the sum jumps, there is
# an edge.
#
# A weighted sum of neighbours, the same at every cell: **that is a convolution**, the one from
# image processing. All cells, all units, heading 0, in one call:

# %%
from torch.nn import functional

from fgtutor import patches

rows, columns = grid.shape
behind, aside = round(grid.behind / grid.spacing), columns // 2
surface = torch.tensor(patches.prepare(M).heights)[None, None]
around = (aside, aside, behind, rows - 1 - behind)  # the edge cell continues beyond the map
padded = functional.pad(surface, around, mode="replicate")
responses = functional.conv2d(padded, weights.reshape(-1, 1, rows, columns))[0]
print("responses", tuple(responses.shape), ": a map for each unit of the first layer")

# %% [markdown]
# One thing is missing: a patch counts heights from the ground under the robot. That ground is a
# map as well (a median filter), and subtracting it from every point subtracts *the sum of the
# weights* times it:
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
# The command and the bias are the same everywhere. And the other layers look at one cell at a
# time, so they simply follow.

# %%
with torch.no_grad():
    constant = first.weight[:, grid.num_points :] @ command + first.bias
    hidden = (responses + constant[:, None, None]).movedim(0, -1)
    at_once = torch.sigmoid(net.head[1:](hidden)).squeeze(-1)
print(f"largest difference from the sliding window: {(at_once - f[..., 0]).abs().max():.1e}")

# %% [markdown]
# No patch was ever cut, and the numbers are the same. For the diagonal headings the kernel is
# turned by 45 degrees, its points fall between the cells, and bilinear weights spread them over
# the cells around; the rest is as before. It works because nothing in the network clips or
# rescales single patches: that would not be linear any more.

# %% [markdown]
# ## How much faster?
#
# `assess` does all this in the fast way (and by the reference way if asked), for $f$ and for
# $\mathcal L_\text{recon}$ too.

# %%
import time

from fgtutor import assess
from fgtutor.cli.demo import MAP

big = ElevationMap.load(MAP)
for method in ("reference", "fast"):
    began = time.perf_counter()
    opinion = assess(big, steps, method=method)
    print(f"{method:9} {opinion.f.numel():,} questions in {time.perf_counter() - began:.2f} s")

# %% [markdown]
# ## What the planner gets
#
# `tensorize` adds the distrust of notebook 04, $\hat F = w_\text{ood} \cdot f$, and closes every
# step onto ground that nobody has seen.

# %%
from fgtutor import tensorize

F = tensorize(big, steps, taus="calibrated")
heading_maps(F, big, label="F of the steps specialist")

# %% [markdown]
# *What to see:* flat ground is bright in all eight. Black is what the steps specialist does not
# know: the ridge, the rubble, the gaps. Its own lane lies at the top: along it (headings 0 and 4)
# it is at home, across it the pattern is another. And near the hatched block each map is dark on
# another side: those are the steps that would lead into the unknown.

# %%
closed = ~directions.Headings.of(F).steps_within(big.known)
print(f"steps closed since they leave known ground: {closed.sum():,} of {closed.size:,}")

# %% [markdown]
# With a running kernel you can paint on the map and watch $F$ follow. Only cells whose window saw
# the stroke are asked again:

# %%
from fgtutor.course.widgets.jupyter import TerrainPainter

TerrainPainter(M, steps)

# %% [markdown]
# ## What to try
#
# - Make the plateau 5 cm high, then 20 cm. At which height do the petals towards it vanish? Is it
#   $f$ that says no, or $w_\text{ood}$?
# - Draw the petals of another specialist on the same plateau: `load_zoo("toy")["slopes"]`.
# - The convolution above is exact because map and patch both have a spacing of 10 cm. What would
#   have to change on a map of 5 cm?
#
# **Exercises:** [exercises/ex05.ipynb](../exercises/ex05.ipynb). **Next:** four tensors, one
# plan, [06_fuse_and_plan.ipynb](06_fuse_and_plan.ipynb).
