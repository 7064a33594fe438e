"""Exercise 09, "Train a specialist": curriculum, advantages, the step size that follows the KL."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

UP, DOWN = 0.5, 0.3


def _robots(rng: np.random.Generator) -> tuple:
    last = int(rng.integers(4, 8))
    row = rng.integers(0, last + 1, 10)
    mean = rng.uniform(0, 1, 10)
    failed = rng.uniform(size=10) < 0.4
    # The cases that decide: top, bottom, middle band, a good robot that fell.
    row[:4], mean[:4], failed[:4] = (last, 0, 2, 2), (0.9, 0.1, 0.4, 0.8), (0, 0, 0, 1)
    return row, mean, failed, last


def _moves(mean: np.ndarray, failed: np.ndarray) -> np.ndarray:
    return ((mean > UP) & ~failed).astype(int) - ((mean < DOWN) | failed).astype(int)


def _rollout(rng: np.random.Generator) -> tuple:
    done = np.zeros(8, dtype=bool)
    done[rng.integers(2, 6)] = True
    gamma, lam = float(rng.uniform(0.9, 0.99)), float(rng.uniform(0.8, 0.97))
    return rng.uniform(0, 1, 8), rng.uniform(0, 5, 9), done, gamma, lam


def _advantages(
    rewards: np.ndarray, values: np.ndarray, done: np.ndarray, gamma: float, lam: float
) -> np.ndarray:
    alive = np.where(done, 0.0, 1.0)
    surprise = rewards + gamma * alive * values[1:] - values[:-1]
    steps = len(rewards)
    return np.array(
        [
            sum(
                np.prod(gamma * lam * alive[t:later]) * surprise[later] for later in range(t, steps)
            )
            for t in range(steps)
        ]
    )


def _half_reset(
    rewards: np.ndarray,
    values: np.ndarray,
    done: np.ndarray,
    gamma: float,
    lam: float,
    bootstrap: bool,
) -> np.ndarray:
    answer, following = np.zeros(len(rewards)), 0.0
    for t in reversed(range(len(rewards))):
        ahead = values[t + 1] if bootstrap or not done[t] else 0.0
        carried = following if not bootstrap or not done[t] else 0.0
        following = rewards[t] + gamma * ahead - values[t] + gamma * lam * carried
        answer[t] = following
    return answer


def _batch(rng: np.random.Generator) -> tuple:
    steps, robots = 8, 3
    fell, timed_out = np.zeros((2, steps, robots), dtype=bool)
    fell[rng.integers(2, 6), 0] = timed_out[rng.integers(2, 6), 1] = True
    gamma, lam = float(rng.uniform(0.9, 0.99)), float(rng.uniform(0.8, 0.97))
    rewards, values = rng.uniform(0, 1, (steps, robots)), rng.uniform(0, 5, (steps, robots))
    return rewards, values, rng.uniform(0, 5, (steps, robots)), fell, timed_out, gamma, lam


def _batch_advantages(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    fell: np.ndarray,
    timed_out: np.ndarray,
    gamma: float,
    lam: float,
    *,
    scaled: str = "all",
) -> np.ndarray:
    """Sum the surprises of each episode, robot by robot; `scaled` otherwise makes it wrong."""
    surprise = rewards + gamma * np.where(fell, 0.0, next_values) - values
    raw = np.zeros(rewards.shape)
    for start, robot in np.ndindex(rewards.shape):
        ends = np.flatnonzero((fell | timed_out)[start:, robot])
        stop = start + int(ends[0]) + 1 if len(ends) else len(rewards)
        weight = (gamma * lam) ** np.arange(stop - start)
        raw[start, robot] = weight @ surprise[start:stop, robot]
    if scaled == "none":
        return raw
    if scaled == "mean":
        return raw - raw.mean()
    axis = 0 if scaled == "robot" else None
    return (raw - raw.mean(axis=axis)) / raw.std(axis=axis)


def _rate(rate: float, kl: float, desired: float, *, slower: float = 1.5) -> float:
    if kl > 2 * desired:
        rate /= slower
    elif kl < desired / 2:
        rate *= slower
    return min(max(rate, 1e-5), 1e-2)


def _unlimited(rate: float, kl: float, desired: float) -> float:
    return rate / 1.5 if kl > 2 * desired else rate * 1.5 if kl < desired / 2 else rate


QUESTIONS = (
    Question(
        id="ex09.q1",
        name="next_rows",
        points=1,
        title="a curriculum in one line",
        expects="one row up if mean r_v > 0.5 and the robot did not fall; one row down if mean r_v "
        "< 0.3 or it fell; rows stay within 0 ... last.",
        draw=_robots,
        truth=lambda row, mean_r_v, failed, last: np.clip(row + _moves(mean_r_v, failed), 0, last),
        mistakes=(
            Mistake(
                "promoting the fallen: a robot that ran well until it fell has not mastered its "
                "row.",
                lambda row, mean, failed, last: np.clip(
                    row + (mean > UP).astype(int) - (mean < DOWN), 0, last
                ),
            ),
            Mistake(
                "a forgotten clip: below row 0 and above the last there is no terrain.",
                lambda row, mean, failed, last: row + _moves(mean, failed),
            ),
            Mistake(
                "no patience between the bounds: between 0.3 and 0.5 a robot stays where it is.",
                lambda row, mean, failed, last: np.clip(
                    row + np.where((mean > UP) & ~failed, 1, -1), 0, last
                ),
            ),
            Mistake(
                "up and down exchanged: a robot that does well moves on to harder ground.",
                lambda row, mean, failed, last: np.clip(row - _moves(mean, failed), 0, last),
            ),
            Mistake(
                "no row down: a robot stuck on ground too hard for it learns nothing.",
                lambda row, mean, failed, last: np.clip(row + ((mean > UP) & ~failed), 0, last),
            ),
        ),
        hints=(
            "Two masks: the robots that move up, and those that move down.",
            "row + up - down, with up.astype(int), then np.clip.",
        ),
    ),
    Question(
        id="ex09.q2",
        name="advantages",
        points=1,
        title="generalised advantages",
        expects="each later surprise counts gamma * lam times less; neither values nor surprises "
        "of the next episode count in this one.",
        draw=_rollout,
        truth=_advantages,
        mistakes=(
            Mistake(
                "an advantage that crosses a reset: after done a new episode begins.",
                lambda r, v, done, g, lam: _advantages(r, v, done & False, g, lam),
            ),
            Mistake(
                "half a reset: where done, V_(t+1) is left out, but A_(t+1) still counts.",
                lambda r, v, done, g, lam: _half_reset(r, v, done, g, lam, bootstrap=False),
            ),
            Mistake(
                "the other half of a reset: where done, A_(t+1) is left out, but V_(t+1) still "
                "counts.",
                lambda r, v, done, g, lam: _half_reset(r, v, done, g, lam, bootstrap=True),
            ),
            Mistake(
                "a forgotten lambda: each later surprise counts gamma * lam times less.",
                lambda r, v, done, g, lam: _advantages(r, v, done, g, 1.0),
            ),
            Mistake(
                "one step alone: that is d_t, the case lam = 0: later surprises count too.",
                lambda r, v, done, g, lam: _advantages(r, v, done, g, 0.0),
            ),
            Mistake(
                "returns for advantages: V_t was added again: that is what the critic learns, not "
                "the policy.",
                lambda r, v, done, g, lam: _advantages(r, v, done, g, lam) + v[:-1],
            ),
            Mistake(
                "rewards without the critic: the values are missing: d_t = r_t + gamma V_(t+1) - "
                "V_t.",
                lambda r, v, done, g, lam: _advantages(r, 0 * v, done, g, lam),
            ),
        ),
        hints=(
            "Go backwards, and carry A along.",
            "alive = 1 - done[t] multiplies both V_(t+1) and A_(t+1).",
        ),
    ),
    Question(
        id="ex09.q3",
        name="next_rate",
        points=1,
        title="a learning rate that follows the KL",
        expects="the rate is divided by 1.5 if KL > 2 desired, multiplied by 1.5 if KL < desired / "
        "2, else kept; always within 1e-5 ... 1e-2.",
        draw=lambda rng: (
            float(10 ** rng.uniform(-4.9, -2.1)),
            float(0.01 * 10 ** rng.uniform(-1, 1)),
            0.01,
        ),
        examples=(
            (1e-3, 0.05, 0.01),
            (1e-3, 0.001, 0.01),
            (1e-3, 0.01, 0.01),
            (1.1e-5, 1.0, 0.01),
            (9e-3, 0.0001, 0.01),
        ),
        truth=lambda rate, kl, desired: _rate(rate, kl, desired),
        mistakes=(
            Mistake(
                "a turned rule: a large KL says that the last step was too LONG.",
                lambda rate, kl, desired: _rate(rate, kl, desired, slower=1 / 1.5),
            ),
            Mistake(
                "a forgotten limit: without 1e-5 ... 1e-2 the rate can vanish or explode.",
                _unlimited,
            ),
            Mistake(
                "a rate that always changes: between desired / 2 and 2 desired it stays as it is.",
                lambda rate, kl, desired: min(
                    max(rate / 1.5 if kl > desired else rate * 1.5, 1e-5), 1e-2
                ),
            ),
            Mistake(
                "a rate that never recovers: a small KL allows longer steps again.",
                lambda rate, kl, desired: max(rate / 1.5, 1e-5) if kl > 2 * desired else rate,
            ),
        ),
        hints=(
            "Three cases: too far, not far enough, just right.",
            "min(max(rate, 1e-5), 1e-2) at the end.",
        ),
    ),
    Question(
        id="ex09.q4",
        name="batch_advantages",
        points=3,
        title="a whole rollout, with falls and time-outs",
        expects="generalised advantages in which nothing is carried back over an end; after a fall "
        "the future is worth 0, after a time-out it is worth next_values; then the mean of all is "
        "0 and their standard deviation 1.",
        draw=_batch,
        truth=lambda rewards, values, next_values, fell, timed_out, gamma, lam: _batch_advantages(
            rewards, values, next_values, fell, timed_out, gamma, lam
        ),
        mistakes=(
            Mistake(
                "a time-out treated as a fall: the robot could have gone on, so what follows is "
                "worth next_values.",
                lambda r, v, n, f, t, g, lam: _batch_advantages(r, v, n, f | t, t, g, lam),
            ),
            Mistake(
                "a fall treated as a time-out: after a fall nothing more is earned.",
                lambda r, v, n, f, t, g, lam: _batch_advantages(r, v, n, f & False, f | t, g, lam),
            ),
            Mistake(
                "an advantage that crosses a time-out: the next step belongs to a new episode.",
                lambda r, v, n, f, t, g, lam: _batch_advantages(r, v, n, f, t & False, g, lam),
            ),
            Mistake(
                "no normalisation: subtract the mean of all, and divide by their standard "
                "deviation.",
                lambda *case: _batch_advantages(*case, scaled="none"),
            ),
            Mistake(
                "half a normalisation: divide by the standard deviation too.",
                lambda *case: _batch_advantages(*case, scaled="mean"),
            ),
            Mistake(
                "every robot normalised by itself: then a robot that did badly in all it did looks "
                "like the others; mean and deviation are those of the whole batch.",
                lambda *case: _batch_advantages(*case, scaled="robot"),
            ),
        ),
        hints=(
            "Go backwards over the steps, for all robots at once: every quantity of a step is an "
            "array [n].",
            "Two factors: 1 - fell[t] for what next_values[t] is worth, and 1 - (fell | "
            "timed_out)[t] for the advantage that is carried.",
            "(a - a.mean()) / a.std()",
        ),
    ),
)
