# %% [markdown]
# # 01 · Elevation maps and patches
#
# - **You will be able to** read an elevation map, cut out the patch that a robot sees of it, and
#   say why the same place is easy in one direction and impossible in another
# - **Time** 40 minutes to read and try; 10 seconds on a CPU
# - **Needs** this package, nothing else: no robot, no GPU, no network
# - **If a part is slow** only the first cell is: it loads torch, once
#
# A robot may have several **policies**. A policy is a function, usually a trained network, that
# turns what the robot senses into what it does. This course follows one idea: **ask every policy,
# at every place and in every direction, how well it would do there; then plan over the answers.**

# %%
from fgtutor.course.diagrams import draw_pipeline  # loads torch: some seconds, once

draw_pipeline(here=1)

# %% [markdown]
# Symbols mean the same in all notebooks: [notation](../docs/notation.md). Equation numbers are
# those of the paper. This notebook covers the start of its Sec. III-B, which numbers no equation.
#
# ## A map is a grid of heights
#
# Somebody has scanned the ground and stored one height per cell of a grid. That is all an
# **elevation map** is: $\mathcal M \in \mathbb R^{W \times H}$.

# %%
from fgtutor import make_terrain
from fgtutor.figures.maps import draw_elevation

M = make_terrain("steps", robot="toy", seed=3).elevation
M

# %%
floor = M.heights[0].max()
assert floor == M.heights.min(), "the first column of cells should be the lowest ground"
draw_elevation(M)

# %% [markdown]
# *What to see:* stripes across the map are a flight of steps, seen from above. White is the most
# common height of a map, here the floor at both ends; brown is higher, and blue would be lower.
#
# The heights are an array with **x first**: `M.heights[ix, iy]`. Robots and planners count in
# metres, arrays in cells. This picture shows both, and the angles we shall need:

# %%
from fgtutor.course.diagrams import draw_frames

draw_frames()

# %% [markdown]
# With the map's lower left corner at $x_0$ and cells $r$ metres wide,
#
# $$
# i_x = \left\lfloor \frac{x - x_0}{r} \right\rfloor,
# \qquad
# x_\text{centre} = x_0 + \left(i_x + \tfrac12\right) r .
# $$
#
# **Your line.** In which cell does x = 3.07 m lie? Replace the three dots.

# %%
(x0, y0), r, x = M.origin, M.resolution, 3.07
cell = ...  # a formula of x, x0 and r

if cell is ...:
    print("Not filled in yet. int() rounds positive numbers down.")
else:
    assert cell == M.cell_of(x, 2.0)[0], f"got {cell}: subtract the corner, divide, round down"
    print("Right.")

# %%
ix, iy = M.cell_of(3.0, 2.0)
x, y = M.centre_of(ix, iy)
print(f"(3.0, 2.0) m lies in cell ({ix}, {iy}), whose centre is ({x:.2f}, {y:.2f}) m")
print(f"the ground there is {M.heights[ix, iy]:.3f} m high")

# %% [markdown]
# The centre is not (3.0, 2.0): a cell *covers* a square, and its corner is not its middle.
# **Swapping x and y, and forgetting the half cell, are the two classic mistakes with maps.** On a
# bridge 35 cm wide, half a cell of 10 cm is a seventh of the width.

# %% [markdown]
# ## Nobody has seen everything
#
# A wall hides what is behind it. Cells that no ray has hit are `NaN`, *not a number*. Zero would
# be wrong: it would claim that the ground there is level.

# %%
import numpy as np

from fgtutor import ElevationMap

heights = M.heights.copy()
heights[40:50, 14:26] = np.nan  # hidden behind something, say
seen = ElevationMap(heights, resolution=M.resolution)
draw_elevation(seen)

# %% [markdown]
# A network cannot compute with `NaN`. So `filled()` guesses: it takes the nearest known height.
# `known` remembers which cells were guessed, and the planner will treat those as blocked.

# %%
filled = seen.filled()
print("heights missing:", np.isnan(filled.heights).sum())
print("cells never seen:", (~filled.known).sum())
assert (~filled.known).sum() == 10 * 12

# %% [markdown]
# ## A robot needs only its surroundings: the patch
#
# To take its next steps, a robot needs only the ground around it. So we lay a small grid of
# points around the robot, turned to face where it faces, and read the height under each point:
# the **patch** $H_{x,y} \in \mathbb R^{w \times h}$.

# %%
from fgtutor.patches import PatchGrid

grid = PatchGrid()
rows, columns = grid.shape
print(f"{rows} x {columns} points, {grid.spacing} m apart: {grid.num_points} numbers")

# %%
from fgtutor.course.patch_pictures import draw_windows

eastward, askew = (3.4, 2.0, 0.0), (5.6, 1.4, 0.9)  # x, y in metres; yaw in radians
draw_windows(M, [eastward, askew], grid)

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
# *What to see:* the small box is the robot, the line in it points ahead. Everything is told **from
# the robot's point of view**: *40 cm ahead of me, the ground falls*. The patch no longer says where
# on the map the robot is.
#
# ## The same by hand
#
# Three steps make a patch. **One:** turn the grid's points $q$ by the robot's yaw $\psi$ and move
# them to the robot at $p = (x, y)$:
#
# $$
# p + R(\psi)\, q, \qquad
# R(\psi) = \begin{pmatrix} \cos\psi & -\sin\psi \\ \sin\psi & \cos\psi \end{pmatrix}.
# $$

# %%
x, y, yaw = askew
R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
points = grid.points.numpy() @ R.T + (x, y)

# %% [markdown]
# **Two:** turned points fall *between* the centres of cells. So the height is a mean of the four
# nearest cells, weighted by how near each is (*bilinear* interpolation). With $a, b \in [0, 1)$
# the fractions of a cell from one centre to the next along x and y,
#
# $$
# h = (1-a)(1-b)\,h_{00} + a(1-b)\,h_{10} + (1-a)\,b\,h_{01} + a\,b\,h_{11}.
# $$


# %%
def height_at(x, y):
    u, v = (x - x0) / r - 0.5, (y - y0) / r - 0.5  # in cells, from the centre of cell (0, 0)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    h = M.heights
    near = (1 - a) * (1 - b) * h[i, j] + a * (1 - b) * h[i + 1, j]
    return near + (1 - a) * b * h[i, j + 1] + a * b * h[i + 1, j + 1]


# %% [markdown]
# **Three:** subtract the ground under the robot, the median of the points in the box. The median,
# because one stone under a wheel must not lift the whole world.

# %%
raw = np.array([height_at(*point) for point in points])
by_hand = raw - np.median(raw[grid.footprint_index])
assert np.allclose(by_hand, patch_at(M, askew, grid), atol=1e-4), "not what the library cuts"
print("the same 187 numbers as the library's")

# %%
from fgtutor.course.ask import predict, reveal

predict(
    "Lift the whole world by 100 m. How far does the patch change?",
    ["by 100 m at every point", "not at all", "only under the robot"],
)

# %%
lifted = ElevationMap(M.heights + 100.0, resolution=M.resolution)
difference = (patch_at(lifted, askew, grid) - patch_at(M, askew, grid)).abs().max()
assert difference < 1e-3
reveal(f"Not at all: by {difference:.5f} m, which is rounding. Step three removes the altitude.")

# %% [markdown]
# So a network that has learned on the beach can be used on a mountain.
#
# **Move it yourself.** Slide the robot over the map and turn it. Where does the patch look the
# same at two places?

# %%
from fgtutor.course.widgets.slides import PatchSlides

PatchSlides(M, grid)

# %% [markdown]
# ## One place, eight directions
#
# Now the main point of this notebook. Here is the simplest obstacle there is: a single ledge,
# flat below, flat above. The robot stands just before it and turns through the eight **headings**
# of this course, $k = 0 \dots 7$: heading 0 is +x, each next one is turned by 45 degrees.

# %%
predict(
    "Which two headings show patches that are mirror images of each other?",
    ["0 and 4", "2 and 6", "none: each patch is different"],
)

# %%
from fgtutor.course.patch_pictures import patch_rose

heights = np.zeros((40, 40))
heights[20:] = 0.15  # from x = 2 m on, the ground is 15 cm higher
ledge = ElevationMap(heights, resolution=0.1)
patch_rose(ledge, 1.75, 2.0, grid)

# %%
patch_of = {
    k: patch_at(ledge, (1.75, 2.0, k * np.pi / 4), grid).reshape(rows, columns) for k in range(8)
}
assert (patch_of[2] - patch_of[6].flip(1)).abs().max() < 1e-4  # mirrored left to right
assert (patch_of[0] - patch_of[4]).abs().max() > 0.1
reveal("2 and 6: both run along the ledge, one with it on the right, one on the left.")

# %% [markdown]
# *What to see:* heading 0 has a wall in front. Heading 4 has it behind, where it does not matter.
# One cell of the map asks the robot eight different questions.

# %% [markdown]
# ## Up is not down
#
# Now compare two robots that cross the *same* ledge, one up and one down. The middle line of a
# patch is the profile of the ground along the robot's path.

# %%
ahead = grid.points.reshape(rows, columns, 2)[:, columns // 2, 0]
up = patch_at(ledge, (1.65, 2.0, 0.0), grid).reshape(rows, columns)[:, columns // 2]
down = patch_at(ledge, (2.35, 2.0, np.pi), grid).reshape(rows, columns)[:, columns // 2]
assert (up + down).abs().max() < 1e-4  # the same ledge with the opposite sign

# %%
from fgtutor.figures.charts import draw_curves

draw_curves(
    ahead,
    {"up the ledge (heading 0)": up, "down the ledge (heading 4)": down},
    title="The same ledge from its two sides",
    xlabel="ahead of the robot (m)",
    ylabel="height (m)",
)

# %% [markdown]
# The robot of the next notebook has wheels with a radius of 9 cm. To it a ledge of 15 cm is a wall
# on the way up and a drop on the way down. A classical **costmap** stores *one* number per cell: it
# calls this ledge either passable both ways or blocked both ways, and one of the two is wrong
# (paper, Sec. I). So from here on there are $d = 8$ numbers per cell.

# %% [markdown]
# ## Turn the world, and the headings turn with it
#
# This check catches most mistakes with axes and angles: rotate the map by 90 degrees and rotate
# the pose with it. The robot must see exactly what it saw. Heading $k$ has become $k + 2$.

# %%
x, y, yaw = 1.75, 1.2, 0.0
turned = ledge.rotated90()  # counter-clockwise about (0, 0): (x, y) goes to (-y, x)
before = patch_at(ledge, (x, y, yaw), grid)
after = patch_at(turned, (-y, x, yaw + np.pi / 2), grid)
assert (after - before).abs().max() < 1e-4
print(f"largest difference: {(after - before).abs().max():.6f} m")

# %% [markdown]
# ## How deep is a hole?
#
# For a robot that cannot climb out, a slot of half a metre and one of ten metres are equally bad.
# But ten metres is a huge number for a network, and the shape of the ground would be lost beside
# it. So before patches are cut, deep holes are raised to 30 cm. (This is ours, not the paper's.)

# %%
from fgtutor import patches

G = make_terrain("gaps", robot="toy", seed=3).elevation
middle = G.shape[1] // 2
prepared = patches.prepare(G).heights[:, middle]
assert G.heights[:, middle].min() < prepared.min() < -0.2
draw_curves(
    G.centres[0],
    {"as scanned": G.heights[:, middle], "as patches see it": prepared},
    title="Gaps, cut lengthwise",
    xlabel="x (m)",
    ylabel="height (m)",
)

# %% [markdown]
# The simulation keeps the true depth: a robot that drives in falls.

# %% [markdown]
# ## What you now know
#
# - A map $\mathcal M$ holds one height per cell, x first; unknown cells are `NaN` until filled, and
#   stay marked as unknown.
# - A patch $H_{x,y}$ is cut around a pose: rotate, interpolate, subtract the ground.
# - It knows neither the place nor the altitude. It does know the heading.
# - Up a ledge and down it are different questions, so every cell gets eight answers.
#
# **Test yourself**
#
# <details><summary>1. The map's corner is at (1, 2) m and cells are 0.5 m wide. Which cell holds
# the point (1.7, 2.2)?</summary>
#
# (0.7 / 0.5, 0.2 / 0.5) = (1.4, 0.4), rounded down: cell (1, 0).
# </details>
#
# <details><summary>2. Why the median under the robot, not the mean?</summary>
#
# A stone under one wheel changes the mean, and with it every height of the patch. The median stays.
# </details>
#
# <details><summary>3. A map is rotated by 90 degrees counter-clockwise. Where are the numbers of
# heading 7 now?</summary>
#
# At heading (7 + 2) mod 8 = 1, and in the rotated cell.
# </details>

# %% [markdown]
# ## What to try
#
# - Move the rose to `x = 2.0`, right onto the ledge. What is "the ground under the robot" there?
#   <details><summary>Answer</summary>The points under the robot lie half below and half above;
#   those on the edge itself are interpolated to 7.5 cm, and that is the median. So ahead the ground
#   is 7.5 cm higher, and behind 7.5 cm lower.</details>
# - Draw other terrains: `"slopes"`, `"rubble"`, `"bridge"`, `"valley"`, `"stairs"`. In the middle
#   of which of them do headings 0 and 4 see the same?
#   <details><summary>Answer</summary>Where the ground does not change along x and is symmetric
#   about the line through the robot: on a straight bridge and in a straight valley.</details>
# - Set `PatchGrid(ahead=0.2)`. What would a robot miss at 1 m/s?
#   <details><summary>Answer</summary>It sees 0.2 s ahead: five decisions of the toy, which decides
#   25 times per second, until its centre is there. Its front wheel, 25 cm ahead of the centre, is
#   already past what the patch shows.</details>
#
# **Exercises:** [exercises/ex01.ipynb](../exercises/ex01.ipynb). **Next:** a robot that falls,
# [02_a_robot_that_falls.ipynb](02_a_robot_that_falls.ipynb).
