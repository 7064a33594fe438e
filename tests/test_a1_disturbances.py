"""Each disturbance of the A1, alone, from its field to what it does."""

import dataclasses
import math

import pytest
import torch

from fgtutor.errors import ConfigError
from fgtutor.robots.a1.env import A1_EPISODES, A1Env
from fgtutor.robots.a1.model import STANCE
from fgtutor.robots.a1.randomise import DISTURBED, UNDISTURBED, WIDE, A1EnvConfig
from fgtutor.robots.a1.sensing import leg_odometry
from fgtutor.specialist import ZOO, load_specialist
from fgtutor.world.terrain import World, make_terrain

STILL = dataclasses.replace(A1_EPISODES, train=False, stuck_seconds=math.inf)
FLAT = make_terrain("flat", robot="a1")


def make(n=8, *, base=UNDISTURBED, config=STILL, terrain=FLAT, seed=0, **axes):
    """Return robots that stand on flat ground under the disturbances given."""
    settings = dataclasses.replace(base, **axes)
    env = A1Env(World([[terrain]]), n, config=config, settings=settings, seed=seed, threads=1)
    y = torch.linspace(-0.2, 0.2, n) + 2.0
    poses = torch.stack((torch.full((n,), 2.0), y, torch.zeros(n)), dim=-1)
    poses[:, :2] += env.offsets[0, 0]
    env.start(torch.arange(n), poses, 0.6)
    return env


def walk(env, steps, seen=None):
    """Let the shipped walker walk; `seen` is called after each step."""
    walker = load_specialist(ZOO / "a1" / "_walker")
    observations = env.get_observations()
    for _ in range(steps):
        observations, *_ = env.step(walker.act(observations))
        if seen:
            seen(observations)


def test_no_disturbance_is_the_model_as_it_is():
    plain, same = (
        make(base=base) for base in (A1EnvConfig(randomise=False, noise=False), UNDISTURBED)
    )
    walk(plain, 40)
    walk(same, 40)
    assert torch.allclose(plain.pose, same.pose, atol=1e-5)
    assert not same.traits.any()


@pytest.mark.parametrize(
    ("axes", "name", "expected"),
    [
        ({"friction": (0.3, 0.3)}, "opt.o_friction", lambda m: [0.3, 0.3]),
        ({"payload": (2.0, 2.0)}, "body_mass", lambda m: m.body_mass[1] + 2.0),
        ({"joint_damping": (1.5, 1.5)}, "dof_damping", lambda m: [1.51] * 12),
        ({"dry_friction": (0.2, 0.2)}, "dof_frictionloss", lambda m: [0.2] * 12),
        ({"strength": (0.8, 0.8)}, "actuator_forcerange", lambda m: [-26.8, 26.8]),
    ],
)
def test_an_axis_alone_sets_its_parameter(axes, name, expected):
    env = make(3, **axes)
    value = env.physics.parameter(name)[1]
    own = torch.as_tensor(expected(env.physics.model), dtype=torch.float64)
    part = {"opt.o_friction": value[:2], "body_mass": value[1], "actuator_forcerange": value[4]}
    assert torch.allclose(part.get(name, value[6:]), own)


def test_strength_scales_both_gains_and_the_rate_gain_one():
    env = make(2, strength=(0.8, 0.8), rate_gain=(2.0, 2.0))
    assert torch.allclose(
        env.physics.parameter("actuator_gainprm")[0, :, 0], torch.tensor(28.0).double()
    )
    bias = env.physics.parameter("actuator_biasprm")[0]
    assert torch.allclose(bias[:, 1], torch.tensor(-28.0).double())
    assert torch.allclose(bias[:, 2], torch.tensor(-0.5 * 2 * 0.8).double())


def test_ranges_are_filled_evenly():
    env = make(200, base=WIDE, calm_share=0.0)
    damping = env.physics.parameter("dof_damping")[:, 8] - 0.01
    assert 0 <= damping.min() < 0.05 and 1.95 < damping.max() <= 2.0
    assert damping.median() == pytest.approx(1.0, abs=0.2)
    delays = env.physics.parameter("actuator_delay")[:, 0] / 0.005
    assert set(delays.round().tolist()) == set(range(9))  # 0 to 40 ms in steps of 5 ms
    assert env.traits.abs().max() < 2.5 and (env.traits.std(dim=0) > 0.1).all()


def test_a_delay_is_kept_within_a_control_step_and_beyond_it():
    """Three simulation steps late: as if the robot had stood still for so long at first."""
    actions = 0.5 * torch.randn(20, 1, 12, generator=torch.Generator().manual_seed(0))
    late = make(1, substeps=1, delay=(0.015, 0.015), encoder_offset=0.01)
    prompt = make(1, substeps=1, encoder_offset=0.01)
    for k in range(20):
        late.step(actions[k])
        prompt.step(actions[k - 3] if k >= 3 else torch.zeros(1, 12))
    assert torch.equal(late.physics.qpos, prompt.physics.qpos)
    coarse = make(1, delay=(0.015, 0.015), encoder_offset=0.01)
    fine = make(1, substeps=1, encoder_offset=0.01)
    for k in range(4):
        coarse.step(actions[k])
        for j in range(4):
            fine.step(actions[(4 * k + j - 3) // 4] if 4 * k + j >= 3 else torch.zeros(1, 12))
    assert torch.equal(coarse.physics.qpos, fine.physics.qpos)


def test_a_new_episode_forgets_the_actions_of_the_last_one():
    env = make(2, delay=(0.04, 0.04))
    fresh = env.physics.qpos[0].clone()
    for _ in range(3):
        env.step(torch.ones(2, 12))
    env.start(torch.tensor([0]), torch.tensor([[*fresh[:2].tolist(), 0.0]]), 0.6)
    assert torch.equal(env.physics.qpos[0], fresh)
    env.step(torch.ones(2, 12))
    other = make(2, delay=(0.04, 0.04))
    other.step(torch.zeros(2, 12))
    assert torch.allclose(env.physics.qpos[0], other.physics.qpos[0], atol=1e-6)


@pytest.mark.slow
def test_what_the_policy_is_told_of_its_velocity():
    told = {}
    for knows in ("true", "none", "error", "odometry"):
        env = make(40, velocity=knows, velocity_error=0.2)
        errors = []
        walk(
            env,
            100,
            lambda seen, env=env, errors=errors: errors.append(
                seen["policy"][:, :3] / 2 - env.body_velocity
            ),
        )
        told[knows] = torch.stack(errors)[25:]
    assert told["true"].abs().max() < 1e-6
    # In error by 0.2 m/s on each axis, and still so 0.1 s later: exp(-0.1 / 0.5) = 0.82.
    wrong = told["error"]
    assert wrong.std().item() == pytest.approx(0.2, rel=0.15)
    kept = (wrong[5:] * wrong[:-5]).mean() / wrong.square().mean()
    assert kept.item() == pytest.approx(math.exp(-0.1 / 0.5), abs=0.1)
    # The legs know it to a few centimetres per second.
    assert told["odometry"].square().mean().sqrt() < 0.1
    assert told["none"].abs().max() > 0.4


def test_odometry_by_hand():
    """A leg that swings back at 2 rad/s about the hip, foot straight below: v = w (l + r)."""
    joints = torch.tensor([[0.0, 0.8, -1.6] * 4])
    rates = torch.tensor([[0.0, 2.0, 0.0] * 4])
    up = torch.tensor([[0.0, 0.0, 1.0]])
    force = torch.tensor([[50.0, 0.0, 0.0, 20.0]])
    velocity, weight = leg_odometry(joints, rates, torch.zeros(1, 3), up, force)
    reach = 0.2 * (math.cos(0.8) + math.cos(0.8)) + 0.02
    assert velocity[0].tolist() == pytest.approx([2 * reach, 0, 0], abs=1e-6)
    assert weight.item() == pytest.approx(1.5)
    # Still joints under a trunk that turns left: its right side, whose foot stands, goes ahead.
    still = torch.zeros(1, 12)
    velocity, _ = leg_odometry(
        joints, still, torch.tensor([[0.0, 0.0, 1.0]]), up, torch.tensor([[60.0, 0, 0, 0]])
    )
    assert velocity[0].tolist() == pytest.approx([-(0.047 + 0.0838), -0.1805, 0.0], abs=1e-6)


def test_an_episode_has_its_own_errors_and_a_new_one_others():
    axes = {"encoder_offset": 0.02, "tilt_offset": 0.05, "gyro_offset": 0.1}
    clean, env = make(30), make(30, **axes)
    off = env.get_observations()["policy"] - clean.get_observations()["policy"]
    again = env.get_observations()["policy"] - clean.get_observations()["policy"]
    assert torch.equal(off, again)
    for part, most in ((slice(3, 6), 0.025), (slice(6, 8), 0.05), (slice(9, 21), 0.02)):
        assert 0.8 * most < off[:, part].abs().max() <= most * 1.01
    before = env.senses.encoder.clone()
    # A joint is held where its encoder says.
    env.step(torch.zeros(30, 12))
    assert torch.allclose(env.physics.ctrl + before, torch.tensor(STANCE).double(), atol=1e-6)
    poses = torch.cat((env.pose[:, :2], env.pose[:, 3:]), dim=-1)
    env.start(torch.arange(10), poses[:10], 0.6)
    assert not (env.senses.encoder[:10] == before[:10]).any()
    assert torch.equal(env.senses.encoder[10:], before[10:])


def test_a_scan_in_error_is_shifted_and_raised():
    hill = make_terrain("steps", robot="a1", difficulty=1.0, seed=1)
    clean, env = (
        make(40, terrain=hill, **axes) for axes in ({}, {"scan_offset": 0.05, "scan_shift": 0.04})
    )
    error = env.senses.scan
    assert 0.035 < error[:, :2].abs().max() <= 0.04 and 0.04 < error[:, 2].abs().max() <= 0.05
    # A scan from the place shifted, lower by the offset: the trunk takes itself for higher.
    clean.displacement[:] = error[:, :2]
    a, b = (e.get_observations()["policy"][:, -135:] for e in (clean, env))
    assert torch.allclose(b, a - 3 * error[:, 2:], atol=1e-5)
    env.step(torch.zeros(40, 12))
    assert torch.equal(env.senses.scan, error)
    drifting = make(40, scan_drift=0.02)
    for _ in range(50):
        drifting.step(torch.zeros(40, 12))
    assert drifting.senses.scan.std().item() == pytest.approx(0.02, rel=0.3)  # after 1 s


def test_a_displaced_robot_reads_its_map_elsewhere():
    hill = make_terrain("steps", robot="a1", difficulty=1.0, seed=1)
    env = make(3, terrain=hill)
    shift = torch.tensor([0.3, -0.1])
    moved = env.pose[:, [0, 1, 3]].clone()
    moved[:, :2] += shift
    there = env.patches_at(moved)
    pose = env.pose.clone()
    env.displacement[:] = shift
    assert torch.allclose(env.get_observations()["patch"], there, atol=1e-5)
    assert torch.equal(env.pose, pose)


def test_noise_is_scaled():
    clean, loud = (make(20, noise=on, noise_share=2.0, scan_noise=0.05) for on in (False, True))
    off = (loud.get_observations()["policy"] - clean.get_observations()["policy"]).abs()
    assert 0.018 < off[:, 9:21].max() <= 0.02 + 1e-6
    assert 0.14 < off[:, -135:].max() <= 0.15 + 1e-6


def test_calm_robots_are_undisturbed_among_others():
    loud = {"encoder_offset": 0.02, "scan_shift": 0.05, "push_speed": 3.0, "push_seconds": 0.02}
    env = make(60, base=WIDE, calm_share=0.5, noise_share=1.0, **loud)
    clean = make(60)
    calm = env.senses.share[:, 0] == 0
    assert 15 < calm.sum() < 45
    assert not env.traits[calm].any() and env.traits[~calm].any(dim=1).all()
    for _ in range(3):
        a, b = (e.get_observations()["policy"][:, 3:] for e in (env, clean))
        assert torch.allclose(a[calm], b[calm], atol=1e-4)
        assert ((a - b)[~calm].abs().amax(dim=1) > 0.01).all()
        env.step(torch.zeros(60, 12))
        clean.step(torch.zeros(60, 12))


def test_ranges_that_make_no_sense_are_refused():
    for axes in ({"delay": (0.02, 0.01)}, {"strength": (0.0, 1.0)}, {"velocity": "guess"}):
        with pytest.raises(ConfigError, match=next(iter(axes))):
            A1EnvConfig(**axes)


@pytest.mark.parametrize("settings", [DISTURBED, WIDE], ids=["disturbed", "wide"])
def test_the_same_seed_disturbs_alike_and_another_does_not(settings):
    one, two, other = (make(6, base=settings, seed=seed) for seed in (3, 3, 4))
    for env in (one, two, other):
        walk(env, 20)
    assert torch.equal(one.pose, two.pose)
    assert not torch.equal(one.pose, other.pose)
