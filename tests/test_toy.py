import math
from dataclasses import asdict

import numpy as np
import pytest
import torch

from fgtutor.elevation import ElevationMap
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.toy import STOREY, WIDE, ToyEnv, ToyModel, polyline
from fgtutor.world.terrain import Terrain, World


def on(heights, poses, speed=0.8):
    """Toys at rest on a map of 0.1 m cells."""
    terrain = Terrain.from_elevation(ElevationMap(np.asarray(heights, dtype=float)), (1, 1), (2, 1))
    env = ToyEnv(World([[terrain]]), len(poses), config=EnvConfig(train=False))
    poses = torch.tensor(poses, dtype=torch.float32)
    poses[:, :2] += env.crossings.corner(torch.arange(len(poses)))
    env.start(torch.arange(len(poses)), poses, speed)
    return env


def roll(env, seconds, action=(0.0, 0.0, 0.0, 0.0)):
    """Drive with a constant action; return which robots fell on the way."""
    fell = torch.zeros(env.num_envs, dtype=torch.bool)
    for _ in range(round(seconds / env.control_dt)):
        *_, extras = env.step(torch.tensor(action).repeat(env.num_envs, 1))
        fell |= extras["fell"]
    return fell


def place(env):
    return (env.motion()[0][:, :2] - env.crossings.corner(torch.arange(env.num_envs))).numpy()


FLAT = np.zeros((60, 30))


def test_it_rolls_at_the_commanded_speed_along_its_heading():
    env = on(FLAT, [(1.0, 1.0, 0.0), (1.0, 1.0, math.pi / 4), (5.0, 2.0, math.pi)])
    assert not roll(env, 2.0).any()
    travelled = place(env) - [(1.0, 1.0), (1.0, 1.0), (5.0, 2.0)]
    assert np.hypot(*travelled.T) == pytest.approx([1.6] * 3, abs=0.2)
    along = [(1, 0), (math.sqrt(0.5), math.sqrt(0.5)), (-1, 0)]
    cosine = (travelled * along).sum(axis=1) / np.hypot(*travelled.T)
    assert cosine == pytest.approx([1.0] * 3, abs=1e-4)
    assert env.motion()[1][:, 0].numpy() == pytest.approx([0.8] * 3, abs=0.15)


def test_direction_matters_at_a_ledge():
    ledge = FLAT.copy()
    ledge[30:] = 0.25  # x >= 3 m is 25 cm higher
    up, down, along = (2.0, 1.5, 0.0), (4.0, 1.5, math.pi), (2.5, 0.5, math.pi / 2)
    env = on(ledge, [up, down, along])
    roll(env, 2.5)
    x, y = place(env).T
    assert x[0] < 3.2, "a toy that only rolls cannot climb 25 cm"
    assert x[1] < 2.5, "it can drop down the same ledge"
    assert y[2] > 1.8, "and along the ledge there is nothing to climb"


def test_it_drops_into_a_gap_and_that_is_a_fall():
    gap = FLAT.copy()
    gap[30:34] = -1.0
    env = on(gap, [(1.5, 1.5, 0.0)])
    assert roll(env, 3.0).all()


def test_it_can_roll_over():
    env = on(FLAT, [(3.0, 1.5, 0.0)])
    chassis = env.bodies[0][0]
    chassis.angular_velocity = 30.0
    assert roll(env, 1.0).all()


def test_legs_lift_the_chassis():
    env = on(FLAT, [(3.0, 1.5, 0.0), (3.0, 1.5, 0.0)], speed=0.0)
    low = env.motion()[0][0, 2].item()
    for _ in range(20):
        env.step(torch.tensor([[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]))
    high, same = env.motion()[0][:, 2].tolist()
    assert high - low > 0.1 and same == pytest.approx(low, abs=0.03)


def test_it_turns_at_the_commanded_rate():
    env = on(FLAT, [(3.0, 1.5, 0.0)], speed=0.3)
    env.command[:, 2] = 1.0
    roll(env, 1.0)
    assert env.motion()[0][0, 3].item() == pytest.approx(1.0, abs=1e-3)
    assert place(env)[0, 1] > 1.55, "it left its line to the left"


def test_one_robot_does_not_touch_another():
    alone = on(FLAT, [(1.0, 1.0, 0.0)])
    crowd = on(FLAT, [(1.0, 1.0, 0.0)] * 3)
    roll(alone, 1.0)
    roll(crowd, 1.0)
    assert place(crowd) == pytest.approx(np.repeat(place(alone), 3, axis=0), abs=1e-6)


def test_wide_disturbances_make_every_toy_another_and_the_same_seed_the_same():
    terrain = Terrain.from_elevation(ElevationMap(FLAT), (1, 1), (2, 1))
    options = {"config": EnvConfig(train=False), "settings": WIDE}
    env, again, other = (ToyEnv(World([[terrain]]), 20, seed=k, **options) for k in (3, 3, 4))
    assert env.models == again.models != other.models
    own = ToyModel()
    for name, (low, high) in asdict(WIDE).items():
        drawn = np.array([getattr(one, name) for one in env.models]) / getattr(own, name)
        assert low <= drawn.min() < drawn.max() <= high and np.ptp(drawn) > 0.5 * (high - low)
    chassis = [bodies[0].mass for bodies in env.bodies]
    assert chassis == [one.chassis_mass for one in env.models]
    # Heavier toys on weaker springs stand lower: the drawn bodies are those that are simulated.
    place = torch.tensor([[1.0, 1.0, 0.0]]).repeat(20, 1)
    place[:, :2] += env.crossings.corner(torch.arange(20))
    env.start(torch.arange(20), place, 0.5)
    roll(env, 1.0)
    sag = [one.chassis_mass / one.leg_stiffness for one in env.models]
    assert np.corrcoef(sag, env.motion()[0][:, 2].numpy())[0, 1] < -0.9
    assert set(ToyEnv(World([[terrain]]), 3, config=EnvConfig()).models) == {own}


def test_a_robot_on_the_border_sees_its_edge_continue():
    env = on(FLAT, [(5.9, 1.5, 0.0)])
    assert not roll(env, 1.0).any()


def test_polyline_keeps_an_edge_vertical_and_drops_collinear_points():
    s = np.arange(7.0)
    h = np.array([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
    assert polyline(s, h).tolist() == [[0, 0], [2, 0], [2.5, 0], [2.5, 0.5], [3, 0.5], [6, 0.5]]


def test_polyline_keeps_a_gentle_slope_smooth():
    s = 0.05 * np.arange(5)
    h = np.array([0.0, 0.0, 0.02, 0.04, 0.04])
    vertices = polyline(s, h)
    assert vertices[:, 0].tolist() == pytest.approx([0.0, 0.05, 0.15, 0.2])


@pytest.mark.parametrize("train", [True, False])
def test_a_robot_off_its_line_has_failed_and_on_a_route_there_is_no_line(train):
    terrain = Terrain.from_elevation(ElevationMap(FLAT), (1, 1), (2, 1))
    env = ToyEnv(World([[terrain]]), 3, config=EnvConfig(train=train))
    poses = torch.tensor([(2.0, 1.5, 0.0)] * 3)
    poses[:, :2] += env.crossings.corner(torch.arange(3))
    env.start(torch.arange(3), poses, 0.8)
    env.crossings.anchor[1, 1] += (
        0.9  # its line lies 0.9 m to its left, the third's 1.1 m to its right
    )
    env.crossings.anchor[2, 1] -= 1.1
    env.step(torch.zeros(3, 4))
    assert env.tracking[:, 1].tolist() == [0.0, 0.0, float(train)]
    assert (env.tracking[:, 0] > 0).tolist() == [True, True, not train]


def test_storeys_are_far_apart():
    env = on(FLAT, [(1.0, 1.0, 0.0)] * 2)
    assert env.bodies[1][0].position.y - env.bodies[0][0].position.y == pytest.approx(STOREY)
