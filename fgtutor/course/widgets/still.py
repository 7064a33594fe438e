"""A widget that brings a picture of itself, for every page that has no kernel behind it.

Reads what a widget shows; gives the notebook both the live view and a PNG with words. JupyterLab
shows the live view; a page without a kernel, and the notebooks that are built, keep the PNG.
"""

import base64
import io
from abc import abstractmethod
from typing import Any

from PIL import Image

from fgtutor.errors import MissingExtraError
from fgtutor.figures.style import Picture, Shown

try:
    import anywidget
    import ipywidgets as w
    import traitlets
except ImportError as error:
    raise MissingExtraError(
        f"the widgets need the package {error.name}, which is not installed: in the clone of "
        'fgtutor pip install -c constraints.txt -e ".[lab]"'
    ) from error

__all__ = ["AS_DRAWN", "LAYOUT", "WIDE", "Pictured", "anywidget", "png", "slider", "traitlets", "w"]

WIDE = {"description_width": "9em"}
LAYOUT = {"width": "32em"}
AS_DRAWN = {"width": "auto", "max_width": "100%", "align_self": "flex-start"}
"""A picture as large as it was drawn: stretched to the page it would be jagged."""


class Pictured(w.VBox):
    """A column of widgets that shows `still()` where nothing can be live."""

    @abstractmethod
    def still(self) -> Shown:
        """Return a picture of the widget as it is now."""

    def _repr_mimebundle_(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, **options: Any
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        live = super()._repr_mimebundle_(**options) or {}
        picture, words = self.still()._repr_mimebundle_()
        png = base64.b64encode(picture["image/png"]).decode()
        return live | {"image/png": png}, words


def slider(value: float, low: float, high: float, step: float, name: str) -> w.FloatSlider:
    """Return a slider that follows the mouse and the arrow keys."""
    return w.FloatSlider(
        value=value, min=low, max=high, step=step, description=name, style=WIDE, layout=LAYOUT
    )


def png(picture: Picture) -> bytes:
    """Return a picture as PNG, in a fraction of the time that a small file would take."""
    picture.canvas.draw()  # pyright: ignore[reportAttributeAccessIssue]
    pixels = picture.canvas.buffer_rgba()  # pyright: ignore[reportAttributeAccessIssue]
    buffer = io.BytesIO()
    Image.frombuffer("RGBA", picture.canvas.get_width_height(), pixels).convert("RGB").save(
        buffer, format="PNG", compress_level=1
    )
    return buffer.getvalue()
