# %% [markdown]
# # 12 · From a scan to a walk
#
# - **You will be able to** turn a LiDAR's points into an elevation map and say what it rests on,
#   foresee how lost a robot gets, and plan so that being a little lost does no harm
# - **Time** half an hour to read; about a minute on two CPU cores
# - **Needs** notebooks [07](07_drive_the_plan.ipynb) and [11](11_mixed_terrain.ipynb); uses the
#   shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer walks, and a
#   coarser survey
#
# Until now the map fell from the sky. In the world a robot has a scanner, its points are noisy,
# and so is its idea of where it stands. This notebook goes the whole way. (The paper's Table III.)

# %% [markdown]
# ## The scanner
#
# The Livox MID-360 sends two hundred thousand rays a second in a pattern that never repeats: the
# longer it looks, the fewer holes there are.

# %%
import numpy as np

from fgtutor.figures.style import Picture
from fgtutor.robots.lidar import LidarConfig, pattern

sensor, looks = LidarConfig(), Picture(7.2, 3.0)
for axes, seconds in zip(looks.subplots(1, 2, sharey=True), (0.1, 0.3), strict=True):
    x, y, z = pattern(np.arange(0, seconds, 5 / sensor.point_rate)).T
    axes.plot(np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z)), ".", markersize=0.6)
    axes.set(title=f"{seconds} s", xlabel="around (degrees)", ylabel="up (degrees)")
looks

# %% [markdown]
# The A1 carries it on its head, upside down, since the ground is what we want to see. Let us lay a
# course of two terrains and look at it once, from where the robot stands.

# %%
from fgtutor.course.cloud_pictures import draw_cloud
from fgtutor.evaluation.switching import lay_course
from fgtutor.robots.lidar import carried, scan_terrain

terrain = lay_course(("steps", "gaps"), robot="a1", seed=1)
truth = terrain.elevation
eyes = carried(terrain, np.array([[*terrain.start, 0.0]]))
glance = scan_terrain(terrain, poses=eyes, config=LidarConfig(carrier="a1"))
draw_cloud(glance, sensors=eyes, title="One look of a tenth of a second")

# %% [markdown]
# *What to see:* arcs that thin out with distance. And behind every edge there is a shadow: **what
# is lower than an edge cannot be seen across it.** A slot narrow enough is all shadow.
#
# ## From points to cells
#
# Sort the points into cells, and take one height from each. The *highest* point, since a foot is
# stopped by it? Then every edge grows by the sensor's noise, and every narrow gap closes. We take
# the **median**, and keep what else the cell knows: how many points, how low, how scattered.
# One place needs more: at the foot of a wall a scanner sees more wall than floor, and the median
# would fill every slot half up. Where a cell's points reach over 20 cm, we ask whether as many
# lie on top as on level ground nearby: if not, the cell is the floor.

# %%
from fgtutor.world.scanning import ScanConfig, map_points

to_cells = ScanConfig(resolution=truth.resolution)
first = map_points(glance, config=to_cells, area=truth.extent)
first

# %%
from fgtutor.figures.maps import draw_elevation

draw_elevation(first.elevation)

# %% [markdown]
# *What to see:* hatched cells were never seen. They are not flat, not free, and not holes: they
# are *unknown*, and no plan will step on them. On this map, the planner would stay at home.

# %% [markdown]
# ## A survey
#
# So walk along first with the sensor on a pole, as surveyors do: many poses, each of them a little
# wrong, as localisation is.

# %%
from fgtutor.course.notebooks import budget
from fgtutor.robots.lidar import survey

spacing = budget(fast=40, full=20, unit="cm between two poses") / 100
poses = survey(terrain, spacing=spacing)
points = scan_terrain(terrain, poses=poses, seed=0)
draw_cloud(points, sensors=poses, title=f"{len(poses)} poses")

# %%
scanned = map_points(points, config=to_cells, area=truth.extent)
scanned

# %%
M = scanned.elevation
draw_elevation(M)

# %% [markdown]
# ## How wrong is it?
#
# In simulation, and only there, we know the truth. Subtract it.

# %%
from fgtutor.course.cloud_pictures import difference

error = difference(M, truth)
wrong = np.abs(error.heights[error.known])
for share in (0.5, 0.95, 0.99):
    print(f"{share:.0%} of the cells are within {100 * np.quantile(wrong, share):.1f} cm")
print(f"never seen: {(~error.known).sum()} of {error.heights.size} cells")

# %%
picture = draw_elevation(error)
picture.axes[0].set_title("The scan minus the truth", loc="left")
picture

# %% [markdown]
# *What to see:* the areas are fine; the **edges** are where a map is wrong. A cell on an edge has
# seen both its sides, and the pose was off by a centimetre or two. Exactly there a robot sets its
# feet. Compare what a single cell rests on, on level ground and at its worst:

# %%
level = M.cell_of(*terrain.start)
edge = np.unravel_index(np.nanargmax(np.abs(error.heights)), M.shape)
for where, cell in (("on the level", level), ("at an edge", edge)):
    inside = np.abs(points[:, :2] - M.centre_of(*cell)).max(axis=1) <= M.resolution / 2
    z = points[inside, 2]
    print(f"{where:13} {len(z):4} points, z = {z.min():+.2f} to {z.max():+.2f} m", end=", ")
    print(f"standard deviation {100 * z.std():.1f} cm; the map says {M.heights[cell]:+.2f} m")

# %% [markdown]
# And birds, dust, reflections? Throw in a hundred points that are not there. A voxel far from its
# nearest neighbours is an outlier:

# %%
rng = np.random.default_rng(0)
low, high = np.array((*truth.extent[:2], 0.2)), np.array((*truth.extent[2:], 1.2))
dirty = np.concatenate((glance, rng.uniform(low, high, (100, 3))))
for neighbours in (0, to_cells.neighbours):
    careful = ScanConfig(resolution=truth.resolution, neighbours=neighbours, min_points=1)
    made = map_points(dirty, config=careful, area=truth.extent)
    spoilt = (np.abs(difference(made.elevation, truth).heights) > 0.15).sum()
    print(f"{neighbours} neighbours asked: {made.outliers:4} points removed, {spoilt} bad cells")

# %% [markdown]
# ## Plan on what was seen
#
# From here on the truth is locked away. The planner gets `M`; physics keeps the real ground.

# %%
from fgtutor import load_zoo
from fgtutor.baselines import AssessedMap, find_route, ours
from fgtutor.course.drives import daring_route

zoo = load_zoo("a1")
assessed, ends = AssessedMap(M, zoo), (terrain.start, terrain.goal)


def route_at(switch_cost):
    route = find_route(ours, assessed, *ends, switch_cost=switch_cost)
    if route:
        return route
    print(route)  # a Refusal: go all the same, and see whether that was wise
    return daring_route(assessed, *ends, switch_cost=switch_cost)


free, priced = route_at(0.0), route_at(1.0)

# %%
from fgtutor.course.route_pictures import compare_routes

compare_routes(M, {"switching is free (the paper)": free, "a switch costs 1": priced})

# %% [markdown]
# *What to see:* count the switches. In the paper switching costs nothing, and its authors name that
# as a limit of the method: where two policies are about as good, the map of who drives flickers,
# and a real robot stumbles at each change. With a price on it, and with a change allowed only for
# a step that *both* can take, a switch happens where it does no harm.

# %%
from fgtutor import execute
from fgtutor.course.a1_pictures import show_walk

walk = execute(priced, terrain, {name: zoo[name] for name in priced.names})
walk

# %%
show_walk(walk, terrain, priced)

# %% [markdown]
# ## Lost by inches
#
# One thing was still given: where the robot is. Every fix of a position is a little off, a new
# error each time; and underneath, a second error **drifts**: a random walk. Here are its first
# twenty seconds, for a few robots, with three centimetres of noise and one of drift.

# %%
fix, drift, dt, seconds = 0.03, 0.01, 0.02, 20.0
draws = rng.standard_normal((400, 2, round(seconds / dt)))
errors = fix * draws[:, 0] + np.cumsum(drift * np.sqrt(dt) * draws[:, 1], axis=-1)
t = dt * np.arange(errors.shape[-1])

# %%
from fgtutor.figures.charts import draw_curves

draw_curves(
    t[::25], {f"robot {i}": errors[i, ::25] for i in range(3)},
    title="What they believe, minus where they are", xlabel="time (s)", ylabel="error in x (m)",
)  # fmt: skip

# %%
spread = errors.std(axis=0)
for second in (0.02, 5, 10, 20):
    print(f"after {second:5.2f} s: {spread[round(second / dt) - 1]:.3f} m, over 400 robots")

# %%
draw_curves(
    t[::25], {"standard deviation": spread[::25]}, title="How lost, on average",
    xlabel="time (s)", ylabel="standard deviation (m)",
)  # fmt: skip

# %% [markdown]
# *What to see:* it does not grow in proportion to time. Steps of a random walk partly undo each
# other. (How does it grow? That is an exercise.)
#
# ## Does it still arrive?
#
# The follower believes its wrong position; physics does not. Walk the same route with more and more
# error, once the paper's way (switching is free, and at once), and once carefully (switching has a
# price, and a policy takes over only when it has been wanted for a few steps in a row).

# %%
from fgtutor.course.drives import drive_together
from fgtutor.execution import FollowConfig

trials = budget(fast=3, full=15, unit="walks a cell, four cells", each=4.0)
levels = {"exact": (0.0, 0.0), "off by inches": (0.03, 0.02)}
manners = {"paper": (free, 1), "careful": (priced, 3)}


def walks(route, hold, level):
    config = FollowConfig(hold_steps=hold, position_noise=level[0], drift=level[1], patience=1.5)
    return drive_together([(route, terrain, seed) for seed in range(trials)], zoo, config=config)


# %%
from tqdm import tqdm

cells = {
    f"{manner}, {level}": walks(*manners[manner], levels[level])
    for manner, level in tqdm([(m, n) for m in manners for n in levels])
}

# %%
from fgtutor.figures.charts import draw_rates

draw_rates(
    {name: (sum(w.success for w in ws), trials) for name, ws in cells.items()},
    title="From the steps to the gaps, on a scanned map",
)

# %%
for name, ws in cells.items():
    reasons = ", ".join(walk.reason for walk in ws)
    print(f"{name:22} {np.mean([w.switches for w in ws]):5.1f} switches a walk; {reasons}")

# %% [markdown]
# *What to see:* with so few walks the intervals overlap, and nothing is proved. The table to
# believe is `fgtutor evaluate switching --robot a1 --trials 200 --out report`: all pairs of
# neighbours and the whole course, at several levels of noise, each of the three additions alone
# and together.
#
# Where do the failed ones lie? If they lie where the policy changes, the price on switching was
# too low. If they lie at edges, it was the position.

# %%
from fgtutor.course.route_pictures import draw_drive

manner, level = "careful", "off by inches"
shown = min(cells[f"{manner}, {level}"], key=lambda w: (w.success, w.length))
draw_drive(shown, priced, truth)

# %% [markdown]
# ## What to try
#
# - `LidarConfig(position_noise=0.05)` in the survey: a surveyor who is bad at localisation. What
#   becomes of the gaps on the map?
# - Map the `glance` with `min_points=1`. How far could the robot plan now?
# - Save `points` with `np.savez("cloud.npz", points=points)` and map it from a shell:
#   `fgtutor map cloud.npz --out map.npz`. A LAS, PLY or PCD file of your own works as well.
# - Plan on the truth instead of `M` and compare the routes. Where does the scan cost you something?
#
# **Exercises:** [exercises/ex12.ipynb](../exercises/ex12.ipynb). **Next:** more of everything,
# [13_scale_out.ipynb](13_scale_out.ipynb).
