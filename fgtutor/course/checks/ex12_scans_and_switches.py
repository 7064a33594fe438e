"""Exercise 12, "From a scan to a walk": rasters, localisation noise, switching (Sec. V)."""

import itertools
from collections.abc import Callable

import numpy as np

from fgtutor.course.checks.question import Mistake, Question


def _cloud(rng: np.random.Generator) -> tuple:
    nx, ny, resolution = 5, 4, float(rng.choice([0.05, 0.1]))
    # Per cell some points on one level; the last row of cells is empty.
    cells = np.repeat(np.argwhere(np.ones((nx, ny - 1))), 3, axis=0)
    level = np.repeat(rng.uniform(-0.3, -0.1, nx * (ny - 1)), 3)
    z = level + rng.uniform(0, 0.02, len(level))
    z[0] += 0.5  # a stray echo, alone up there
    z[3:6] = -0.3, -0.2, -0.1  # three strays: no height has support
    z[8] -= 0.5  # one below the ground
    inside = (cells + rng.uniform(0.05, 0.95, cells.shape)) * resolution
    points = np.column_stack((inside, z))
    beside = np.array([[-0.4, 0.3, 1.0], [nx + 0.4, 0.3, 1.0], [0.3, ny + 0.4, 1.0]])
    beside = np.repeat(beside, 2, axis=0) * (resolution, resolution, 1)
    points = np.concatenate((points, beside))
    return rng.permutation(points), (nx, ny), resolution, 2


def _raster(
    points: np.ndarray,
    shape: tuple[int, int],
    resolution: float,
    support: int,
    *,
    empty: float = np.nan,
    pick: Callable[[np.ndarray], float] = np.max,
    clamp: bool = False,
) -> np.ndarray:
    """Look at the points cell by cell; the options make it wrong."""
    heights = np.full(shape, empty)
    cells = np.floor(points[:, :2] / resolution).astype(int)
    if clamp:
        cells = np.clip(cells, 0, np.array(shape) - 1)
    for ix, iy in np.ndindex(shape):
        z = points[(cells == (ix, iy)).all(axis=-1), 2]
        held = [h for h in z if sum(abs(h - other) <= 0.05 for other in z) >= support]
        if held:
            heights[ix, iy] = pick(np.array(held))
    return heights


def _noise(rng: np.random.Generator) -> tuple:
    return (np.linspace(0, 20, 6), float(rng.uniform(0.01, 0.05)), float(rng.uniform(0.01, 0.05)))


def _choices(rng: np.random.Generator) -> tuple:
    feasibility = rng.uniform(0.3, 1, (6, 2))
    return feasibility, float(rng.uniform(0.5, 1.5))


def _sequences(feasibility: np.ndarray) -> list[tuple[float, int]]:
    """Every choice of a policy for each step: what its steps cost, and its switches."""
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
        points=3,
        title="from a point cloud to a map",
        expects="heights[ix, iy] is the HIGHEST point over the cell that has at least `support` "
        "points of its cell, itself among them, within 5 cm of its height; NaN where there is "
        "none; points beside the map do not count.",
        draw=_cloud,
        truth=lambda points, shape, resolution, support: _raster(
            points, shape, resolution, support
        ),
        mistakes=(
            Mistake(
                "stray points believed: a single echo high above the others is no ground; ask for "
                "`support` points.",
                lambda p, s, r, n: _raster(p, s, r, 1),
            ),
            Mistake(
                "a mean of the points: at the edge of a step, the mean is a height that is "
                "nowhere.",
                lambda p, s, r, n: _raster(p, s, r, n, pick=np.mean),
            ),
            Mistake(
                "the lowest point: a foot is stopped by the highest.",
                lambda p, s, r, n: _raster(p, s, r, n, pick=np.min),
            ),
            Mistake(
                "zeros for what was not seen: an unknown cell is NaN; 0 would be free ground.",
                lambda p, s, r, n: _raster(p, s, r, n, empty=0.0),
            ),
            Mistake(
                "heights that start at zero: all ground here lies below 0, so a maximum with 0 "
                "hides it.",
                lambda p, s, r, n: np.maximum(_raster(p, s, r, n), 0.0),
            ),
            Mistake(
                "points beside the map pushed into its border cells: leave them out.",
                lambda p, s, r, n: _raster(p, s, r, n, clamp=True),
            ),
            Mistake(
                "NaN that spreads: np.maximum(nan, z) is NaN; start from -inf, or fill in cell by "
                "cell.",
                lambda p, s, r, n: np.full(s, np.nan),
            ),
            Mistake(
                "swapped axes: the first index is ix: maps here are not images.",
                lambda p, s, r, n: _raster(p[:, [1, 0, 2]], s[::-1], r, n),
            ),
            Mistake(
                "a point that does not count itself: `support` includes the point.",
                lambda p, s, r, n: _raster(p, s, r, n + 1),
            ),
        ),
        hints=(
            "Cells as in exercise 01: np.floor(xy / resolution). Keep the points whose cell is on "
            "the map.",
            "For the heights z of one cell, np.abs(z[:, None] - z) <= 0.05 says which points lie "
            "near which; its sum along an axis is the support of each.",
            "A loop over np.unique(cells, axis=0) visits every cell that was hit.",
        ),
    ),
    Question(
        id="ex12.q2",
        name="localisation_std",
        points=1,
        title="how lost is the robot after t seconds?",
        expects="a standard deviation in metres; a random walk's VARIANCE grows in proportion to "
        "time, and independent errors add their variances.",
        draw=_noise,
        truth=lambda t, fix, drift: np.hypot(fix, drift * np.sqrt(t)),
        mistakes=(
            Mistake(
                "standard deviations that add up: independent errors partly cancel: their squares "
                "add up.",
                lambda t, fix, drift: fix + drift * np.sqrt(t),
            ),
            Mistake(
                "a drift that always goes in one direction: drift * t is a bias; a random walk "
                "gets as far as drift * sqrt(t).",
                lambda t, fix, drift: np.hypot(fix, drift * t),
            ),
            Mistake(
                "a variance in place of a standard deviation: the root is missing: the answer is "
                "in metres.",
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
        points=2,
        title="plan with a price on switching",
        expects="the smallest sum over the steps of 1 / F[step, policy of that step], plus "
        "switch_cost for every change of policy; the first policy is free.",
        draw=_choices,
        examples=((np.array([[0.9, 0.5], [0.5, 0.6], [0.9, 0.5]]), 1.0),),
        truth=lambda feasibility, switch_cost: _cheapest(feasibility, switch_cost),
        mistakes=(
            Mistake(
                "the greedy choice: the best policy at every step may mean a switch at every step; "
                "staying can be cheaper.",
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
                "percent in place of a probability: a probability lies between 0 and 1.",
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
