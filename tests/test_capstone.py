"""The capstone: nets and routes are judged by what they do, on ground drawn from a seed."""

from functools import cache

import networkx
import numpy as np
import pytest
import torch

from fgtutor.course.checks import capstone, find, questions_of, unseen_maps
from fgtutor.course.checks.question import PASSED, WRONG, Judge
from fgtutor.course.grading.replies import reply_of
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import OodScore
from fgtutor.fusion import fuse
from fgtutor.planning import PAPER, plan


@cache
def judge_of(question):
    """One for all tests: it trains each typical mistake once."""
    asked = find(question)
    return Judge(asked, asked.cases(0, 1))


def judged(question, target):
    judge = judge_of(question)
    return judge.judge(reply_of(target, judge.cases, 60.0, harness=judge.question.harness))


@pytest.fixture(scope="module")
def trained():
    """A case of the training, and what a good net answers to it."""
    case = find("ex13.q1").cases(0, 1)[0]
    return case, capstone.training_answers(capstone.train_net, *case)


@pytest.fixture(scope="module")
def unseen():
    """A map, and the answer of a good planner."""
    case = find("ex13.q3").cases(0, 1)[0]
    return case, unseen_maps.map_answers(unseen_maps.face_map, *case)


def faults(answer, case, **changed):
    names = ("updates", "f", "familiar", "strange", "apart")
    parts = dict(zip(names, answer, strict=True)) | changed
    return set(capstone.training_faults(tuple(parts.values()), *case))


# A net of one's own -------------------------------------------------------------------------------


def test_a_submission_is_not_given_the_held_out_labels(trained):
    case, _ = trained
    held = capstone._drives(case[-1])[1][2]
    for given in case[:-2]:
        assert given.shape != held.shape or not np.allclose(given, held)


def test_learned_and_held_out_ground_differ(trained):
    (patch, _, _, held_patch, _, foreign, _, _), _ = trained
    rough = [p[np.ptp(p, axis=-1) > capstone.RELIEF].round(4) for p in (patch, held_patch, foreign)]
    seen = {row.tobytes() for row in rough[0]}
    assert len(rough[2]) == capstone.FOREIGN
    for other in rough[1:]:
        assert sum(row.tobytes() in seen for row in other) < len(other) / 20


def test_a_good_net_has_no_fault(trained):
    case, answer = trained
    assert faults(answer, case) == set()


@pytest.mark.parametrize(
    ("changed", "kinds"),
    [
        ({"updates": capstone.BUDGET + 1}, {"budget"}),
        ({"apart": 0.01}, {"repeat"}),
        ({"strange": np.zeros(capstone.FOREIGN)}, {"blind"}),
        ({"f": np.zeros(capstone.HELD)}, {"calibration", "useless"}),
        ({"f": np.full(capstone.HELD, np.nan)}, {"finite"}),
        ({"f": np.full(capstone.HELD, 7.0)}, {"range", "useless", "calibration"}),
        ({"f": np.zeros(3)}, {"form"}),
    ],
)
def test_each_demand_is_missed_on_its_own(trained, changed, kinds):
    case, answer = trained
    assert faults(answer, case, **changed) == kinds


def test_every_update_counts_whoever_makes_it(trained):
    case, _ = trained

    def by_hand(patch, command, label, budget, seed):
        net = capstone.train_net(patch, command, label, 0, seed)
        for _ in range(2 * budget):  # no optimizer
            loss = net.feasibility(patch[:8], command[:8]).mean()
            torch.autograd.backward(loss)
        return net

    updates, *_ = capstone.training_answers(by_hand, *case[:-2], 4, 0)
    assert updates == 8
    assert torch.autograd.backward.__module__ == "torch.autograd"


def test_a_net_that_answers_in_another_form_is_wrong_and_no_crash_of_ours():
    class Talker:
        def feasibility(self, patch, command):
            return torch.zeros(3)

        reconstruction = feasibility_of = lambda self, patch: torch.zeros(3)

    verdict = judged("ex13.q1", lambda *given: Talker())
    assert verdict.outcome == WRONG and "one number for each patch" in verdict.detail


@pytest.mark.parametrize("answers", [[None], ["text"], [[1, 2]], [{"list": [1.0]}]])
def test_forged_answers_are_wrong(answers):
    assert judge_of("ex13.q1").judge({"answers": answers}).points == 0


# Into the zoo -------------------------------------------------------------------------------------


def test_joining_is_fusing_with_one_more():
    for tensors, f, loss, own, alpha, known in find("ex13.q2").cases(5):
        joined, gain = capstone.join_zoo(tensors, f, loss, own, alpha, known)
        np.testing.assert_array_equal(joined[:-1], tensors)
        before, after = (np.asarray(fuse(list(part))[0]) for part in (tensors, joined))
        np.testing.assert_allclose(gain, after - before)
        assert (joined[-1] <= f).all() and (gain > 0).any()
        assert not joined[-1][~known].any() and not joined[-1][-1, :, 0].any()


def test_the_newcomer_s_weight_is_the_library_s_conformal_one():
    (_, f, loss, own, alpha, known) = find("ex13.q2").cases(5)[0]
    levels = 1 - np.arange(1, len(own)) / len(own)
    exact = dict(zip(map(str, levels), np.sort(own)[:0:-1].tolist(), strict=True))
    one = OodScore(None, (exact, exact), alpha=min(2 * alpha, 0.99))  # of two equal p-values
    ours = one.weight(torch.tensor(loss), torch.tensor(loss)).numpy()
    weights = capstone.join_zoo(np.zeros((1, *f.shape)), f, loss, own, alpha, known)[0][-1] / f
    inside = (loss < own.max()) & (weights > 0)
    np.testing.assert_allclose(weights[inside], ours[inside], atol=0.1)


# Unseen maps --------------------------------------------------------------------------------------


def test_no_mixed_map_is_crossed_before_the_newcomer_joins(unseen):
    (others, *_), (before, _, after, policies) = unseen
    assert len(before) == 0 and len(after) == len(policies) + 1
    assert set(policies.tolist()) == set(range(len(others) + 1))


def test_the_right_route_costs_what_the_library_s_does(unseen):
    (others, newcomer, f_min, start, goal), _ = unseen
    tensors = [*others, newcomer]
    fused, policy_map = fuse(tensors)
    grid = ElevationMap(np.zeros(newcomer.shape[:2]))
    ends = [tuple((np.array(cell) + 0.5) * grid.resolution) for cell in (start, goal)]
    route = plan(
        fused, policy_map, grid=grid, start=ends[0], goal=ends[1], settings=PAPER, f_min=f_min
    )
    costs = unseen_maps._costs(np.asarray(fused), f_min)
    ours, _ = unseen_maps._cheapest(costs, start, goal)
    assert ours == pytest.approx(route.raise_for().cost, rel=1e-5)


def test_a_route_may_be_any_that_is_cheap_enough(unseen):
    case, answer = unseen
    assert unseen_maps.map_faults(answer, *case) == {}
    cells, policies = answer[2:]
    there_and_back = [0, 1, 0, *range(1, len(cells))]
    longer = cells[there_and_back], np.concatenate((policies[:1], policies[:1], policies))
    kinds = {
        kind.partition(",")[0] for kind in unseen_maps.map_faults((*answer[:2], *longer), *case)
    }
    assert kinds <= {"dear", "closed"}
    jump = np.delete(cells, 5, axis=0), policies[:-1]
    assert set(unseen_maps.map_faults((*answer[:2], *jump), *case)) == {"steps, With the newcomer"}
    refused = unseen_maps.map_faults((*answer[:2], cells[:0], policies[:0]), *case)
    assert set(refused) == {"refused, With the newcomer"}


def test_scipy_s_route_is_networkx_s():
    rng = np.random.default_rng(0)
    costs = 1 / rng.uniform(0.1, 1, (6, 5, 8))
    costs[rng.uniform(size=costs.shape) < 0.2] = np.inf
    graph = networkx.DiGraph()
    for ix, iy, k in np.ndindex(costs.shape):
        there = ix + int(capstone.STEPS[k][0]), iy + int(capstone.STEPS[k][1])
        if np.isfinite(costs[ix, iy, k]) and 0 <= there[0] < 6 and 0 <= there[1] < 5:
            graph.add_edge((ix, iy), there, weight=costs[ix, iy, k])
    for goal in ((5, 4), (0, 4), (3, 0)):
        cost, cells = unseen_maps._cheapest(costs, (0, 0), goal)
        expected = networkx.dijkstra_path_length(graph, (0, 0), goal)
        assert cost == pytest.approx(expected)
        assert networkx.path_weight(graph, [*map(tuple, cells.tolist())], "weight") == (
            pytest.approx(expected)
        )


# The report ---------------------------------------------------------------------------------------


def test_a_report_by_hand():
    ours = np.array([True] * 9 + [False])
    other = np.array([False] * 9 + [True])  # 9 to 1: p = 2 (1 + 10) / 1024
    table, p, says = find("ex13.q4").truth(ours, np.stack((other, ours)))
    assert p.tolist() == pytest.approx([2 * 2 * 11 / 1024, 1.0])
    assert says.tolist() == [1, 0]
    # Wilson, 9 of 10: 0.596 to 0.982 (Wilson 1927, as quoted in any table).
    assert table[0].tolist() == pytest.approx([0.9, 0.596, 0.982], abs=1e-3)


def test_the_correction_decides_in_every_case():
    asked = find("ex13.q4")
    for seed in range(12):
        for ours, others in asked.cases(seed, 2):
            _, p, says = asked.truth(ours, others)
            assert {-1, 0, 1} == set(says.tolist())
            assert ((p > 0.05) & (p / len(p) < 0.05)).any() and (p == 1.0).any()


def test_the_judgement_follows_from_its_formula_and_has_that_power():
    n = find("ex13.q5").truth()
    rng = np.random.default_rng(0)
    first, second = rng.binomial(n, 0.95, 20_000) / n, rng.binomial(n, 0.9, 20_000) / n
    scatter = np.sqrt((first * (1 - first) + second * (1 - second)) / n)
    assert np.mean(np.abs(first - second) > 1.96 * scatter) == pytest.approx(0.8, abs=0.02)


# The whole ----------------------------------------------------------------------------------------


def test_the_exercise_states_the_demands_that_are_made(request):
    text = (request.config.rootpath / "solutions/src/ex13.py").read_text(encoding="utf-8")
    for demand in (
        f"(5 parts) at most {capstone.CALIBRATED} ",
        f"at most {capstone.EXPLAINED} times the variance",
        f"at least {capstone.TOLD_APART} ",
        f"{sum(question.points for question in questions_of('ex13'))} points",
    ):
        assert demand in text


@pytest.mark.parametrize("question", ["ex13.q1", "ex13.q3"])
def test_no_more_cases_are_drawn_than_make_sense(question):
    asked = find(question)
    assert len(asked.cases(0, 10)) == asked.most


@pytest.mark.parametrize("question", ["ex13.q1", "ex13.q3"])
def test_a_fault_is_told_with_its_number(question):
    asked = find(question)
    verdict = judged(question, asked.mistakes[0].answer)
    assert verdict.outcome == WRONG
    assert f"Looks like {asked.mistakes[0].says}" in verdict.detail
    assert any(character.isdigit() for character in verdict.detail.splitlines()[-1])
    assert judged(question, asked.truth).outcome == PASSED
