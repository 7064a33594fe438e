# %% [markdown]
# # 01 · Elevation maps and patches
#
# - **You will be able to** read an elevation map, cut out of it the patch that a robot sees, and
#   say why one and the same place is easy in one direction and impossible in the other
# - **Time** half an hour to read; 10 seconds on a CPU
# - **Needs** this package, nothing else: no robot, no GPU, no network
# - **If a part is slow** only the first cell is: it loads torch, once
#
# A robot that plans its way needs to know the ground before it stands on it. What moves it is a
# **policy**: a function, usually a trained network, from what the robot senses to what it does; and
# a robot may have several. This course follows one idea from here to the end: **ask every policy of
# the robot, at every place and in every direction, how well it would do there, and plan over the
# answers.** The question starts with a map.

# %% [markdown]
# ## A map is a grid of heights
#
# Somebody has scanned the ground and put one height into every cell of a grid. That is all an
# **elevation map** is; the paper calls it $\mathcal M$.

# %%
from fgtutor import make_terrain
from fgtutor.figures.maps import draw_elevation

M = make_terrain("steps", robot="toy", seed=3).elevation
M

# %%
draw_elevation(M)

# %% [markdown]
# Stripes across the way: a flight of steps, seen from above. White is the usual height, so the
# colours tell you at once what stands out and what is sunk in.
#
# The heights are an array, **x first**: `M.heights[ix, iy]`. Cells are for computers; people,
# robots and planners talk in metres. The map translates.

# %%
ix, iy = M.cell_of(3.0, 2.0)
x, y = M.centre_of(ix, iy)
print(f"(3.0, 2.0) m lies in cell ({ix}, {iy}), whose centre is ({x:.2f}, {y:.2f}) m")
print(f"the ground there is {M.heights[ix, iy]:.3f} m high")

# %% [markdown]
# The centre is not (3.0, 2.0): a cell *covers* a square, and its corner is not its middle. Half a
# cell lost here is half a cell beside the bridge later. **Swapping x and y, and forgetting the
# half cell, are the two classic mistakes with maps.** You will meet both again in the exercises.

# %% [markdown]
# ## Nobody has seen everything
#
# A wall hides what is behind it. Cells that no ray has hit are `NaN`, *not a number*, which is
# honest: zero would be a claim.

# %%
import numpy as np

from fgtutor import ElevationMap

heights = M.heights.copy()
heights[40:50, 14:26] = np.nan  # behind something, say
seen = ElevationMap(heights, resolution=M.resolution)
draw_elevation(seen)

# %% [markdown]
# A network cannot compute with `NaN`. `filled()` takes the nearest known height instead, and
# remembers in `known` where that was a guess: a filled cell is a guess that must never pass for
# free ground.

# %%
filled = seen.filled()
print("heights missing:", np.isnan(filled.heights).sum())
print("cells never seen:", (~filled.known).sum())

# %% [markdown]
# ## A robot needs only its surroundings: the patch
#
# To decide whether it can take the next step, a robot needs no map of the whole world, only what
# lies around its feet. So we lay a small grid of points around it, turned the way it faces, and
# read the height under each: the **patch** $H_{x,y}$.

# %%
from fgtutor.patches import PatchGrid

grid = PatchGrid()
print(
    f"{grid.shape[0]} x {grid.shape[1]} points, {grid.spacing} m apart: {grid.num_points} numbers"
)

# %%
from fgtutor.course.patch_pictures import draw_windows

eastward, askew = (3.4, 2.0, 0.0), (5.6, 1.4, 0.9)  # x, y in metres; yaw in radians
draw_windows(M, [eastward, askew], grid)

# %% [markdown]
# The window turns with the robot. Yaw counts from the +x axis counter-clockwise. The points of
# the turned window fall *between* the cells' centres, so their heights are interpolated from four
# cells.

# %%
from fgtutor.course.patch_pictures import patch_at, patch_gallery

patch_gallery(
    [patch_at(M, eastward, grid), patch_at(M, askew, grid)],
    grid,
    ["facing +x", "facing askew"],
    columns=2,
    title="What the robot sees: it always looks to the right",
)

# %% [markdown]
# The small box is the robot, the line in it its nose. Everything is now told **from the robot's
# point of view**: *in front of me, 40 cm ahead, the ground falls*. Where on earth that is has
# vanished from the numbers.
#
# So has the altitude: heights count from the ground under the robot (the median of the points in
# the box). Lift the whole world by a hundred metres, and the patch stays what it was.

# %%
lifted = ElevationMap(M.heights + 100.0, resolution=M.resolution)
difference = patch_at(lifted, askew, grid) - patch_at(M, askew, grid)
print(f"largest change: {difference.abs().max():.5f} m")

# %% [markdown]
# What is left of 100 m is rounding. A network that sees patches can use on a mountain what it has
# learned at the beach.

# %% [markdown]
# ## One place, eight directions
#
# Now the main point of this notebook. Here is the simplest obstacle there is: a single ledge,
# flat below, flat above.

# %%
from fgtutor.course.patch_pictures import patch_rose

heights = np.zeros((40, 40))
heights[20:] = 0.15  # from x = 2 m on the ground is 15 cm higher
ledge = ElevationMap(heights, resolution=0.1)
patch_rose(ledge, 1.75, 2.0, grid)

# %% [markdown]
# The robot stands still, just before the ledge, and turns through the eight **headings** that
# this course plans with: heading 0 is +x, and every next one is 45 degrees further round.
#
# *What to see:* heading 0 has a wall in front. Heading 4 has it behind, where it does not matter.
# Headings 2 and 6 run along it, and are mirror images. One cell of the map, eight different
# questions to the robot.

# %% [markdown]
# ## Up is not down
#
# Now compare two robots that cross the *same* ledge, one up and one down. The middle line of a
# patch is the profile of the ground under the robot's path.

# %%
from fgtutor.figures.charts import draw_curves

rows, columns = grid.shape
ahead = grid.points.reshape(rows, columns, 2)[:, columns // 2, 0]
up = patch_at(ledge, (1.65, 2.0, 0.0), grid).reshape(rows, columns)[:, columns // 2]
down = patch_at(ledge, (2.35, 2.0, np.pi), grid).reshape(rows, columns)[:, columns // 2]
draw_curves(
    ahead,
    {"up the ledge (heading 0)": up, "down the ledge (heading 4)": down},
    title="The same ledge from its two sides",
    xlabel="ahead of the robot (m)",
    ylabel="height (m)",
)

# %% [markdown]
# For a robot with wheels of 9 cm radius, the first is a wall and the second a bump it can drop
# from. A classical **costmap** stores *one* number for each cell: it has to call this ledge
# passable both ways or blocked both ways, and is wrong either way. That is why everything from
# here on has eight numbers a cell.

# %% [markdown]
# ## Turn the world, and the headings turn with it
#
# A sanity check that catches most mistakes with axes and angles: rotate the map by 90 degrees,
# rotate the pose with it, and the robot must see exactly what it saw. A heading that was $k$ is
# now $k + 2$.

# %%
x, y, yaw = 1.75, 1.2, 0.0
turned = ledge.rotated90()  # counter-clockwise about (0, 0): (x, y) goes to (-y, x)
before = patch_at(ledge, (x, y, yaw), grid)
after = patch_at(turned, (-y, x, yaw + np.pi / 2), grid)
print(f"largest difference: {(after - before).abs().max():.6f} m")

# %% [markdown]
# ## How deep is a hole?
#
# For a robot that cannot climb out, a slot of half a metre and one of ten metres are the same: do
# not fall in. But to a network ten metres is a huge number, and would drown all that matters. So
# before patches are cut, holes are raised to a depth at which they are holes and no more.

# %%
from fgtutor import patches

G = make_terrain("gaps", robot="toy", seed=3).elevation
middle = G.shape[1] // 2
draw_curves(
    G.centres[0],
    {
        "as scanned": G.heights[:, middle],
        "as patches see it": patches.prepare(G).heights[:, middle],
    },
    title="Gaps, cut lengthwise",
    xlabel="x (m)",
    ylabel="height (m)",
)

# %% [markdown]
# Physics keeps the true depth: whoever drives into it falls. Only the eyes are spared.

# %% [markdown]
# ## What to try
#
# - Move the rose to `x = 2.0`, right onto the ledge. What is "the ground under the robot" there?
#   Look at the medians in `fgtutor.patches.ground_height`.
# - Draw other terrains: `"slopes"`, `"rubble"`, `"bridge"`, `"valley"`, `"stairs"`. For which of
#   them do headings 0 and 4 see the same?
# - Give `PatchGrid` another reach. What would a robot miss that sees only 20 cm ahead at 1 m/s?
#
# **Exercises:** [exercises/ex01.ipynb](../exercises/ex01.ipynb). **Next:** a robot that falls,
# [02_a_robot_that_falls.ipynb](02_a_robot_that_falls.ipynb).
