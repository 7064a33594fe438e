"""A chart of success rates with their intervals, as SVG: a text that every browser draws.

Reads groups of shares; gives SVG. Matplotlib belongs to the course, above the evaluation, and a row
of dots needs none of it.
"""

from collections.abc import Mapping
from html import escape

from fgtutor.statistics import Share

WIDTH, LEFT, RIGHT = 640, 200, 24
"""The picture's width, and the room left and right of the axis, px."""
LINE, HEAD = 18, 34
"""Height of a line and of a group's heading, px."""
BLUE, GREY, LIGHT = "#0072B2", "#4D4D4D", "#D9D9D9"


def share_chart(groups: Mapping[str, Mapping[str, Share]], title: str) -> str:
    """Draw one dot and its interval a share, under the heading of its group, on 0 to 100 %."""
    marks: list[str] = []
    y = 44.0
    top = y

    def text(x: float, y: float, words: str, anchor: str = "start", more: str = "") -> str:
        return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}"{more}>{escape(words)}</text>'

    for group, shares in groups.items():
        y += HEAD
        marks.append(text(16, y - 8, group, more=' font-weight="bold"'))
        for name, share in shares.items():
            y += LINE
            low, high = (_x(end) for end in share.interval)
            dot = _x(share.successes / share.trials)
            marks.append(text(LEFT - 12, y - 5, name, anchor="end"))
            marks.append(
                f'<path d="M{low:.1f} {y - 9:g}H{high:.1f}" stroke="{BLUE}" stroke-width="3" '
                f'stroke-opacity="0.45"/><circle cx="{dot:.1f}" cy="{y - 9:g}" r="4.5" '
                f'fill="{BLUE}"/>'
            )
    axis = "".join(
        f'<path d="M{_x(tick):g} {top:g}V{y + 6:g}" stroke="{LIGHT}"/>'
        + text(_x(tick), y + 22, f"{100 * tick:.0f} %", anchor="middle")
        for tick in (0.0, 0.25, 0.5, 0.75, 1.0)
    )
    height = y + 34
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height:g}" '
        f'viewBox="0 0 {WIDTH} {height:g}" font-family="sans-serif" font-size="12" fill="{GREY}">'
        f'<rect width="100%" height="100%" fill="white"/>'
        + text(16, 26, title, more=' font-size="14" font-weight="bold"')
        + axis
        + "".join(marks)
        + "</svg>\n"
    )


def _x(share: float) -> float:
    """Return where on the axis a share lies, px."""
    return LEFT + share * (WIDTH - LEFT - RIGHT)
