# %% [markdown]
# # 07 · Drive the plan
#
# - **You will be able to** drive a planned route in simulation, switch policies on the way, compare
#   what the plan promised with what the drive delivered, and report a success rate with its
#   interval
# - **Time** 40 minutes to read and try; about 2 minutes on two CPU cores, most of it one table
# - **Needs** notebook [06](06_fuse_and_plan.ipynb) for routes; uses the shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer trials in the
#   table at the end, the only long cell. It shows a bar and can be stopped
#
# A plan promises that the robot will get there. In this notebook we find out (paper, Secs. III-C
# and IV-B).

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=7)

# %% [markdown]
# ## From map to route, in one call
#
# `plan_on_map` is notebooks 04 to 06 in one function. Our ground is a corridor with all four
# obstacles across its whole width: there is no way round. If the planner refuses a corridor, we
# take the next. ([Notation](../docs/notation.md))

# %%
from fgtutor import load_zoo, make_terrain  # loads the robots: some seconds, once
from fgtutor.planning import plan_on_map

zoo = load_zoo("toy")
for seed in range(1, 40, 2):
    terrain = make_terrain("mixed", robot="toy", seed=seed)
    M, start, goal = terrain.elevation, terrain.start, terrain.goal
    planned = plan_on_map(M, zoo, start, goal)
    if planned.answer:  # a Route, or a Refusal, which is False
        break
    print(f"corridor {seed}: {planned.answer}")
route = planned.route
route

# %%
from fgtutor.figures.maps import draw_route

assert len(set(route.policies)) == 4  # every specialist is needed
draw_route(route, M)

# %% [markdown]
# ## How to follow a line: pure pursuit
#
# The route is a line. To follow it, the robot looks for the point of the line nearest to it, goes
# on from there by the **lookahead** $\ell$ (0.55 m), and steers for the point it finds there. Let
# $\psi^*$ be the direction from the robot to that point and $\psi$ the robot's yaw. It turns at
#
# $$
# \omega = \mathrm{clip}\big(3\,\mathrm{wrap}(\psi^* - \psi),
# \ -\omega_\text{max},\ \omega_\text{max}\big),
# $$
#
# where $\mathrm{wrap}$ brings the difference into $[-\pi, \pi)$, and it slows down while it turns.

# %%
from itertools import pairwise

import numpy as np

lookahead = 0.55
line = np.array([(0, 0), (0.5, 0), (1, 0.5), (1.5, 0.5)])
robot, yaw = np.array((0.3, 0.15)), -0.3

fine = np.concatenate([np.linspace(a, b, 50, endpoint=False) for a, b in pairwise(line)])
nearest = np.linalg.norm(fine - robot, axis=1).argmin()
along = np.concatenate(([0], np.linalg.norm(np.diff(fine, axis=0), axis=1).cumsum()))
aim = fine[np.searchsorted(along, along[nearest] + lookahead)]
print(f"nearest point {fine[nearest].round(2)}, aim {aim.round(2)}")

# %% [markdown]
# **Your line.** Compute the turn rate $\omega$, in rad/s, with a limit of 1.5 rad/s.

# %%
direction = np.arctan2(*(aim - robot)[::-1])
error = (direction - yaw + np.pi) % (2 * np.pi) - np.pi
omega = ...  # a formula of error; np.clip(value, low, high) clips

if omega is ...:
    print("Not filled in yet: replace the three dots.")
else:
    assert np.isclose(omega, np.clip(3 * error, -1.5, 1.5)), "3 times the error, clipped to 1.5"
    print("Right: positive, so it turns to the left.")

# %%
from fgtutor.figures.style import Picture

sketch = Picture(7.0, 3.2)
axes = sketch.subplots()
axes.plot(*line.T, color="silver", linewidth=6, label="route")
axes.plot(*fine[nearest], "o", color="black", label="nearest point")
axes.plot(*aim, "*", color="black", markersize=14, label="aim: 0.55 m further on")
axes.annotate("", robot + 0.3 * np.array((np.cos(yaw), np.sin(yaw))), robot,
              arrowprops={"arrowstyle": "->", "linewidth": 2})  # fmt: skip
axes.plot(*np.stack((robot, aim)).T, "--", color="black", label="where it wants to go")
axes.plot(*robot, "s", color="tab:blue", markersize=10, label="robot; the arrow is its yaw")
axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="Pure pursuit")
axes.legend(loc="upper left", fontsize=8)
sketch

# %% [markdown]
# A short lookahead follows tightly but wobbles; a long one is smooth but cuts corners.
#
# ## When to change the driver: hysteresis
#
# The route names a policy for each step: $P$ at its cell and heading (Eq. 7). A robot that stands
# between two cells could be told to switch to and fro 25 times per second. So a new policy takes
# over only once it has been wanted for `hold_steps = 3` control steps in a row.

# %%
wanted = list("AAABABBBBBBAAAA")
active, waiting, driven = wanted[0], 0, []
for policy in wanted:
    waiting = waiting + 1 if policy != active else 0
    if waiting >= 3:
        active, waiting = policy, 0
    driven.append(active)
print("wanted", "".join(wanted), " driven", "".join(driven))
assert driven.count("B") == 6  # no flicker at step 4, and each change comes two steps late

# %% [markdown]
# ## Go

# %%
from fgtutor import execute

episode = execute(route, terrain, zoo)
assert episode.success
episode

# %%
from fgtutor.course.route_pictures import draw_drive

draw_drive(episode, route, M)

# %%
from fgtutor.figures.videos import film_strip

film_strip(episode, terrain, route, count=6)

# %% [markdown]
# *What to see:* the colour of the robot is the policy in charge, and the bar at the bottom shows
# who drove when. Each policy holds its legs in its own posture. To make a film of it:
# `fgtutor.figures.videos.save_video(episode, terrain, route, "drive.mp4")`.

# %% [markdown]
# ## What does a switch cost?
#
# The plan above counts a switch like a metre of ideal ground. In the paper it is free. Move the
# slider and watch the switches.

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "How many switches does the route keep, however dear a switch is?",
    ["none", "three", "one for each cell on it whose owner is not that of the cell before"],
)

# %%
from fgtutor.course.widgets.slides import SwitchSlides

SwitchSlides(M, planned, start, goal)

# %%
from fgtutor import plan

task = {"grid": M, "start": start, "goal": goal, "tensors": planned.tensors, "names": planned.names}
free = plan(planned.fused, planned.policy_map, switch_cost=0.0, **task)
dear = plan(planned.fused, planned.policy_map, switch_cost=8.0, **task)
print(f"free: {free.switches} switches; a switch costs 8 m: {dear.switches}")
assert dear.switches == 3 <= free.switches
reveal("three")

# %% [markdown]
# Four obstacles, each of which only one specialist can cross: three hand-overs are the least.
#
# ## What was promised, what was delivered
#
# For each step the plan promised a feasibility: the predicted mean $r_v$ (Eq. 1) over the next
# second. Now we know what came. Lay the two side by side along the drive.

# %%
import torch

from fgtutor.feasibility import tracking_reward

poses = episode.poses
dt = episode.seconds / len(poses)
speed = np.hypot(*np.gradient(poses[:, :2], dt, axis=0).T)
wanted = zoo[planned.names[0]].command[0]
error = torch.tensor(np.stack((speed - wanted, np.zeros_like(speed)), axis=-1))
r_v = tracking_reward(error, torch.zeros(2)).numpy()

# %%
from fgtutor.figures.charts import draw_curves

window = round(1 / dt)
delivered = np.convolve(r_v, np.ones(window) / window, mode="valid")  # the second that follows
now = poses[: len(delivered), None, :2]
nearest = np.linalg.norm(now - route.xy[None, :-1], axis=-1).argmin(axis=1)
promised = route.feasibility[nearest]
draw_curves(
    now[:, 0, 0],
    {"promised: F on the route": promised, "delivered: mean r_v of the next second": delivered},
    title="Did the plan keep its promise?",
    xlabel="x (m)",
    ylabel="feasibility, r_v",
)

# %%
together = np.corrcoef(promised, delivered)[0, 1]
print(f"mean promised {promised.mean():.2f}, delivered {delivered.mean():.2f}")
print(f"correlation {together:.2f}")
assert together > 0.5

# %% [markdown]
# *What to see:* the curves do not lie on each other. The promise was made for a robot that drives
# straight along one of eight headings at one speed. But on the whole, where the promise dips, the
# drive is slower. Where it dips and the drive does not, the net is too pessimistic there.
#
# ## Will it arrive?
#
# $F$ says how well a step goes, and not whether the robot arrives. For that a route has a promise
# of its own: with $l_k$ the length of step $k$ in metres,
#
# $$p = \prod_k \exp\left(-l_k\, h(F_k)\right), \qquad h(F) = e^{4 - 20 F}.$$
#
# $h$ says how many walks end per metre. It was fitted to drives of the A1, and is ours: the paper
# has none. A route that promises less than `least_promise = 0.25` is not taken: the planner looks
# for a way round its worst steps, and refuses if it finds none.

# %%
predict(
    "Half a metre of F = 0.1 lies across the way. How likely does the robot get over it?",
    ["about 0.9", "about 0.5", "below 0.05"],
)

# %%
for F in (0.1, 0.2, 0.3, 0.5):
    ends = np.exp(4 - 20 * F)
    print(f"F = {F}: {ends:.4f} walks end per metre, 0.5 m promise {np.exp(-0.5 * ends):.3f}")
print(f"our route promises {route.promise:.3f}")
assert np.exp(-0.5 * np.exp(4 - 20 * 0.1)) < 0.05 and route.promise > 0.9
reveal("below 0.05")

# %% [markdown]
# *What to see:* a metre of $F = 0.3$ ends one walk in eight, a metre of $F = 0.1$ nearly all. The
# cost $l/F$ of the two differs by a factor of three only.

# %% [markdown]
# ## The wrong driver
#
# How much of this do we owe to choosing the right policy? Take the very same route, and let one
# specialist drive all of it, from five starts a few centimetres apart.

# %%
predict(
    "How many of the four specialists reach the goal alone every time?",
    ["none", "one", "two or more"],
)

# %%
from dataclasses import replace

from fgtutor.execution import FollowConfig, execute_batch

alone = {
    name: replace(route, policies=np.full_like(route.policies, i))
    for i, name in enumerate(planned.names)
}
starts = range(5)
attempts = {
    name: execute_batch(
        [way] * len(starts), [terrain] * len(starts), zoo, seeds=starts,
        config=FollowConfig(patience=1.5), record_body=True,
    )
    for name, way in alone.items()
}  # fmt: skip
for name, drives in attempts.items():
    print(f"{name:7} arrives {sum(d.success for d in drives)} of 5 times; the first: {drives[0]}")

# %%
worst = min(attempts, key=lambda name: attempts[name][0].length)
assert not any(all(d.success for d in drives) for drives in attempts.values())
reveal("none")
draw_drive(attempts[worst][0], alone[worst], M)

# %%
film_strip(attempts[worst][0], terrain, alone[worst], count=4)

# %% [markdown]
# *What to see:* the route is the same; only the driver is different, and none can be relied on: one
# gets through now and then, the others stop or fall where the ground is not theirs.

# %% [markdown]
# ## One drive proves little
#
# One drive shows that it *can* work. How often does it? Start a little differently each time, and
# let the robot be wrong about where it is.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.figures.charts import draw_rates

trials = budget(fast=10, full=50, unit="drives for each error", each=0.3)
rates = {}
for drift in (0.0, 0.05, 0.15):
    lost = FollowConfig(position_noise=0.02, drift=drift, patience=1.5)
    drives = execute_batch(
        [route] * trials, [terrain] * trials, zoo, seeds=range(trials), config=lost
    )
    rates[f"drift {drift:.2f} m after 1 s"] = (sum(d.success for d in drives), trials)

# %%
draw_rates(rates, title="How well must the robot know where it is?")

# %% [markdown]
# *What to see:* the black lines are 95 % intervals: with $k$ successes of $n$, the true rate lies
# somewhere in there (Wilson, 1927). Two that overlap have not shown a difference.

# %% [markdown]
# ## The table
#
# Now the question of the paper's Table II, for the toy. Each specialist plans and drives on its
# own. **Ours** fuses all four. **General** is one policy that was trained on all terrains with as
# many samples as one specialist. And a **traversability** map plans with thresholds raised for this
# robot (notebook 06), while our policy map says who drives. The ground is new to all.

# %%
from fgtutor.baselines import Switched, TraversabilityConfig, planners, traversability


def cells(elevation, radius):
    return traversability(elevation, radius, TraversabilityConfig(step=0.25, roughness=0.1))


kinds = ["steps", "gaps", "slopes", "rubble", "mixed"]
everyone = load_zoo("toy", include_general=True)
chosen = {name: planners(everyone)[name] for name in [*kinds[:4], "ours", "general"]}
chosen["costmap"] = Switched(cells)
trials = budget(fast=4, full=20, unit="trials per field, 35 fields", each=3.0)

# %%
from tqdm import tqdm

from fgtutor.evaluation.trials import Ground, drive
from fgtutor.planning import PlanSettings

rows = []
for kind in tqdm(kinds):
    tiles = [make_terrain(kind, robot="toy", seed=2 * i + 1) for i in range(trials)]
    grounds = [Ground(terrain=tile, seeds=(i,)) for i, tile in enumerate(tiles)]
    rows += drive(grounds, chosen, everyone, settings=PlanSettings())

# %%
from fgtutor.figures.charts import draw_table
from fgtutor.statistics import wilson_interval


def crossed(kind, name):
    return sum(r.outcome == "reached" for r in rows if (r.terrain, r.policy) == (kind, name))


def with_interval(count):
    low, high = wilson_interval(int(count), trials)
    return f"{count}\n{low:.0%}-{high:.0%}"


counts = np.array([[crossed(kind, name) for name in chosen] for kind in kinds])

# %%
draw_table(
    counts / trials,
    kinds,
    [*chosen],
    title="Who reaches the goal (column), on which terrain (row)?",
    caption=f"Successes of {trials}, and the 95 % interval of the rate",
    texts=[[with_interval(value) for value in row] for row in counts],
)

# %%
specialists, team = counts[:4, :4], counts[:, 4]
assert (specialists.argmax(axis=1) == np.arange(4)).all()  # the diagonal
assert (abs(team[:4] - specialists.diagonal()) <= trials / 4).all()
assert counts[4, :4].max() < team[4]  # on mixed ground only a team gets through
print("on its own terrain:", specialists.diagonal(), " ours:", team[:4], " of", trials)

# %% [markdown]
# *What to see:* rows and columns are in the same order, so the **diagonal** is each specialist on
# its own terrain, where it is the best of the four. **Ours** is about as good as the diagonal in
# every row. The last row has all four obstacles one after the other: there ours leads. How do
# the others fail?

# %%
from collections import Counter

for name in chosen:
    print(f"{name:8}", dict(Counter(row.outcome for row in rows if row.policy == name)))

# %% [markdown]
# `no_route` means that the planner refused: by its tensor there is no chain of steps, or none that
# promises enough. A refusal counts as a failure in this table, as in the paper (Sec. IV-B), and it
# is the cheapest one: nothing is broken. The costmap refuses for a different reason: to it, a gap
# is a wall. Where it does not refuse it may still fall: its thresholds do not know who drives.
#
# A difference of one or two successes means nothing yet: look at the intervals. The tables in
# [results](../docs/results.md) have 200 trials per field; `fgtutor evaluate matrix` makes them.

# %% [markdown]
# ## What you now know
#
# - Pure pursuit steers for a point a lookahead ahead on the route; hysteresis keeps drivers from
#   flickering.
# - A cost on switching removes needless hand-overs, and keeps those that the ground requires.
# - A promise ($F$) can be checked against the deed ($r_v$).
# - A success rate is worth as much as its interval is narrow.
# - You have the whole method: patches, joint training, $w_\text{ood}$, tensors, fusion, planning,
#   driving. From here on the same functions drive a robot with four legs.
#
# **Test yourself**
#
# <details><summary>1. The robot faces 170°, its aim lies at -170°. Which way does it turn, and by
# how much?</summary>
#
# wrap(-170° - 170°) = wrap(-340°) = +20°: to the left by 20 degrees.
# </details>
#
# <details><summary>2. 9 of 10 drives succeed with A, 7 of 10 with B. Is A better?</summary>
#
# Not shown: the 95 % intervals, 60-98 % and 40-89 %, overlap widely.
# </details>
#
# <details><summary>3. What goes wrong without hysteresis if the robot's estimate of its place
# jitters by a centimetre at the border of two cells?</summary>
#
# The wanted policy may change at every control step, and each change asks the legs for a different
# posture.
# </details>

# %% [markdown]
# ## What to try
#
# - Set `FollowConfig(hold_steps=1)` or `15` in `execute`. What does hysteresis buy, and what does
#   it cost?
#   <details><summary>Answer</summary>With 15 steps the new policy comes late, at the toy's 25
#   decisions per second by 0.6 s, which is half a metre: it may begin an obstacle with the wrong
#   driver. With 1 step nothing is late, but flickers are driven.</details>
# - Plan with the paper's settings, `plan_on_map(..., settings=PAPER)`. Is the route different?
#   <details><summary>Answer</summary>It has more switches and may zigzag, since a diagonal step
#   costs no more than a straight one. Its taus are the paper's too, so it may refuse or dare
#   more.</details>
# - Take a corridor that the plan refuses, and drive straight through with
#   `fgtutor.course.drives.straight_route(terrain, "steps")`. Was it right to refuse?
#   <details><summary>Answer</summary>Count over ten seeds. A refusal was wise if such drives fail
#   more often than planned ones.</details>
#
# **Exercises:** [exercises/ex07.ipynb](../exercises/ex07.ipynb). **Next:** a robot with legs,
# [08 Meet the A1](08_meet_the_a1.ipynb).
