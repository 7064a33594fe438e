"""Pictures of the A1: its postures and walks, its gait, and what its reward pays for.

Reads states, episodes, forces and rewards; gives figures and film strips. MuJoCo draws the robot
where a graphics library works; where none does, stick figures take its place, so that every
notebook runs everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fgtutor.errors import ConfigError, RenderingError
from fgtutor.execution import Episode, FollowConfig
from fgtutor.figures.a1_film import BESIDE, DISTANCE, VIEW
from fgtutor.figures.style import INK, LINES, TITLE, Panels, Photo, Picture, colours_of
from fgtutor.figures.videos import film_strip
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.robots.a1.looks import a1_scene
from fgtutor.robots.a1.model import CALF_LENGTH, HIP_OFFSET, LEG_X, LEG_Y, LEGS, THIGH_LENGTH
from fgtutor.robots.base import LocomotionEnv
from fgtutor.robots.offscreen import Renderer, Shot
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

LEG_COLOURS = dict(zip(LEGS, LINES, strict=False))
"""Each leg has one colour in the stick figures and in the gait."""
EARTH = "#B08D5E"
"""The colour of the ground below them."""
LOADED = 10.0
"""A foot that the ground pushes with more than this stands, N."""
STEEPNESS = 25.0
"""How far down the camera looks, degrees."""
PAGE = 840
"""Widest film strip, pixels: a notebook is no wider, and must stay small."""


# The robot ----------------------------------------------------------------------------------------


def leg_points(qpos: ArrayLike) -> Float[np.ndarray, "4 4 3"]:
    """Return where each leg's abduction axis, hip, knee and foot are, m; legs as in `LEGS`.

    `qpos` is the state that MuJoCo and `A1Env.drawing` give: place, quaternion, 12 joint angles.
    """
    state = np.asarray(qpos, dtype=float)
    trunk = Rotation.from_quat(state[3:7], scalar_first=True)
    legs = np.empty((4, 4, 3))
    for leg, name in enumerate(LEGS):
        x, y = (1 if name[0] == "F" else -1), (1 if name[1] == "L" else -1)
        abduction, hip, knee = state[7 + 3 * leg : 10 + 3 * leg]
        # Hip and knee turn about y: a link that hangs down swings back by a positive angle.
        thigh = -THIGH_LENGTH * np.array((np.sin(hip), 0.0, np.cos(hip)))
        calf = -CALF_LENGTH * np.array((np.sin(hip + knee), 0.0, np.cos(hip + knee)))
        joint = np.array((0.0, y * HIP_OFFSET, 0.0))
        chain = np.array((0 * joint, joint, joint + thigh, joint + thigh + calf))
        axis = np.array((x * LEG_X, y * LEG_Y, 0.0))
        swung = Rotation.from_euler("x", abduction).apply(chain)
        legs[leg] = state[:3] + trunk.apply(axis + swung)
    return legs


def draw_postures(
    postures: Mapping[str, ArrayLike], *, title: str = "", plane: bool = False
) -> Picture:
    """Draw states of the A1 as stick figures: from its right side above, from the front below.

    Nearer legs hide farther ones, which are paler. With `plane`, a line shows the plane through the
    four feet, which is the ground if all of them stand.
    """
    columns = max(1, len(postures))
    width = min(2.6 * columns, 7.6)
    figure = Picture(max(width, 3.0), 2 * 0.6 * width / columns + 1.0)
    panels = figure.subplots(2, columns, squeeze=False, sharey=True)
    for column, (name, qpos) in enumerate(postures.items()):
        state = np.asarray(qpos, dtype=float)
        yaw = Rotation.from_quat(state[3:7], scalar_first=True).as_euler("ZYX")[0]
        ahead = Rotation.from_euler("z", -yaw)
        legs = ahead.apply((leg_points(state) - state[:3]).reshape(-1, 3)).reshape(4, 4, 3)
        # From its right, at -y, one looks along +y; from the front along -x, its left at the right.
        for row, (across, depth) in enumerate(((0, legs[:, 0, 1]), (1, -legs[:, 0, 0]))):
            axes = panels[row, column]
            axes.set(xlim=(-0.42, 0.42), ylim=(-0.42, 0.12), aspect="equal", xticks=(), yticks=())
            if plane:
                _draw_plane(axes, legs[:, 3], across)
            _draw_legs(axes, legs[..., across], legs[..., 2], depth)
        panels[0, column].set_title(name, fontsize=9, loc="left")
    panels[0, 0].set_ylabel("from its right", fontsize=9)
    panels[1, 0].set_ylabel("from the front", fontsize=9)
    handles = [Line2D([], [], color=colour, label=leg) for leg, colour in LEG_COLOURS.items()]
    style = {"ncols": 5, "frameon": False, "fontsize": 9}
    if plane:
        handles.append(Line2D([], [], color=EARTH, linewidth=4, label="plane of the feet"))
    figure.legend(handles=handles, loc="outside lower center", **style)
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def _draw_legs(
    axes: Axes,
    across: Float[np.ndarray, "4 4"],
    up: Float[np.ndarray, "4 4"],
    depth: Float[np.ndarray, " legs"],
) -> None:
    """Draw trunk and legs as lines in one plane, from the farthest to the nearest."""
    hull = [0, 1, 3, 2, 0]  # around the trunk: FR, FL, RL, RR
    axes.plot(
        across[hull, 0], up[hull, 0], color=INK, linewidth=4, solid_joinstyle="round", zorder=3
    )
    colours = list(LEG_COLOURS.values())
    for leg, colour in enumerate(colours):
        far = depth[leg] > depth.mean()
        style: dict[str, Any] = {"zorder": 2, "alpha": 0.45} if far else {"zorder": 4}
        axes.plot(across[leg], up[leg], ".-", color=colour, linewidth=2.5, **style)
        axes.plot(across[leg, -1], up[leg, -1], "o", color=INK, markersize=5, **style)


def _draw_plane(axes: Axes, feet: Float[np.ndarray, "4 3"], across: int) -> None:
    """Draw where the plane through the feet (least squares) cuts the middle of the robot."""
    ground = np.column_stack((feet[:, :2], np.ones(4)))
    slopes = np.linalg.lstsq(ground, feet[:, 2], rcond=None)[0]
    ends = np.array((-0.42, 0.42))
    up = slopes[2] + slopes[across] * ends
    axes.plot(ends, up - 0.02, color=EARTH, linewidth=4, zorder=1)


def show_walk(
    episode: Episode, terrain: Terrain, route: Route, *, count: Panels = 6, columns: Panels = 3
) -> Photo | Picture:
    """Return a film strip of a walk; where nothing draws MuJoCo's scenes, stick figures of it."""
    check_arguments(show_walk, locals(), ConfigError)
    try:
        strip = film_strip(episode, terrain, route, count=count, columns=columns)
    except RenderingError:
        print("no graphics library draws here (`fgtutor doctor` says why): stick figures instead")
        return walk_sticks(episode, count=min(count, 4))
    strip.image.thumbnail((PAGE, strip.image.height))
    return strip


def walk_sticks(episode: Episode, *, count: Panels = 4) -> Picture:
    """Draw stick figures at `count` moments of a recorded walk, evenly spread."""
    check_arguments(walk_sticks, locals(), ConfigError)
    if episode.body is None:
        raise ConfigError("this episode has no body recorded: drive it with execute()")
    steps = np.linspace(0, len(episode.poses) - 1, count).astype(int).tolist()
    dt = episode.seconds / len(episode.poses)
    postures = {f"{(t + 1) * dt:.1f} s": episode.body[t] for t in steps}
    return draw_postures(postures, title=f"The walk ({episode.reason})")


class A1View:
    """What `DriveA1` shows of the A1 on a terrain; it draws for as long as it is kept."""

    def __init__(self, terrain: Terrain, colour: str = LINES[0]) -> None:
        """Prepare the view; `colour` is that of the robot's hull."""
        self.terrain, self.coat = terrain, to_rgb(colour)
        self._renderer: Renderer | None = None
        self._sticks = False

    def __call__(self, env: LocomotionEnv) -> UInt8[np.ndarray, "height width 3"]:
        """Return a picture of robot 0 of an environment whose first tile is the terrain."""
        qpos = env.drawing()[0]
        qpos[:2] -= env.offsets[0, 0].cpu().numpy()
        yaw = float(env.motion()[0][0, 3])
        if not self._sticks:
            try:
                return self._draw(qpos, yaw)
            except RenderingError:
                self._sticks = True
        canvas = FigureCanvasAgg(draw_postures({"": qpos}))
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3]

    def _draw(self, qpos: np.ndarray, yaw: float) -> UInt8[np.ndarray, "height width 3"]:
        if self._renderer is None:
            width, height = VIEW
            goal = np.array([self.terrain.goal])  # a disc, and no line: nothing was planned
            radius = FollowConfig().goal_radius
            scene = a1_scene(self.terrain, goal, [], width=width, height=height, goal_radius=radius)
            self._renderer = Renderer(scene, width, height)
        x, y, z = qpos[:3].tolist()
        shot = Shot(
            qpos=qpos,
            target=(x, y, z - 0.05),
            distance=DISTANCE,
            azimuth=float(np.degrees(yaw)) + BESIDE,
            elevation=-STEEPNESS,
            coat=self.coat,
        )
        return self._renderer.draw(shot)

    def close(self) -> None:
        """End the process that draws."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


# Gait and reward ----------------------------------------------------------------------------------


def draw_gait(loads: ArrayLike, dt: Positive) -> Picture:
    """Draw which foot stands when, from the ground's forces on the four feet, [time, 4] in N."""
    check_arguments(draw_gait, locals(), ConfigError)
    loaded = np.asarray(loads) > LOADED
    figure = Picture(7.0, 2.0)
    axes = figure.subplots()
    for place, colour in enumerate(LEG_COLOURS.values()):
        edges = np.flatnonzero(np.diff(loaded[:, place].astype(int), prepend=0, append=0))
        spans = [(a * dt, (b - a) * dt) for a, b in edges.reshape(-1, 2).tolist()]
        axes.broken_barh(spans, (place - 0.4, 0.8), color=colour)
    axes.set_yticks(range(len(LEGS)), LEGS)
    axes.set(xlabel="time (s)\nA bar: the foot stands", xlim=(0, len(loaded) * dt))
    axes.invert_yaxis()
    axes.set_title("Which foot stands when", **TITLE, loc="left")
    return figure


def draw_terms(behaviours: Mapping[str, Mapping[str, float]]) -> Picture:
    """Draw what each term of the reward gives for each behaviour, and their sum."""
    names = list(next(iter(behaviours.values())))
    figure = Picture(7.0, 0.9 + 0.42 * (len(names) + 1))
    axes = figure.subplots()
    height = 0.8 / len(behaviours)
    colours = colours_of(behaviours)
    for number, ((behaviour, terms), colour) in enumerate(
        zip(behaviours.items(), colours, strict=True)
    ):
        values = [terms[name] for name in names]
        places = np.arange(len(names) + 1) - 0.4 + (number + 0.5) * height
        axes.barh(places, [*values, sum(values)], height, color=colour, label=behaviour)
    axes.axvline(0, color=INK, linewidth=1)
    axes.axhline(len(names) - 0.5, color=INK, linewidth=0.5)
    axes.set_yticks(range(len(names) + 1), [*names, "sum"], fontsize=9)
    axes.invert_yaxis()
    axes.set(xlabel="per second; the sum is floored at zero before it is paid")
    axes.legend(frameon=False, fontsize=9)
    axes.set_title("What it earns, term by term", **TITLE, loc="left")
    return figure
