"""Exercise 08, "Meet the A1": actuators, observations, mirror images, a joint in motion."""

import numpy as np

from fgtutor.course.checks.question import Mistake, Question

KP, KD, SCALE, LIMIT = 35.0, 0.5, 0.5, 33.5
MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
SIGNS = np.array((-1.0, 1.0, 1.0) * 4)


def _joints(rng: np.random.Generator) -> tuple:
    stance = rng.uniform(-1, 1, 12)
    q = stance + rng.uniform(-0.4, 0.4, 12)
    action = rng.uniform(-2.5, 2.5, 12)
    action[:2] = 4.0, -4.0  # beyond what the motor can give
    return q, rng.uniform(-6, 6, 12), action, stance


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


def _joint(rng: np.random.Generator) -> tuple:
    inertia, damping = float(rng.uniform(0.04, 0.06)), float(rng.uniform(1.0, 1.6))
    return float(rng.uniform(0.5, 1.2)), inertia, 35.0, damping, 15.0, 0.005, 200


def _response(
    target: float,
    inertia: float,
    kp: float,
    kd: float,
    limit: float,
    dt: float,
    steps: int,
    *,
    explicit: bool = False,
    band: float = 0.05,
    entered: bool = False,
    peak: bool = False,
) -> tuple[np.ndarray, float, float]:
    """Step a joint of mass inertia; the options make it wrong."""
    angles, q, dq = np.zeros(steps), 0.0, 0.0
    for i in range(steps):
        before = dq
        dq += dt * min(max(kp * (target - q) - kd * dq, -limit), limit) / inertia
        q += dt * (before if explicit else dq)
        angles[i] = q
    inside = np.abs(angles - target) <= band * abs(target)
    settled = np.flatnonzero(inside) if entered else np.flatnonzero(~inside) + 1
    at = (settled[:1] if entered else settled[-1:]).sum()
    time = np.nan if not inside[-1] else float((at + 1) * dt)
    over = float(angles.max()) - (0.0 if peak else target)
    return angles, over if peak else max(over, 0.0), time


QUESTIONS = (
    Question(
        id="ex08.q1",
        name="joint_torques",
        points=1,
        title="from an action to torques",
        expects="an action of 0 pulls a joint to its stance, an action of 1 to 0.5 rad beyond it; "
        "damping opposes the speed; no torque is larger than 33.5 N m.",
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
        points=1,
        title="where is down, seen from the trunk?",
        expects="the world's (0, 0, -1) in the trunk's frame, R^T (0, 0, -1): level, it is (0, 0, "
        "-1); nose down (pitch +90 degrees), it is (1, 0, 0).",
        draw=_quaternions,
        examples=((np.array([[1.0, 0.0, 0.0, 0.0], [0.5**0.5, 0.0, 0.5**0.5, 0.0]]),),),
        truth=_down,
        mistakes=(
            Mistake(
                "R in place of its transpose: R turns a vector of the trunk into the world; here "
                "the world's is turned into the trunk's frame.",
                lambda q: _down(q * (1, -1, -1, -1)),
            ),
            Mistake(
                "a quaternion read as (x, y, z, w): w comes first, as in MuJoCo.",
                lambda q: _down(np.roll(q, 1, axis=-1)),
            ),
            Mistake("a direction upwards: gravity points to -z.", lambda q: -_down(q)),
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
        points=1,
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
                "front and rear exchanged: the mirror stands along the robot, not across it: FR "
                "changes with FL.",
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
        name="step_response",
        points=3,
        title="a joint that swings to its target",
        expects="each step first changes the speed by torque / inertia * dt, with the torque of "
        "question 1 within the limit, then the angle by the NEW speed; the overshoot is how far "
        "beyond the target the angle got (0 if never), the settling time the end of the first step "
        "from which on the angle stays within 5 % of the target (NaN if it is not there at the "
        "end).",
        draw=_joint,
        examples=(
            (1.0, 0.05, 35.0, 0.0, 33.5, 0.005, 200),  # never settles
            (1.0, 0.05, 35.0, 8.0, 33.5, 0.005, 400),  # never overshoots
        ),
        truth=lambda target, inertia, kp, kd, limit, dt, steps: _response(
            target, inertia, kp, kd, limit, dt, steps
        ),
        mistakes=(
            Mistake(
                "the old speed: update the speed first, and move by the new one, or the swing "
                "gains energy in every step.",
                lambda *case: _response(*case, explicit=True),
            ),
            Mistake(
                "a forgotten limit: the motor gives no more than `limit`.",
                lambda t, i, kp, kd, lim, dt, n: _response(t, i, kp, kd, np.inf, dt, n),
            ),
            Mistake(
                "a forgotten inertia: an acceleration is torque / inertia.",
                lambda t, i, kp, kd, lim, dt, n: _response(t, 1.0, kp, kd, lim, dt, n),
            ),
            Mistake(
                "the first time inside the band: it may swing out again; the joint has settled "
                "when it STAYS inside.",
                lambda *case: _response(*case, entered=True),
            ),
            Mistake(
                "the peak in place of the overshoot: subtract the target.",
                lambda *case: _response(*case, peak=True),
            ),
            Mistake(
                "a band of 2 %: 5 % of the target is asked for.",
                lambda *case: _response(*case, band=0.02),
            ),
        ),
        hints=(
            "A loop of four lines: torque, limit, speed, angle.",
            "inside = np.abs(angles - target) <= 0.05 * abs(target); the last step that is not "
            "inside is the one before the joint has settled.",
            "np.flatnonzero(~inside) lists the steps outside; step i ends at (i + 1) * dt.",
        ),
    ),
)
