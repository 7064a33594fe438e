"""The style that all pictures share: colours, titles, the kind of figure, and how one is saved.

Gives `Picture`, a matplotlib figure that a notebook shows by itself and that any thread may draw,
and `Photo`, the same for pixels. Both bring words for those who cannot see them.
Nothing here touches pyplot, whose figures are global state.
"""

import io
import re
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Interval
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from PIL import Image

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
OTHER_COLOURS = ("#882255", "#999933", "#44AA99", "#F0E442")
"""Policies that the course does not know take these in turn: Paul Tol's muted ones and a yellow."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of curves that belong to no policy, in turn."""
DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)))
"""Curves differ in their dashes too: colour alone carries no meaning."""
F_COLOURS = "viridis"
"""The palette of f and F, from 0 to 1."""
INK = "#1E2328"
"""The colour of words and outlines."""
TITLE = {"fontsize": 10.5, "weight": "bold", "ha": "left"}
"""How titles look."""
TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.06}
"""How a figure is saved: the page fits what is drawn, so that no word is ever cut off."""
DPI = 110
"""Dots per inch on a page: a figure 7.5 inches wide nearly fills a notebook's cell."""
LONGEST = 600
"""Letters of the longest words that stand for a picture."""
Panels = Annotated[int, Interval(ge=1, le=1000)]
"""A number of pictures, in all or side by side."""
Dpi = Annotated[float, Interval(ge=1, le=2400)]
"""Dots per inch."""


class Shown(ABC):
    """What a notebook shows as a PNG, with words for those who cannot see it."""

    alt: str = ""
    """What the picture shows; "" is `described`."""

    @abstractmethod
    def described(self) -> str:
        """Return the words that the picture itself has."""

    @abstractmethod
    def _repr_png_(self) -> bytes: ...

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> tuple[dict, dict]:
        words = {"alt": self.alt or self.described()}
        return {"image/png": self._repr_png_()}, {"image/png": words}


class Picture(Shown, Figure):
    """A figure without screen or pyplot that a notebook shows when it is a cell's last value."""

    def __init__(self, width: float = 7.0, height: float = 5.0) -> None:
        super().__init__(figsize=(width, height), layout="constrained", dpi=100)
        FigureCanvasAgg(self)

    def described(self) -> str:
        """Return its titles, labels and legends, panel by panel."""
        panels = [_words(axes) for axes in self.axes]
        parts = [_suptitles(self), *panels, *(_names(legend) for legend in self.legends)]
        text = ". ".join(dict.fromkeys(part for part in parts if part))
        return textwrap.shorten(text, LONGEST, placeholder=" ...") or "A picture without words"

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=DPI, **TIGHT)
        return buffer.getvalue()


class Photo(Shown):
    """A picture made of pixels, such as a film strip."""

    def __init__(self, image: Image.Image, alt: str) -> None:
        """Keep an image, and say in words what it shows."""
        self.image, self.alt = image, alt

    def described(self) -> str:
        """Return the words it was given."""
        return self.alt

    def save(self, path: str | Path) -> None:
        """Write it; the suffix chooses the format."""
        self.image.save(path)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.image.save(buffer, format="PNG")
        return buffer.getvalue()


def _words(axes: Axes) -> str:
    """Return the title, the labels and the legend of a panel, or "" if it has none."""
    titles = [axes.get_title(loc=loc) for loc in ("left", "center", "right")]
    texts = [*titles, axes.get_xlabel(), axes.get_ylabel(), _names(axes.get_legend())]
    return _plain(", ".join(text for text in texts if text))


def _names(legend: Legend | None) -> str:
    """Return what a legend names."""
    texts = [text.get_text() for text in legend.get_texts()] if legend else []
    return _plain(", ".join(texts))


def _suptitles(figure: Figure) -> str:
    """Return the titles over several panels."""
    found = [figure, *figure.subfigs]
    found += [panel for one in figure.subfigs for panel in one.subfigs]
    return _plain(". ".join(text for panel in found if (text := panel.get_suptitle())))


def _plain(text: str) -> str:
    """Return words without marks of mathematics and breaks of lines."""
    return re.sub(r"[$\\{}]", "", text).replace("\n", ", ")


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
        figure.savefig(temporary, dpi=dpi, **TIGHT)
    return path


def policy_colours(names: Sequence[str]) -> dict[str, str]:
    """Return the colour of each policy; names that the course does not know take a cycle."""
    unknown = [name for name in names if name not in POLICY_COLOURS]
    others = {name: OTHER_COLOURS[i % len(OTHER_COLOURS)] for i, name in enumerate(unknown)}
    return {name: POLICY_COLOURS.get(name) or others[name] for name in names}


def colours_of(names: Iterable[str]) -> list[str]:
    """Return for each name the policy's own colour, or the next of the curves' colours."""
    return [POLICY_COLOURS.get(name, LINES[i % len(LINES)]) for i, name in enumerate(names)]
