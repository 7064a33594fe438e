"""The right answers of the checks are right: by the library, by another library, or by hand."""

import itertools
import math

import mujoco
import networkx
import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.stats import binomtest

from fgtutor import patches
from fgtutor.course.checks import ex08_a1, find, nets
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


def test_patch_points_are_those_of_the_library():
    for offsets, pose in cases("ex01.q2"):
        turned = patches.rotate(torch.from_numpy(offsets), torch.tensor(pose[2]).double())
        np.testing.assert_allclose(answer("ex01.q2", offsets, pose), turned.numpy() + pose[:2])


def test_a_cut_patch_is_bilinear_between_the_centres():
    for heights, origin, resolution, pose, offsets, under in cases("ex01.q3"):
        centres = tuple(
            o + (np.arange(n) + 0.5) * resolution
            for o, n in zip(origin, heights.shape, strict=True)
        )
        bilinear = RegularGridInterpolator(centres, heights, bounds_error=False)
        expected = bilinear(answer("ex01.q2", offsets, pose))
        ours = answer("ex01.q3", heights, origin, resolution, pose, offsets, under)
        np.testing.assert_allclose(ours, expected - np.median(expected[under]))
        assert np.isnan(ours).any() and not np.isnan(ours[under]).any()


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


def test_joint_loss_is_the_library_s():
    (patch, command, r_v, noise, alpha, beta, weights) = cases("ex03.q2")[0]
    net = nets.build_net(patch.shape[1], command.shape[1], nets.HIDDEN, nets.LATENT).double()
    torch.nn.utils.vector_to_parameters(torch.tensor(weights), net.parameters())
    given = [torch.tensor(array) for array in (patch, command, r_v)]
    # Without noise the library's loss in evaluation mode, where the latent is the mean.
    expected, _ = net.eval().loss(*given, alpha=alpha, beta=beta)
    ours = answer("ex03.q2", net, *given, torch.zeros(noise.shape), alpha, beta)
    assert float(ours.detach()) == pytest.approx(float(expected.detach()))


def test_calibration_is_the_library_s():
    for predicted, measured, bins in cases("ex03.q3"):
        table, error = calibration(predicted, measured, bins)
        ours = answer("ex03.q3", predicted, measured, bins)
        np.testing.assert_allclose(ours[0], table)
        assert ours[1] == pytest.approx(error)


def test_rollout_labels_are_the_library_s():
    for r_v, failed, ended, window in cases("ex03.q4"):
        # The library's row t tells of the step that led to time t: one row more at the start.
        rows = np.stack((r_v, failed, ended), axis=-1)
        rows = torch.tensor(np.concatenate((np.zeros((1, *rows.shape[1:])), rows)))
        labels, trusted = feasibility_labels(rows, window)
        ours = answer("ex03.q4", r_v, failed, ended, window)
        np.testing.assert_allclose(ours[0], labels[:-1], rtol=1e-6)
        np.testing.assert_array_equal(ours[1], trusted[:-1])


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


def test_a_window_lies_ahead_of_its_cell_by_hand():
    # On a slope that rises by 1 per cell along x, the middle of three rows lies 1 higher along +x,
    # 1 lower along -x, and level along y.
    heights = np.arange(5.0)[:, None] * np.ones((1, 5))
    tensor = answer("ex05.q1", heights, 3, 3, lambda windows: windows[:, 4])
    assert tensor[2, 2].tolist() == [1.0, 0.0, -1.0, 0.0]
    # The windows of a corner leave the map.
    assert tensor[0, 0].tolist() == [0.0] * 4


def test_the_first_layer_is_that_of_torch():
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
    assert 5 <= reached < len(cases("ex06.q3"))


def test_the_cheapest_route_costs_what_dijkstra_says():
    for costs, start, goal in cases("ex06.q5"):
        cells = answer("ex06.q5", costs, start, goal)
        cost = answer("ex06.q3", costs, start, goal)
        assert math.isfinite(cost) == (len(cells) > 0)
        if len(cells):
            assert (*cells[0], *cells[-1]) == (*start, *goal)
            with np.errstate(divide="ignore"):
                assert answer("ex06.q4", 1 / costs, cells) == pytest.approx(cost)


def test_a_plan_with_switches_is_dijkstra_s():
    for tensors, f_min, switch_cost, start, goal in cases("ex06.q6"):
        graph = networkx.DiGraph()
        for policy, tensor in enumerate(tensors):
            moves = as_networkx(tensor, np.full(tensor.shape, policy), f_min=f_min)
            for cell, onward, edge in moves.edges(data=True):
                graph.add_edge((*cell, policy), (*onward, policy), weight=edge["weight"])
        pairs = list(itertools.permutations(range(len(tensors)), 2))
        for cell in np.ndindex(tensors.shape[1:3]):
            for old, new in pairs:
                graph.add_edge((*cell, old), (*cell, new), weight=switch_cost)
        expected = math.inf
        for first, last in itertools.product(range(len(tensors)), repeat=2):
            lengths = networkx.single_source_dijkstra_path_length(graph, (*start, first))
            expected = min(expected, lengths.get((*goal, last), math.inf))
        assert answer("ex06.q6", tensors, f_min, switch_cost, start, goal) == pytest.approx(
            expected
        )


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


def test_torques_and_mirror_by_hand():
    # Target 0.9 + 0.5 * 0.2 = 1.0: 35 * 0.1 - 0.5 * 2 = 2.5; far away, the limit.
    q, dq = np.array([0.9, -5.0]), np.array([2.0, 0.0])
    torque = answer("ex08.q1", q, dq, np.array([0.2, 0.0]), np.array([0.9, 0.9]))
    assert torque == pytest.approx([2.5, 33.5])
    joints = np.arange(12.0)[None]
    assert answer("ex08.q3", joints)[0].tolist() == [-3, 4, 5, -0.0, 1, 2, -9, 10, 11, -6, 7, 8]


def test_a_joint_swings_as_by_hand():
    # kp = 1, inertia 1, dt = 0.5, no damping: dq = 0.5, q = 0.25; dq = 0.875, q = 0.6875.
    angles, over, settled = answer("ex08.q4", 1.0, 1.0, 1.0, 0.0, 9.0, 0.5, 2)
    assert angles == pytest.approx([0.25, 0.6875])
    assert over == 0.0 and math.isnan(settled)


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


def test_batch_advantages_of_one_robot_are_generalised_advantages():
    for rewards, values, next_values, fell, timed_out, gamma, lam in cases("ex09.q4"):
        ours = answer("ex09.q4", rewards, values, next_values, fell, timed_out, gamma, lam)
        assert (ours.mean(), ours.std()) == pytest.approx((0.0, 1.0))
        # Equal worth from one step to the next, and no time-out: the case of ex09.q2.
        chained = np.concatenate((values[1:], next_values[-1:]))
        ours = answer("ex09.q4", rewards, values, chained, fell, fell & False, gamma, lam)
        single = [
            answer("ex09.q2", r, np.append(v, n), f, gamma, lam)
            for r, v, n, f in zip(rewards.T, values.T, next_values[-1], fell.T, strict=True)
        ]
        expected = np.stack(single, axis=-1)
        np.testing.assert_allclose(ours, (expected - expected.mean()) / expected.std())


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


def test_success_table_and_paired_test_by_hand():
    # Terrain 0, policy 0: reached, no route -> 1/2; terrain 1, policy 1: a fall -> 0.
    table = answer("ex11.q2", np.array([0, 0, 1]), np.array([0, 0, 1]), np.array([0, 1, 2]), 2, 2)
    assert table == pytest.approx(np.array([[0.5, np.nan], [np.nan, 0.0]]), nan_ok=True)
    for first, second in cases("ex11.q3"):
        wins, losses, p = answer("ex11.q3", first, second)
        if wins + losses:
            assert p == pytest.approx(binomtest(wins, wins + losses).pvalue)
    # Walks of 2 m and 3 m, the second one too long for its reference of 1.5 m: SPL (1 + 0.5) / 2.
    xy = np.array([[[0, 0], [2, 0], [np.nan] * 2], [[0, 0], [0, 2], [0, 3]]], dtype=float)
    table = answer("ex11.q5", np.zeros(2, int), np.ones(2, bool), xy, np.array([2.0, 1.5]), 2)
    expected = np.array([[2.5, 1.0, 0.75], [np.nan] * 3])
    np.testing.assert_allclose(table, expected)


def test_raster_and_noise_by_hand():
    # Two points of one cell 20 cm apart support no height, and one beside the map has none.
    points = [[0.05, 0.15, -0.3], [0.01, 0.11, -0.1], [0.15, 0.05, -0.2], [0.16, 0.07, -0.22]]
    points = np.array([*points, [0.05, 0.16, -0.12], [0.25, 0.05, 1.0]])
    raster = answer("ex12.q1", points, (2, 2), 0.1, 2)
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
