"""Feasibility maps with routes, as SVG: a picture that every browser draws.

Reads one tensor and route a panel; gives SVG, in which the map is a PNG of one pixel a cell.
Matplotlib belongs to the course, above the evaluation (see also `chart`).
"""

import base64
import io
from collections.abc import Mapping
from html import escape

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from fgtutor.elevation import ElevationMap
from fgtutor.routes import Route
from fgtutor.world.terrain import Section

SCALE, GAP, HEAD, FOOT = 24, 28, 64, 40
"""Pixels a metre; between two panels; above and below them."""
NARROWEST = 600
"""Width that the legend needs, px."""
BLUE, RED, DARK, CLOSED = (0, 114, 178), (213, 94, 0), (77, 77, 77), (217, 217, 217)
"""Feasible; the route; walls and words; closed. The colour-blind tell them apart."""


def draw_maps(
    elevation: ElevationMap,
    panels: Mapping[str, tuple[Float[Tensor, "nx ny 8"], Route | None]],
    *,
    title: str,
    f_min: float,
    walls: Bool[np.ndarray, "nx ny"],
    places: Mapping[str, Section],
) -> str:
    """Draw the same map once a panel, each with its feasibility and its route, side by side.

    The feasibility is the mean over the headings; a cell is closed where none reaches `f_min`.
    `places` are framed, and the height of what lies there is written below them.
    """
    length, width = (SCALE * side for side in elevation.size)
    total = max(len(panels) * (length + GAP) + GAP, NARROWEST)
    height = HEAD + width + FOOT
    parts = [_text(GAP, 24, title, 'font-size="15"')]
    for number, (name, (tensor, route)) in enumerate(panels.items()):
        left = GAP + number * (length + GAP)
        says = f"{name}: {route.length:.1f} m" if route else f"{name}: no way"
        picture = _png(tensor.numpy(), walls, f_min)
        parts += [
            _text(left, HEAD - 10, says, 'font-weight="bold"'),
            f'<image x="{left:g}" y="{HEAD}" width="{length:g}" height="{width:g}" '
            f'preserveAspectRatio="none" style="image-rendering:pixelated" '
            f'href="data:image/png;base64,{picture}"/>',
            # In metres from the map's corner; y grows upwards on the map, downwards in SVG.
            f'<g transform="translate({left:g} {HEAD + width:g}) scale({SCALE} {-SCALE}) '
            f'translate({-elevation.origin[0]:g} {-elevation.origin[1]:g})">',
            *(_frame(place) for place in places.values()),
            *(_line(route) if route else ()),
            "</g>",
        ]
        for place in places.values():
            x = left + SCALE * ((place.x0 + place.x1) / 2 - elevation.origin[0])
            y = HEAD + width - SCALE * (place.y0 - elevation.origin[1])
            top = elevation.crop(place.x0, place.y0, place.x1, place.y1).heights.max()
            style = f'font-size="11" text-anchor="middle" stroke="{_rgb(DARK)}" stroke-width="3"'
            words = f"{100 * top:.0f} cm high"
            parts.append(_text(x, y + 13, words, f'{style} paint-order="stroke"', "white"))
    legend = "blue: feasibility, mean of 8 headings; light grey: closed; dark: wall"
    parts.append(_text(GAP, height - 14, f"{legend}; circle: start; square: goal"))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total:g} {height:g}" '
        f'width="{total:g}" height="{height:g}" font-family="sans-serif" font-size="12">'
        f'<rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _frame(place: Section) -> str:
    return (
        f'<rect x="{place.x0:g}" y="{place.y0:g}" width="{place.x1 - place.x0:g}" '
        f'height="{place.y1 - place.y0:g}" fill="none" stroke="{_rgb(DARK)}" stroke-width="0.05"/>'
    )


def _line(route: Route) -> list[str]:
    """Draw a route and its ends, in metres."""
    points = " ".join(f"{x:.4g},{y:.4g}" for x, y in route.xy)
    line = f'<polyline points="{points}" fill="none" stroke-linejoin="round"'
    (x, y), (u, v) = route.xy[0], route.xy[-1]
    ends = f'fill="white" stroke="{_rgb(DARK)}" stroke-width="0.06"'
    return [
        f'{line} stroke="white" stroke-width="0.24"/>',
        f'{line} stroke="{_rgb(RED)}" stroke-width="0.13"/>',
        f'<circle cx="{x:g}" cy="{y:g}" r="0.2" {ends}/>',
        f'<rect x="{u - 0.2:g}" y="{v - 0.2:g}" width="0.4" height="0.4" {ends}/>',
    ]


def _png(
    tensor: Float[np.ndarray, "nx ny 8"], walls: Bool[np.ndarray, "nx ny"], f_min: float
) -> str:
    """Return the picture of a tensor in base64."""
    colours = 255 - tensor.mean(axis=-1)[..., None] * (255 - np.array(BLUE))
    colours[tensor.max(axis=-1) < f_min] = CLOSED
    colours[walls] = DARK
    buffer = io.BytesIO()
    # An image is [row = y, column = x], its first row the top one.
    Image.fromarray(colours.astype(np.uint8).transpose(1, 0, 2)[::-1]).save(buffer, "PNG")
    return base64.b64encode(buffer.getvalue()).decode()


def _text(x: float, y: float, words: str, style: str = "", colour: str = "") -> str:
    return f'<text x="{x:g}" y="{y:g}" fill="{colour or _rgb(DARK)}" {style}>{escape(words)}</text>'


def _rgb(colour: tuple[int, int, int]) -> str:
    return "#{:02X}{:02X}{:02X}".format(*colour)
