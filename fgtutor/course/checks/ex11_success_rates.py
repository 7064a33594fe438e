"""Exercise 11, "Mixed terrain": success tables with intervals, metres per policy (Sec. IV-B)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question
from fgtutor.directions import STEP_LENGTHS

Z = 1.959963984540054
REACHED, NO_ROUTE = 0, 1


def _counts(rng: np.random.Generator) -> tuple:
    trials = rng.integers(5, 200, 6)
    successes = (trials * rng.uniform(0, 1, 6)).astype(int)
    successes[0] = trials[0]  # a perfect score, where the textbook interval fails
    return successes, trials


def _wilson(successes: np.ndarray, trials: np.ndarray, z: float = Z) -> tuple:
    """The two rates at which the observed share would be z standard errors away: a quadratic."""
    share = successes / trials
    a, b, c = 1 + z**2 / trials, -(2 * share + z**2 / trials), share**2
    root = np.sqrt(np.maximum(b**2 - 4 * a * c, 0))
    return (-b - root) / (2 * a), (-b + root) / (2 * a)


def _wald(successes: np.ndarray, trials: np.ndarray) -> tuple:
    share = successes / trials
    half = Z * np.sqrt(share * (1 - share) / trials)
    return share - half, share + half


def _uncentred(successes: np.ndarray, trials: np.ndarray) -> tuple:
    low, high = _wilson(successes, trials)
    share, half = successes / trials, (high - low) / 2
    return share - half, share + half


def _outcomes(rng: np.random.Generator) -> tuple:
    n, policies, terrains = 60, 3, 4
    terrain, policy = rng.integers(terrains, size=n), rng.integers(policies, size=n)
    policy[(terrain == 1) & (policy == 2)] = 0  # one pair is never tried
    return terrain, policy, rng.choice(4, n, p=[0.5, 0.25, 0.15, 0.1]), terrains, policies


def _rates(
    terrain: np.ndarray, policy: np.ndarray, outcome: np.ndarray, terrains: int, policies: int
) -> np.ndarray:
    table = np.full((terrains, policies), np.nan)
    for t, p in set(zip(terrain.tolist(), policy.tolist(), strict=True)):
        table[t, p] = np.mean(outcome[(terrain == t) & (policy == p)] == REACHED)
    return table


def _of_planned(
    terrain: np.ndarray, policy: np.ndarray, outcome: np.ndarray, terrains: int, policies: int
) -> np.ndarray:
    kept = outcome != NO_ROUTE
    return _rates(terrain[kept], policy[kept], outcome[kept], terrains, policies)


def _route(rng: np.random.Generator) -> tuple:
    n = int(rng.integers(10, 25))
    return rng.integers(8, size=n), rng.integers(3, size=n), 4, 0.1


def _metres(
    headings: np.ndarray, policies: np.ndarray, count: int, resolution: float
) -> np.ndarray:
    return np.bincount(policies, STEP_LENGTHS[headings] * resolution, minlength=count)


QUESTIONS = (
    Question(
        id="ex11.q1",
        name="wilson_interval",
        points=3,
        title="how sure is a success rate?",
        expects="(low, high) of the Wilson interval with z = 1.96: centre (p + z^2/2n) / (1 + "
        "z^2/n), half width z / (1 + z^2/n) sqrt(p (1 - p) / n + z^2 / 4n^2); within [0, 1], and "
        "of some width even when every trial succeeded.",
        draw=_counts,
        truth=lambda successes, trials: _wilson(successes, trials),
        mistakes=(
            Mistake(
                "the textbook interval: p +- z sqrt(p (1 - p) / n) has no width at p = 1, and "
                "leaves [0, 1].",
                _wald,
            ),
            Mistake(
                "a centre at p: Wilson's interval is not symmetric about p: its centre is drawn "
                "towards 1/2.",
                _uncentred,
            ),
            Mistake(
                "z = 1 for z = 1.96: one standard error covers 68 %, not 95 %.",
                lambda s, n: _wilson(s, n, 1.0),
            ),
            Mistake(
                "a one-sided z: 1.645 leaves 5 % on EACH side; 95 % in the middle needs 1.96.",
                lambda s, n: _wilson(s, n, 1.6448536),
            ),
            Mistake("swapped ends: the low end comes first.", lambda s, n: _wilson(s, n)[::-1]),
        ),
        hints=(
            "p = successes / trials; compute centre and half width one after the other.",
            "The division by (1 + z^2 / n) belongs to both.",
        ),
        rtol=1e-3,
        atol=1e-3,
    ),
    Question(
        id="ex11.q2",
        name="success_table",
        points=2,
        title="Table II from raw trials",
        expects="table[terrain, policy] is the share of ALL trials of that pair whose outcome is 0 "
        "(reached); no route, a fall and a time-out are failures; NaN where nothing was tried.",
        draw=_outcomes,
        truth=lambda terrain, policy, outcome, terrains, policies: _rates(
            terrain, policy, outcome, terrains, policies
        ),
        mistakes=(
            Mistake(
                "refusals left out: a planner that finds no route has failed too (outcome 1), or "
                "one that only dares the easy trials would win.",
                _of_planned,
            ),
            Mistake(
                "a transposed table: terrains are rows, policies columns.",
                lambda t, p, o, nt, np_: _rates(t, p, o, nt, np_).T,
            ),
            Mistake(
                "zeros for nothing tried: a rate of 0 says that it always failed; where nothing "
                "was tried, NaN.",
                lambda t, p, o, nt, np_: np.nan_to_num(_rates(t, p, o, nt, np_)),
            ),
            Mistake(
                "failures for successes: outcome 0 is `reached`.",
                lambda t, p, o, nt, np_: 1 - _rates(t, p, o, nt, np_),
            ),
            Mistake(
                "counts for rates: divide by the trials of that pair.",
                lambda t, p, o, nt, np_: np.array(
                    [
                        [np.sum((t == i) & (p == j) & (o == 0)) for j in range(np_)]
                        for i in range(nt)
                    ]
                ),
            ),
        ),
        hints=(
            "One mask per pair: (terrain == i) & (policy == j).",
            "The mean of (outcome[mask] == 0) is the rate; an empty mask has none.",
        ),
    ),
    Question(
        id="ex11.q3",
        name="metres_by_policy",
        points=2,
        title="who walked how far?",
        expects="the metres of the route that each of `count` policies walks: a step along an axis "
        "is `resolution` long, a diagonal one sqrt(2) times that; 0 for a policy without a step.",
        draw=_route,
        truth=lambda headings, policies, count, resolution: _metres(
            headings, policies, count, resolution
        ),
        mistakes=(
            Mistake(
                "steps for metres: that counts steps.",
                lambda h, p, n, r: np.bincount(p, minlength=n),
            ),
            Mistake(
                "diagonals as short as the others: odd headings are diagonal: sqrt(2) cells long.",
                lambda h, p, n, r: np.bincount(p, minlength=n) * r,
            ),
            Mistake(
                "a forgotten resolution: STEP_LENGTHS counts cells; a cell is `resolution` metres.",
                lambda h, p, n, r: _metres(h, p, n, 1.0),
            ),
            Mistake(
                "diagonal and straight exchanged: heading 0 is +x: even headings lie along the "
                "axes.",
                lambda h, p, n, r: (
                    _metres(h + 1, p, n, r) if h.max() < 7 else _metres((h + 1) % 8, p, n, r)
                ),
            ),
            Mistake(
                "shares for metres: it is divided by the whole length.",
                lambda h, p, n, r: _metres(h, p, n, r) / _metres(h, p, n, r).sum(),
            ),
            Mistake(
                "missing idle policies: a policy that never walks has 0 m: np.bincount needs "
                "minlength=count.",
                lambda h, p, n, r: _metres(h, p, 0, r),
            ),
        ),
        hints=(
            "fgtutor.directions.STEP_LENGTHS[headings] are the lengths in cells.",
            "np.bincount(policies, weights=lengths, minlength=count) adds them up by policy.",
        ),
    ),
    Question(
        id="ex11.q4",
        name="trials_needed",
        points=2,
        title="how many trials make a 99 %?",
        expects="the smallest number of trials, all successful, after which the lower end of the "
        "95 % Wilson interval lies above 0.99.",
        truth=lambda: 381,
        mistakes=(
            Mistake(
                "one trial in a hundred: 100 successes of 100 still allow a rate of 96 %.",
                lambda: 100,
            ),
            Mistake(
                "the rule of three: 3 / n is a one-sided 95 % bound; the interval asked for is "
                "two-sided.",
                lambda: 300,
            ),
            Mistake(
                "a forgotten square: the lower end is n / (n + z^2), with z squared.", lambda: 195
            ),
            Mistake(
                "one trial too few: at 380 the lower end is still just below 0.99.", lambda: 380
            ),
            Mistake("a bound of 0.9: 0.99 is asked for.", lambda: 35),
        ),
        hints=(
            "Put p = 1 into the formula: what is left of the lower end?",
            "n / (n + z^2) > 0.99: solve for n, and round up.",
        ),
        rtol=1e-6,
    ),
)
