"""The right answers of the checks are right: by the library, by another library, or by hand."""

import itertools
import math

import mujoco
import networkx
import numpy as np
import pytest
import torch

from fgtutor import patches
from fgtutor.course.checks import ex08_a1, find
from fgtutor.directions import STEPS, YAWS
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import OodScore, feasibility_labels, ood_weight, tracking_reward
from fgtutor.fusion import fuse
from fgtutor.planning import PAPER, as_networkx, as_switching_networkx, plan
from fgtutor.robots.a1 import model as a1_model
from fgtutor.robots.a1.randomise import A1EnvConfig
from fgtutor.robots.steering import turn_rate
from fgtutor.statistics import calibration, spl, wilson_interval
from fgtutor.tensorization import assess


def answer(question: str, *arguments):
    return find(question).truth(*arguments)


def cases(question: str, seed: int = 5):
    return find(question).cases(seed)


def test_cells_are_those_of_the_map():
    for xy, origin, resolution in cases("ex01.q1"):
        grid = ElevationMap(np.zeros((20, 20)), resolution=resolution, origin=tuple(origin))
        inside = [grid.contains(*point) for point in xy]
        ours = answer("ex01.q1", xy, origin, resolution)[inside]
        assert ours.tolist() == [list(grid.cell_of(*point)) for point in xy[inside]]


def test_ground_is_that_of_the_patch_grid():
    grid = patches.PatchGrid(ahead=0.3, behind=0.3, half_width=0.2, footprint=(0.1, 0.1))
    for patch, footprint in cases("ex01.q2"):
        flat = torch.from_numpy(patch).flatten()
        expected = (flat - patches.ground_height(flat, grid)).reshape(grid.shape)
        np.testing.assert_allclose(answer("ex01.q2", patch, footprint), expected)


def test_patch_points_are_those_of_the_library():
    for offsets, pose in cases("ex01.q3"):
        turned = patches.rotate(torch.from_numpy(offsets), torch.tensor(pose[2]).double())
        np.testing.assert_allclose(answer("ex01.q3", offsets, pose), turned.numpy() + pose[:2])


def test_rise_by_a_loop():
    for heights, heading in cases("ex01.q4"):
        rise = answer("ex01.q4", heights, heading)
        for cell in np.ndindex(heights.shape):
            there = tuple(cell + STEPS[heading])
            inside = all(0 <= i < n for i, n in zip(there, heights.shape, strict=True))
            expected = heights[there] - heights[cell] if inside else math.nan
            assert rise[cell] == pytest.approx(expected, nan_ok=True)


def test_tracking_reward_is_the_library_s():
    for velocity, command in cases("ex02.q1"):
        expected = tracking_reward(torch.tensor(velocity), torch.tensor(command))
        np.testing.assert_allclose(answer("ex02.q1", velocity, command), expected)


def test_labels_are_those_of_the_library_up_to_the_fall():
    for r_v, fell, window in cases("ex02.q2"):
        # The library's row t tells of the step that led to time t: one row more at the start.
        ended = np.diff(fell.astype(float), prepend=0.0)
        rows = np.concatenate((np.zeros((1, 3)), np.stack((r_v * ~fell, ended, ended), axis=-1)))
        labels, _ = feasibility_labels(torch.tensor(rows)[:, None], window)
        alive = min(int(ended.argmax()) + 1, len(r_v) - window + 1)
        ours = answer("ex02.q2", r_v, fell, window)
        np.testing.assert_allclose(ours[:alive], labels[:alive, 0], rtol=1e-6)


def test_returns_and_objective_by_hand():
    done = np.array([False, True, False])
    # From the end: 1; 1 (last of its episode); 1 + 0.5 * 1.
    assert answer("ex02.q3", np.ones(3), done, 0.5).tolist() == [1.5, 1.0, 1.0]
    # A = 1: min(2, 1.2) = 1.2; A = -1: min(-2, -1.2) = -2; the mean is -0.4.
    ratio, advantage = np.array([2.0, 2.0]), np.array([1.0, -1.0])
    assert answer("ex02.q4", ratio, advantage, 0.2) == pytest.approx(-0.4)


def test_feasibility_loss_by_hand():
    # (0.5 - 1)^2 = 0.25 and 0: mean 0.125; recon mean 2, kl mean 10: 3 (2 + 0.1 * 10) = 9.
    f, r_v = np.array([0.5, 1.0]), np.array([1.0, 1.0])
    loss = answer("ex03.q1", f, r_v, np.array([1.0, 3.0]), np.array([0.0, 20.0]), 3.0, 0.1)
    assert loss == pytest.approx(9.125)


def test_divergence_is_that_of_torch():
    for mean, log_variance in cases("ex03.q2"):
        scale = torch.tensor(log_variance / 2).exp()
        ours, prior = (
            torch.distributions.Normal(torch.tensor(mean), scale),
            torch.distributions.Normal(0.0, 1.0),
        )
        expected = torch.distributions.kl_divergence(ours, prior).sum(-1)
        np.testing.assert_allclose(answer("ex03.q2", mean, log_variance), expected, atol=1e-12)


def test_calibration_is_the_library_s():
    for predicted, measured, bins in cases("ex03.q3"):
        table, error = calibration(predicted, measured, bins)
        np.testing.assert_allclose(answer("ex03.q3", predicted, measured, bins), table)
        assert answer("ex03.q4", table) == pytest.approx(error)


def test_reconstruction_loss_is_the_network_s(make_specialist):
    net = make_specialist().feasibility
    patch = torch.randn(5, net.num_points, generator=torch.Generator().manual_seed(0)) * 0.1
    with torch.no_grad():
        mean, _ = net.encoder(net.height_scale * patch).chunk(2, dim=-1)
        decoded, expected = net.decoder(mean).numpy(), net.reconstruction(patch)
    ours = answer("ex04.q1", patch.numpy(), decoded, net.height_scale)
    np.testing.assert_allclose(ours, expected, rtol=1e-5)


def test_weights_and_taus_are_the_library_s():
    for loss, low, high in cases("ex04.q2"):
        np.testing.assert_allclose(answer("ex04.q2", loss, low, high), ood_weight(loss, low, high))
    for losses, own, alpha in cases("ex04.q3"):
        levels = 1 - np.arange(1, len(own)) / len(own)
        exact = dict(zip(map(str, levels), np.sort(own)[:0:-1].tolist(), strict=True))
        one = OodScore(None, (exact, exact), alpha=min(2 * alpha, 0.99))  # of two equal p-values
        ours = one.weight(torch.tensor(losses), torch.tensor(losses))
        inner = losses < own.max()  # beyond, the library goes on with a tail
        np.testing.assert_allclose(
            answer("ex04.q3", losses, own, alpha)[inner], ours[inner], atol=0.1
        )
    assert 0.9 * ood_weight(answer("ex04.q4")) == pytest.approx(0.1)


def test_windows_and_first_layer_are_those_of_torch():
    for heights, rows, columns in cases("ex05.q1"):
        ours = answer("ex05.q1", heights, rows, columns)
        for i, j in np.ndindex(ours.shape[:2]):
            window = heights[i : i + rows, j : j + columns]
            np.testing.assert_array_equal(ours[i, j], window.ravel())
    for heights, kernel, bias in cases("ex05.q2"):
        convolved = torch.nn.functional.conv2d(
            torch.tensor(heights)[None, None], torch.tensor(kernel)[None, None]
        )
        np.testing.assert_allclose(answer("ex05.q2", heights, kernel, bias), convolved[0, 0] + bias)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_tensor_is_the_tensor_of_the_turned_map(make_specialist, quarters):
    heights = np.random.default_rng(0).uniform(0, 0.2, (7, 5))
    grid, specialist = ElevationMap(heights), make_specialist()
    of_turned = assess(grid.rotated90(quarters), specialist).f.numpy()
    turned = answer("ex05.q3", assess(grid, specialist).f.numpy(), quarters)
    np.testing.assert_allclose(turned, of_turned, atol=1e-5)


def test_reconstruction_without_decoding_by_decoding():
    rng = np.random.default_rng(0)
    decoder, aims, codes = (
        rng.normal(size=(9, 3)),
        rng.normal(size=(5, 9)),
        rng.normal(size=(5, 3)),
    )
    expected = ((aims - codes @ decoder.T) ** 2).sum(axis=-1)
    ours = answer("ex05.q4", codes, (aims**2).sum(-1), aims @ decoder, decoder.T @ decoder)
    np.testing.assert_allclose(ours, expected)


def test_fusion_and_edges_are_the_library_s():
    for (tensors,) in cases("ex06.q1"):
        for ours, theirs in zip(answer("ex06.q1", tensors), fuse(list(tensors)), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    for fused, f_min in cases("ex06.q2"):
        graph = as_networkx(fused, np.zeros(fused.shape, dtype=int), f_min=f_min)
        with np.errstate(divide="ignore"):
            costs = answer("ex06.q2", fused, f_min)
        for cell, _, edge in graph.edges(data=True):
            assert costs[(*cell, edge["heading"])] == pytest.approx(edge["weight"])
        assert np.isfinite(costs).sum() == (fused >= f_min).sum()


def test_cheapest_is_dijkstra_s():
    reached = 0
    for costs, start, goal in cases("ex06.q3"):
        fused = np.where(np.isfinite(costs), 1 / costs, 0)
        graph = as_networkx(fused, np.zeros(costs.shape, dtype=int), f_min=1e-9)
        expected = networkx.single_source_dijkstra_path_length(graph, start).get(goal, math.inf)
        assert answer("ex06.q3", costs, start, goal) == pytest.approx(expected)
        reached += math.isfinite(expected)
    assert reached >= 5


def test_route_cost_is_that_of_the_planned_route():
    fused = np.random.default_rng(0).uniform(0.2, 1, (6, 5, 8))
    grid = ElevationMap(np.zeros((6, 5)), resolution=1.0)
    ends = {"start": (0.5, 0.5), "goal": (5.5, 4.5)}
    route = plan(fused, np.zeros(fused.shape, int), grid=grid, **ends, settings=PAPER).raise_for()
    assert answer("ex06.q4", fused, route.cells) == pytest.approx(route.cost)


def test_aim_point_and_hysteresis_by_hand():
    # Up 0.4 m, then a hairpin back: the vertex nearest to (0, 0.19) is (0, 0.2); 0.3 m on along the
    # route lies (0.1, 0.4), with 0.2 + 0.1.
    route = np.array([[0, 0], [0, 0.2], [0, 0.4], [0.1, 0.4], [0.1, 0.2], [0.1, 0.0]])
    assert answer("ex07.q1", route, np.array([0.0, 0.19]), 0.3).tolist() == [0.1, 0.4]
    assert answer("ex07.q1", route, np.array([0.0, 0.19]), 9.0).tolist() == [0.1, 0.0]
    assert answer("ex07.q3", np.array([0, 1, 0, 1, 1, 1, 1]), 3).tolist() == [0, 0, 0, 0, 0, 1, 1]


def test_turn_rate_is_the_library_s():
    for wanted, yaw, limit in cases("ex07.q2"):
        expected = turn_rate(torch.tensor(wanted), torch.tensor(yaw), limit)
        np.testing.assert_allclose(answer("ex07.q2", wanted, yaw, limit), expected, atol=1e-9)


def test_the_a1_s_numbers_are_the_library_s():
    model = a1_model.A1Config()
    assert (model.kp, model.kd, model.torque_limit) == (ex08_a1.KP, ex08_a1.KD, ex08_a1.LIMIT)
    assert ex08_a1.MIRROR == a1_model.MIRROR and tuple(ex08_a1.SIGNS) == a1_model.MIRROR_SIGNS
    assert A1EnvConfig().action_scale == ex08_a1.SCALE


def test_gravity_is_turned_as_mujoco_turns_it():
    for (quaternions,) in cases("ex08.q2"):
        for quaternion, ours in zip(quaternions, answer("ex08.q2", quaternions), strict=True):
            inverse, expected = np.zeros(4), np.zeros(3)
            mujoco.mju_negQuat(inverse, quaternion)
            mujoco.mju_rotVecQuat(expected, np.array([0.0, 0.0, -1.0]), inverse)
            np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_torques_rewards_and_mirror_by_hand():
    # Target 0.9 + 0.5 * 0.2 = 1.0: 35 * 0.1 - 0.5 * 2 = 2.5; far away, the limit.
    q, dq = np.array([0.9, -5.0]), np.array([2.0, 0.0])
    torque = answer("ex08.q1", q, dq, np.array([0.2, 0.0]), np.array([0.9, 0.9]))
    assert torque == pytest.approx([2.5, 33.5])
    joints = np.arange(12.0)[None]
    assert answer("ex08.q3", joints)[0].tolist() == [-3, 4, 5, -0.0, 1, 2, -9, 10, 11, -6, 7, 8]
    # 1 * 2 - 3 * 1 < 0 counts 0; 1 * 2 - 1 = 1 earns 0.02.
    terms, weights = np.array([[1.0, 3.0], [1.0, 1.0]]), np.array([2.0, -1.0])
    assert answer("ex08.q4", terms, weights, 0.02) == pytest.approx([0.0, 0.02])


def test_curriculum_advantages_and_rate_by_hand():
    rows = answer(
        "ex09.q1", np.array([0, 2, 3, 2]), np.array([0.1, 0.9, 0.9, 0.9]), np.arange(4) == 3, 3
    )
    assert rows.tolist() == [0, 3, 3, 1]
    # Backwards, gamma = lam = 0.5, done in the middle: d = (1 + 1 - 4, 1 - 2, 1 + 3 - 2) =
    # (-2, -1, 2); A = 2; -1; -2 + 0.25 * -1.
    values, done = np.array([4.0, 2.0, 2.0, 6.0]), np.array([False, True, False])
    advantage = answer("ex09.q2", np.ones(3), values, done, 0.5, 0.5)
    assert advantage == pytest.approx([-2.25, -1.0, 2.0])
    rates = [answer("ex09.q3", 1e-3, kl, 0.01) for kl in (0.021, 0.0049, 0.01)]
    assert rates == pytest.approx([1e-3 / 1.5, 1.5e-3, 1e-3])


def test_lengths_spl_and_table_one():
    assert answer("ex10.q1", np.array([[0, 0], [3, 4], [3, 5]])) == pytest.approx(6.0)
    for trials in cases("ex10.q2"):
        assert answer("ex10.q2", *trials) == pytest.approx(spl(*trials))
    reference = answer("ex10.q3")
    assert [round(reference / length, 2) for length in (26.75, 14.84, 9.73)] == pytest.approx(
        [0.19, 0.34, 0.51], abs=0.011
    )


def test_intervals_are_the_library_s():
    for successes, trials in cases("ex11.q1"):
        pairs = zip(successes.tolist(), trials.tolist(), strict=True)
        expected = np.array([wilson_interval(*pair) for pair in pairs])
        np.testing.assert_allclose(np.stack(answer("ex11.q1", successes, trials), -1), expected)
    needed = answer("ex11.q4")
    assert wilson_interval(needed, needed)[0] > 0.99 > wilson_interval(needed - 1, needed - 1)[0]


def test_success_table_and_metres_by_hand():
    # Terrain 0, policy 0: reached, no route -> 1/2; terrain 1, policy 1: a fall -> 0.
    table = answer("ex11.q2", np.array([0, 0, 1]), np.array([0, 0, 1]), np.array([0, 1, 2]), 2, 2)
    assert table == pytest.approx(np.array([[0.5, np.nan], [np.nan, 0.0]]), nan_ok=True)
    metres = answer("ex11.q3", np.array([0, 1, 2]), np.array([0, 2, 0]), 4, 0.5)
    assert metres == pytest.approx([1.0, 0.0, 0.5 * math.sqrt(2), 0.0])


def test_raster_and_noise_by_hand():
    points = np.array([[0.05, 0.15, -0.3], [0.01, 0.11, -0.1], [0.15, 0.05, -0.2]])
    raster = answer("ex12.q1", points, (2, 2), 0.1)
    assert raster == pytest.approx(np.array([[np.nan, -0.1], [-0.2, np.nan]]), nan_ok=True)
    # 3 cm fix, 2 cm per root second: after 4 s, sqrt(9 + 16) = 5 cm.
    assert answer("ex12.q2", np.array([4.0]), 0.03, 0.02) == pytest.approx([0.05])


def test_switching_is_priced_as_the_planner_does():
    for feasibility, switch_cost in cases("ex12.q3"):
        steps, policies = feasibility.shape
        tensors = np.zeros((policies, steps + 1, 1, len(YAWS)))
        tensors[:, :steps, 0, 0] = feasibility.T  # a corridor along +x
        graph = as_switching_networkx(tensors, switch_cost)
        costs = [
            networkx.dijkstra_path_length(graph, (0, 0, first), (steps, 0, last))
            for first, last in itertools.product(range(policies), repeat=2)
        ]
        assert answer("ex12.q3", feasibility, switch_cost) == pytest.approx(min(costs))
