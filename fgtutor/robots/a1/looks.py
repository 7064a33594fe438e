"""The A1 to look at: its terrain in colours, a route painted on the ground, light and a body.

Reads a terrain and a route as plain points and colours; gives a MuJoCo model for `offscreen` that
has the very ground of physics, and in which qpos means the same. Nothing here is ever simulated.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import math
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise

import mujoco
import numpy as np
from jaxtyping import Float

from fgtutor.elevation import ElevationMap
from fgtutor.robots.a1.model import (
    CALF_LENGTH,
    FOOT_RADIUS,
    HIP_OFFSET,
    LEG_X,
    LEGS,
    THIGH_LENGTH,
    TRUNK_SIZE,
    A1Config,
    world_spec,
)
from fgtutor.robots.offscreen import COAT
from fgtutor.world.boxes import Box
from fgtutor.world.terrain import Terrain, World

UNTOUCHED = {"contype": 0, "conaffinity": 0}
Colour = tuple[float, float, float]

HEIGHTS = (-0.6, -0.1, 0.0, 0.15, 0.5, 1.0)
"""Heights whose colours are given, m; between them colours blend."""
COLOURS = (
    (0.20, 0.31, 0.42),
    (0.45, 0.56, 0.66),
    (0.87, 0.85, 0.80),
    (0.85, 0.75, 0.60),
    (0.74, 0.61, 0.45),
    (0.63, 0.50, 0.36),
)
"""The colour at each of `HEIGHTS`: as on the course's maps, pits are blue and walls brown."""
ZENITH, NADIR = (0.86, 0.91, 0.96), (0.60, 0.72, 0.81)
"""Colours of the sky above and below the ground."""
DARK, METAL = (0.13, 0.14, 0.16), (0.42, 0.44, 0.47)
"""Colours of the robot's legs and joints."""
GOAL = (0.15, 0.6, 0.3)
"""Colour of flag and disc at the goal."""
SPACING, WIDTH, LIFT = 0.05, 0.05, 0.004
"""Step, width and height above the ground of the painted line, m."""
STEEP = 0.8
"""The painted line breaks where the ground rises or falls by more than this per metre."""


def a1_scene(
    terrain: Terrain,
    xy: Float[np.ndarray, "points 2"],
    colours: Sequence[Colour],
    *,
    width: int,
    height: int,
    goal_radius: float,
) -> mujoco.MjModel:
    """Return the A1 on a terrain with a line from point to point and a disc around the last.

    Positions are in the terrain's frame. The robot's hull has the material `offscreen.COAT`.

    Args:
        terrain: The ground, with or without boxes.
        xy: Points of the line, m; at least one.
        colours: Colour of each stretch between two points, one less than points.
        width: Width of the pictures to draw, pixels.
        height: Height of the pictures to draw, pixels.
        goal_radius: Radius of the disc, m.
    """
    world = World([[terrain]])
    spec = world_spec(world, A1Config())
    _set_looks(spec, width, height)
    _lay_ground(spec, world)
    dress(spec)
    ground = terrain.elevation.filled()
    _paint(spec, ground, np.asarray(xy, dtype=float), colours)
    _add_goal(spec, ground, np.asarray(xy, dtype=float)[-1], goal_radius)
    return spec.compile()


def ground_colour(heights: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n 3"]:
    """Return the colour of ground at these heights, in [0, 1]."""
    channels = np.array(COLOURS).T
    return np.stack([np.interp(heights, HEIGHTS, channel) for channel in channels], axis=-1)


def _set_looks(spec: mujoco.MjSpec, width: int, height: int) -> None:
    """Set sky, light and the quality of the picture."""
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=ZENITH, rgb2=NADIR,
        width=128, height=128,
    )  # fmt: skip
    look = spec.visual
    look.global_.offwidth, look.global_.offheight = width, height
    # Without a GPU, smooth edges or fine shadows would each triple the time of a picture.
    look.quality.offsamples, look.quality.shadowsize = 0, 512
    look.quality.numslices, look.quality.numstacks = 20, 10
    # MuJoCo lights corners and blends between them: a lamp at the camera would stain large faces.
    look.headlight.ambient = (0.45, 0.46, 0.48)
    look.headlight.diffuse = look.headlight.specular = (0.0, 0.0, 0.0)
    # Everything MuJoCo derives from the size of the scene shall follow the robot's instead.
    spec.stat.extent, spec.stat.center = 2.0, (0.0, 0.0, 0.0)
    look.map.znear, look.map.zfar, look.map.shadowclip = 0.02, 40.0, 3.0
    # The shadows' map is finite: a sun that travels along spends it on what the camera sees.
    light = {
        "type": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        "mode": mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        "specular": (0.1, 0.1, 0.1),
    }
    trunk = spec.body("trunk")
    trunk.add_light(pos=(-2.0, 1.2, 4.0), dir=(0.5, -0.3, -1.0), diffuse=(0.6, 0.57, 0.5), **light)
    shade = {"pos": (1.0, -2.0, 2.0), "dir": (-0.4, 1.0, -0.9), "castshadow": False}
    trunk.add_light(**shade, diffuse=(0.13, 0.14, 0.17), **light)  # lest all shady sides look alike


def _lay_ground(spec: mujoco.MjSpec, world: World) -> None:
    """Move the ground to the terrain's own frame; colour it by height."""
    heights = np.asarray(world.elevation.filled().heights)
    for geom in spec.worldbody.geoms:
        geom.pos = geom.pos - np.array((*world.offset[0, 0], 0.0))
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
            axes = np.zeros(9)
            mujoco.mju_quat2Mat(axes, geom.quat)
            top = geom.pos[2] + np.abs(axes[6:]) @ geom.size
            geom.rgba = (*ground_colour(top), 1.0)
            # A tilted box ends in the plane of its neighbours, where faces would shine through
            # each other: draw it a millimetre short on either side.
            geom.size = geom.size - 0.001 * ((np.abs(axes[6:]) < 1e-6) & (axes[8] < 1 - 1e-6))
        else:
            # Rows of a picture run along -y: [ix, iy] is transposed and turned upside down.
            picture = (255 * ground_colour(heights.T[::-1])).astype(np.uint8)
            spec.add_texture(
                name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, nchannel=3,
                height=picture.shape[0], width=picture.shape[1], data=picture.ravel().tolist(),
            )  # fmt: skip
            material = spec.add_material(name="ground")
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
            geom.material, geom.rgba = "ground", (1.0, 1.0, 1.0, 1.0)


def dress(spec: mujoco.MjSpec) -> None:
    """Give the robot a body to look at around the spheres that collide, which physics ignores."""
    kind = mujoco.mjtGeom
    for name, colour, shine in (
        (COAT, (0.5,) * 3, 0.5),
        ("dark", DARK, 0.3),
        ("metal", METAL, 0.6),
    ):
        spec.add_material(name=name, rgba=(*colour, 1.0), specular=shine, shininess=0.4)

    def show(body: mujoco.MjsBody, material: str, **properties: object) -> None:
        body.add_geom(material=material, group=2, **UNTOUCHED, **properties)

    trunk, (length, width, height) = spec.body("trunk"), TRUNK_SIZE
    half = (length / 2, width / 2 - 0.035, height / 2)
    show(trunk, COAT, type=kind.mjGEOM_BOX, size=half)
    show(
        trunk, "dark", type=kind.mjGEOM_BOX, size=(length / 2 - 0.02, width / 2, height / 2 - 0.03)
    )
    for x in (1, -1):
        end = (x * LEG_X, 0.0, 0.0)
        show(trunk, "dark", type=kind.mjGEOM_BOX, pos=end, size=(0.055, 0.055, 0.045))
    nose = (LEG_X + 0.06, 0.0, 0.012)
    show(trunk, COAT, type=kind.mjGEOM_BOX, pos=nose, size=(0.022, 0.05, 0.03))
    for leg in LEGS:
        y = 1 if leg[1] == "L" else -1
        hip, thigh, calf = (spec.body(f"{leg}_{link}") for link in ("hip", "thigh", "calf"))
        axle = (0.0, y * 0.01, 0.0, 0.0, y * (HIP_OFFSET - 0.015), 0.0)
        show(hip, "metal", type=kind.mjGEOM_CYLINDER, fromto=axle, size=(0.044, 0.0, 0.0))
        disc = (0.0, -y * 0.02, 0.0, 0.0, y * 0.014, 0.0)
        show(thigh, "dark", type=kind.mjGEOM_CYLINDER, fromto=disc, size=(0.046, 0.0, 0.0))
        middle = (0.0, 0.0, -THIGH_LENGTH / 2)
        show(thigh, "dark", type=kind.mjGEOM_BOX, pos=middle, size=(0.021, 0.013, THIGH_LENGTH / 2))
        knee = (0.0, -0.014, 0.0, 0.0, 0.014, 0.0)
        show(calf, "metal", type=kind.mjGEOM_CYLINDER, fromto=knee, size=(0.026, 0.0, 0.0))
        shin = (0.0, 0.0, 0.0, 0.0, 0.0, -CALF_LENGTH)
        show(calf, "metal", type=kind.mjGEOM_CAPSULE, fromto=shin, size=(0.0095, 0.0, 0.0))
        foot = (0.0, 0.0, -CALF_LENGTH)
        show(calf, "dark", type=kind.mjGEOM_SPHERE, pos=foot, size=(FOOT_RADIUS, 0.0, 0.0))


def _paint(
    spec: mujoco.MjSpec,
    ground: ElevationMap,
    xy: Float[np.ndarray, "points 2"],
    colours: Sequence[Colour],
) -> None:
    """Lay a flat ribbon on the ground, one box from bend to bend.

    Few and long boxes, because every shape costs time in every picture.
    """
    for start, stop, colour in _stretches(xy, colours):
        way = stop - start
        yaw = math.atan2(way[1], way[0])
        shares = np.linspace(0.0, 1.0, max(1, round(math.hypot(*way) / SPACING)) + 1)
        points = start + shares[:, None] * way
        # In a valley the line floats over the bottom, rather than sinking into both walls.
        across = 0.5 * WIDTH * np.array((-math.sin(yaw), math.cos(yaw)))
        tops = np.max([_heights(ground, points + side * across) for side in (-1, 0, 1)], axis=0)
        bends = np.flatnonzero(np.abs(np.diff(tops, 2)) > 1e-4) + 1
        for near, far in pairwise(np.column_stack((points, tops + LIFT))[[0, *bends, -1]]):
            run = math.hypot(*(far - near)[:2])
            if abs(far[2] - near[2]) > STEEP * run:
                continue
            rise = math.atan2(far[2] - near[2], run)
            piece = Box(
                centre=tuple((near + far) / 2),
                size=(float(np.linalg.norm(far - near)), WIDTH, LIFT),
                rpy=(0.0, -rise, yaw),
            )
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, pos=piece.centre, quat=piece.quaternion,
                size=np.array(piece.size) / 2, rgba=(*colour, 1.0), **UNTOUCHED,
            )  # fmt: skip


def _stretches(
    xy: Float[np.ndarray, "points 2"], colours: Sequence[Colour]
) -> Iterator[tuple[np.ndarray, np.ndarray, Colour]]:
    """Join steps that go on straight in one colour; yield where each begins and ends."""
    steps = zip(pairwise(xy), colours, strict=True)

    def kind(step: tuple[tuple[np.ndarray, np.ndarray], Colour]) -> tuple[float, Colour]:
        (near, far), colour = step
        return round(math.atan2(*(far - near)), 3), colour

    for (_, colour), group in groupby(steps, key=kind):
        pairs = [pair for pair, _ in group]
        yield pairs[0][0], pairs[-1][1], colour


def _heights(ground: ElevationMap, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Return the height of the cell under each point."""
    cells = np.floor((xy - np.array(ground.origin)) / ground.resolution).astype(int)
    i, j = np.clip(cells, 0, np.array(ground.shape) - 1).T
    return np.asarray(ground.heights)[i, j]


def _add_goal(
    spec: mujoco.MjSpec, ground: ElevationMap, xy: Float[np.ndarray, "2"], radius: float
) -> None:
    """Stand a flag at the goal, and mark how near the robot has to come."""
    z = float(_heights(ground, xy[None])[0])
    x, y = xy.tolist()
    kind = mujoco.mjtGeom
    for shape, pos, size, opacity in (
        (kind.mjGEOM_CYLINDER, (x, y, z), (radius, LIFT / 2, 0.0), 0.5),
        (kind.mjGEOM_CYLINDER, (x, y, z + 0.35), (0.008, 0.35, 0.0), 1.0),
        (kind.mjGEOM_BOX, (x + 0.11, y, z + 0.63), (0.1, 0.004, 0.07), 1.0),
    ):
        spec.worldbody.add_geom(type=shape, pos=pos, size=size, rgba=(*GOAL, opacity), **UNTOUCHED)
