"""Menagerie's A1: what its file publishes is what is simulated, and our environment drives it."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from fgtutor.robots.a1 import model as a1_model
from fgtutor.robots.a1.env import A1Env, A1EnvConfig
from fgtutor.robots.a1.menagerie import MenagerieConfig
from fgtutor.robots.a1.randomise import UNDISTURBED
from fgtutor.world.terrain import World, make_terrain

SLICES = a1_model.sensor_slices()


@pytest.fixture(scope="module")
def model():
    return a1_model.build_spec(config=MenagerieConfig()).compile()


def standing(model, seconds=1.0):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def test_it_has_the_published_masses_and_joints(model):
    # trunk 4.713, and four times hip 0.696 + thigh 1.013 + calf with foot 0.226
    assert model.body_mass.sum() == pytest.approx(4.713 + 4 * 1.935)
    names = [model.joint(i).name for i in range(1, model.njnt)]
    assert tuple(names) == a1_model.JOINTS
    assert model.dof_damping[6:].tolist() == [1.0, 2.0, 2.0] * 4
    assert set(model.dof_frictionloss[6:]) == {0.2} and set(model.dof_armature[6:]) == {0.01}
    assert model.actuator_ctrllimited.all()
    assert model.ngeom == 1 + 36  # the floor, 8 shapes of the trunk and 7 of each leg


@pytest.mark.parametrize(
    ("leg", "hip", "thigh", "place"),
    [  # as the file writes them out: centre of mass of hip and thigh, and where the hip is
        ("FR", (-0.003311, -0.000635), (-0.003237, 0.022327), (0.183, -0.047)),
        ("FL", (-0.003311, 0.000635), (-0.003237, -0.022327), (0.183, 0.047)),
        ("RR", (0.003311, -0.000635), (-0.003237, 0.022327), (-0.183, -0.047)),
        ("RL", (0.003311, 0.000635), (-0.003237, -0.022327), (-0.183, 0.047)),
    ],
)
def test_every_leg_is_on_its_side(model, leg, hip, thigh, place):
    assert model.body(f"{leg}_hip").ipos[:2] == pytest.approx(hip)
    assert model.body(f"{leg}_thigh").ipos[:2] == pytest.approx(thigh)
    assert model.body(f"{leg}_hip").pos[:2] == pytest.approx(place)


def test_left_and_right_legs_have_mirrored_inertia(model):
    def inertia(name):
        """Return the inertia of a body about its own axes."""
        body, frame = model.body(name), np.zeros(9)
        mujoco.mju_quat2Mat(frame, body.iquat)
        axes = frame.reshape(3, 3)
        return axes @ np.diag(body.inertia) @ axes.T

    flip = np.diag([1.0, -1.0, 1.0])
    for link in a1_model.LINKS:
        for end in "FR":
            left, right = inertia(f"{end}L_{link}"), inertia(f"{end}R_{link}")
            assert left == pytest.approx(flip @ right @ flip, abs=2e-8)


def test_it_is_nearly_the_robot_that_the_maker_publishes(model):
    """Two files, two programs: the links' centres and inertias must agree."""
    ours = a1_model.build_spec().compile()
    for leg in a1_model.LEGS:
        for link in a1_model.LINKS:
            body, other = (each.body(f"{leg}_{link}") for each in (model, ours))
            assert body.mass == pytest.approx(other.mass)
            assert body.ipos == pytest.approx(other.ipos, abs=1e-6)
            assert body.inertia == pytest.approx(other.inertia, rel=1e-4)


def test_it_stands_and_its_feet_carry_it(model):
    data = standing(model)
    assert 0.22 < data.qpos[2] < 0.30
    force = data.sensordata[SLICES["foot_force"]].reshape(4, 3).sum(axis=0)
    assert force[2] == pytest.approx(model.body_mass.sum() * 9.81, rel=0.02)
    assert not data.sensordata[SLICES["trunk_contact"]].any()


def test_it_touches_itself_and_only_the_ground_counts(model):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2], touched = 5.0, 0
    ranges = np.array([model.joint(name).range for name in a1_model.JOINTS])
    for _ in range(100):
        data.qpos[7:] = rng.uniform(ranges[:, 0], ranges[:, 1])
        mujoco.mj_forward(model, data)
        touched += data.ncon
        assert not data.sensordata[SLICES["foot_force"]].any()
        assert not data.sensordata[SLICES["leg_contact"]].any()
    assert touched > 0
    data.qpos[2] = 0.05
    mujoco.mj_forward(model, data)
    assert data.sensordata[SLICES["trunk_contact"]].any()


def test_our_environment_drives_it():
    terrain = make_terrain("flat", robot="a1")
    settings = A1EnvConfig(randomise=False, noise=False, substeps=10)
    env = A1Env(World([[terrain]]), 2, settings=settings, model=MenagerieConfig())
    assert env.control_dt == pytest.approx(0.02)
    for _ in range(10):
        observations, *_ = env.step(torch.zeros(2, 12))
    assert torch.isfinite(observations["policy"]).all() and not env.fallen().any()


def test_its_feet_get_the_friction_that_is_drawn():
    terrain = make_terrain("flat", robot="a1")
    settings = replace(UNDISTURBED, substeps=10, friction=(0.3, 0.3))
    env = A1Env(World([[terrain]]), 2, settings=settings, model=MenagerieConfig())
    friction = env.physics.parameter("geom_friction")
    for leg in a1_model.LEGS:
        foot = env.physics.model.geom(f"{leg}_foot").id
        assert friction[:, foot].tolist() == [[0.3, 0.02, 0.01]] * 2
    assert friction[:, env.physics.model.geom("RL_shin").id, 0].tolist() == [0.6] * 2
