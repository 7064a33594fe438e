"""The A1's scene: the same ground and the same joints as in physics, and a line painted right."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtutor.elevation import ElevationMap
from fgtutor.errors import RenderingError
from fgtutor.robots.a1 import looks as scenes
from fgtutor.robots.a1.env import A1Env
from fgtutor.robots.a1.looks import a1_scene, ground_colour
from fgtutor.robots.a1.model import JOINTS, STANCE
from fgtutor.robots.offscreen import COAT, Renderer, Shot
from fgtutor.world.terrain import Terrain, World, make_terrain

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
SIZE = {"width": 64, "height": 48}
LOOK = {**SIZE, "goal_radius": 0.2}


def plain(model: mujoco.MjModel, colour: tuple[float, float, float]) -> np.ndarray:
    """Return position and half size of every fixed shape of this colour, by x."""
    mine = (model.geom_bodyid == 0) & (model.geom_rgba[:, :3] == np.float32(colour)).all(axis=1)
    rows = np.column_stack((model.geom_pos[mine], model.geom_size[mine]))
    return rows[np.argsort(rows[:, 0])]


def height_under(model: mujoco.MjModel, x: float, y: float) -> float:
    """Return where a ray from above meets the scene, the robot left out."""
    data = mujoco.MjData(model)
    data.qpos[:3] = -50.0, -50.0, 50.0
    mujoco.mj_kinematics(model, data)
    distance = mujoco.mj_ray(
        model, data, (x, y, 5.0), (0.0, 0.0, -1.0), None, 1, -1, np.zeros(1, dtype=np.int32)
    )
    return 5.0 - distance


def waves() -> Terrain:
    x, y = np.mgrid[0:60, 0:40] * 0.05
    ground = ElevationMap(0.2 * np.sin(2 * x) + 0.1 * y, resolution=0.05)
    return Terrain.from_elevation(ground, (0.5, 1.0), (2.5, 1.0), robot="a1")


@pytest.mark.parametrize("name", ["mixed", "steps", "waves"])
def test_the_ground_is_that_of_the_map_in_the_terrains_frame(name):
    terrain = waves() if name == "waves" else make_terrain(name, robot="a1", seed=3)
    # The line's one point, with the flag, stands in a corner, out of the way of the rays.
    model = a1_scene(terrain, np.array([[0.2, 0.2]]), [], **LOOK)
    (nx, ny), rng = terrain.elevation.shape, np.random.default_rng(0)
    for ix, iy in rng.integers((15, 15), (nx - 5, ny - 5), (60, 2)).tolist():
        x, y = terrain.elevation.centre_of(ix, iy)
        assert height_under(model, x, y) == pytest.approx(
            terrain.elevation.heights[ix, iy], abs=2e-3
        )


def test_a_state_of_physics_means_the_same_here():
    terrain = make_terrain("flat", robot="a1")
    model = a1_scene(terrain, np.array([terrain.goal]), [], **LOOK)
    physics = A1Env(World([[terrain]]), 1).physics.model
    state = np.array((3.0, 2.0, 0.3, 1.0, 0.0, 0.0, 0.0, *STANCE)) + 0.01
    places = []
    for each in (physics, model):
        assert [each.joint(i).name for i in range(1, each.njnt)] == list(JOINTS)
        data = mujoco.MjData(each)
        data.qpos[:] = state
        mujoco.mj_kinematics(each, data)
        places.append(data.xpos[1:])
    np.testing.assert_allclose(places[0], places[1], atol=1e-12)
    assert model.material(COAT).id >= 0


def test_a_straight_level_line_of_one_colour_is_one_box():
    terrain = make_terrain("flat", robot="a1")
    x = np.arange(1.0, 5.01, 0.05)
    line = np.column_stack((x, np.full_like(x, 2.0)))
    model = a1_scene(terrain, line, [RED] * 40 + [BLUE] * 40, **LOOK)
    for colour, middle in ((RED, 2.0), (BLUE, 4.0)):
        (box,) = plain(model, colour)
        np.testing.assert_allclose(box[:3], (middle, 2.0, scenes.LIFT), atol=1e-6)
        np.testing.assert_allclose(box[3:], (1.0, scenes.WIDTH / 2, scenes.LIFT / 2), atol=1e-6)


def test_the_line_breaks_at_an_edge_and_follows_a_ramp():
    heights = np.zeros((80, 40))
    heights[20:40] = 0.15  # a ledge from x = 1 to x = 2, then a ramp of 0.4 from x = 3
    heights[60:] = 0.4 * 0.05 * np.arange(20)[:, None]
    terrain = Terrain.from_elevation(
        ElevationMap(heights, resolution=0.05), (0.5, 1.0), (3.5, 1.0), robot="a1"
    )
    model = a1_scene(terrain, np.array([(0.525, 1.025), (3.525, 1.025)]), [RED], **LOOK)
    boxes = plain(model, RED)
    level = boxes[boxes[:, 0] < 2.9]
    np.testing.assert_allclose(level[:, 2] - scenes.LIFT, (0.0, 0.15, 0.0), atol=1e-6)
    np.testing.assert_allclose(level[:2, 3], (0.225, 0.475), atol=1e-6)
    ramp = boxes[-1]
    # From the ramp's first cell to the last point: 0.5 m of run, 0.2 m of rise.
    assert ramp[3] == pytest.approx(np.hypot(0.5, 0.2) / 2, abs=1e-3)
    assert ramp[2] == pytest.approx(0.1 + scenes.LIFT, abs=1e-3)


def test_in_a_valley_the_line_floats_over_the_bottom():
    heights = np.abs(np.arange(40) - 19.5) * 0.05 * np.ones((80, 1))  # walls of 45 degrees
    terrain = Terrain.from_elevation(
        ElevationMap(heights, resolution=0.05), (0.5, 1.0), (3.5, 1.0), robot="a1"
    )
    model = a1_scene(terrain, np.array([(1.0, 1.0), (3.0, 1.0)]), [RED], **LOOK)
    (box,) = plain(model, RED)
    # The line is 5 cm wide: its edges lie over the cells beside the bottom, 2.5 cm high.
    assert box[2] == pytest.approx(0.025 + scenes.LIFT, abs=1e-6)


def test_the_goal_stands_at_the_lines_end_on_the_ground():
    terrain = make_terrain("steps", robot="a1", seed=3)
    spot = terrain.elevation.centre_of(80, 40)
    model = a1_scene(terrain, np.array([spot]), [], **LOOK)
    disc = plain(model, scenes.GOAL)
    disc = disc[np.argmax(disc[:, 3])]
    z = terrain.elevation.heights[80, 40]
    np.testing.assert_allclose(disc[:4], (*spot, z, 0.2), atol=1e-6)


@pytest.mark.slow
def test_a_height_field_has_its_colours_in_the_right_places():
    """Draw a hill on the left of a pit, seen along +x from above."""
    x, y = np.mgrid[0:80, 0:80] * 0.05
    heights = 0.3 * (np.hypot(x - 2, y - 3) < 0.5) - 0.3 * (np.hypot(x - 2, y - 1) < 0.5)
    # The slight slope keeps it from being taken for a map of blocks.
    ground = ElevationMap(heights + 0.001 * (x + y), resolution=0.05)
    terrain = Terrain.from_elevation(ground, (0.5, 2.0), (3.8, 2.0), robot="a1")
    model = a1_scene(terrain, np.array([terrain.goal]), [], **LOOK)
    assert model.nhfield == 1
    away = np.array((2.0, 2.0, -9.0, 1.0, 0.0, 0.0, 0.0, *STANCE))
    shot = Shot(qpos=away, target=(2.0, 2.0, 0.0), distance=5.0, azimuth=0.0, elevation=-90.0)
    try:
        with Renderer(model, **SIZE) as renderer:
            picture = renderer.draw(shot).astype(int)
    except RenderingError as error:
        pytest.skip(str(error))
    warmth = picture[20:28, :, 0] - picture[20:28, :, 2]
    assert warmth[:, 8:32].max() > 40 and warmth[:, 8:32].min() > 0
    assert warmth[:, 32:56].min() < -30


@given(z=st.floats(-3, 3))
@settings(max_examples=40)
def test_pits_are_blue_ground_is_light_and_walls_are_brown(z):
    red, _, blue = ground_colour(z)
    assert min(red, blue) >= 0 and max(red, blue) <= 1
    if z <= -0.1 or z >= 0:
        assert (blue > red) == (z < 0)
    assert sum(ground_colour(z)) <= sum(ground_colour(0.0)) + 1e-12
    np.testing.assert_allclose(ground_colour(np.array([z, 0.0]))[0], ground_colour(z))
