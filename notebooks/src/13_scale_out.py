# %% [markdown]
# # 13 · Scale out
#
# - **You will be able to** add a policy without touching the others, say how many trials a claim
#   needs, and spread training and evaluation over cores, machines and a GPU without changing a
#   single number
# - **Time** 45 minutes to read and try; two minutes on two CPU cores
# - **Needs** notebooks [09](09_train_a_specialist.ipynb) and [11](11_mixed_terrain.ipynb); uses
#   the shipped specialists. No cluster and no GPU: what needs one is shown as a command
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer trials, smaller
#   batches
#
# So far everything ran on a laptop. This notebook shows what changes when you want more, and what
# must not change.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=13)

# %% [markdown]
# Symbols are those of the [notation page](../docs/notation.md), and numbers of equations and tables
# are the paper's.
#
# ## A newcomer
#
# A team of policies meets ground that none of them knows. Let us pretend that nobody has trained
# the valley specialist, and ask the other three.

# %%
import shutil
from pathlib import Path

from fgtutor import load_zoo, make_terrain  # loads the robots: some seconds, once
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


def ask(zoo):
    assessed = AssessedMap(M, zoo)
    return assessed, find_route(ours, assessed, *ends)


three, answer = ask(before)
print(answer)

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "Now the valley specialist joins. In how many cells and headings will F_max fall?",
    ["in none", "in a few, near the walls", "wherever a newcomer is worse than the others"],
)

# %% [markdown]
# *Adding a policy is copying a folder.* No other policy is retrained or even loaded differently.

# %%
shutil.copytree(ZOO / "a1" / "valley", team / "valley")
after = load_zoo("a1", team)
four, hired = ask(after)
print(list(after), hired, sep="\n")
assert hired and (not answer or hired.cost <= answer.cost)

# %%
from fgtutor.course.route_pictures import compare_routes

compare_routes(M, {"before": answer, "with the newcomer": hired})

# %% [markdown]
# *What to see:* on the left a refusal or a more expensive route; on the right the valley's own
# policy drives where it is the best. What about the other three? Their tensors have not changed by
# a single bit:

# %%
for name in before:
    assert (three.tensors()[name] == four.tensors()[name]).all()
print("unchanged:", *before)

# %%
from fgtutor import fuse
from fgtutor.figures.maps import draw_policy_map

alone, _ = fuse(list(three.tensors().values()))
fused, policy_map = fuse(list(four.tensors().values()))
draw_policy_map(policy_map, fused, M, tuple(after))

# %% [markdown]
# Eq. 6 says why this is safe. The maximum over $n + 1$ policies is
#
# $$
# \max_{i \le n+1} F_i = \max\Bigl(\max_{i \le n} F_i,\; F_{n+1}\Bigr) \;\ge\; \max_{i \le n} F_i .
# $$

# %%
assert not (fused < alone).any()
share = (fused > alone).float().mean()
print(f"F_max grew in {share:.0%} of all cells and headings, and fell in none")
reveal("in none")

# %% [markdown]
# A newcomer can still do harm, by **promising too much**. So it must pass two tests before it
# joins: calibration on its own ground (notebook 09), and a low $w_\text{ood}$ on everybody else's
# (notebook 04). For a real fifth specialist, for ramps of 25 degrees, say:
#
#     fgtutor train --robot a1 --terrain slopes --from runs/a1-gentle-seed1/specialist
#     cp -r runs/a1-slopes-seed1/specialist fgtutor/zoo/a1/slopes
#     fgtutor doctor
#     fgtutor evaluate calibration --robot a1
#     fgtutor evaluate newcomer --robot a1 --newcomer slopes
#
# `evaluate calibration` runs the two tests. `evaluate newcomer` measures success with the newcomer
# and without it, on its own ground and on the others', and compares the others' tensors.

# %% [markdown]
# ## How many trials?
#
# A success rate from $n$ trials with $k$ successes is an estimate. Wilson's 95 % interval says what
# the true rate may be, with $z = 1.96$:
#
# $$
# \frac{k + z^2/2}{n + z^2} \;\pm\; \frac{z}{n + z^2} \sqrt{\frac{k\,(n-k)}{n} + \frac{z^2}{4}} .
# $$

# %%
predict(
    "19 of 20 succeed: the interval is 23 points wide. How wide is it for 190 of 200?",
    ["12 points", "about 6 points", "2.4 points"],
)

# %%
import numpy as np

from fgtutor.figures.charts import draw_curves
from fgtutor.statistics import wilson_interval

trials = 20 * np.unique(np.logspace(0, 3, 40).astype(int))
ends_of = np.array([wilson_interval(19 * n // 20, n) for n in trials.tolist()])
draw_curves(
    trials, {"upper end": ends_of[:, 1], "lower end": ends_of[:, 0]}, log_x=True,
    title="What is still possible if 95 % succeed", xlabel="trials", ylabel="true success rate",
)  # fmt: skip

# %%
width = {n: np.ptp(wilson_interval(19 * n // 20, n)) for n in (20, 200, 2000, 20_000)}
assert 2 < width[20] / width[200] < 5 and 2.5 < width[2000] / width[20_000] < 4
print(", ".join(f"{n:,} trials: {100 * w:.1f} points" for n, w in width.items()))
reveal("about 6 points")

# %% [markdown]
# *What to see:* ten times as many trials make the interval about a third as wide: the square root
# in the formula. For large $n$ its half-width is about $h = z \sqrt{p\,(1-p)/n}$.
#
# **Your line.** How many trials give $h = 0.01$ at $p = 0.95$?

# %%
z, p, h = 1.96, 0.95, 0.01
needed = ...  # solve h = z * sqrt(p * (1 - p) / n) for n

if needed is ...:
    print("Not filled in yet. Square both sides first.")
else:
    assert abs(needed - z**2 * p * (1 - p) / h**2) < 1, f"got {needed}: square, then solve for n"
    print(f"Right: {needed:.0f} trials for one cell of a table.")

# %% [markdown]
# Trials cost time. So every evaluation here measures a little before it starts and says what the
# rest will take. A table for yourself (50 trials per cell), and one with the paper's 10,000:

# %%
from fgtutor.evaluation.cost import estimate
from fgtutor.evaluation.success import PAPER_GROUNDS, PAPER_TRIALS

kinds = ("steps", "gaps", "bridge", "valley", "mixed")
courses = [make_terrain(kind, robot="a1", seed=1) for kind in kinds]
planners = len(after) + 2  # ours and the generalist
for each in (50, PAPER_TRIALS):
    cost = estimate(after, courses, grounds=PAPER_GROUNDS, episodes=each * planners)
    for cores in (2, 64):
        print(cost.on(cores))

# %% [markdown]
# ## More cores, same numbers
#
# An evaluation is cut into **tasks**: a function, and plain arguments. The result of a task depends
# on its arguments only, not on which process did it, or when, or in which order. The machinery
# knows no robot, so let the toy show it, which is quicker.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.evaluation.shards import collect, settings_of
from fgtutor.evaluation.success import TrialsConfig, run_task
from fgtutor.evaluation.tasks import Task

count = budget(fast=6, full=24, unit="grounds", each=2.0)
small, policies = TrialsConfig(robot="toy", trials=count), ("slopes", "ours")
tasks = [
    Task(name=f"ground-{i}", function=run_task, arguments=(small, "slopes", policies, [i]))
    for i in range(count)
]

# %%
import time
from dataclasses import replace

results, seconds = {}, {}
for workers in (1, 2):
    began = time.perf_counter()
    config = replace(small, workers=workers)
    results[workers] = collect(tasks, settings_of(config, "lesson"), config, progress=True)
    seconds[workers] = time.perf_counter() - began
assert results[1].rows == results[2].rows, "how it was computed must not matter"
print(f"{len(results[1].rows)} rows, the same from one process and from two")

# %% [markdown]
# Is it faster, too? That depends. Each new process must load torch first. Measure both parts, and
# compute from them how long a job of $n$ tasks takes with $k$ processes:
# $t = t_\text{start} + \lceil n/k \rceil\, t_\text{task}$.

# %%
import subprocess
import sys

began = time.perf_counter()
subprocess.run([sys.executable, "-c", "import fgtutor.evaluation.success"], check=True)
start_up, each = time.perf_counter() - began, seconds[1] / count
print(f"to start a process: {start_up:.1f} s; one task: {each:.2f} s")


def wall_time(n, processes):
    return start_up * (processes > 1) + np.ceil(n / processes) * each


# %%
many = np.unique(np.logspace(0, 5, 60).astype(int))
draw_curves(
    many, {f"{k} at a time": wall_time(many, k) for k in (1, 2, 16, 64)}, log=True, log_x=True,
    title="When does a second process pay?", xlabel="tasks", ylabel="time (s), computed",
)  # fmt: skip

# %%
assert wall_time(1, 2) > wall_time(1, 1) and wall_time(10**5, 64) < wall_time(10**5, 1) / 10
pays = next(n for n in range(1, 10**6) if wall_time(n, 2) < wall_time(n, 1))
print(f"here two processes are faster from {pays} tasks on")

# %% [markdown]
# *What to see:* on the left, where the job is small, one process wins: the others are still
# loading. On the right the curves are parallel, and 64 processes are nearly 64 times as fast.
#
# ## Stop and go on
#
# Give a run a folder, and each task's rows are kept there as soon as it is finished. If you stop it
# or the power fails, the same command goes on. Here only the first task was done before:

# %%
kept = replace(small, workers=1, out=Path("kept"))
settings = settings_of(kept, "lesson")
collect(tasks[:1], settings, kept)
began = time.perf_counter()
whole = collect(tasks, settings, kept)
assert whole.rows == results[1].rows
print(f"{len(tasks) - 1} of {len(tasks)} tasks were left; the same rows again")

# %%
from fgtutor.figures.charts import draw_rates
from fgtutor.statistics import Share

by_policy = {
    name: Share.of(row["outcome"] == "reached" for row in whole.rows if row["policy"] == name)
    for name in policies
}
draw_rates({name: (s.successes, s.trials) for name, s in by_policy.items()},
           title="The same rows, however they were computed")  # fmt: skip

# %% [markdown]
# *What to see:* the black lines first. With so few trials they are long, and say nothing about
# which of the two is better.
#
# The same works on a **Ray cluster**, of which this package needs only the address (in a clone of
# this project `pip install -c constraints.txt -e ".[cluster]"`, then `ray start --head` on one
# machine, and on the others `ray start --address HOST:PORT`):
#
#     fgtutor evaluate matrix --robot a1 --protocol paper --ray HOST:PORT --out report
#
# If a worker is lost, its task is done again, and that is all. *Training* spreads in the same way.
# A sweep trains a specialist for every terrain and seed. Each is a task that goes on from its last
# checkpoint if its worker is lost:
#
#     fgtutor sweep --robot a1 --terrains steps valley --seeds 1 2 3 --ray HOST:PORT --out sweep

# %% [markdown]
# ## More robots at once
#
# Inside one process there is a cheaper way to do more: simulate many robots side by side.

# %%
predict(
    "One robot does a few hundred control steps per second. How many do 256 do together?",
    ["the same", "10 to 100 times as many", "256 times as many"],
)

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
    list(rates), {"measured": list(rates.values())}, log=True, log_x=True,
    title="What a batch buys", xlabel="robots", ylabel="control steps per second, together",
)  # fmt: skip

# %%
gain = rates[256] / rates[1]
assert 2 < gain < 256
reveal(f"{gain:.0f} times as many: {rates[1]:,.0f} and {rates[256]:,.0f} steps per second.")

# %% [markdown]
# *What to see:* on the left the curve is steep. One robot leaves the physics idle most of the time:
# Python is the work, and it is the same for any batch. On the right the curve flattens: from there
# on physics is the work. A training should have at least as many robots as there is a bend; with
# many more you only wait longer between two points of its curve.
#
# **More cores** move the bend: MuJoCo steps robots on all threads it is given
# (`A1Env(..., threads=16)`), and the results are the same bit for bit. A **GPU** helps the networks
# first:
#
#     fgtutor train --robot a1 --terrain steps --num-envs 4096 --threads 16 --device cuda:0
#
# Physics is one small class, `fgtutor.robots.a1.physics.Physics`. A class with the same members on
# top of a GPU simulator can replace it; observations, rewards, planning and driving stay as they
# are. Several GPUs train one policy through rsl_rl's own `torchrun` path: the gradients of the
# Feasibility-Net are averaged just like the policy's.

# %% [markdown]
# ## What you now know
#
# - A newcomer is a folder. The maximum of Eq. 6 can only grow, so a newcomer costs the others
#   nothing. It harms only by promising too much.
# - Ten times the trials give a third of the interval. Know the cost before you start.
# - A task that depends on its arguments only can run anywhere, in any order, and again.
# - More processes pay for large jobs, more robots per process nearly always.
#
# And in the whole course: maps and patches (01); a policy and a net that watches it (02, 03);
# distrust of unfamiliar ground (04); tensors, fusion, and a plan that explains itself (05, 06);
# driving it (07); the same code for a legged robot (08 to 11); a map from a scan, and a position
# that is a little wrong (12).
#
# **Test yourself**
#
# <details><summary>1. A newcomer promises 0.99 everywhere, and its $w_\text{ood}$ is 1 everywhere.
# What does the plan do?</summary>
#
# It sends the newcomer everywhere, straight to the goal. The maximum trusts whoever promises most.
# </details>
#
# <details><summary>2. You have 200 trials and two planners that reach 95 % and 97 %. May you say
# that the second is better?</summary>
#
# No. Each interval is about 6 points wide, so the two overlap. Drive both on the same grounds and
# compare trial by trial, or drive more.
# </details>
#
# <details><summary>3. Why must a task draw its random numbers from its own arguments, not from a
# generator that all tasks share?</summary>
#
# With a shared generator, what a task draws depends on which tasks ran before it. Then the order,
# and so the number of workers, would change the results.
# </details>
#
# ## What to try
#
# - Hire a policy that promises too much: load a copy of a specialist, do
#   `copy.feasibility.head[-1].bias.data += 4`, add it to the team and drive the plan. Which of the
#   two tests would have caught it?
#   <details><summary>Answer</summary>Calibration on its own ground: it promises nearly 1 and earns
#   what it earned before. Its w_ood has not changed, so the other test sees nothing.</details>
# - `taus`, `f_min`, `switch_cost`, `hold_steps`: somebody chose these four numbers. Write a `Task`
#   that tries others on all your cores. On which grounds do you then test?
#   <details><summary>Answer</summary>On grounds that were not used to choose them. The best of many
#   settings looks better on its own grounds than it is.</details>
# - A third robot is one file and one line: the recipe is in CONTRIBUTING.md.
#
# **Exercises:** the capstone, [exercises/ex13.ipynb](../exercises/ex13.ipynb): train a net or a
# specialist of your own, and let it face maps that you have not seen.
#
# **What to read now.** The paper again, [arXiv:2602.07932](https://arxiv.org/abs/2602.07932): which
# of its sentences do you read differently? Then, from the [references](../docs/notation.md):
#
# - *Learning to Walk in Minutes* (Rudin et al.) for training with thousands of robots,
# - *DreamWaQ* (Nahrendra et al.) for policies that feel the ground instead of seeing it,
# - *Do Deep Generative Models Know What They Don't Know?* (Nalisnick et al.) for what can go wrong
#   with $w_\text{ood}$,
# - *Probabilistic Terrain Mapping* (Fankhauser et al.) for maps from a robot that drifts.
#
# What you have *not* seen is a real robot. The map will be worse, the ground will give way, and
# somebody will have to carry the robot home. Begin with a soft floor.
#
# Thank you for walking along. Back to the beginning:
# [01_elevation_maps.ipynb](01_elevation_maps.ipynb).
