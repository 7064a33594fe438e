# %% [markdown]
# # 13 · Scale out
#
# - **You will be able to** add a policy without touching the others, say how many trials a claim
#   needs, and spread training and evaluation over cores, machines and a GPU without changing a
#   single number
# - **Time** half an hour to read; about a minute on two CPU cores
# - **Needs** notebooks [09](09_train_a_specialist.ipynb) and [11](11_mixed_terrain.ipynb); uses
#   the shipped specialists. No cluster and no GPU: what needs one is shown as a command
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer trials, smaller
#   batches
#
# Everything so far fitted into a laptop. Here is what changes when you want more of it, and what
# must not change.

# %% [markdown]
# ## A newcomer
#
# A team meets ground that none of them knows. Let us pretend that the valley specialist has never
# been trained, and ask the other three.

# %%
import shutil
from pathlib import Path

from fgtutor import load_zoo, make_terrain
from fgtutor.specialist import ZOO

team = Path("team")  # a zoo of our own: a folder of folders
for name in ("steps", "gaps", "bridge"):
    shutil.copytree(ZOO / "a1" / name, team / name, dirs_exist_ok=True)
shutil.rmtree(team / "valley", ignore_errors=True)  # if you run this cell again
before = load_zoo("a1", team)
list(before)

# %%
from fgtutor.baselines import AssessedMap, find_route, ours

terrain = make_terrain("valley", robot="a1", seed=1)
M, ends = terrain.elevation, (terrain.start, terrain.goal)


# %%
def ask(zoo):
    assessed = AssessedMap(M, zoo)
    return assessed, find_route(ours, assessed, *ends)


# %%
three, answer = ask(before)
print(answer)

# %% [markdown]
# Now hire. *Adding a policy is copying a folder.* Nobody is retrained, nobody is asked.

# %%
shutil.copytree(ZOO / "a1" / "valley", team / "valley")
after = load_zoo("a1", team)
four, hired = ask(after)
print(list(after), hired, sep="\n")

# %%
from fgtutor.course.route_pictures import compare_routes

compare_routes(M, {"before": answer, "with the newcomer": hired})

# %% [markdown]
# *What to see:* before, either a refusal or a route by those who could; after, whoever does it
# best. And the others? They have not been touched, to the last bit:

# %%
for name in before:
    same = bool((three.tensors()[name] == four.tensors()[name]).all())
    print(f"{name:7} thinks of this map what it thought before: {same}")

# %%
from fgtutor import fuse
from fgtutor.figures.maps import draw_policy_map

fused, policy_map = fuse(list(four.tensors().values()))
draw_policy_map(policy_map, fused, M, tuple(after))

# %% [markdown]
# With the maximum, a newcomer can only ever raise $\hat F_\text{max}$. Check it, everywhere at
# once:

# %%
alone, _ = fuse(list(three.tensors().values()))
print("somewhere worse than before:", bool((fused < alone).any()))
print(f"better in {(fused > alone).float().mean():.0%} of all cells and headings")

# %% [markdown]
# A newcomer can still do harm: by *promising too much*. That is why it must pass two tests before
# it is let in, calibration on its own ground (notebook 09) and distrust on everybody else's
# (notebook 04). To train a real fifth one, for ramps of 25 degrees, say:
#
#     fgtutor train --robot a1 --terrain slopes --from runs/a1-gentle-seed1/specialist
#     cp -r runs/a1-slopes-seed1/specialist fgtutor/zoo/a1/slopes
#     fgtutor doctor
#     fgtutor evaluate calibration --robot a1
#     fgtutor evaluate newcomer --robot a1 --newcomer slopes
#
# The last line but one is the two tests; the last one measures success on its own ground and on the
# others', without and with it, and whether the others' tensors stayed the same.

# %% [markdown]
# ## How many trials?
#
# A claim costs trials. Here is the width of the 95 % interval when nineteen of twenty succeed, for
# more and more of them.

# %%
import numpy as np

from fgtutor.figures.charts import draw_curves
from fgtutor.statistics import wilson_interval

trials = 20 * np.unique(np.logspace(0, 3, 40).astype(int))
ends_of = np.array([wilson_interval(19 * n // 20, n) for n in trials.tolist()])
draw_curves(
    np.log10(trials), {"upper end": ends_of[:, 1], "lower end": ends_of[:, 0]},
    title="What is still possible after so many trials",
    xlabel="trials, as a power of ten", ylabel="true success rate",
)  # fmt: skip

# %% [markdown]
# *What to see:* ten times as many trials make the interval about a third as wide. Between a table
# for yourself and one for a paper lie not minutes, but days. So before it starts, every evaluation
# here measures a little and says what the rest will take:

# %%
from fgtutor.evaluation.cost import estimate
from fgtutor.evaluation.success import PAPER_GROUNDS, PAPER_TRIALS

kinds = ("steps", "gaps", "bridge", "valley", "mixed")
courses = [make_terrain(kind, robot="a1", seed=1) for kind in kinds]
planners = len(after) + 2  # ours and the generalist
cost = estimate(after, courses, grounds=PAPER_GROUNDS, episodes=PAPER_TRIALS * planners)
for cores in (1, 2, 64):
    print(cost.on(cores))

# %% [markdown]
# ## More cores, same numbers
#
# An evaluation is cut into **tasks**: a function, and plain arguments. What a task gives depends on
# its arguments only, not on who did it, when, or beside whom. The machinery knows no robot, so let
# the toy show it, which is quicker.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.evaluation.shards import collect, settings_of
from fgtutor.evaluation.success import TrialsConfig, run_task
from fgtutor.evaluation.tasks import Task

count = budget(fast=2, full=24, unit="grounds", each=2.0)
small, who = TrialsConfig(robot="toy", trials=count), ("slopes", "ours")
tasks = [
    Task(name=f"ground-{i}", function=run_task, arguments=(small, "slopes", who, [i]))
    for i in range(count)
]

# %%
import time
from dataclasses import replace

results = {}
for workers in (1, 2):
    began = time.perf_counter()
    config = replace(small, workers=workers)
    results[workers] = collect(tasks, settings_of(config, "lesson"), config, progress=True)
    print(f"{workers} at a time: {time.perf_counter() - began:.0f} s")
print("the same rows:", results[1].rows == results[2].rows)

# %% [markdown]
# *What to see:* the last line. The first two are a matter of your machine: each new process first
# has to load torch, which for so short a job is most of the work. For an hour of it, it is
# nothing.
#
# ## Stopped, and gone on
#
# Give a run a folder, and each task's rows are kept there as soon as it is finished. Stop it, pull
# the plug: the same command goes on. Here the first task is all that was done before:

# %%
kept = replace(small, workers=1, out=Path("kept"))
settings = settings_of(kept, "lesson")
collect(tasks[:1], settings, kept)
began = time.perf_counter()
whole = collect(tasks, settings, kept)
print(f"gone on in {time.perf_counter() - began:.2f} s, {len(tasks) - 1} of {len(tasks)} tasks")
print("the same rows again:", whole.rows == results[1].rows)

# %%
from fgtutor.figures.charts import draw_rates
from fgtutor.statistics import Share

by_policy = {
    name: Share.of(row["outcome"] == "reached" for row in whole.rows if row["policy"] == name)
    for name in who
}
draw_rates({name: (s.successes, s.trials) for name, s in by_policy.items()},
           title="However it was done, this is what came out")  # fmt: skip

# %% [markdown]
# The same on a **Ray cluster**, of which this package needs to know nothing but the address (in a
# clone of this project `pip install -c constraints.txt -e ".[cluster]"`, then `ray start --head` on
# one machine, and on the others `ray start --address HOST:PORT`):
#
#     fgtutor evaluate matrix --robot a1 --protocol paper --ray HOST:PORT --out report
#
# A worker that vanishes costs its task one more try, and nothing else. *Training* spreads in the
# same way: a sweep trains a specialist for every terrain and seed, each of them a task that goes on
# from its checkpoint if its worker is lost, and compares what came out:
#
#     fgtutor sweep --robot a1 --terrains steps valley --seeds 1 2 3 --ray HOST:PORT --out sweep

# %% [markdown]
# ## More robots at once
#
# *Within* a process there is another way to do more, and it is nearly free: simulate robots side by
# side. Measure it here, on your machine: control steps a second, for batches of growing size.

# %%
import torch

from fgtutor.robots.a1.env import A1Env
from fgtutor.world.terrain import World

largest = budget(fast=8, full=10, unit="doublings of the batch", each=1.5)
world, rates = World([[make_terrain("steps", robot="a1", seed=1)]]), {}
for size in (2**k for k in range(largest + 1)):
    env = A1Env(world, size, seed=0)
    actions, began = torch.zeros(size, 12), time.perf_counter()
    for _ in range(20):
        env.step(actions)
    rates[size] = 20 * size / (time.perf_counter() - began)

# %%
draw_curves(
    np.log2(list(rates)), {"control steps a second": list(rates.values())}, log=True,
    title="What a batch buys", xlabel="robots, as a power of two", ylabel="control steps a second",
)  # fmt: skip

# %% [markdown]
# *What to see:* at first twice the robots are nearly twice the steps: one robot alone leaves the
# physics idle most of the time, waiting for Python. Look where it flattens: from there on physics
# is the work. A training should have that many robots at least; with many more you only wait longer
# between two looks at its curve.
#
# What then? **More cores** move the bend: MuJoCo steps robots on all threads it is given
# (`A1Env(..., threads=16)`), and the results are the same bit for bit. A **GPU** helps the networks
# first:
#
#     fgtutor train --robot a1 --terrain steps --num-envs 4096 --threads 16 --device cuda:0
#
# Physics itself sits behind one small class, `fgtutor.robots.a1.physics.Physics`. Whoever writes
# the same members over a GPU simulator replaces it, and no line of observations, rewards, planning
# or driving will notice. And several GPUs train one policy through rsl_rl's own `torchrun` path:
# the Feasibility-Net's gradients are averaged just as the policy's are.

# %% [markdown]
# ## Where you are
#
# You have seen all of it: maps and patches; a policy and a net that watches it; distrust of what
# was never seen; tensors, fusion, a plan that explains itself; two robots, one seam; a scan, a
# walk, and an honest table. What you have *not* seen is a real robot. The map will be worse, the
# ground will give way, and somebody will have to carry it home. Begin with a soft floor.
#
# ## What to try
#
# - Hire a policy that promises too much: set `net.head[-1].bias += 4` on a copy of a specialist's
#   Feasibility-Net, add it to the team, and drive the plan. Which of the two tests would have
#   caught it?
# - `taus`, `f_min`, `switch_cost`, `hold_steps`: four numbers that somebody chose. Write a `Task`
#   that tries them, and let all your cores find better ones. On which grounds do you then test?
# - A third robot is one file and one line: the recipe is in CONTRIBUTING.md.
# - Read the paper again. Which of its sentences do you now read differently?
#
# Thank you for walking along. Back to the beginning:
# [01_elevation_maps.ipynb](01_elevation_maps.ipynb).
