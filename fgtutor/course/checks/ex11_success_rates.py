"""Exercise 11, "Mixed terrain": success tables with intervals, a paired test (Sec. IV-B)."""

import math

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

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


def _pairs(rng: np.random.Generator) -> tuple:
    first = rng.uniform(size=50) < 0.8
    second = np.where(rng.uniform(size=50) < 0.6, first, rng.uniform(size=50) < 0.6)
    first[:4], second[:4] = (1, 1, 0, 0), (0, 0, 1, 0)
    return first, second


def _sign_test(
    first: np.ndarray, second: np.ndarray, sides: float = 2.0, ties: bool = False
) -> tuple[int, int, float]:
    """Count the outcomes of n fair coins by Pascal's triangle; `sides` and `ties` make it wrong."""
    wins, losses = int((first & ~second).sum()), int((second & ~first).sum())
    n, least = (len(first) if ties else wins + losses), min(wins, losses)
    row = np.ones(1)
    for _ in range(n):
        row = np.append(row, 0.0) + np.append(0.0, row)
    return wins, losses, float(min(sides * row[: least + 1].sum() / 2.0**n, 1.0))


def _unlimited(first: np.ndarray, second: np.ndarray) -> tuple[int, int, float]:
    wins, losses, half = _sign_test(first, second, sides=1.0)
    return wins, losses, 2 * half


def _point_test(first: np.ndarray, second: np.ndarray) -> tuple[int, int, float]:
    wins, losses, _ = _sign_test(first, second)
    n = wins + losses
    return wins, losses, float(min(2 * math.comb(n, wins) / 2**n, 1.0))


def _length(xy: np.ndarray) -> float:
    return float(np.hypot(*np.diff(xy, axis=0).T).sum())


def _walks(rng: np.random.Generator) -> tuple:
    trials, count, longest = 14, 3, 8
    xy = np.cumsum(rng.uniform(0.1, 1.0, (trials, longest, 2)), axis=1)
    for trial, end in enumerate(rng.integers(4, longest + 1, trials)):
        xy[trial, end:] = np.nan
    xy[0] = np.nan
    xy[0, :2] = (0, 0), (0, 1)  # shorter than its reference
    checkpoint = np.append(np.arange(10) % 2, [0, 1, 0, 1])  # the last checkpoint was never tried
    success = rng.uniform(size=trials) < 0.7
    success[:4] = True, True, False, False
    return checkpoint, success, xy, rng.uniform(1.5, 3, trials), count


def _checkpoints(
    checkpoint: np.ndarray,
    success: np.ndarray,
    xy: np.ndarray,
    reference: np.ndarray,
    count: int,
    *,
    every: bool = False,
    capped: bool = True,
    empty: float = np.nan,
    of_successes: bool = False,
) -> np.ndarray:
    """Make the rows one by one; the options make it wrong."""
    lengths = np.array([_length(walk[~np.isnan(walk[:, 0])]) for walk in xy])
    table = np.full((count, 3), empty)
    for row in sorted(set(checkpoint.tolist())):
        own = checkpoint == row
        reached = own & success
        share = reference / (np.maximum(lengths, reference) if capped else lengths)
        spl = share[reached].mean() if of_successes else (share * success)[own].mean()
        table[row] = lengths[own if every else reached].mean(), success[own].mean(), spl
    return table


QUESTIONS = (
    Question(
        id="ex11.q1",
        name="wilson_interval",
        points=1,
        title="how sure is a success rate?",
        expects="(low, high) of the Wilson interval with z = 1.96: within [0, 1], never without "
        "width, and 0.84 to 1 for 20 successes of 20.",
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
                "z = 1 in place of 1.96: one standard error covers 68 %, not 95 %.",
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
        points=1,
        title="Table II from raw trials",
        expects="table[terrain, policy] is the share of ALL trials of that pair whose outcome is 0 "
        "(reached); no route, a fall and a time-out are failures; NaN where nothing was tried.",
        draw=_outcomes,
        truth=lambda terrain, policy, outcome, terrains, policies: _rates(
            terrain, policy, outcome, terrains, policies
        ),
        mistakes=(
            Mistake(
                "refusals left out: no route (outcome 1) is a failure too, or a planner that "
                "accepts only the easy trials would win.",
                _of_planned,
            ),
            Mistake(
                "a transposed table: terrains are rows, policies columns.",
                lambda t, p, o, nt, np_: _rates(t, p, o, nt, np_).T,
            ),
            Mistake(
                "zeros where nothing was tried: a rate of 0 says that it always failed; where "
                "nothing was tried, NaN.",
                lambda t, p, o, nt, np_: np.nan_to_num(_rates(t, p, o, nt, np_)),
            ),
            Mistake(
                "failures counted: outcome 0 is `reached`.",
                lambda t, p, o, nt, np_: 1 - _rates(t, p, o, nt, np_),
            ),
            Mistake(
                "counts in place of rates: divide by the trials of that pair.",
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
        name="paired_test",
        points=3,
        title="which planner is better, over the same grounds?",
        expects="the trials that only the first one won, those that only the second one won, and "
        "the probability that n fair coins, n the sum of both, fall at least as unevenly, to "
        "either side; never above 1.",
        draw=_pairs,
        examples=(
            (np.array([True, False, True]), np.array([True, False, True])),  # they never differ
            (np.array([True, False, True]), np.array([False, True, True])),  # as often each
        ),
        truth=lambda first, second: _sign_test(first, second),
        mistakes=(
            Mistake(
                "one side of the test: before the trials, either planner might have been the "
                "better one: count both sides.",
                lambda a, b: _sign_test(a, b, sides=1.0),
            ),
            Mistake(
                "draws counted: a ground that both cross, or none, says nothing about which is "
                "better.",
                lambda a, b: _sign_test(a, b, ties=True),
            ),
            Mistake(
                "successes in place of wins: count the trials that ONLY this planner won.",
                lambda a, b: (int(a.sum()), int(b.sum()), _sign_test(a, b)[2]),
            ),
            Mistake(
                "swapped counts: those that only the first one won come first.",
                lambda a, b: (_sign_test(a, b)[1], _sign_test(a, b)[0], _sign_test(a, b)[2]),
            ),
            Mistake(
                "a probability above 1: where both won as often, both sides hold the middle; limit "
                "p to 1.",
                _unlimited,
            ),
            Mistake(
                "one outcome alone: not only this split, but every more uneven one counts.",
                _point_test,
            ),
        ),
        hints=(
            "first & ~second marks the trials that only the first one won.",
            "The probability of exactly k heads of n fair coins is math.comb(n, k) / 2**n.",
            "Sum it over k = 0 ... min(wins, losses), times 2, at most 1.",
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
    Question(
        id="ex11.q5",
        name="table_one",
        points=3,
        title="how an approach improves, from raw walks",
        expects="row c holds, of the trials of checkpoint c, the mean length of the walks that "
        "succeeded, the success rate, and SPL over all trials; NaN three times for a checkpoint "
        "that was never tried; a walk ends where its positions become NaN.",
        draw=_walks,
        truth=lambda checkpoint, success, xy, reference, count: _checkpoints(
            checkpoint, success, xy, reference, count
        ),
        mistakes=(
            Mistake(
                "lengths of failures: a walk that ended in a fall is short for the wrong reason; "
                "average the successes.",
                lambda *case: _checkpoints(*case, every=True),
            ),
            Mistake(
                "an SPL over successes alone: a failure counts 0.",
                lambda *case: _checkpoints(*case, of_successes=True),
            ),
            Mistake(
                "a forgotten max: a walk shorter than its reference counts 1, not more.",
                lambda *case: _checkpoints(*case, capped=False),
            ),
            Mistake(
                "zeros for a checkpoint that was not tried: 0 would say that it always failed.",
                lambda *case: _checkpoints(*case, empty=0.0),
            ),
            Mistake(
                "columns in the wrong order: length, success rate, SPL.",
                lambda *case: _checkpoints(*case)[:, [0, 2, 1]],
            ),
            Mistake(
                "walks that go on after their end: NaN marks what was never walked; leave those "
                "positions out.",
                lambda c, s, xy, ref, n: _checkpoints(c, s, np.nan_to_num(xy), ref, n),
            ),
        ),
        hints=(
            "First the length of each walk: np.diff over axis 1, and np.nansum over the steps.",
            "Then a loop over the checkpoints: own = checkpoint == c; skip it if not own.any().",
            "SPL of a checkpoint is the mean of success * reference / max(length, reference).",
        ),
    ),
)
