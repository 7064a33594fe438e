"""What a live view shows: pictures of one map side by side, a route on top, and two texts.

Reads what an `Explorer` or a `Painting` computed; gives plain values that a browser's canvas draws
(`widgets`), or one PNG where there is none. Nothing here knows the notebook.

Arrays are [ix, iy], but a picture has its rows first and y = 0 at the bottom: `upright` turns them,
and points of the overlay count (right, down) in cells from the picture's upper left corner.
"""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.colors import to_rgb
from PIL import Image, ImageDraw

from fgtutor.elevation import ElevationMap
from fgtutor.figures.films import INK, font
from fgtutor.figures.maps import BLOCKED, UNKNOWN, draw_elevation

Point = tuple[float, float]
CIVIDIS = (matplotlib.colormaps["cividis"](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
"""Colours of F: they differ in brightness too, so the colour-blind read them alike."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One picture of the map."""

    key: str
    """Which of the scene's pictures it shows."""
    title: str
    """What it is."""
    caption: str = ""
    """What to see in it."""
    colour: str = ""
    """Colour of the title, "#RRGGBB", where the picture belongs to one policy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything a view draws."""

    rows: Sequence[Sequence[Panel]]
    """The panels, row by row; those of a row share its width."""
    pictures: Mapping[str, UInt8[np.ndarray, "ny nx 3"]]
    """One colour a cell, upright, by panel key."""
    lines: Sequence[tuple[str, Sequence[Point]]] = field(default_factory=tuple)
    """Polylines over every panel: a colour and points (right, down), in cells."""
    marks: Mapping[str, Point] = field(default_factory=dict)
    """Where "start" and "goal" lie."""
    box: tuple[float, float, float, float] | None = None
    """A rectangle (left, top, right, bottom) to outline, in cells."""
    legend: Mapping[str, str] = field(default_factory=dict)
    """Colours by name."""
    status: str = ""
    """One line of text that says what came out."""


def upright(values: np.ndarray) -> np.ndarray:
    """Turn an array [ix, iy, ...] into a picture: x to the right, y up."""
    return np.ascontiguousarray(np.swapaxes(values, 0, 1)[::-1])


def on_picture(cells: Float[np.ndarray, "n 2"], ny: int) -> list[Point]:
    """Return where the centres of cells (ix, iy) lie in a picture of `ny` rows, (right, down)."""
    return [(ix + 0.5, ny - iy - 0.5) for ix, iy in np.asarray(cells).tolist()]


def shades(low: str, high: str) -> UInt8[np.ndarray, "256 3"]:
    """Return 256 colours from one to another."""
    way = np.linspace(0, 1, 256)[:, None]
    return (((1 - way) * to_rgb(low) + way * to_rgb(high)) * 255).round().astype(np.uint8)


def level(values: Float[np.ndarray, "nx ny"]) -> UInt8[np.ndarray, "nx ny"]:
    """Return values in [0, 1] as indices into 256 colours."""
    return (values * 255 + 0.5).astype(np.uint8)


def feasibility_picture(
    best: Float[np.ndarray, "nx ny"], known: Bool[np.ndarray, "nx ny"], f_min: float
) -> UInt8[np.ndarray, "ny nx 3"]:
    """Colour F, one number a cell; dark where it is below `f_min`."""
    picture = CIVIDIS[upright(level(best))]
    picture[upright(best < f_min)] = rgb(BLOCKED)
    return mark_unknown(picture, known)


def ground_picture(elevation: ElevationMap) -> UInt8[np.ndarray, "ny nx 3"]:
    """Colour the heights of a map exactly as `figures.draw_elevation` does."""
    image = np.asarray(draw_elevation(elevation).axes[0].images[0].get_array())
    # imshow counts rows from the bottom here, a picture from the top.
    return mark_unknown((image[::-1] * 255).round().astype(np.uint8), elevation.known)


def mark_unknown(
    picture: UInt8[np.ndarray, "ny nx 3"], known: Bool[np.ndarray, "nx ny"]
) -> UInt8[np.ndarray, "ny nx 3"]:
    """Grey out the cells that were never observed, in place; return the picture."""
    if not known.all():
        picture[upright(~known)] = rgb(UNKNOWN)
    return picture


def rgb(colour: str) -> UInt8[np.ndarray, "3"]:
    """Return a colour by name or #RRGGBB as three bytes."""
    return (np.array(to_rgb(colour)) * 255).round().astype(np.uint8)


def to_png(scene: Scene, width: int = 960) -> bytes:
    """Draw a scene as one PNG, `width` pixels wide."""
    gap, head, foot = 12, 22, 20
    strips = []
    for row in scene.rows:
        across = (width - gap * (len(row) - 1)) // len(row)
        drawn = [_panel(scene, panel, across) for panel in row]
        strip = Image.new("RGB", (width, head + drawn[0].height + foot), "white")
        draw = ImageDraw.Draw(strip)
        for i, (panel, picture) in enumerate(zip(row, drawn, strict=True)):
            left = i * (across + gap)
            draw.text((left, 3), panel.title, fill=panel.colour or INK, font=font(13))
            strip.paste(picture, (left, head))
            draw.text((left, head + picture.height + 2), panel.caption, fill=INK, font=font(11))
        strips.append(strip)
    legend = Image.new("RGB", (width, 46), "white")
    draw = ImageDraw.Draw(legend)
    left = 0.0
    for name, colour in scene.legend.items():
        draw.rectangle((left, 6, left + 12, 18), fill=colour)
        draw.text((left + 17, 5), name, fill=INK, font=font(12))
        left += 34 + draw.textlength(name, font=font(12))
    draw.text((0, 26), scene.status, fill=INK, font=font(12))
    page = Image.new("RGB", (width, sum(part.height for part in (*strips, legend))), "white")
    top = 0
    for part in (*strips, legend):
        page.paste(part, (0, top))
        top += part.height
    buffer = io.BytesIO()
    page.save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def _panel(scene: Scene, panel: Panel, across: int) -> Image.Image:
    """Draw one picture with what lies on top of it."""
    cells = scene.pictures[panel.key]
    ny, nx = cells.shape[:2]
    scale = across / nx
    image = Image.fromarray(cells).resize((across, round(ny * scale)), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(image)

    def place(point: Point) -> Point:
        return point[0] * scale, point[1] * scale

    for _, points in scene.lines:
        draw.line([place(point) for point in points], fill="white", width=6, joint="curve")
    for colour, points in scene.lines:
        draw.line([place(point) for point in points], fill=colour, width=3, joint="curve")
    for role, point in scene.marks.items():
        u, v = place(point)
        corners = [
            (u + r * math.sin(turn), v - r * math.cos(turn)) for turn, r in _outline(role == "goal")
        ]
        draw.polygon(corners, fill="white", outline="black")
    if scene.box is not None:
        left, top, right, bottom = scene.box
        draw.rectangle((*place((left, top)), *place((right, bottom))), outline="black", width=2)
    return image


def _outline(star: bool) -> list[tuple[float, float]]:
    """Return the corners of a mark as (turn, radius in pixels): a star, or a disc."""
    if star:
        return [(i * math.pi / 5, 4.0 if i % 2 else 10.0) for i in range(10)]
    return [(i * math.pi / 8, 6.0) for i in range(16)]
