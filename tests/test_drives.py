"""What the notebooks drive: functions, straight routes, many walks, routes against all advice."""

import numpy as np
import pytest
import torch

from fgtutor.baselines import AssessedMap, find_route, ours, without_ood
from fgtutor.course.drives import Scripted, collect, drive_together, straight_route
from fgtutor.course.route_pictures import draw_drive
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.execution import FollowConfig, execute
from fgtutor.feasibility import feasibility_labels
from fgtutor.figures import charts
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import World, make_terrain

SHORT = FollowConfig(patience=1.0, grace=1.0)


def roll(observations) -> torch.Tensor:
    return torch.zeros(len(observations), 4)


def png(figure) -> bytes:
    return figure._repr_png_()


@pytest.mark.slow
def test_a_plain_function_drives_straight_to_the_goal_on_flat_ground():
    terrain = make_terrain("flat", robot="toy")
    route = straight_route(terrain, "roll")
    assert route.xy[0] == pytest.approx(terrain.start, abs=0.1)
    assert route.xy[-1] == pytest.approx(terrain.goal, abs=0.1)
    assert route.length == pytest.approx(terrain.goal[0] - terrain.start[0], abs=0.15)
    episode = execute(route, terrain, {"roll": Scripted(roll)}, config=SHORT)
    assert episode.success and set(episode.policies.tolist()) == {0}
    assert png(draw_drive(episode, route, terrain.elevation))
    assert png(charts.draw_tracking(episode, terrain, 0.85, np.ones(len(episode.poses))))


@pytest.mark.filterwarnings("ignore::tqdm.TqdmWarning")
def test_a_rollout_has_every_group_over_time():
    env = ToyEnv(World([[make_terrain("steps", robot="toy")]]), 3)
    rollout = collect(env, roll, seconds=0.4)
    assert {name: tuple(v.shape[:2]) for name, v in rollout.items()} == dict.fromkeys(
        ("policy", "patch", "command", "tracking"), (10, 3)
    )
    label, valid = feasibility_labels(rollout["tracking"], 4)
    assert png(charts.draw_labels(rollout["tracking"][:, 0], label[:, 0], valid[:, 0], 0.04))


@pytest.mark.slow
def test_walks_are_driven_together_and_count_as_their_routes_do(make_rolling):
    ground = make_terrain("flat", robot="toy")
    zoo = {name: make_rolling(name) for name in ("gaps", "slopes", "steps")}
    jobs = [(straight_route(ground, name), ground, 3) for name in ("steps", "gaps")]
    first, second = drive_together(jobs, zoo, config=SHORT)
    assert first.success and second.success
    assert set(first.policies) == set(second.policies) == {0}
    (alone,) = drive_together(jobs[:1], zoo, config=SHORT)
    np.testing.assert_allclose(first.poses, alone.poses, atol=1e-6)


def test_a_route_of_strangers_is_refused(make_rolling):
    ground = make_terrain("flat", robot="toy")
    with pytest.raises(ConfigError, match="routes name gaps; the zoo has steps"):
        drive_together([(straight_route(ground, "gaps"), ground, 0)], {"steps": make_rolling()})


def test_without_w_ood_a_route_goes_where_ours_refuses(make_rolling):
    """A net that promises little and knows nothing: L_recon is far above its taus everywhere."""
    heights = np.zeros((30, 10))
    heights[14:16] = 0.4
    wall = ElevationMap(heights)
    shy = make_rolling(f=0.02, quantiles={"0.5": 1e-9, "0.9": 2e-9, "0.95": 3e-9, "0.99": 4e-9})
    ground, ends = AssessedMap(wall, {"steps": shy}), ((0.55, 0.55), (2.45, 0.55))
    assert not find_route(ours, ground, *ends)
    brave = {"f_min": 1e-9, "least_promise": 0.0}
    route = find_route(without_ood, ground, *ends, **brave).raise_for()
    assert not find_route(ours, ground, *ends, least_promise=0.0)
    assert len(route.headings) == 19 and route.names == ("steps",)
    assert route.feasibility == pytest.approx(0.02, abs=1e-6)
