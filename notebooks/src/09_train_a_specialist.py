# %% [markdown]
# # 09 · Train a specialist
#
# - **You will be able to** read a training curve, stop a training and go on with it, say how a
#   curriculum, an advantage and an adaptive learning rate work, and judge what has come out
# - **Time** half an hour to read; about 4 minutes on two CPU cores, most of it two trainings
# - **Needs** notebooks [02](02_a_robot_that_falls.ipynb) and [03](03_feasibility_net.ipynb) for
#   PPO and labels, and [08](08_meet_the_a1.ipynb); uses the shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: then it trains for
#   seconds, to show the machinery, and learns next to nothing. The stop button is always safe:
#   a training that is run again goes on where it was
#
# The specialists that ship with this course were trained on a machine with two cores. This
# notebook takes their recipe apart, lets you run a small piece of it, and shows the rest from the
# records that every specialist carries with it.

# %% [markdown]
# ## Where the shipped ones come from
#
# A specialist's folder holds its weights and its **provenance**: settings, seed, versions, and the
# curve of its last stage. The shipped ones have had two to four stages; in the last one even the
# easiest ground is hard (`docs/a1.md` tells all of it).

# %%
from fgtutor import load_zoo
from fgtutor.figures.charts import training_curve

steps = load_zoo("a1")["steps"]
record = steps.provenance

# %%
print(f"{record['samples']:,} samples in all, those of what it started from included")
print(f"{record['seconds'] / 60:.0f} minutes for the last stage, seed {record['seed']}")
training_curve(record["curve"])

# %% [markdown]
# *What to see:* three stories told by the same samples. At the top, how well the robots track;
# in the middle, how hard their ground is by then; at the bottom, how well the Feasibility-Net can
# tell in advance. When the ground gets harder the upper curve may well fall: read the first two
# together or not at all.

# %% [markdown]
# ## Nobody learns on a cliff
#
# The training world has **rows** of growing difficulty. Here it is from above, small:

# %%
from pathlib import Path

from fgtutor.course.notebooks import budget
from fgtutor.learning.config import A1TrainConfig
from fgtutor.specialist import ZOO

walker = ZOO / "a1" / "_walker"
robots = budget(fast=48, full=256, unit="robots")
iterations = budget(fast=4, full=60, unit="iterations of 40 steps", each=2.0)
config = A1TrainConfig(
    terrain="steps", rows=5, columns=2, num_envs=robots, iterations=iterations,
    start_from=walker, critic_warmup=2, save_every=20,
    actor="perceptive", disturbances="usual", turned=0.0,  # as the walker learned
    out=Path("runs") / f"09-steps-{robots}-{iterations}",
)  # fmt: skip

# %%
from fgtutor.figures.maps import draw_elevation
from fgtutor.learning.config import training_world

draw_elevation(training_world(config).elevation)

# %% [markdown]
# *What to see:* the lowest row is nearly flat, the highest has the paper's full steps. Each robot
# starts at the bottom. After an episode it moves **up** a row if it tracked well, **down** if it
# did badly, and else it stays. So every robot works where it is neither bored nor lost, and nobody
# has to write a timetable.

# %%
from fgtutor.robots.a1.env import A1_EPISODES

print(f"up a row:   mean r_v above {A1_EPISODES.promote_above}, and no fall")
print(f"down a row: mean r_v below {A1_EPISODES.demote_below}, or a fall in the tile's first half")
print(f"a new episode after {A1_EPISODES.episode_seconds:.0f} s, a fall,")
print(f"or {A1_EPISODES.stuck_seconds} s without moving {100 * A1_EPISODES.stuck_progress:.0f} cm")

# %% [markdown]
# The last line matters: a robot that has learned to stop before each step never falls. *Waiting
# must not pay.*

# %% [markdown]
# ## Was that action better than expected?
#
# PPO makes actions more likely that turned out *better than expected*. Expected by whom? By the
# **critic**, a second network that predicts the reward still to come, $V$. The **surprise** of one
# step is $\delta_t = r_t + \gamma V_{t+1} - V_t$. Take a robot that walks as expected, stumbles a
# little at one step, and falls half a second later:

# %%
import numpy as np

T, stumble, gamma, lam = 40, 15, config.gamma, 0.95
rewards = np.where(np.arange(T) < T - 1, 1.0, 0.0)
values = np.full(T + 1, 1 / (1 - gamma))  # a walk for ever, as far as the critic knows
values[stumble + 1 :] *= 0.7  # after the stumble it fears something
values[T] = 0.0  # fallen: nothing more to come
surprise = rewards + gamma * values[1:] - values[:-1]

# %% [markdown]
# The fall is the fault of the stumble, not of the last step. So an action also answers for later
# surprises, each a factor $\gamma\lambda$ fainter: that sum is its **advantage**.

# %%
from fgtutor.figures.charts import draw_curves


def answer_for(lam):
    fade = (gamma * lam) ** np.arange(T)
    return [fade[: T - t] @ surprise[t:] for t in range(T)]


# %%
draw_curves(
    np.arange(T),
    {"surprise alone (λ = 0)": answer_for(0.0), f"advantage (λ = {lam})": answer_for(lam)},
    title="Who is to blame?", xlabel="control step", ylabel="better or worse than expected",
)  # fmt: skip

# %% [markdown]
# *What to see:* surprise alone blames two steps. The advantage blames all that led there, most of
# all the last ones. The larger $\lambda$, the further back the blame goes, and the noisier it is.

# %% [markdown]
# ## Train, stop, go on
#
# A specialist does not begin at zero: it takes over the **walker**, a policy that has learned to
# walk on nearly level ground. Only its Feasibility-Net and its critic are new, so in the first
# iterations the policy is left alone until the critic has understood what it judges.
#
# Half-way a signal arrives, just as when you press the stop button.

# %%
import signal
from dataclasses import replace

from fgtutor import train
from fgtutor.course.widgets.live_curve import LiveCurve

live = LiveCurve()


def impatient(row):
    live(row)
    if row["iteration"] == iterations // 2:
        signal.raise_signal(signal.SIGINT)  # "stop", as the button says it


# %%
started = (config.out / "checkpoint.pt").exists()
half = train(replace(config, resume=started), on_iteration=impatient)
live.draw(half.provenance["curve"])

# %%
print(f"stopped: {half.provenance['samples']:,} samples so far, the walker's included")

# %% [markdown]
# Nothing was lost: a checkpoint holds the networks, their optimisers, the curriculum and the
# dice. `resume=True` goes on, bit for bit as if nobody had interrupted (a test of this package
# says so).

# %%
again = LiveCurve()
mine = train(replace(config, resume=True), on_iteration=again)
again.draw(mine.provenance["curve"])

# %% [markdown]
# *What to see:* $r_v$ is high from the first iteration on. That is the walker's doing, not yours.
#
# ## What the walker is worth
#
# The same once more, but from nothing. Here we turn the crank ourselves, to see one thing more
# that a log shows.

# %%
from fgtutor.learning.training import Trainer

crank = budget(fast=4, full=25, unit="iterations", each=2.0)
scratch = Trainer(replace(config, start_from=None, out=Path("runs") / "09-from-nothing"))

# %%
from tqdm import tqdm

rows, rates = [], []
for _ in tqdm(range(crank)):
    rows.append(scratch.iterate())
    rates.append(scratch.algorithm.learning_rate)

# %%
walker_rows = mine.provenance["curve"][:crank]
together = min(len(walker_rows), len(rows))
draw_curves(
    range(1, together + 1),
    {"from the walker": [row["r_v"] for row in walker_rows[:together]],
     "from nothing": [row["r_v"] for row in rows[:together]]},
    title="The same robots, the same ground", xlabel="iteration", ylabel="r_v",
)  # fmt: skip

# %% [markdown]
# *What to see:* the distance between the curves is what walking is worth. Specialists start from a
# walker (that of the gaps from the steps specialist), and learn only what is different about
# *their* ground.
#
# ## How long may a step be?
#
# PPO must not change the policy by much at a time. rsl_rl measures how far it went, by the
# **KL divergence** between old and new policy. If that is more than twice what is wanted, it
# divides the learning rate by 1.5; if it is less than half, it multiplies it by 1.5.

# %%
draw_curves(
    range(1, len(rates) + 1), {"learning rate": rates}, log=True,
    title="The learning rate sets itself", xlabel="iteration", ylabel="learning rate",
)  # fmt: skip

# %% [markdown]
# *What to see:* it moves up and down, and is no sign of trouble. One that sinks to its floor and
# stays is: then every step that the policy takes is too far.

# %% [markdown]
# ## The exam
#
# Curves are homework; this is the exam. Steps of nearly three quarters of the full height that
# nobody has been trained on, straight across, the same for the three drivers.

# %%
from fgtutor import load_specialist, make_terrain

count = budget(fast=4, full=20, unit="grounds for each of three drivers", each=2.0)
exam = [make_terrain("steps", robot="a1", difficulty=0.65, seed=2 * i + 1) for i in range(count)]
drivers = {"walker": load_specialist(walker), "mine": mine, "steps": steps}

# %%
from fgtutor.course.drives import drive_together, straight_route
from fgtutor.execution import FollowConfig

jobs = [(straight_route(ground, name), ground, i) for name in drivers
        for i, ground in enumerate(exam)]  # fmt: skip
walks = drive_together(jobs, drivers, config=FollowConfig(patience=1.2, grace=3.0))

# %%
from fgtutor.figures.charts import draw_rates

passed = {
    name: (sum(walk.success for walk in walks[i * count : (i + 1) * count]), count)
    for i, name in enumerate(drivers)
}
draw_rates(passed, title="Who crosses steps it has never seen?")

# %% [markdown]
# *What to see:* first the black lines, then the bars. In fast mode `mine` is the walker with a few
# seconds of practice, so the two should not differ; `steps` has practised for as long as its
# provenance says.

# %% [markdown]
# ## Does it know what it can do?
#
# The Feasibility-Net has learned all along, from the same samples. Its exam is that of notebook 03:
# a rollout on held-out ground, labels, and a plot of promise against deed.

# %%
from fgtutor.evaluation.calibration import CalibrationConfig, drive, promised
from fgtutor.figures.charts import calibration_plot
from fgtutor.statistics import calibration

envs = budget(fast=16, full=80, unit="robots, 5 s each", each=0.5)
exam = drive(steps, "steps", CalibrationConfig(robot="a1", envs=envs, seconds=5.0))
calibration_plot(*calibration(*promised(steps, exam)))

# %% [markdown]
# *What to see:* do the points lie near the diagonal where many patches are (the bars below)? That
# is where planning reads the net. A policy may be poor and its net still honest: that is the
# subject of the next notebook.

# %% [markdown]
# ## What to try
#
# - Train in earnest, from a shell: `fgtutor train --robot a1 --terrain gentle`, then
#   `fgtutor train --robot a1 --terrain steps --from runs/a1-gentle-seed1/specialist --hours 1`, and
#   again with `--resume` as often as you have an hour.
# - `critic_warmup=0`: what happens to $r_v$ in the first iterations, and why?
# - `rows=1` puts every robot on the hardest ground at once. Compare the curves.
# - `actor="dreamwaq"` trains the paper's blind policy, which has to imagine the ground. What can
#   it not know before its feet do?
#
# **Exercises:** [exercises/ex09.ipynb](../exercises/ex09.ipynb). **Next:** what a better policy
# does to a plan, [10_planning_adapts.ipynb](10_planning_adapts.ipynb).
