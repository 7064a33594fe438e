"""The Unitree A1 as a MuJoCo model, on terrain: its published constants and its controllers.

Reads the terrain as boxes or as an elevation map; gives an `MjSpec` for `physics.Physics`. The
constants come from the maker's description, robots/a1_description/urdf/a1.urdf in
unitreerobotics/unitree_ros on GitHub ("URDF" below), where no other source is named.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import Interval
from jaxtyping import Float

from fgtutor.elevation import ElevationMap
from fgtutor.io.validation import check_fields
from fgtutor.robots.a1.ground import add_box, add_ground, add_heightfield, blocky
from fgtutor.world.boxes import Box
from fgtutor.world.terrain import World

Gain = Annotated[float, Interval(gt=0, le=1000)]
"""A stiffness or a torque."""
Damping = Annotated[float, Interval(ge=0, le=100)]
"""A damping, an inertia or a dry friction."""
Solver = Literal["newton", "cg", "pgs"]
"""How MuJoCo solves contacts."""

LEGS = ("FR", "FL", "RR", "RL")
"""Legs in the order of every array (F front, R rear; R right, L left), as in Unitree's SDK."""
LINKS = ("hip", "thigh", "calf")
"""Joints of a leg in order: abduction about x, then hip and knee flexion about y."""
JOINTS = tuple(f"{leg}_{link}" for leg in LEGS for link in LINKS)
"""The 12 joints and actuators in the order of qpos[7:], qvel[6:] and ctrl."""
MIRROR = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
"""For each joint, the index of its mirror image in the plane y = 0."""
MIRROR_SIGNS = (-1.0, 1.0, 1.0) * 4
"""Factor that mirrors an angle: abduction changes sign, flexion does not."""

LEG_X, LEG_Y = 0.1805, 0.047
"""Hip joint from the trunk's centre, ahead and to the side, m (URDF)."""
HIP_OFFSET = 0.0838
"""Sideways distance from the abduction axis to the thigh, m (URDF)."""
THIGH_LENGTH = CALF_LENGTH = 0.2
"""Length of thigh and calf, m (URDF)."""
FOOT_RADIUS = 0.02
"""Radius of the foot, m (URDF)."""
TRUNK_SIZE = (0.267, 0.194, 0.114)
"""Length, width and height of the trunk's hull, m (URDF: a box between two cylinders)."""

JOINT_RANGES = {
    "hip": (-0.802851455917, 0.802851455917),
    "thigh": (-1.0471975512, 4.18879020479),
    "calf": (-2.69653369433, -0.916297857297),
}
"""Limits of each joint, rad (URDF)."""

STANCE = (-0.1, 0.9, -1.7, 0.1, 0.9, -1.7, -0.1, 1.0, -1.7, 0.1, 1.0, -1.7)
"""Joint angles the robot stands in and actions are relative to, rad (legs slightly apart)."""
STANCE_HEIGHT = 0.29
"""Height of the trunk's centre over flat ground in the stance, before the springs sag, m."""


@dataclass(frozen=True)
class Inertia:
    """Mass properties of one link in its own frame."""

    mass: float
    """Mass, kg."""
    centre: tuple[float, float, float]
    """Centre of mass, m."""
    moments: tuple[float, float, float, float, float, float]
    """ixx, iyy, izz, ixy, ixz, iyz about the centre of mass, kg m^2."""


# All from the URDF. Its trunk weighs 6.0 kg; mujoco_menagerie's A1, made from an older file, has
# 4.713 kg and is otherwise the same. Leg links are given for the left front leg.
TRUNK = Inertia(
    6.0, (0.0, 0.0041, -0.0005), (0.0158533, 0.0377999, 0.0456542, -3.66e-05, -6.11e-05, -2.75e-05)
)
HIP = Inertia(
    0.696,
    (-0.003311, 0.000635, 3.1e-05),
    (0.000469246, 0.00080749, 0.000552929, -9.409e-06, -3.42e-07, -4.66e-07),
)
THIGH = Inertia(
    1.013,
    (-0.003237, -0.022327, -0.027326),
    (0.005529065, 0.005139339, 0.001367788, 4.825e-06, 0.000343869, 2.2448e-05),
)
CALF = Inertia(
    0.166,
    (0.006435, 0.0, -0.107388),
    (0.002997972, 0.003014022, 3.2426e-05, 0.0, -0.000141163, 0.0),
)
FOOT = Inertia(0.06, (0.0, 0.0, -CALF_LENGTH), (9.6e-06, 9.6e-06, 9.6e-06, 0.0, 0.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class A1Config:
    """What can be chosen about the A1 and its simulation; the rest is the robot itself."""

    kp: Gain = 35.0
    """Stiffness of the joint controllers, N m / rad (28 to 40 are usual in published A1 work)."""
    kd: Damping = 0.5
    """Damping of the joint controllers, N m s / rad."""
    torque_limit: Gain = 33.5
    """Highest joint torque, N m (URDF)."""
    armature: Damping = 0.01
    """Rotor inertia seen at abduction and hip joints, kg m^2 (mujoco_menagerie's A1)."""
    knee_armature: Damping = 0.02
    """Rotor inertia seen at the knee, behind its additional linkage, kg m^2."""
    damping: Damping = 0.01
    """Passive joint damping, N m s / rad (URDF)."""
    dry_friction: Damping = 0.0
    """Dry friction of a joint, N m. The URDF's 0.2 is left out: it would add 12 rows to every
    contact problem for less than 1 % of the torque limit."""
    friction: Annotated[float, Interval(gt=0, le=5)] = 0.8
    """Sliding friction on any terrain (mujoco_menagerie's A1 foot). To randomise it, write
    `physics.parameter("opt.o_friction")[:, :2]`."""
    timestep: Annotated[float, Interval(ge=1e-4, le=0.05)] = 0.005
    """One simulation step, s; four make one control step at 50 Hz."""
    iterations: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Iterations of the solver at most; more than 5 of Newton's change nothing visible, and a GPU
    back end needs few."""
    solver: Solver = "newton"
    """How contacts are solved."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Shape of the friction cone."""
    impratio: Annotated[float, Interval(ge=1, le=1000)] = 1.0
    """How much stiffer friction is than the normal force, with an elliptic cone."""
    integrator: Literal["implicitfast", "euler"] = "implicitfast"
    """How velocities are integrated."""

    def __post_init__(self) -> None:
        check_fields(self)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the robot, its controllers and its sensors; another model of it does so its way."""
        # One friction for every contact, kept in the options: given per geom, randomising it would
        # copy an array as long as the terrain into every simulation at every call.
        spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_OVERRIDE)
        spec.option.o_friction = (self.friction, self.friction, 0.005, 0.0001, 0.0001)
        _add_robot(spec, self)


SENSORS = {
    "foot_force": (4, 3),
    "foot_position": (4, 3),
    "foot_velocity": (4, 3),
    "leg_contact": (4, 2),
    "trunk_contact": (1, 1),
    "accelerometer": (1, 3),
}
"""Groups of sensors in the order of the sensor array: how many, and numbers each. Legs as in LEGS.

foot_force: what the ground pushes the foot with, world frame, N; foot_position and foot_velocity:
centre of the foot, world frame, m and m/s; leg_contact: number of contacts of knee and of shin;
trunk_contact: number of contacts of the trunk; accelerometer: trunk frame, m/s^2, +g at rest."""


def sensor_slices() -> dict[str, slice]:
    """Return where each group of `SENSORS` lies in the sensor array."""
    slices, start = {}, 0
    for name, (count, width) in SENSORS.items():
        slices[name] = slice(start, start + count * width)
        start += count * width
    return slices


def combined(first: Inertia, second: Inertia) -> Inertia:
    """Return the inertia of two links welded together (parallel-axis theorem)."""
    mass = first.mass + second.mass
    centre = (first.mass * np.array(first.centre) + second.mass * np.array(second.centre)) / mass
    total = np.zeros((3, 3))
    for link in (first, second):
        offset = np.array(link.centre) - centre
        total += _matrix(link.moments)
        total += link.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    rows, columns = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
    x, y, z = centre.tolist()
    ixx, iyy, izz, ixy, ixz, iyz = total[rows, columns].tolist()
    return Inertia(mass, (x, y, z), (ixx, iyy, izz, ixy, ixz, iyz))


def mirrored(link: Inertia, x: int, y: int) -> Inertia:
    """Return the inertia reflected to the leg on side (x, y), each +1 or -1 (+1: front, left)."""
    cx, cy, cz = link.centre
    ixx, iyy, izz, ixy, ixz, iyz = link.moments
    return Inertia(link.mass, (x * cx, y * cy, cz), (ixx, iyy, izz, x * y * ixy, x * ixz, y * iyz))


def _matrix(moments: tuple[float, ...]) -> Float[np.ndarray, "3 3"]:
    ixx, iyy, izz, ixy, ixz, iyz = moments
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])


def build_spec(
    boxes: Iterable[Box] = (),
    heightfield: ElevationMap | None = None,
    *,
    config: A1Config | None = None,
) -> mujoco.MjSpec:
    """Return the A1 on the given terrain; on an endless flat floor if none is given.

    Boxes have exact edges and are faster; a height field takes any filled map. Raises `ConfigError`
    if the height field has unknown cells.
    """
    config = config or A1Config()
    boxes = tuple(boxes)
    spec = mujoco.MjSpec()
    spec.modelname = "a1"
    spec.compiler.degree = False
    _set_options(spec, config)
    config.add_to(spec)
    for box in boxes:
        add_box(spec, box)
    if heightfield is not None:
        add_heightfield(spec, heightfield)
    elif not boxes:
        add_ground(spec, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0))
    key = spec.add_key(name="stance")
    key.qpos = (0.0, 0.0, STANCE_HEIGHT, 1.0, 0.0, 0.0, 0.0, *STANCE)
    key.ctrl = STANCE
    return spec


def world_spec(world: World, model: A1Config) -> mujoco.MjSpec:
    """Return the model of the world: boxes if its ground is made of blocks, else a height field."""
    tiles = [tile for row in world.tiles for tile in row]
    if all(tile.boxes or blocky(tile.elevation) for tile in tiles):
        return build_spec(world.boxes, config=model)
    return build_spec(heightfield=world.elevation.filled(), config=model)


def _set_options(spec: mujoco.MjSpec, config: A1Config) -> None:
    option = spec.option
    option.timestep = config.timestep
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{config.integrator.upper()}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{config.cone.upper()}")
    option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{config.solver.upper()}")
    option.iterations = config.iterations
    option.impratio = config.impratio
    # What sleeps is not computed, and terrain always does: 2,500 boxes then cost half a step less.
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    # Bounding volumes only serve drawing, yet cost time in every step while they are on.
    spec.visual.global_.bvactive = False


def _add_robot(spec: mujoco.MjSpec, config: A1Config) -> None:
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, STANCE_HEIGHT))
    trunk.add_freejoint(name="trunk")
    trunk.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
    _set_inertia(trunk, TRUNK)
    trunk.add_site(name="imu")
    length, width, height = TRUNK_SIZE
    radius = height / 2
    for leg in LEGS:
        # A sphere in each corner stands for the hull: a box on a height field is expensive.
        x, y = side(leg)
        corner = (x * length / 2, y * (width / 2 - radius), 0.0)
        _add_collider(trunk, f"{leg}_corner", corner, radius)
    for leg in LEGS:
        _add_leg(spec, trunk, leg, config)
    add_sensors(spec)


def _add_leg(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, leg: str, config: A1Config) -> None:
    x, y = side(leg)
    hip = trunk.add_body(name=f"{leg}_hip", pos=(x * LEG_X, y * LEG_Y, 0.0))
    thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, y * HIP_OFFSET, 0.0))
    calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -THIGH_LENGTH))
    # Only the abduction housing differs between front and rear; thigh and calf point the same way.
    _set_inertia(hip, mirrored(HIP, x, y))
    _set_inertia(thigh, mirrored(THIGH, 1, y))
    _set_inertia(calf, mirrored(combined(CALF, FOOT), 1, y))

    for link, body in zip(LINKS, (hip, thigh, calf), strict=True):
        add_joint(spec, body, leg, link, config)

    # The knee's housing is about as wide as the thigh, 0.0245 x 0.034 m (URDF); the shin 0.016 m.
    _add_collider(thigh, f"{leg}_knee", (0.0, 0.0, -THIGH_LENGTH), 0.02)
    _add_collider(calf, f"{leg}_shin", (0.0, 0.0, -CALF_LENGTH / 2), 0.015)
    _add_collider(calf, f"{leg}_foot", (0.0, 0.0, -CALF_LENGTH), FOOT_RADIUS)
    calf.add_site(name=f"{leg}_foot", pos=(0.0, 0.0, -CALF_LENGTH))


def add_joint(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    leg: str,
    link: str,
    config: A1Config,
    damping: float | None = None,
) -> mujoco.MjsActuator:
    """Add a joint of a leg with its controller; `damping` (N m s / rad) is the config's if None."""
    body.add_joint(
        name=f"{leg}_{link}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(1.0, 0.0, 0.0) if link == "hip" else (0.0, 1.0, 0.0),
        range=JOINT_RANGES[link],
        armature=config.knee_armature if link == "calf" else config.armature,
        damping=(config.damping if damping is None else damping, 0.0, 0.0),
        frictionloss=config.dry_friction,
    )
    actuator = spec.add_actuator(
        name=f"{leg}_{link}",
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=f"{leg}_{link}",
        forcerange=(-config.torque_limit, config.torque_limit),
        forcelimited=True,
    )
    actuator.set_to_position(kp=config.kp, kv=config.kd)
    return actuator


def side(leg: str) -> tuple[int, int]:
    """Return on which side a leg is: +1 or -1 along x (+1: front) and along y (+1: left)."""
    return (1 if leg[0] == "F" else -1), (1 if leg[1] == "L" else -1)


def _set_inertia(body: mujoco.MjsBody, link: Inertia) -> None:
    body.mass = link.mass
    body.ipos = link.centre
    body.fullinertia = link.moments
    body.explicitinertial = True


def _add_collider(
    body: mujoco.MjsBody, name: str, pos: tuple[float, float, float], radius: float
) -> None:
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=pos,
        size=(radius, 0.0, 0.0),
        contype=1,
        conaffinity=0,
        group=3,
    )


def add_sensors(spec: mujoco.MjSpec, *, by_calf: bool = False) -> None:
    """Add `SENSORS` to a robot whose bodies, sites and geoms are named as this one's.

    With `by_calf`, a foot's force is that of the ground on all shapes of its calf, and contacts
    within the robot do not count: for a model that has soft feet and can touch itself.
    """
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    contact = partial(_add_contact, spec, world="world" if by_calf else "")
    site = {"objtype": objects.mjOBJ_SITE}
    foot, name = (objects.mjOBJ_BODY, "calf") if by_calf else (objects.mjOBJ_GEOM, "foot")
    for leg in LEGS:
        contact(f"{leg}_foot_force", foot, f"{leg}_{name}", force=True)
    for kind, sensor in (
        ("foot_position", kinds.mjSENS_FRAMEPOS),
        ("foot_velocity", kinds.mjSENS_FRAMELINVEL),
    ):
        for leg in LEGS:
            spec.add_sensor(name=f"{leg}_{kind}", type=sensor, objname=f"{leg}_foot", **site)
    for leg in LEGS:
        for part in ("knee", "shin"):
            contact(f"{leg}_{part}_contact", objects.mjOBJ_GEOM, f"{leg}_{part}")
    contact("trunk_contact", objects.mjOBJ_BODY, "trunk")
    spec.add_sensor(name="accelerometer", type=kinds.mjSENS_ACCELEROMETER, objname="imu", **site)


def _add_contact(
    spec: mujoco.MjSpec,
    name: str,
    kind: mujoco.mjtObj,
    target: str,
    *,
    world: str,
    force: bool = False,
) -> None:
    field = (
        mujoco.mjtConDataField.mjCONDATA_FORCE if force else mujoco.mjtConDataField.mjCONDATA_FOUND
    )
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        # The force acts on what stands here as the reference; as the object it would change sign.
        reftype=kind,
        refname=target,
        objtype=mujoco.mjtObj.mjOBJ_BODY if world else mujoco.mjtObj.mjOBJ_UNKNOWN,
        objname=world,
        # What to report (bits), how to reduce several contacts (3: net force, 0: none), how many.
        intprm=(1 << int(field), 3 if force else 0, 1),
    )
