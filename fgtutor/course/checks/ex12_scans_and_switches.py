"""Exercise 12, "From a scan to a walk": rasters, localisation noise, switching (Sec. V)."""

import itertools

import numpy as np

from fgtutor.course.checks.question import Mistake, Question


def _cloud(rng: np.random.Generator) -> tuple:
    nx, ny, resolution = 5, 4, float(rng.choice([0.05, 0.1]))
    n = 30
    cells = np.stack((rng.integers(nx, size=n), rng.integers(ny - 1, size=n)), axis=-1)
    inside = (cells + rng.uniform(0.05, 0.95, (n, 2))) * resolution
    return np.column_stack((inside, rng.uniform(-0.3, -0.05, n))), (nx, ny), resolution


def _raster(
    points: np.ndarray,
    shape: tuple[int, int],
    resolution: float,
    empty: float = np.nan,
    pick=np.max,
) -> np.ndarray:
    cells = np.floor(points[:, :2] / resolution).astype(int)
    heights = np.full(shape, empty)
    for ix, iy in set(map(tuple, cells.tolist())):
        inside = (cells == (ix, iy)).all(axis=-1)
        heights[ix, iy] = pick(points[inside, 2])
    return heights


def _noise(rng: np.random.Generator) -> tuple:
    return (np.linspace(0, 20, 6), float(rng.uniform(0.01, 0.05)), float(rng.uniform(0.01, 0.05)))


def _choices(rng: np.random.Generator) -> tuple:
    feasibility = rng.uniform(0.3, 1, (6, 2))
    return feasibility, float(rng.uniform(0.5, 1.5))


def _sequences(feasibility: np.ndarray) -> list[tuple[float, int]]:
    """Every way to choose a policy for each step: what its steps cost, and its switches."""
    steps, policies = feasibility.shape
    return [
        (
            float(sum(1 / feasibility[i, p] for i, p in enumerate(choice))),
            sum(a != b for a, b in itertools.pairwise(choice)),
        )
        for choice in itertools.product(range(policies), repeat=steps)
    ]


def _cheapest(feasibility: np.ndarray, switch_cost: float, first: int = 0) -> float:
    ways = _sequences(feasibility)
    return min(steps + switch_cost * (switches + first) for steps, switches in ways)


def _greedy(feasibility: np.ndarray, switch_cost: float) -> float:
    best = feasibility.argmax(axis=1)
    switches = np.count_nonzero(np.diff(best))
    return float((1 / feasibility.max(axis=1)).sum() + switch_cost * switches)


QUESTIONS = (
    Question(
        id="ex12.q1",
        name="rasterise",
        points=2,
        title="from a point cloud to a map",
        expects="heights[ix, iy] is the HIGHEST point over the cell (the map's corner is (0, 0)), "
        "and NaN where the scanner hit nothing.",
        draw=_cloud,
        truth=lambda points, shape, resolution: _raster(points, shape, resolution),
        mistakes=(
            Mistake(
                "mean for max: at the edge of a step, the mean is a height that is nowhere.",
                lambda p, s, r: _raster(p, s, r, pick=np.mean),
            ),
            Mistake(
                "the last point for the highest: heights[ix, iy] = z keeps whichever point came "
                "last: use np.maximum.at.",
                lambda p, s, r: _raster(p, s, r, pick=lambda z: z[-1]),
            ),
            Mistake(
                "zeros for the unseen: an unknown cell is NaN: 0 would be free ground.",
                lambda p, s, r: _raster(p, s, r, empty=0.0),
            ),
            Mistake(
                "a floor at zero: all points here lie below 0: start from -infinity, not from "
                "zeros.",
                lambda p, s, r: np.where(np.isnan(_raster(p, s, r)), np.nan, 0.0),
            ),
            Mistake(
                "swapped axes: the first index is ix: maps here are not images.",
                lambda p, s, r: _raster(p[:, [1, 0, 2]], s[::-1], r),
            ),
            Mistake(
                "the lowest point: a foot is stopped by the highest.",
                lambda p, s, r: _raster(p, s, r, pick=np.min),
            ),
        ),
        hints=(
            "Cells as in exercise 01: np.floor(xy / resolution).",
            "np.maximum.at(heights, (ix, iy), z) keeps the highest, from an array of -np.inf.",
            "What is still -inf at the end was never hit: make it NaN.",
        ),
    ),
    Question(
        id="ex12.q2",
        name="localisation_std",
        points=2,
        title="how lost is the robot after t seconds?",
        expects="sqrt(fix^2 + drift^2 t): a random walk's VARIANCE grows with time, and "
        "independent errors add their variances.",
        draw=_noise,
        truth=lambda t, fix, drift: np.hypot(fix, drift * np.sqrt(t)),
        mistakes=(
            Mistake(
                "standard deviations that add up: independent errors partly cancel: their squares "
                "add up.",
                lambda t, fix, drift: fix + drift * np.sqrt(t),
            ),
            Mistake(
                "a drift that only ever grows one way: drift * t is a bias; a random walk gets as "
                "far as drift * sqrt(t).",
                lambda t, fix, drift: np.hypot(fix, drift * t),
            ),
            Mistake(
                "a variance for a standard deviation: the root is missing: the answer is in "
                "metres.",
                lambda t, fix, drift: fix**2 + drift**2 * t,
            ),
            Mistake(
                "a forgotten fix: at t = 0 the error is that of one fix.",
                lambda t, fix, drift: drift * np.sqrt(t),
            ),
            Mistake(
                "a fix that gets better with time: the fixes are not averaged: each step uses one.",
                lambda t, fix, drift: np.hypot(fix / np.sqrt(t + 1), drift * np.sqrt(t)),
            ),
        ),
        hints=(
            "What is the variance of the sum of independent errors?",
            "drift is in metres per root second: drift * sqrt(t) is its share.",
        ),
    ),
    Question(
        id="ex12.q3",
        name="cheapest_with_switches",
        points=3,
        title="plan with a price on switching",
        expects="the smallest sum over the steps of 1 / F[step, policy of that step], plus "
        "switch_cost for every change of policy; the first policy is free.",
        draw=_choices,
        examples=((np.array([[0.9, 0.5], [0.5, 0.6], [0.9, 0.5]]), 1.0),),
        truth=lambda feasibility, switch_cost: _cheapest(feasibility, switch_cost),
        mistakes=(
            Mistake(
                "the greedy choice: the best policy at every step may switch to and fro; staying "
                "can be cheaper.",
                _greedy,
            ),
            Mistake("free switching: the changes are not paid.", lambda f, s: _cheapest(f, 0.0)),
            Mistake(
                "one policy for all: a switch is dear, but not forbidden.",
                lambda f, s: (1 / f).sum(axis=0).min(),
            ),
            Mistake(
                "a price for the first policy: the robot starts with whichever policy it likes.",
                lambda f, s: _cheapest(f, s, first=1),
            ),
            Mistake(
                "a price for every step: only a CHANGE of policy costs.",
                lambda f, s: (1 / f.max(axis=1)).sum() + s * len(f),
            ),
        ),
        hints=(
            "Carry along, for each policy, the cheapest cost of having arrived with it.",
            "A step with policy p comes from p for free, or from the cheapest other one for "
            "switch_cost.",
            "cost = np.minimum(cost, cost.min() + switch_cost) + 1 / F[i]; the answer is its min.",
        ),
    ),
    Question(
        id="ex12.q4",
        name="all_switches",
        points=2,
        title="five switches in a row",
        expects="the probability that all five switches of Table III succeed (95, 100, 100, 85 and "
        "100 %), if they are independent.",
        truth=lambda: 0.95 * 0.85,
        mistakes=(
            Mistake(
                "the mean of the rates: that is the chance of ONE switch drawn at random; here all "
                "five must succeed.",
                lambda: (0.95 + 1 + 1 + 0.85 + 1) / 5,
            ),
            Mistake("the weakest switch alone: the others can fail too.", lambda: 0.85),
            Mistake(
                "failures that are added: 1 - 0.05 - 0.15 counts the runs twice in which both "
                "fail.",
                lambda: 0.80,
            ),
            Mistake(
                "percent for a probability: a probability lies between 0 and 1.",
                lambda: 100 * 0.95 * 0.85,
            ),
            Mistake(
                "the measured success: 70 % is what the whole walk achieved; it includes the "
                "walking between the switches.",
                lambda: 0.70,
            ),
        ),
        hints=(
            "Independent events that must all happen: their probabilities multiply.",
            "0.95 * 1 * 1 * 0.85 * 1",
        ),
        rtol=2e-3,
    ),
)
