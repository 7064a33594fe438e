"""Exercise 10, "Planning adapts": path length, SPL, and Table I (Sec. IV-A)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

LENGTHS, SPLS = np.array([26.75, 14.84, 9.73]), np.array([0.19, 0.34, 0.51])
"""Table I of the paper: path length, m, and SPL at epochs 1.5K, 5K, 20K; every trial succeeded."""


def _steps(xy: np.ndarray) -> np.ndarray:
    return np.hypot(*np.diff(xy, axis=0).T)


def _trials(rng: np.random.Generator) -> tuple:
    n = 12
    reference = rng.uniform(4, 8, n)
    length = reference * rng.uniform(0.9, 3, n)
    length[0] = 0.9 * reference[0]  # shorter than the reference: capped
    success = rng.uniform(size=n) < 0.7
    success[:3] = True, False, True
    return success, length, reference


QUESTIONS = (
    Question(
        id="ex10.q1",
        name="path_length",
        points=2,
        title="how far did it walk?",
        expects="a length in metres, never shorter than the straight line from first to last; "
        "along three sides of a square of 1 m it is 3 m.",
        draw=lambda rng: (np.cumsum(rng.normal(0.1, 0.2, (int(rng.integers(5, 20)), 2)), 0),),
        truth=lambda xy: _steps(xy).sum(),
        mistakes=(
            Mistake(
                "the straight line: that is how far it got, not how far it walked.",
                lambda xy: np.hypot(*(xy[-1] - xy[0])),
            ),
            Mistake(
                "squared steps: the distance is the square ROOT of dx^2 + dy^2, for each step.",
                lambda xy: (_steps(xy) ** 2).sum(),
            ),
            Mistake(
                "a mean over the steps: every step counts in full.", lambda xy: _steps(xy).mean()
            ),
            Mistake(
                "the distance along the axes: |dx| + |dy| walks around the corner of every step.",
                lambda xy: np.abs(np.diff(xy, axis=0)).sum(),
            ),
            Mistake(
                "one root for all: each step has a length of its own: the root comes before the "
                "sum.",
                lambda xy: np.sqrt((_steps(xy) ** 2).sum()),
            ),
        ),
        hints=("np.diff(xy, axis=0) are the steps.", "np.linalg.norm(..., axis=-1).sum()"),
    ),
    Question(
        id="ex10.q2",
        name="spl",
        points=2,
        title="success weighted by path length",
        expects="a mean over ALL trials, in which a failure counts 0, a success with a detour less "
        "than 1, and no trial more than 1.",
        draw=_trials,
        truth=lambda success, length, reference: np.mean(
            np.where(success, np.minimum(reference / length, 1.0), 0.0)
        ),
        mistakes=(
            Mistake(
                "failures that count: a trial that failed adds 0, however short its walk was.",
                lambda s, length, ref: np.mean(ref / np.maximum(length, ref)),
            ),
            Mistake(
                "a mean over successes alone: then one lucky trial in a hundred looks like a "
                "perfect planner.",
                lambda s, length, ref: np.mean((ref / np.maximum(length, ref))[s]),
            ),
            Mistake(
                "a quotient upside down: a detour must make the number smaller.",
                lambda s, length, ref: np.mean(s * np.maximum(length, ref) / ref),
            ),
            Mistake(
                "a forgotten max: a walk shorter than the reference must not count more than 1.",
                lambda s, length, ref: np.mean(s * ref / length),
            ),
            Mistake(
                "the success rate: every success counts 1, however long its walk was.",
                lambda s, length, ref: np.mean(s),
            ),
        ),
        hints=(
            "One number per trial first, then the mean over all of them.",
            "success * reference / np.maximum(length, reference)",
        ),
    ),
    Question(
        id="ex10.q3",
        name="reference_length",
        points=2,
        title="read Table I backwards",
        expects="the reference length, m, that the paper must have used for its SPL, if all trials "
        "succeeded: one number that fits all three columns within rounding (2 % is enough).",
        truth=lambda: float(np.mean(LENGTHS * SPLS)),
        mistakes=(
            Mistake(
                "the shortest path in the table: with a reference of 9.73 m the last column would "
                "have an SPL of 1, not 0.51.",
                lambda: 9.73,
            ),
            Mistake(
                "a length divided by its SPL: SPL = reference / length, so the reference is SPL "
                "TIMES length.",
                lambda: 9.73 / 0.51,
            ),
            Mistake(
                "the mean of the lengths: a reference is what a perfect planner would walk.",
                lambda: float(LENGTHS.mean()),
            ),
            Mistake(
                "the last length with every SPL: use each column's own length with its own SPL.",
                lambda: float((9.73 * SPLS).mean()),
            ),
        ),
        hints=(
            "Every trial succeeded, so SPL is about reference / length in each column.",
            "26.75 * 0.19, 14.84 * 0.34, 9.73 * 0.51: what do they have in common?",
        ),
        rtol=0.02,
    ),
)
