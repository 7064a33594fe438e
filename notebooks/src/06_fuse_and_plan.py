# %% [markdown]
# # 06 · Fuse and plan
#
# - **You will be able to** fuse the opinions of many specialists into one map, read the graph
#   that a planner searches, find the cheapest route in it, and say why a classical costmap cannot
# - **Time** half an hour to read; about 1 minute on two CPU cores
# - **Needs** notebooks [04](04_have_i_seen_this_before.ipynb) and
#   [05](05_from_map_to_tensor.ipynb) for $w_\text{ood}$ and the tensor; uses the shipped
#   specialists
# - **If a part is slow** nothing here simulates a robot; the slowest cells ask four specialists
#   about a whole map, a second or two each
#
# Four specialists have told us, for every cell and heading, how well they would do there. Now
# there is almost nothing left to do. That is the beauty of it.

# %% [markdown]
# ## Four opinions
#
# Between start and goal lies a ridge, and four ways round it: rubble and slopes, gaps, steps, and
# a long detour on the flat.

# %%
from fgtutor import ElevationMap, load_zoo, tensorize
from fgtutor.cli.demo import GOAL, MAP, START
from fgtutor.figures.maps import draw_elevation

zoo = load_zoo("toy")
names = tuple(zoo)
names

# %%
M = ElevationMap.load(MAP)
draw_elevation(M)

# %%
tensors = {name: tensorize(M, zoo[name], taus="calibrated") for name in names}

# %% [markdown]
# Look at one single cell, in the lane with the gaps. Every row is one specialist's flower,
# written as numbers.

# %%
import numpy as np

from fgtutor import directions
from fgtutor.figures.charts import draw_table

cell = M.cell_of(4.0, 5.6)
opinions = np.stack([tensors[name][cell].numpy() for name in names])
draw_table(
    opinions,
    names,
    directions.NAMES,
    title=f"F of each specialist in cell {cell}, by heading",
    caption="Read a column: who would you send that way?",
)

# %% [markdown]
# ## Fuse: take the best, remember whose it is
#
# $$ \hat F_\text{max} = \max_i \hat F_i \qquad \mathcal P = \arg\max_i \hat F_i $$
#
# For each cell *and heading* the best one is sent. That is all there is to fusion:

# %%
best = opinions.max(axis=0)
who = opinions.argmax(axis=0)
for heading, (value, policy) in enumerate(zip(best, who, strict=True)):
    print(f"{directions.NAMES[heading]:5} F_max = {value:.2f}  P = {names[policy]}")

# %%
from fgtutor import fuse

fused, policy_map = fuse(list(tensors.values()))
tuple(fused.shape), tuple(policy_map.shape)

# %%
from fgtutor.figures.maps import draw_petals, draw_policy_map

draw_petals(fused, M, policy_map, names)

# %%
draw_policy_map(policy_map, fused, M, names)

# %% [markdown]
# *What to see:* the lanes have found their owners. On the flat all are nearly equally good, so
# there the colour means little. The ridge, its foot, and the unknown block belong to nobody.
#
# Why the *maximum*? Because only one will drive. A mean would punish a team for every member that
# cannot do the job: hire a fifth specialist for stairs, and all other roads get worse. With the
# maximum a new member can only help, and **nobody is retrained**.

# %% [markdown]
# ## A graph you can read
#
# A planner does not see maps. It sees a **graph**: a node for each cell, an arrow for each step
# that somebody can do. Cut a handful of cells out of the tensor, where the gap lane begins:

# %%
from fgtutor.planning import as_networkx

ix, iy = M.cell_of(2.2, 5.6)
window = slice(ix, ix + 6), slice(iy, iy + 4)
tiny = ElevationMap(
    M.heights[window], resolution=M.resolution, origin=tuple(M.resolution * np.array((ix, iy)))
)
graph = as_networkx(fused[window].numpy(), policy_map[window].numpy())
print(graph)

# %%
for tail, head, edge in list(graph.out_edges((1, 1), data=True)):
    heading, policy = directions.NAMES[edge["heading"]], names[edge["policy"]]
    print(f"{tail} -> {head}  {heading:5} F = {edge['feasibility']:.2f} ({policy:6})", end="  ")
    print(f"cost = 1 / F = {edge['weight']:.2f}")

# %% [markdown]
# The **cost** of an arrow is $1/\hat F_\text{max}$: a step that nearly certainly works costs
# little more than 1, one with $F = 0.1$ costs 10, so ten good steps round a bad one are a fair
# trade. Below `f_min` (0.1, unless you say otherwise) there is no arrow at all.
#
# **Dijkstra's algorithm** finds the cheapest way: always go on from the node that is cheapest to
# reach so far, and no node need ever be looked at twice.

# %%
from itertools import pairwise

import networkx

path = networkx.dijkstra_path(graph, (0, 0), (5, 3))
cost = sum(graph.edges[step]["weight"] for step in pairwise(path))
print(" -> ".join(str(node) for node in path))
print(f"cost, added up by hand: {cost:.3f}")
print(f"cost, says networkx:    {networkx.dijkstra_path_length(graph, (0, 0), (5, 3)):.3f}")

# %%
from fgtutor.course.route_pictures import draw_graph

draw_graph(graph, tiny, path, names)

# %% [markdown]
# *What to see:* every cell has up to eight arrows out, in the colour of the policy that is sent.
# There and back are two arrows, and they need not cost the same.

# %% [markdown]
# ## The whole map
#
# The same, with some ten thousand nodes. `plan` takes metres and gives a `Route`.

# %%
from fgtutor import plan
from fgtutor.planning import PAPER

task = {"grid": M, "start": START, "goal": GOAL, "names": names, "tensors": list(tensors.values())}
route = plan(fused, policy_map, settings=PAPER, **task)
route

# %%
from fgtutor.figures.maps import draw_route

draw_route(route, M)

# %% [markdown]
# *What to see:* there are four ways round the ridge. Which one did it take, and who drives? It
# weighs a short way that somebody finds a little hard against a long one that everybody finds
# easy.
#
# ## Ask it why
#
# No step of this route is a secret. Here is the one that it liked least:

# %%
worst = max(route.explain(), key=lambda step: step["cost"])
for key, value in worst.items():
    if isinstance(value, dict):
        value = {name: round(number, 2) for name, number in value.items()}
    print(f"{key:8} {value if not isinstance(value, float) else round(value, 4)}")

# %% [markdown]
# And why did it not go elsewhere? Ask about a cell that is black in the policy map, and about one
# in the hatched block:

# %%
from fgtutor import assess
from fgtutor.tensorization import why_blocked

assessments = {name: assess(M, specialist) for name, specialist in zoo.items()}
ix, _ = M.cell_of(6.0, 4.0)
shut = int((fused[ix].amax(dim=-1) < 0.1).nonzero()[-1])  # in this column of cells
for x, y in (M.centre_of(ix, shut), (5.7, 6.4)):
    print(why_blocked(x, y, assessments))

# %% [markdown]
# A learned planner that goes from map to motion in one network could not have told you. This is
# what the paper means by *transparency*: the learning is in the opinions, and the decision is
# arithmetic.
#
# ## The flickering of equals
#
# Look at the number of switches in the route above. On flat ground several policies are almost
# equally good, and $\mathcal P$ changes its mind from cell to cell. The paper's plan does not
# mind: switching is free there. A real robot stumbles a little at each switch. So let a switch
# cost something, as much as a metre of easy ground. And let a diagonal step cost its length: by
# $1/\hat F$ alone it costs as much as a straight one, and routes zigzag. These are our settings,
# `PlanSettings()`; the paper's are `PAPER`. Everything in this package uses one of the two:

# %%
from fgtutor.course.route_pictures import compare_routes

calm = plan(fused, policy_map, **task)
compare_routes(M, {"the paper's settings": route, "ours: a switch costs 1": calm})

# %% [markdown]
# *What to see:* fewer switches, at hardly any price in length.

# %% [markdown]
# ## The paper in one file
#
# Notebooks 04 to 06 are Secs. III-B and III-C of the paper. Written down as it says, slowly and
# without any of our tricks, they fit into 91 lines: `fgtutor/paper.py`. Read it from top to bottom
# once; you know every line of it by now. Here is its last function. Does it agree with the fast
# way? It asks for one patch after the other, so a part of the map will do: from the start into the
# gap lane.

# %%
import inspect

from fgtutor import paper
from fgtutor.planning import plan_on_map

print(inspect.getsource(paper.plan))

# %%
part, gaps = M.crop(0.5, 3.0, 4.0, 6.5), (3.5, 5.6)
cells, policies, cost = paper.plan(part, zoo, START, gaps)
fast = plan_on_map(part, zoo, START, gaps, settings=PAPER).route
print(f"cost of the cheapest route: paper.py {cost:.4f}, the fast way {fast.cost:.4f}")

# %% [markdown]
# ## A ledge is a one-way street
#
# Now for the classical planner. A costmap turns heights into *one* number a cell, with
# thresholds. What it cannot say is "down yes, up no". So let us find the most one-way ledge there
# is for our team:

# %%
rises = np.arange(0.04, 0.26, 0.02)


def worst_step(rise, heading):
    heights = np.zeros((24, 9))
    heights[12:] = rise
    edge = ElevationMap(heights)
    team = fuse([tensorize(edge, s, taus="calibrated") for s in zoo.values()])[0]
    return team[5:19, 4, heading].min().item()


ups = np.array([worst_step(rise, 0) for rise in rises])
downs = np.array([worst_step(rise, 4) for rise in rises])

# %%
from fgtutor.figures.charts import draw_curves

draw_curves(
    rises,
    {"up": ups, "down": downs},
    title="The worst F_max on the way over a ledge",
    xlabel="height of the ledge (m)",
    ylabel="F_max",
)

# %%
rise = float(rises[(downs - ups).argmax()])
heights = np.zeros((50, 44))
heights[20:, :28] = rise  # the ledge itself
heights[14:, 28:] = rise / 2  # further up, the same height in two small steps
heights[27:, 28:] = rise
L = ElevationMap(heights, resolution=0.1)
print(f"a ledge of {rise:.2f} m, and beside it two of {rise / 2:.2f} m")
draw_elevation(L)

# %% [markdown]
# Plan from the low side to the high side and back, with our tensors, and with a
# **traversability** map: slope, step height and roughness of each cell against critical values,
# the standard of the field. The same search on both.

# %%
from fgtutor.baselines import AssessedMap, find_route, planners

low_side, high_side = (0.6, 1.6), (4.4, 1.6)
ground = AssessedMap(L, zoo)


def ask(name, start, goal):
    return find_route(planners(zoo)[name], ground, start, goal)  # a Route, or a Refusal


# %%
compare_routes(
    L,
    {
        "ours, up": ask("ours", low_side, high_side),
        "ours, down": ask("ours", high_side, low_side),
        "traversability, up": ask("traversability+P", low_side, high_side),
        "traversability, down": ask("traversability+P", high_side, low_side),
    },
)

# %% [markdown]
# *What to see:* going up, ours prefers the two small steps if the big one is worse than the way
# round; going down, it has no reason to. The classical planner has one opinion of the ledge for
# both ways, and thresholds that do not know who drives. (It may even find no way at all: to its
# thresholds the ledge is a wall.)
#
# And where there is no way round? A corridor with all four obstacles across its whole width:

# %%
from fgtutor import make_terrain

for seed in range(1, 40, 2):
    corridor = make_terrain("mixed", robot="toy", seed=seed)
    ground = AssessedMap(corridor.elevation, zoo)
    answer = ask("ours", corridor.start, corridor.goal)
    print(f"corridor {seed}: {answer}")
    if answer:  # a Refusal is False
        break

# %%
ends = corridor.start, corridor.goal
compare_routes(
    corridor.elevation,
    {
        "ours": answer,
        "ours, without headings": ask("no-heading", *ends),
        "traversability": ask("traversability+P", *ends),
        "occupancy grid": ask("occupancy+P", *ends),
    },
    columns=1,
)

# %% [markdown]
# *What to see:* the costmaps know flat ground and obstacles, and to them what the specialists can
# do is an obstacle. They are not stupid; they have just never been told what this robot can do.
# (Where ours refused, above, no specialist knew some of the ground. In notebook 07 you will see
# whether such refusals are wise.)

# %% [markdown]
# ## What to try
#
# - Replace the maximum by the mean: `torch.stack(list(tensors.values())).mean(dim=0)` as `fused`.
#   Which lane does the route take, if any?
# - Fire the gaps specialist. Plan again. What does the second best way cost?
# - `plan(..., cost="inverse")` is the paper's cost alone: a diagonal step costs as much as a
#   straight one. Compare the routes.
# - `plan(..., backend="networkx")` searches the graph you have seen. Compare cost and time with
#   the default.
#
# **Exercises:** [exercises/ex06.ipynb](../exercises/ex06.ipynb). **Next:** drive it,
# [07_drive_the_plan.ipynb](07_drive_the_plan.ipynb).
