"""What the films of all robots share: which steps they show, the map, the words, the policies' bar.

Reads an `Episode` with its body recorded, the terrain and the route; a robot's film adds the
picture of the robot itself. What moves is drawn with Pillow onto a map that matplotlib draws once.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, ImageDraw, ImageFont

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode
from fgtutor.figures.maps import draw_elevation, draw_route
from fgtutor.figures.style import INK, Picture, policy_colours
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

WIDTH = 720
"""Width of a frame, pixels; like every size of a frame a multiple of 16, as video codecs want."""
FPS = 12.5
"""Frames per second: a whole number of the robots' control steps and of GIF's 1/100 s."""
SKY = "#F3F7FA"
BAR = 12
"""Height of the bar of policies, pixels."""


class EpisodeFilm(ABC):
    """One episode, ready to be drawn at any moment.

    Raises:
        ConfigError: The episode is empty, or its body is not that of the film's robot.
    """

    robot: ClassVar[str]
    """Whose film it is."""
    features: ClassVar[int]
    """How many numbers tell the pose of this robot's body (see `LocomotionEnv.drawing`)."""

    def __init__(self, episode: Episode, terrain: Terrain, route: Route) -> None:
        steps = len(episode.poses)
        if steps == 0 or episode.body is None or episode.body.shape != (steps, self.features):
            got = "none" if episode.body is None else f"body {episode.body.shape}"
            raise ConfigError(
                f"a film needs the {self.robot}'s body at each of {steps} steps, got {got}: record "
                f"the episode with execute(), by the robot {self.robot}"
            )
        self.episode, self.route = episode, route
        self.body = episode.body
        self.ground = terrain.elevation.filled()
        self.colours = policy_colours(route.names)
        self.dt = episode.seconds / steps

    @abstractmethod
    def views(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw the robot from near at these steps."""

    @abstractmethod
    def frames(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw the film's frames at these steps: the robot, and where it is on the map."""

    def times(self, fps: float = FPS) -> list[int]:
        """Return the steps that a film of this speed shows, the last one included."""
        steps = np.arange(0, len(self.episode.poses), 1 / (fps * self.dt)).astype(int).tolist()
        return [*steps, len(self.episode.poses) - 1]

    def policy(self, t: int) -> str:
        """Return the name of the policy that was active at step t."""
        return self.route.names[self.episode.policies[t]]

    def speed(self, t: int) -> float:
        """Return the speed over the last fifth of a second, m/s."""
        before = max(0, t - max(1, round(0.2 / self.dt)))
        gone = np.hypot(*(self.episode.poses[t, :2] - self.episode.poses[before, :2]))
        return float(gone / ((t - before) * self.dt)) if t > before else 0.0

    def smooth(self, values: Float[np.ndarray, " steps"], seconds: float) -> np.ndarray:
        """Return the moving average: a camera floats, or everything in its picture would shake."""
        width = max(1, round(seconds / self.dt)) | 1
        padded = np.pad(values, width // 2, mode="edge")
        return np.convolve(padded, np.ones(width) / width, mode="valid")

    def write(self, image: Image.Image, t: int) -> None:
        """Write policy, time, speed and at last the outcome at the top; policies at the bottom."""
        draw = ImageDraw.Draw(image)
        name = self.policy(t)
        draw.text((14, 8), name, fill=self.colours[name], font=font(22))
        last = t == len(self.episode.poses) - 1
        verdict = f"     {self.episode.reason}" if last else ""
        seconds = (t + 1) * self.dt
        draw.text(
            (170, 13), f"{seconds:4.1f} s     {self.speed(t):.2f} m/s{verdict}", INK, font(16)
        )
        steps, (width, height) = len(self.episode.policies), image.size
        edges = (np.flatnonzero(np.diff(self.episode.policies[: t + 1])) + 1).tolist()
        for first, after in zip([0, *edges], [*edges, t + 1], strict=True):
            draw.rectangle(
                (first / steps * width, height - BAR, after / steps * width, height),
                fill=self.colours[self.policy(first)],
            )


class MapView:
    """A map with a route, on which a robot moves.

    `width` is in pixels. A `bare` map has no axes and may be laid into another picture.
    """

    def __init__(
        self, ground: ElevationMap, route: Route, width: int = WIDTH, *, bare: bool = False
    ) -> None:
        """Draw the map once."""
        length, breadth = ground.size
        height = width * breadth / length
        height = height if bare else round(np.clip(0.9 * height + 40, 160, 640) / 16) * 16
        figure = Picture(width / 100, height / 100)
        axes = figure.subplots()
        draw_elevation(ground, axes=axes, bare=True)
        draw_route(route, ground, axes=axes, bare=True)
        if bare:
            figure.set_layout_engine("none")
            axes.set_axis_off()
            axes.set_position((0.0, 0.0, 1.0, 1.0))
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self.image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        """The map and the route alone."""
        self._matrix = axes.transData.get_matrix()

    def at(
        self, way: Float[np.ndarray, "steps 2"], yaw: float, colour: str, size: float = 0.35
    ) -> Image.Image:
        """Return the map with the way driven so far and an arrow at its end, `size` in metres."""
        image = self.image.copy()
        draw = ImageDraw.Draw(image)
        xy = np.column_stack((way, np.ones(len(way))))
        # matplotlib counts pixels from the bottom, an image from the top.
        pixels = (xy @ self._matrix.T)[:, :2] * (1, -1) + (0, image.height)
        if len(way) > 1:
            draw.line([tuple(point) for point in pixels.tolist()], fill=INK, width=2)
        turn = np.array(((math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))))
        scale = max(size * self._matrix[0, 0], 11)
        arrow = np.array(((1, 0), (-0.7, 0.62), (-0.35, 0), (-0.7, -0.62))) * scale
        corners = arrow @ turn.T * (1, -1) + pixels[-1]
        points = [tuple(corner) for corner in corners.tolist()]
        draw.polygon(points, fill=colour, outline="white", width=2)
        return image


@lru_cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return matplotlib's own font: the only one that is certain to be there."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"), size
    )
