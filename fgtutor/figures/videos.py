"""Videos of a robot on its route: the toy in the vertical cut it drives in, the A1 in its scene.

Reads an `Episode` with its body recorded, the terrain and the route; gives frames, a GIF or MP4,
and a film strip for pages that cannot play a video. A second of the toy's film costs less than a
second; the A1's is drawn by MuJoCo (`a1_film`).
"""

import itertools
import math
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import IO, cast

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode
from fgtutor.figures.canvas import Panels
from fgtutor.figures.films import FPS, INK, SKY, WIDTH, EpisodeFilm, MapView, font
from fgtutor.io.storage import atomic_write
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.robots import ROBOTS, load
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
HOLD = 1.2
"""How long the last frame stays, s."""
EARTH, TURF = "#B7A68A", "#5B4A33"
FORMATS = (".mp4", ".gif")


class Film(EpisodeFilm):
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


def film_of(episode: Episode, terrain: Terrain, route: Route) -> EpisodeFilm:
    """Return the film of the robot that drove.

    Raises `ConfigError` if its entry in `ROBOTS` names none, or no body was recorded.
    """
    film = ROBOTS[episode.robot].film
    if film is None:
        raise ConfigError(
            f"the robot {episode.robot} has no film: name one in its entry of fgtutor.robots.ROBOTS"
        )
    return load(film)(episode, terrain, route)


def frames(
    episode: Episode, terrain: Terrain, route: Route, *, fps: Positive = FPS
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the frames of an episode, one every 1 / fps seconds, the last one held."""
    check_arguments(frames, locals(), ConfigError)
    image = np.zeros(0, dtype=np.uint8)
    film = film_of(episode, terrain, route)
    for picture in film.frames(film.times(fps)):
        image = np.asarray(picture)
        yield image
    for _ in range(round(HOLD * fps)):
        yield image


def save_video(
    episode: Episode, terrain: Terrain, route: Route, path: str | Path, *, fps: float = FPS
) -> Path:
    """Write an episode as .mp4 (H.264) or .gif, whole or not at all.

    Raises:
        ConfigError: The suffix is another, no body was recorded, or ffmpeg does not run here.
        RenderingError: The A1 cannot be drawn on this machine.
        StorageError: The system refused to write.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ConfigError(f"a video is one of {', '.join(FORMATS)}, got {path.name!r}")
    pictures = frames(episode, terrain, route, fps=fps)
    with atomic_write(path) as temporary:
        if path.suffix == ".gif":
            _write_gif(pictures, temporary, fps)
        else:
            _write_mp4(pictures, temporary, fps)
    return path


def film_strip(
    episode: Episode, terrain: Terrain, route: Route, *, count: Panels = 8, columns: Panels = 2
) -> Image.Image:
    """Return views at `count` moments, evenly spread from start to end, read row by row."""
    check_arguments(film_strip, locals(), ConfigError)
    film = film_of(episode, terrain, route)
    steps = np.linspace(0, len(episode.poses) - 1, count).astype(int).tolist()
    views = [view.resize((2 * view.width // 3, 2 * view.height // 3), Image.Resampling.LANCZOS)
             for view in film.views(steps)]  # fmt: skip
    (width, height), rows, gap = views[0].size, -(-count // columns), 6
    strip = Image.new("RGB", (columns * (width + gap) - gap, rows * (height + gap) - gap), "white")
    for n, view in enumerate(views):
        strip.paste(view, (n % columns * (width + gap), n // columns * (height + gap)))
    return strip


def _write_gif(pictures: Iterator[np.ndarray], path: Path, fps: float) -> None:
    """Write a GIF at two thirds of the size, with one palette, so that still parts cost nothing."""
    images = []
    palette: Image.Image | None = None
    for picture in pictures:
        image = Image.fromarray(picture)
        image = image.resize((2 * image.width // 3, 2 * image.height // 3))
        if palette is None:
            palette = image.quantize(96)
        images.append(image.quantize(palette=palette, dither=Image.Dither.NONE))
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0
    )


def _write_mp4(pictures: Iterator[np.ndarray], path: Path, fps: float) -> None:
    """Write H.264 in the pixel format that browsers play."""
    first = next(pictures)
    height, width = first.shape[:2]
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
    target = "-c:v libx264 -pix_fmt yuv420p -crf 23 -movflags +faststart"
    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
        process = subprocess.Popen(
            [*command, *source.split(), *target.split(), str(path)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
    except (RuntimeError, FileNotFoundError, PermissionError) as error:
        raise ConfigError(f"no ffmpeg runs here ({error}): write a .gif instead") from error
    with process:
        # A pipe that breaks means that ffmpeg gave up: its own words and exit code say why.
        with suppress(BrokenPipeError):
            for picture in itertools.chain([first], pictures):
                cast(IO[bytes], process.stdin).write(picture.tobytes())
        _, complaint = process.communicate()
    if process.returncode:
        words = complaint.decode(errors="replace").strip()
        raise OSError(words or f"ffmpeg ended with code {process.returncode}")
