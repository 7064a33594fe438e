import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from fgtutor.elevation import ElevationMap
from fgtutor.patches import prepare, sample_patches
from fgtutor.policies.symmetry import SymmetricMLPModel
from fgtutor.robots import ROBOTS
from fgtutor.robots.a1 import rewards
from fgtutor.robots.a1.env import A1_EPISODES, A1_GRID, A1Env, A1EnvConfig
from fgtutor.robots.a1.ground import edges
from fgtutor.robots.a1.model import JOINT_RANGES, STANCE
from fgtutor.world.terrain import Terrain, World, make_terrain

STILL = dataclasses.replace(A1_EPISODES, train=False, stuck_seconds=math.inf)
FLAT = make_terrain("flat", robot="a1")


def make(*terrains, n=None, config=STILL, **options):
    terrains = terrains or (FLAT,)
    return A1Env(World([list(terrains)]), n or len(terrains), config=config, **options)


def put(env, *poses, speed=0.0):
    """Place robot i at pose i (x, y, yaw), given in the frame of the first tile."""
    poses = torch.tensor(np.array(poses), dtype=torch.float32) + torch.tensor(
        [*env.offsets[0, 0].tolist(), 0.0]
    )
    env.start(torch.arange(len(poses)), poses, speed)


def still(env):
    return torch.zeros(env.num_envs, 12)


@torch.inference_mode()
def drive(env, steps=30, seed=0, vigour=0.5):
    """Act at random, but the same at every call; return everything the environment said."""
    rng = torch.Generator().manual_seed(seed)
    said = []
    for _ in range(steps):
        actions = vigour * torch.randn(env.num_envs, 12, generator=rng)
        observations, reward, done, _ = env.step(actions)
        said += [observations["policy"], observations["tracking"], reward, done]
    return said


def same(first, second):
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_slope_has_no_edge_and_a_ledge_has_one():
    slope = np.tile(np.arange(6) * 0.05, (5, 1))
    np.testing.assert_allclose(edges(slope)[:, 1:], slope[:, 1:])
    ledge = np.zeros((6, 5))
    ledge[3:] = 0.1
    np.testing.assert_allclose(edges(ledge)[:, 2], [0.0, 0.0, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(edges(ledge[::-1])[:, 2], [0.1, 0.1, 0.1, 0.1, 0.0, 0.0])
    groove = np.abs(np.arange(7) - 3.0)
    np.testing.assert_allclose(edges(groove[None])[0], [3, 2, 1, 1, 1, 2, 3])


def test_in_training_a_robot_that_turns_away_or_leaves_its_line_has_failed():
    env = make(n=4, config=dataclasses.replace(A1_EPISODES, stuck_seconds=math.inf))
    put(env, (1.0, 2.0, 0.0), (4.0, 2.0, 0.0), (4.0, 3.2, 0.0), (6.0, 2.0, 0.0))
    env.crossings.crossing[:] = True
    env.crossings.crossing[1] = False  # nor may one that walks straight on from anywhere
    env.crossings.aside[:] = 0.0
    turned = env.pose.clone()
    turned[0, 3] += math.radians(47)
    turned[1, 3] -= math.radians(47)
    turned[3, 3] -= math.radians(43)
    assert env.crossings.strayed(turned).tolist() == [True, True, True, False]


def test_a_new_heading_must_be_followed_at_some_rate():
    env = make(n=1, config=dataclasses.replace(A1_EPISODES, train=True, turn_share=0.0))
    put(env, (4.0, 2.0, 0.0))
    env.crossings.turning[:], env.crossings.crossing[:] = False, False
    env.crossings.target_yaw += math.pi / 2
    stays = env.pose.clone()
    steps = 0
    while not env.crossings.strayed(stays).any():
        env.crossings.headings(env.pose, env.control_dt)
        steps += 1
    # 45 degrees at 0.5 times 1 rad/s.
    assert steps * env.control_dt == pytest.approx(math.radians(45) / 0.5, abs=0.05)


def test_a_robot_that_turns_faster_than_expected_has_not_strayed():
    env = make(n=2, config=dataclasses.replace(A1_EPISODES, train=True, turn_share=0.0))
    put(env, (4.0, 2.0, 0.0), (4.0, 2.0, 0.0))
    env.crossings.turning[:], env.crossings.crossing[:] = False, False
    env.crossings.target_yaw += math.pi / 2
    env.crossings.headings(env.pose, env.control_dt)
    # Nearly there at once; the other turned away as far.
    env.pose[:, 3] = torch.tensor([1.2, -1.2])
    env.crossings.headings(env.pose, env.control_dt)
    assert env.crossings.strayed(env.pose).tolist() == [False, True]
    assert env.crossings.told_yaw.tolist() == pytest.approx([1.2, 0.02], abs=0.01)
    env.pose[:, 3] = math.pi / 2 + 0.3  # beyond the heading wanted: that is not further
    env.crossings.headings(env.pose, env.control_dt)
    assert env.crossings.told_yaw[0].item() == pytest.approx(1.21, abs=0.01)


def test_velocity_counts_along_the_heading_told():
    for train, expected in ((True, [[0.0, 0.6], [0.6, 0.0]]), (False, [[0.6, 0.0]] * 2)):
        env = make(n=2, config=dataclasses.replace(A1_EPISODES, train=train))
        put(env, (2.0, 2.0, math.pi / 2), (4.0, 2.0, 1.0))
        env.crossings.told_yaw[:] = torch.tensor([0.0, 1.0])  # the first walks off to the left
        velocity = torch.tensor([[0.6, 0.0, 0.0]] * 2)
        along = env.crossings.along_heading(env.pose, velocity)
        torch.testing.assert_close(along, torch.tensor(expected), atol=1e-4, rtol=0)


# The robot on the ground --------------------------------------------------------------------------


def test_stands_for_two_seconds_without_action():
    env = make(n=3)
    put(env, (2.0, 2.0, 0.0), (4.0, 1.0, 2.0), (6.0, 3.0, -1.0))
    before = env.motion()[0].clone()
    for _ in range(100):
        _, reward, done, extras = env.step(still(env))
        assert not done.any()
        assert not extras["fell"].any()
        assert (reward > 0).all()
    pose, velocity = env.motion()
    assert (pose[:, :2] - before[:, :2]).norm(dim=-1).max() < 0.05
    assert (pose[:, 2] - 0.24).abs().max() < 0.02
    assert velocity.abs().max() < 0.1


@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2, -2.5])
def test_is_placed_where_it_should_be(yaw):
    env = make()
    put(env, (3.0, 2.0, yaw))
    pose, velocity = env.motion()
    dx, dy = env.offsets[0, 0].tolist()
    assert pose[0].tolist() == pytest.approx([3.0 + dx, 2.0 + dy, 0.30, yaw], abs=1e-5)
    assert not velocity.any()
    feet = env.sensed[0, env.sensors["foot_position"]].reshape(4, 3)[:, 2] - 0.02
    assert ((feet > 0.0) & (feet < 0.03)).all()


def slope(angle, yaw_of_rise):
    """A tile that rises at `angle` towards `yaw_of_rise`."""
    x = (np.arange(80) + 0.5) * 0.1
    along = x[:, None] * math.cos(yaw_of_rise) + x[None, :] * math.sin(yaw_of_rise)
    heights = ElevationMap(math.tan(angle) * along, resolution=0.1)
    return Terrain.from_elevation(heights, (1.0, 4.0), (7.0, 4.0), robot="a1")


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, math.pi, -math.pi / 4])
def test_is_placed_tilted_to_a_slope_and_stands_there(yaw):
    env = make(slope(0.25, 0.0))
    put(env, (4.0, 4.0, yaw))
    # Seen by the trunk, "up" leans towards the rise: ahead if it faces it, left if that is left.
    up = [math.sin(0.25) * math.cos(yaw), -math.sin(0.25) * math.sin(yaw), math.cos(0.25)]
    assert env.up[0].tolist() == pytest.approx(up, abs=0.03)
    for _ in range(50):
        env.step(still(env))
    assert not env.fallen().any()
    assert (env.motion()[0][0, :2] - env.offsets[0, 0] - 4.0).norm() < 0.25


def test_height_field_and_boxes_carry_it_alike():
    boxes = make()
    assert boxes.physics.model.nhfield == 0
    rough = slope(0.0, 0.0)
    flat = make(rough)
    # A flat map from elsewhere is blocky: it becomes boxes too.
    assert flat.physics.model.nhfield == 0
    field = make(slope(1e-3, 0.0))
    assert field.physics.model.nhfield == 1
    for env in (boxes, field):
        put(env, (4.0, 2.0, 0.0))
        for _ in range(50):
            env.step(still(env))
    ground = 1e-3 * 4.0
    assert (field.motion()[0][0, 2] - ground).item() == pytest.approx(
        boxes.motion()[0][0, 2].item(), abs=0.005
    )


def test_velocity_is_in_the_yaw_frame_and_the_body_frame():
    env = make()
    put(env, (4.0, 2.0, math.pi / 2))
    env.physics.qvel[0, :6] = torch.tensor([0.0, 0.5, 0.1, 0.0, 0.0, 0.8])
    env.physics.forward()
    env._read()
    assert env.motion()[1][0].tolist() == pytest.approx([0.5, 0.0, 0.8], abs=1e-6)
    felt = env.proprioception()[0]
    # Velocity ahead 0.5 and up 0.1, times 2; rotation about z 0.8, times 0.25; gravity down.
    assert felt[:9].tolist() == pytest.approx([1, 0, 0.2, 0, 0, 0.2, 0, 0, -1], abs=1e-5)
    assert felt[9:45].abs().max() < 1e-6
    assert felt[45:].tolist() == pytest.approx([0.0, 1.0])  # the clock starts at 0


# What it sees -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["steps", "gaps", "valley"])
def test_patches_equal_sample_patches(name):
    terrain = make_terrain(name, robot="a1", difficulty=1.0, seed=3)
    env = make(terrain, n=8)
    rng = np.random.default_rng(0)
    poses = [(rng.uniform(1, 7), rng.uniform(1, 3), rng.uniform(-3, 3)) for _ in range(8)]
    put(env, *poses)
    here = env.motion()[0][:, [0, 1, 3]]
    world = sample_patches(env.heights, here, A1_GRID, resolution=env.resolution, origin=env.origin)
    assert torch.equal(env.get_observations()["patch"], world)
    single = prepare(terrain.elevation)
    here = here - torch.tensor([*env.offsets[0, 0].tolist(), 0.0])
    alone = sample_patches(torch.tensor(single.heights), here, A1_GRID, resolution=0.05)
    assert torch.allclose(world, alone, atol=2e-3)
    assert world.abs().max() > 0.02


def test_scan_sees_a_ledge_ahead_at_its_height_over_the_trunk():
    heights = np.zeros((80, 40))
    heights[48:] = 0.1  # from x = 4.8 m
    terrain = Terrain.from_elevation(ElevationMap(heights), (1, 2), (7, 2), robot="a1")
    env = make(terrain)
    put(env, (4.25, 2.0, 0.0))
    scan = env.get_observations()["policy"][0, -135:].reshape(15, 9)
    trunk = env.motion()[0][0, 2].item()
    # Row i lies 0.1 i - 0.5 m ahead: row 10 at x = 4.75, halfway between cells, row 11 at 4.85.
    assert scan[:10].flatten().tolist() == pytest.approx([3 * (0.29 - trunk)] * 90, abs=1e-4)
    assert scan[11:].flatten().tolist() == pytest.approx([3 * (0.39 - trunk)] * 36, abs=1e-4)


def test_scan_is_clamped_and_blind_to_how_deep_a_hole_is():
    scans = []
    for depth in (0.6, 1.5):
        scale = dataclasses.replace(ROBOTS["a1"].scale, chasm_depth=(depth, depth, depth))
        terrain = make_terrain("gaps", robot="a1", difficulty=1.0, seed=1, scale=scale)
        env = make(terrain, n=20)
        put(env, *[(0.5 + 0.05 * i, 2.0, 0.0) for i in range(20)])
        scans.append(env.get_observations()["policy"][:, -135:])
    assert scans[0].min() < -0.5 and torch.allclose(*scans, atol=1e-5)
    env = make(make_terrain("bridge", robot="a1", difficulty=1.0, seed=1), n=1)
    put(env, (2.0, 2.375, 0.0))  # 0.3 m before the beam
    scan = env.get_observations()["policy"][:, -135:]
    assert scan.min().item() == pytest.approx(3 * (0.29 - 0.8), abs=1e-5)


def mirrored(observations):
    mirror = A1Env.mirror
    return observations[:, list(mirror.observation_index)] * torch.tensor(mirror.observation_sign)


def test_the_mirrored_robot_on_the_mirrored_ground_observes_the_mirror_image():
    # Physics, terrain and observation are mirrored, not only the table.
    terrain = make_terrain("steps", robot="a1", difficulty=1.0, seed=4)
    heights = np.asarray(terrain.elevation.heights)
    twin = Terrain.from_elevation(
        ElevationMap(heights[:, ::-1], resolution=0.05), (1, 2), (7, 2), robot="a1"
    )
    seen = []
    action = torch.linspace(-0.6, 0.6, 12)
    sign = torch.tensor(A1Env.mirror.action_sign)
    for tile, side, act in (
        (terrain, 1, action),
        (twin, -1, action[list(A1Env.mirror.action_index)] * sign),
    ):
        env = make(Terrain.from_elevation(tile.elevation, (1, 2), (7, 2), robot="a1"))
        put(env, (4.0, 2.0 + side * 0.4, side * 0.3), speed=0.6)
        env.command[:, 2] = side * 0.5
        env.clock += 0.25 if side > 0 else 0.75
        for _ in range(4):
            observations, *_ = env.step(act[None])
        seen.append(observations["policy"])
    # The trunk itself is not exactly symmetric (its centre of mass lies 4 mm to the left).
    assert (seen[0] - mirrored(seen[1])).abs().max() < 0.25
    assert (seen[0] - mirrored(seen[1]))[:, -135:].abs().max() < 0.02
    assert (seen[0] - seen[1]).abs().max() > 0.5


def test_policy_answers_the_mirrored_observation_with_the_mirrored_action():
    env = make(make_terrain("steps", robot="a1"), n=6)
    put(env, *[(0.8 + i, 1.5 + 0.1 * i, 0.4 * i) for i in range(6)])
    for _ in range(3):
        observations, *_ = env.step(0.3 * torch.randn(6, 12))
    policy = SymmetricMLPModel(
        observations,
        {"actor": ["policy"]},
        "actor",
        env.num_actions,
        hidden_dims=[32],
        mirror=env.mirror,
    )
    x = observations["policy"]
    one = policy(TensorDict({"policy": x}, batch_size=[6]))
    two = policy(TensorDict({"policy": mirrored(x)}, batch_size=[6]))
    sign = torch.tensor(env.mirror.action_sign)
    assert torch.equal(two, one[:, list(env.mirror.action_index)] * sign)


# Rewards by hand ----------------------------------------------------------------------------------


def test_kernel_and_moving_by_hand():
    assert rewards.kernel(torch.tensor(0.5), 0.25).item() == pytest.approx(math.exp(-1))
    assert rewards.moving(torch.tensor([0.0, 0.5, 9.0])).tolist() == pytest.approx(
        [1.0, 0.2 + 0.8 * math.exp(-1), 0.2]
    )


def test_stance_share_is_a_trot():
    # A quarter of a cycle on, FR and RL stand, FL and RR swing; half a cycle later, reversed.
    share = rewards.stance_share(torch.tensor([0.0, 0.25, 0.75]))
    assert share[0].tolist() == pytest.approx([0.5] * 4, abs=1e-6)
    assert share[1].tolist() == pytest.approx([1, 0, 0, 1], abs=1e-6)
    # Standing and swinging overlap for a little: 0.5 + 1.2 sin(2 pi / 36).
    early = rewards.stance_share(torch.tensor([1 / 36]))[0, 0].item()
    assert early == pytest.approx(0.5 + 1.2 * math.sin(math.radians(10)))
    assert share[2].tolist() == pytest.approx([0, 1, 1, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("stance", "force", "slide", "clearance", "expected"),
    [
        (1.0, 67.0, 0.0, 0.0, 1.0),  # a loaded foot that stands
        (1.0, 20.0, 0.0, 0.0, 0.5),  # half loaded: 20 of 40 N
        (1.0, 67.0, math.sqrt(0.1), 0.0, math.exp(-1)),  # it slides
        (1.0, 0.0, 0.0, 0.07, 0.0),  # in the air when it should stand
        (0.0, 0.0, 1.0, 0.07, 1.0),  # swings within the corridor
        (0.0, 0.0, 1.0, 0.01, math.exp(-1)),  # 3 cm too low
        (0.0, 0.0, 1.0, 0.13, math.exp(-1)),  # 3 cm too high
        (0.0, 67.0, 0.0, 0.07, 0.0),  # stands when it should swing
        (0.5, 0.0, 0.0, 0.07, 0.5),
    ],
)
def test_gait_by_hand(stance, force, slide, clearance, expected):
    four = [torch.full((1, 4), value) for value in (stance, force, slide, clearance)]
    value = rewards.gait(*four, (0.04, 0.1)).item()
    assert value == pytest.approx(2 * expected - 1, abs=1e-6)


def test_posture_limits_and_landing_by_hand():
    joints = torch.tensor([[0.2, 0.0, 0.0, -0.2, 0.0, 0.0] * 2] * 2)  # the feet brought together
    joints[1, 0], joints[1, 4] = 0.5, -0.5  # a hip and a thigh: 0.09 * 3 + 0.25 * 0.1
    assert rewards.posture(joints).tolist() == pytest.approx([1.0, math.exp(-0.295)])
    angles = torch.tensor([STANCE, STANCE])
    low, high = JOINT_RANGES["hip"]
    angles[1, 3] = high + 0.1  # soft limit: 95 % of a range symmetric about zero
    assert rewards.limits(angles).tolist() == pytest.approx([0.0, 0.1 + 0.05 * high], abs=1e-6)
    assert low == -high
    force = torch.tensor([[60.0, 0.0, 135.0, 60.0], [185.0, 0.0, 1e4, 0.0]])
    assert rewards.landing(force).tolist() == pytest.approx([0.0, 2.5])


def test_reward_of_standing_still_by_hand():
    env = make()
    put(env, (4.0, 2.0, 0.0), speed=0.5)
    for _ in range(100):
        _, reward, _, _ = env.step(still(env))
    terms = {name: value.item() for name, value in env.reward_terms().items()}
    # The error is 0.5 m/s: exp(-0.25 / 0.1), exp(-1), and style counts 0.2 + 0.8 exp(-1) = 0.494.
    assert terms["tracking"] == pytest.approx(1.2 * math.exp(-2.5), rel=0.25)
    assert terms["approach"] == pytest.approx(0.6 * math.exp(-1), rel=0.1)
    assert terms["turning"] == pytest.approx(0.5 * 0.494, rel=0.05)
    # At the stance the hips are 0.2 rad off what posture asks for; under load they sag further.
    assert 0.15 < terms["posture"] / 0.494 <= 0.5 * math.exp(-4 * 3 * 0.2**2)
    assert terms["jerk"] == terms["landing"] == terms["limits"] == 0.0
    assert reward.item() == pytest.approx(0.02 * sum(terms.values()))


def test_waiting_earns_less_than_half_of_walking():
    env = make()
    put(env, (4.0, 2.0, 0.0), speed=0.7)
    waiting = 0.0
    for _ in range(100):
        _, reward, _, _ = env.step(still(env))
        waiting += reward.item() / env.control_dt / 100
    walking = 1.2 + 0.6 + 0.5 + 0.75 * 1.5 + 0.5
    assert 0 < waiting < 0.3 * walking


# Failures -----------------------------------------------------------------------------------------


def test_falling_is_noticed():
    env = make(n=3)
    put(env, (2.0, 2.0, 0.0), (4.0, 2.0, 0.0), (6.0, 2.0, 0.0))
    assert not env.fallen().any()
    env.physics.qpos[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # on its back
    env.physics.qpos[2, 2] -= 0.26  # the trunk in the ground
    env.physics.forward()
    env._read()
    assert env.fallen().tolist() == [False, True, True]


def test_a_foot_in_a_slot_is_a_failure_and_a_deep_valley_is_not():
    gaps = make_terrain("gaps", robot="a1", difficulty=1.0, seed=0)
    valley = make_terrain("valley", robot="a1", difficulty=1.0, seed=0)
    env = make(gaps, valley)
    floor = np.asarray(gaps.elevation.heights)[:, 40]
    slot = (np.flatnonzero(floor < -0.5)[0] + 1.5) * 0.05
    (x0, _), (x1, _) = valley.lane[1], valley.lane[2]
    dx = (env.offsets[0, 1, 0] - env.offsets[0, 0, 0]).item()
    put(env, (1.0, 2.0, 0.0), (dx + (x0 + x1) / 2, valley.lane[1][1], 0.0))
    for _ in range(10):
        env.step(still(env))
        assert not env.fallen().any()
    env.physics.qpos[1, 7::3] = torch.tensor([0.4, -0.4] * 2)  # feet together, at the lowest line
    env.physics.qpos[1, 2] = 0.29
    env.physics.forward()
    env._read()
    assert env._feet("foot_position")[1, :, 2].max() < 0.1
    assert not env.fallen().any()
    put(env, (slot - 0.19, 2.0, 0.0))
    env.physics.qpos[0, 2] -= 0.15
    env.physics.qpos[0, 7 + 1 :: 3] = 0.3  # stretched legs: the front feet in the slot
    env.physics.qpos[0, 7 + 2 :: 3] = -0.92
    env.physics.forward()
    env._read()
    feet = env.sensed[0, env.sensors["foot_position"]].reshape(4, 3)
    assert feet[0, 2] < -0.2
    assert env.fallen()[0]


@pytest.mark.parametrize("what", ["state", "action"])
def test_an_explosion_ends_one_episode_and_poisons_nothing(what):
    healthy, hurt = (make(n=4, config=A1_EPISODES, settings=A1EnvConfig()) for _ in range(2))
    for env in (healthy, hurt):
        drive(env, 5)
    actions = still(hurt)
    if what == "state":
        hurt.physics.qvel[2, 8] = float("nan")
    else:
        actions[2, 3] = float("nan")
    normal = healthy.step(still(healthy))
    with pytest.warns(RuntimeWarning, match=r"1 simulations exploded .* \(1 so far\)"):
        observations, reward, done, extras = hurt.step(actions)
    assert done.tolist() == [0, 0, 1, 0]
    assert extras["fell"].tolist() == [False, False, True, False]
    assert not extras["time_outs"].any()
    assert observations["tracking"][2].tolist() == [0.0, 1.0, 1.0]
    assert reward[2] == 0.0
    others = torch.tensor([0, 1, 3])
    assert torch.equal(observations["patch"][others], normal[0]["patch"][others])
    assert torch.equal(reward[others], normal[1][others])
    for said in (observations["policy"], observations["patch"], reward):
        assert torch.isfinite(said).all()
    # The robot lives again, and no further warning is due.
    drive(hurt, 5)
    assert hurt.explosions == 1


def test_an_exploded_robot_stays_lost_where_nothing_is_reset():
    env = make(n=2)
    put(env, (2.0, 2.0, 0.0), (6.0, 2.0, 0.0))
    env.physics.qpos[1, 2] = float("inf")
    with pytest.warns(RuntimeWarning, match="exploded"):
        env.step(still(env))
    for _ in range(3):
        _, _, done, _ = env.step(still(env))
        assert done.tolist() == [0, 1]
    put(env, (2.0, 2.0, 0.0), (6.0, 2.0, 0.0))
    assert not env.fallen().any()


# Repeatability and randomisation ------------------------------------------------------------------


def test_results_are_bit_identical_at_one_and_two_threads():
    terrain = make_terrain("steps", robot="a1", difficulty=0.5, seed=1)
    results = [
        drive(make(terrain, n=12, config=A1_EPISODES, threads=threads), 50, vigour=2.0)
        for threads in (1, 2)
    ]
    assert same(*results)
    assert any(said.any() for said in results[0][3::4])  # some episodes ended on the way


def test_a_stored_state_continues_bit_for_bit():
    env = make(n=6, config=A1_EPISODES)
    drive(env, 20)
    state = env.state_dict()
    env.reset_all()
    first = drive(env, 20, seed=1)
    other = make(n=6, config=A1_EPISODES, seed=5)  # other robots, until the state is loaded
    drive(other, 7)
    other.load_state_dict(state)
    other.reset_all()
    assert same(first, drive(other, 20, seed=1))


def test_randomisation_is_behind_one_switch():
    plain = make(n=40, settings=A1EnvConfig(randomise=False, noise=False))
    random = make(n=40, settings=A1EnvConfig(noise=False))
    assert not plain.late.any()
    assert 5 < random.late.sum() < 35
    mass = random.physics.parameter("body_mass")[:, 1]
    nominal = plain.physics.model.body_mass[1]
    assert mass.min() >= nominal - 0.5
    assert mass.max() <= nominal + 1.5
    assert mass.std() > 0.1
    friction = random.physics.parameter("opt.o_friction")
    assert torch.equal(friction[:, 0], friction[:, 1])
    assert friction[:, 0].min() >= 0.5
    assert friction[:, 0].max() <= 1.1
    gain = random.physics.parameter("actuator_gainprm")[:, :, 0]
    assert torch.equal(gain, -random.physics.parameter("actuator_biasprm")[:, :, 1])
    assert ((gain / 35.0 - 1).abs() <= 0.1 + 1e-9).all()
    assert (gain[:, 0] == gain[:, 11]).all()


def test_a_late_robot_acts_one_step_later():
    env = make(n=2)
    env.late[1] = True
    action = torch.full((2, 12), 0.4)
    env.step(action)
    assert env.physics.ctrl[0].tolist() == pytest.approx([q + 0.2 for q in STANCE])
    assert env.physics.ctrl[1].tolist() == pytest.approx(list(STANCE))
    env.step(action)
    assert torch.equal(env.physics.ctrl[0], env.physics.ctrl[1])


def test_pushes_move_a_standing_robot():
    often = A1EnvConfig(noise=False, push_seconds=0.2)
    env = make(n=4, settings=often)
    put(env, *[(1.5 + 1.5 * i, 2.0, 0.0) for i in range(4)])
    fastest = torch.zeros(4)
    for _ in range(60):
        env.step(still(env))
        fastest = torch.maximum(fastest, env.motion()[1][:, :2].norm(dim=-1))
    assert (fastest > 0.15).all()


def test_noise_stays_within_its_bounds_and_off_the_patch():
    clean, noisy = (
        make(n=8, settings=A1EnvConfig(randomise=False, noise=on)) for on in (False, True)
    )
    for env in (clean, noisy):
        put(env, *[(0.8 + 0.9 * i, 2.0, 0.0) for i in range(8)])
    a, b = clean.get_observations(), noisy.get_observations()
    assert torch.equal(a["patch"], b["patch"])
    off = (a["policy"] - b["policy"]).abs()
    # velocity 0.1 m/s at scale 2; gyroscope 0.2 at 0.25; gravity 0.05; joints 0.01; rates 1 at 0.05
    for part, most in (
        (slice(0, 3), 0.2),
        (slice(3, 6), 0.05),
        (slice(6, 9), 0.05),
        (slice(9, 21), 0.01),
        (slice(21, 33), 0.05),
        (slice(-135, None), 0.06),
    ):
        assert 0.5 * most < off[:, part].max() <= most + 1e-6
    assert not off[:, 33:50].any()  # last action, clock and command are known exactly


def test_training_is_randomised_and_evaluation_is_not():
    training, evaluation = make(config=A1_EPISODES), make(config=STILL)
    assert training.settings.randomise
    assert training.settings.noise
    assert not evaluation.settings.randomise
    assert not evaluation.settings.noise


def test_drawing_is_a_qpos_that_mujoco_can_draw():
    env = make(n=2)
    put(env, (2.0, 2.0, 0.0), (6.0, 2.0, 1.0))
    drawing = env.drawing()
    assert drawing.shape == (2, 19)
    data = mujoco.MjData(env.physics.model)
    data.qpos[:] = drawing[1]
    mujoco.mj_forward(env.physics.model, data)
    assert data.body("trunk").xpos == pytest.approx(env.motion()[0][1, :3].numpy(), abs=1e-5)
    drawing[:] = 0.0
    assert env.physics.qpos[0, 2] > 0.2
