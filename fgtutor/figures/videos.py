"""Videos of a robot on its route, and film strips for pages that cannot play one.

Reads an `Episode` with its body recorded, the terrain and the route; gives frames, a GIF or an MP4,
of pictures that the robot's own film draws (`toy_film`, `a1_film`).
"""

import itertools
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from fgtutor.errors import ConfigError
from fgtutor.execution import Episode
from fgtutor.figures.episode_film import FPS, EpisodeFilm
from fgtutor.figures.style import Panels, Photo
from fgtutor.io.storage import atomic_write
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.robots import ROBOTS, load
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

HOLD = 1.2
"""How long the last frame stays, s."""
FORMATS = (".mp4", ".gif")


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
) -> Photo:
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
    drivers = ", ".join(dict.fromkeys(route.names[k] for k in episode.policies.tolist()))
    return Photo(
        strip,
        f"Film strip of {count} moments of a drive by the {episode.robot}, in rows from start to "
        f"end: {episode.length:.1f} m in {episode.seconds:.0f} s, end: {episode.reason}. "
        f"Policies: {drivers}",
    )


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
