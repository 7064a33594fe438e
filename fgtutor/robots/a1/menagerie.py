"""The Unitree A1 of MuJoCo Menagerie: another model of the same robot, made by others.

Gives a `model.A1Config` with which `A1Env` simulates that robot instead, driven by the same
policies. The constants are those of unitree_a1/a1.xml in google-deepmind/mujoco_menagerie on GitHub
(commit 1b428b08), its collision shapes included; its meshes, which only serve drawing, are left
out. Its licence stands beside this file (LICENSE-menagerie, BSD-3-Clause).

It differs from ours in mass (trunk 4.713 kg for 6.0), in shapes (36 for 16, which also touch each
other; the left front hip's, which the file has twice, stands once), in its feet (so soft that the
calf's tip carries a share; with rolling friction), in its joints (damping of 1 to 2 N m s / rad for
0.01, dry friction, clamped targets) and in how it is simulated. The gains of the joint controllers
are ours: the policies command them.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import mujoco
from annotated_types import Interval

from fgtutor.robots.a1.model import (
    CALF_LENGTH,
    FOOT_RADIUS,
    JOINT_RANGES,
    LEGS,
    LINKS,
    STANCE_HEIGHT,
    THIGH_LENGTH,
    A1Config,
    Damping,
    add_joint,
    add_sensors,
    side,
)

HIP_X, HIP_Y, THIGH_Y = 0.183, 0.047, 0.08505
"""Hip joint from the trunk's centre, and the thigh from the hip, m."""
MARGIN = 0.001
"""Distance at which contacts begin, m."""
QUARTER = (1.0, 1.0, 0.0, 0.0)
"""Turns a shape's axis from z to y."""

TRUNK_MASS = 4.713
TRUNK_CENTRE = (0.0, 0.0041, -0.0005)
TRUNK_INERTIA = (0.0158533, 0.0377999, 0.0456542, -3.66e-05, -6.11e-05, -2.75e-05)
HIP_MASS, HIP_INERTIA = 0.696, (0.000807752, 0.00055293, 0.000468983)
HIP_CENTRE = (0.003311, 0.000635, 3.1e-05)
"""Of the left rear leg, m."""
HIP_FRAMES = {
    "FR": (0.507528, 0.506268, 0.491507, 0.494499),
    "FL": (0.494499, 0.491507, 0.506268, 0.507528),
    "RR": (0.491507, 0.494499, 0.507528, 0.506268),
    "RL": (0.506268, 0.507528, 0.494499, 0.491507),
}
"""Principal axes (w, x, y, z)."""
THIGH_MASS, THIGH_INERTIA = 1.013, (0.00555739, 0.00513936, 0.00133944)
THIGH_CENTRE = (-0.003237, 0.022327, -0.027326)
THIGH_FRAME = (0.999125, -0.00256393, -0.0409531, -0.00806091)
"""Of the right legs."""
CALF_MASS, CALF_INERTIA = 0.226, (0.00340344, 0.00339393, 3.54834e-05)
CALF_CENTRE = (0.00472659, 0.0, -0.131975)
CALF_FRAME = (0.706886, 0.017653, 0.017653, 0.706886)


@dataclass(frozen=True, kw_only=True)
class MenagerieConfig(A1Config):
    """What can be chosen about Menagerie's A1; by default it is as it ships, but for the gains."""

    damping: Damping = 2.0
    """Passive joint damping at thigh and calf, N m s / rad."""
    abduction_damping: Damping = 1.0
    """Passive joint damping at the hip, N m s / rad."""
    dry_friction: Damping = 0.2
    """Dry friction of a joint, N m."""
    knee_armature: Damping = 0.01
    """Rotor inertia seen at the knee, kg m^2: that of the other joints."""
    timestep: Annotated[float, Interval(ge=1e-4, le=0.05)] = 0.002
    """One simulation step, s (MuJoCo's default); ten make one control step at 50 Hz."""
    iterations: Annotated[int, Interval(ge=1, le=1000)] = 100
    """Iterations of the solver at most (MuJoCo's default)."""
    cone: Literal["pyramidal", "elliptic"] = "elliptic"
    """Shape of the friction cone."""
    impratio: Annotated[float, Interval(ge=1, le=1000)] = 100.0
    """How much stiffer friction is than the normal force."""
    integrator: Literal["implicitfast", "euler"] = "euler"
    """How velocities are integrated (MuJoCo's default)."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the robot, its controllers and its sensors. `friction` is that of its feet."""
        trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, STANCE_HEIGHT))
        trunk.add_freejoint(name="trunk")
        trunk.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
        trunk.mass, trunk.ipos, trunk.explicitinertial = TRUNK_MASS, TRUNK_CENTRE, True
        trunk.fullinertia = TRUNK_INERTIA
        trunk.add_site(name="imu")
        _add_trunk_shapes(trunk)
        for leg in LEGS:
            _add_leg(spec, trunk, leg, self)
        add_sensors(spec, by_calf=True)


def _add_trunk_shapes(trunk: mujoco.MjsBody) -> None:
    kinds, along_x = mujoco.mjtGeom, (1.0, 0.0, 1.0, 0.0)
    _add_shape(trunk, kinds.mjGEOM_BOX, size=(0.125, 0.04, 0.057))
    for y in (-0.04, 0.04):
        place = {"pos": (0.0, y, 0.0), "quat": along_x}
        _add_shape(trunk, kinds.mjGEOM_CYLINDER, size=(0.058, 0.125, 0.0), **place)
    _add_shape(trunk, kinds.mjGEOM_BOX, pos=(0.25, 0.0, 0.0), size=(0.005, 0.06, 0.05))
    for place, size, quat in (
        ((0.25, 0.06, -0.01), (0.009, 0.035, 0.0), (1.0, 0.0, 0.0, 0.0)),
        ((0.25, -0.06, -0.01), (0.009, 0.035, 0.0), (1.0, 0.0, 0.0, 0.0)),
        ((0.25, 0.0, -0.05), (0.005, 0.06, 0.0), QUARTER),
        ((0.255, 0.0, 0.0355), (0.021, 0.052, 0.0), QUARTER),
    ):
        _add_shape(trunk, kinds.mjGEOM_CAPSULE, pos=place, size=size, quat=quat)


def _add_leg(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, leg: str, config: MenagerieConfig) -> None:
    kinds, (x, y) = mujoco.mjtGeom, side(leg)
    hip = trunk.add_body(name=f"{leg}_hip", pos=(x * HIP_X, y * HIP_Y, 0.0))
    thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, y * THIGH_Y, 0.0))
    calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -THIGH_LENGTH))
    for body, mass, centre, inertia, frame in (
        (hip, HIP_MASS, HIP_CENTRE, HIP_INERTIA, HIP_FRAMES[leg]),
        (thigh, THIGH_MASS, THIGH_CENTRE, THIGH_INERTIA, THIGH_FRAME),
        (calf, CALF_MASS, CALF_CENTRE, CALF_INERTIA, CALF_FRAME),
    ):
        body.mass, body.inertia, body.explicitinertial = mass, inertia, True
        body.ipos, body.iquat = centre, frame
    # Hips are mirrored in both planes; thighs in y = 0, where x and z of a quaternion change sign.
    hip.ipos = (-x * HIP_CENTRE[0], y * HIP_CENTRE[1], HIP_CENTRE[2])
    thigh.ipos = (THIGH_CENTRE[0], -y * THIGH_CENTRE[1], THIGH_CENTRE[2])
    w, i, j, k = THIGH_FRAME
    thigh.iquat = (w, -y * i, j, -y * k)
    for link, body in zip(LINKS, (hip, thigh, calf), strict=True):
        damping = config.abduction_damping if link == "hip" else config.damping
        actuator = add_joint(spec, body, leg, link, config, damping)
        actuator.ctrlrange, actuator.ctrllimited = JOINT_RANGES[link], True

    _add_shape(
        hip, kinds.mjGEOM_CYLINDER, pos=(0.0, y * 0.055, 0.0), size=(0.04, 0.04, 0.0), quat=QUARTER
    )
    _add_rod(thigh, 0.015, (-0.02, 0.0, 0.0), (-0.02, 0.0, -0.16))
    _add_rod(thigh, 0.015, (0.0, 0.0, 0.0), (-0.02, 0.0, -0.1))
    knee = (0.0, 0.0, -THIGH_LENGTH)
    _add_rod(thigh, 0.015, (-0.02, 0.0, -0.16), knee, name=f"{leg}_knee")
    _add_rod(calf, 0.01, (0.0, 0.0, 0.0), (0.02, 0.0, -0.13), name=f"{leg}_shin")
    foot = (0.0, 0.0, -CALF_LENGTH)
    _add_rod(calf, 0.01, (0.02, 0.0, -0.13), foot)
    _add_shape(
        calf,
        kinds.mjGEOM_SPHERE,
        name=f"{leg}_foot",
        pos=foot,
        size=(FOOT_RADIUS, 0.0, 0.0),
        # Soft as rubber, and its friction counts, whatever the ground's: sliding, spin, rolling.
        solimp=(0.015, 1.0, 0.031, 0.5, 2.0),
        priority=1,
        condim=6,
        friction=(config.friction, 0.02, 0.01),
    )
    calf.add_site(name=f"{leg}_foot", pos=foot)


def _add_rod(
    body: mujoco.MjsBody,
    radius: float,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    **properties: Any,
) -> None:
    size = (radius, 0.0, 0.0)
    _add_shape(body, mujoco.mjtGeom.mjGEOM_CAPSULE, size=size, fromto=start + end, **properties)


def _add_shape(body: mujoco.MjsBody, kind: mujoco.mjtGeom, **properties: Any) -> None:
    """Add a shape that touches the ground and the robot's other links."""
    common = {"friction": (0.6, 0.005, 0.0001), "margin": MARGIN, "group": 3}
    body.add_geom(type=kind, **common | properties)
