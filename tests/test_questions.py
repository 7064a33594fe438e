"""Every requirement that a question states is tried by its cases, whatever the seed.

A typical mistake violates one requirement; `VIOLATIONS` holds wrong answers for the others. Each
must fail under every seed of an instructor, and each right answer must pass.
"""

import ast
import json
import math

import numpy as np
import pytest

from fgtutor.course.checks import EXERCISES, SOLUTIONS, find, questions_of
from fgtutor.course.checks.question import PASSED, WRONG, Judge
from fgtutor.course.grading.answers import difference
from fgtutor.course.grading.replies import reply_of
from fgtutor.course.grading.worker import made

QUESTIONS = [question for exercise in EXERCISES for question in questions_of(exercise)]
FUNCTIONS = [question for question in QUESTIONS if question.draw]
SEEDS = range(12)
LONG = 10
"""Lines of a solution beyond which a question is more than a formula."""


def right(question):
    return find(question).truth


def without_infinity(costs, start, goal):
    cost = right("ex06.q3")(costs, start, goal)
    return cost if math.isfinite(cost) else -1.0


def beyond_the_end(route, position, distance):
    """Raise IndexError where the route ends before."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    nearest = np.hypot(*(route - position).T).argmin()
    return route[np.flatnonzero(along >= along[nearest] + distance)[0]]


def one_turn(wanted, yaw, limit):
    """Wrap the error once, as if both yaws lay within half a turn."""
    error = wanted - yaw
    error = np.where(error > np.pi, error - 2 * np.pi, error)
    return np.clip(3 * np.where(error < -np.pi, error + 2 * np.pi, error), -limit, limit)


def changed_in_place(r_v, fell, window):
    r_v[fell] = 0.0
    return np.array([r_v[t : t + window].mean() for t in range(len(r_v))])


def whole_windows(r_v, fell, window):
    """Leave out the labels at the end of the rollout, where the window is shorter."""
    labels = np.array(right("ex02.q2")(r_v, fell, window))
    labels[len(r_v) - window + 1 :] = 0.0
    return labels


def up_to_the_quantile(losses, own, alpha):
    """Compare with the own loss at the index of a quantile, in place of a share."""
    return np.clip((np.quantile(own, 1 - alpha) / losses), 0, 1)


VIOLATIONS = {
    "ex01.q1": [
        lambda xy, origin, r: np.floor((xy - origin) / r),  # not integers
        lambda xy, origin, r: np.maximum(np.floor((xy - origin) / r).astype(int), 0),
        lambda xy, origin, r: np.floor((xy - origin[0]) / r).astype(int),
    ],
    "ex01.q4": [
        lambda h, k: right("ex01.q4")(h, k) * (np.arange(len(h)) < len(h) - 1)[:, None],
    ],
    "ex02.q1": [lambda v, c: np.exp(-np.hypot(*(v - c).T) / 0.2)],
    "ex02.q2": [changed_in_place, whole_windows],
    "ex03.q3": [lambda p, m, bins: (right("ex03.q3")(p, m, bins)[0], 0.0)],
    "ex04.q2": [
        lambda loss, low, high: np.minimum(1 - (loss - low) / (high - low), 1),  # below 0
        lambda loss, low, high: np.where(loss >= high, 1.0, right("ex04.q2")(loss, low, high)),
    ],
    "ex04.q3": [up_to_the_quantile],
    "ex06.q1": [
        lambda t: (t.max(axis=0), np.where(t[1] == t.max(axis=0), 1, t.argmax(axis=0))),
    ],
    "ex06.q2": [lambda f, m: 1 / np.maximum(f, m)],
    "ex06.q3": [without_infinity, lambda c, s, g: right("ex06.q3")(c, s, g) + (s == g)],
    "ex07.q1": [beyond_the_end],
    "ex07.q2": [one_turn, lambda w, y, limit: np.maximum(right("ex07.q2")(w, y, limit), -1.4)],
    "ex07.q3": [lambda wanted, hold: right("ex07.q3")(wanted, 2)],
    "ex08.q1": [
        lambda q, dq, a, s: np.minimum(35 * (s + 0.5 * a - q) - 0.5 * dq, 33.5),
        lambda q, dq, a, s: np.maximum(35 * (s + 0.5 * a - q) - 0.5 * dq, -33.5),
    ],
    "ex09.q1": [
        lambda row, m, f, last: np.maximum(row + ((m > 0.5) & ~f) - ((m < 0.3) | f), 0),
        lambda row, m, f, last: np.minimum(row + ((m > 0.5) & ~f) - ((m < 0.3) | f), last),
        lambda row, m, f, last: np.clip(row + ((m > 0.5) & ~f) - (m < 0.3), 0, last),
    ],
    "ex09.q3": [
        lambda rate, kl, desired: min(right("ex09.q3")(rate, kl, desired), 5e-3),
        lambda rate, kl, desired: max(right("ex09.q3")(rate, kl, desired), 2e-5),
    ],
    "ex10.q2": [lambda s, p, ref: np.mean(s * np.minimum(ref / p, 1.05))],
    "ex11.q1": [lambda s, n: (right("ex11.q1")(s, n)[0], s / n)],
    "ex11.q3": [lambda a, b: (*right("ex11.q3")(a, b)[:2], 0.05)],
}


def verdict_of(question, judge, cases, target):
    options = {"harness": question.harness} if question.harness else {}
    with np.errstate(all="ignore"):
        return judge.judge(reply_of(target, cases, 60.0, **options))


@pytest.mark.slow
@pytest.mark.parametrize("question", FUNCTIONS, ids=lambda question: question.id)
def test_every_seed_tries_every_requirement(question):
    # A net takes a while, a training longer: each of their cases tries all that is asked.
    number = 1 if question.seconds else 3 if question.harness else 10
    for seed in SEEDS:
        cases = question.cases(seed, number)
        judge = Judge(question, cases)
        assert verdict_of(question, judge, cases, question.truth).outcome == PASSED
        for mistake in question.mistakes:
            outcome = verdict_of(question, judge, cases, mistake.answer).outcome
            assert outcome == WRONG, (seed, mistake.says)
        for number_of, wrong in enumerate(VIOLATIONS.get(question.id, ())):
            outcome = verdict_of(question, judge, cases, wrong).outcome
            assert outcome != PASSED, (seed, number_of)


@pytest.mark.parametrize(
    "question", [q for q in FUNCTIONS if q.harness], ids=lambda question: question.id
)
def test_a_harness_needs_nothing_but_its_source(question):
    (case,) = question.cases(0, 1)
    alone = made(question.harness_source)
    assert (
        difference(question.answers(question.truth, [case])[0], alone(question.truth, *case)) == ""
    )


def test_violations_belong_to_questions():
    assert set(VIOLATIONS) <= {question.id for question in FUNCTIONS}


def test_an_expectation_does_not_give_the_answer_away():
    judgements = [question for question in QUESTIONS if not question.draw]
    assert len(judgements) >= 5
    for question in judgements:
        assert f"{question.truth():g}" not in question.expects


def test_a_third_of_the_questions_asks_for_more_than_ten_lines(request):
    lengths = {}
    for exercise in EXERCISES:
        master = request.config.rootpath / "solutions" / "src" / f"{exercise}.py"
        regions = master.read_text(encoding="utf-8").split("# BEGIN SOLUTION\n")[1:]
        for question, region in zip(questions_of(exercise), regions, strict=True):
            lines = region.partition("# END SOLUTION")[0].splitlines()
            code = [line for line in lines if line.strip() and line.strip()[0] != "#"]
            lengths[question.id] = len(code)
    long = [question for question, lines in lengths.items() if lines > LONG]
    assert 3 * len(long) >= len(QUESTIONS), lengths


def test_judgements_are_argued_in_their_solutions():
    worked = json.loads(SOLUTIONS.read_text(encoding="utf-8"))
    for question in QUESTIONS:
        if not question.draw:
            reasons = [line for line in worked[question.id].splitlines() if line.startswith("#")]
            assert len(reasons) >= 3, question.id
            assert ast.parse(worked[question.id])
