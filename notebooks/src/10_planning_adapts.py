# %% [markdown]
# # 10 · Planning adapts
#
# - **You will be able to** show that a plan follows what the policy can do, without anybody
#   telling it; measure a walk; and say what SPL means and what it hides
# - **Time** twenty minutes to read; about a minute on two CPU cores
# - **Needs** notebooks [06](06_fuse_and_plan.ipynb) and [09](09_train_a_specialist.ipynb); uses
#   three shipped checkpoints of the `steps` specialist
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer walks. The
#   walks are the only long cell
#
# A costmap says where *a robot* can go. Which robot? The one of this morning, or the one that has
# trained all day? Here is one robot three times, early, in the middle and late in its training,
# before the same wall. (The paper's Table I.)

# %% [markdown]
# ## Three stages of one policy
#
# Each checkpoint has its own Feasibility-Net, trained with it until that moment and no longer.

# %%
from fgtutor.evaluation.adaptation import AdaptationConfig

config = AdaptationConfig(robot="a1")
stages = config.load_checkpoints()
for name, specialist in stages.items():
    print(f"{name:6} after {specialist.provenance['samples']:>10,} samples")

# %% [markdown]
# What do they think of one ledge, 40 cm ahead, the higher the worse?

# %%
import numpy as np
import torch

from fgtutor.figures.charts import draw_curves

grid = next(iter(stages.values())).grid
rises = torch.linspace(-0.25, 0.25, 51)
ledges = torch.where(grid.points[:, 0] > 0.35, rises[:, None], 0.0)
with torch.no_grad():
    opinions = {
        name: s.feasibility.feasibility(ledges, torch.tensor(s.command).expand(len(rises), -1))
        for name, s in stages.items()
    }

# %%
draw_curves(
    rises, opinions, title="One ledge, three stages of one policy",
    xlabel="height of the ledge (m); below 0 it goes down", ylabel="feasibility f",
)  # fmt: skip

# %% [markdown]
# *What to see:* does the promise for high ledges rise from stage to stage? On the level (0) all of
# them should be good. Up and down are, as ever, two different things.

# %% [markdown]
# ## A wall with three gates
#
# Start and goal are five metres apart, with a wall between them that nobody climbs. In the wall
# there are three gates. Steps lie in each: **the shorter the way, the higher the steps.**

# %%
from fgtutor.evaluation.adaptation import STRAIGHT, WAYS, geodesic, make_map
from fgtutor.figures.maps import draw_elevation

terrain = make_map("a1", seed=1)
M, start, goal = terrain.elevation, terrain.start, terrain.goal
for way, gate in zip(WAYS, terrain.sections, strict=True):
    top = M.crop(gate.x0, gate.y0, gate.x1, gate.y1).heights.max()
    print(f"{way:6} way: up to {100 * top:.0f} cm, in two steps")

# %%
from fgtutor.figures.style import Picture

narrow = Picture(4.6, 6.4)
draw_elevation(M, axes=narrow.subplots())

# %% [markdown]
# ## Ask each of them
#
# The same map, the same planner, the same thresholds. Only the tensor is another: each stage is
# asked about itself.

# %%
from fgtutor.evaluation.adaptation import find_plans, way_of

plans = find_plans(terrain, stages, config)
routes = {name: route for name, (_, route) in plans.items() if route}
for name, (_, route) in plans.items():
    how = f"{route.length:5.1f} m, the {way_of(route.xy, terrain)} way" if route else "no way"
    print(f"{name:6} {how}")

# %%
from dataclasses import replace

from fgtutor.course.route_pictures import compare_routes

drawn = {name: "refused" for name in plans}
drawn |= {name: replace(route, names=("steps",)) for name, route in routes.items()}
compare_routes(M, drawn, columns=3)

# %% [markdown]
# *What to see:* do the routes get shorter from left to right? Nobody has told the planner that the
# robot has learned something. It asked.
#
# The reason lies in the tensors. Here is the mean over the headings, for each stage:

# %%
strip = Picture(7.6, 4.6)
panels = strip.subplots(1, len(plans), sharey=True)
for axes, (name, (tensor, _)) in zip(np.atleast_1d(panels), plans.items(), strict=True):
    x0, y0, x1, y1 = M.extent
    # An image is [row = y, column = x]: transpose, with its first row at the bottom.
    axes.imshow(tensor.mean(dim=-1).T, origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=1)
    axes.set_title(f"F of {name}", fontsize=10)
strip

# %% [markdown]
# *What to see:* the wall is dark in all of them. Find the gates: in which stage does which of them
# open?

# %% [markdown]
# ## Choosy, or desperate?
#
# Where there is a way round, a planner may be choosy: here it takes no step with $\hat F$ below
# `f_min`. That number is a choice. What would each stage do with another?

# %%
from fgtutor.planning import plan_on_map


def length(name, f_min):
    tensors = {name: plans[name][0]}
    plan = plan_on_map(M, {name: stages[name]}, start, goal, tensors=tensors, f_min=f_min)
    return plan.route.length if plan.answer else np.nan


# %%
limits = np.linspace(0.05, 0.6, 12)
draw_curves(
    limits, {name: [length(name, limit) for limit in limits] for name in stages},
    title="How far each would go round", xlabel="f_min", ylabel="length of the route (m)",
)  # fmt: skip

# %% [markdown]
# *What to see:* stairs. A route does not get longer bit by bit: a gate closes, and the next one is
# taken. Where a line ends, even the last gate has closed.

# %% [markdown]
# ## Walk
#
# A short route is a claim. Let them walk: each its own route, a few times, all side by side.

# %%
from fgtutor.course.drives import drive_together
from fgtutor.course.notebooks import budget
from fgtutor.execution import FollowConfig

trials = budget(fast=2, full=12, unit="walks for each stage", each=1.5)
jobs = [(route, terrain, seed) for route in routes.values() for seed in range(trials)]
walks = drive_together(jobs, stages, config=FollowConfig(patience=1.15, grace=4.0))
walked = {name: walks[i * trials : (i + 1) * trials] for i, name in enumerate(routes)}

# %% [markdown]
# How long was a walk? Add up the distances from pose to pose. (Not the length of the plan: feet
# wander.) And how *good* was it? A planner that always arrives, by way of the moon, has a success
# rate of 100 %. **SPL**, *success weighted by path length*, weighs each success by how direct the
# way was:
#
# $$ \text{SPL} = \frac1N \sum_i S_i \frac{\ell_i}{\max(p_i,\, \ell_i)} $$
#
# with $S$ for success, $p$ for the length of the walk, and $\ell$ for a reference length. Which
# one? The paper does not say. So here are two: the straight line, which no robot could walk, and
# the shortest way over cells that are not wall.

# %%
from fgtutor.statistics import spl

shortest = geodesic(terrain)
print(f"straight: {STRAIGHT:.1f} m; round the wall: {shortest:.1f} m\n")
for name, episodes in walked.items():
    success = np.array([e.success for e in episodes])
    metres = np.array([e.length for e in episodes])
    scores = [spl(success, metres, reference) for reference in (STRAIGHT, shortest)]
    print(f"{name:6} reached {success.sum()} of {trials}, {metres.mean():5.1f} m;", end=" ")
    print(f"SPL {scores[0]:.2f} (straight), {scores[1]:.2f} (round the wall)")

# %% [markdown]
# *What to see:* three columns that belong together. A rising SPL with a constant success rate is
# the paper's result: *the robot always arrives, and by ever shorter ways.* If a stage fell, its
# SPL has paid for it in full, however short the way was.

# %%
from fgtutor.course.route_pictures import draw_drive

name = list(routes)[-1] if routes else ""
best = max(walked[name], key=lambda walk: walk.length) if routes else None
if best:
    route = routes[name]
    print(f"{name}: {best}")

# %%
draw_drive(best, route, M) if best else draw_elevation(M)

# %% [markdown]
# *What to see:* white is the plan, the colour is where the trunk went. The wider the gate, the
# less that difference matters.
#
# **A warning.** These are a few walks on one map. The table in the README comes from
# `fgtutor evaluate adaptation --robot a1`: a hundred walks for each stage on twenty maps, with
# intervals that know that walks on one map resemble each other.

# %% [markdown]
# ## What to try
#
# - `make_map("a1", seed=2, heights=(0.5, 0.4, 0.2))` lowers the steps of the short and the middle
#   way. Which stage changes its mind first?
# - Plan with the *late* tensor and walk with the *early* policy (in `drive_together`, give the
#   route of one and name the other). What is a promise worth that somebody else has made?
# - `AdaptationConfig(cost="inverse")` is the paper's cost, by which a diagonal step is no longer
#   than a straight one. Compare the routes.
#
# **Exercises:** [exercises/ex10.ipynb](../exercises/ex10.ipynb). **Next:** four specialists on one
# course, [11_mixed_terrain.ipynb](11_mixed_terrain.ipynb).
