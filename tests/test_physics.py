import mujoco
import numpy as np
import pytest
import torch

from fgtutor.errors import ConfigError, SimulationError
from fgtutor.robots.a1 import model as a1_model
from fgtutor.robots.a1.physics import Physics
from fgtutor.world.terrain import make_terrain

SIMS = 6


@pytest.fixture(scope="module")
def model():
    terrain = make_terrain("steps", robot="a1", difficulty=0.5, seed=1)
    return a1_model.build_spec(terrain.boxes).compile()


def controls(step):
    """Give every simulation its own shaky controls, the same whenever they are asked for."""
    rng = np.random.default_rng(step)
    return torch.tensor(a1_model.STANCE) + torch.from_numpy(rng.uniform(-0.4, 0.4, (SIMS, 12)))


def place(physics):
    physics.qpos[:, 0] = 0.5 + torch.arange(physics.num_sims)
    physics.qpos[:, 1] = 2.0
    physics.qpos[:, 2] = 0.6
    physics.forward()


def drive(physics, steps=15):
    for step in range(steps):
        physics.ctrl[:] = controls(step)
        physics.step(4)
    return physics.qpos.clone(), physics.qvel.clone(), physics.sensors.clone()


def same(first, second, sims=slice(None)):
    return all(torch.equal(a[sims], b[sims]) for a, b in zip(first, second, strict=True))


def test_starts_at_the_keyframe(model):
    physics = Physics(model, SIMS, threads=1)
    assert physics.num_sims == SIMS
    assert torch.equal(physics.qpos[3], torch.from_numpy(model.key_qpos[0]))
    assert torch.equal(physics.ctrl[3], torch.tensor(a1_model.STANCE, dtype=torch.float64))


def test_starts_at_the_defaults_without_a_keyframe():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(pos=(1, 2, 3))
    body.add_freejoint()
    body.add_geom(size=(0.1, 0, 0))
    physics = Physics(spec.compile(), 2, threads=1)
    assert physics.qpos[1].tolist() == [1, 2, 3, 1, 0, 0, 0]


def test_results_are_bit_identical_at_one_and_two_threads(model):
    results = []
    for threads in (1, 2):
        physics = Physics(model, SIMS, threads=threads)
        place(physics)
        results.append(drive(physics))
    assert same(*results)
    assert torch.isfinite(results[0][0]).all()


def test_results_equal_a_plain_loop_over_mujoco(model):
    physics = Physics(model, SIMS, threads=2)
    place(physics)
    start = physics.qpos.clone()
    qpos, qvel, sensors = drive(physics, 5)
    for sim in (0, SIMS - 1):
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[:] = start[sim].numpy()
        mujoco.mj_forward(model, data)
        for step in range(5):
            data.ctrl[:] = controls(step)[sim].numpy()
            mujoco.mj_step(model, data, 4)
        mujoco.mj_step1(model, data)
        assert np.array_equal(data.qpos, qpos[sim].numpy())
        assert np.array_equal(data.qvel, qvel[sim].numpy())
        assert np.array_equal(data.sensordata, sensors[sim].numpy())


def test_tensors_share_memory_with_the_simulator(model):
    physics = Physics(model, SIMS, threads=1)
    qpos, height = physics.qpos, physics.derived("xpos")
    qpos[2, 2] = 1.75
    physics.forward()
    assert height[2, model.body("trunk").id, 2] == 1.75
    physics.step(4)
    assert physics.qpos.data_ptr() == qpos.data_ptr()
    assert height[2, model.body("trunk").id, 2] == qpos[2, 2] < 1.75


def test_sensors_of_positions_and_velocities_are_current_after_a_step(model):
    physics = Physics(model, SIMS, threads=1)
    place(physics)
    drive(physics, 20)
    slices = a1_model.sensor_slices()
    after_step = physics.sensors.clone()
    physics.forward(torch.tensor([0, 1]))
    for name in ("foot_position", "foot_velocity"):
        assert torch.equal(physics.sensors[:, slices[name]], after_step[:, slices[name]])
    force = slices["foot_force"]
    moved = (physics.sensors[:, force] != after_step[:, force]).any(dim=1)
    assert moved[:2].all()
    assert not moved[2:].any()


def test_reset_touches_only_the_simulations_named(model):
    physics = Physics(model, SIMS, threads=2)
    place(physics)
    before = drive(physics, 3)
    physics.reset(torch.tensor([1, 4]))
    assert torch.equal(physics.qpos[1], torch.from_numpy(model.key_qpos[0]))
    assert not physics.qvel[4].any()
    others = torch.tensor([0, 2, 3, 5])
    assert torch.equal(physics.qpos[others], before[0][others])
    none = torch.tensor([], dtype=torch.long)
    physics.reset(none)
    physics.forward(none)
    assert torch.equal(physics.qpos[others], before[0][others])


@pytest.mark.parametrize("field", ["qpos", "qvel", "ctrl"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_explosion_stays_in_its_simulation(model, field, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    healthy, hurt = (Physics(model, SIMS, threads=2) for _ in range(2))
    for physics in (healthy, hurt):
        place(physics)
        drive(physics, 3)
    assert hurt.exploded().tolist() == []
    for physics in (healthy, hurt):
        physics.ctrl[:] = controls(3)
    getattr(hurt, field)[3].view(-1)[7] = value
    healthy.step(4)
    hurt.step(4)
    assert hurt.exploded().tolist() == [3]
    assert healthy.exploded().tolist() == []
    assert torch.isfinite(hurt.qpos).all()
    assert torch.isfinite(hurt.sensors).all()
    others = torch.tensor([0, 1, 2, 4, 5])
    assert torch.equal(healthy.qpos[others], hurt.qpos[others])
    assert torch.equal(healthy.sensors[others], hurt.sensors[others])

    hurt.reset(torch.tensor([3]))
    healthy.reset(torch.tensor([3]))
    assert hurt.exploded().tolist() == []
    assert same(drive(healthy, 3), drive(hurt, 3))
    # MuJoCo would otherwise leave a log file in the working directory.
    assert not list(tmp_path.iterdir())


def test_a_state_written_as_nan_shows_before_the_next_step(model):
    physics = Physics(model, SIMS, threads=1)
    physics.qvel[5, 0] = float("nan")
    assert physics.exploded().tolist() == [5]


def test_parameters_differ_between_simulations():
    model = a1_model.build_spec().compile()
    physics = Physics(model, 3, threads=1)
    trunk = model.body("trunk").id
    physics.parameter("body_mass")[1, trunk] += 3.0
    physics.set_const()
    for _ in range(100):
        physics.step(4)
    physics.forward()
    feet = physics.sensors[:, a1_model.sensor_slices()["foot_force"]].reshape(3, 4, 3)
    weight = feet[:, :, 2].sum(dim=1) / 9.81
    assert weight.tolist() == pytest.approx([13.74, 16.74, 13.74], rel=0.02)


@pytest.mark.parametrize(("sims", "threads"), [(0, 1), (-3, 1), (4, -1)])
def test_counts_that_make_no_sense_are_refused(model, sims, threads):
    with pytest.raises(ConfigError, match=r"(num_sims|threads): should be greater than"):
        Physics(model, sims, threads=threads)


def heap(memory):
    """A heap of boxes with so many contacts that they do not fit into `memory` bytes."""
    spec = mujoco.MjSpec()
    spec.memory = memory
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 1))
    for i in range(30):
        body = spec.worldbody.add_body(pos=(0.05 * i, 0, 0.05))
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.1, 0.1, 0.1))
    return spec.compile()


def test_a_model_that_mujoco_cannot_step_is_a_typed_error():
    with pytest.raises(SimulationError, match="memory"):
        Physics(heap(20_000), 2, threads=1)


def test_dropped_contacts_are_a_warning():
    with pytest.warns(RuntimeWarning, match="Too many contacts"):
        Physics(heap(100_000), 2, threads=1)
