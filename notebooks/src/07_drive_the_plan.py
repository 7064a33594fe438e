# %% [markdown]
# # 07 · Drive the plan
#
# - **You will be able to** drive a planned route in simulation, switch policies on the way, hold
#   the plan's promises against the deed, and report a success rate that you may believe
# - **Time** half an hour to read; about 2 minutes on two CPU cores, most of it one table
# - **Needs** notebook [06](06_fuse_and_plan.ipynb) for routes; uses the shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer trials in the
#   table at the end, the only long cell. It shows a bar and can be stopped
#
# A plan is a promise. In this notebook we keep it, or see it broken.

# %% [markdown]
# ## From map to route, in one call
#
# `plan_on_map` is notebooks 04 to 06 in one function; it keeps every stage, so nothing is hidden
# in it. Our ground is a corridor with all four obstacles across its whole width: there is no way
# round. If the planner refuses one, because some of it is strange to everybody, we take the next.

# %%
from fgtutor import load_zoo, make_terrain
from fgtutor.planning import plan_on_map

zoo = load_zoo("toy")
for seed in range(1, 40, 2):
    terrain = make_terrain("mixed", robot="toy", seed=seed)
    M, start, goal = terrain.elevation, terrain.start, terrain.goal
    planned = plan_on_map(M, zoo, start, goal)
    if planned.answer:  # a Route, or a Refusal, which is False
        break
    print(f"corridor {seed}: {planned.answer}")
planned.route

# %%
from fgtutor.figures.maps import draw_route

draw_route(planned.route, M)

# %% [markdown]
# ## Go
#
# `execute` puts the robot at the start and lets it follow. A **pure pursuit** follower steers for
# a point a little ahead on the route; the active policy is the one that the route has named, where
# the robot is, for three control steps in a row (**hysteresis**: `FollowConfig.hold_steps`).

# %%
from fgtutor import execute

episode = execute(planned.route, terrain, zoo)
episode

# %%
from fgtutor.course.route_pictures import draw_drive

draw_drive(episode, planned.route, M)

# %%
from fgtutor.figures.videos import film_strip

film_strip(episode, terrain, planned.route, count=12)

# %% [markdown]
# *What to see:* the colour of the robot is the policy in charge, and the bar at the bottom is who
# drove when. Watch how it holds its legs: each policy has a bearing of its own.
# `save_video(episode, terrain, planned.route, "drive.mp4")` makes a film of it.

# %% [markdown]
# ## Promise and deed
#
# For every step the plan promised a feasibility: the predicted mean $r_v$ over the next second.
# Now we know what came. Lay the two side by side along the way.

# %%
import numpy as np
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
nearest = np.linalg.norm(now - planned.route.xy[None, :-1], axis=-1).argmin(axis=1)
draw_curves(
    now[:, 0, 0],
    {"promised: F on the route": planned.route.feasibility[nearest],
     "delivered: mean r_v of the next second": delivered},
    title="Did the plan keep its word?",
    xlabel="x (m)",
    ylabel="feasibility, r_v",
)  # fmt: skip

# %% [markdown]
# *What to see:* the two need not lie on each other, since the promise was made for a robot that
# drives straight along one of eight headings at one speed. But where the promise dips, the deed
# should dip too. Where it does not, either the robot was lucky or the net is too shy.

# %% [markdown]
# ## The wrong driver
#
# How much of this is owed to choosing the right policy? Take the very same route, and let one
# specialist drive all of it.

# %%
from dataclasses import replace

from fgtutor.execution import FollowConfig, execute_batch

alone = {}
for i, name in enumerate(planned.names):
    policies = np.full_like(planned.route.policies, i)
    alone[name] = replace(planned.route, policies=policies)

# %%
patience = FollowConfig(patience=1.5)
count = len(alone)
attempts = execute_batch(
    list(alone.values()), [terrain] * count, zoo, seeds=[0] * count, config=patience,
    record_body=True,
)  # fmt: skip
dict(zip(alone, attempts, strict=True))

# %%
worst = min(range(count), key=lambda i: attempts[i].length)
draw_drive(attempts[worst], alone[planned.names[worst]], M)

# %%
film_strip(attempts[worst], terrain, alone[planned.names[worst]], count=4)

# %% [markdown]
# *What to see:* the end of the line. The route was the same; the driver was another. (If one of
# the specialists did make it all the way, it has more in it than its Feasibility-Net will
# promise.)

# %% [markdown]
# ## Once is never
#
# One drive proves that it *can* work. How often does it? Start a little differently each time,
# and let the robot be mistaken about where it is.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.figures.charts import draw_rates

trials = budget(fast=6, full=50, unit="drives for each error", each=0.3)
rates = {}
for drift in (0.0, 0.05, 0.15):
    lost = FollowConfig(position_noise=0.02, drift=drift, patience=1.5)
    drives = execute_batch(
        [planned.route] * trials, [terrain] * trials, zoo, seeds=range(trials), config=lost
    )
    rates[f"drift {drift:.2f} m per root second"] = (sum(d.success for d in drives), trials)

# %%
draw_rates(rates, title="How well must the robot know where it is?")

# %% [markdown]
# *What to see:* the black lines. With so few drives they are long, and any two of them that
# overlap have not shown a difference.

# %% [markdown]
# ## The table
#
# Finally the question of the paper's Table II, for the toy: each specialist plans and drives on
# its own; **ours** fuses all four; **general** is one policy that was trained on all terrains
# with as many samples as one specialist has had; and a classical occupancy grid plans, while our
# policy map says who drives. Terrain nobody has been trained on, the same for all.

# %%
from fgtutor.baselines import planners

everyone = load_zoo("toy", include_general=True)
contestants = [*zoo, "ours", "general", "occupancy+P"]
chosen = {name: planners(everyone)[name] for name in contestants}
kinds = ["steps", "gaps", "slopes", "rubble", "mixed"]
trials = budget(fast=2, full=20, unit="trials a cell, 35 cells", each=3.0)

# %%
from tqdm import tqdm

from fgtutor import make_terrain
from fgtutor.evaluation.trials import Ground, drive
from fgtutor.planning import PlanSettings

rows = []
for kind in tqdm(kinds):
    tiles = [make_terrain(kind, robot="toy", seed=2 * i + 1) for i in range(trials)]
    grounds = [Ground(terrain=tile, seeds=(i,)) for i, tile in enumerate(tiles)]
    rows += drive(grounds, chosen, everyone, settings=PlanSettings())

# %%
from fgtutor.figures.charts import draw_table


def crossed(kind, name):
    return sum(r.outcome == "reached" for r in rows if (r.terrain, r.policy) == (kind, name))


counts = np.array([[crossed(kind, name) for name in contestants] for kind in kinds])
draw_table(
    counts / trials,
    kinds,
    contestants,
    title="Who reaches the goal (column), on which terrain (row)?",
    caption=f"Successes of {trials}. The mixed terrain has all four obstacles in a row",
    texts=[[str(value) for value in row] for row in counts],
)

# %% [markdown]
# *What to see:* the diagonal of the first four columns, and then **ours** beside the best of the
# four in each row. How do the others fail?

# %%
from collections import Counter

for name in contestants:
    print(f"{name:12}", dict(Counter(row.outcome for row in rows if row.policy == name)))

# %% [markdown]
# `no_route` means: it refused. It knew that it does not know; that is what notebook 04 was for. A
# refusal is a failure in this table, and it is the cheapest one there is. (The occupancy grid
# refuses for another reason: to it, every obstacle is a wall.)
#
# **How sure may you be?** With this many trials, this sure:

# %%
from fgtutor.statistics import wilson_interval

for successes in (0, trials // 2, trials):
    low, high = wilson_interval(successes, trials)
    print(f"{successes} of {trials}: the true rate lies between {low:.0%} and {high:.0%}")

# %% [markdown]
# So a difference of one or two successes in the table means nothing yet. The tables in the README
# are made by `fgtutor evaluate matrix`, with many more trials.

# %% [markdown]
# ## Where you are
#
# You have the whole method in your hands: patches, joint training, distrust of the unknown,
# tensors, fusion, planning, driving. Nothing in it was about a toy. In the second half of the
# course the same functions drive a robot with four legs and twelve motors.
#
# ## What to try
#
# - `plan_on_map(..., switch_cost=0.0)`: does the flickering hurt when it is driven?
# - Set `FollowConfig(hold_steps=1)` or `15`. What does hysteresis buy, and what does it cost?
# - Plan with the paper's settings, `plan_on_map(..., settings=PAPER)`. Is the route another? Is
#   it driven more safely?
# - Let `roll` of notebook 02 drive a corridor that the plan refused. Was it right to refuse?
#
# **Exercises:** [exercises/ex07.ipynb](../exercises/ex07.ipynb). **Next:** a robot with legs,
# [08 Meet the A1](08_meet_the_a1.ipynb).
