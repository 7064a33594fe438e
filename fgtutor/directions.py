"""The d = 8 headings: their order, yaw angles and cell steps (paper, Sec. III-B).

Heading k points k * 45 degrees counter-clockwise from +x, so 0 = +x, 2 = +y, 4 = -x, 6 = -y. This
is the only file that knows the order; everything else asks it.
"""

import math

import numpy as np
from jaxtyping import Bool

NUM_HEADINGS = 8
"""d, the number of headings (paper, Sec. III-B)."""

YAWS = np.arange(NUM_HEADINGS) * (math.pi / 4)
"""Yaw of each heading, radians counter-clockwise from +x (REP-103)."""

STEPS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])
"""Cell step (dix, diy) of each heading."""

STEP_LENGTHS = np.hypot(STEPS[:, 0], STEPS[:, 1])
"""Length of each step in cells: 1 along an axis, sqrt(2) along a diagonal."""

NAMES = ("+x", "+x+y", "+y", "-x+y", "-x", "-x-y", "-y", "+x-y")
"""How figures and messages name the headings."""


def steps_within(usable: Bool[np.ndarray, "nx ny"]) -> Bool[np.ndarray, "nx ny 8"]:
    """Return which steps start from a usable cell and end on one; none leads off the map."""
    nx, ny = usable.shape
    around = np.pad(usable, 1, constant_values=False)
    ends = [around[1 + dx : 1 + dx + nx, 1 + dy : 1 + dy + ny] for dx, dy in STEPS]
    return np.stack(ends, axis=-1) & usable[..., None]
