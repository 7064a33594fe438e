# %% [markdown]
# # 08 · Meet the A1
#
# - **You will be able to** say what a simulated legged robot is made of, what its policy senses,
#   commands and is rewarded for, and steer a trained one by slider
# - **Time** 45 minutes to read and try; about half a minute on two CPU cores
# - **Needs** notebooks [01](01_elevation_maps.ipynb) to [07](07_drive_the_plan.ipynb) for the
#   ideas; uses the shipped specialists. No GPU. The robot's pictures need a graphics library that
#   draws without a window (EGL, OSMesa); where there is none you get stick figures
# - **If a part is slow** only the last section simulates for more than a moment; without a
#   graphics card, a picture of the robot takes a tenth of a second
#
# So far we had a toy. Here is the robot of the paper (Sec. IV): the Unitree A1, four legs, twelve
# motors, simulated in MuJoCo. The functions that plan and drive are the same.
#
# Symbols and references are on the [notation page](../docs/notation.md); equation numbers are the
# paper's.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=8)

# %% [markdown]
# ## A robot is a page of constants
#
# A simulator needs lengths, masses, inertias and limits. They come from the maker's own
# description; `fgtutor/robots/a1/model.py` names the source of each.

# %%
from fgtutor.robots.a1.model import JOINTS, build_spec

model = build_spec().compile()
print(f"{model.body_mass.sum():.1f} kg, {model.nv} degrees of freedom, {model.nu} motors")
print(", ".join(JOINTS))
assert model.nv - model.nu == 6

# %% [markdown]
# In the names, the first letter is front or rear, the second right or left. In each leg the
# **hip** swings the leg sideways, the **thigh** swings it forwards and backwards, and the **calf**
# bends the knee. Six degrees of freedom have no motor: the trunk's position and its tilt. *To walk
# is to move what has no motor by means of what has.*

# %%
from fgtutor.course.a1_pictures import draw_postures

stance = model.key_qpos[0]
spread = stance.copy()
spread[7::3] += (-0.4, 0.4, -0.4, 0.4)  # hips
sitting = stance.copy()
sitting[[14, 17]], sitting[[15, 18]] = 1.6, -2.6  # rear thighs and calves
draw_postures({"the stance": stance, "hips spread": spread, "rear knees bent": sitting})

# %% [markdown]
# *What to see:* twelve angles are a posture. They do not say where the *trunk* is: in the last
# picture the rear feet hang in the air, and physics would have to lower the tail.

# %% [markdown]
# ## An action is a target for each joint
#
# The policy does not command torques. Fifty times a second it says where each joint *should be*,
# relative to the stance. A spring and a damper in each motor do the rest, two hundred times a
# second (**PD control**). With the joint's angle $q$ and the action $a$,
#
# $$ \text{torque} = k_p\,(q_\text{stance} + 0.5\,a - q) - k_d\,\dot q . $$
#
# Watch one knee. For half a second the action is zero. Then all four knees are told to bend.

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "Once the knee has settled, where is it?",
    ["exactly at its target", "close to its target, but never there"],
)

# %%
from dataclasses import replace

import torch

from fgtutor import load_zoo, make_terrain  # loads the robots: some seconds, once
from fgtutor.robots.a1.env import A1_EPISODES, A1Env
from fgtutor.world.terrain import World

zoo = load_zoo("a1")
steps = zoo["steps"]
still = replace(A1_EPISODES, train=False, history=steps.history)  # nobody draws new episodes
env = A1Env(World([[make_terrain("flat", robot="a1")]]), 1, config=still)

# %%
knee, rows = JOINTS.index("FR_calf"), []
torque = env.physics.derived("actuator_force")
for step in range(75):
    action = torch.zeros(1, 12)
    action[:, 2::3] = -0.8 if step >= 25 else 0.0
    env.step(action)
    target = env.stance[knee] + env.settings.action_scale * action[0, knee]
    rows.append((target.item(), env.q[0, 7 + knee].item(), torque[0, knee].item()))

# %%
import numpy as np

from fgtutor.figures.charts import draw_curves

t = np.arange(len(rows)) * env.control_dt
targets, angles, torques = np.array(rows).T
draw_curves(
    t, {"target": targets, "angle": angles},
    title="The front right knee", xlabel="time (s)", ylabel="angle (rad)",
)  # fmt: skip

# %%
gap = (targets - angles)[-1]
print(f"at the end the gap is {gap:.3f} rad, the torque {torques[-1]:.2f} N m")
assert abs(gap) > 0.01
reveal("close to its target, but never there")
draw_curves(t, {"torque": torques}, title="What it takes", xlabel="time (s)", ylabel="N m")

# %% [markdown]
# *What to see:* the angle follows, overshoots, swings, and never quite arrives. A spring that
# carries weight must be stretched: the gap between target and angle *is* the torque that holds the
# robot up.
#
# **Your line.** At rest $\dot q = 0$. Predict the torque from the gap, with $k_p$ from the model.

# %%
kp = env.model.kp
expected = ...  # a formula of kp and gap

if expected is ...:
    print("Not filled in yet: replace the three dots.")
else:
    assert abs(expected - torques[-1]) < 0.5, "the equation above, with no velocity"
    print(f"Right: {expected:.2f} N m")

# %% [markdown]
# A policy that wants to push has to aim past where it wants to be. It finds that out by itself. And
# an action of zero stands, so a policy that knows nothing yet does not collapse at once.

# %% [markdown]
# ## What it senses
#
# The simulator measures all of this, with the noise of real sensors in training:

# %%
from fgtutor.robots.a1.observation import NOISE, SCAN_GRID

for name, (count, noise, scale) in NOISE.items():
    print(f"{name:12} {count:3} numbers, noise up to {noise:4.2f}, shown to the net times {scale}")
print(f"{'command':12} {env.command.shape[1]:3} numbers")
print(f"{'scan':12} {SCAN_GRID.num_points:3} heights")

# %% [markdown]
# One of these is a privilege of simulators: no sensor of the A1 measures its **velocity**. A robot
# must estimate it, for instance from how its joints and its gyroscope moved in the last moments. In
# DreamWaQ, whose protocol the paper follows, a network does so: it reads the last frames and gives
# an estimate of the velocity, beside a few numbers about the body and the ground. What does our
# specialist do?

# %%
print("it reads the groups:", ", ".join(steps.policy.obs_groups))
if steps.history:
    print(f"it remembers {steps.history} frames, and estimates its velocity from them")
else:
    print("it is told its velocity")
seen = env.get_observations()
print({name: seen[name].shape[1] for name in steps.policy.obs_groups})

# %% [markdown]
# Look at *gravity*. A policy should not care where north is, but it must know **which way
# is down**. So it observes the direction of gravity *as the trunk sees it*. Put four robots on one
# slope, looking four ways:

# %%
from fgtutor import ElevationMap
from fgtutor.world.terrain import Terrain

rise = 0.4 * np.arange(80) * 0.05  # 4 in 10, up along +x
slope = ElevationMap(np.tile(rise[:, None], (1, 80)), resolution=0.05)
hill = Terrain.from_elevation(slope, (1.0, 2.0), (3.0, 2.0), robot="a1")
four = A1Env(World([[hill]]), 4, config=still)
yaws = {"uphill": 0.0, "slope on its right": np.pi / 2, "downhill": np.pi}
yaws["slope on its left"] = -np.pi / 2

# %%
predict("Facing uphill, is the first number (ahead) of gravity positive or negative?")

# %%
x, y = (four.offsets[0, 0] + torch.tensor((2.0, 2.0))).tolist()  # tiles lie somewhere in the world
four.start(torch.arange(4), torch.tensor([(x, y, yaw) for yaw in yaws.values()]), 0.0)
gravity = four.get_observations()["policy"][:, 6:9]
for name, numbers in zip(yaws, gravity.tolist(), strict=True):
    print(f"{name:19} gravity points to ({', '.join(f'{g:+.2f}' for g in numbers)})")
assert gravity[0, 0] < -0.3 and gravity[2, 0] > 0.3
reveal("negative: the nose is up, so down lies a little behind")

# %%
draw_postures(
    dict(zip(yaws, four.drawing(), strict=True)), title="One slope, four headings", plane=True
)

# %% [markdown]
# *What to see:* facing uphill, down lies a little behind. Turn around, and the sign changes. With
# the slope at its side, it is the second number (left) that speaks.

# %% [markdown]
# ## What it sees
#
# There are two windows on the ground, for two readers. The **patch** $H_{x,y}$ is for the
# Feasibility-Net. It counts from the ground under the robot, since a planner has no body. The
# **scan** is for the policy. It looks mostly ahead and counts from the trunk: the policy has to
# know how high *it* stands. Three robots at one place of a flight of steps, for this and the next
# section:

# %%
tile = make_terrain("steps", robot="a1", difficulty=0.6, seed=5)
trio = A1Env(World([[tile]]), 3, config=still)
x, y = tile.start[0] + 1.6, tile.start[1]
place = torch.tensor((x, y)) + trio.offsets[0, 0]
trio.start(torch.arange(3), torch.tensor([[*place.tolist(), 0.0]] * 3), steps.command[0])
seen = trio.get_observations()

# %%
from fgtutor.course.patch_pictures import draw_windows, patch_gallery

draw_windows(tile.elevation, (x, y, 0.0), steps.grid)

# %%
patch_gallery([seen["patch"][0]], steps.grid, ["the patch: what planning asks about"], columns=2)

# %%
from fgtutor.robots.a1.observation import SCAN_SCALE

scan = seen["policy"][0, -SCAN_GRID.num_points :] / SCAN_SCALE
patch_gallery([scan], SCAN_GRID, ["the scan: what the policy walks by"], columns=2)

# %% [markdown]
# ## What it is rewarded for
#
# Reward for tracking alone would teach a robot to fling itself forward. So the reward per second is
# a sum of eleven terms. Let $e$ be the error of the planar velocity (m/s), $\delta$ that of the
# turn rate (rad/s), $\nu^2 = e^2 + (0.35\,\delta)^2$, and $m = 0.2 + 0.8\,e^{-\nu^2/0.25}$, which
# is small unless the robot moves as told.
#
# | term | weight | formula |
# | --- | ---: | --- |
# | tracking | 1.2 | $\exp(-e^2 / 0.1)$ |
# | approach | 0.6 | $\exp(-\nu^2 / 0.25)$: the same, wider |
# | turning | 0.5 | $m \exp(-\delta^2 / 0.25)$ |
# | gait | 1.5 | $m$ times -1 to 1: stand and swing each foot by a clock |
# | posture | 0.5 | $m \exp(-\sum_j w_j (q_j - n_j)^2)$: near the stance, feet close together |
# | orientation | -2 | squared sine of the tilt |
# | bounce | -0.5 | vertical velocity, squared |
# | wobble | -0.02 | roll and pitch rate, squared |
# | limits | -1 | radians beyond the joints' soft limits |
# | jerk | -0.02 | $\lVert a_t - a_{t-1} \rVert^2$ |
# | landing | -0.3 | force on each foot beyond 135 N, per 100 N, at most 2 |
#
# The sum is **floored at zero**. Otherwise a robot that earns less than nothing per step would
# learn to end its costs, by falling. (The labels of the Feasibility-Net stay Eq. 1 alone.)

# %%
from dataclasses import asdict

from fgtutor.robots.a1.rewards import RewardWeights

weights = asdict(RewardWeights())
table = (1.2, 0.6, 0.5, 1.5, 0.5, -2.0, -0.5, -0.02, -1.0, -0.02, -0.3)
assert tuple(weights.values()) == table, weights

# %% [markdown]
# Three robots show it: one walks by the shipped `steps` policy, one stands still, one flails.

# %%
predict("Per second, how much does the robot earn that stands still?", ["nothing", "some", "most"])

# %%
generator = torch.Generator().manual_seed(0)
terms, loads = [], []
for _ in range(125):
    actions = torch.zeros(3, 12)
    actions[0] = steps.act(trio.get_observations())[0]
    actions[2] = 2 * torch.rand(12, generator=generator) - 1
    trio.step(actions)
    terms.append(trio.reward_terms())
    loads.append(trio.sensed[0, trio.sensors["foot_force"]].reshape(4, 3).norm(dim=-1))

# %%
from fgtutor.course.a1_pictures import draw_terms

earned = {
    name: {term: np.mean([row[term][i].item() for row in terms]) for term in weights}
    for i, name in enumerate(("walks", "stands", "flails"))
}
draw_terms(earned)

# %%
sums = {name: round(float(sum(one.values())), 2) for name, one in earned.items()}
print(sums)
assert sums["walks"] > 2 * sums["stands"] > 0 and sums["walks"] > sums["flails"]
reveal("some")

# %% [markdown]
# *What to see:* the sums at the bottom. Standing still earns a little, since terms for style also
# pay a robot that waits. That is why $m$ makes them small: *robots learn to hesitate in front of
# hard places when rewards are careless.*
#
# The term *gait* asks for diagonal pairs of feet, by a clock. Did the robot listen?

# %%
from fgtutor.course.a1_pictures import draw_gait

FR, FL, RR, RL = (torch.stack(loads) > 10.0).T  # newtons: the foot stands
pairs, sides = (FR == RL).float().mean(), (FR == FL).float().mean()
assert pairs > 0.6 > sides
draw_gait(torch.stack(loads), trio.control_dt)

# %% [markdown]
# *What to see:* mostly FR and RL stand together, then FL and RR: a **trot**. On obstacles the
# pattern becomes irregular, and should.

# %% [markdown]
# ## Half of the experience for free
#
# An A1 is its own mirror image. What it learns on its left it should know on its right. So the
# policy is *built* symmetric: mirror what it observes, and it answers with the mirrored action,
# exactly. Mirror swaps left and right numbers and changes some signs:

# %%
from fgtutor.robots.a1.model import MIRROR, MIRROR_SIGNS

index, sign = list(A1Env.mirror.observation_index), torch.tensor(A1Env.mirror.observation_sign)


def mirrored(groups):
    image = groups.clone()
    image["policy"] = groups["policy"][:, index] * sign
    if steps.history:  # each frame of the memory is a part of what `policy` holds
        frames = torch.zeros(len(groups), steps.history, len(index))
        frames[..., A1Env.felt] = groups["history"].unflatten(1, (steps.history, -1))
        image["history"] = (frames[..., index] * sign)[..., A1Env.felt].flatten(1)
        image["scan"] = image["policy"][:, -SCAN_GRID.num_points :]
    return image


# %%
before = trio.get_observations()
expected = steps.act(before)[:, list(MIRROR)] * torch.tensor(MIRROR_SIGNS)
difference = (steps.act(mirrored(before)) - expected).abs().max()
assert difference < 1e-4
print(f"largest difference: {difference:.1e}")

# %%
posture = trio.drawing()[0]
posture[3:7] = (1.0, 0.0, 0.0, 0.0)
image = posture.copy()
image[7:] = posture[7:][list(MIRROR)] * MIRROR_SIGNS
draw_postures({"as it walks": posture, "in the mirror": image})

# %% [markdown]
# *What to see:* left and right legs have changed places. Hips have changed their sign; thighs and
# calves have not.

# %% [markdown]
# ## Drive it
#
# The policy takes commands: so much forwards, so much turning. It does not know what a route is.
# Here is a drive by hand: straight on, a curve to the left, a curve to the right.

# %%
from fgtutor.course.a1_pictures import A1View, show_walk
from fgtutor.course.drives import straight_route
from fgtutor.course.widgets.driving import Drive

ground = make_terrain("steps", robot="a1", difficulty=0.3, seed=5)
drive = Drive(ground, {"steps": steps}, render=A1View(ground))
for turn, seconds in ((0.0, 1.5), (0.6, 2.0), (-0.6, 2.0)):
    drive.turn = turn
    drive.advance(seconds)
assert not drive.fallen
print(drive.status)

# %%
show_walk(drive.episode, ground, straight_route(ground, "steps"))

# %% [markdown]
# With a running kernel it is your turn: choose a policy, press play, and move the sliders. They
# reach further than the robot was trained for, so that you can feel where that ends.

# %%
from fgtutor.course.widgets.jupyter import DriveA1

DriveA1(ground, zoo, render=A1View(ground))

# %% [markdown]
# ## What you now know
#
# - Twelve joint angles, six coordinates without a motor; actions are targets for PD controllers.
# - At rest the gap between target and angle is the torque divided by $k_p$.
# - The policy reads ten frames of its body, the command and a scan. From the frames it estimates
#   its velocity, which no sensor measures. The Feasibility-Net reads the patch and the command.
# - Rewards are a weighted sum, floored at zero. Style pays only in motion.
# - The policy is symmetric by construction.
#
# **Test yourself**
#
# <details><summary>1. k_p is halved. What happens to the gap at rest, and to the torque?</summary>
#
# The torque stays: it has to carry the same weight. So the gap doubles.
# </details>
#
# <details><summary>2. Why does the patch count from the ground, the scan from the trunk?</summary>
#
# A planner asks about places where no robot stands, so there is no trunk to count from. The policy
# needs to know how far its feet must reach.
# </details>
#
# <details><summary>3. What would a robot learn if the reward were not floored at zero?</summary>
#
# Where each second costs more than it earns, ending the episode early pays: it would learn to fall.
# </details>

# %% [markdown]
# ## What to try
#
# - Build `A1Env(..., model=A1Config(kp=17.5))` (`fgtutor.robots.a1.model`) and repeat the knee.
#   <details><summary>Answer</summary>The gap at rest doubles, the robot stands lower, and the swing
#   after the step is slower.</details>
# - Drive backwards: pull the speed slider below zero. Was it trained for that?
#   <details><summary>Answer</summary>No: commands in training go ahead, and the scan looks mostly
#   ahead. The Feasibility-Net was not trained on it either, so its answer means nothing.</details>
# - Print `trio.reward_terms()` after each step until a robot falls. Which term notices first?
#   <details><summary>Answer</summary>Usually orientation and wobble, a few steps before the end;
#   tracking falls when the feet have lost their grip.</details>
# - See the model live in 3-D: MuJoCo brings a viewer for the browser. It prints the address to
#   open; `viewer.close()` ends it. It asks for no password, so use it on your own machine only.
#
# ```python
# from mujoco.studio import launch_web
#
# viewer = launch_web.launch()
# viewer.set_model(model)
# ```
#
# **Exercises:** [exercises/ex08.ipynb](../exercises/ex08.ipynb). **Next:** train a specialist,
# [09_train_a_specialist.ipynb](09_train_a_specialist.ipynb).
