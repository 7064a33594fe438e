# %% [markdown]
# # 02 · A robot that falls
#
# - **You will be able to** drive a simulated robot, say in one number how well it does what it is
#   told, and train it with PPO while you watch
# - **Time** half an hour to read; about 3 minutes on two CPU cores, 2 of them training
# - **Needs** notebook [01](01_elevation_maps.ipynb) for the words *map* and *patch*; no GPU, no
#   network
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: the training then
#   takes a minute at most and learns less. Stop it at any time with the stop button: what it has
#   learned by then is kept, and running the cell again goes on
#
# Before you plan with what a robot can do, meet a robot, and let it fail.

# %% [markdown]
# ## The toy
#
# Two wheels on legs that can lengthen and shorten, under a box: a robot that lives in the
# *vertical slice* of the map along its heading. Its physics is 2-D
# ([pymunk](https://www.pymunk.org)), so a thousand seconds of it cost a few seconds; but it
# drives on the same maps, over the same patches and to the same commands as the four-legged robot
# of the second half of the course. Up a ledge, down it and along it are three different things
# for it too.

# %%
from fgtutor import make_terrain
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import World

terrain = make_terrain("gaps", robot="toy", seed=2)
env = ToyEnv(World([[terrain]]), num_envs=1, config=EnvConfig(train=False))

# %% [markdown]
# An environment answers two questions. What do you sense?

# %%
observations = env.get_observations()
{name: tuple(values.shape) for name, values in observations.items()}

# %% [markdown]
# - `policy`: what its controller gets: the robot's own body, the command, and the ground right in
#   its path;
# - `patch`: the patch $H_{x,y}$ of notebook 01 at the robot's pose (the toy's grid is long and
#   narrow);
# - `command`: the velocity it should drive, forwards, sideways and turning;
# - `tracking`: how the last step went. That one carries this whole course, see below.
#
# And: what happens if you do this? An action is four numbers between -1 and 1: push the rear
# wheel, push the front wheel, stretch the rear leg, stretch the front leg.

# %%
import torch

action = torch.tensor([[0.0, 0.0, -1.0, 1.0]])  # rear leg short, front leg long
for _ in range(12):
    observations, reward, done, _ = env.step(action)
pose, velocity = env.motion()
print(f"after {12 * env.control_dt:.2f} s the nose points up by {env.state[0, 0, 2]:.2f} rad")

# %% [markdown]
# ## The laziest driver
#
# Every *policy* is a function from observations to actions. The simplest: do nothing, and let the
# wheels roll at the commanded speed. How far does it get over gaps?

# %%
from fgtutor.course.drives import Scripted, straight_route
from fgtutor.execution import FollowConfig, execute
from fgtutor.figures.videos import film_strip


def roll(observations):
    return torch.zeros(len(observations), 4)


route = straight_route(terrain, "roll")
patience = FollowConfig(patience=1.5, grace=2.0)
episode = execute(route, terrain, {"roll": Scripted(roll)}, config=patience)
episode

# %%
film_strip(episode, terrain, route, count=6)

# %% [markdown]
# *What to see:* on the flat it is perfect. Then a wheel meets a gap that is wider than the wheel
# is, and that is that.
#
# ## Anything goes
#
# The other extreme: do *something*, at random.

# %%
generator = torch.Generator().manual_seed(0)


def flail(observations):
    return 2 * torch.rand(len(observations), 4, generator=generator) - 1


route = straight_route(terrain, "flail")
flailing = execute(route, terrain, {"flail": Scripted(flail)}, config=patience)
print(flailing)
film_strip(flailing, terrain, route, count=6)

# %% [markdown]
# ## How well does it do what it is told?
#
# We need one number, at every moment, that says how well the robot follows its command. The
# paper's is the **velocity tracking reward**:
#
# $$
# r_v = \exp\left(-\frac{\lVert v - \hat v \rVert_2}{\sigma}\right), \quad \sigma = 0.25\
# \text{m/s}
# $$
#
# It is 1 when the velocity $v$ is the commanded $\hat v$, and falls off *steeply*: note that the
# norm is not squared.

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
# A robot that stands still still gets a little. So a *failed* robot gets exactly 0, by rule: a
# fall must never look better than it is.
#
# Here is the rolling robot once more, on low steps which it survives, with its $r_v$ along the
# way.

# %%
import numpy as np

from fgtutor.figures.charts import draw_tracking

steps = make_terrain("steps", robot="toy", difficulty=0.6, seed=2)
bumpy = execute(straight_route(steps, "roll"), steps, {"roll": Scripted(roll)}, config=patience)
speed = np.gradient(bumpy.poses[:, 0], env.control_dt)
v = torch.tensor(np.stack((speed, np.zeros_like(speed)), axis=-1), dtype=torch.float32)
draw_tracking(bumpy, steps, 0.85, tracking_reward(v, v_hat))

# %% [markdown]
# *What to see:* $r_v$ is near 1 on the flat and dips at every edge. It reads the ground like a
# needle. Remember that: **in notebook 03 we will predict this number from the patch alone, and
# that prediction is what the whole planner runs on.**

# %% [markdown]
# ## Learning to drive: PPO in four sentences
#
# A small network gets the observations and gives the mean of each action; we draw actions around
# that mean, so that it tries things out. Many robots drive side by side for a while (a
# *rollout*). Actions that led to more reward than expected become more likely, the others less; a
# second network, the *critic*, learns what to expect. And no single update may change the policy
# by much (the *proximal* in Proximal Policy Optimization), because the data was collected by the
# old one.
#
# The reward is $r_v$, plus some small terms. The robots start on nearly flat ground, and whoever
# crosses it moves on to a harder row: that is the *curriculum*.

# %%
from pathlib import Path

from fgtutor.course.notebooks import budget

iterations = budget(fast=40, full=85, unit="iterations with 128 robots", each=1.4)
out = Path("runs") / f"02-gaps-{iterations}"

# %% [markdown]
# Now watch. The upper curve is $r_v$, the middle one says how hard the ground is by now, the
# lowest belongs to notebook 03. Stop it when you like: the next run of this cell goes on from
# there.

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

# %% [markdown]
# *What to see:* $r_v$ first climbs; then it may well fall again while the middle curve climbs:
# the robots are not getting worse, their ground is getting harder. A single curve never tells you
# how good a policy is. A test does.

# %% [markdown]
# ## The exam
#
# New gaps that nobody was trained on, the same for everyone: how many courses does each driver
# cross? With so few trials, an honest answer is an interval.

# %%
from fgtutor import load_zoo
from fgtutor.execution import execute_batch

trials = budget(fast=20, full=60, unit="trials for each driver", each=0.15)
exam = [make_terrain("gaps", robot="toy", difficulty=0.5, seed=2 * i + 1) for i in range(trials)]
shipped = load_zoo("toy")["gaps"]
drivers = {"roll": Scripted(roll), "flail": Scripted(flail), "mine": mine, "gaps": shipped}

# %%
passed = {}
for name, driver in drivers.items():
    routes = [straight_route(ground, name) for ground in exam]
    drives = execute_batch(routes, exam, {name: driver}, seeds=range(trials), config=patience)
    passed[name] = (sum(drive.success for drive in drives), trials)

# %%
from fgtutor.figures.charts import draw_rates

draw_rates(passed, title="Who crosses gaps it has never seen?")

# %% [markdown]
# *What to see:* compare `mine` with `roll`, and look at the intervals before you cheer: do they
# overlap? `gaps` is the policy that ships with this course. It is the same code and the same
# network, trained longer:

# %%
provenance = shipped.provenance
print(f"{provenance['samples']:,} samples in {provenance['seconds'] / 60:.0f} minutes")
print(f"mine: {mine.provenance['samples']:,} samples")

# %%
widest = make_terrain("gaps", robot="toy", seed=1)
route = straight_route(widest, "gaps")
expert = execute(route, widest, {"gaps": shipped})
print(expert)
film_strip(expert, widest, route, count=12)

# %% [markdown]
# These are the widest gaps that the course has. Look at what it does with its legs and its speed
# before, over and after a gap. Nobody told it. All it was ever told is $r_v$.
#
# It has also become a **specialist**. Put it before a high ledge, and it knows nothing. Whether
# it *knows that it knows nothing* is the question of notebooks 03 and 04.

# %% [markdown]
# ## What to try
#
# - Let it train on: raise `iterations` (the run folder's name changes with it, so this is a new
#   run), or train from a shell with `fgtutor train --robot toy --terrain gaps`.
# - Train on `"slopes"`. Which of the curves look different, and why do fewer episodes fail?
# - Make a film instead of a strip: `save_video(expert, widest, route, "gaps.mp4")` from
#   `fgtutor.figures.videos`.
# - Write a better driver than `roll` by hand: stretch both legs when the middle of the patch says
#   so. How far do you get?
#
# **Exercises:** [exercises/ex02.ipynb](../exercises/ex02.ipynb). **Next:** predict $r_v$ before
# you go there, [03_feasibility_net.ipynb](03_feasibility_net.ipynb).
