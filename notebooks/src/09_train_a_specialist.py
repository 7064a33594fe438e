# %% [markdown]
# # 09 · Train a specialist
#
# - **You will be able to** read a training curve, stop a training and go on with it, say how a
#   curriculum, an advantage, PPO's clip and an adaptive learning rate work, and judge the result
# - **Time** 45 minutes to read and try; about 6 minutes on two CPU cores, most of it two trainings
# - **Needs** notebooks [02](02_a_robot_that_falls.ipynb) and [03](03_feasibility_net.ipynb) for
#   PPO and labels, and [08](08_meet_the_a1.ipynb); uses the shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: then it trains for
#   seconds, to show the machinery, and learns next to nothing. The stop button is always safe:
#   a training that is run again goes on where it was
#
# The specialists of this course were trained on a machine with two cores. This notebook takes their
# recipe apart and lets you run a small piece of it. The rest is shown from the records that every
# specialist carries with it. In the paper, training is Sec. III-A (Fig. 2) and the start of Sec.
# IV.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=9)

# %% [markdown]
# Symbols are those of the [notation page](../docs/notation.md); longer arguments are among the
# [derivations](../docs/derivations.md).
#
# ## Where the shipped ones come from
#
# A specialist's folder holds its weights and its **provenance**: settings, seed, versions, and the
# curve of its last stage of training. [docs/a1.md](../docs/a1.md) tells of all stages.

# %%
from fgtutor import load_zoo  # loads the robots: some seconds, once
from fgtutor.figures.charts import training_curve

steps = load_zoo("a1")["steps"]
record = steps.provenance
curve = record["curve"]
print(f"{record['samples']:,} samples in all, those of what it started from included")
print(f"{record['seconds'] / 60:.0f} minutes for the last stage, seed {record['seed']}")

# %%
training_curve(curve)

# %%
assert curve[-1]["row"] > curve[0]["row"], "the ground should get harder"
change = {key: curve[-1][key] - curve[0][key] for key in ("row", "r_v")}
print(f"from the first point to the last: row {change['row']:+.1f}, r_v {change['r_v']:+.2f}")

# %% [markdown]
# *What to see:* three stories about the same samples. Above: how well the robots track their
# command ($r_v$, Eq. 1). In the middle: how hard their ground is by then. Below: how well the
# Feasibility-Net can tell (Eqs. 2 and 3). Read the first two together: while the ground gets
# harder, $r_v$ may stand still although the policy improves.

# %% [markdown]
# ## Nobody learns on a cliff
#
# The training world has **rows** of growing difficulty. The same seed at a higher difficulty is the
# same place, only harder. Here is one place from the first, the middle and the last row, cut
# lengthwise:

# %%
from fgtutor.figures.charts import draw_curves
from fgtutor.learning.config import training_tile

tiles = {d: training_tile("steps", robot="a1", difficulty=d, seed=4) for d in (0.1, 0.55, 1.0)}
profiles = {
    f"difficulty {d}": tile.elevation.heights[:, tile.elevation.shape[1] // 2]
    for d, tile in tiles.items()
}
x = tiles[1.0].elevation.centres[0]
draw_curves(x, profiles, title="One place in three rows", xlabel="x (m)", ylabel="height (m)")

# %% [markdown]
# Six in ten places of the training world get **neighbours**: a different obstacle at either end,
# one landing away. A crossing ends before it reaches them. They are there to be seen: on mixed
# terrain a patch shows the next obstacle while the robot is still on this one.

# %%
from fgtutor.figures.maps import draw_elevation

crowded = training_tile("steps", robot="a1", difficulty=1.0, seed=4, neighbours=True)
print("along x:", ", ".join(part.name for part in crowded.sections))
draw_elevation(crowded.elevation, title="Steps, with a neighbour at either end")

# %%
from fgtutor.course.ask import predict, reveal
from fgtutor.robots.a1.env import A1_EPISODES

rule = A1_EPISODES
print(f"up a row:   mean r_v above {rule.promote_above}, and no fall")
print(f"down a row: mean r_v below {rule.demote_below}, or a fall in the tile's first half")
predict("A robot walks with a mean r_v of 0.3 and does not fall.", ["up", "down", "it stays"])

# %%
assert rule.demote_below < 0.3 < rule.promote_above
reveal("it stays")

# %% [markdown]
# So every robot finds the row where it is neither bored nor lost. And when does an episode end?

# %%
print(f"after {rule.episode_seconds:.0f} s, at a fall,")
print(f"or after {rule.stuck_seconds} s without moving {100 * rule.stuck_progress:.0f} cm")

# %% [markdown]
# The last line matters. Without it, a robot that stops before each step would never fall and would
# keep its row. *Waiting must not pay.*

# %% [markdown]
# ## Was that action better than expected?
#
# PPO makes those actions likelier that turned out *better than expected*. The expectation comes
# from the **critic**, a second network: $V(o)$ is the discounted reward that it expects from $o$
# on. The **surprise** of step $t$ is
#
# $$ \delta_t = r_t + \gamma\, V(o_{t+1}) - V(o_t). $$
#
# Take a robot that walks as expected, stumbles a little at one step, and falls half a second later:

# %%
import numpy as np

T, stumble, gamma, lam = 40, 15, 0.99, 0.95
rewards = np.where(np.arange(T) < T - 1, 1.0, 0.0)
values = np.full(T + 1, 1 / (1 - gamma))  # a walk for ever, as far as the critic knows
values[stumble + 1 :] *= 0.7  # after the stumble it expects less
values[T] = 0.0  # fallen: nothing more to come
surprise = rewards + gamma * values[1:] - values[:-1]
print("bad surprises at steps", *np.flatnonzero(surprise < -1e-9))

# %% [markdown]
# The fall is the fault of the stumble, not of the last step. So an action also answers for later
# surprises, each a factor $\gamma\lambda$ fainter than the one before. That sum is its
# **advantage** (generalised advantage estimation, Schulman et al., 2016):
#
# $$ A_t = \sum_{l \ge 0} (\gamma\lambda)^l\, \delta_{t+l}. $$
#
# **Your line.** How much of a surprise ten steps later counts?

# %%
share = ...  # a formula of gamma and lam

if share is ...:
    print("Not filled in yet. Look at the factor in the sum, for l = 10.")
else:
    assert abs(share - 0.9405**10) < 1e-9, f"got {share}: one factor for each step"
    print(f"Right: {share:.0%}.")

# %% [markdown]
# **Slide** $\lambda$ from 0 to 1. Who is to blame for the fall?

# %%
from fgtutor.course.widgets.slides import AdvantageSlides

AdvantageSlides(rewards, values, gamma=gamma, lam=lam)

# %%
advantage = [((gamma * lam) ** np.arange(T - t)) @ surprise[t:] for t in range(T)]
assert (surprise < -1e-9).sum() == 2  # the stumble and the last step
assert max(advantage[: stumble + 1]) < 0  # with lambda, all that led there

# %% [markdown]
# *What to see:* at $\lambda = 0$ only the stumble and the last step are blamed. At 0.95 everything
# that led there is. The larger $\lambda$, the further back the blame goes; but the sum then holds
# more steps, and each adds noise.

# %% [markdown]
# ## How far may one update go?
#
# Let $\rho_t = \pi(a_t | o_t) / \pi_\text{old}(a_t | o_t)$: how much likelier has the action become
# since it was tried? PPO maximises
#
# $$
# L = \mathbb E_t \bigl[ \min\bigl( \rho_t A_t,\;
#     \operatorname{clip}(\rho_t, 1 - \epsilon, 1 + \epsilon)\, A_t \bigr) \bigr],
# \qquad \epsilon = 0.2 .
# $$

# %%
predict(
    "A bad action (A = -1) is already half as likely as before. Does L still push it down?",
    ["yes", "no", "it pushes it up again"],
)

# %%
ratio = np.linspace(0.4, 1.6, 121)


def clipped(ratio, A):
    return np.minimum(ratio * A, np.clip(ratio, 0.8, 1.2) * A)


# %%
draw_curves(
    ratio, {"good action, A = +1": clipped(ratio, 1), "bad action, A = -1": clipped(ratio, -1)},
    title="What PPO maximises, for one action",
    xlabel="how much likelier the action has become", ylabel="its part of L",
)  # fmt: skip

# %%
assert clipped(0.5, -1) == clipped(0.6, -1) and clipped(1.3, 1) == clipped(1.4, 1)  # flat
reveal("no")

# %% [markdown]
# *What to see:* each curve is flat on the side where the policy has already done what it should: it
# has been pushed far enough for one rollout. On the other side it is not flat: a mistake can always
# be taken back ([derivation](../docs/derivations.md#ppos-clip)).

# %% [markdown]
# ## Train, stop, go on
#
# A specialist does not begin at zero. It takes over the **walker**, a policy that has learned to
# walk on nearly level ground. Its critic is new, so in the first iterations the policy is left
# alone until the critic has learned what to expect.

# %%
from pathlib import Path

from fgtutor.course.notebooks import budget
from fgtutor.learning.config import A1TrainConfig
from fgtutor.specialist import ZOO

walker = ZOO / "a1" / "_walker"
robots = budget(fast=48, full=256, unit="robots")
iterations = budget(fast=4, full=40, unit="iterations of 40 steps", each=4.0)
config = A1TrainConfig(
    terrain="steps", rows=5, columns=2, turned=0.0, num_envs=robots, iterations=iterations,
    start_from=walker, critic_warmup=2, save_every=20,
    out=Path("runs") / f"09-steps-{robots}-{iterations}",
)  # fmt: skip

# %% [markdown]
# Half-way a signal arrives, just as when you press the stop button:

# %%
import signal
from dataclasses import replace

from fgtutor import train


def impatient(row):
    if row["iteration"] == iterations // 2:
        signal.raise_signal(signal.SIGINT)


started = (config.out / "checkpoint.pt").exists()
half = train(replace(config, resume=started), on_iteration=impatient)
print(f"stopped: {half.provenance['samples']:,} samples so far, the walker's included")

# %% [markdown]
# Nothing was lost. A checkpoint holds the networks, their optimisers, the curriculum and the state
# of the random numbers. `resume=True` goes on, bit for bit as if nobody had interrupted (a test of
# this package says so).

# %%
from fgtutor.course.widgets.live_curve import LiveCurve

live = LiveCurve()
mine = train(replace(config, resume=True), on_iteration=live)
live.draw(mine.provenance["curve"])
assert len(mine.provenance["curve"]) == iterations

# %% [markdown]
# *What to see:* $r_v$ is well above zero from the first iteration on. That is the walker's doing.
#
# ## A velocity that nobody measures
#
# The tracking reward compares velocities, but no sensor of the A1 measures one. So the policy reads
# a **history** of ten frames (joints, gyroscope, gravity, last actions). An encoder estimates from
# it the velocity $\hat v$ and a latent vector $z$, from which a decoder predicts the next frame:
#
# $$
# L_\text{context} = \lVert v - \hat v \rVert^2 + \lVert o' - \hat o' \rVert^2
#     + \beta\, L_\text{KL}(z).
# $$
#
# In simulation the true $v$ is known, so this is supervised learning beside PPO, as in DreamWaQ
# (Nahrendra et al., 2023), which the paper follows. PPO's gradient stops at the encoder.

# %%
import torch

from fgtutor.course.drives import collect
from fgtutor.learning.config import make_training_env
from fgtutor.robots.a1.observation import NOISE

scale = NOISE["velocity"][2]  # networks see the velocity times this
seen = collect(make_training_env(replace(config, num_envs=4)), mine.act, seconds=3.0)
encoder = mine.policy.context
with torch.no_grad():
    estimate = encoder(seen["history"])[..., encoder.width : encoder.width + 3] / scale
truth = seen["critic"][..., :3] / scale

# %%
draw_curves(
    0.02 * np.arange(len(truth)),
    {"true": truth[:, 0, 0], "estimated": estimate[:, 0, 0]},
    title="One robot's velocity ahead", xlabel="time (s)", ylabel="velocity (m/s)",
)  # fmt: skip

# %%
off = (estimate - truth).square().mean().sqrt()
assert off < truth.square().mean().sqrt(), "worse than always estimating 0"
print(f"off by {off:.2f} m/s (root mean square), after {iterations} iterations")

# %% [markdown]
# *What to see:* the estimate follows the truth, with an error that shrinks as the encoder is
# trained. Where both drop to 0, a new episode begins.

# %% [markdown]
# ## What the walker is worth
#
# The same once more, but from nothing. This time we call each iteration ourselves, and write down
# the learning rate after every one of its updates.

# %%
from fgtutor.learning.training import Trainer

count = budget(fast=4, full=20, unit="iterations", each=4.0)
scratch, rates = Trainer(replace(config, start_from=None, out=Path("runs") / "09-from-nothing")), []
hook = scratch.algorithm.optimizer.register_step_post_hook(
    lambda optimizer, *_: rates.append(optimizer.param_groups[0]["lr"])
)

# %%
from tqdm import tqdm

rows = [scratch.iterate() for _ in tqdm(range(count))]
walker_rows = mine.provenance["curve"][:count]

# %%
draw_curves(
    range(1, count + 1),
    {"from the walker": [row["r_v"] for row in walker_rows],
     "from nothing": [row["r_v"] for row in rows]},
    title="The same robots, the same ground", xlabel="iteration", ylabel="r_v",
)  # fmt: skip

# %%
means = [np.mean([row["r_v"] for row in some]) for some in (walker_rows, rows)]
assert means[0] > means[1]
print("mean r_v: {:.2f} from the walker, {:.2f} from nothing".format(*means))

# %% [markdown]
# *What to see:* the distance between the curves is what walking is worth. A specialist starts from
# a walker and learns only what is different about *its* ground.
#
# ## The learning rate sets itself
#
# The clip looks at single actions. rsl_rl also watches how far the whole policy has moved since the
# rollout, by the **KL divergence** of its Gaussian actions, with means $\mu_j$ and deviations
# $s_j$:
#
# $$
# \mathrm{KL} = \mathbb E_t \sum_j \Bigl[ \ln \frac{s_j}{s_j^\text{old}}
#   + \frac{(s_j^\text{old})^2 + (\mu_j^\text{old} - \mu_j)^2}{2 s_j^2} - \frac12 \Bigr].
# $$
#
# Above twice the desired value it divides the learning rate by 1.5, below half of it it multiplies
# it by 1.5, and otherwise leaves it.

# %%
predict("Which shape will the learning rate have over the updates?",
        ["a smooth decay", "a zig-zag in equal jumps", "a constant"])  # fmt: skip

# %%
draw_curves(
    range(1, len(rates) + 1), {"learning rate": rates}, log=True, steps=True,
    title=f"The learning rate in {count} iterations from nothing",
    xlabel="update (16 in each iteration)", ylabel="learning rate",
)  # fmt: skip

# %%
jumps = np.abs(np.diff(np.log(rates)))
assert len(rates) == 16 * count and jumps.max() < np.log(1.5) + 1e-6 and jumps.max() > 0.1
print(f"it jumped in {np.mean(jumps > 1e-6):.0%} of the updates, by a factor of 1.5 at most")
reveal("a zig-zag in equal jumps")

# %% [markdown]
# *What to see:* going up and down is normal. A rate that sinks to its floor of $10^{-5}$ and stays
# there is a bad sign: then every update moves the policy too far, however small it is.

# %% [markdown]
# ## The exam
#
# A training curve is of noisy policies on ground that they know. The exam has held-out steps, of
# two thirds of the full difficulty, and no noise. All three drivers get the same grounds.

# %%
from fgtutor import load_specialist, make_terrain

held_out = budget(fast=4, full=20, unit="grounds for each of three drivers", each=2.0)
exam = [make_terrain("steps", robot="a1", difficulty=0.65, seed=2 * i + 1) for i in range(held_out)]
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
    name: (sum(walk.success for walk in walks[i * held_out : (i + 1) * held_out]), held_out)
    for i, name in enumerate(drivers)
}
assert passed["steps"] >= passed["walker"]
draw_rates(passed, title="Who crosses steps it has never seen?")

# %% [markdown]
# *What to see:* first the black lines, then the bars. Where the lines overlap, the bars prove
# nothing. `mine` has practised for minutes at most, `steps` for as long as its provenance says.

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
rollout = drive(steps, "steps", CalibrationConfig(robot="a1", envs=envs, seconds=5.0))
table, error = calibration(*promised(steps, rollout))
calibration_plot(table, error)

# %%
assert error < 0.15
most = table[table[:, 2].argmax()]
print(f"where most patches are, it promises {most[0]:.2f} and the robots earn {most[1]:.2f}")

# %% [markdown]
# *What to see:* look at the points above the tall bars; where there are few patches, a point means
# little. A policy may be poor and its net still honest. The next notebook lives on that.

# %% [markdown]
# ## What you now know
#
# - A curriculum lets each robot find its own difficulty, and waiting must not pay.
# - The advantage spreads a surprise over the actions before it; $\lambda$ says how far back.
# - The clip and the adaptive learning rate both limit how far one rollout may move the policy.
# - A velocity that no sensor measures can be estimated, supervised, beside PPO.
# - A training can be stopped and resumed; its provenance says what it was.
#
# **Test yourself**
#
# <details><summary>1. r_v falls during a training. Name a harmless reason.</summary>
#
# The curriculum: the robots have moved to harder rows. Look at the mean row before you worry.
# </details>
#
# <details><summary>2. λ = 1, and the critic is perfect. Does the choice of λ still
# matter?</summary>
#
# Not for the mean: with a perfect critic every λ gives the right advantage on average. But with λ =
# 1 it is a sum over many noisy steps, so it scatters most.
# </details>
#
# <details><summary>3. Why must the critic be warmed up before a walker is trained
# further?</summary>
#
# A new critic expects nonsense, so the surprises and the advantages are nonsense too. Following
# them would unlearn the walking.
# </details>
#
# ## What to try
#
# - Train in earnest, from a shell: `fgtutor train --robot a1 --terrain gentle`, then
#   `fgtutor train --robot a1 --terrain steps --from runs/a1-gentle-seed1/specialist --hours 1`, and
#   again with `--resume` as often as you have an hour.
# - `critic_warmup=0`: what happens to $r_v$ in the first iterations?
#   <details><summary>Answer</summary>It tends to fall before it rises: see question 3 above.
#   Compare several seeds before you believe one curve.</details>
# - `rows=1` puts every robot on the hardest ground at once. Compare the curves.
#   <details><summary>Answer</summary>r_v is lower and more episodes fail. A robot that always falls
#   at the first step never sees the second one.</details>
# - `actor="dreamwaq"` trains the paper's blind policy, which has to imagine the ground. What can it
#   not know before its feet do?
#   <details><summary>Answer</summary>Where the next edge is. It notices a slot when a foot is in
#   it.
#   </details>
#
# **Exercises:** [exercises/ex09.ipynb](../exercises/ex09.ipynb). **Next:** what a better policy
# does to a plan, [10_planning_adapts.ipynb](10_planning_adapts.ipynb).
