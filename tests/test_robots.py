"""One contract for every robot: a third robot needs one line in ROBOTS and passes all of this."""

import math

import pytest
import torch

from fgtutor import patches
from fgtutor.errors import ConfigError
from fgtutor.feasibility import tracking_reward
from fgtutor.patches import sample_patches
from fgtutor.robots import ROBOTS, env_class
from fgtutor.robots.crossings import UNTRIED, EnvConfig
from fgtutor.robots.steering import slowdown, turn_rate
from fgtutor.world.terrain import World, make_terrain
from fgtutor.world.turned import make_turned

robots = pytest.mark.parametrize("robot", sorted(ROBOTS))


def make_env(robot, *names, num_envs=4, seed=0, **config):
    names = names or ("steps", "gaps")
    tiles = [make_terrain(name, robot=robot, difficulty=0.6, seed=3) for name in names]
    return env_class(robot)(World([tiles]), num_envs, config=EnvConfig(**config), seed=seed)


def actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 0.5 * torch.randn(steps, env.num_envs, env.num_actions, generator=generator)


def test_tracking_reward_by_hand():
    # |(0.3, 0.4)| = 0.5, so r_v = exp(-0.5 / 0.25) = exp(-2).
    velocity, command = (
        torch.tensor([[0.3, 0.4], [1.0, 0.0]]),
        torch.tensor([[0.0, 0.0], [1.0, 0.0]]),
    )
    assert tracking_reward(velocity, command).tolist() == pytest.approx([math.exp(-2), 1.0])


def test_turn_rate_takes_the_shorter_way_within_the_limit():
    wanted = torch.tensor([math.pi - 0.1, 0.2, 3.0])
    yaw = torch.tensor([-math.pi + 0.1, 0.1, 0.0])
    assert turn_rate(wanted, yaw, 1.5).tolist() == pytest.approx([-0.6, 0.3, 1.5], abs=1e-5)


def test_a_robot_that_must_turn_far_slows_down_by_the_cosine_squared():
    wanted = torch.tensor([0.5, 0.5 + math.pi / 4, 0.5 - math.pi / 2, 0.5 + math.pi])
    yaw = torch.tensor([0.5, 0.5, 0.5, 0.5 + 4 * math.pi])
    assert slowdown(wanted, yaw, 0.25).tolist() == pytest.approx([1.0, 0.5, 0.25, 0.25], abs=1e-5)
    assert slowdown(wanted, yaw, 1.0).tolist() == [1.0] * 4


@robots
@pytest.mark.parametrize("slowest", [1.0, 0.25])
def test_a_robot_is_steered_at_its_speed_straight_on_and_slower_in_a_turn(robot, slowest):
    env = make_env(robot, slowest=slowest)
    yaw = torch.tensor([0.0, 0.3, 1.0, -2.0])
    env.start(torch.arange(4), torch.stack((torch.full((4,), 1.0),) * 2 + (yaw,), dim=-1), 0.8)
    env.steer(torch.zeros(4), env.motion()[0][:, 3])
    share = [max(slowest, max(0.0, math.cos(angle)) ** 2) for angle in yaw.tolist()]
    assert env.command[:, 0].tolist() == pytest.approx([0.8 * s for s in share], abs=1e-3)
    assert env.command[:, 2].sign().tolist() == [0.0, -1.0, -1.0, 1.0]


@robots
def test_observation_groups_are_flat_and_finite(robot):
    env = make_env(robot)
    observations = env.get_observations()
    assert set(observations.keys()) == {"policy", "patch", "command", "tracking"}
    assert observations["patch"].shape == (4, env.grid.num_points)
    assert observations["command"].shape == observations["tracking"].shape == (4, 3)
    for action in actions(env, 5):
        observations, reward, done, extras = env.step(action)
        assert all(
            torch.isfinite(group).all() and group.ndim == 2 for group in observations.values()
        )
        assert reward.shape == done.shape == extras["time_outs"].shape == (4,)


@robots
def test_the_same_seed_gives_the_same_rollout(robot):
    first, second = make_env(robot, seed=5), make_env(robot, seed=5)
    for action in actions(first, 12):
        a, b = first.step(action), second.step(action)
        assert torch.equal(a[0]["policy"], b[0]["policy"]) and torch.equal(a[1], b[1])
    other = make_env(robot, seed=6)
    assert not torch.equal(other.get_observations()["policy"], first.get_observations()["policy"])


@robots
def test_a_restored_environment_continues_as_the_original(robot):
    original = make_env(robot, seed=1)
    for action in actions(original, 6):
        original.step(action)
    state = original.state_dict()
    original.reset_all()
    restored = make_env(robot, seed=99)
    restored.load_state_dict(state)
    restored.reset_all()
    for action in actions(original, 6, seed=1):
        assert torch.equal(original.step(action)[0]["policy"], restored.step(action)[0]["policy"])


@robots
def test_placing_puts_robots_where_asked(robot):
    env = make_env(robot, "flat", train=False)
    poses = torch.tensor([[2.0, 2.0, 0.0], [3.0, 1.0, 1.0], [4.0, 2.5, -2.0], [5.0, 2.0, math.pi]])
    poses[:, :2] += env.crossings.corner(torch.arange(4))
    env.start(torch.arange(4), poses, 0.5)
    pose, velocity = env.motion()
    assert torch.allclose(pose[:, [0, 1]], poses[:, :2], atol=1e-3)
    turned = torch.remainder(pose[:, 3] - poses[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert turned.abs().max() < 1e-3
    assert velocity.abs().max() < 1e-3
    assert env.command[:, 0].tolist() == pytest.approx([0.5] * 4)


@robots
def test_a_robot_that_does_nothing_neither_falls_nor_leaves(robot):
    env = make_env(robot, "flat", train=False)
    poses = torch.tensor([[4.0, 2.0, 0.7]]).repeat(4, 1)
    poses[:, :2] += env.crossings.corner(torch.arange(4))
    env.start(torch.arange(4), poses, 0.0)
    for _ in range(round(2.0 / env.control_dt)):
        *_, extras = env.step(torch.zeros(4, env.num_actions))
        assert not extras["fell"].any()
    moved = env.motion()[0][:, :2] - poses[:, :2]
    assert moved.norm(dim=-1).max() < 0.2


@robots
def test_patches_are_those_of_the_planner(robot):
    terrain = make_terrain("steps", robot=robot, difficulty=0.6, seed=3)
    env = env_class(robot)(World([[terrain]]), 3, config=EnvConfig(train=False))
    places = torch.tensor([[0.1, 0.1, 0.5], [2.0, 2.0, 0.0], [4.3, 3.9, 2.0]])
    poses = places.clone()
    poses[:, :2] += env.crossings.corner(torch.arange(3))
    env.start(torch.arange(3), poses, 0.5)
    own = patches.prepare(terrain.elevation)
    expected = sample_patches(
        torch.tensor(own.heights), places, env.grid, resolution=own.resolution, origin=own.origin
    )
    assert torch.allclose(env.get_observations()["patch"], expected, atol=1e-3)


@robots
def test_waiting_ends_an_episode_as_a_failure_without_reward(robot):
    env = make_env(robot, "flat", stuck_seconds=0.3, speed=(0.0, 0.0), turn_share=0.0)
    failed = torch.zeros(4, dtype=torch.bool)
    for _ in range(round(1.5 / env.control_dt)):
        observations, _, done, extras = env.step(torch.zeros(4, env.num_actions))
        r_v, fails, ends = observations["tracking"].unbind(-1)
        failed |= fails.bool()
        assert (r_v[fails > 0] == 0).all() and (ends[fails > 0] == 1).all()
        assert (extras["time_outs"][fails > 0] == 0).all() and (done[fails > 0] == 1).all()
    assert failed.all()


@robots
def test_leaving_the_tile_is_a_time_out_and_not_a_failure(robot):
    env = make_env(robot, "flat", train=False)
    poses = torch.tensor([[-0.05, 2.0, 0.0]]).repeat(4, 1)
    poses[:, :2] += env.crossings.corner(torch.arange(4))
    env.start(torch.arange(4), poses, 0.0)
    observations, _, done, extras = env.step(torch.zeros(4, env.num_actions))
    assert done.all() and extras["time_outs"].all() and not observations["tracking"][:, 1].any()


@robots
def test_between_neighbours_robots_stay_off_them(robot):
    terrain = make_terrain("gaps", robot=robot, seed=3, neighbours=True)
    assert terrain.limits is not None
    env = env_class(robot)(World([[terrain]]), 256, config=EnvConfig())
    x = env.motion()[0][:, 0] - env.crossings.corner(torch.arange(256))[:, 0]
    assert ((terrain.limits[0] < x) & (x < terrain.limits[1])).all()
    backwards = torch.cos(env.crossings.target_yaw) < 0
    assert torch.allclose(x[env.crossings.crossing & ~backwards], torch.tensor(terrain.start[0]))
    assert torch.allclose(x[env.crossings.crossing & backwards], torch.tensor(terrain.goal[0]))
    poses = env.motion()[0].clone()
    poses[:4, 0] += torch.tensor([terrain.limits[k] + s for k in (0, 1) for s in (-0.01, 0.01)])
    poses[:4, 0] -= x[:4]
    outside, strange = env.crossings.outside(poses)
    assert outside.nonzero().flatten().tolist() == strange.nonzero().flatten().tolist() == [0, 3]


@robots
def test_between_neighbours_crossings_begin_with_all_feet_on_the_landing(robot):
    """A foot over the next tile's chasm would be a failure before the first step."""
    row = [make_terrain("steps", robot=robot, seed=seed, neighbours=True) for seed in range(8)]
    config = EnvConfig(train=False, start_yaw=0.8)
    env = env_class(robot)(World([row]), 256, config=config)
    crossing, fell = env.crossings.crossing.clone(), torch.zeros(256, dtype=torch.bool)
    for _ in range(round(0.4 / env.control_dt)):
        fell |= env.step(torch.zeros(256, env.num_actions))[3]["fell"]
    assert not (fell & crossing).any()


@robots
def test_crossings_begin_anywhere_up_to_their_run_up(robot):
    terrain = make_terrain("bridge", robot=robot, seed=3)
    env = env_class(robot)(World([[terrain]]), 512, config=EnvConfig(run_up=0.6))
    crossing = env.crossings.crossing
    x = (env.motion()[0][:, 0] - env.crossings.corner(torch.arange(512))[:, 0])[crossing]
    forwards = torch.cos(env.crossings.target_yaw[crossing]) > 0
    for side, last in (
        (x[forwards], terrain.span[0] - 0.6),
        (-x[~forwards], -terrain.span[1] - 0.6),
    ):
        first = terrain.start[0] if last > 0 else -terrain.goal[0]
        assert first - 1e-4 <= side.min() < first + 0.1 * (last - first)
        assert last + 1e-4 >= side.max() > last - 0.1 * (last - first)


@robots
def test_going_on_to_a_neighbours_obstacle_is_infeasible_but_no_fault(robot):
    """What would happen there is unknown, so it must not look feasible; PPO sees a time-out."""
    terrain = make_terrain("gaps", robot=robot, seed=3, neighbours=True)
    assert terrain.limits is not None
    env = env_class(robot)(World([[terrain]]), 2, config=EnvConfig(train=False))
    last = torch.tensor([terrain.limits[1] + 0.02, 2.0, 0.0])
    poses = torch.stack((last, last - torch.tensor([0.5, 0.0, 0.0])))
    poses[:, :2] += env.crossings.corner(torch.arange(2))
    env.start(torch.arange(2), poses, 0.0)
    observations, _, done, extras = env.step(torch.zeros(2, env.num_actions))
    assert done.tolist() == [1, 0] and extras["time_outs"].tolist() == [1.0, 0.0]
    assert observations["tracking"][:, 1].tolist() == pytest.approx([UNTRIED, 0.0])


@robots
def test_crossings_begin_askew_towards_their_lane(robot):
    terrain = make_terrain("bridge", robot=robot, seed=3)
    env = env_class(robot)(World([[terrain]]), 512, config=EnvConfig(start_yaw=0.8))
    across = env.crossings.crossing
    ahead = torch.where(torch.cos(env.crossings.target_yaw) > 0, 0.0, math.pi)
    angle = torch.remainder(env.crossings.target_yaw - ahead + math.pi, 2 * math.pi) - math.pi
    assert 0.6 < angle[across].abs().max() < 0.81
    # Seen along the way, a robot left of the lane heads to the right.
    left = env.crossings.beside_lane(env.motion()[0]) + env.crossings.aside
    left = left * torch.cos(ahead)
    steep = across & (angle.abs() > 0.16) & (left.abs() > 0.01)
    assert steep.sum() > 100 and (torch.sign(angle) == -torch.sign(left))[steep].all()


@robots
def test_the_curriculum_follows_the_tracking_reward(robot):
    tiles = [[make_terrain("flat", robot=robot, seed=2)] for _ in range(3)]
    env = env_class(robot)(World(tiles), 7, config=EnvConfig())
    env.crossings.row = torch.tensor([1, 1, 1, 1, 1, 1, 2])
    mean = torch.tensor([0.9, 0.9, 0.9, 0.4, 0.9, 0.9, 0.9])
    failed = torch.tensor([False, True, True, False, False, True, False])
    way = torch.tensor([0.9, 0.2, 0.7, 0.9, 0.1, 0.2, 0.9])
    here = env.motion()[0][:, :2]
    env.crossings.begin[:] = here
    env.crossings.begin[:, 0] -= way * env.crossings.tile_size[0]
    env.crossings.crossing[:] = torch.arange(7) != 5
    env.crossings.promote(torch.arange(7), mean, here, failed)
    row = env.crossings.row
    # Tracked well: up. Failed early: down. Failed late, tracked badly, soon over, or failed but was
    # not to cross the tile: stays. Tracked well on the last row: anywhere in the harder half.
    assert row[:6].tolist() == [2, 0, 1, 1, 1, 1] and row[6] >= 1


@robots
def test_a_crossing_is_steered_along_the_lane_at_its_distance(robot):
    terrain = make_terrain("bridge", robot=robot, difficulty=0.0, seed=3)
    config = EnvConfig(train=False)
    env = env_class(robot)(World([[terrain]]), 3, config=config)
    beam = terrain.lane[1][1]
    (x0, _), (x1, _) = terrain.lane[1:3]
    corner = env.crossings.corner(torch.arange(1))[0]
    places = torch.tensor([[(x0 + x1) / 2, beam + side, 0.0] for side in (-0.1, 0.0, 0.1)])
    places[:, :2] += corner
    env.start(torch.arange(3), places, 0.5)
    env.crossings.crossing[:], env.crossings.aside[:] = True, 0.0
    pose = env.motion()[0]
    off = env.crossings.headings(pose, env.control_dt) - pose[:, 3]
    # To the right of the beam's line: turn left; on it: straight on; to its left: turn right.
    assert off[0] > 0.1 and abs(off[1]) < 0.02 and off[2] < -0.1
    env.crossings.aside[:] = 0.1
    assert abs(env.crossings.headings(pose, env.control_dt)[2] - pose[2, 3]) < 0.02


@pytest.mark.parametrize("angle", [30.0, -140.0])
def test_a_way_that_lies_askew_is_crossed_along_it(angle):
    """Distances to the beam and angles to it, worked out anew from the terrain's own lane."""
    terrain = make_turned("bridge", robot="a1", angle=angle, seed=4)
    config = EnvConfig(start_yaw=0.0, start_beside=0.0, traverse_share=1.0, episode_seconds=20.0)
    env = env_class("a1")(World([[terrain]]), 64, config=config)
    pose, corner = env.motion()[0], env.crossings.corner(torch.arange(1))[0]
    a, b = (torch.tensor(point) for point in terrain.lane[1:3])
    along = (b - a) / (b - a).norm()
    left = torch.stack((-along[1], along[0]))
    start = pose[:, :2] - corner
    ends = torch.tensor([terrain.start, terrain.goal])
    assert (torch.cdist(start, ends).amin(dim=1) < terrain.spread + 0.03).all()
    heading = torch.stack((torch.cos(pose[:, 3]), torch.sin(pose[:, 3])), dim=-1)
    forth = torch.sign(heading @ along)
    assert 0.1 < (forth < 0).float().mean() < 0.6
    assert ((heading @ along).abs() > math.cos(0.16)).all()  # `SLIGHT` askew
    # Whoever is beside the way on the beam is steered back to it, at equal distances alike.
    ids = torch.arange(3)
    side = torch.tensor([0.1, 0.0, -0.1])
    places = corner + (a + b) / 2 + side[:, None] * left
    yaw = math.atan2(along[1], along[0])
    env.start(ids, torch.cat((places, torch.full((3, 1), yaw)), dim=-1), 0.5)
    env.crossings.crossing[ids], env.crossings.aside[ids] = True, 0.0
    assert env.crossings.beside_lane(env.motion()[0])[ids].tolist() == pytest.approx(
        side.tolist(), abs=0.01
    )
    off = (env.crossings.headings(env.motion()[0], env.control_dt) - yaw)[ids]
    assert off.tolist() == pytest.approx([-0.224, 0.0, 0.224], abs=0.03)  # asin(0.1 / 0.45)
    assert not env.crossings.outside(env.motion()[0])[0].any()


def test_an_unknown_robot_lists_the_known_ones():
    with pytest.raises(ConfigError, match="toy"):
        env_class("zebra")


def test_an_environment_needs_a_robot():
    with pytest.raises(ConfigError, match="num_envs"):
        make_env("toy", num_envs=0)
