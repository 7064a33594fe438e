# %% [markdown]
# # 11 · Mixed terrain
#
# - **You will be able to** send four specialists over a course that none of them masters alone,
#   read from the plan who goes where and why, and put an honest table beside a film
# - **Time** 45 minutes to read and try; two to three minutes on two CPU cores
# - **Needs** notebooks [06](06_fuse_and_plan.ipynb), [07](07_drive_the_plan.ipynb) and
#   [08](08_meet_the_a1.ipynb); uses the shipped specialists and the generalist
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer walks, and a
#   film of few frames. Long cells show a bar and can be stopped
#
# Steps of 15 cm. Slots too deep to step into. A beam 35 cm wide over a chasm. A valley with walls
# of 50 degrees. All in one corridor, one after the other, from wall to wall. This is the experiment
# of the paper's Sec. IV-B (Fig. 6 and Table II).

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=11)

# %% [markdown]
# Symbols are those of the [notation page](../docs/notation.md), and numbers of equations and tables
# are the paper's.
#
# ## The course
#
# A narrow corridor keeps the map small, and there is no way round anything. The planner may refuse
# a course, if part of it is strange to every specialist. Then we take the next one.

# %%
from dataclasses import replace

from fgtutor import load_zoo, make_terrain  # loads the robots: some seconds, once
from fgtutor.robots import ROBOTS

everyone = load_zoo("a1", include_general=True)
zoo = {name: s for name, s in everyone.items() if name != "general"}
narrow = replace(ROBOTS["a1"].scale, width=2.4)


def corridor(kind, seed):
    return make_terrain(kind, robot="a1", seed=seed, scale=narrow)


# %%
from fgtutor.baselines import AssessedMap, find_route, ours

for seed in range(1, 16, 2):  # odd: nobody was trained on these
    terrain = corridor("mixed", seed)
    assessed = AssessedMap(terrain.elevation, everyone)
    answer = find_route(ours, assessed, terrain.start, terrain.goal)
    print(f"course {seed}: {answer}")
    if answer:  # a refusal is False
        break
route = answer.raise_for()

# %%
from fgtutor.figures.maps import draw_elevation

M, sections = terrain.elevation, terrain.sections
for part in sections:
    print(f"{part.name:7} from {part.x0:5.2f} m to {part.x1:5.2f} m")
draw_elevation(M, title="Elevation map M")

# %%
from fgtutor.course.ask import predict, reveal

predict("Four autoencoders look at this corridor. Where will that of `bridge` feel at home?")

# %% [markdown]
# ## Who knows what
#
# $w_\text{ood}$ (Eq. 4) of each specialist, the mean over the headings:

# %%
from fgtutor.figures.maps import draw_weight
from fgtutor.figures.style import Picture

weights = {name: assessed.assessment(name).ood() for name in zoo}
sheet = Picture(7.2, 6.4)
for axes, name in zip(sheet.subplots(len(zoo), 1, sharex=True), zoo, strict=True):
    draw_weight(weights[name], M, name, axes=axes)
    axes.set(xlabel="")
sheet

# %% [markdown]
# Colours are hard to compare. So read $w_\text{ood}$ at every step of the route, at its heading:

# %%
import numpy as np

kinds = [part.name for part in sections]  # in the order of the course
x = (route.xy[:-1, 0] + route.xy[1:, 0]) / 2
inside = [(x > part.x0) & (x < part.x1) for part in sections]
at = (*route.cells[:-1].T, route.headings)
familiar = np.array([[weights[name][at][own].mean() for name in kinds] for own in inside])

# %%
from fgtutor.figures.charts import draw_table

draw_table(
    familiar, kinds, kinds,
    title="Who (column) knows the route on which section (row)?", caption="Mean of w_ood",
)  # fmt: skip

# %%
assert (familiar.argmax(axis=1) == np.arange(len(kinds))).all() and np.diag(familiar).min() > 0.5
column = familiar[:, kinds.index("bridge")]
reveal("On its own section: " + ", ".join(map("{} {:.2f}".format, kinds, column)))

# %% [markdown]
# *What to see:* the diagonal. On each section its own specialist knows the ground along the route,
# and the others know it less or not at all. If a row were 0 throughout, there would be a hole in
# the course. No route could cross it, however well somebody could walk there.
#
# ## One plan
#
# Fuse and plan, exactly as with the toy. None of that code knows what a leg is.
#
# $$
# F_\text{max}(x, y, k) = \max_i F_i(x, y, k), \tag{6}
# $$
# $$
# P(x, y, k) = \operatorname*{arg\,max}_i F_i(x, y, k). \tag{7}
# $$

# %%
from fgtutor import fuse
from fgtutor.figures.maps import draw_policy_map, draw_route

fused, policy_map = fuse(list(assessed.tensors().values()))
draw_policy_map(policy_map, fused, M, tuple(zoo))

# %%
draw_route(route, M)

# %% [markdown]
# **Walk along the route** with the slider: who drives, and how familiar does each specialist find
# the ground there?

# %%
from fgtutor.course.widgets.slides import RouteSlides

RouteSlides(route, M, weights)

# %% [markdown]
# Who is sent over which section? Count the steps of the route in each:

# %%
driver = np.array(route.names)[route.policies]
shares = np.array([[np.mean(driver[own] == name) for name in kinds] for own in inside])
draw_table(
    shares, kinds, kinds,
    title="Who drives (column) on which section (row)?", caption="Share of the route's steps",
)  # fmt: skip

# %%
assert (np.diag(shares) > 0.5).all(), "each section should mostly be driven by its own specialist"

# %% [markdown]
# *What to see:* the diagonal. Nobody has told the planner which section is which; it has only seen
# heights. Now look for the place on the route where $w_\text{ood}$ took away most of a promise:

# %%
from fgtutor import directions

taken = {name: ((1 - weights[name]) * assessed.assessment(name).f)[at].numpy() for name in zoo}
bold = max(zoo, key=lambda name: taken[name].max())
step = taken[bold].argmax()
(ix, iy), k = route.cells[step], route.headings[step]
print(f"at ({route.xy[step, 0]:.1f}, {route.xy[step, 1]:.1f}) m, heading {directions.NAMES[k]}")
for name in zoo:
    f, w_ood = assessed.assessment(name).f[ix, iy, k], weights[name][ix, iy, k]
    print(f"{name:7} f = {f:.3f}, w_ood = {w_ood:.3f}, F = {w_ood * f:.3f}")

# %%
assert taken[bold].max() > 0.2 and driver[step] != bold
print(f"{bold} promises much there; {driver[step]} drives")

# %% [markdown]
# *What to see:* compare the columns. One specialist promises much about ground that it has never
# seen. Eq. 5 takes the promise away, and a different one drives.
#
# ## Walk

# %%
from fgtutor import execute
from fgtutor.execution import FollowConfig

follow = FollowConfig(patience=1.3, grace=4.0)  # do not wait for minutes for a robot that is stuck
team = {name: zoo[name] for name in route.names}
episode = execute(route, terrain, team, config=follow)
episode

# %%
from fgtutor.course.a1_pictures import show_walk

show_walk(episode, terrain, route, count=9)

# %% [markdown]
# *What to see:* the colour of the hull is the policy in charge; the bar at the bottom says who
# drove when. Compare how the robot holds itself on the beam and in the valley.
#
# Here is the same as a film, beside this notebook. (It needs a graphics library; the rest does
# not.)

# %%
from fgtutor.course.notebooks import budget
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
# Six contestants, as in Table II: each specialist alone, planning with its own tensor; **ours**;
# and **general**, one policy that was trained on all four terrains. All use the same planner and
# the same execution. A planner that finds no route has failed, and counts as failed (Sec. IV-B).

# %%
predict(
    "How many of the four specialists cross the mixed course alone?", ["none", "one", "all four"]
)

# %%
from collections import Counter

from fgtutor.baselines import planners
from fgtutor.course.drives import drive_together

contestants = [*kinds, "ours", *(["general"] if "general" in everyone else [])]
plan_by = planners(everyone)


# %%
def compete(ground, assessed, seeds):
    """Plan with each planner, walk all the routes side by side, and count what came of it."""
    ends = ground.start, ground.goal
    routes = {name: find_route(plan_by[name], assessed, *ends) for name in contestants}
    going = [(name, seed) for name in contestants if routes[name] for seed in seeds]
    walks = drive_together([(routes[n], ground, s) for n, s in going], everyone, config=follow)
    outcomes = {name: Counter() for name in contestants}
    for (name, _), walk in zip(going, walks, strict=True):
        outcomes[name][walk.reason] += 1
    for name in contestants:
        outcomes[name]["no route"] += 0 if routes[name] else len(seeds)
    return outcomes


# %%
trials = budget(fast=4, full=20, unit="walks for each of them", each=1.5)
mixed = compete(terrain, assessed, range(trials))
for name in contestants:
    print(f"{name:8}", dict(+mixed[name]))

# %%
from fgtutor.figures.charts import draw_rates

draw_rates(
    {name: (mixed[name]["reached"], trials) for name in contestants},
    title="Who crosses the mixed course?",
)

# %%
alone = {kind: mixed[kind]["reached"] for kind in kinds}
assert mixed["ours"]["reached"] > max(alone.values())
reveal("none" if not any(alone.values()) else f"{sum(map(bool, alone.values()))} of four")

# %% [markdown]
# *What to see:* the outcome of the others is "no route", not "fell". They have failed on paper,
# where failing is cheap.
#
# ## Table II, in small
#
# Now each terrain by itself, on ground that nobody was trained on. The paper's numbers, in percent,
# from 10,000 trials each:
#
# | terrain | steps | gaps | bridge | valley | ours | general |
# |---|---|---|---|---|---|---|
# | steps | 99.99 | 0 | 0 | 61.30 | 99.96 | 98.75 |
# | gaps | 0 | 99.45 | 0 | 0 | 99.49 | 0 |
# | bridge | 0 | 0 | 98.07 | 0 | 100 | 0 |
# | valley | 0 | 0 | 0 | 99.60 | 99.69 | 58.94 |
# | mixed | 0 | 0 | 0 | 0 | 98.60 | 0 |

# %%
from tqdm import tqdm

grounds = budget(fast=2, full=10, unit="grounds of each kind, two walks on each", each=10.0)
rows = ["steps", "gaps", "bridge", "valley"]
table = {kind: {name: Counter() for name in contestants} for kind in rows}
for kind, seed in tqdm([(k, s) for k in rows for s in range(101, 101 + 2 * grounds, 2)]):
    ground = corridor(kind, seed)
    result = compete(ground, AssessedMap(ground.elevation, everyone), range(2))
    for name in contestants:
        table[kind][name] += result[name]
table["mixed"] = mixed

# %%
from fgtutor.statistics import Share

columns = [*rows, *contestants[len(kinds) :]]  # in the paper's order, as the rows
cells = [
    [Share(successes=row[name]["reached"], trials=row[name].total()) for name in columns]
    for row in table.values()
]
draw_table(
    [[s.successes / s.trials for s in row] for row in cells], list(table), columns,
    title="Who reaches the goal (column), on which terrain (row)?",
    caption=f"Success, % (95 % interval); {2 * grounds} trials per cell, mixed {trials}",
    texts=[[str(s).replace(" ", "\n") for s in row] for row in cells],
)  # fmt: skip

# %%
for kind in rows:
    own, ours_too = table[kind][kind]["reached"], table[kind]["ours"]["reached"]
    assert min(own, ours_too) > 0.7 * 2 * grounds, f"{kind}: {own} and {ours_too}"

# %% [markdown]
# *What to see:* the diagonal, as in the paper, and `ours` beside it. Then the differences. The
# paper's valley policy gets over steps in 61 % of the trials: a specialist can cross foreign ground
# if its own net finds enough of it familiar. And our generalist is not the paper's.
#
# How much do these numbers prove? If $n$ of $n$ succeed, the lower end of Wilson's interval is
# $n / (n + z^2)$ with $z = 1.96$.
#
# **Your line.** Below which true success rate need you not think, after 20 of 20?

# %%
n, z = 20, 1.96
lowest = ...  # a formula of n and z

if lowest is ...:
    print("Not filled in yet. Put the numbers into the formula above.")
else:
    from fgtutor.statistics import wilson_interval

    assert abs(lowest - wilson_interval(20, 20)[0]) < 1e-3, f"got {lowest}"
    print(f"Right: {lowest:.0%}. Even a perfect 20 of 20 leaves that much open.")

# %% [markdown]
# So of two cells that differ by one success nothing can be said. The table in the README has
# hundreds of trials per cell, and this package never prints a rate without its interval.
# `fgtutor evaluate matrix --robot a1 --trials 200 --out report` makes such a table;
# `--protocol paper` is the paper's own. It can be interrupted, and it says beforehand how long it
# will take. Notebook 13 shows how to share the work.

# %% [markdown]
# ## What you now know
#
# - $w_\text{ood}$ decides who may speak about a place, and the maximum decides who drives there.
# - Nobody tells the planner what a bridge is. The diagonal comes out of heights alone.
# - A refusal is a result: it counts as a failure, but nothing breaks.
# - A table needs its intervals, and trials on one ground are alike: many grounds beat many walks.
#
# **Test yourself**
#
# <details><summary>1. The route switches from steps to bridge on level ground before the beam, not
# on its first plank. Why can that be cheaper?</summary>
#
# A patch looks 0.8 m ahead. Near the beam the steps specialist already sees ground that it does not
# know, so its F falls before the beam begins. And a switch needs a step that both can take.
# </details>
#
# <details><summary>2. Why does the general policy use the same planner in the comparison?</summary>
#
# So that the two differ in one thing only, the policies. With a different planner you could not
# tell which of the two made the difference.
# </details>
#
# <details><summary>3. Ours succeeds in 19 of 20 and a specialist in 20 of 20 on its own terrain. Is
# fusion harmful?</summary>
#
# Nobody can tell: the intervals are 76-99 % and 84-100 %. Drive more grounds.
# </details>
#
# ## What to try
#
# - Take one specialist away: `{n: s for n, s in everyone.items() if n != "bridge"}` in a new
#   `AssessedMap`. What does the planner say, and where?
#   <details><summary>Answer</summary>It refuses: a chain of steps with F above f_min ends in front
#   of the beam. The refusal names how far it got.</details>
# - `AssessedMap(..., taus="paper")`: the paper's one pair of thresholds for all. Who gains ground?
#   <details><summary>Answer</summary>Compare the mean of each w_ood. A specialist whose terrain is
#   hard to rebuild loses even its own ground under thresholds that were chosen for other nets. That
#   is why ours are calibrated for each specialist.</details>
# - `find_route(..., PAPER)` from `fgtutor.settings` plans by the paper's settings. Count the
#   switches, then walk it.
#   <details><summary>Answer</summary>Switching is free there, so policies of nearly equal F take
#   turns and there are many more switches. See notebook 12 for what they cost.</details>
# - Plan without headings, `plan_by["no-heading"]`. On which section does it hurt most?
#   <details><summary>Answer</summary>Compare the least F of the two routes. On the beam and in the
#   valley, going along is easy and going across is impossible: the mean over the headings hides
#   that. `docs/results.md` has the success rates.</details>
#
# **Exercises:** [exercises/ex11.ipynb](../exercises/ex11.ipynb). **Next:** nobody gives you a
# map, [12_from_a_scan_to_a_walk.ipynb](12_from_a_scan_to_a_walk.ipynb).
