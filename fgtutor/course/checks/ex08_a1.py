"""Exercise 08, "Meet the A1": actuators, observations, mirror images, rewards."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

KP, KD, SCALE, LIMIT = 35.0, 0.5, 0.5, 33.5
MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
SIGNS = np.array((-1.0, 1.0, 1.0) * 4)


def _joints(rng: np.random.Generator) -> tuple:
    stance = rng.uniform(-1, 1, 12)
    q = stance + rng.uniform(-0.4, 0.4, 12)
    return q, rng.uniform(-6, 6, 12), rng.uniform(-2.5, 2.5, 12), stance


def _torque(
    q: np.ndarray,
    dq: np.ndarray,
    action: np.ndarray,
    stance: np.ndarray,
    *,
    scale: float = SCALE,
    damping: float = -KD,
    limit: float = LIMIT,
) -> np.ndarray:
    return np.clip(KP * (stance + scale * action - q) + damping * dq, -limit, limit)


def _quaternions(rng: np.random.Generator) -> tuple:
    quaternion = rng.normal(0, 1, (5, 4))
    return (quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),)


def _down(quaternion: np.ndarray) -> np.ndarray:
    """The third row of the rotation matrix, turned downwards."""
    w, x, y, z = quaternion.T
    return -np.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=-1)


def _terms(rng: np.random.Generator) -> tuple:
    terms = rng.uniform(0, 1, (6, 4))
    terms[:2, 2:] += 3  # two robots whose penalties outweigh what they gain
    return terms, np.array([1.2, 0.5, -2.0, -0.5]), 0.02


QUESTIONS = (
    Question(
        id="ex08.q1",
        name="joint_torques",
        points=3,
        title="from an action to torques",
        expects="torque = 35 (stance + 0.5 action - q) - 0.5 dq, no larger than 33.5 N m either "
        "way: an action moves the target AROUND the stance, and damping opposes the speed.",
        draw=_joints,
        truth=lambda q, dq, action, stance: _torque(q, dq, action, stance),
        mistakes=(
            Mistake(
                "a forgotten limit: the motor gives 33.5 N m and no more.",
                lambda q, dq, a, s: _torque(q, dq, a, s, limit=np.inf),
            ),
            Mistake(
                "damping that drives: damping opposes the joint's speed: - kd * dq.",
                lambda q, dq, a, s: _torque(q, dq, a, s, damping=KD),
            ),
            Mistake(
                "a forgotten stance: an action of 0 means: stand. The target is stance + 0.5 * "
                "action.",
                lambda q, dq, a, s: _torque(q, dq, a, 0 * s),
            ),
            Mistake(
                "a forgotten action scale: an action of 1 moves the target by 0.5 rad.",
                lambda q, dq, a, s: _torque(q, dq, a, s, scale=1.0),
            ),
            Mistake(
                "a spring that pushes away: the spring pulls q towards the target: target - q.",
                lambda q, dq, a, s: np.clip(KP * (q - s - SCALE * a) - KD * dq, -LIMIT, LIMIT),
            ),
            Mistake(
                "a forgotten damping: without - kd * dq the leg swings.",
                lambda q, dq, a, s: _torque(q, dq, a, s, damping=0.0),
            ),
        ),
        hints=(
            "First the target angle, then the spring, then the damper, then the limit.",
            "np.clip(torque, -33.5, 33.5)",
        ),
    ),
    Question(
        id="ex08.q2",
        name="gravity_in_body",
        points=2,
        title="which way is down, seen from the trunk?",
        expects="the world's (0, 0, -1) in the trunk's frame, R^T (0, 0, -1): level, it is (0, 0, "
        "-1); nose down (pitch +90 degrees), it is (1, 0, 0).",
        draw=_quaternions,
        examples=((np.array([[1.0, 0.0, 0.0, 0.0], [0.5**0.5, 0.0, 0.5**0.5, 0.0]]),),),
        truth=_down,
        mistakes=(
            Mistake(
                "R for its transpose: that turns a vector of the trunk into the world; here it is "
                "the other way round.",
                lambda q: _down(q * (1, -1, -1, -1)),
            ),
            Mistake(
                "a quaternion read as (x, y, z, w): w comes first, as in MuJoCo.",
                lambda q: _down(np.roll(q, 1, axis=-1)),
            ),
            Mistake("up for down: gravity points to -z.", lambda q: -_down(q)),
            Mistake(
                "the world's own down: nothing was turned: that is the same for every posture.",
                lambda q: np.tile((0.0, 0.0, -1.0), (len(q), 1)),
            ),
        ),
        hints=(
            "R^T (0, 0, -1) is minus the third ROW of R.",
            "That row is (2 (xz - wy), 2 (yz + wx), 1 - 2 (x^2 + y^2)).",
        ),
        atol=1e-6,
    ),
    Question(
        id="ex08.q3",
        name="mirrored",
        points=2,
        title="the robot's mirror image",
        expects="left and right legs change places (FR with FL, RR with RL), hip angles change "
        "sign, thighs and calves do not; mirroring twice changes nothing.",
        draw=lambda rng: (rng.uniform(-1, 1, (3, 12)),),
        truth=lambda joints: joints[:, list(MIRROR)] * SIGNS,
        mistakes=(
            Mistake(
                "forgotten signs: a hip that swings outwards to the left swings outwards to the "
                "right in the mirror.",
                lambda j: j[:, list(MIRROR)],
            ),
            Mistake("legs that stay: the right leg's image is a left leg.", lambda j: j * SIGNS),
            Mistake(
                "front for rear: the mirror stands along the robot, not across it: FR changes with "
                "FL.",
                lambda j: np.roll(j, 6, axis=-1) * SIGNS,
            ),
            Mistake(
                "all signs turned: knees bend the same way in the mirror.",
                lambda j: -j[:, list(MIRROR)],
            ),
            Mistake(
                "the order turned around: within a leg the order stays hip, thigh, calf.",
                lambda j: j[:, ::-1] * SIGNS[::-1],
            ),
        ),
        hints=(
            "joints.reshape(-1, 4, 3) is [robot, leg, joint], legs in the order FR FL RR RL.",
            "Take the legs [1, 0, 3, 2], multiply by (-1, 1, 1), and reshape back.",
        ),
    ),
    Question(
        id="ex08.q4",
        name="reward",
        points=2,
        title="many terms, one reward",
        expects="the weighted sum of all terms of a robot, not below 0, times dt: weights are per "
        "second, and a robot never earns by ending its episode.",
        draw=_terms,
        truth=lambda terms, weights, dt: np.maximum(terms @ weights, 0.0) * dt,
        mistakes=(
            Mistake(
                "a forgotten floor: when every step costs, falling over early is the best a robot "
                "can do.",
                lambda t, w, dt: (t @ w) * dt,
            ),
            Mistake(
                "a floor under each term: then penalties count nothing; the floor is for the sum.",
                lambda t, w, dt: np.maximum(t * w, 0).sum(axis=-1) * dt,
            ),
            Mistake(
                "a forgotten dt: weights are per second, a step lasts dt.",
                lambda t, w, dt: np.maximum(t @ w, 0),
            ),
            Mistake(
                "mean for sum: terms add up.",
                lambda t, w, dt: np.maximum((t * w).mean(axis=-1), 0) * dt,
            ),
            Mistake(
                "one reward for all robots: each row of terms is a robot: sum over the last axis.",
                lambda t, w, dt: max((t * w).sum(), 0) * dt,
            ),
        ),
        hints=(
            "terms @ weights is one number per robot.",
            "np.maximum(..., 0.0) first, then times dt.",
        ),
    ),
)
