# %% [markdown]
# # 03 · Feasibility-Net
#
# - **You will be able to** turn a rollout into labels, write and train a network that predicts how
#   well *one particular policy* would do on a patch, and check whether its promises come true
# - **Time** 50 minutes to read and try; about 2 minutes on two CPU cores
# - **Needs** notebook [02](02_a_robot_that_falls.ipynb) for $r_v$, and a first acquaintance with
#   PyTorch; uses shipped specialists, so nothing of yours must be trained
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer robots, fewer
#   updates. You may interrupt a bar, but run its cell to the end before you go on
#
# In notebook 02 you saw $r_v$ dip where the ground gets hard. Could one have *known* that from the
# patch, before going there? A network that knows is half of this course: the **Feasibility-Net**
# (paper, Sec. III-A). To train it, one only has to watch the policy drive.
#
# Symbols and references are on the [notation page](../docs/notation.md); equation numbers are the
# paper's.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=3)

# %% [markdown]
# ## Watch a driver
#
# We begin with the driver that we understand: `roll`, which only lets its wheels turn. Many robots
# drive over steps of all heights, at commanded speeds between a slow walk and a run.

# %%
import torch

from fgtutor import make_terrain
from fgtutor.course.notebooks import budget
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import World

robots = budget(fast=96, full=192, unit="robots, 12 s each", each=0.12)
speeds = EnvConfig(speed=(0.3, 1.5))  # m/s
tiles = [make_terrain("steps", difficulty=(i % 5 + 1) / 5, seed=2 * i) for i in range(30)]
env = ToyEnv(World([tiles]), robots, seed=0, config=speeds)


# %%
def roll(observations):
    return torch.zeros(len(observations), 4)


# %%
from fgtutor.course.drives import collect

rollout = collect(env, roll, seconds=12.0)
{name: tuple(values.shape) for name, values in rollout.items()}

# %% [markdown]
# The shapes are [time, robots, numbers]. Each row is one moment of one robot: the patch it stood
# on, the command it had, and in `tracking` how the step that led here went: ($r_v$, failed?,
# ended?).
#
# ## From a rollout to labels
#
# *What will happen if I go there?* is a question about the future. The next 40 ms are mostly noise,
# so the label $y_t$ of a moment is the mean of $r_v$ over the **next second**, $n = 25$ steps:
#
# $$
# y_t = \frac1n \sum_{k=1}^{n} r_v^{(t+k)} .
# $$
#
# (The paper uses the $r_v$ of a single step; the window is ours.) Two rules keep labels honest:
#
# 1. After a failure, $r_v$ counts as 0 for the rest of the window. A fall is not missing data.
# 2. A label never reaches into the next episode, where the robot was put somewhere else.

# %%
from fgtutor.course.diagrams import draw_label_timeline

draw_label_timeline()

# %% [markdown]
# **Your line.** A robot tracks well, then fails in step 3. The $r_v$ of its steps 1, 2, 3 are 0.9,
# 0.6 and 0.0. What is the label of moment 0, with a window of three?

# %%
from fgtutor.feasibility import feasibility_labels

first = ...  # a number, or a formula

r_v, failed, ended = [0.0, 0.9, 0.6, 0.0, 0.8, 0.8], [0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0]
six_steps = torch.tensor([r_v, failed, ended]).T[:, None]  # [time, robots, 3]
label, valid = feasibility_labels(six_steps, window=3)
if first is ...:
    print("Not filled in yet: the mean of three numbers.")
else:
    assert abs(first - label[0, 0]) < 1e-4, f"got {first}: average steps 1, 2 and 3"
    print("Right.")

# %%
print("label:", [round(y, 2) for y in label[:, 0].tolist()])
print("valid:", valid[:, 0].tolist())

# %% [markdown]
# The second label is (0.6 + 0 + 0) / 3: after the failure its window holds a zero that never
# happened. The last two moments have too little of their window left to say anything: no label.
#
# Now the real thing: one robot that got stuck.

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "A robot fails at 6 s. When does its label begin to count the failure?",
    ["at 6 s", "from 5 s on", "from 7 s on"],
)

# %%
from fgtutor.figures.charts import draw_labels

second = round(1.0 / env.control_dt)
label, valid = feasibility_labels(rollout["tracking"], window=second)
unlucky = int(rollout["tracking"][..., 1].sum(dim=0).argmax())
history = rollout["tracking"][:, unlucky]
draw_labels(history, label[:, unlucky], valid[:, unlucky], env.control_dt)

# %%
fails = int(history[:, 1].argmax())
assert label[fails - 5, unlucky] <= 5 / second  # at most five of its 25 steps earned anything
reveal("From 5 s on: a label sees a failure up to one second before it happens.")

# %% [markdown]
# That second of foresight is what the patch must be enough to predict. Slide the window. What do
# you gain with a longer one, and what do you lose?

# %%
from fgtutor.course.widgets.slides import LabelSlides

LabelSlides(history, env.control_dt)

# %% [markdown]
# ## The network: two that share nothing
#
# The Feasibility-Net is an MLP, the *head*, that reads patch and command and gives the feasibility
# $\hat f \in [0, 1]$. Beside it a variational autoencoder (**VAE**) squeezes the patch through a
# narrow code $z$ and rebuilds it; notebook 04 needs that. They share inputs and a sum of losses,
# but **no weight**.

# %%
from fgtutor.course.diagrams import draw_net

draw_net()

# %% [markdown]
# Note what $\hat f$ is: the expected $r_v$. It is *not* the probability of success. A robot that
# crosses safely at half the commanded speed has a low $\hat f$.
#
# Here is all of it, in about forty lines of PyTorch.

# %%
from itertools import pairwise

from torch import nn


def mlp(activation, *widths):
    layers = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])  # no activation after the last


# %%
class Net(nn.Module):
    def __init__(self, points, command=3, latent=16):
        super().__init__()
        self.scale = 4.0  # a unit of height is a quarter of a metre
        self.head = mlp(nn.ELU, points + command, 128, 64, 1)
        self.encoder = mlp(nn.Tanh, points, 256, 128, 2 * latent)
        self.decoder = mlp(nn.Tanh, latent, 128, 256, points)

    def feasibility(self, patch, command):
        inputs = torch.cat((self.scale * patch, command), dim=-1)
        return torch.sigmoid(self.head(inputs)).squeeze(-1)


# %%
torch.manual_seed(0)
net = Net(env.grid.num_points)
net

# %% [markdown]
# The encoder gives two numbers per code: a mean $\mu$ and a log-variance $\log s^2$. The code is
# drawn, $z = \mu + s\,\varepsilon$ with $\varepsilon \sim \mathcal N(0, 1)$. Written so, the noise
# is an input, and gradients pass through $\mu$ and $s$: the *reparametrisation*. The loss is
#
# $$
# \mathcal L_\text{feas} = \lVert \hat f - r_v \rVert_2^2 + \alpha\, \mathcal L_\text{VAE}
# \tag{2}
# $$
# $$
# \mathcal L_\text{VAE} = \mathcal L_\text{recon}(H_{x,y}) + \beta\, \mathcal L_\text{KL}(H_{x,y})
# \tag{3}
# $$
#
# with the paper's $\alpha = 1$ and $\beta = 5 \times 10^{-4}$. $\mathcal L_\text{recon}$ is the
# squared error of the rebuilt patch, summed over its points. $\mathcal L_\text{KL}$ says how far
# the code's distribution is from a standard normal one; between two Gaussians it has a closed form:
#
# $$
# \mathcal L_\text{KL} = \tfrac12 \sum_j \left(\mu_j^2 + s_j^2 - 1 - \log s_j^2\right).
# $$
#
# **Your line.** One code with $\mu = 1$ and $s^2 = 1$: how large is its KL? And where is it 0?

# %%
mu, log_variance = torch.tensor(1.0), torch.tensor(0.0)
kl = ...  # the formula above, for one code

if kl is ...:
    print("Not filled in yet: log_variance.exp() is s squared.")
else:
    normal = torch.distributions.Normal
    right = torch.distributions.kl_divergence(normal(mu, 1.0), normal(0.0, 1.0))
    assert torch.isclose(torch.as_tensor(kl), right), f"got {kl}, PyTorch says {right}"
    print("Right: 0.5. It is 0 for mu = 0 and s = 1 only.")


# %%
def vae_loss(net, patch, beta=5e-4):
    h = net.scale * patch
    mean, log_variance = net.encoder(h).chunk(2, dim=-1)
    z = mean + torch.randn_like(mean) * torch.exp(0.5 * log_variance)
    recon = (net.decoder(z) - h).square().sum(dim=-1).mean()
    kl = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1).mean()
    return recon + beta * kl, recon  # Eq. 3


def loss_of(net, patch, command, label, alpha=1.0):
    error = (net.feasibility(patch, command) - label).square().mean()
    vae, recon = vae_loss(net, patch)
    return error + alpha * vae, error, recon  # Eq. 2


# %% [markdown]
# The library's `FeasibilityNet` has the same layers under the same names. So it can take over your
# weights, and must give the same loss for the same noise:

# %%
from fgtutor.feasibility import FeasibilityNet

patch, command, y = (rollout["patch"][valid], rollout["command"][valid], label[valid])
library = FeasibilityNet(env.grid.num_points)
library.load_state_dict(net.state_dict())
torch.manual_seed(1)
ours = loss_of(net, patch[:64], command[:64], y[:64])[0]
torch.manual_seed(1)
theirs = library.loss(patch[:64], command[:64], y[:64])[0]
assert torch.isclose(ours, theirs, rtol=1e-4)
print(f"yours {ours:.5f}, the library's {theirs:.5f}; {len(y):,} labelled moments to learn from")

# %% [markdown]
# **Why these two terms?** They are a bound. For any encoder $q(z \mid H)$,
#
# $$
# \log p(H) \ \ge\ \mathbb E_{q}\bigl[\log p(H \mid z)\bigr] - \mathrm{KL}\bigl(q(z \mid H)\,
# \Vert\, p(z)\bigr),
# $$
#
# the evidence lower bound (ELBO). If the decoder's error is Gaussian with variance
# $\sigma_d^2$, minus this bound, times $2\sigma_d^2$, is Eq. 3 with $\beta = 2\sigma_d^2$, up to a
# constant. So $\beta = 5 \times 10^{-4}$ says: an error of 0.016 units, 4 mm, is normal. And a high
# loss hints at a patch that the model finds improbable; only a hint, since it is a bound.
#
# **Why not a plain autoencoder?** It may put its codes anywhere, with holes between them. Noise in
# the code and the KL make it use one compact region smoothly: a code of a known patch means a known
# patch. What it cannot encode it cannot rebuild (Kingma and Welling, 2014; steps in
# [derivations](../docs/derivations.md)).
#
# ## Train it

# %%
from tqdm import tqdm

updates = budget(fast=600, full=1500, unit="updates", each=0.01)
optimiser = torch.optim.Adam(net.parameters(), lr=2e-3)
curve = []
for _ in tqdm(range(updates)):
    batch = torch.randint(len(y), (512,))
    loss, *parts = loss_of(net, patch[batch], command[batch], y[batch])
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    curve.append([part.item() for part in parts])

# %%
from fgtutor.figures.charts import draw_curves

error, recon = torch.tensor(curve).T
assert error[-50:].mean() < error[:10].mean() / 2 and recon[-50:].mean() < recon[:10].mean() / 4
draw_curves(
    range(updates),
    {"(f - r_v)²": error, "L_recon": recon},
    title="Two losses, one rollout",
    xlabel="update",
    ylabel="loss",
    log=True,
)

# %% [markdown]
# ## Do its promises come true?
#
# A low loss is not the point. The point is: **when it says 0.8, is it 0.8?** So let the same driver
# meet ground that the net has never seen (odd seeds here, even ones above), sort all moments by
# what the net promised, and compare with what came.

# %%
fresh = [make_terrain("steps", difficulty=(i % 5 + 1) / 5, seed=2 * i + 1) for i in range(30)]
exam = ToyEnv(World([fresh]), robots, seed=1, config=speeds)
test = collect(exam, roll, seconds=8.0)
measured, known = feasibility_labels(test["tracking"], window=second)

# %%
with torch.no_grad():
    promised = net.feasibility(test["patch"][known], test["command"][known])

# %%
from fgtutor.figures.charts import calibration_plot
from fgtutor.statistics import calibration

table, off = calibration(promised.numpy(), measured[known].numpy())
assert off < 0.1
calibration_plot(table, off)

# %% [markdown]
# *What to see:* on the dashed line a promise is kept. Below it the net was too hopeful, above it
# too shy. The bars on the left are the moments where it says "don't": it exists for their sake.
#
# ## What does it fear?

# %%
from fgtutor.course.patch_pictures import patch_gallery

order = promised.argsort()
pick = order[[0, len(order) // 40, -len(order) // 40, -1]]
captions = [f"f = {promised[i]:.2f}, came {measured[known][i]:.2f}" for i in pick]
patch_gallery(
    test["patch"][known][pick],
    env.grid,
    captions,
    columns=2,
    title="Least (above) and most (below) feasible for `roll`",
)

# %%
lane = test["patch"][known].unflatten(-1, env.grid.shape)[:, :, 2]  # the middle line
under = lane[:, 2:9]  # from 30 cm behind the robot's centre to 30 cm ahead
edge = under.amax(dim=-1) - under.amin(dim=-1)
feared, liked = (edge[order[part]].mean() for part in (slice(500), slice(-500, None)))
assert feared > liked + 0.02
print(
    f"edge between the wheels: {feared:.2f} m where f is lowest, {liked:.2f} m where it is highest"
)

# %% [markdown]
# *What to see:* where f is lowest, an edge lies between the wheels. The front one is already up,
# and rolling will not lift the rear one. Where f is highest, the ground in the robot's path is
# level.

# %% [markdown]
# ## A different driver, a different answer
#
# Here is the heart of the matter. *Feasible* is not a property of the ground. It is a property of
# the ground **and of the policy that drives on it**. Let two nets judge the same courses: the one
# that you trained, which knows `roll`, and the one that ships with the *steps* specialist, which
# knows that specialist.

# %%
import numpy as np

from fgtutor import load_zoo  # loads the robots: some seconds, once
from fgtutor.course.patch_pictures import patch_at

steps = load_zoo("toy")["steps"]
heights = (0.2, 0.4, 0.6, 0.8, 1.0)  # difficulty: how high the steps are
seeds = range(1, 25, 2)
courses = {h: [make_terrain("steps", difficulty=h, seed=i) for i in seeds] for h in heights}


# %%
@torch.no_grad()
def along(net, course):  # f at each place on the straight line from start to goal
    x = np.arange(course.start[0], course.goal[0], 0.1)
    poses = np.stack((x, 0 * x + course.start[1], 0 * x), axis=-1)
    patches = patch_at(course.elevation, poses, env.grid)
    return net.feasibility(patches, torch.tensor(steps.command).expand(len(x), -1))


# %%
predict(
    "On low steps, which of the two nets promises more?",
    ["that of roll, which can do nothing", "that of the steps specialist", "both the same"],
)

# %%
nets = {"roll": net, "steps": steps.feasibility}
f = {name: [[along(one, c) for c in courses[h]] for h in heights] for name, one in nets.items()}
mean = {name: [np.mean([c.mean() for c in row]) for row in rows] for name, rows in f.items()}
least = {name: [np.mean([c.min() for c in row]) for row in rows] for name, rows in f.items()}

# %%
draw_curves(
    heights,
    least,
    title="The least f along a course: two drivers, one set of courses",
    xlabel="difficulty (share of the full step height)",
    ylabel="least f, mean of 12 courses",
)

# %%
assert mean["roll"][0] > mean["steps"][0] and least["roll"][-1] < least["steps"][-1] - 0.1
reveal(
    f"That of roll: {mean['roll'][0]:.2f} against {mean['steps'][0]:.2f} on average. Nothing beats "
    "plain rolling where the ground is almost flat."
)

# %% [markdown]
# *What to see:* at the hardest place of a course, `roll` falls off far sooner than the specialist
# as the steps get higher. Is that what happens? Let both drive.

# %%
from fgtutor.course.drives import Scripted, straight_route
from fgtutor.execution import FollowConfig, execute_batch
from fgtutor.figures.charts import draw_shares
from fgtutor.statistics import Share

patience = FollowConfig(patience=1.5, grace=2.0)
arrived = {}
for h in heights:
    arrived[f"difficulty {h}"] = won = {}
    for name, driver in {"roll": Scripted(roll), "steps": steps}.items():
        routes = [straight_route(course, name) for course in courses[h]]
        drives = execute_batch(routes, courses[h], {name: driver}, seeds=seeds, config=patience)
        won[name] = Share.of(drive.success for drive in drives)

# %%
hardest = arrived["difficulty 1.0"]
assert hardest["roll"].successes < hardest["steps"].successes
draw_shares({key: arrived[key] for key in list(arrived)[::2]}, title="Who arrives?")

# %% [markdown]
# Where one policy's f falls below another's, one should change drivers. The planner of this course
# does nothing else. A costmap has one opinion of a ledge; a robot with many skills needs one per
# skill.

# %% [markdown]
# ## Feasible at what speed?
#
# The command is an input too. Here is one ledge, 40 cm ahead of `roll`, at all speeds that the net
# was trained on.

# %%
from fgtutor import ElevationMap


def ledge(height):
    ground = np.zeros((50, 20))
    ground[25:] = height
    return patch_at(ElevationMap(ground), (2.1, 1.0, 0.0), env.grid)


v = torch.linspace(0.3, 1.5, 31)
commands = torch.stack((v, 0 * v, 0 * v), dim=-1)
with torch.no_grad():
    by_height = {
        f"ledge of {100 * h:.0f} cm": net.feasibility(ledge(h).expand(len(v), -1), commands)
        for h in (0.0, 0.06, 0.12)
    }

# %%
high = by_height["ledge of 12 cm"]
assert high[0] > high[-1] + 0.1
draw_curves(
    v, by_height, title="f depends on the command", xlabel="speed (m/s)", ylabel="feasibility f"
)

# %% [markdown]
# *What to see:* the same ledge is acceptable at a walk and reckless at a run. Part of that is Eq.
# 1: its $\sigma$ is a speed, so a robot that is stuck is wrong by 0.3 m/s at a walk and still earns
# 0.30; at a run it is wrong by 1.5 m/s and earns 0.002.
#
# From now on every question is put at one speed, the specialist's *planning command*.

# %% [markdown]
# ## The paper's idea: policy and net in one training
#
# You first had a policy and then collected a rollout for its net. But a policy *in training* makes
# rollouts all day long, falls included. Joint training uses each rollout twice: first fit the
# Feasibility-Net to it, then let PPO learn from it. The net watches, and never disturbs.

# %%
from fgtutor.figures.charts import training_curve

training_curve(steps.provenance["curve"])

# %% [markdown]
# *What to see:* in the lowest panel, $(\hat f - r_v)^2$ stays low although the policy changes all
# the time: the net keeps up with it.
#
# And is the shipped net honest on new ground of its own kind?

# %%
from fgtutor.evaluation.calibration import CalibrationConfig, drive
from fgtutor.evaluation.calibration import promised as promises_of

settings = CalibrationConfig(envs=budget(fast=40, full=100, unit="robots", each=0.2), seconds=10.0)
said, came = promises_of(steps, drive(steps, "steps", settings))
table, off = calibration(said, came)
assert off < 0.15 and came.mean() > said.mean()
calibration_plot(table, off)

# %% [markdown]
# *What to see:* it is too shy: more came than it said. One reason: in training, noise was added to
# the policy's actions, and the net saw the outcome. Here the policy drives without the noise, and
# better. For a planner that is the safe side; but compare two policies by $f$ only if their nets
# err alike.

# %% [markdown]
# ## What you now know
#
# - A label is the mean $r_v$ of the next second; a failure counts as 0 from then on.
# - The Feasibility-Net is a head and a VAE without a common weight, trained by Eqs. 2 and 3.
# - $\hat f$ is an expected $r_v$ of one policy at one command, not a probability of success.
# - A calibration plot on new ground tells whether promises come true; the loss does not.
#
# **Test yourself**
#
# <details><summary>1. Why must the steps after a fall count as 0 and not be left out?</summary>
#
# A robot that runs perfectly into a gap would get the label 1 right before it: only the good steps
# would be left in the mean.
# </details>
#
# <details><summary>2. A code has mu = 0 and s = 0.1. Is its KL zero?</summary>
#
# No: $\tfrac12(0 + 0.01 - 1 + 4.61) = 1.81$. A narrow code says much about the patch, and the KL
# charges for it.
# </details>
#
# <details><summary>3. A net always answers 0.7, the mean of all labels. How does its calibration
# plot look?</summary>
#
# One point, on the diagonal: perfectly calibrated and useless. Look at the bars too: a good net
# also spreads its answers.
# </details>

# %% [markdown]
# ## What to try
#
# - Use the paper's label of a single step: `window=1`. What happens to the loss and to the plot?
#   <details><summary>Answer</summary>Single steps are noisier, so the loss stays higher; the plot
#   compares means, and can still lie on the diagonal. What is lost is the warning: before a ledge
#   the next 40 ms are fine. Which is fairer? The one that answers the question you will ask: for a
#   planner, whether the next metre works.</details>
# - Break rule 1: set `rollout["tracking"][..., 1] = 0` before the labels are made. What does the
#   net then say of a ledge of 12 cm?
#   <details><summary>Answer</summary>More: windows are cut where a robot failed, and only the steps
#   before it count. The net has learned from survivors.</details>
# - Ask the steps net about a *gap* (heights of -0.3 m for 40 cm). Should you believe its answer?
#   <details><summary>Answer</summary>It gives a number as calmly as ever, and has never seen a gap.
#   That is the next notebook.</details>
#
# **Exercises:** [exercises/ex03.ipynb](../exercises/ex03.ipynb). **Next:** have I seen this
# before? [04_have_i_seen_this_before.ipynb](04_have_i_seen_this_before.ipynb).
