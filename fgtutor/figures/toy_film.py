"""The toy robot's film: the map above, below it the vertical cut that the robot drives in.

Reads an `Episode` with its body recorded, the terrain and the route; gives pictures, drawn with
Pillow: a second of film takes less than a second.
"""

import math
from collections.abc import Iterable, Iterator
from functools import cached_property

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from fgtutor.elevation import ElevationMap
from fgtutor.execution import Episode
from fgtutor.figures.episode_film import SKY, WIDTH, EpisodeFilm, MapView, font
from fgtutor.figures.style import INK
from fgtutor.robots.toy import CLIFF, ToyModel
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

SIDE = (WIDTH, 272)
"""Size of the toy's side view, pixels."""
SCALE = 180
"""Pixels per metre in the side view."""
BEHIND = 1.5
"""How much ground the side view shows behind the robot's centre, m."""
SHARP = 2
"""Robot and ground are drawn this many times too large, then reduced: smooth edges."""
EARTH, TURF = "#B7A68A", "#5B4A33"


class ToyFilm(EpisodeFilm):
    """The toy's film: the map above, the side view below."""

    robot, features = "toy", 9

    def __init__(self, episode: Episode, terrain: Terrain, route: Route) -> None:
        super().__init__(episode, terrain, route)
        self.model = ToyModel()
        self.camera = self.smooth(episode.poses[:, 2], 0.6)

    def views(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw the side view at these steps."""
        return map(self.side, steps)

    def frames(self, steps: Iterable[int]) -> Iterator[Image.Image]:
        """Draw map and side view at these steps."""
        return map(self.frame, steps)

    def frame(self, t: int) -> Image.Image:
        """Draw step t: the map above, the side view below."""
        pose = self.episode.poses[: t + 1]
        above = self._map.at(pose[:, :2], pose[-1, 3], self.colours[self.policy(t)])
        below = self.side(t)
        frame = Image.new("RGB", (WIDTH, above.height + below.height), SKY)
        frame.paste(above, (0, 0))
        frame.paste(below, (0, above.height))
        return frame

    @cached_property
    def _map(self) -> MapView:
        return MapView(self.ground, self.route)

    def side(self, t: int) -> Image.Image:
        """Draw the vertical cut along the robot's heading, with the robot in it."""
        width, height = (SHARP * pixels for pixels in SIDE)
        image = Image.new("RGB", (width, height), SKY)
        draw = ImageDraw.Draw(image)
        scale = SHARP * SCALE
        x, y, _, yaw = self.episode.poses[t].tolist()

        def place(s: float, z: float) -> tuple[float, float]:
            return (s + BEHIND) * scale, 0.5 * height - (z - self.camera[t]) * scale

        s, h = ground_along(self.ground, x, y, yaw, -BEHIND, width / scale - BEHIND)
        line = [place(*point) for point in zip(s.tolist(), h.tolist(), strict=True)]
        draw.polygon([(0, height), *line, (width, height)], fill=EARTH)
        draw.line(line, fill=TURF, width=3 * SHARP, joint="curve")
        self._robot(draw, t, place, scale)
        image = image.reduce(SHARP)
        self.write(image, t)
        draw = ImageDraw.Draw(image)
        right = WIDTH - 14
        draw.line((right - SCALE / 2, 26, right, 26), fill=INK, width=2)
        draw.text((right - SCALE / 4, 8), "0.5 m", INK, font(13), anchor="ma")
        return image

    def _robot(self, draw: ImageDraw.ImageDraw, t: int, place, scale: float) -> None:
        m = self.model
        parts = np.reshape(self.body[t], (3, 3)).tolist()
        (s, z, angle), *wheels = parts
        forward = np.array((math.cos(angle), math.sin(angle)))
        up = np.array((-forward[1], forward[0]))
        centre = np.array((s, z))
        for side, (wheel_s, wheel_z, turn) in zip((-1, 1), wheels, strict=True):
            hip = place(*(centre + side * m.half_base * forward))
            draw.line((hip, place(wheel_s, wheel_z)), fill="#6B7680", width=round(0.045 * scale))
            u, v = place(wheel_s, wheel_z)
            r = m.wheel_radius * scale
            draw.ellipse((u - r, v - r, u + r, v + r), fill="#3A4148", outline=INK, width=2 * SHARP)
            spoke = 0.8 * m.wheel_radius * np.array((math.cos(turn), math.sin(turn)))
            ends = [place(wheel_s + e * spoke[0], wheel_z + e * spoke[1]) for e in (-1, 1)]
            draw.line(ends, fill="white", width=2 * SHARP)
        length, thick = m.chassis_size
        outline = [(-1, -1), (0.8, -1), (1, -0.2), (1, 0.2), (0.8, 1), (-1, 1)]  # a bow in front
        corners = [place(*(centre + a * length / 2 * forward + b * thick / 2 * up))
                   for a, b in outline]  # fmt: skip
        draw.polygon(
            corners, fill=self.colours[self.policy(t)], outline=INK, width=round(1.5 * SHARP)
        )


def ground_along(
    ground: ElevationMap, x: float, y: float, yaw: float, start: float, stop: float
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"]]:
    """Return places s from `start` to `stop` along a ray (m) and the ground's height at each.

    As in `ToyEnv`, gentle ground is interpolated and a cliff between two cells stays vertical.
    """
    s = np.arange(start, stop + 0.01, min(0.01, ground.resolution / 4))
    px, py = x + s * math.cos(yaw), y + s * math.sin(yaw)
    (nx, ny), (x0, y0) = ground.shape, ground.origin
    u = np.clip((px - x0) / ground.resolution - 0.5, 0, nx - 1)
    v = np.clip((py - y0) / ground.resolution - 0.5, 0, ny - 1)
    i, j = np.minimum(u.astype(int), nx - 2), np.minimum(v.astype(int), ny - 2)
    around = np.stack([ground.heights[i + di, j + dj] for di in (0, 1) for dj in (0, 1)])
    nearest = ground.heights[np.rint(u).astype(int), np.rint(v).astype(int)]
    return s, np.where(np.ptp(around, axis=0) > CLIFF, nearest, ground.height_at(px, py))
