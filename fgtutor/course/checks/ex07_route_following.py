"""Exercise 07, "Drive the plan": pure pursuit, turn rates, hysteresis (Sec. III-C)."""

import numpy as np
from numpy.typing import ArrayLike

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


_SHORT = (np.array([[0.0, 0.0], [0.2, 0.0], [0.4, 0.1]]), np.array([0.22, 0.01]), 0.5)
"""A route that ends before the distance is driven."""
_HAIRPIN = (
    np.array([[0, 0], [0, 0.2], [0, 0.4], [0.1, 0.4], [0.1, 0.2], [0.1, 0.0]]),
    np.array([0.0, 0.19]),
    0.3,
)


def _to_nowhere(route: np.ndarray, position: np.ndarray, distance: float) -> np.ndarray:
    first = _nearest(route, position)
    left = np.hypot(*np.diff(route[first:], axis=0).T).sum()
    return _along(route, first, distance) if left >= distance else np.full(2, np.nan)


def _beeline(route: np.ndarray, position: np.ndarray, distance: float) -> np.ndarray:
    far = np.hypot(*(route - position).T) >= distance
    return route[far.argmax()] if far.any() else route[-1]


def _yaws(rng: np.random.Generator) -> tuple:
    # Yaws of several turns, errors away from half a turn, where left and right are as good.
    yaw = rng.uniform(-20, 20, 8)
    error = rng.uniform(-2.9, 2.9, 8)
    error[:4] = 0.1, -0.1, 0.2, -0.2
    turns = rng.choice([-1, 1], 8)
    turns[2:4] = 3, -2  # wanted and yaw several turns apart
    return yaw + error + 2 * np.pi * turns, yaw, 1.5


def _wrapped(error: ArrayLike) -> np.ndarray:
    return np.angle(np.exp(1j * np.asarray(error)))


def _wrapped_once(error: np.ndarray) -> np.ndarray:
    return error - 2 * np.pi * (error >= np.pi) + 2 * np.pi * (error < -np.pi)


def _track(rng: np.random.Generator) -> tuple:
    turns = rng.uniform(-0.5, 0.5, 12)
    yaw = np.cumsum(turns) + rng.uniform(-3, 3)
    route = np.cumsum(0.2 * np.stack((np.cos(yaw), np.sin(yaw)), axis=-1), axis=0)
    pose = np.array([*(route[0] + rng.uniform(-0.05, 0.05, 2)), yaw[0] + rng.uniform(0.5, 1.0)])
    return route, pose, 0.8, 0.3, 1.5, 0.15, 0.04, 120


def _driven(
    route: np.ndarray,
    pose: np.ndarray,
    speed: float,
    distance: float,
    limit: float,
    near: float,
    dt: float,
    most: int,
    *,
    beeline: bool = False,
    stop: bool = True,
    late: bool = False,
) -> np.ndarray:
    """Drive in the complex plane; the options make it wrong."""
    place, yaw, poses = complex(*pose[:2]), float(pose[2]), [np.array(pose, dtype=float)]
    goal = complex(*route[-1])
    for _ in range(most):
        if stop and abs(goal - place) <= near:
            break
        here = np.array([place.real, place.imag])
        aim = _beeline if beeline else lambda r, p, d: _along(r, _nearest(r, p), d)
        error = np.angle(complex(*aim(route, here, distance)) - place) - yaw
        rate = float(np.clip(GAIN * _wrapped(error), -limit, limit))
        before = yaw
        yaw += rate * dt
        place += speed * dt * np.exp(1j * (before if late else yaw))
        poses.append(np.array([place.real, place.imag, yaw]))
    return np.array(poses)


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
        points=1,
        title="the point to steer for",
        expects="from the route's vertex nearest to the robot, the first vertex that is at least "
        "`distance` further ALONG the route; the route's last vertex if it ends before.",
        draw=_route,
        examples=(_SHORT, _HAIRPIN),
        truth=lambda route, position, distance: _along(route, _nearest(route, position), distance),
        mistakes=(
            Mistake(
                "no answer at the end of the route: where less than `distance` is left, steer for "
                "its last vertex.",
                _to_nowhere,
            ),
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
        points=1,
        title="turn towards it",
        expects="the robot turns towards `wanted` on the side that is nearer, 3 rad/s for every "
        "radian that is left, and never faster than `limit`.",
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
                "a wrap of one turn: wanted and yaw may be several turns apart: use %, not a "
                "single +- 2 pi.",
                lambda wanted, yaw, limit: np.clip(
                    GAIN * _wrapped_once(wanted - yaw), -limit, limit
                ),
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
                "a limit on the error: the limit is for the turn rate, so it comes after the gain.",
                lambda wanted, yaw, limit: GAIN * np.clip(_wrapped(wanted - yaw), -limit, limit),
            ),
        ),
        hints=(
            "(error + pi) % (2 pi) lies in [0, 2 pi).",
            "(wanted - yaw + pi) % (2 pi) - pi lies on the nearer side.",
        ),
    ),
    Question(
        id="ex07.q3",
        name="active_policies",
        points=2,
        title="switch, but do not flicker",
        expects="the active policy starts as wanted[0]; a different one takes over in the step in "
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
                "a mere delay: that is `wanted` some steps later, with every flicker still in it.",
                lambda wanted, hold: np.concatenate((np.full(hold - 1, wanted[0]), wanted))[
                    : len(wanted)
                ],
            ),
        ),
        hints=(
            "Two variables travel along: the active policy, and for how long a different one was "
            "wanted.",
            "wanted == active sets the count to 0; otherwise it grows by 1; at `hold` switch.",
        ),
    ),
    Question(
        id="ex07.q4",
        name="drive",
        points=3,
        title="a pure-pursuit follower",
        expects="the poses [n + 1, 3] from the given one on; each step turns towards the aim point "
        "by turn_rate * dt and then moves speed * dt along the NEW yaw; it ends once the robot is "
        "within `near` of the route's last vertex, or after `most` steps.",
        draw=_track,
        examples=(
            # Turns too slowly ever to get there: the steps run out.
            (
                np.array([[0.0, 0.0], [0.5, 0.0]]),
                np.array([0.0, 0.1, 3.0]),
                *(0.5, 0.2, 0.2, 0.05, 0.1, 30),
            ),
            # Is there already.
            (
                np.array([[0.0, 0.0], [0.5, 0.0]]),
                np.array([0.49, 0.0, 0.0]),
                *(0.5, 0.2, 1.5, 0.05, 0.1, 30),
            ),
        ),
        truth=lambda route, pose, speed, distance, limit, near, dt, most: _driven(
            route, pose, speed, distance, limit, near, dt, most
        ),
        mistakes=(
            Mistake(
                "a missing first pose: the pose that was given comes first.",
                lambda *case: _driven(*case)[1:],
            ),
            Mistake(
                "driving on at the goal: it ends as soon as the robot is within `near` of the last "
                "vertex.",
                lambda *case: _driven(*case, stop=False),
            ),
            Mistake(
                "an aim point behind the robot: look for it ALONG the route, from the nearest "
                "vertex on.",
                lambda *case: _driven(*case, beeline=True),
            ),
            Mistake(
                "moving before turning: the step goes along the new yaw.",
                lambda *case: _driven(*case, late=True),
            ),
            Mistake(
                "a turn without a limit: the robot turns at most `limit` rad/s.",
                lambda r, p, v, d, w, n, dt, m: _driven(r, p, v, d, w / dt, n, dt, m),
            ),
            Mistake(
                "one step too few: `most` steps are allowed.",
                lambda r, p, v, d, w, n, dt, m: _driven(r, p, v, d, w, n, dt, m - 1),
            ),
            Mistake(
                "speed without dt: a step lasts dt seconds.",
                lambda r, p, v, d, w, n, dt, m: _driven(r, p, v / dt, d, w, n, dt, m),
            ),
        ),
        hints=(
            "A loop over range(most): look whether the goal is near, find the aim point, the "
            "bearing, the turn rate; turn, move, write the pose down.",
            "np.arctan2(aim[1] - y, aim[0] - x) is the bearing of the aim point.",
            "Your own aim_point and turn_rate do two of the steps.",
        ),
        rtol=1e-4,
        atol=1e-6,
    ),
)
