# %% [markdown]
# # 06 · Fuse and plan
#
# - **You will be able to** fuse the tensors of several specialists, read the graph that a planner
#   searches, find the cheapest route by hand, and say what a classical costmap cannot express
# - **Time** 45 minutes to read and try; about 1 minute on two CPU cores
# - **Needs** notebooks [04](04_have_i_seen_this_before.ipynb) and
#   [05](05_from_map_to_tensor.ipynb) for $w_\text{ood}$ and the tensor; uses the shipped
#   specialists
# - **If a part is slow** nothing here simulates a robot; the slowest cells ask four specialists
#   about a whole map, a second or two each
#
# Four specialists have said, for every cell and heading, how well they would do there. What is left
# is arithmetic and a graph search (paper, Sec. III-C, Fig. 4).

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=6)

# %% [markdown]
# Symbols: [notation](../docs/notation.md). Derivations: [derivations](../docs/derivations.md).
# Equation numbers are the paper's.
#
# ## Four tensors
#
# Between start and goal lies a ridge. Four lanes lead past it: rubble and slopes, gaps, steps, and
# a long detour on flat ground.

# %%
from fgtutor import ElevationMap, load_zoo  # loads the robots: some seconds, once
from fgtutor.cli.demo import GOAL, MAP, START
from fgtutor.figures.maps import draw_elevation

M = ElevationMap.load(MAP)
print(f"start {START} m, goal {GOAL} m")
draw_elevation(M)

# %%
from fgtutor.tensorization import assess_all

zoo = load_zoo("toy")
names = tuple(zoo)
assessments = assess_all(M, zoo, taus="calibrated")
tensors = {name: one.weighted() for name, one in assessments.items()}
names

# %% [markdown]
# Look at one cell, in the lane with the gaps. Each row is one specialist's flower, as numbers.

# %%
import numpy as np

from fgtutor import directions
from fgtutor.figures.charts import draw_table

cell = M.cell_of(4.0, 5.6)
at_cell = np.stack([tensors[name][cell].numpy() for name in names])
draw_table(
    at_cell,
    names,
    directions.NAMES,
    title=f"F of each specialist in cell {cell}, by heading",
    caption="Read a column: which specialist would you send along that heading?",
)

# %%
from fgtutor.course.ask import predict, reveal

predict("Which specialist gets heading +y, and which heading +x?", ["gaps both", "slopes, gaps"])

# %% [markdown]
# ## Fuse: keep the best value, and whose it is
#
# $$ F_\text{max}(x, y, k) = \max_i F_i(x, y, k) \tag{6} $$
#
# $$ P(x, y, k) = \arg\max_i F_i(x, y, k) \tag{7} $$

# %%
best, owner = at_cell.max(axis=0), at_cell.argmax(axis=0)
for heading, (value, policy) in enumerate(zip(best, owner, strict=True)):
    print(f"{directions.NAMES[heading]:5} F_max = {value:.2f}  P = {names[policy]}")
assert names[owner[2]] == "slopes" and names[owner[0]] == "gaps"
reveal("slopes, gaps")

# %% [markdown]
# Along +x the patch shows a gap, along +y flat ground between two gaps.
#
# **Careful:** where all values are 0, `argmax` still has to answer, and answers with the first name
# of the list. "F_max = 0.00, P = gaps" means *nobody*. The planner never gets there: such a step is
# not in its graph. For the whole map:

# %%
from fgtutor import fuse

fused, policy_map = fuse(list(tensors.values()))
assert (policy_map[fused == 0] == 0).all()  # nobody: the first name, without a meaning
print("F_max", tuple(fused.shape), "and P", tuple(policy_map.shape))

# %%
from fgtutor.figures.maps import draw_petals

part = M.crop(2.2, 5.2, 3.8, 6.4)  # where the lane with the gaps begins
ix, iy = slice(22, 38), slice(52, 64)
draw_petals(fused[ix, iy], part, policy_map[ix, iy], names)

# %%
from fgtutor.figures.maps import draw_policy_map

draw_policy_map(policy_map, fused, M, names)

# %% [markdown]
# *What to see:* the lanes with rubble and with gaps have the colour of their specialists. On flat
# ground all are about equally good, so there the colour means little. The foot and the edges of the
# ridge are black, and so is what was never observed. And along the *top* of the ridge runs a
# coloured strip: it is flat, so the slopes specialist could drive there. But no step leads up to
# it. A planner asked to go there refuses:

# %%
from fgtutor import plan

task = {"grid": M, "names": names, "tensors": list(tensors.values())}
on_top = plan(fused, policy_map, start=START, goal=(6.0, 4.5), **task)
assert not on_top and fused[M.cell_of(6.0, 4.5)].max() > 0.5
print(on_top.reason)

# %% [markdown]
# Why the *maximum*? Because only one policy will drive. With a mean, each member that cannot do
# the job would lower the result: add a fifth specialist for stairs, and every flat road gets
# worse. With the maximum a new member can only help, and **nobody is retrained**.
#
# ## The planning problem
#
# A **path** is a chain of cells and headings $(c_0, k_0), (c_1, k_1), \dots$ in which each heading
# leads to the next cell. The planner wants the path from start to goal with the least total cost:
#
# $$
# \min_{(c_0, k_0), \dots, (c_{n-1}, k_{n-1})} \ \sum_{t=0}^{n-1}
# \frac{1}{F_\text{max}(c_t, k_t)}
# \qquad \text{with } F_\text{max}(c_t, k_t) \ge f_\text{min} .
# $$
#
# The cost of a step, $1/F_\text{max}$, is the paper's. The limit $f_\text{min} = 0.1$
# is ours: a step below it does not exist.
#
# **Why $1/F$?** Suppose the robot makes good a share $F$ of the commanded speed. Then a step takes
# $1/F$ times as long, and the cheapest path is the fastest. $F = 1$ costs 1 and $F = 0.1$ costs 10:
# ten easy steps round one bad step are a fair trade. ($F$ is a tracking reward, so this is not
# exact, but it is the right kind of quantity: a velocity.)
#
# **Why not $-\log F$?** Then the sum is the logarithm of a product, and the cheapest path is the
# likeliest to succeed: right if $F$ were the probability of surviving a step, each independent of
# the others. It is not. And $-\log 1 = 0$ would make perfect ground free: a detour of any length
# would cost nothing. ([Derivation](../docs/derivations.md).)

# %% [markdown]
# ## A graph you can read
#
# A planner sees no map. It sees a **graph**: one node per cell, one arrow per step that some policy
# can do. Cut 24 cells out of the tensor, where the lane with the gaps begins:

# %%
from fgtutor.planning import as_networkx

ix, iy = M.cell_of(2.2, 5.6)
window = slice(ix, ix + 6), slice(iy, iy + 4)
corner = tuple(M.resolution * np.array((ix, iy)))
tiny = ElevationMap(M.heights[window], resolution=M.resolution, origin=corner)
graph = as_networkx(fused[window].numpy(), policy_map[window].numpy())
print(graph)

# %%
for tail, head, edge in graph.out_edges((1, 1), data=True):
    heading, policy = directions.NAMES[edge["heading"]], names[edge["policy"]]
    print(f"{tail} -> {head}  {heading:5} F = {edge['feasibility']:.2f} ({policy:6})", end="  ")
    print(f"cost = 1 / F = {edge['weight']:.2f}")

# %% [markdown]
# ## Dijkstra's algorithm, step by step
#
# Keep a list of nodes with the cheapest cost found *so far*: the **frontier**. Take the cheapest
# node off it. Its cost is now final (it is **settled**): any other path to it would have to go
# through a node of the frontier that already costs as much. Then offer each neighbour the path
# through this node, and go on.
#
# **Your line.** A node was settled at a cost of 2.75. An arrow with F = 0.5 leads from it to a
# neighbour. What does the neighbour cost on this path?

# %%
settled_cost, F = 2.75, 0.5
offer = ...  # a formula of settled_cost and F

if offer is ...:
    print("Not filled in yet: replace the three dots.")
else:
    assert offer == 4.75, f"got {offer}: the cost so far plus the cost of the arrow, 1 / F"
    print("Right.")


# %%
def tell(node, cost, settled):
    waiting = sorted((cost[n], n) for n in cost if n not in settled)
    print(f"settled {node} at {cost[node]:.2f}; frontier:", end=" ")
    print(", ".join(f"{n} {c:.2f}" for c, n in waiting[:5]))


# %%
import heapq


def dijkstra(graph, start):
    cost, before, settled = {start: 0.0}, {}, {}
    frontier = [(0.0, start)]
    while frontier:
        _, node = heapq.heappop(frontier)
        if node in settled:
            continue  # a dearer path to a node that is settled
        settled[node] = cost[node]
        for neighbour in graph[node]:
            offer = cost[node] + graph.edges[node, neighbour]["weight"]
            if offer < cost.get(neighbour, np.inf):
                cost[neighbour], before[neighbour] = offer, node
                heapq.heappush(frontier, (offer, neighbour))
        if len(settled) <= 5:
            tell(node, cost, settled)
    return settled, before


# %%
settled, before = dijkstra(graph, (0, 0))

# %%
import networkx

path = [(5, 3)]
while path[-1] in before:
    path.append(before[path[-1]])
path.reverse()
print(" -> ".join(map(str, path)))
costs = list(settled.values())
assert costs == sorted(costs)  # nodes are settled in the order of their cost
assert np.isclose(settled[5, 3], networkx.dijkstra_path_length(graph, (0, 0), (5, 3)))

# %%
from fgtutor.course.route_pictures import draw_graph

draw_graph(graph, tiny, path, names)

# %% [markdown]
# *What to see:* each cell has up to eight arrows out, in the colour of the policy that is sent.
# There and back are two arrows, and they need not cost the same.
#
# ## And A*?
#
# A* adds to each cost a guess of what is still to come, and so settles fewer nodes. It finds the
# cheapest path if the guess is **admissible**: never too high. The paper uses Dijkstra since costs
# depend on direction and policy. But a safe guess exists: $F \le 1$, so a step never costs less
# than its length, and the straight line to the goal never guesses too high. Move the slider:

# %%
from fgtutor.course.widgets.slides import FrontierSlides

FrontierSlides(M, fused, START, GOAL)

# %% [markdown]
# ## The whole map
#
# `plan` takes metres and gives a `Route`. With `PAPER` a step costs $1/F$ and switching is free.

# %%
from fgtutor.planning import PAPER

task |= {"start": START, "goal": GOAL}
route = plan(fused, policy_map, settings=PAPER, **task)
route

# %%
from fgtutor.figures.maps import draw_route

draw_route(route, M)

# %% [markdown]
# *What to see:* of the four lanes it takes the one with rubble and slopes, right past the ridge.
# The flat detour would be four metres longer.
#
# **$1/F$ against $-\log F$, once more.** If $F$ were the probability of surviving a step, the
# robot would hardly ever arrive:

# %%
print(f"product of F along the route: {route.feasibility.prod():.0e}")
assert route.feasibility.prod() < 1e-6

# %% [markdown]
# In notebook 07 the robot drives such routes, and arrives.

# %% [markdown]
# ## Ask it why
#
# The route can explain each of its steps. Here is the dearest one:

# %%
dearest = max(route.explain(), key=lambda step: step["cost"])
print(f"in cell {dearest['cell']} towards {dearest['heading']}, driven by {dearest['policy']}")
print(f"F_max {dearest['F_max']:.2f}, cost {dearest['cost']:.2f}: ", end="")
print(f"{dearest['share']:.1%} of what the whole route costs")
print("F of each:", {name: round(value, 2) for name, value in dearest["F"].items()})

# %% [markdown]
# Why did it not drive straight over the ridge? And not through the hatched block? Ask about a cell
# of each:

# %%
from fgtutor.tensorization import why_blocked

ridge, hatched = (why_blocked(x, y, assessments) for x, y in ((6.0, 4.2), (5.7, 6.4)))
print(ridge, hatched, sep="\n\n")
assert "never observed" in hatched and "never observed" not in ridge

# %% [markdown]
# The first is closed because each specialist either does not know such ground or would not keep its
# speed; the second because nobody has seen it. This is what the paper means by *transparency*: the
# learning is in $f$ and $w_\text{ood}$, and the decision is arithmetic.

# %% [markdown]
# ## When two are equally good
#
# The route above switches between slopes and rubble several times. On flat ground both are about
# equally good, and $P$ changes from cell to cell. In the paper's plan switching is free; a
# real robot may stumble at each switch. So we let a switch cost as much as a metre of ideal ground.
# For this the planner searches over pairs (cell, policy): a step with policy $p$ costs its length
# over $F_p$, a change of policy costs 1. ([Exercise 06](../exercises/ex06.ipynb) has you write it.)
# And a diagonal step costs its length: by $1/F$ alone it costs as much as a straight one. These are
# our settings, `PlanSettings()`; the paper's are `PAPER`.

# %%
from fgtutor.course.route_pictures import compare_routes

calm = plan(fused, policy_map, **task)
assert calm.switches < route.switches and calm.length <= route.length
compare_routes(M, {"the paper's settings": route, "ours: a switch costs 1 m": calm})

# %% [markdown]
# *What to see:* the route has fewer switches, and it is not longer.

# %% [markdown]
# ## The paper in one file
#
# Notebooks 04 to 06 are Secs. III-B and III-C of the paper. `fgtutor/paper.py` writes them down as
# they stand there, slowly and without our tricks. You have read its first half in notebook 05. Here
# is the rest: the graph and the plan.

# %%
import inspect

from fgtutor import paper

print(inspect.getsource(paper.graph))
print(inspect.getsource(paper.plan))

# %% [markdown]
# Does it agree with the fast way? It cuts one patch after the other, so a part of the map will do:
# from the start into the lane with the gaps.

# %%
from fgtutor.planning import plan_on_map

part, in_lane = M.crop(0.5, 3.0, 4.0, 6.5), (3.5, 5.6)
cells, policies, cost = paper.plan(part, zoo, START, in_lane)
fast = plan_on_map(part, zoo, START, in_lane, settings=PAPER).route
assert np.isclose(cost, fast.cost, rtol=1e-4)
print(f"cost of the cheapest route: paper.py {cost:.4f}, the fast way {fast.cost:.4f}")

# %% [markdown]
# ## A ledge is a one-way street
#
# Now for the classical planner. A costmap turns heights into *one* number per cell, by thresholds.
# It cannot say "down yes, up no". Which ledge is the most one-way for our team?

# %%
from fgtutor import tensorize

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
    title="The lowest F_max on the way over a ledge",
    xlabel="height of the ledge (m)",
    ylabel="F_max",
)

# %%
rise = float(rises[(downs - ups).argmax()])
assert (downs - ups).max() > 0.3 > ups[(downs - ups).argmax()]
heights = np.zeros((50, 44))
heights[20:, :28] = rise  # the ledge itself
heights[14:, 28:] = rise / 2  # further up, the same height in two small steps
heights[27:, 28:] = rise
L = ElevationMap(heights, resolution=0.1)
print(f"a ledge of {rise:.2f} m, and beside it two of {rise / 2:.2f} m")
draw_elevation(L)

# %% [markdown]
# Plan from the low side to the high side and back. The opponent is a **traversability** map (after
# Wermelinger et al., 2016): slope, height of a step and roughness of each cell against critical
# values. Our policy map says which policy drives; the costmap knows of none, so its switches are
# free. Its critical values:

# %%
from fgtutor.baselines import TraversabilityConfig

cautious, bold = TraversabilityConfig(), TraversabilityConfig(step=0.25, roughness=0.1)
for name, critical in {"as published": cautious, "raised for this robot": bold}.items():
    print(f"{name}: slope {critical.slope} rad, ", end="")
    print(f"step {critical.step} m, roughness {critical.roughness} m")

# %%
predict(
    "Which traversability map finds the better route: the one as published, or the one with raised "
    "thresholds?",
    ["as published", "raised", "depends on the direction"],
)

# %%
from fgtutor.baselines import AssessedMap, Switched, find_route, ours, traversability


def costmap(critical):
    return Switched(lambda M, r: traversability(M, r, critical))


ground = AssessedMap(L, zoo)
low_side, high_side = (0.6, 2.0), (4.4, 2.0)
routes = {}
for way, ends in {"up": (low_side, high_side), "down": (high_side, low_side)}.items():
    routes[f"ours, {way}"] = find_route(ours, ground, *ends)
    for name, critical in {"as published": cautious, "raised": bold}.items():
        routes[f"{name}, {way}"] = find_route(costmap(critical), ground, *ends)

# %%
compare_routes(L, routes, columns=3)

# %%
metres = {name: round(one.length, 1) for name, one in routes.items()}
assert metres["ours, up"] > metres["ours, down"]
assert metres["as published, up"] == metres["as published, down"]
assert metres["raised, up"] == metres["raised, down"]
print(metres)
reveal("depends on the direction")

# %% [markdown]
# *What to see:* ours goes up by the two small steps and comes down over the ledge. As published,
# the costmap takes the detour in both directions: downhill its route is longer than it need be.
# With raised thresholds it takes the ledge in both directions: uphill, where our $F$ is below 0.3.
# No threshold gets both right, because a cell has only one number.
#
# And where there is no way round? A corridor with all four obstacles across its whole width:

# %%
from fgtutor import make_terrain

for seed in range(1, 40, 2):
    corridor = make_terrain("mixed", robot="toy", seed=seed)
    ground = AssessedMap(corridor.elevation, zoo)
    answer = find_route(ours, ground, corridor.start, corridor.goal)
    print(f"corridor {seed}: {answer}")
    if answer:  # a Refusal is False
        break

# %%
ends = corridor.start, corridor.goal
refused = find_route(costmap(bold), ground, *ends)
assert answer and not refused
compare_routes(corridor.elevation, {"ours": answer, "costmap, raised": refused}, columns=1)

# %% [markdown]
# *What to see:* even the raised thresholds close the corridor. A gap is half a metre deep; to a
# costmap that is a step of half a metre, and raising the threshold so far would open every wall. It
# was never told what this robot can do.

# %% [markdown]
# ## What you now know
#
# - $F_\text{max}$ is the best value and $P$ its owner (Eqs. 6, 7). Where
#   everything is 0, $P$ means nothing.
# - A step costs $1/F_\text{max}$, an expected time; steps below $f_\text{min}$ do
#   not exist. Dijkstra settles nodes in the order of their cost.
# - The straight line is an admissible guess for A* when a step costs its length over $F$.
# - A new specialist can only raise $F_\text{max}$. Nobody is retrained.
# - One number per cell cannot tell up from down, whatever the threshold.
#
# **Test yourself**
#
# <details><summary>1. Specialist A offers (0.8, 0.1), B offers (0.3, 0.5) for two headings. F_max,
# P, and the costs?</summary>
#
# F_max = (0.8, 0.5), P = (A, B), costs 1.25 and 2.
# </details>
#
# <details><summary>2. Dijkstra settles a node at cost 7. Can a later path reach it for 6?</summary>
#
# No. That path would leave the settled part through a node of the frontier. All of those cost at
# least 7 when this node is taken, and arrows only add to it.
# </details>
#
# <details><summary>3. When would $-\log F$ be the right cost?</summary>
#
# If F were the probability to survive a step, independent of the other steps, and only survival
# counted, not time.
# </details>

# %% [markdown]
# ## What to try
#
# - Replace the maximum by the mean: `torch.stack(list(tensors.values())).mean(dim=0)`.
#   <details><summary>Answer</summary>In a lane where only one of four knows the ground, the mean is
#   a quarter of its F: below 0.25. The step is four times as dear, or closed.</details>
# - Leave the rubble specialist out and plan again. What does the second-best route cost?
#   <details><summary>Answer</summary>Give <code>fuse</code> and <code>tensors</code> the other
#   three. If the lane past the ridge closes, the route takes another lane; its cost tells how much
#   this specialist was worth here.</details>
# - `plan(..., backend="networkx")` searches the graph you have seen. Compare cost and time.
#   <details><summary>Answer</summary>The same cost up to rounding; the time is much longer, since
#   each arrow is a Python object.</details>
# - Tensorize with `headings=16` or `48`, fuse and plan.
#   <details><summary>Answer</summary>The route gets shorter where the goal lies between two compass
#   directions.</details>
#
# **Exercises:** [exercises/ex06.ipynb](../exercises/ex06.ipynb). **Next:** drive it,
# [07_drive_the_plan.ipynb](07_drive_the_plan.ipynb).
