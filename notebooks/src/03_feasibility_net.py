# %% [markdown]
# # 03 · Feasibility-Net
#
# - **You will be able to** turn a rollout into labels, train a network that predicts how well
#   *one particular policy* would do on a patch, and check whether its promises come true
# - **Time** half an hour to read; about 1 minute on two CPU cores
# - **Needs** notebook [02](02_a_robot_that_falls.ipynb) for $r_v$; uses shipped specialists, so
#   nothing of yours must be trained
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer robots, fewer
#   updates. You may interrupt a bar, but run its cell to the end before you go on
#
# In notebook 02 you saw $r_v$ dip where the ground gets hard. Could one have *known*, from the
# patch, before going there? A network that knows is half of this course: the **Feasibility-Net**.
# It asks nothing of the policy but to watch it drive.

# %% [markdown]
# ## Watch a driver
#
# Let us start with the driver that we understand: `roll`, which does nothing but let its wheels
# turn. It drives over steps of all heights, from nearly flat to higher than its axles, many
# robots at once.

# %%
import torch

from fgtutor import make_terrain
from fgtutor.course.notebooks import budget
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import World

robots = budget(fast=64, full=192, unit="robots, 12 s each", each=0.12)
tiles = [make_terrain("steps", difficulty=(i % 5 + 1) / 5, seed=2 * i) for i in range(30)]
env = ToyEnv(World([tiles]), robots, seed=0)

# %%
from fgtutor.course.drives import collect


def roll(observations):
    return torch.zeros(len(observations), 4)


rollout = collect(env, roll, seconds=12.0)
{name: tuple(values.shape) for name, values in rollout.items()}

# %% [markdown]
# Every row is a moment of one robot: the patch it stood on, the command it had, and in `tracking`
# how the step just taken went: ($r_v$, failed?, ended?).
#
# ## From a rollout to labels
#
# The question "what will happen *if I go there*?" looks ahead. The answer of the next 40
# milliseconds is mostly noise, so the label of a moment is the mean of $r_v$ over the **next
# second**. Two rules make it honest:
#
# 1. After a failure $r_v$ counts as 0 for the rest of the window. A fall is not "no data".
# 2. A label never reaches into the next episode: the robot was put somewhere else.
#
# Work it out by hand on six steps and a window of three. The robot tracks well, then fails in
# step 4, and is reset. Since a row tells of the step that *led to* its moment, the label of a
# moment begins one row further on, and the 0.0 of the first row is in no label.

# %%
from fgtutor.feasibility import feasibility_labels

r_v, failed, ended = [0.0, 0.9, 0.6, 0.0, 0.8, 0.8], [0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0]
six_steps = torch.tensor([r_v, failed, ended]).T[:, None]  # [time, robots, 3]
label, valid = feasibility_labels(six_steps, window=3)
print("label:", [round(v, 2) for v in label[:, 0].tolist()])
print("valid:", valid[:, 0].tolist())

# %% [markdown]
# The first label is (0.9 + 0.6 + 0) / 3. The second has seen 0.6 and then the failure, which
# makes the rest 0. At the end too little of the window is left to say anything: such moments get
# no label.
#
# Now the real thing, one robot that got stuck:

# %%
from fgtutor.figures.charts import draw_labels

label, valid = feasibility_labels(rollout["tracking"], window=round(1.0 / env.control_dt))
failures = rollout["tracking"][..., 1].sum(dim=0)
unlucky = int(failures.argmax())
draw_labels(rollout["tracking"][:, unlucky], label[:, unlucky], valid[:, unlucky], env.control_dt)

# %% [markdown]
# *What to see:* the label goes down *before* the trouble comes. That second of foresight is what
# the patch must be enough to predict.

# %% [markdown]
# ## Two heads, one loss
#
# The net reads patch and command and answers twice. An MLP gives the feasibility $\hat f \in [0,
# 1]$; beside it, a variational autoencoder (**VAE**) squeezes the patch through a narrow latent and
# rebuilds it (notebook 04 will need that):
#
# $$
# \mathcal L = (\hat f - r_v)^2 + \alpha\,(\mathcal L_\text{recon} + \beta\,\mathcal L_\text{KL})
# $$
#
# $\mathcal L_\text{recon}$ says how badly it rebuilds the patch; $\mathcal L_\text{KL}$ keeps its
# latent near a standard normal distribution, so that it cannot simply memorise. $\alpha = 1$ and
# $\beta = 0.0005$, the paper's, say how much each counts.

# %%
from fgtutor.feasibility import FeasibilityNet

torch.manual_seed(0)
lazy_net = FeasibilityNet(env.grid.num_points)
optimiser = torch.optim.Adam(lazy_net.parameters(), lr=2e-3)
data = [rollout[name][valid] for name in ("patch", "command")] + [label[valid]]
print(f"{len(data[0]):,} labelled moments")

# %%
from tqdm import tqdm

updates = budget(fast=400, full=1500, unit="updates", each=0.01)
history = []
for _ in tqdm(range(updates)):
    batch = torch.randint(len(data[0]), (512,))
    loss, parts = lazy_net.loss(*(values[batch] for values in data))
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    history.append({name: value.item() for name, value in parts.items()})

# %%
from fgtutor.figures.charts import draw_curves

draw_curves(
    range(updates),
    {
        "(f - r_v)²": [row["feasibility"] for row in history],
        "L_recon": [row["reconstruction"] for row in history],
    },
    title="Two losses, one network, one rollout",
    xlabel="update",
    ylabel="loss",
    log=True,
)

# %% [markdown]
# ## Do its promises come true?
#
# A low loss is not the point. The point is: **when it says 0.8, is it 0.8?** So let the same
# driver meet ground that the net has never seen (odd seeds here, even ones above), sort all
# moments by what the net promised, and compare with what was delivered.

# %%
lazy_net.eval()
fresh = [make_terrain("steps", difficulty=(i % 5 + 1) / 5, seed=2 * i + 1) for i in range(30)]
exam = ToyEnv(World([fresh]), robots, seed=1)
test = collect(exam, roll, seconds=8.0)
measured, valid = feasibility_labels(test["tracking"], window=round(1.0 / exam.control_dt))

# %%
from fgtutor.figures.charts import calibration_plot
from fgtutor.statistics import calibration

with torch.no_grad():
    promised = lazy_net.feasibility(test["patch"][valid], test["command"][valid])
calibration_plot(*calibration(promised.numpy(), measured[valid].numpy()))

# %% [markdown]
# *What to see:* points on the dashed line are promises kept. Below it the net is too hopeful,
# above it too shy. Bars far to the left are the moments where it says "don't": they are why it
# exists.
#
# ## What does it fear?

# %%
from fgtutor.course.patch_pictures import patch_gallery

order = promised.argsort()
seen = test["patch"][valid]
pick = torch.cat((order[:: len(order) // 40][:4], order.flip(0)[:: len(order) // 40][:4]))
captions = [f"f = {promised[i]:.2f}, came {measured[valid][i]:.2f}" for i in pick]
patch_gallery(seen[pick], env.grid, captions, title="Least and most feasible for `roll`")

# %% [markdown]
# *What to see:* in the upper row the wheels stand at an edge or are about to meet one; in the
# lower row the ground in the robot's path is level, and what lies beside it hardly matters. The
# toy's patch is long and narrow: it looks far ahead and little aside, as the toy itself moves.

# %% [markdown]
# ## Another driver, another answer
#
# Here is the heart of the matter. *Feasible* is not a property of the ground. It is a property of
# the ground **and of who drives on it**. So put the same ledge before two nets: the one you have
# just trained, which has watched `roll`, and the one that ships with the steps specialist, which
# has watched *that* one learn.

# %%
import numpy as np

from fgtutor import ElevationMap, load_zoo
from fgtutor.course.patch_pictures import patch_at

steps = load_zoo("toy")["steps"]


def ledge(height):
    heights = np.zeros((50, 20))
    heights[25:] = height
    return patch_at(ElevationMap(heights), (2.1, 1.0, 0.0), env.grid)


# %%
rises = np.linspace(-0.2, 0.2, 41)
before_ledges = torch.stack([ledge(height) for height in rises])
command = torch.tensor(steps.command).expand(len(rises), -1)
with torch.no_grad():
    answers = {
        "of the driver that rolls": lazy_net.feasibility(before_ledges, command),
        "of the steps specialist": steps.feasibility.feasibility(before_ledges, command),
    }

# %%
draw_curves(
    rises,
    answers,
    title="One ledge 40 cm ahead, two opinions",
    xlabel="height of the ledge (m); below 0 it goes down",
    ylabel="feasibility f",
)

# %% [markdown]
# *What to see:* on the flat the lazy driver may well be the better one: it tracks to perfection
# what needs no skill. But its curve falls off sooner where the ledge gets high. Wherever two such
# curves cross, one should change drivers, and that is all that the planner of this course will
# do. A costmap has one opinion of a ledge. A robot with many skills needs one for each.

# %% [markdown]
# ## Feasible at what speed?
#
# The command is an input too. The same patch may be fine at a walk and reckless at a run.

# %%
v = torch.linspace(0.7, 1.0, 31)
commands = torch.stack((v, torch.zeros_like(v), torch.zeros_like(v)), dim=-1)
with torch.no_grad():
    by_height = {
        f"ledge of {height:.2f} m": steps.feasibility.feasibility(
            ledge(height).expand(len(v), -1), commands
        )
        for height in (0.0, 0.08, 0.16)
    }
draw_curves(
    v, by_height, title="f depends on the command", xlabel="speed (m/s)", ylabel="feasibility f"
)

# %% [markdown]
# *What to see:* the lines keep their order and fall gently, as the commands of the training did
# not differ much either.
#
# From now on every question is put at one speed, the specialist's *planning command*, and only
# the patch varies.

# %% [markdown]
# ## The paper's trick: both at once
#
# You first had a policy and then collected a rollout for its net. But a policy *in training*
# makes rollouts all day long, falls included, and throws them away. Joint training uses each of
# them twice: first fit the Feasibility-Net to it, then let PPO learn from it. Same data, two
# losses, and **no shared weights**: the net watches, and never disturbs.

# %%
from fgtutor.figures.charts import training_curve

training_curve(steps.provenance["curve"])

# %% [markdown]
# *What to see:* at the bottom, $(\hat f - r_v)^2$ stays low while the policy changes all the
# time: the net keeps up with it. (Every checkpoint moves the training to new ground; the loss
# notices.)
#
# And is the shipped net honest on ground it has never seen? The same test as above, on its own
# terrain:

# %%
from fgtutor.evaluation.calibration import CalibrationConfig, drive, promised

settings = CalibrationConfig(envs=budget(fast=40, full=100, unit="robots", each=0.2), seconds=10.0)
held_out = drive(steps, "steps", settings)
calibration_plot(*calibration(*promised(steps, held_out)))

# %% [markdown]
# ## What to try
#
# - Use the paper's instantaneous label: `window=1`. What happens to the loss, and what to the
#   calibration plot? Which of the two is the fairer judge?
# - Break rule 1: set `failed` to zero before you make the labels. What does the net now say of a
#   ledge that is too high?
# - Ask the steps net about a *gap* (heights of -1 m for 40 cm). It answers with a number, calmly.
#   Should you believe it? It has never seen a gap. That is the next notebook.
#
# **Exercises:** [exercises/ex03.ipynb](../exercises/ex03.ipynb). **Next:** have I seen this
# before? [04_have_i_seen_this_before.ipynb](04_have_i_seen_this_before.ipynb).
