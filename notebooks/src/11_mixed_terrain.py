# %% [markdown]
# # 11 · Mixed terrain
#
# - **You will be able to** send four specialists over a course that none of them masters alone,
#   read from the plan who goes where and why, and put an honest table beside a film
# - **Time** half an hour to read; about a minute on two CPU cores
# - **Needs** notebooks [06](06_fuse_and_plan.ipynb), [07](07_drive_the_plan.ipynb) and
#   [08](08_meet_the_a1.ipynb); uses the shipped specialists and the generalist
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: one ground a cell of
#   the table, and a film of few frames. Long cells show a bar and can be stopped
#
# Steps of 15 cm. Slots too deep to step into. A beam 35 cm wide over a chasm. A valley with walls
# of 50 degrees. All in one corridor, one after another, from wall to wall. (The paper's Table II.)

# %% [markdown]
# ## The course
#
# A narrow corridor keeps the map small; there is no way round anything. If the planner refuses it
# because some of the ground is strange to everybody, we take the next one.

# %%
from dataclasses import replace

from fgtutor import load_zoo, make_terrain
from fgtutor.figures.maps import draw_elevation
from fgtutor.robots import ROBOTS

everyone = load_zoo("a1", include_general=True)
zoo = {name: s for name, s in everyone.items() if name != "general"}
narrow = replace(ROBOTS["a1"].scale, width=2.4)


def corridor(kind, seed):
    return make_terrain(kind, robot="a1", seed=seed, scale=narrow)


# %%
from fgtutor.baselines import AssessedMap, find_route, ours
from fgtutor.course.drives import daring_route
from fgtutor.course.notebooks import budget

for seed in range(1, 2 * budget(fast=2, full=8, unit="courses at most", each=2.0), 2):
    terrain = corridor("mixed", seed)
    assessed = AssessedMap(terrain.elevation, everyone)
    route = find_route(ours, assessed, terrain.start, terrain.goal)
    if route:  # a Refusal is False
        break
    print(f"course {seed}: {route}")
    route = daring_route(assessed, terrain.start, terrain.goal)  # against that advice
route

# %%
M = terrain.elevation
draw_elevation(M)

# %%
for part in terrain.sections:
    print(f"{part.name:7} from {part.x0:5.2f} m to {part.x1:5.2f} m")

# %% [markdown]
# (If every course was refused, the route above is the **daring** one: the best there is if every
# $f$ is believed wherever it is asked, without $w_\text{ood}$. Then this notebook shows whether the
# refusal was wise.)
#
# ## Who knows what
#
# Four autoencoders look at one corridor.

# %%
from fgtutor.figures.maps import draw_weight
from fgtutor.figures.style import Picture

sheet = Picture(7.2, 6.4)
for axes, name in zip(sheet.subplots(len(zoo), 1, sharex=True), zoo, strict=True):
    draw_weight(assessed.assessment(name).ood(), M, name, axes=axes)
    axes.set(xlabel="")
sheet

# %% [markdown]
# *What to see:* full colour is home. In the best of worlds each row lights up over its own section
# and over the level ground, and the four together leave no hole. A hole is where a plan must fail,
# however well somebody could walk there.

# %% [markdown]
# ## One plan
#
# Fuse and plan, exactly as with the toy. Not a line of that code knows what a leg is.

# %%
from fgtutor import fuse
from fgtutor.figures.maps import draw_policy_map, draw_route

fused, policy_map = fuse(list(assessed.tensors().values()))
draw_policy_map(policy_map, fused, M, tuple(zoo))

# %%
draw_route(route, M)

# %% [markdown]
# Who is sent over which section? Count the steps of the route in each.

# %%
import numpy as np

from fgtutor.figures.charts import draw_table

x = (route.xy[:-1, 0] + route.xy[1:, 0]) / 2
shares = [
    np.bincount(route.policies[(x > part.x0) & (x < part.x1)], minlength=len(route.names))
    for part in terrain.sections
]
shares = np.array([share / max(share.sum(), 1) for share in shares])
draw_table(
    shares, [part.name for part in terrain.sections], route.names,
    title="Who drives (column) on which section (row)?", caption="Share of the route's steps",
)  # fmt: skip

# %% [markdown]
# *What to see:* nobody has told the planner which section is which; it has seen heights. Where a
# row does not name its own specialist, ask the route why:

# %%
from fgtutor import directions

worst = max(route.explain(), key=lambda step: step["cost"])
heading = directions.NAMES.index(worst["heading"])
x, y = M.centre_of(*worst["cell"])
print(f"the step it liked least: at ({x:.1f}, {y:.1f}) m, heading {worst['heading']}")
for name in zoo:
    (ix, iy), one = worst["cell"], assessed.assessment(name)
    f, F = (tensor[ix, iy, heading] for tensor in (one.closed(one.f), one.weighted()))
    print(f"{name:7} f = {f:.3f}, with w_ood {F:.3f}")

# %% [markdown]
# ## Walk

# %%
from fgtutor import execute
from fgtutor.execution import FollowConfig

follow = FollowConfig(patience=1.3, grace=4.0)  # who stands still need not stand for minutes
team = {name: zoo[name] for name in route.names}
episode = execute(route, terrain, team, config=follow)
episode

# %%
from fgtutor.course.a1_pictures import show_walk

show_walk(episode, terrain, route, count=9)

# %% [markdown]
# *What to see:* the colour of the hull is the policy in charge; the bar at the bottom says who
# drove when. Compare how it holds itself on the beam and in the valley.
#
# The same as a film, beside this notebook. (A film needs a graphics library; the notebook does
# not.)

# %%
from fgtutor.errors import RenderingError
from fgtutor.figures.videos import save_video

fps = budget(fast=1, full=12, unit="frames for each second of the walk", each=2.0)
try:
    print("a film:", save_video(episode, terrain, route, "walk.mp4", fps=fps))
except RenderingError:
    print("no graphics library draws here: no film")

# %%
from fgtutor.course.route_pictures import draw_drive

draw_drive(episode, route, M)

# %% [markdown]
# ## And the others?
#
# Each specialist alone, planning with its own tensor; **ours**; and **general**, one policy that
# was trained on all four terrains with as many samples as the four together. All over the same
# course, through the same planner and the same execution. A planner that finds no route has
# failed, and we count it so.

# %%
from collections import Counter

from fgtutor.baselines import planners
from fgtutor.course.drives import drive_together

contestants = [*zoo, "ours", *(["general"] if "general" in everyone else [])]
ways = planners(everyone)


# %%
def compete(ground, assessed, seeds):
    """Plan with each planner, walk all the routes side by side, and count what came of it."""
    ends = ground.start, ground.goal
    routes = {name: find_route(ways[name], assessed, *ends) for name in contestants}
    going = [(name, seed) for name in contestants if routes[name] for seed in seeds]
    walks = drive_together([(routes[n], ground, s) for n, s in going], everyone, config=follow)
    outcomes = {name: Counter() for name in contestants}
    for (name, _), walk in zip(going, walks, strict=True):
        outcomes[name][walk.reason] += 1
    for name in contestants:
        outcomes[name]["no route"] += 0 if routes[name] else len(seeds)
    return outcomes


# %%
trials = budget(fast=2, full=10, unit="walks for each of them", each=1.5)
table = {"mixed": compete(terrain, assessed, range(trials))}
for name in contestants:
    print(f"{name:8}", dict(+table["mixed"][name]))

# %%
from fgtutor.figures.charts import draw_rates

draw_rates(
    {name: (table["mixed"][name]["reached"], trials) for name in contestants},
    title="Who crosses the mixed course?",
)

# %% [markdown]
# *What to see:* compare `ours` with the best of the rest, and *how* the rest fail: with "no route"
# a robot has failed on paper, where failing is cheap.

# %% [markdown]
# ## Table II, in small
#
# Now each terrain by itself, on ground that nobody was trained on.

# %%
from tqdm import tqdm

every = ["steps", "bridge", "gaps", "valley"]
kinds = every[: budget(fast=1, full=4, unit="of four kinds of ground")]
count = budget(fast=2, full=10, unit="walks on each", each=1.5)
for kind in tqdm(kinds):
    table[kind] = {name: Counter() for name in contestants}
    for seed in range(101, 101 + count, 2):  # two walks on each ground
        ground = corridor(kind, seed)
        result = compete(ground, AssessedMap(ground.elevation, everyone), range(2))
        for name in contestants:
            table[kind][name] += result[name]

# %%
counts = {kind: [row[name]["reached"] for name in contestants] for kind, row in table.items()}
totals = {kind: sum(row["ours"].values()) for kind, row in table.items()}
draw_table(
    [[n / totals[kind] for n in row] for kind, row in counts.items()], list(counts), contestants,
    title="Who reaches the goal (column), on which terrain (row)?", caption="Successes, and trials",
    texts=[[f"{n} of {totals[kind]}" for n in row] for kind, row in counts.items()],
)  # fmt: skip

# %% [markdown]
# *What to see:* how sure may you be of any two cells that differ by one? With this many trials the
# true rate lies in this range:

# %%
from fgtutor.statistics import wilson_interval

for kind, total in totals.items():
    low, high = wilson_interval(total, total)
    print(f"{kind:7} even {total} of {total} only says: more than {low:.0%}")

# %% [markdown]
# That is why the real table has thousands of trials behind it, and why this package never prints a
# rate without its interval. `fgtutor evaluate matrix --robot a1 --trials 200 --out report` makes
# one that you can put your name to; `--protocol paper` is the paper's own. It can be interrupted,
# and it says beforehand how long it will take. Notebook 13 shows how to share the work.

# %% [markdown]
# ## What to try
#
# - Take one specialist away: `{n: s for n, s in everyone.items() if n != "bridge"}` in a new
#   `AssessedMap`. What does the planner say, and where?
# - `AssessedMap(..., taus="paper")`: the paper's one pair of thresholds for all. Who gains ground?
# - `find_route(..., PAPER)` plans by the paper's settings. Count the switches; then walk it.
# - Plan without headings, `ways["no-heading"]`. On which section does it hurt most, and why there?
#
# **Exercises:** [exercises/ex11.ipynb](../exercises/ex11.ipynb). **Next:** nobody gives you a
# map, [12_from_a_scan_to_a_walk.ipynb](12_from_a_scan_to_a_walk.ipynb).
