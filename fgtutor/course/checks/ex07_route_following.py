"""Exercise 07, "Drive the plan": pure pursuit, turn rates, hysteresis (Sec. III-C)."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

GAIN = 3.0


def _route(rng: np.random.Generator) -> tuple:
    yaw = np.cumsum(rng.uniform(-0.6, 0.6, 14)) + rng.uniform(-3, 3)
    spacing = rng.uniform(0.1, 0.3, 14)
    route = np.cumsum(spacing[:, None] * np.stack((np.cos(yaw), np.sin(yaw)), axis=-1), axis=0)
    position = route[rng.integers(3, 8)] + rng.uniform(-0.03, 0.03, 2)
    return route, position, float(rng.uniform(0.3, 0.7))


def _nearest(route: np.ndarray, position: np.ndarray) -> int:
    return int(np.hypot(*(route - position).T).argmin())


def _along(route: np.ndarray, first: int, distance: float) -> np.ndarray:
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    far = along - along[first] >= distance
    far[:first] = False
    return route[far.argmax()] if far.any() else route[-1]


def _beeline(route: np.ndarray, position: np.ndarray, distance: float) -> np.ndarray:
    far = np.hypot(*(route - position).T) >= distance
    return route[far.argmax()] if far.any() else route[-1]


def _yaws(rng: np.random.Generator) -> tuple:
    # Yaws of several turns, errors away from half a turn, where left and right are as good.
    yaw = rng.uniform(-7, 7, 8)
    error = rng.uniform(-2.9, 2.9, 8)
    error[:2] = 0.1, -0.1
    return yaw + error + 2 * np.pi * rng.choice([-1, 1], 8), yaw, 1.5


def _wrapped(error: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * error))


def _wanted(rng: np.random.Generator) -> tuple:
    # Flickers shorter than the hold, and stays longer than it, in turn.
    hold = int(rng.integers(2, 5))
    runs = [hold + 2, hold - 1, 1, hold - 1, 2, hold + 2, 1, hold + 1]
    return np.repeat(np.arange(len(runs)) % 2, runs), hold


def _held(wanted: np.ndarray, hold: int, forget: bool = True) -> np.ndarray:
    active, waiting, answer = int(wanted[0]), 0, []
    for policy in wanted.tolist():
        if policy != active:
            waiting += 1
        elif forget:
            waiting = 0
        if waiting >= hold:
            active, waiting = policy, 0
        answer.append(active)
    return np.array(answer)


QUESTIONS = (
    Question(
        id="ex07.q1",
        name="aim_point",
        points=2,
        title="the point to steer for",
        expects="from the route's vertex nearest to the robot, the first vertex that is at least "
        "`distance` further ALONG the route; the route's last vertex if it ends before.",
        draw=_route,
        truth=lambda route, position, distance: _along(route, _nearest(route, position), distance),
        mistakes=(
            Mistake(
                "a straight-line distance: the first vertex that far from the robot may lie behind "
                "it.",
                _beeline,
            ),
            Mistake(
                "a distance from the start of the route: the robot has driven some of the route "
                "already.",
                lambda route, position, distance: _along(route, 0, distance),
            ),
            Mistake(
                "the nearest vertex itself: a robot that steers for where it is turns on the spot: "
                "look ahead.",
                lambda route, position, distance: route[_nearest(route, position)],
            ),
            Mistake(
                "always the goal: it cuts the corners that the route goes round.",
                lambda route, position, distance: route[-1],
            ),
            Mistake(
                "the vertex before: it stops just short of `distance`.",
                lambda route, position, distance: route[
                    max(_nearest(route, _along(route, _nearest(route, position), distance)) - 1, 0)
                ],
            ),
        ),
        hints=(
            "The length of each edge, then np.cumsum: that is how far along each vertex lies.",
            "Subtract what the nearest vertex has; the first one >= distance is the answer.",
        ),
    ),
    Question(
        id="ex07.q2",
        name="turn_rate",
        points=2,
        title="turn the shorter way",
        expects="3 * (wanted - yaw) with the error brought into [-pi, pi), within -limit ... "
        "limit: never more than half a turn.",
        draw=_yaws,
        examples=((np.array([3.1]), np.array([-3.1]), 1.5),),
        truth=lambda wanted, yaw, limit: np.clip(GAIN * _wrapped(wanted - yaw), -limit, limit),
        mistakes=(
            Mistake(
                "a forgotten wrap: from 179 to -179 degrees is 2 degrees to the left, not 358 to "
                "the right.",
                lambda wanted, yaw, limit: np.clip(GAIN * (wanted - yaw), -limit, limit),
            ),
            Mistake(
                "a turn away from the aim: the error is wanted - yaw; positive turns left.",
                lambda wanted, yaw, limit: np.clip(-GAIN * _wrapped(wanted - yaw), -limit, limit),
            ),
            Mistake(
                "a forgotten limit: no robot turns that fast.",
                lambda wanted, yaw, limit: GAIN * _wrapped(wanted - yaw),
            ),
            Mistake(
                "a forgotten gain: the turn rate is 3 per second times the error.",
                lambda wanted, yaw, limit: np.clip(_wrapped(wanted - yaw), -limit, limit),
            ),
            Mistake(
                "turns that are always to the left: the error was brought into [0, 2 pi); take pi "
                "off again.",
                lambda wanted, yaw, limit: np.clip(
                    GAIN * ((wanted - yaw) % (2 * np.pi)), -limit, limit
                ),
            ),
            Mistake(
                "limit before gain: the limit is for the turn rate, so it comes last.",
                lambda wanted, yaw, limit: GAIN * np.clip(_wrapped(wanted - yaw), -limit, limit),
            ),
        ),
        hints=(
            "(error + pi) % (2 pi) lies in [0, 2 pi).",
            "(wanted - yaw + pi) % (2 pi) - pi is the shorter way.",
        ),
    ),
    Question(
        id="ex07.q3",
        name="active_policies",
        points=3,
        title="switch, but do not flicker",
        expects="the active policy starts as wanted[0]; another one takes over in the step in "
        "which it has been wanted for `hold` steps in a row.",
        draw=_wanted,
        examples=((np.array([0, 1, 0, 1, 1, 1, 1]), 3),),
        truth=lambda wanted, hold: _held(wanted, hold),
        mistakes=(
            Mistake(
                "switching at once: each flicker of P reaches the robot.",
                lambda wanted, hold: wanted,
            ),
            Mistake(
                "a switch one step late: it takes over IN the step that completes the row of "
                "`hold`.",
                lambda wanted, hold: _held(wanted, hold + 1),
            ),
            Mistake(
                "a switch one step early: the row must be `hold` steps long.",
                lambda wanted, hold: _held(wanted, hold - 1),
            ),
            Mistake(
                "a counter that is never reset: in a row means: being wanted no longer sets the "
                "count back to 0.",
                lambda wanted, hold: _held(wanted, hold, forget=False),
            ),
            Mistake(
                "a delay for hysteresis: that is `wanted` some steps later, with every flicker.",
                lambda wanted, hold: np.concatenate((np.full(hold - 1, wanted[0]), wanted))[
                    : len(wanted)
                ],
            ),
        ),
        hints=(
            "Two variables travel along: the active policy, and for how long another was wanted.",
            "wanted == active sets the count to 0; otherwise it grows by 1; at `hold` switch.",
        ),
    ),
)
