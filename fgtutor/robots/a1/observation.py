"""What the A1 observes and how it acts: the layout of both, their scales, noise and mirror image.

Gives plain values. The environment (`env`) measures by them, policies are mirrored by them, and
`fgtutor export` writes them down for other programs. Scales and noise are legged_gym's (Rudin et
al., CoRL 2021).
"""

import numpy as np

from fgtutor.patches import HOLE_DEPTH, SPACING, PatchGrid
from fgtutor.policies.symmetry import Mirror, join
from fgtutor.robots.a1.model import (
    JOINTS,
    MIRROR,
    MIRROR_SIGNS,
    STANCE,
    STANCE_HEIGHT,
    A1Config,
)
from fgtutor.robots.base import Layout, part

SCAN_GRID = PatchGrid(ahead=0.9, behind=0.5, half_width=0.4)
"""What the policy sees: 15 x 9 points, mostly ahead."""
SCAN_LIMIT = 0.8
"""The scan ends this far above and below the trunk's centre, m."""
NOISE = {
    "velocity": (3, 0.1, 2.0),
    "gyroscope": (3, 0.2, 0.25),
    "gravity": (3, 0.05, 1.0),
    "joints": (12, 0.01, 1.0),
    "joint rates": (12, 1.0, 0.05),
    "last action": (12, 0.0, 1.0),
    "clock": (2, 0.0, 1.0),
}
"""What the policy feels, in order: how many numbers, largest noise in their own unit (m/s, rad/s,
g, rad, rad/s), and the scale the policy sees them at. Noise and scales as in legged_gym."""
UNFELT = (0, 1, 2)
"""What no sensor of the A1 measures: its velocity. It has to be estimated."""
FELT = tuple(range(3, 3 + sum(count for count, *_ in NOISE.values())))
"""What a policy that estimates it remembers instead: the rest of what is felt, and the command."""
SCAN_NOISE, SCAN_SCALE = 0.02, 3.0
"""Largest noise of a scanned height, m, and the scale the policy sees heights at."""


def mirror() -> Mirror:
    """Return how the A1's mirror image in the plane y = 0 observes and acts."""
    rows, columns = SCAN_GRID.shape
    parts = [  # (index, sign) of each part of the observation, in order
        ((0, 1, 2), (1, -1, 1)),  # velocity: a vector
        ((0, 1, 2), (-1, 1, -1)),  # rotation: a pseudovector
        ((0, 1, 2), (1, -1, 1)),  # direction of gravity
        *[(MIRROR, MIRROR_SIGNS)] * 3,  # joints, their rates, last action
        ((0, 1), (-1, -1)),  # clock: the mirrored trot is half a cycle on
        ((0, 1, 2), (1, -1, -1)),  # command (vx, vy, wz)
        (
            tuple(r * columns + c for r in range(rows) for c in reversed(range(columns))),
            (1,) * rows * columns,
        ),
    ]
    index, sign = join(parts)
    return Mirror(
        observation_index=index,
        observation_sign=sign,
        action_index=MIRROR,
        action_sign=MIRROR_SIGNS,
    )


def layout(config: A1Config, action_scale: float, gait: float) -> Layout:
    """Describe each part of the observation, in order, and the action.

    Args:
        config: The joint controllers' gains.
        action_scale: Change of a joint's target that an action of 1 asks for, rad.
        gait: Gait cycles per second.
    """
    meaning = {
        "velocity": "the trunk's velocity in its own frame (x ahead, y left, z up), m/s; no sensor "
        "of the A1 measures it: it has to be estimated",
        "gyroscope": "the trunk's rotation rate in its own frame, rad/s",
        "gravity": "the direction of gravity in the trunk's frame, a unit vector",
        "joints": "angles, rad, in the order of action.joints",
        "joint rates": "the same joints' speeds, rad/s",
        "last action": "the policy's previous answer; zeros at the start",
        "clock": f"sin and cos of 2 pi {gait:g} Hz t, from t = 0 at the start",
    }
    parts = [
        part(name, size, meaning[name], scale=scale, offset=STANCE if name == "joints" else 0.0)
        for name, (size, _, scale) in NOISE.items()
    ]
    parts.append(part("command", 3, "wanted vx, vy (m/s, yaw frame) and turn rate (rad/s)"))
    scan = part(
        "scan",
        SCAN_GRID.num_points,
        "height of the ground minus that of the trunk's centre at `points`: ahead and left of the "
        f"trunk's centre in the yaw frame, m; on a map in which holes end {HOLE_DEPTH:g} m below "
        f"the ground around them, smoothed by a triangle reaching {SPACING:g} m to each side",
        scale=SCAN_SCALE,
        offset=-STANCE_HEIGHT,
        limits=(-SCAN_LIMIT, SCAN_LIMIT),
    )
    parts.append(scan | {"points": np.round(SCAN_GRID.points.numpy(), 4).tolist()})
    return parts, {
        "size": len(JOINTS),
        "meaning": "joint targets, rad: offset + scale * action",
        "joints": list(JOINTS),
        "offset": list(STANCE),
        "scale": action_scale,
        "stiffness": config.kp,
        "damping": config.kd,
        "torque limit": config.torque_limit,
    }
