# %% [markdown]
# # 04 · Have I seen this before?
#
# - **You will be able to** catch a network being confident about ground it has never seen,
#   measure how strange a patch is with an autoencoder, and choose the two thresholds that turn
#   strangeness into distrust
# - **Time** half an hour to read and play; about 1 minute on two CPU cores
# - **Needs** notebook [03](03_feasibility_net.ipynb); uses the shipped specialists; the live
#   sliders need a running kernel
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer robots. The
#   sliders themselves need no simulation
#
# A network always answers. Ask the feasibility net of a robot that has only ever seen smooth
# hills about a field of steps, and it gives you a number, as calmly as ever. This notebook is
# about not believing it.

# %% [markdown]
# ## What they promise
#
# Four specialists, four terrains. `assess` asks a specialist about every cell of a map in all
# eight headings (how it does that so fast is notebook 05). Of each pair we take the worst moment
# on the straight way from start to goal.

# %%
import numpy as np

from fgtutor import assess, load_zoo, make_terrain

zoo = load_zoo("toy")
names = list(zoo)
grounds = {name: make_terrain(name, robot="toy", seed=1) for name in names}


def worst_promise(specialist, ground):
    (first, middle), (last, _) = (ground.elevation.cell_of(*p) for p in (ground.start, ground.goal))
    return assess(ground.elevation, specialist).f[first:last, middle, 0].min().item()


promises = np.array([[worst_promise(s, g) for g in grounds.values()] for s in zoo.values()])

# %%
from fgtutor.figures.charts import draw_table

draw_table(
    promises,
    names,
    names,
    title="The least f that a specialist (row) promises on a terrain (column)",
    caption="Full: go ahead. Pale: don't",
)

# %% [markdown]
# ## What comes of it
#
# Now let each of them drive each.

# %%
from fgtutor.course.drives import straight_route
from fgtutor.execution import FollowConfig, execute_batch

patience = FollowConfig(patience=1.5, grace=2.0)
tiles = list(grounds.values())
deeds = []
for name, specialist in zoo.items():
    routes = [straight_route(tile, name) for tile in tiles]
    deeds.append(execute_batch(routes, tiles, {name: specialist}, seeds=[0] * 4, config=patience))

# %%
reached = np.array([[episode.success for episode in row] for row in deeds], dtype=float)
draw_table(
    reached,
    names,
    names,
    title="What came of it",
    caption="One drive each, straight ahead",
    texts=[[episode.reason for episode in row] for row in deeds],
)

# %% [markdown]
# *What to see:* compare the two tables cell by cell. On the diagonal, at home, promise and deed
# go together. Beside it there may be cells that are full above and failed below: **confident, and
# wrong.** Here is the most confident failure of all.

# %%
from fgtutor import execute
from fgtutor.figures.videos import film_strip

i, j = np.unravel_index((promises * (1 - reached)).argmax(), promises.shape)
route = straight_route(tiles[j], names[i])
print(f"{names[i]} on {names[j]} promised f >= {promises[i, j]:.2f}")
film_strip(
    execute(route, tiles[j], {names[i]: zoo[names[i]]}, config=patience), tiles[j], route, count=4
)

# %% [markdown]
# Nobody lied. On its own terrain this net is well calibrated; you saw such a plot in notebook 03.
# But ground like this was not in its data, and outside its data a network's answer is an
# accident: sometimes it happens to be right, and one cannot tell when.
#
# The cure is not a better answer. The cure is a second question: **have I seen this before?**

# %% [markdown]
# ## Squeeze and rebuild
#
# Beside its feasibility head the net has an **autoencoder**. It squeezes the patch through a
# latent of a few numbers and rebuilds it. That works only for patches of a kind it was trained
# on: it has learned what *its* world looks like, and nothing else.

# %%
import torch

net = zoo["steps"].feasibility
print(f"{net.num_points} heights -> {net.latent} numbers -> {net.num_points} heights")


@torch.no_grad()
def rebuild(net, patch):
    mean, _ = net.encoder(net.height_scale * patch).chunk(2, dim=-1)
    return net.decoder(mean) / net.height_scale


# %% [markdown]
# To see both worlds, let every specialist drive over fresh terrain of its own kind, and keep the
# patches it meets.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.evaluation.calibration import CalibrationConfig, drive

settings = CalibrationConfig(envs=budget(fast=16, full=100, unit="robots", each=0.4), seconds=8.0)
drives = {name: drive(specialist, name, settings) for name, specialist in zoo.items()}


def rough(patch):  # flat ground looks the same everywhere and teaches nothing
    return patch[patch.amax(dim=-1) - patch.amin(dim=-1) > settings.relief]


worlds = {name: rough(one.patch) for name, one in drives.items()}
{name: len(patches) for name, patches in worlds.items()}

# %%
from fgtutor.course.patch_pictures import patch_gallery

grid = zoo["steps"].grid
home, abroad = (worlds[name][:: len(worlds[name]) // 4][1:3] for name in ("steps", "gaps"))
shown = torch.cat((home, abroad))
with torch.no_grad():
    loss = net.reconstruction(shown)
captions = ["from steps", "from steps", "from gaps", "from gaps"]
captions += [f"L_recon = {value:.2f}" for value in loss]
patch_gallery(
    torch.cat((shown, rebuild(net, shown))),
    grid,
    captions,
    title="Above: seen. Below: rebuilt by the steps specialist",
)

# %% [markdown]
# *What to see:* its own steps come back as they were. Gaps come back as something it knows:
# smeared, too shallow, or in the wrong place. How wrong is a number: the **reconstruction loss**,
# the squared error *summed* over the points of the patch, in the units that the network sees
# (quarters of a metre).

# %%
patch = shown[0]
by_hand = ((net.height_scale * (rebuild(net, patch) - patch)) ** 2).sum()
print(f"by hand {by_hand:.4f}, by the network {loss[0]:.4f}")

# %% [markdown]
# The *sum*, not the mean: otherwise the thresholds below would mean another thing for every size
# of patch.

# %% [markdown]
# ## Where to draw the line
#
# One patch proves nothing. Here is how $\mathcal L_\text{recon}$ of the steps specialist is
# spread over all patches, on its own terrain and on the others'.

# %%
from fgtutor.feasibility import TAU_HIGH, TAU_LOW
from fgtutor.figures.charts import draw_losses

with torch.no_grad():
    losses = {name: net.reconstruction(patches) for name, patches in worlds.items()}
draw_losses(losses, {"paper": (TAU_LOW, TAU_HIGH)})

# %% [markdown]
# Between "certainly home" and "certainly abroad" lies a ramp, the paper's **out-of-distribution
# weight**:
#
# $$
# w_\text{ood} = \operatorname{clip}\left(1 - \frac{\mathcal L_\text{recon} -
# \tau_\text{low}}{\tau_\text{high} - \tau_\text{low}}, \ 0,\ 1\right)
# $$
#
# *What to see in the lower half:* left of $\tau_\text{low}$ the net is trusted fully, right of
# $\tau_\text{high}$ not at all. The paper's taus are one pair for all networks, and what an error
# of 2.0 means differs from one to the next.
#
# The *calibrated* weight needs no thresholds. After its training, every specialist was driven over
# new ground of its own kind. Now a patch has a **p-value**: the share of those own patches that are
# at least as strange as it is. The weight is
#
# $$ w_\text{ood} = \operatorname{clip}\left(\frac{p}{\alpha},\ 0,\ 1\right), \qquad \alpha = 0.03 $$
#
# so of its own terrain at most 3 % loses weight, for every network. Strange means either a large
# $\mathcal L_\text{recon}$ or a large share of the patch's relief that was not understood,
# $\mathcal L_\text{recon} / (1 + \sum h^2)$: low rubble, badly rebuilt, has a small error and a
# large share.

# %%
from fgtutor.feasibility import ood_weight

for value in (0.05, 0.5, 1.0, 3.0):
    print(f"L_recon = {value:4.2f}  ->  w_ood = {ood_weight(value, TAU_LOW, TAU_HIGH):.2f}")

# %% [markdown]
# ## Who knows what
#
# Now ask all four about all four. Each row is one specialist's mean $w_\text{ood}$ on the ground
# of each column.

# %%
from fgtutor.tensorization import ood_score


def trust(choice):
    rows = []
    for specialist in zoo.values():
        net, score = specialist.feasibility, ood_score(choice, specialist)
        with torch.no_grad():
            losses = [net.losses(net.relief(patch)) for patch in worlds.values()]
        rows.append([score.weight(*loss).mean().item() for loss in losses])
    return rows


# %%
draw_table(
    trust("calibrated"),
    names,
    names,
    title="w_ood of each specialist (row) on each terrain",
    caption="Full: home. Pale: abroad",
)

# %% [markdown]
# *What to see:* read it row by row. In the best of worlds the diagonal is full and the rest is
# pale. Where a cell beside the diagonal is not pale, ask why. Sometimes rightly: low rubble does
# look like a low step, and there the feasibility head must say no, as it can on ground that is at
# least a little familiar. Sometimes wrongly: an autoencoder that has learned to rebuild sharp
# edges rebuilds gentle ones for free. And now go back to the confident failure above: what does
# this table say of it?
#
# The same with the paper's one pair of taus:

# %%
draw_table(
    trust("paper"),
    names,
    names,
    title="The same with the paper's taus",
    caption="One pair of thresholds for four different autoencoders",
)

# %% [markdown]
# ## Distrust on a map
#
# Weight times feasibility is what the planner gets: $\hat F_i = w_\text{ood} \cdot f$. On the map
# that the rest of this half of the course uses, four ways round a ridge, each specialist now
# marks out its own territory.

# %%
from fgtutor import ElevationMap
from fgtutor.cli.demo import GOAL, MAP, START
from fgtutor.figures.maps import draw_elevation, draw_weight

M = ElevationMap.load(MAP)
draw_elevation(M)

# %%
opinions = {name: assess(M, specialist) for name, specialist in zoo.items()}
draw_weight(opinions["gaps"].ood(), M, "gaps")

# %%
draw_weight(opinions["steps"].ood(), M, "steps")

# %% [markdown]
# *What to see:* full colour where the specialist feels at home; flat ground is home to everybody,
# and the ridge to nobody. Find the hatched block: nobody has ever seen what is there, and no
# network is asked.

# %% [markdown]
# ## Turn the knobs
#
# What do the thresholds do to the *plan*? Loose ones trust everyone everywhere, and the route may
# lead where it should not. Strict ones trust nobody off the flat: then the route becomes a long
# detour, or there is none. (How it is found is notebook 06.)

# %%
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.tau_pictures import tau_figure

tau_figure(Explorer(M, opinions, START, GOAL))

# %% [markdown]
# With a running kernel, do it yourself. Drag the two ends of the slider; take policies away;
# click on the map to set start and goal; hold the pointer over a cell to read its numbers.

# %%
from fgtutor.course.widgets.jupyter import TauExplorer

TauExplorer(M, opinions, START, GOAL)

# %% [markdown]
# ## What to try
#
# - Pull $\tau_\text{low}$ and $\tau_\text{high}$ together. What has the ramp become, and what
#   does the planner lose?
# - Take away the policy that the route needs most. Is there another way? What does it cost?
# - Rebuild a patch turned upside down (`-patch`): steps down become steps up. Is that still
#   "home"?
# - An autoencoder is one way to notice strangeness. Think of another that needs only the patches
#   (distance to the nearest training patch?), and of what it would cost on a map of a million
#   cells.
#
# **Exercises:** [exercises/ex04.ipynb](../exercises/ex04.ipynb). **Next:** ask about *every*
# place at once, [05_from_map_to_tensor.ipynb](05_from_map_to_tensor.ipynb).
