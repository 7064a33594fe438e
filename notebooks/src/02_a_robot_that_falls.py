# %% [markdown]
# # 02 · A robot that falls
#
# - **You will be able to** drive a simulated robot, say in one number how well it does what it is
#   told, and train it with PPO while you watch
# - **Time** 40 minutes to read and try; about 3 minutes on two CPU cores, 2 of them training
# - **Needs** notebook [01](01_elevation_maps.ipynb) for the words *map* and *patch*; no GPU, no
#   network
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: the training then
#   takes a minute at most and learns less. Stop it at any time with the stop button: what it has
#   learned by then is kept, and running the cell again goes on
#
# Before you plan with what a robot can do, meet a robot, and let it fail.
#
# Symbols and references are on the [notation page](../docs/notation.md); equation numbers are the
# paper's.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=2)

# %% [markdown]
# ## The toy
#
# Two wheels on legs that can lengthen and shorten, under a box. The toy lives in the *vertical
# slice* of the map along its heading. Its physics is 2-D ([pymunk](https://www.pymunk.org)), so a
# thousand simulated seconds take a few real ones. But it drives on the same maps, sees the same
# kind of patch and takes the same commands as the four-legged robot of the second half.

# %%
from fgtutor import make_terrain
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import World

terrain = make_terrain("gaps", robot="toy", seed=2)
world = World([[terrain]])  # rows and columns of terrains: here a single one
env = ToyEnv(world, num_envs=1, config=EnvConfig(train=False))  # one robot, no new episodes

# %%
from fgtutor.course.patch_pictures import draw_windows

draw_windows(terrain.elevation, [(1.2, 2.0, 0.0)], env.grid)

# %% [markdown]
# *What to see:* the toy's patch is long and narrow. It looks 1.2 m ahead, as it moves ahead.
#
# An environment answers two questions. **What do you sense?**

# %%
observations = env.get_observations()
{name: tuple(values.shape) for name, values in observations.items()}

# %% [markdown]
# - `policy`: what the policy gets, 39 numbers: pitch (2), speeds and height (4), legs (6), wheels
#   (2), its last action (4), the command (3), the middle line of the patch (18)
# - `patch`: the patch $H_{x,y}$ of notebook 01 at the robot's pose, 18 x 5 points
# - `command`: the velocity $\hat v$ to drive: forwards, sideways, turning
# - `tracking`: how the last step went: ($r_v$, failed?, ended?). It carries this whole course
#
# **What happens if you do this?** An action is four numbers between -1 and 1: the rear wheel, the
# front wheel (faster or slower than commanded), the rear leg, the front leg (longer or shorter).

# %%
import torch

action = torch.tensor([[0.0, 0.0, -1.0, 1.0]])  # rear leg short, front leg long
for _ in range(12):
    observations, reward, done, _ = env.step(action)
pitch = env.state[0, 0, 2]
assert pitch > 0
print(f"after {12 * env.control_dt:.2f} s the nose points up by {pitch:.2f} rad")

# %% [markdown]
# ## The laziest driver
#
# The simplest policy does nothing: all actions are 0, and the wheels roll at the commanded speed.
# These gaps are wider than a wheel. How far does it get?

# %%
from fgtutor.course.drives import Scripted, straight_route
from fgtutor.execution import FollowConfig, execute
from fgtutor.figures.videos import film_strip


def roll(observations):
    return torch.zeros(len(observations), 4)


route = straight_route(terrain, "roll")  # from start to goal along x
patience = FollowConfig(patience=1.5, grace=2.0)  # time limit: 1.5 x length / speed + 2 s
driver = Scripted(roll)  # a plain function in the place of a trained policy
episode = execute(route, terrain, {"roll": driver}, config=patience)
assert episode.reason == "fell"
episode

# %%
film_strip(episode, terrain, route, count=4)

# %% [markdown]
# *What to see:* it is perfect on the flat and ends in the first gap.
#
# ## How well does it do what it is told?
#
# We need one number for each moment. The paper's is the **velocity tracking reward** (Sec. III-A):
#
# $$
# r_v = \exp\left(-\frac{\lVert v - \hat v \rVert_2}{\sigma}\right),
# \qquad \sigma = 0.25\ \text{m/s}
# \tag{1}
# $$
#
# It is 1 when the velocity $v$ is the commanded $\hat v$. The norm is not squared, so it falls off
# *steeply*: an error of $\sigma$ leaves $e^{-1} = 0.37$. The value is the paper's;
# a larger $\sigma$ would forgive more.
# Told 0.85 m/s, a robot that is a tenth too slow still earns 0.71, one that stands 0.03.

# %%
from fgtutor.feasibility import tracking_reward
from fgtutor.figures.charts import draw_curves

v_hat = torch.tensor([0.85, 0.0])
speeds = torch.linspace(-0.2, 1.8, 201)
v = torch.stack((speeds, torch.zeros_like(speeds)), dim=-1)
draw_curves(
    speeds,
    {"r_v": tracking_reward(v, v_hat)},
    title=f"r_v, told to drive {v_hat[0]:.2f} m/s",
    xlabel="speed (m/s)",
    ylabel="r_v",
)

# %% [markdown]
# **Your line.** How large an error, in m/s, halves the reward? Solve Eq. 1 for $r_v = 0.5$.

# %%
import math

sigma = 0.25
error = ...  # a formula of sigma; math.log is the natural logarithm

if error is ...:
    print("Not filled in yet. Take the logarithm of both sides of exp(-error / sigma) = 0.5.")
else:
    got = tracking_reward(v_hat + torch.tensor([error, 0.0]), v_hat).item()
    assert math.isclose(got, 0.5, abs_tol=1e-4), f"an error of {error} gives r_v = {got:.3f}"
    print(f"Right: {error:.3f} m/s.")

# %% [markdown]
# Slide the speed and $\sigma$:

# %%
from fgtutor.course.widgets.slides import TrackingSlides

TrackingSlides()

# %% [markdown]
# A robot that does not move still earns $e^{-0.85/0.25} = 0.03$. So by rule a *failed* robot earns
# exactly 0: a fall must never look better than it is.
#
# ## Anything goes
#
# The opposite of doing nothing is doing *something*, at random.

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "Random actions, on the flat before the first gap: which driver has the higher mean r_v?",
    ["roll, which does nothing", "flail, which acts at random", "about the same"],
)

# %%
generator = torch.Generator().manual_seed(0)


def flail(observations):
    return 2 * torch.rand(len(observations), 4, generator=generator) - 1


route = straight_route(terrain, "flail")
flailing = execute(route, terrain, {"flail": Scripted(flail)}, config=patience)
print("roll: ", episode)
print("flail:", flailing)

# %%
import numpy as np


def tracking(driven):  # r_v of each step, from the distance driven in it
    speed = np.gradient(driven.poses[:, 0], env.control_dt)
    v = torch.tensor(np.stack((speed, np.zeros_like(speed)), axis=-1), dtype=torch.float32)
    return tracking_reward(v, v_hat)


flat = slice(0, 20)  # the first 0.8 s
rolled, flailed = (tracking(one)[flat].mean().item() for one in (episode, flailing))
assert rolled > flailed
reveal(
    f"roll: {rolled:.2f} against {flailed:.2f}. Both fell, but r_v tells them apart before that."
)

# %% [markdown]
# Here is `roll` once more, on low steps that it survives, with its $r_v$ along the route.

# %%
from fgtutor.figures.charts import draw_tracking

steps = make_terrain("steps", robot="toy", difficulty=0.6, seed=2)
bumpy = execute(straight_route(steps, "roll"), steps, {"roll": driver}, config=patience)
earned = tracking(bumpy)
draw_tracking(bumpy, steps, 0.85, earned)

# %%
profile = steps.elevation.heights[:, steps.elevation.shape[1] // 2]
first_edge = (np.flatnonzero(np.diff(profile))[0] + 1) * steps.elevation.resolution
moving = 8  # steps; before, it starts from rest
first_dip = bumpy.poses[moving + (earned[moving:] < 0.5).int().argmax(), 0]
print(f"first edge at x = {first_edge:.2f} m; r_v first falls below 0.5 at x = {first_dip:.2f} m")
assert first_dip < first_edge, "the front wheel should feel the edge before the centre is there"

# %% [markdown]
# *What to see:* $r_v$ is near 1 on the flat and dips at every edge. It dips *before* x reaches the
# edge, since x is the robot's centre, and its front wheel is 25 cm ahead of it. Remember this
# picture: **in notebook 03 we predict $r_v$ from the patch alone, and the whole planner runs on
# that prediction.**

# %% [markdown]
# ## Learning to drive: PPO in one page
#
# A small network, the policy $\pi_\theta$, turns the observation $o_t$ into the mean of the action
# $a_t$. While it learns, noise is added to the mean, so that it tries things out. Many robots drive
# side by side for a while (a *rollout*). Then three things happen.
#
# **1. How good was each action?** A second network, the *critic* $V(o)$, learns what reward to
# expect. The *advantage* adds up by how much each step exceeded that, later steps counting less
# (generalised advantage estimation, GAE):
#
# $$
# A_t = \sum_{l \ge 0} (\gamma\lambda)^l\, \delta_{t+l},
# \qquad
# \delta_t = r_t + \gamma V(o_{t+1}) - V(o_t),
# \qquad \gamma = 0.98,\ \lambda = 0.95 .
# $$
#
# **2. Make good actions more likely, but not by much.** With the ratio of new to old probability
# $\rho_t = \pi_\theta(a_t \mid o_t) / \pi_{\theta_\text{old}}(a_t \mid o_t)$, PPO maximises
#
# $$
# L = \operatorname{mean}_t\ \min\bigl(\rho_t A_t,\
# \operatorname{clip}(\rho_t, 1 - \epsilon, 1 + \epsilon)\, A_t\bigr), \qquad \epsilon = 0.2 .
# $$
#
# Beyond $1 \pm \epsilon$ there is nothing more to gain: the data was collected by the old policy,
# and says little about a very different one. This is the *proximal* in Proximal Policy Optimization
# (Schulman et al., 2017; the code is [rsl_rl](https://github.com/leggedrobotics/rsl_rl)'s; more in
# [derivations](../docs/derivations.md)).

# %%
ratio = torch.linspace(0.4, 1.6, 121)
clipped = ratio.clip(0.8, 1.2)
objective = {f"A = {A:+d}": torch.minimum(ratio * A, clipped * A) for A in (1, -1)}
draw_curves(
    ratio,
    objective,
    title="PPO's clip: what a larger or smaller probability earns",
    xlabel="ratio of probabilities, new over old",
    ylabel="objective",
)

# %% [markdown]
# *What to see:* a good action (A = +1) earns nothing more above 1.2; a bad one (A = -1) nothing
# more below 0.8. But the penalty for a bad action that became *more* likely has no limit.
#
# **3. Fit the critic** to the rewards that really came. Then the next rollout begins.
#
# The toy's reward is $r_v$ and four smaller terms; $\omega$ is the rate of pitch:
#
# $$
# r = r_v + \tfrac12\, e^{-(v - \hat v)^2 / 0.5} - 0.02\, \lVert a_t - a_{t-1} \rVert^2
# - 0.002\, \omega^2 - 5\, [\text{failed}]
# $$
#
# The second term has a slope even where $r_v$ is almost 0. Robots start on nearly flat ground, and
# those that cross it move on to a harder row: that is the *curriculum*.

# %%
from pathlib import Path

from fgtutor.course.notebooks import budget

iterations = budget(fast=40, full=85, unit="iterations with 128 robots", each=1.4)
out = Path("runs") / f"02-gaps-{iterations}"

# %%
predict(
    "The robots move on to harder ground as they learn. What will the curve of r_v do?",
    ["climb all the time", "climb, then stay about level or fall", "fall all the time"],
)

# %% [markdown]
# Now watch. The top curve is $r_v$, the middle one says how hard the ground is by now, the lowest
# belongs to notebook 03. Stop it when you like: the next run of this cell goes on from there.

# %%
from fgtutor import train
from fgtutor.course.widgets.live_curve import LiveCurve
from fgtutor.learning.training import TrainConfig

live = LiveCurve()
config = TrainConfig(
    terrain="gaps",
    iterations=iterations,
    num_envs=128,
    save_every=20,
    out=out,
    resume=(out / "checkpoint.pt").exists(),
)
mine = train(config, on_iteration=live)
live.draw(mine.provenance["curve"])

# %%
curve = mine.provenance["curve"]
before, after = curve[0], curve[-1]
assert after["row"] > before["row"] or len(curve) < 40  # unless you stopped it early
reveal(
    f"r_v went from {before['r_v']:.2f} to {after['r_v']:.2f} only, while the mean row went from "
    f"{before['row']:.1f} to {after['row']:.1f}: the robots got better, and so did their ground."
)

# %% [markdown]
# So a training curve alone never tells you how good a policy is. A test does.

# %% [markdown]
# ## The exam
#
# New gaps that no driver was trained on, the same for all: narrow, medium, and the widest of the
# course. How many courses does each driver cross? `gaps` is the policy that ships with this course:
# same code, same network, trained longer.

# %%
from fgtutor import load_zoo  # loads the robots: some seconds, once

trials = budget(fast=12, full=40, unit="trials per driver and width", each=0.45)
shipped = load_zoo("toy")["gaps"]
drivers = {"roll": driver, "flail": Scripted(flail), "mine": mine, "gaps": shipped}
more = shipped.provenance["samples"] / mine.provenance["samples"]
print(f"gaps was trained on {more:.0f} times as many samples as mine")

# %%
predict(
    "Where will the longer training of `gaps` show?",
    ["at all widths", "only at the wider gaps", "nowhere: mine is as good"],
)

# %%
from fgtutor.execution import execute_batch
from fgtutor.statistics import Share


def exam(difficulty, name, driver):
    seeds = range(1, 2 * trials, 2)
    tiles = [make_terrain("gaps", robot="toy", difficulty=difficulty, seed=i) for i in seeds]
    routes = [straight_route(tile, name) for tile in tiles]
    drives = execute_batch(routes, tiles, {name: driver}, seeds=range(trials), config=patience)
    return Share(successes=sum(drive.success for drive in drives), trials=trials)


widths = {"narrow gaps": 0.5, "medium gaps": 0.75, "the widest gaps": 1.0}
passed = {
    label: {name: exam(difficulty, name, one) for name, one in drivers.items()}
    for label, difficulty in widths.items()
}

# %%
from fgtutor.figures.charts import draw_shares

draw_shares(passed, title="Who crosses gaps it has never seen?")

# %%
easy, hard = passed["narrow gaps"], passed["the widest gaps"]
if 40 <= len(curve) <= 85:  # shorter or longer trainings of yours may differ
    assert easy["mine"].successes > easy["roll"].successes
    assert hard["gaps"].successes > hard["mine"].successes
reveal("At the widest gaps. On narrow and medium ones a short training is enough.")

# %% [markdown]
# *What to see:* the black lines are 95 % intervals. Where two of them overlap widely, these trials
# do not say which driver is better. Now look at the expert on the widest gaps:

# %%
widest = make_terrain("gaps", robot="toy", seed=1)
route = straight_route(widest, "gaps")
expert = execute(route, widest, {"gaps": shipped})
assert expert.success
film_strip(expert, widest, route, count=8)

# %% [markdown]
# Look at what it does with its legs before, over and after a gap. Nobody told it how: the reward
# names only the velocity and smoothness.
#
# It has become a **specialist**. Put it before a high ledge, and it is lost. Whether anything can
# *know* that beforehand is the question of notebooks 03 and 04.

# %% [markdown]
# ## What you now know
#
# - A policy maps observations to actions; $r_v$ (Eq. 1) says in one number, from 0 to 1, how well
#   it tracks its command.
# - PPO makes actions with a positive advantage more likely, within $1 \pm \epsilon$ per update.
# - With a curriculum, a flat curve can be progress. Only a test on new ground tells.
#
# **Test yourself**
#
# <details><summary>1. A robot told to drive 1 m/s drives 1.5 m/s. What is its r_v?</summary>
#
# $e^{-0.5/0.25} = e^{-2} = 0.14$. Too fast is as bad as too slow.
# </details>
#
# <details><summary>2. What would PPO lose without the min, with the clipped term alone?</summary>
#
# A bad action (A = -1) whose probability has doubled would cost 1.2, however likely it became, and
# with no slope: nothing would push it back.
# </details>
#
# <details><summary>3. GAE with lambda = 0: what is left of A_t?</summary>
#
# $\delta_t = r_t + \gamma V(o_{t+1}) - V(o_t)$: one step, the rest is believed to the critic.
# Little noise, but as wrong as the critic is.
# </details>

# %% [markdown]
# ## What to try
#
# - Let it train on: raise `iterations` (the run folder's name changes with it, so this is a new
#   run), or train from a shell with `fgtutor train --robot toy --terrain gaps`.
#   <details><summary>What to expect</summary>The middle curve goes on climbing, and the exam's
#   wider gaps are crossed one width after the other.</details>
# - Train on `"slopes"`. Why do fewer episodes fail there?
#   <details><summary>Answer</summary>A slope slows the robot down, but hardly ever tips it over or
#   drops a wheel into a hole: the cost of a mistake is a lower r_v, not the end.</details>
# - Make a film instead of a strip: `save_video(expert, widest, route, "runs/gaps.mp4")` from
#   `fgtutor.figures.videos`.
# - Write a better driver than `roll` by hand: lengthen the front leg when the middle line of the
#   patch, `observations["policy"][:, -18:]`, falls ahead. How far do you get?
#   <details><summary>A hint</summary>Point 5 of the 18 is under the robot, each next one is 10 cm
#   further ahead, and the heights are multiplied by 4.</details>
#
# **Exercises:** [exercises/ex02.ipynb](../exercises/ex02.ipynb). **Next:** predict $r_v$ before
# you go there, [03_feasibility_net.ipynb](03_feasibility_net.ipynb).
