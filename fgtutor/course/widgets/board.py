"""A scene on the browser's canvas, below the controls that change it.

Reads a `Scene` and what a person does with mouse and keyboard; gives both to the widget built on
it. The canvas is `static/panels.js`, sent with the widget, so that nothing is fetched from
anywhere.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.painting import Painting
from fgtutor.course.widgets.panels import Cell, Scene
from fgtutor.course.widgets.scene_figure import scene_figure
from fgtutor.course.widgets.still import Pictured, anywidget, traitlets, w
from fgtutor.errors import FgtutorError
from fgtutor.figures.style import Picture

STATIC = Path(__file__).parent / "static"


class Canvas(anywidget.AnyWidget):
    """A scene on the browser's canvas, which answers the mouse and the keyboard.

    `on_msg` hands over what a person did: {"kind": "press" | "drag" | "hover", ...} with "cells"
    [[ix, iy], ...], for arrow keys "move" with a "step" [dx, dy], and "enter" for Enter or Space.
    """

    # Texts, not paths: anywidget would watch a file for changes with a thread of its own.
    _esm = (STATIC / "panels.js").read_text(encoding="utf-8")
    _css = (STATIC / "panels.css").read_text(encoding="utf-8")
    rows = traitlets.List().tag(sync=True)
    shape = traitlets.List().tag(sync=True)
    pictures = traitlets.Dict().tag(sync=True)
    overlay = traitlets.Dict().tag(sync=True)
    status = traitlets.Unicode().tag(sync=True)
    reading = traitlets.Unicode().tag(sync=True)
    frame = traitlets.Int(0).tag(sync=True)

    def show(self, scene: Scene) -> None:
        """Draw a scene; the browser gets all of it in one message, or nothing torn."""
        first = next(iter(scene.pictures.values()))
        with self.hold_sync():
            self.rows = [[asdict(panel) for panel in row] for row in scene.rows]
            self.shape = [first.shape[1], first.shape[0]]
            self.pictures = {key: cells.tobytes() for key, cells in scene.pictures.items()}
            self.overlay = {
                "lines": [{"colour": colour, "points": points} for colour, points in scene.lines],
                "marks": scene.marks,
                "box": scene.box,
                "legend": scene.legend,
                "hatched": scene.hatched,
                "extent": scene.extent,
                "charts": [asdict(chart) for chart in scene.charts],
            }
            self.status = scene.status
            self.frame += 1


class Board(Pictured):
    """Controls above a canvas; handles what a person does and shows what became of it."""

    def __init__(self, controls: list[w.Widget], model: Explorer | Painting) -> None:
        self.view, self._model = Canvas(), model
        self._hovered: Cell | None = None
        super().__init__([*controls, self.view])
        self.view.on_msg(self._on_message)

    def _scene(self) -> Scene:
        """Return what the canvas shows."""
        raise NotImplementedError

    def still(self) -> Picture:
        """Draw the scene as it is now."""
        return scene_figure(self._scene())

    def _on_message(self, _: Any, content: dict[str, Any], __: Any) -> None:
        """Act on a message of the canvas, and tell it when the answer has been sent."""
        try:
            cells = [(int(ix), int(iy)) for ix, iy in content.get("cells", [])]
            if content["kind"] == "hover":
                self._hovered = cells[-1] if cells else None
                self._reread()
            else:
                self._act(content, cells)
        except FgtutorError as error:
            self.view.status = str(error)
        finally:
            if content["kind"] != "hover":
                self.view.send({"kind": "done"})

    def _present(self) -> None:
        """Show the scene, and the numbers of the cell under the mouse as they now are."""
        self.view.show(self._scene())
        if self._hovered is not None:
            self._reread()

    def _reread(self) -> None:
        self.view.reading = "" if self._hovered is None else self._model.read(self._hovered)

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        raise NotImplementedError
