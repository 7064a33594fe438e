import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from fgtutor import execution
from fgtutor.directions import STEPS
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, InfeasibleCellError
from fgtutor.execution import FollowConfig, _Track, execute, execute_batch
from fgtutor.planning import plan
from fgtutor.robots import conditions_of
from fgtutor.robots.toy import ToyEnv
from fgtutor.world.terrain import Terrain, make_terrain


def straight(elevation, start, goal, policy=0):
    """The route that a tensor of ones gives, all of it by one policy."""
    fused = np.ones((*elevation.shape, 8))
    policies = np.full(fused.shape, policy)
    return plan(
        fused, policies, grid=elevation, start=start, goal=goal, cost="length", backend="scipy",
        unknown="fill",
    )  # fmt: skip


def flat(shape=(60, 40)):
    return ElevationMap(np.zeros(shape))


def task(start, goal, heights=None):
    elevation = ElevationMap(heights) if heights is not None else flat()
    return straight(elevation, start, goal), Terrain.from_elevation(elevation, start, goal)


def test_a_toy_reaches_the_end_of_a_straight_route(make_rolling):
    route, terrain = task((1.0, 2.0), (4.0, 2.0))
    episode = execute(route, terrain, {"roll": make_rolling()})
    assert episode.success and episode.reason == "reached"
    assert np.hypot(*(episode.poses[-1, :2] - route.xy[-1])) <= 0.35
    assert episode.length == pytest.approx(3.0 - 0.35, abs=0.15)
    # 2.65 m at 0.85 m/s, and a moment to get going.
    assert episode.seconds == pytest.approx(3.1, abs=0.6)
    assert episode.body is not None and len(episode.body) == len(episode.poses)


def two_speeds(make_rolling, first, second):
    """Return 5 m straight on whose halves two policies drive, where they meet, terrain and zoo."""
    route, terrain = task((0.5, 2.0), (5.5, 2.0))
    half = len(route.policies) // 2
    policies = np.where(np.arange(len(route.policies)) < half, 0, 1)
    both = replace(route, policies=policies, names=("first", "second"))
    zoo = {
        name: make_rolling(name, command=(speed, 0.0, 0.0))
        for name, speed in (("first", first), ("second", second))
    }
    return both, both.xy[half, 0], terrain, zoo


def test_each_policy_drives_at_its_own_speed(make_rolling):
    route, seam, terrain, zoo = two_speeds(make_rolling, 0.4, 1.2)
    episode = execute(route, terrain, zoo)
    assert episode.success and episode.switches == 1
    x, by = episode.poses[:, 0], episode.policies
    moved = np.append(0.0, np.diff(x)) * len(x) / episode.seconds
    # From 0.4 to 1.2 m/s at 0.5 m/s^2 it takes 1.28 m.
    slow, fast = np.median(moved[by == 0]), np.median(moved[x > seam + 1.5])
    assert slow == pytest.approx(0.4, abs=0.05) and fast == pytest.approx(1.2, abs=0.1)
    assert x[by == 0].max() == pytest.approx(seam, abs=0.2)


@pytest.mark.parametrize(("acceleration", "entering"), [(0.5, 0.5), (1e6, 1.2)])
def test_it_has_slowed_down_when_a_slower_policy_takes_over(make_rolling, acceleration, entering):
    route, seam, terrain, zoo = two_speeds(make_rolling, 1.2, 0.5)
    episode = execute(route, terrain, zoo, config=FollowConfig(acceleration=acceleration))
    assert episode.success
    x = episode.poses[:, 0]
    v = np.diff(x) * len(x) / episode.seconds
    assert v[np.argmax(x > seam - 0.05)] == pytest.approx(entering, abs=0.12)
    # (1.2^2 - 0.5^2) / (2 * 0.5) = 1.19 m before it, nothing has changed yet.
    before = (x[:-1] > 1.2) & (x[:-1] < seam - 1.3)
    assert np.median(v[before]) == pytest.approx(1.2, abs=0.1)


def test_no_rounding_makes_a_speed_less_than_the_slowest(make_rolling):
    route, _, _, _ = two_speeds(make_rolling, 1.0, 1.0)
    far = replace(route, xy=route.xy * 10_000)
    track = _Track(far, {0: 0, 1: 1})
    assert len(track.points) > 1e6
    told = track.told(np.array([0.001, 0.002]), 1e6)
    assert told.min() == pytest.approx(0.001) and told.max() < 0.01


def test_the_time_limit_is_that_of_the_speeds_on_the_route(make_rolling):
    route, _, terrain, zoo = two_speeds(make_rolling, 0.5, 1.0)
    # Too little for any of it, and of the time that the route takes, not of the slowest's.
    late = FollowConfig(patience=0.5, grace=0.0)
    episode = execute(route, terrain, zoo, config=late)
    assert episode.reason == "timeout"
    assert episode.seconds == pytest.approx(0.5 * (2.5 / 0.5 + 2.5 / 1.0), abs=0.15)


@pytest.mark.parametrize("goal", [(4.0, 3.5), (1.0, 3.6), (4.5, 0.6)])
def test_it_follows_bends(make_rolling, goal):
    route, terrain = task((1.5, 2.0), goal)
    episode = execute(route, terrain, {"roll": make_rolling()})
    assert episode.success
    away = np.hypot(*(episode.poses[:, None, :2] - route.xy[None]).transpose(2, 0, 1)).min(axis=1)
    assert away.max() < 0.45, "it stays near the route"


def test_it_starts_towards_where_it_will_steer_not_along_the_first_cell(make_rolling):
    # 0.2 m aside in 3 m: two cells of the route are diagonal, wherever the search puts them.
    elevation, ends = flat(), ((1.05, 2.05), (4.05, 2.25))
    route = straight(elevation, *ends)
    cells = route.cells.copy()
    cells[1:3] = cells[0] + np.array([[1, 1], [2, 2]])
    cells[3:, 1] = cells[2, 1]
    headings = [
        next(k for k, s in enumerate(STEPS) if (s == d).all()) for d in np.diff(cells, axis=0)
    ]
    x, y = elevation.centres
    route = replace(
        route, cells=cells, xy=np.stack((x[cells[:, 0]], y[cells[:, 1]]), axis=-1),
        headings=np.array(headings),
    )  # fmt: skip
    terrain, sure = Terrain.from_elevation(elevation, *ends), FollowConfig(start_yaw_noise=0)
    episode = execute(route, terrain, {"roll": make_rolling()}, config=sure)
    assert episode.success
    # 0.55 m along it: two diagonals, 0.2 m each way, and 0.27 m straight on.
    assert episode.poses[0, 3] == pytest.approx(math.atan2(0.2, 0.47), abs=0.1)


@pytest.mark.slow
def test_a_ledge_is_a_time_out_and_a_gap_is_a_fall(make_rolling):
    ledge, gap = np.zeros((60, 40)), np.zeros((60, 40))
    ledge[30:], gap[30:34] = 0.2, -1.0
    tasks = [task((1.0, 2.0), (4.5, 2.0), heights) for heights in (ledge, gap)]
    zoo, patient = {"roll": make_rolling()}, FollowConfig(stuck_seconds=math.inf)
    episodes = execute_batch(*zip(*tasks, strict=True), zoo, seeds=[0, 1], config=patient)
    assert [episode.reason for episode in episodes] == ["timeout", "fell"]
    limit = 3 * tasks[0][0].length / 0.85 + 5
    assert episodes[0].seconds == pytest.approx(limit, abs=0.1)
    assert episodes[1].seconds < 5


def test_who_comes_no_further_runs_out_of_time_early(make_rolling):
    ledge = np.zeros((60, 40))
    ledge[30:] = 0.2
    route, terrain = task((1.0, 2.0), (4.5, 2.0), ledge)
    episode = execute(
        route, terrain, {"roll": make_rolling()}, config=FollowConfig(stuck_seconds=2)
    )
    assert episode.reason == "timeout"
    assert episode.poses[-1, 0] > 2.4, "it came as far as it could"
    assert 2 + 1.4 / 0.85 < episode.seconds < 7, "its time limit would be 17 s"


@pytest.mark.slow
def test_a_batch_gives_what_single_trials_give(make_rolling):
    terrains = [make_terrain("rubble", difficulty=0.3, seed=seed) for seed in (1, 3, 5)]
    routes = [straight(t.elevation, t.start, (6.0, t.start[1])) for t in terrains]
    zoo = {"roll": make_rolling()}
    together = execute_batch(routes, terrains, zoo, seeds=[7, 8, 9])
    for index, terrain in enumerate(terrains):
        alone = execute(routes[index], terrain, zoo, seed=7 + index)
        assert alone.reason == together[index].reason
        # Lanes lie at other heights in pymunk's space: equal up to what a float holds there.
        assert alone.poses[:20] == pytest.approx(together[index].poses[:20], abs=1e-3)


@pytest.mark.slow
def test_trials_on_one_terrain_share_a_tile_and_do_not_meet(make_rolling, monkeypatch):
    worlds, make = [], execution.World
    monkeypatch.setattr(execution, "World", lambda tiles: worlds.append(tiles) or make(tiles))
    one, other = (make_terrain("rubble", difficulty=0.3, seed=seed) for seed in (1, 3))
    routes = [straight(t.elevation, t.start, (6.0, t.start[1])) for t in (one, other, one, one)]
    zoo, seeds = {"roll": make_rolling()}, (7, 8, 7, 9)
    shared = execute_batch(routes, [one, other, one, one], zoo, seeds=seeds)
    apart = execute_batch(routes, [one, other, replace(one), replace(one)], zoo, seeds=seeds)
    assert [len(row) for (row,) in worlds] == [2, 4]
    for here, there in zip(shared, apart, strict=True):
        assert here.reason == there.reason
        assert here.poses[:20] == pytest.approx(there.poses[:20], abs=1e-3)
    # The same seed drives the same way, though another robot stands in the same place.
    assert shared[0].poses[:20] == pytest.approx(shared[2].poses[:20], abs=1e-6)
    assert not np.array_equal(shared[0].poses[0], shared[3].poses[0])


def test_the_policy_switches_where_the_route_says_and_holds_on_a_flicker(make_rolling):
    elevation = flat()
    fused = np.ones((60, 40, 8))
    policies = np.zeros(fused.shape, dtype=int)
    policies[30:] = 1
    policies[20] = 1  # one cell: over before the hysteresis has made up its mind
    route = plan(
        fused, policies, grid=elevation, start=(1.0, 2.0), goal=(4.5, 2.0), cost="length",
        backend="scipy",
    )  # fmt: skip
    assert route.switches == 3
    terrain = Terrain.from_elevation(elevation, (1.0, 2.0), (4.5, 2.0))
    zoo = {"a": make_rolling("steps"), "b": make_rolling("gaps")}
    held = execute(route, terrain, zoo, config=FollowConfig(hold_steps=4))
    assert held.success and held.switches == 1
    at = held.poses[np.flatnonzero(np.diff(held.policies))[0], 0]
    assert at == pytest.approx(3.1, abs=0.15)
    assert execute(route, terrain, zoo, config=FollowConfig(hold_steps=1)).switches == 3


def test_localisation_noise_misleads_the_follower_only(make_rolling):
    route, terrain = task((1.0, 2.0), (4.0, 2.0))
    zoo = {"roll": make_rolling()}
    exact = execute(route, terrain, zoo)
    lost = execute(route, terrain, zoo, config=FollowConfig(position_noise=0.1, drift=0.05))
    assert lost.poses[0, :2] == pytest.approx(exact.poses[0, :2], abs=1e-3)
    assert np.abs(lost.poses[40, 1] - 2.0) > np.abs(exact.poses[40, 1] - 2.0)


def test_the_seed_alone_decides(make_rolling):
    route, terrain = task((1.0, 2.0), (3.0, 2.0))
    zoo = {"roll": make_rolling()}
    first, again, other = (execute(route, terrain, zoo, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.poses, again.poses)
    assert not np.array_equal(first.poses[0], other.poses[0])


def test_a_route_of_one_cell_is_reached_at_once(make_rolling):
    route, terrain = task((2.0, 2.0), (2.0, 2.0))
    episode = execute(route, terrain, {"roll": make_rolling()})
    assert episode.success and len(episode.poses) == 1


def test_a_refusal_is_not_driven_but_says_why(make_rolling):
    elevation = ElevationMap(np.zeros((9, 9)))
    closed = np.zeros((9, 9, 8))
    terrain = Terrain.from_elevation(elevation, (0.15, 0.15), (0.75, 0.75))
    refusal = plan(closed, closed, grid=elevation, start=terrain.start, goal=terrain.goal)
    with pytest.raises(InfeasibleCellError, match="no policy can leave the start"):
        execute(refusal, terrain, {"roll": make_rolling()})


def test_no_routes_no_episodes(make_rolling):
    assert execute_batch([], [], {"roll": make_rolling()}, seeds=[]) == []


def test_what_cannot_be_driven_is_refused(make_rolling):
    route, terrain = task((1.0, 2.0), (3.0, 2.0))
    with pytest.raises(ConfigError, match="one route, terrain and seed"):
        execute_batch([route], [terrain], {"roll": make_rolling()}, seeds=[])
    with pytest.raises(ConfigError, match="policy 2; the zoo has roll"):
        execute(straight(flat(), (1, 2), (3, 2), policy=2), terrain, {"roll": make_rolling()})
    with pytest.raises(ConfigError, match="one robot"):
        execute(route, terrain, {})


def test_execution_leaves_the_policy_as_it_was(make_rolling):
    route, terrain = task((1.0, 2.0), (2.0, 2.0))
    specialist = make_rolling()
    before = {k: v.clone() for k, v in specialist.policy.state_dict().items()}
    execute(route, terrain, {"roll": specialist})
    assert all(torch.equal(v, before[k]) for k, v in specialist.policy.state_dict().items())


@pytest.fixture
def two(make_rolling):
    """A route whose second half another policy drives, the ground, and both policies by name."""
    elevation = flat()
    policies = np.zeros((60, 40, 8), dtype=int)
    policies[30:] = 1
    ends = {"start": (1.0, 2.0), "goal": (4.5, 2.0)}
    names = ["steps", "gaps"]
    fused = np.ones(policies.shape)
    route = plan(fused, policies, grid=elevation, cost="length", names=names, **ends)
    zoo = {name: make_rolling(name) for name in names}
    return route, Terrain.from_elevation(elevation, *ends.values()), zoo


@pytest.mark.slow
def test_policies_are_taken_by_name_whatever_the_order_of_the_zoo(two, make_rolling):
    route, terrain, zoo = two
    stranger = make_rolling("other", command=(0.2, 0.0, 0.0))
    zoos = [zoo, dict(reversed(zoo.items())), {"other": stranger, **dict(reversed(zoo.items()))}]
    asked = {name: [] for name in zoo}
    for name, specialist in zoo.items():
        specialist.policy.register_forward_hook(lambda *_, name=name: asked[name].append(1))
    episodes, counts = [], []
    for one in zoos:
        for calls in asked.values():
            calls.clear()
        episodes.append(execute(route, terrain, one))
        counts.append({name: len(calls) for name, calls in asked.items()})
    for episode in episodes:
        assert episode.success
        assert np.array_equal(episode.poses, episodes[0].poses)
        # Policies are numbered as the route numbers them.
        assert np.array_equal(episode.policies, episodes[0].policies)
    assert counts[0] == counts[1] == counts[2] and all(counts[0].values())
    assert counts[0]["steps"] == (episodes[0].policies == 0).sum()


def test_routes_of_different_policies_drive_in_one_batch(two):
    route, terrain, zoo = two
    turned = replace(route, names=tuple(reversed(route.names)), policies=1 - route.policies)
    first, second = execute_batch([route, turned], [terrain] * 2, zoo, seeds=[3, 3])
    assert first.success and np.array_equal(first.policies, 1 - second.policies)


def test_a_policy_that_the_zoo_lacks_is_named(two):
    route, terrain, zoo = two
    with pytest.raises(ConfigError, match="routes name gaps; the zoo has steps"):
        execute(route, terrain, {"steps": zoo["steps"]})
    # What a route does not use need not be there.
    only = replace(route, policies=np.zeros_like(route.policies))
    assert execute(only, terrain, {"steps": zoo["steps"]}).success


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *((f, v) for f in FollowConfig.__annotations__ for v in (math.nan, -1, "1", None)),
        *((f, math.inf) for f in FollowConfig.__annotations__ if f != "stuck_seconds"),
        ("lookahead", 1e308),
        ("patience", 1e308),
        ("hold_steps", 0),
        ("hold_steps", 1.5),
        ("stuck_seconds", 0.0),
    ],
)
def test_a_setting_that_cannot_work_is_named(field, value):
    with pytest.raises(ConfigError, match=f"^{field}: "):
        FollowConfig(**{field: value})


def test_no_time_at_all_is_one_step(make_rolling):
    route, terrain = task((1.0, 2.0), (4.0, 2.0))
    none = FollowConfig(patience=0.0, grace=0.0)
    episode = execute(route, terrain, {"roll": make_rolling()}, config=none)
    assert episode.reason == "timeout" and len(episode.poses) == 1


def test_a_negative_seed_is_refused(make_rolling):
    route, terrain = task((1.0, 2.0), (4.0, 2.0))
    with pytest.raises(ConfigError, match="seeds are numbers from 0, got -1"):
        execute(route, terrain, {"roll": make_rolling()}, seed=-1)


def test_a_route_that_leaps_to_the_moon_is_refused(make_rolling):
    route, terrain = task((1.0, 2.0), (4.0, 2.0))
    xy = route.xy.copy()
    xy[-1] = 3.8e8
    with pytest.raises(ConfigError, match="too long"):
        execute(replace(route, xy=xy), terrain, {"roll": make_rolling()})


@pytest.mark.slow
@pytest.mark.parametrize("displaced", [False, True])
def test_a_wrong_fix_moves_what_is_seen_if_asked(make_rolling, monkeypatch, displaced):
    terrain = make_terrain("rubble", difficulty=0.3, seed=1)
    route = straight(terrain.elevation, terrain.start, (4.0, terrain.start[1]))
    errors, look = [], ToyEnv.patches

    def noted(env):
        seen, poses = look(env), env.motion()[0][:, [0, 1, 3]]
        poses[:, :2] += env.displacement
        assert torch.equal(seen, env.patches_at(poses))
        errors.append(env.displacement.clone())
        return seen

    monkeypatch.setattr(ToyEnv, "patches", noted)
    config = FollowConfig(position_noise=0.05, displaced_scan=displaced)
    execute(route, terrain, {"roll": make_rolling()}, config=config)
    spread = torch.cat(errors[5:]).std()
    assert spread == (pytest.approx(0.05, rel=0.3) if displaced else 0.0)


@pytest.mark.slow
def test_fused_fixes_are_wrong_by_less_but_keep_their_drift(make_rolling, monkeypatch):
    terrain = make_terrain("rubble", difficulty=0.3, seed=1)
    route = straight(terrain.elevation, terrain.start, (4.0, terrain.start[1]))
    look, errors = ToyEnv.patches, []
    monkeypatch.setattr(
        ToyEnv, "patches", lambda env: (errors.append(env.displacement.clone()), look(env))[1]
    )

    def spread(**options) -> float:
        errors.clear()
        config = FollowConfig(displaced_scan=True, **options)
        execute(route, terrain, {"roll": make_rolling()}, config=config)
        return float(torch.cat(errors[25:]).square().mean().sqrt())

    # A first-order filter with share a leaves sqrt(a / (2 - a)) of white noise: 0.04 s of 0.4 s.
    fused = spread(position_noise=0.05, fusing_seconds=0.4)
    assert fused == pytest.approx(0.05 * (0.1 / 1.9) ** 0.5, rel=0.35)
    assert spread(position_noise=0.05, fusing_seconds=0.04) == spread(position_noise=0.05)
    assert spread(drift=0.05, fusing_seconds=0.4) == pytest.approx(spread(drift=0.05), rel=0.35)


@pytest.mark.slow
def test_a_condition_makes_another_robot(make_rolling):
    route, terrain = task((1.0, 2.0), (4.5, 2.0), np.zeros((60, 40)))
    run = {"zoo": {"roll": make_rolling()}, "seeds": [3]}
    conditions = conditions_of("toy")
    slippery = conditions.axes["low-friction"].levels["x 0.4"]
    plain, same, other = (
        execute_batch([route], [terrain], condition=condition, **run)[0]
        for condition in (None, conditions.undisturbed, slippery)
    )
    assert np.array_equal(plain.poses, same.poses)
    assert not np.array_equal(plain.poses[:20], other.poses[:20])
