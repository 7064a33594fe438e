"""Exercise 13, the capstone: a net of one's own, in the zoo, on unseen maps, with intervals."""

import math

import numpy as np

from fgtutor.course.checks.capstone import (
    CALIBRATED,
    EXPLAINED,
    TOLD_APART,
    flawed_net,
    flawed_zoo,
    join_zoo,
    train_net,
    training_answers,
    training_case,
    training_faults,
    zoo_case,
)
from fgtutor.course.checks.question import Mistake, Question
from fgtutor.course.checks.unseen_maps import (
    face_map,
    flawed_route,
    map_answers,
    map_case,
    map_faults,
)

# The report ---------------------------------------------------------------------------------------

_WINS = ((9, 1), (16, 2), (2, 17), (5, 5), (0, 0))
"""Trials that only ours won, and only the other one: hardly, clearly, worse, alike, the same."""


def _trials(rng: np.random.Generator) -> tuple:
    """Draw our outcomes and those of four others over the same maps, in any order."""
    won, lost = (int(rng.integers(20, 40)) for _ in range(2))
    ours = np.repeat((True, False), (won, lost))
    others = np.tile(ours, (len(_WINS), 1))
    for row, (only_ours, only_theirs) in zip(others, _WINS, strict=True):
        row[:only_ours] = False
        row[won : won + only_theirs] = True
    maps = rng.permutation(len(ours))
    return ours[maps], others[rng.permutation(len(_WINS))][:, maps]


def _report(
    ours: np.ndarray,
    others: np.ndarray,
    *,
    method: str = "wilson",
    sided: str = "two-sided",
    tests: float | None = None,
    capped: bool = True,
    draws: bool = False,
) -> tuple:
    """Ask scipy for intervals and tests; the options make it wrong."""
    from scipy.stats import binomtest, norm

    table, p, says = [], [], []
    for outcomes in (ours, *others):
        rate, n = outcomes.mean(), len(outcomes)
        if method == "wald":
            half = norm.ppf(0.975) * math.sqrt(rate * (1 - rate) / n)
            table.append((rate, rate - half, rate + half))
        else:
            told = binomtest(int(outcomes.sum()), n).proportion_ci(method="wilson")
            table.append((rate, told.low, told.high))
    for other in others:
        better, worse = int((ours & ~other).sum()), int((other & ~ours).sum())
        n, more = better + worse, max(better, worse)
        if draws:
            equal = len(ours) - n
            n, more = n + 2 * (equal // 2), more + equal // 2
        one = binomtest(more, n, alternative="greater").pvalue if n else 1.0
        raw = one if sided == "one-sided" else min(2 * one, 1.0)
        corrected = raw * (len(others) if tests is None else tests)
        p.append(min(corrected, 1.0) if capped else corrected)
        says.append(int(np.sign(better - worse)) * (p[-1] < 0.05))
    return np.array(table), np.array(p), np.array(says)


def _overlapping(ours: np.ndarray, others: np.ndarray) -> tuple:
    """Conclude from whether two intervals overlap."""
    table, p, _ = _report(ours, others)
    above = table[0, 1] > table[1:, 2]
    below = table[0, 2] < table[1:, 1]
    return table, p, above.astype(int) - below


def _any_difference(ours: np.ndarray, others: np.ndarray) -> tuple:
    """Conclude from the rates alone."""
    table, p, _ = _report(ours, others)
    return table, p, np.sign(table[0, 0] - table[1:, 0]).astype(int)


QUESTIONS = (
    Question(
        id="ex13.q1",
        name="train_net",
        points=10,
        title="a net of your own, within a budget",
        expects="a net whose calibration error on held-out ground is at most "
        f"{CALIBRATED}, whose squared error there is at most {EXPLAINED} times the labels' "
        f"variance, whose L_recon tells foreign ground with an AUROC of at least {TOLD_APART}, "
        "after at most `budget` calls of backward(); f lies in [0, 1], and the same seed gives the "
        "same net.",
        draw=training_case,
        harness=training_answers,
        faults=training_faults,
        most=1,
        seconds=60.0,
        truth=train_net,
        mistakes=(
            Mistake(
                "a net that was not trained: call backward() on the loss and step() on the "
                "optimizer, `budget` times.",
                flawed_net("untrained"),
            ),
            Mistake(
                "an autoencoder that does not learn: its loss is part of the joint loss, and its "
                "weights of what the optimizer was given.",
                flawed_net("blind"),
            ),
            Mistake(
                "one update too many: `budget` is what you may spend, and what others can compare "
                "with.",
                flawed_net("over budget"),
            ),
            Mistake(
                "a seed that is not used: torch.manual_seed(seed) comes before the net is built "
                "and before batches are drawn.",
                flawed_net("unseeded"),
            ),
            Mistake(
                "a head that says the mean of all labels: calibrated, and useless; aim at each "
                "sample's own label.",
                flawed_net("mean"),
            ),
            Mistake(
                "a score in place of a feasibility: the sigmoid is missing, so f leaves [0, 1].",
                flawed_net("score"),
            ),
        ),
        hints=(
            "Your FeasibilityNet and joint_loss of exercise 03 are in mine.py. Copy them into this "
            "notebook, with their imports: a submission stands alone.",
            "Adam with lr=3e-3, batches of 128 drawn by torch.randint, 64 hidden numbers, a latent "
            "of 8, alpha=1 and beta=1e-3 are enough for 300 updates.",
            "torch.manual_seed(seed) first; then net, optimizer, and a loop over range(budget): "
            "draw rows, loss, zero_grad, backward, step.",
        ),
    ),
    Question(
        id="ex13.q2",
        name="join_zoo",
        points=5,
        title="into the zoo, and nobody else changes",
        expects="the old tensors as they were, then the newcomer's F = w_ood f, which is 0 for "
        "steps out of or into an unknown cell or off the map; and the gain, by how much its F "
        "exceeds the best of the others, 0 where it does not.",
        draw=zoo_case,
        truth=lambda tensors, f, loss, own, alpha, known: join_zoo(
            tensors, f, loss, own, alpha, known
        ),
        mistakes=(
            Mistake(
                "a newcomer that is believed everywhere: F is w_ood times f.",
                flawed_zoo("unweighted"),
            ),
            Mistake(
                "a share in place of a weight: w_ood is the share divided by alpha, at most 1.",
                flawed_zoo("uncalibrated"),
            ),
            Mistake("steps off the map: they are closed, F = 0.", flawed_zoo("edge")),
            Mistake("steps into the unknown: they are closed, F = 0.", flawed_zoo("unknown")),
            Mistake(
                "a newcomer that comes first: the others keep their numbers, so it is the last.",
                flawed_zoo("first"),
            ),
            Mistake(
                "others that change: the tensors of the zoo stay as they were, number for number.",
                flawed_zoo("shared"),
            ),
            Mistake(
                "a negative gain: where the newcomer is worse, fusing takes the others: gain 0.",
                flawed_zoo("signed"),
            ),
        ),
        hints=(
            "Weight first: the share of `own` that is at least as large as each loss, divided by "
            "alpha, limited to 1. own >= loss[..., None] compares all at once.",
            "For heading k, the cell that is entered is (ix + STEPS[k][0], iy + STEPS[k][1]). Pad "
            "`known` with False by one cell, and off the map is unknown too.",
            "np.concatenate((tensors, joined[None])), and np.maximum(joined - tensors.max(axis=0), "
            "0)",
        ),
    ),
    Question(
        id="ex13.q3",
        name="face_map",
        points=7,
        title="maps that nobody has seen",
        expects="a chain of neighbouring cells from start to goal and a policy for each step, "
        "whose F is at least f_min at every step; the costs 1 / F sum up to at most 1 % more than "
        "the cheapest; two empty arrays where there is no such chain.",
        draw=map_case,
        harness=map_answers,
        faults=map_faults,
        most=2,
        seconds=30.0,
        truth=face_map,
        mistakes=(
            Mistake(
                "no refusal: where F < f_min there is no edge, however much the robot wants to "
                "cross.",
                flawed_route("reckless"),
            ),
            Mistake(
                "one policy for the whole route: no single specialist crosses a mixed map; take "
                "the best one at every step.",
                flawed_route("one"),
            ),
            Mistake(
                "a policy that is not the best: the map of policies is the argmax of the tensors "
                "that are fused.",
                flawed_route("worst"),
            ),
            Mistake(
                "the fewest steps: the sum of 1 / F is to be small, and a step on easy ground is "
                "cheaper.",
                flawed_route("steps"),
            ),
            Mistake(
                "a route from goal to start: predecessors are followed backwards, so turn both "
                "lists around.",
                flawed_route("backwards"),
            ),
            Mistake(
                "a policy for each cell: a route of n cells has n - 1 steps.",
                flawed_route("cells"),
            ),
        ),
        hints=(
            "fuse, edge_costs and cheapest_route of exercise 06 do nearly all of it. Copy them "
            "from mine.py into this notebook: a submission stands alone.",
            "The heading of a step is the row of STEPS that equals the difference of its two "
            "cells; the policy is policy_map[ix, iy, k] of the cell that is left.",
            "No route: return np.zeros((0, 2), dtype=int), np.zeros(0, dtype=int).",
        ),
    ),
    Question(
        id="ex13.q4",
        name="report",
        points=5,
        title="a report that can be trusted",
        expects="for ours and each of the others the success rate and its 95 % Wilson interval; "
        "for each of the others p of the paired test, times the number of tests and at most 1; and "
        "the conclusion: 1 where ours is better and -1 where it is worse with p < 0.05, else 0.",
        draw=_trials,
        truth=lambda ours, others: _report(ours, others),
        mistakes=(
            Mistake(
                "p of a single test: of five planners that are all alike, one has p below 0.05 in "
                "more than one study of five; multiply p by the number of tests.",
                lambda ours, others: _report(ours, others, tests=1),
            ),
            Mistake(
                "a textbook interval: Wilson's is asked for.",
                lambda ours, others: _report(ours, others, method="wald"),
            ),
            Mistake(
                "one side of the test: before the trials, either might have been the better one.",
                lambda ours, others: _report(ours, others, sided="one-sided"),
            ),
            Mistake(
                "draws counted: a map that both cross, or none, says nothing about which is "
                "better.",
                lambda ours, others: _report(ours, others, draws=True),
            ),
            Mistake(
                "intervals that overlap: they do not settle a comparison over the same maps; the "
                "paired test does.",
                _overlapping,
            ),
            Mistake(
                "a conclusion from the rates alone: a difference that chance can make is none yet.",
                _any_difference,
            ),
            Mistake(
                "a turned conclusion: 1 says that OURS is better.",
                lambda ours, others: (*_report(ours, others)[:2], -_report(ours, others)[2]),
            ),
            Mistake(
                "a probability above 1: multiply by the number of tests, then limit to 1.",
                lambda ours, others: _report(ours, others, capped=False),
            ),
        ),
        hints=(
            "wilson_interval and paired_test of exercise 11 do the arithmetic.",
            "One paired test for each row of `others`; p = min(len(others) * p, 1).",
            "np.sign(only ours - only theirs) is the direction; it counts only where p < 0.05.",
        ),
        rtol=1e-3,
    ),
    Question(
        id="ex13.q5",
        name="maps_needed",
        points=3,
        title="how many maps tell 95 % from 90 %?",
        expects="the smallest whole number of maps for each planner with which the difference is "
        "found in four of five studies, by the formula of the question.",
        truth=lambda: 432,
        mistakes=(
            Mistake(
                "a study that fails every other time: without z of the power, half of all studies "
                "miss the difference.",
                lambda: 212,
            ),
            Mistake(
                "a one-sided test: 1.645 belongs to one side; the test asked for has two.",
                lambda: 341,
            ),
            Mistake(
                "maps of both planners together: the number for each of them is asked for.",
                lambda: 864,
            ),
            Mistake(
                "one planner's scatter: the variances of both add up.",
                lambda: 283,
            ),
            Mistake("rounded down: 431 maps are not quite enough.", lambda: 431),
        ),
        hints=(
            "p (1 - p) is 0.09 for the one planner and 0.0475 for the other.",
            "(1.96 + 0.8416)^2 * (0.09 + 0.0475) / 0.05^2, rounded up.",
        ),
        rtol=1e-6,
    ),
)
