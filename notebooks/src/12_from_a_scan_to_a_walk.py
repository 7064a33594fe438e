# %% [markdown]
# # 12 · From a scan to a walk
#
# - **You will be able to** turn a LiDAR's points into an elevation map and say what it rests on,
#   foresee how lost a robot gets, and plan so that being a little lost does no harm
# - **Time** 45 minutes to read and try; two to three minutes on two CPU cores
# - **Needs** notebooks [07](07_drive_the_plan.ipynb) and [11](11_mixed_terrain.ipynb); uses the
#   shipped specialists
# - **If a part is slow** run `%env FGTUTOR_FAST=1` in a new cell at the top: fewer walks, and a
#   coarser survey
#
# Until now the map was given. A real robot has a scanner, whose points are noisy, and an idea of
# where it stands, which is wrong by some centimetres. This notebook goes all the way from the one
# to a walk despite the other. In the paper this is Sec. V (Figs. 7 and 8, Table III), on a real
# robot.

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=12)

# %% [markdown]
# Symbols are those of the [notation page](../docs/notation.md).
#
# ## The scanner
#
# The paper's scanner, a Livox MID-360, sends 200,000 rays per second in a pattern that never
# repeats. The longer it looks, the fewer holes are left.

# %%
import numpy as np

from fgtutor.figures.style import Picture
from fgtutor.robots.lidar import LidarConfig, pattern

sensor, looks = LidarConfig(), Picture(7.2, 3.0)
for axes, seconds in zip(looks.subplots(1, 2, sharey=True), (0.1, 0.3), strict=True):
    x, y, z = pattern(np.arange(0, seconds, 10 / sensor.point_rate)).T
    axes.plot(np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z)), ".", markersize=1.5)
    axes.set(title=f"{seconds} s", xlabel="around (degrees)", ylabel="up (degrees)")
looks

# %% [markdown]
# The A1 carries it on its head, upside down, since we want to see the ground. Let us lay a course
# of two terrains, steps and gaps, and look at it once, from where the robot stands.

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "After one look of a tenth of a second, how much of the map is known?",
    ["under 20 %", "about half", "over 80 %"],
)

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
# *What to see:* points that thin out with distance. And behind every edge there is a shadow: **what
# is lower than an edge cannot be seen across it.** How deep does a ray get into a slot? By similar
# triangles: a sensor at height $h$, a horizontal distance $d$ away, sees down to the depth
# $w\, h / d$ on the far wall of a slot $w$ wide.
#
# **Your line.** The sensor is 0.4 m high, the slot 1.5 m away and 0.15 m wide.

# %%
h, d, w = 0.4, 1.5, 0.15
depth = ...  # a formula of h, d and w

if depth is ...:
    print("Not filled in yet. Draw the ray over the near edge: two similar triangles.")
else:
    assert abs(depth - 0.04) < 1e-9, f"got {depth}: depth to width is as height to distance"
    print(f"Right: {100 * depth:.0f} cm. The slot is 60 cm deep, and nothing of its floor is seen.")

# %% [markdown]
# ## From points to cells
#
# Sort the points into cells and take one height from each. Which one? Two candidates: the
# **highest** point, since it stops a foot; or the **median**, since noise goes both ways.


# %%
from collections import defaultdict


def sort_into_cells(points):
    """Return the heights of the points in each cell (ix, iy) of the map."""
    cells = np.floor((points[:, :2] - truth.extent[:2]) / truth.resolution).astype(int)
    inside = ((cells >= 0) & (cells < truth.shape)).all(axis=1)
    heights = defaultdict(list)
    for (ix, iy), z in zip(cells[inside].tolist(), points[inside, 2], strict=True):
        heights[ix, iy].append(z)
    return heights


# %%
from fgtutor.world.scanning import ScanConfig, map_points

to_cells = ScanConfig(resolution=truth.resolution)
first = map_points(glance, config=to_cells, area=truth.extent)
first

# %%
from fgtutor.figures.maps import draw_elevation

draw_elevation(first.elevation, title="The map after one look")

# %%
known = first.elevation.known.mean()
assert 0 < known < 0.2
print(f"{known:.0%} of the cells hold at least {to_cells.min_points} points")
reveal("under 20 %")

# %% [markdown]
# *What to see:* hatched cells were never seen. They are not flat, not free and not holes: they are
# *unknown*, and no plan steps on them. On this map the planner would stay at home.
#
# ## A survey
#
# So first walk along with the sensor on a pole, as surveyors do: from many poses, each of them
# known to a centimetre or so. **Slide** to add one pose after the other.

# %%
from fgtutor.course.widgets.slides import LidarSlides
from fgtutor.robots.lidar import survey

LidarSlides(terrain, survey(terrain, spacing=2.0))

# %%
from fgtutor.course.notebooks import budget

spacing = budget(fast=40, full=20, unit="cm between two poses") / 100
poses = survey(terrain, spacing=spacing)
points = scan_terrain(terrain, poses=poses, seed=0)
print(f"{len(poses)} poses, {len(points):,} points")

# %%
scanned = map_points(points, config=to_cells, area=truth.extent)
M = scanned.elevation
assert M.known.mean() > 0.95
draw_elevation(M, title="Elevation map M, from the survey")

# %% [markdown]
# Back to the two candidates. Try both on the survey, beside `map_points`, where it matters most: on
# the floor of the slots.

# %%
predict(
    "By which rule do the slots of the map become too shallow?",
    ["the highest point", "the median", "both"],
)

# %%
slot = truth.heights < -0.3
by_cell = sort_into_cells(points[::4])
in_slots = [(cell, zs) for cell, zs in by_cell.items() if len(zs) > 1 and slot[cell]]
high = {
    "highest point": [max(zs) - truth.heights[cell] for cell, zs in in_slots],
    "median": [np.median(zs) - truth.heights[cell] for cell, zs in in_slots],
    "map_points": [M.heights[cell] - truth.heights[cell] for cell, _ in in_slots],
}
filled_up = {rule: np.mean(np.array(errors) > 0.1) for rule, errors in high.items()}

# %%
from fgtutor.figures.charts import draw_table

draw_table(
    [[share] for share in filled_up.values()], list(filled_up), ["too shallow"],
    title="How many cells of the slots are filled up?",
    caption="Share of their cells that are more than 10 cm too high",
)  # fmt: skip

# %%
assert filled_up["highest point"] >= filled_up["median"] > 2 * filled_up["map_points"]
reveal("both")

# %% [markdown]
# *What to see:* both plain rules fill slots up, since at the foot of a wall a scanner sees more
# wall than floor. `map_points` therefore does four things:
#
# 1. It removes **outliers**: points far from their nearest neighbours.
# 2. It sorts points into cells and takes the **median**. Cells with fewer than two points stay
#    unknown.
# 3. If a cell's points reach over more than 20 cm, there is a **wall** in it. Then it counts the
#    points in the topmost 8 cm. Level ground nearby shows about as many: the cell is the top of the
#    wall. Fewer than half as many: the cell is the floor beside it.
# 4. The top gets the median of its topmost points, the floor the lowest 5 % of all.

# %% [markdown]
# ## How wrong is the map?
#
# In simulation, and only there, we know the truth. Subtract it.

# %%
from fgtutor.course.cloud_pictures import difference, draw_error

error = difference(M, truth)
wrong = np.abs(error.heights[error.known])
for share in (0.5, 0.95, 0.99):
    print(f"{share:.0%} of the cells are within {100 * np.quantile(wrong, share):.1f} cm")
print(f"never seen: {(~error.known).sum()} of {error.heights.size} cells")

# %%
draw_error(M, truth)

# %%
step = np.maximum.reduce([np.abs(truth.heights - np.roll(truth.heights, s, 0)) for s in (-1, 1)])
edges = (step > 0.02) & error.known
at_edges, elsewhere = (np.abs(error.heights[where]).mean() for where in (edges, ~edges & M.known))
assert at_edges > 2 * elsewhere
print(f"mean error at edges {100 * at_edges:.1f} cm, elsewhere {100 * elsewhere:.1f} cm")

# %% [markdown]
# *What to see:* level areas are right; the **edges** are wrong. A cell on an edge shows the scanner
# both its sides, and the pose was off by a centimetre or two. Robots set their feet exactly there.
# Compare what two single cells rest on:

# %%
level = M.cell_of(*terrain.start)
edge = np.unravel_index(np.nanargmax(np.abs(error.heights)), M.shape)
for where, cell in (("level ground", level), ("worst edge", edge)):
    inside = np.abs(points[:, :2] - M.centre_of(*cell)).max(axis=1) <= M.resolution / 2
    z = points[inside, 2]
    print(f"{where:12} {len(z):4} points, z = {z.min():+.2f} to {z.max():+.2f} m", end=", ")
    print(f"standard deviation {100 * z.std():.1f} cm; the map says {M.heights[cell]:+.2f} m")

# %% [markdown]
# And birds, dust, reflections? Add a hundred points that are not there, with and without the
# outlier test of rule 1:

# %%
rng = np.random.default_rng(0)
low, high = np.array((*truth.extent[:2], 0.2)), np.array((*truth.extent[2:], 1.2))
dirty, spoilt = np.concatenate((glance, rng.uniform(low, high, (100, 3)))), {}
for neighbours in (0, to_cells.neighbours):
    settings = ScanConfig(resolution=truth.resolution, neighbours=neighbours, min_points=1)
    made = map_points(dirty, config=settings, area=truth.extent)
    spoilt[neighbours] = (np.abs(difference(made.elevation, truth).heights) > 0.15).sum()
    print(f"{neighbours} neighbours: {made.outliers} points out, {spoilt[neighbours]} bad cells")
assert spoilt[to_cells.neighbours] < spoilt[0]

# %% [markdown]
# ## Plan on what was seen
#
# From here on the truth is locked away. The planner gets `M`; physics keeps the real ground. In the
# paper a switch of policies costs nothing, and its authors name that as a limit of the method
# (Sec. V). Our planner can put a price on it.

# %%
from fgtutor import load_zoo  # loads the robots: some seconds, once
from fgtutor.baselines import AssessedMap, find_route, ours

zoo = load_zoo("a1")
assessed, ends = AssessedMap(M, zoo), (terrain.start, terrain.goal)
free, priced = (
    find_route(ours, assessed, *ends, switch_cost=price).raise_for() for price in (0.0, 1.0)
)

# %%
from fgtutor.course.route_pictures import compare_routes

compare_routes(M, {"switching is free (the paper)": free, "a switch costs 1": priced})

# %%
assert priced.switches <= free.switches
print(f"switches: {free.switches} if free, {priced.switches} at a price of 1 (metre of F = 1)")

# %% [markdown]
# *What to see:* count the switches. Where two policies are about equally good, the best one changes
# from cell to cell. With a price on it, and a change allowed only for a step that *both* policies
# can take, few switches are left.

# %%
from fgtutor import execute

execute(priced, terrain, {name: zoo[name] for name in priced.names})

# %% [markdown]
# ## How lost is the robot?
#
# So far the robot knew exactly where it was. In reality its estimate has two errors. Each position
# fix is a little off, by a new $n_t$ every time. And underneath a second error **drifts**: a random
# walk, to which every control step of $\Delta t$ adds a small $d_s$:
#
# $$
# e_t = n_t + \sum_{s \le t} d_s, \qquad
# n_t \sim \mathcal N(0, \sigma_\text{fix}^2), \quad
# d_s \sim \mathcal N(0, \sigma_\text{drift}^2\, \Delta t).
# $$
#
# Here are twenty seconds, for three robots:

# %%
fix, drift, dt, seconds = 0.03, 0.01, 0.02, 20.0
draws = rng.standard_normal((2000, 2, round(seconds / dt)))
errors = fix * draws[:, 0] + np.cumsum(drift * np.sqrt(dt) * draws[:, 1], axis=-1)
t = dt * np.arange(1, errors.shape[-1] + 1)

# %%
from fgtutor.figures.charts import draw_curves

draw_curves(
    t[::50], {f"robot {i}": errors[i, ::50] for i in range(3)},
    title="Where they believe they are, minus where they are",
    xlabel="time (s)", ylabel="error in x (m)",
)  # fmt: skip

# %%
predict(
    "Over many robots: what grows in proportion to time?",
    ["the standard deviation of the error", "its variance", "neither"],
)

# %%
variance = errors.var(axis=0)
draw_curves(
    t[::10], {"measured": 1e4 * variance[::10]}, title="How lost, over 2,000 robots",
    xlabel="time (s)", ylabel="variance of the error (cm²)",
)  # fmt: skip

# %%
line = np.polyfit(t, variance, 1)
assert np.abs(variance - np.polyval(line, t)).max() < 0.15 * variance[-1]
print(f"the line begins at {1e4 * line[1]:.0f} cm²")
reveal("its variance")

# %% [markdown]
# *What to see:* a straight line that does not begin at 0. Independent errors add their variances,
# one part for each step. (Which two numbers make this line? That is an exercise.)
#
# ## Does it still arrive?
#
# The follower believes its wrong position; physics does not. Walk with more and more error, once in
# the paper's manner (switching is free, and happens at once), and once carefully (switching has a
# price, and a policy takes over only when it has been wanted for three steps in a row).

# %%
predict("15 cm of noise, slots 15 cm wide: how many of the walks still arrive?")

# %%
from fgtutor.course.drives import drive_together
from fgtutor.execution import FollowConfig

trials = budget(fast=4, full=20, unit="walks for each of six cases", each=6.0)
levels = {"exact": (0.0, 0.0), "3 cm": (0.03, 0.02), "15 cm": (0.15, 0.05)}
manners = {"paper": (free, 1), "careful": (priced, 3)}


def walks(route, hold, level):
    config = FollowConfig(hold_steps=hold, position_noise=level[0], drift=level[1], patience=1.5)
    return drive_together([(route, terrain, seed) for seed in range(trials)], zoo, config=config)


# %%
from tqdm import tqdm

cases = {
    f"{manner}, {level}": walks(*manners[manner], levels[level])
    for level, manner in tqdm([(n, m) for n in levels for m in manners])
}

# %%
from fgtutor.figures.charts import draw_rates

won = {name: sum(walk.success for walk in ws) for name, ws in cases.items()}
draw_rates({name: (count, trials) for name, count in won.items()},
           title="From the steps to the gaps, on a scanned map")  # fmt: skip

# %%
from fgtutor.statistics import Share

for name, ws in cases.items():
    share = Share(successes=won[name], trials=trials)
    print(f"{name:14} reached {share!s:13} %, {np.mean([w.switches for w in ws]):5.1f} switches")

# %%
for level in levels:
    (low, high), (low2, high2) = (
        Share(successes=won[f"{manner}, {level}"], trials=trials).interval for manner in manners
    )
    apart = "differ" if low > high2 or low2 > high else "cannot be told apart"
    print(f"{level:6} the two manners {apart}: {low:.0%}-{high:.0%} and {low2:.0%}-{high2:.0%}")
reveal(", ".join(f"{m}: {won[f'{m}, 15 cm']} of {trials}" for m in manners))

# %% [markdown]
# *What to see:* the careful manner switches less. Does that help it to arrive? Read the last three
# lines, not your hopes. In our simulation a change of policy is nearly harmless, so there is
# little to win; see Table III in [docs/results.md](../docs/results.md) for thousands of walks.
#
# On the real robot the paper reached 95, 100, 100, 85 and 100 % in its five transitions, with 20
# attempts each, and 70 % of the whole course. It names two causes: an imprecise position, so that
# policies change too early, and changes that cost nothing in the plan but something on the ground.
# A simulation that knows little of the second cause cannot show its cure.

# %%
from fgtutor.course.route_pictures import draw_drive

lost = [(name, walk) for name, ws in cases.items() for walk in ws if not walk.success]
name, shown = lost[0] if lost else ("careful, 15 cm", cases["careful, 15 cm"][0])
print(f"{len(lost)} of {len(cases) * trials} walks failed; shown is one of '{name}': {shown}")
draw_drive(shown, manners[name.partition(",")[0]][0], truth)

# %% [markdown]
# ## What you now know
#
# - A cell's height is a choice of one number from many points; at walls the choice matters.
# - Unknown is a value of its own. Edges are where a map is wrong.
# - Noise stays, drift grows: variances add up.
# - A price on switching makes plans calm. Whether it helps is a matter of measuring.
#
# **Test yourself**
#
# <details><summary>1. Why does the surveyor's sensor hang 1.2 m above the ground and not at the
# robot's height?</summary>
#
# It then looks down steeply, so the ratio of height to distance is large and it sees the floor of
# the slots.
# </details>
#
# <details><summary>2. One map says NaN in a cell, another 0. Both are planned on. Which is more
# dangerous?</summary>
#
# The 0. It claims that the cell is level with the start, so a plan may cross it. NaN is closed.
# </details>
#
# <details><summary>3. Drift has a standard deviation of 4 cm after 10 s. And after 40 s?</summary>
#
# 8 cm. The variance has grown fourfold, so its root has doubled.
# </details>
#
# ## What to try
#
# - `LidarConfig(position_noise=0.05)` in the survey: a surveyor with a poor position. What becomes
#   of the gaps on the map?
#   <details><summary>Answer</summary>Their edges blur over two cells on each side. A slot three
#   cells wide keeps hardly a cell of its floor, and looks shallower and wider.</details>
# - Map the `glance` with `min_points=1`. How far could the robot plan now?
#   <details><summary>Answer</summary>More cells become known, also some that rest on one wrong
#   point. Far away there are still holes between the points, and the shadows remain.</details>
# - Save `points` with `np.savez("cloud.npz", points=points)` and map it from a shell:
#   `fgtutor map cloud.npz --out map.npz`. A LAS, PLY or PCD file of your own works as well.
# - Plan on the truth instead of `M` and compare the routes. Where does the scan cost you something?
#   <details><summary>Answer</summary>At edges, where its errors make patches look unfamiliar: the
#   cost of the route is higher on `M`, mostly over the steps and the slots.</details>
#
# **Exercises:** [exercises/ex12.ipynb](../exercises/ex12.ipynb). **Next:** more of everything,
# [13_scale_out.ipynb](13_scale_out.ipynb).
