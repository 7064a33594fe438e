# %% [markdown]
# # 08 · Meet the A1
#
# - **You will be able to** say what a simulated legged robot is made of, what its policy feels,
#   commands and is paid for, and steer a trained one by slider
# - **Time** half an hour to read and play; about half a minute on two CPU cores
# - **Needs** notebooks [01](01_elevation_maps.ipynb) to [07](07_drive_the_plan.ipynb) for the
#   ideas; uses the shipped specialists. No GPU. The robot's pictures need a graphics library that
#   draws without a window (EGL, OSMesa); where there is none you get stick figures
# - **If a part is slow** only the last section simulates for more than a moment; without a
#   graphics card, a picture of the robot takes a tenth of a second
#
# Everything so far was told with a toy. Here is the robot of the paper: the Unitree A1, four legs,
# twelve motors, simulated in MuJoCo. The functions that plan and drive are the same, to the letter.

# %% [markdown]
# ## A robot is a page of constants
#
# A simulator wants to know lengths, masses, inertias and limits, and nothing else. They all come
# from the maker's own description; `fgtutor/robots/a1/model.py` names the source of each.

# %%
from fgtutor.robots.a1.model import JOINTS, build_spec

model = build_spec().compile()
print(f"{model.body_mass.sum():.1f} kg, {model.nv} degrees of freedom, {model.nu} motors")
print(", ".join(JOINTS))

# %%
for name in ("trunk", "FR_hip", "FR_thigh", "FR_calf"):
    print(f"{name:9} {model.body(name).mass.item():6.3f} kg")

# %% [markdown]
# F is front and R is rear; R is right and L is left. In each leg the **hip** swings the leg
# sideways, the **thigh** swings it forwards and backwards, and the **calf** bends the knee. Six
# degrees of freedom have no motor: those are the trunk's place and tilt. *To walk is to move what
# has no motor by what has.*

# %%
from fgtutor.course.a1_pictures import draw_postures

stance = model.key_qpos[0]
spread = stance.copy()
spread[7::3] += (-0.4, 0.4, -0.4, 0.4)  # hips
sitting = stance.copy()
sitting[[14, 17]], sitting[[15, 18]] = 1.6, -2.6  # rear thighs and calves
draw_postures({"the stance": stance, "hips spread": spread, "rear knees bent": sitting})

# %% [markdown]
# *What to see:* twelve angles are a posture. Where the *trunk* is they do not say: in the last
# picture the rear feet hang in the air, and physics would have to lower the tail.

# %% [markdown]
# ## An action is a place to go to
#
# The policy does not command torques. Fifty times a second it says where each joint *should be*,
# relative to the stance, and a spring and a damper in each motor do the rest, two hundred times a
# second:
#
# $$ \tau = k_p\,(q_\text{stance} + 0.5\,a - q) - k_d\,\dot q $$
#
# Watch one knee. For half a second the action is zero; then all four knees shall bend.

# %%
from dataclasses import replace

import torch

from fgtutor import make_terrain
from fgtutor.robots.a1.env import A1_EPISODES, A1Env
from fgtutor.world.terrain import World

still = replace(A1_EPISODES, train=False)  # nobody draws new episodes for us
flat = make_terrain("flat", robot="a1")
env = A1Env(World([[flat]]), 1, config=still)

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
draw_curves(t, {"torque": torques}, title="What it takes", xlabel="time (s)", ylabel="N m")

# %% [markdown]
# *What to see:* the angle follows, overshoots, swings, and then *never quite arrives*. A spring
# that carries weight must be stretched: the gap between target and angle *is* the force that holds
# the robot up. A policy that wants to push has to aim past where it wants to be. It finds that out
# by itself.
#
# And note what zero means: an action of zero stands. A policy that knows nothing yet at least does
# not collapse.

# %% [markdown]
# ## What it feels
#
# No robot is told where on earth it is. It feels its own body, with the noise of real sensors.
# (Only its velocity no sensor of the A1 measures: a real robot has to estimate it.)

# %%
from fgtutor.robots.a1.observation import NOISE, SCAN_GRID

for name, (count, noise, scale) in NOISE.items():
    print(f"{name:12} {count:3} numbers, noise up to {noise:4.2f}, shown to the net times {scale}")
print(f"{'command':12} {env.command.shape[1]:3} numbers")
print(f"{'scan':12} {SCAN_GRID.num_points:3} heights")
env.get_observations()["policy"].shape

# %% [markdown]
# *Gravity* deserves a look. A policy should not care where north is, but it must know **which way
# is down**. So it observes the direction of gravity *as the trunk sees it*. Put four robots on one
# slope, looking four ways:

# %%
from fgtutor import ElevationMap
from fgtutor.world.terrain import Terrain

rise = 0.4 * np.arange(80) * 0.05  # 4 in 10, up along +x
slope = ElevationMap(np.tile(rise[:, None], (1, 80)), resolution=0.05)
hill = Terrain.from_elevation(slope, (1.0, 2.0), (3.0, 2.0), robot="a1")
four = A1Env(World([[hill]]), 4, config=still)
ways = {"up the slope": 0.0, "slope on its right": np.pi / 2, "down": np.pi}
ways["slope on its left"] = -np.pi / 2

# %%
middle = four.offsets[0, 0] + torch.tensor((2.0, 2.0))
poses = torch.tensor([(*middle.tolist(), yaw) for yaw in ways.values()], dtype=torch.float32)
four.start(torch.arange(4), poses, 0.0)
down = four.get_observations()["policy"][:, 6:9]
for way, (x, y, z) in zip(ways, down.tolist(), strict=True):
    print(f"{way:19} down is ({x:+.2f}, {y:+.2f}, {z:+.2f})")

# %%
draw_postures(dict(zip(ways, four.drawing(), strict=True)), title="One slope, four headings")

# %% [markdown]
# *What to see:* facing uphill, the nose is up, and down lies a little *behind* (a negative first
# number). Turn around, and the sign turns. With the slope at its side it is the second number that
# speaks.

# %% [markdown]
# ## What it sees
#
# Two windows on the ground, for two readers. The **patch** $H_{x,y}$ is for the Feasibility-Net,
# and counts from the ground under the robot, since a planner has no body. The **scan** is for the
# policy, looks mostly ahead, and counts from its own trunk: it has to know how high *it* stands.

# %%
from fgtutor import load_zoo
from fgtutor.robots.a1.observation import SCAN_SCALE

zoo = load_zoo("a1")
steps, tile = zoo["steps"], make_terrain("steps", robot="a1", difficulty=0.6, seed=5)
trio = A1Env(World([[tile]]), 3, config=still)
place = torch.tensor([[*tile.start, 0.0]]) + torch.tensor([[1.6, 1.6, 0.0]])
place[:, :2] += trio.offsets[0, 0] - torch.tensor((0.0, 1.6))
trio.start(torch.arange(3), place.expand(3, 3), steps.command[0])

# %%
from fgtutor.course.patch_pictures import draw_windows, patch_gallery

seen = trio.get_observations()
x, y = (place[0, :2] - trio.offsets[0, 0]).tolist()
draw_windows(tile.elevation, (x, y, 0.0), steps.grid)

# %%
patch_gallery([seen["patch"][0]], steps.grid, ["the patch: what planning asks about"], columns=2)

# %%
scan = seen["policy"][0, -SCAN_GRID.num_points :] / SCAN_SCALE
patch_gallery([scan], SCAN_GRID, ["the scan: what the policy walks by"], columns=2)

# %% [markdown]
# ## What it is paid for
#
# The tracking reward of notebook 02 alone would teach a robot to fling itself forward. So the
# reward is a sum of eleven small terms: some earn, some cost. Three robots show it, at the same
# place: one walks by the shipped `steps` policy, one stands, one flails.

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

who = ("walks", "stands", "flails")
draw_terms({
    name: {term: np.mean([row[term][i].item() for row in terms]) for term in terms[0]}
    for i, name in enumerate(who)
})  # fmt: skip

# %% [markdown]
# *What to see:* the sum at the bottom decides, and it is **floored at zero** before it is paid.
# Otherwise a robot for which every step costs more than it earns would soon find out how to end
# the costs: by falling over.
#
# Also look at how much the robot earns that merely stands. Terms that pay for style also pay who
# waits, so they are worth little unless the robot moves as told. *Hesitation, not falling, is what
# robots learn when rewards are careless.*
#
# One term asks for a **gait**: feet in diagonal pairs, by a clock. Did it listen?

# %%
from fgtutor.course.a1_pictures import draw_gait

draw_gait(torch.stack(loads), trio.control_dt)

# %% [markdown]
# *What to see:* on the flat FR and RL stand together, then FL and RR: a trot. On obstacles the
# pattern frays, and should: the clock is advice, not law.

# %% [markdown]
# ## Half of the robot for free
#
# An A1 is its own mirror image. What it learns on its left it should know on its right. So the
# policy is *made* symmetric: mirror what it observes, and the answer is the mirrored action,
# exactly. It can favour no side, and it needs half of the experience.

# %%
from fgtutor.robots.a1.model import MIRROR, MIRROR_SIGNS

mirror, before = trio.mirror, trio.get_observations()
index, sign = list(mirror.observation_index), torch.tensor(mirror.observation_sign)
after = before.clone()
after["policy"] = before["policy"][:, index] * sign
expected = steps.act(before)[:, list(MIRROR)] * torch.tensor(MIRROR_SIGNS)
print(f"largest difference: {(steps.act(after) - expected).abs().max():.1e}")

# %%
posture = trio.drawing()[0]
posture[3:7] = (1.0, 0.0, 0.0, 0.0)
image = posture.copy()
image[7:] = posture[7:][list(MIRROR)] * MIRROR_SIGNS
draw_postures({"as it walks": posture, "in the mirror": image})

# %% [markdown]
# *What to see:* left and right legs have changed places; hips have changed their sign, thighs and
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
# ## What to try
#
# - Give `A1Config` (of `fgtutor.robots.a1.model`) half the stiffness, `kp`, and repeat the knee's
#   experiment (`A1Env(..., model=A1Config(kp=17.0))`). What happens to the gap between target and
#   angle?
# - In the drive above, put `ground` at difficulty 1.0, or on another terrain. Which policy do you
#   choose, and can you feel a difference?
# - Drive backwards (`drive.speed = -0.4`). Was it trained for that? What would its Feasibility-Net
#   have to say?
# - `env.reward_terms()` at a fall: which term notices first?
# - MuJoCo ships a web viewer: `mujoco.studio.launch_web` shows `model` live in your browser.
#
# **Exercises:** [exercises/ex08.ipynb](../exercises/ex08.ipynb). **Next:** train a specialist,
# [09_train_a_specialist.ipynb](09_train_a_specialist.ipynb).
