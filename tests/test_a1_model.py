import itertools

import mujoco
import numpy as np
import pytest

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.robots.a1 import ground
from fgtutor.robots.a1 import model as a1_model
from fgtutor.robots.a1.looks import dress
from fgtutor.world.boxes import Box
from fgtutor.world.terrain import make_terrain

SLICES = a1_model.sensor_slices()


@pytest.fixture(scope="module")
def model():
    return a1_model.build_spec().compile()


def in_stance(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return data


# Constants ----------------------------------------------------------------------------------------


def test_mass_is_the_sum_of_the_published_links(model):
    # trunk 6.0, and four times hip 0.696 + thigh 1.013 + calf 0.166 + foot 0.06
    assert model.body_mass.sum() == pytest.approx(6.0 + 4 * 1.935)


def test_calf_and_foot_combine_to_what_mujoco_menagerie_publishes(model):
    # mujoco_menagerie/unitree_a1/a1.xml lumps the same two links, with another program.
    calf = model.body("FL_calf")
    assert calf.mass.item() == pytest.approx(0.226)
    assert calf.ipos == pytest.approx([0.00472659, 0.0, -0.131975], abs=1e-6)
    assert calf.inertia == pytest.approx([0.00340344, 0.00339393, 3.54834e-05], rel=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "centre", "products"),
    [  # FR, FL, RR, RL as the URDF writes them out
        (1, -1, (-0.003311, -0.000635, 3.1e-05), (9.409e-06, -3.42e-07, 4.66e-07)),
        (1, 1, (-0.003311, 0.000635, 3.1e-05), (-9.409e-06, -3.42e-07, -4.66e-07)),
        (-1, -1, (0.003311, -0.000635, 3.1e-05), (-9.409e-06, 3.42e-07, 4.66e-07)),
        (-1, 1, (0.003311, 0.000635, 3.1e-05), (9.409e-06, 3.42e-07, -4.66e-07)),
    ],
)
def test_mirrored_hip_is_the_published_hip_of_the_other_legs(x, y, centre, products):
    hip = a1_model.mirrored(a1_model.HIP, x, y)
    assert hip.centre == centre
    assert hip.moments[3:] == products


def test_joints_and_actuators_come_in_the_documented_order(model):
    names = [model.joint(i).name for i in range(1, model.njnt)]
    assert tuple(names) == a1_model.JOINTS
    assert tuple(model.actuator(i).name for i in range(model.nu)) == a1_model.JOINTS
    assert [model.joint(name).qposadr[0] for name in a1_model.JOINTS] == list(range(7, 19))
    assert names[:4] == ["FR_hip", "FR_thigh", "FR_calf", "FL_hip"]


def test_joints_have_the_published_limits(model):
    for name in a1_model.JOINTS:
        low, high = a1_model.JOINT_RANGES[name[3:]]
        assert model.joint(name).range == pytest.approx([low, high])
        knee = name.endswith("calf")
        assert model.joint(name).armature.item() == (0.02 if knee else 0.01)


def test_torque_saturates_at_the_published_limit(model):
    data = in_stance(model)
    data.qpos[2] = 2.0
    data.ctrl[:] = 100.0 * np.resize((1, -1), 12)
    mujoco.mj_forward(model, data)
    assert np.abs(data.actuator_force) == pytest.approx(np.full(12, 33.5))


def test_gains_act_as_a_pd_controller(model):
    data = in_stance(model)
    data.ctrl[:] += 0.1
    data.qvel[6:] = 2.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force == pytest.approx(np.full(12, 35 * 0.1 - 0.5 * 2.0))


def test_link_lengths_put_the_feet_where_they_belong(model):
    data = in_stance(model)
    data.qpos[:7] = (0, 0, 1, 1, 0, 0, 0)
    data.qpos[7:] = 0.0
    mujoco.mj_forward(model, data)
    feet = data.sensordata[SLICES["foot_position"]].reshape(4, 3)
    # Straight legs: 0.1805 ahead, 0.047 + 0.0838 to the side, 0.2 + 0.2 down.
    expected = [(x * 0.1805, y * 0.1308, 0.6) for x, y in ((1, -1), (1, 1), (-1, -1), (-1, 1))]
    assert feet == pytest.approx(np.array(expected))


def test_mirrored_joints_mirror_the_feet(model):
    data, rng = in_stance(model), np.random.default_rng(0)
    ranges = np.array([model.joint(name).range for name in a1_model.JOINTS])
    angles = rng.uniform(ranges[:, 0], ranges[:, 1])
    feet = []
    for q in (angles, angles[list(a1_model.MIRROR)] * a1_model.MIRROR_SIGNS):
        data.qpos[7:] = q
        mujoco.mj_forward(model, data)
        feet.append(data.sensordata[SLICES["foot_position"]].reshape(4, 3).copy())
    assert feet[1][[1, 0, 3, 2]] * (1, -1, 1) == pytest.approx(feet[0])


def test_sensor_slices_name_the_sensors_of_the_model(model):
    names = [model.sensor(i).name for i in range(model.nsensor)]
    position = dict(zip(names, model.sensor_adr, strict=True))
    for group in ("foot_force", "foot_position", "foot_velocity"):
        starts = [position[f"{leg}_{group}"] for leg in a1_model.LEGS]
        assert starts == [SLICES[group].start + 3 * leg for leg in range(4)]
    assert position["FR_knee_contact"] == SLICES["leg_contact"].start
    assert position["RL_shin_contact"] == SLICES["leg_contact"].stop - 1
    assert position["trunk_contact"] == SLICES["trunk_contact"].start
    assert SLICES["accelerometer"] == slice(position["accelerometer"], model.nsensordata)


@pytest.mark.parametrize("field", ["kp", "torque_limit", "friction", "timestep"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_config_refuses_values_that_cannot_work(field, value):
    with pytest.raises(ConfigError, match=f"^{field}: "):
        a1_model.A1Config(**{field: value})


# Behaviour ----------------------------------------------------------------------------------------


def test_stands_for_two_seconds_on_the_floor(model):
    data = in_stance(model)
    for _ in range(400):
        mujoco.mj_step(model, data)
        assert 0.22 < data.qpos[2] < 0.30
    upright = 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)
    assert upright > 0.99
    mujoco.mj_forward(model, data)
    force = data.sensordata[SLICES["foot_force"]].reshape(4, 3).sum(axis=0)
    assert force[2] == pytest.approx(model.body_mass.sum() * 9.81, rel=0.02)
    assert data.sensordata[SLICES["accelerometer"]][2] == pytest.approx(9.81, rel=0.02)
    assert not data.sensordata[SLICES["leg_contact"]].any()
    assert not data.sensordata[SLICES["trunk_contact"]].any()


def test_a_lying_robot_reports_contacts_of_trunk_and_legs(model):
    data = in_stance(model)
    data.qpos[2] = 0.05
    mujoco.mj_forward(model, data)
    assert data.sensordata[SLICES["trunk_contact"]] == 4
    assert data.sensordata[SLICES["leg_contact"]].any()


def test_the_robot_never_collides_with_itself(model):
    data, rng = in_stance(model), np.random.default_rng(1)
    ranges = np.array([model.joint(name).range for name in a1_model.JOINTS])
    data.qpos[2] = 5.0
    for _ in range(50):
        data.qpos[7:] = rng.uniform(ranges[:, 0], ranges[:, 1])
        mujoco.mj_forward(model, data)
        assert data.ncon == 0


def test_visuals_change_nothing_but_the_looks(model):
    spec = a1_model.build_spec()
    dress(spec)
    pretty = spec.compile()
    assert pretty.ngeom > model.ngeom
    states = []
    for each in (model, pretty):
        data = in_stance(each)
        mujoco.mj_step(each, data, 50)
        states.append(data.qpos.copy())
    assert np.array_equal(*states)


# Terrain ------------------------------------------------------------------------------------------

RADIUS = 0.02


def drop(points, elevation, **terrain):
    """Drop spheres that can only fall, and return the height of the ground each came to rest on.

    On a slope a sphere touches ground beside its lowest point: its centre is then
    radius * sqrt(1 + slope^2) above the ground under it.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    for box in terrain.get("boxes", ()):
        ground.add_box(spec, box)
    if "heightfield" in terrain:
        ground.add_heightfield(spec, terrain["heightfield"])
    for x, y in points:
        body = spec.worldbody.add_body(pos=(x, y, float(elevation.height_at(x, y)) + 0.04))
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1), damping=(0.05, 0, 0))
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(RADIUS, 0, 0), mass=0.01, conaffinity=0
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 500)
    e = elevation.resolution / 4
    x, y = points.T
    dx = (elevation.height_at(x + e, y) - elevation.height_at(x - e, y)) / (2 * e)
    dy = (elevation.height_at(x, y + e) - elevation.height_at(x, y - e)) / (2 * e)
    return data.xpos[1:, 2] - RADIUS * np.sqrt(1 + dx**2 + dy**2)


def smooth_points(elevation, seed):
    """Draw points around which the map is one plane, so that all three must agree."""
    h = elevation.heights.astype(float)
    dx, dy = ((np.roll(h, -1, axis) - np.roll(h, 1, axis)) / 2 for axis in (0, 1))
    plane = np.full(h.shape, True)
    plane[:2], plane[-2:], plane[:, :2], plane[:, -2:] = False, False, False, False
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        plane &= np.abs(np.roll(h, (-i, -j), (0, 1)) - (h + i * dx + j * dy)) < 1e-4
    cells = np.random.default_rng(seed).permutation(np.argwhere(plane))
    # The lowest as well, or the few cells at the bottom of a slot would hardly ever be drawn.
    lowest = cells[np.argsort(h[*cells.T], kind="stable")]
    chosen = np.concatenate((cells[:30], lowest[:10]))
    return np.array([elevation.centre_of(*cell) for cell in chosen]) + 0.01


@pytest.mark.parametrize("name", ["steps", "gaps", "bridge", "valley", "slopes", "rubble"])
def test_spheres_come_to_rest_on_boxes_map_and_height_field_alike(name):
    terrain = make_terrain(name, robot="a1", difficulty=0.9, seed=3)
    points = smooth_points(terrain.elevation, seed=0)
    ground = terrain.elevation.height_at(*points.T)
    assert np.ptp(ground) > 0.05
    on_boxes = drop(points, terrain.elevation, boxes=terrain.boxes)
    on_field = drop(points, terrain.elevation, heightfield=terrain.elevation)
    assert on_boxes == pytest.approx(ground, abs=2e-3)
    assert on_field == pytest.approx(ground, abs=2e-3)


def test_a_tilted_box_turns_the_way_its_angles_say():
    # Roll of 30 degrees lifts the left side (+y); yaw of 90 degrees then turns +y to -x.
    box = Box(centre=(0, 0, 0), size=(2, 2, 0.2), rpy=(np.radians(30), 0, np.radians(90)))
    xs = np.arange(-0.5, 0.6, 0.1)
    # The upper face, 0.1 from the centre: z = -x tan 30 + 0.1 / cos 30.
    heights = (-xs * np.tan(np.radians(30)) + 0.1 / np.cos(np.radians(30)))[:, None]
    elevation = ElevationMap(np.repeat(heights, 11, axis=1), 0.1, origin=(-0.55, -0.55))
    points = np.array([(-0.3, 0.1), (0.0, 0.2), (0.3, -0.2)])
    assert drop(points, elevation, boxes=[box]) == pytest.approx(
        elevation.height_at(*points.T), abs=2e-3
    )


def test_a_flat_map_makes_a_flat_height_field():
    elevation = ElevationMap(np.full((8, 6), 0.25), 0.1, origin=(1.0, -2.0))
    points = np.array([(1.2, -1.7), (1.6, -1.6)])
    rest = drop(points, elevation, heightfield=elevation)
    assert rest == pytest.approx([0.25, 0.25], abs=2e-3)


def test_a_height_field_needs_every_height():
    heights = np.zeros((5, 5))
    heights[2, 3] = np.nan
    with pytest.raises(ConfigError, match="filled"):
        a1_model.build_spec(heightfield=ElevationMap(heights))
    a1_model.build_spec(heightfield=ElevationMap(heights).filled()).compile()


def test_terrain_replaces_the_floor():
    def kinds(spec):
        return {geom.type for geom in spec.worldbody.geoms}

    box = Box(centre=(0, 0, -0.5), size=(4, 4, 1))
    assert kinds(a1_model.build_spec()) == {mujoco.mjtGeom.mjGEOM_PLANE}
    assert kinds(a1_model.build_spec([box])) == {mujoco.mjtGeom.mjGEOM_BOX}
