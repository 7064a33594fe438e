"""Videos of the toy on its route: the map from above, and from the side the cut that it drives in.

Reads an `Episode` with its body recorded, the terrain and the route; gives frames, a GIF or MP4,
and a film strip for pages that cannot play a video. What moves is drawn with Pillow onto a picture
of the map that matplotlib draws once, so that a second of film costs less than a second.
"""

import itertools
import math
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import IO, cast

import imageio_ffmpeg
import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, ImageDraw, ImageFont

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode
from fgtutor.robots.toy import CLIFF, ToyModel
from fgtutor.routes import Route
from fgtutor.storage import atomic_write
from fgtutor.teach.canvas import Picture, policy_colours
from fgtutor.teach.figures import draw_elevation, draw_route
from fgtutor.terrain import Terrain

WIDTH = 720
"""Width of a frame, pixels; like every size here a multiple of 16, which video codecs want."""
SIDE = (WIDTH, 272)
"""Size of the side view, pixels."""
SCALE = 180
"""Pixels per metre in the side view."""
BEHIND = 1.5
"""How much ground the side view shows behind the robot's centre, m."""
SHARP = 2
"""Robot and ground are drawn this many times too large, then reduced: smooth edges."""
FPS = 12.5
"""Frames per second: every second control step of the toy, and a whole number of GIF's 1/100 s."""
HOLD = 1.2
"""How long the last frame stays, s."""
SKY, EARTH, TURF, INK = "#F3F7FA", "#B7A68A", "#5B4A33", "#1E2328"
FORMATS = (".mp4", ".gif")


class Film:
    """One episode, ready to be drawn at any moment.

    Raises:
        ConfigError: The episode is empty, or no toy's body was recorded with it.
    """

    def __init__(self, episode: Episode, terrain: Terrain, route: Route) -> None:
        steps = len(episode.poses)
        if steps == 0 or episode.body is None or episode.body.shape != (steps, 9):
            got = "none" if episode.body is None else f"body {episode.body.shape}"
            raise ConfigError(
                f"a film needs the toy's body at each of {steps} steps, got {got}: record the "
                "episode with execute(), by a toy"
            )
        self.episode, self.route, self.model = episode, route, ToyModel()
        self.ground = terrain.elevation.filled()
        self.colours = policy_colours(route.names)
        self.dt = episode.seconds / steps
        # The camera floats over the ground: slower than the chassis, or everything would shake.
        width = max(1, round(0.6 / self.dt)) | 1
        padded = np.pad(episode.poses[:, 2], width // 2, mode="edge")
        self.camera = np.convolve(padded, np.ones(width) / width, mode="valid")

    def times(self, fps: float = FPS) -> list[int]:
        """Return the steps that a film of this speed shows, the last one included."""
        steps = np.arange(0, len(self.episode.poses), 1 / (fps * self.dt)).astype(int).tolist()
        return [*steps, len(self.episode.poses) - 1]

    def frame(self, t: int) -> Image.Image:
        """Draw step t: the map above, the side view below."""
        above, below = self._above(t), self.side(t)
        frame = Image.new("RGB", (WIDTH, above.height + below.height), SKY)
        frame.paste(above, (0, 0))
        frame.paste(below, (0, above.height))
        return frame

    # From above -----------------------------------------------------------------------------------

    @cached_property
    def _map(self) -> tuple[Image.Image, np.ndarray]:
        """Draw map and route once; return the image, and the matrix from metres to its pixels."""
        length, width = self.ground.size
        height = round(np.clip(0.9 * WIDTH * width / length + 40, 160, 640) / 16) * 16
        figure = Picture(WIDTH / 100, height / 100)
        axes = figure.subplots()
        draw_elevation(self.ground, axes=axes)
        figure.axes[1].remove()  # the colour bar: a film is no place to read numbers
        draw_route(self.route, self.ground, axes=axes)
        figure.legends.clear()
        axes.set_title("", loc="left")
        axes.set(xlabel="", ylabel="")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        return image, axes.transData.get_matrix()

    def _above(self, t: int) -> Image.Image:
        image, matrix = self._map
        image = image.copy()
        draw = ImageDraw.Draw(image)
        xy = np.column_stack((self.episode.poses[: t + 1, :2], np.ones(t + 1)))
        # matplotlib counts pixels from the bottom, an image from the top.
        pixels = (xy @ matrix.T)[:, :2] * (1, -1) + (0, image.height)
        if t:
            draw.line([tuple(point) for point in pixels.tolist()], fill=INK, width=2)
        yaw = self.episode.poses[t, 3]
        turn = np.array(((math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))))
        size = max(0.35 * matrix[0, 0], 11)
        arrow = np.array(((1, 0), (-0.7, 0.62), (-0.35, 0), (-0.7, -0.62))) * size
        corners = arrow @ turn.T * (1, -1) + pixels[-1]
        points = [tuple(corner) for corner in corners.tolist()]
        draw.polygon(points, fill=self.colours[self._policy(t)], outline="white", width=2)
        return image

    # From the side --------------------------------------------------------------------------------

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
        self._words(ImageDraw.Draw(image), t)
        return image

    def _robot(self, draw: ImageDraw.ImageDraw, t: int, place, scale: float) -> None:
        m, body = self.model, self.episode.body
        parts = np.reshape(body[t] if body is not None else (), (3, 3)).tolist()
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
            corners, fill=self.colours[self._policy(t)], outline=INK, width=round(1.5 * SHARP)
        )

    def _words(self, draw: ImageDraw.ImageDraw, t: int) -> None:
        """Write policy, time and speed; below them a bar of the policies so far; a scale."""
        name = self._policy(t)
        draw.text((14, 8), name, fill=self.colours[name], font=_font(22))
        last = t == len(self.episode.poses) - 1
        verdict = f"     {self.episode.reason}" if last else ""
        seconds = (t + 1) * self.dt
        draw.text(
            (170, 13), f"{seconds:4.1f} s     {self._speed(t):.2f} m/s{verdict}", INK, _font(16)
        )
        steps, y = len(self.episode.policies), SIDE[1] - 12
        edges = np.flatnonzero(np.diff(self.episode.policies[: t + 1])) + 1
        for first, after in zip([0, *edges], [*edges, t + 1], strict=True):
            colour = self.colours[self.route.names[self.episode.policies[first]]]
            draw.rectangle((first / steps * WIDTH, y, after / steps * WIDTH, SIDE[1]), fill=colour)
        right = WIDTH - 14
        draw.line((right - SCALE / 2, 26, right, 26), fill=INK, width=2)
        draw.text((right - SCALE / 4, 8), "0.5 m", INK, _font(13), anchor="ma")

    def _policy(self, t: int) -> str:
        return self.route.names[self.episode.policies[t]]

    def _speed(self, t: int) -> float:
        """Return the speed over the last fifth of a second, m/s."""
        before = max(0, t - max(1, round(0.2 / self.dt)))
        gone = np.hypot(*(self.episode.poses[t, :2] - self.episode.poses[before, :2]))
        return float(gone / ((t - before) * self.dt)) if t > before else 0.0


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


def frames(
    episode: Episode, terrain: Terrain, route: Route, *, fps: float = FPS
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the frames of an episode, one every 1 / fps seconds, the last one held."""
    film = Film(episode, terrain, route)
    image = np.zeros(0, dtype=np.uint8)
    for t in film.times(fps):
        image = np.asarray(film.frame(t))
        yield image
    for _ in range(round(HOLD * fps)):
        yield image


def save_video(
    episode: Episode, terrain: Terrain, route: Route, path: str | Path, *, fps: float = FPS
) -> Path:
    """Write an episode as .mp4 (H.264) or .gif, whole or not at all.

    Raises:
        ConfigError: The suffix is another, no toy's body was recorded, or ffmpeg does not run here.
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
    episode: Episode, terrain: Terrain, route: Route, *, count: int = 8, columns: int = 2
) -> Image.Image:
    """Return side views at `count` moments, evenly spread from start to end, read row by row."""
    film = Film(episode, terrain, route)
    width, height = (2 * pixels // 3 for pixels in SIDE)
    rows, gap = -(-count // columns), 6
    strip = Image.new("RGB", (columns * (width + gap) - gap, rows * (height + gap) - gap), "white")
    for n, t in enumerate(np.linspace(0, len(episode.poses) - 1, count).astype(int).tolist()):
        view = film.side(t).resize((width, height), Image.Resampling.LANCZOS)
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


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Return matplotlib's own font: the only one that is certain to be there."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"), size
    )
