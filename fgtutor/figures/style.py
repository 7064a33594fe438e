"""The style that all pictures share: colours, titles, the kind of figure, and how one is saved.

Gives `Picture`, a matplotlib figure that a notebook shows by itself and that any thread may draw.
Nothing here touches pyplot, whose figures are global state.
"""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Interval
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from fgtutor.directions import Headings
from fgtutor.errors import ConfigError
from fgtutor.io.storage import atomic_write
from fgtutor.io.validation import check_arguments

POLICY_COLOURS = {
    "steps": "#0072B2",
    "gaps": "#D55E00",
    "slopes": "#009E73",
    "rubble": "#CC79A7",
    "bridge": "#E69F00",
    "valley": "#56B4E9",
    "general": "#4D4D4D",
    "ours": "#332288",
}
"""A policy has one colour in the whole course: Okabe and Ito's, safe for the colour-blind."""
HEADING_COLOURS = (
    "#E69F00", "#B8A23A", "#009E73", "#56B4E9", "#0072B2", "#6F6DAE", "#CC79A7", "#D55E00",
)  # fmt: skip
"""One colour per 45 degrees, in a circle: neighbours resemble each other."""
OTHER_COLOURS = ("#882255", "#999933", "#44AA99", "#F0E442")
"""Policies that the course does not know take these in turn: Paul Tol's muted ones and a yellow."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of curves that belong to no policy, in turn."""
INK = "#1E2328"
"""The colour of words and outlines."""
TITLE = {"fontsize": 10.5, "weight": "bold", "ha": "left"}
"""How titles look."""
Panels = Annotated[int, Interval(ge=1, le=1000)]
"""A number of pictures, in all or side by side."""
Dpi = Annotated[float, Interval(ge=1, le=2400)]
"""Dots per inch."""


class Picture(Figure):
    """A figure without screen or pyplot that a notebook shows when it is a cell's last value."""

    def __init__(self, width: float = 7.0, height: float = 5.0) -> None:
        super().__init__(figsize=(width, height), layout="constrained", dpi=100)
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def save_figure(figure: Figure, path: str | Path, dpi: Dpi = 120) -> Path:
    """Write a figure whole or not at all; the suffix chooses the format (.png, .svg, .pdf ...).

    Raises:
        ConfigError: The suffix is no picture format, or `dpi` no number of dots.
        StorageError: The system refused to write.
    """
    check_arguments(save_figure, locals(), ConfigError)
    path = Path(path)
    formats = figure.canvas.get_supported_filetypes()
    if path.suffix[1:].lower() not in formats:
        raise ConfigError(f"cannot draw {path.name!r}: give it a suffix of {', '.join(formats)}")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


def policy_colours(names: Sequence[str]) -> dict[str, str]:
    """Return the colour of each policy; names that the course does not know take a cycle."""
    unknown = [name for name in names if name not in POLICY_COLOURS]
    others = {name: OTHER_COLOURS[i % len(OTHER_COLOURS)] for i, name in enumerate(unknown)}
    return {name: POLICY_COLOURS.get(name) or others[name] for name in names}


def heading_colours(headings: Headings) -> Float[np.ndarray, "d 3"]:
    """Return the colour of each heading, red, green and blue; between two it is a mixture."""
    circle, at = np.array([to_rgb(colour) for colour in HEADING_COLOURS]), headings.yaws / np.pi * 4
    return np.stack([np.interp(at, range(8), part, period=8) for part in circle.T], axis=-1)


def colours_of(names: Iterable[str]) -> list[str]:
    """Return for each name the policy's own colour, or the next of the curves' colours."""
    return [POLICY_COLOURS.get(name, LINES[i % len(LINES)]) for i, name in enumerate(names)]
