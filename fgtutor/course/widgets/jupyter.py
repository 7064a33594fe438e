"""The course's live widgets: drag the taus, paint a terrain, drive a robot.

Reads a map and a zoo; gives ipywidgets that a notebook shows. What they compute is in `explorer`,
`painting` and `driving`, which know no notebook; the canvas is `static/panels.js`, sent with the
widget, so that nothing is fetched from anywhere.
"""

import io
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fgtutor.course.widgets.driving import Drive, Render
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.painting import Painting
from fgtutor.course.widgets.panels import Cell, Point, Scene
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.elevation import ElevationMap
from fgtutor.errors import FgtutorError, MissingExtraError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW
from fgtutor.settings import SETTINGS, PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, Taus
from fgtutor.world.terrain import Terrain

try:
    import anywidget
    import ipywidgets as w
    import traitlets
except ImportError as error:
    raise MissingExtraError(
        f"the widgets need the package {error.name}, which is not installed: in the clone of "
        'fgtutor pip install -c constraints.txt -e ".[lab]"'
    ) from error

STATIC = Path(__file__).parent / "static"
WIDE = {"description_width": "9em"}
LAYOUT = {"width": "32em"}
TAU_STEP = 0.05
"""Step of the tau slider. Where its ends meet, they are kept a tenth of it apart."""


class Canvas(anywidget.AnyWidget):
    """A scene on the browser's canvas, which answers the mouse and the keyboard.

    `on_msg` hands over what a person did: {"kind": "press" | "drag" | "hover" | "move", ...}
    with "cells" [[ix, iy], ...], or for arrow keys a "step" [dx, dy].
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
            }
            self.status = scene.status
            self.frame += 1


class _Board(w.VBox):
    """Controls above a canvas; handles what a person does and shows what became of it."""

    def __init__(self, controls: list[w.Widget], model: Explorer | Painting) -> None:
        self.view, self._model = Canvas(), model
        self._hovered: Cell | None = None
        super().__init__([*controls, self.view])
        self.view.on_msg(self._on_message)

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

    def _present(self, scene: Scene) -> None:
        """Show a scene, and the numbers of the cell under the mouse as they now are."""
        self.view.show(scene)
        if self._hovered is not None:
            self._reread()

    def _reread(self) -> None:
        self.view.reading = "" if self._hovered is None else self._model.read(self._hovered)

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        raise NotImplementedError


class TauExplorer(_Board):
    """Drag tau_low and tau_high and see what the robot dares: w_ood, F_max, P and the route follow.

    A click sets the goal, or with Shift (or the switch above the map) the start; arrow keys move
    it. It begins with `settings` and `changes` as an `Explorer` does; its buttons choose ours or
    the paper's. `zoo` may hold `Assessment`s that were computed already. Raises what `Explorer`
    raises.
    """

    def __init__(
        self,
        elevation: ElevationMap,
        zoo: Mapping[str, Specialist | Assessment],
        start: Point,
        goal: Point,
        settings: PlanSettings | None = None,
        *,
        tau_limit: float = 5.0,
        **changes: Any,
    ) -> None:
        self.explorer = Explorer(elevation, zoo, start, goal, settings, **changes)
        self._pictures = TauPictures(self.explorer)
        now = self.explorer.settings
        taus = (TAU_LOW, TAU_HIGH) if isinstance(now.taus, str) else now.taus
        self.taus = w.FloatRangeSlider(
            value=taus,
            min=0.0,
            max=max(tau_limit, *taus),
            step=TAU_STEP,
            description="tau low, high",
            readout_format=".2f",
            style=WIDE,
            layout=LAYOUT,
        )
        self.policies = {
            name: w.Checkbox(
                value=name in self.explorer.policies,
                description=name,
                indent=False,
                layout={"width": "auto"},
            )
            for name in self.explorer.names
        }
        self.f_min = _slider(now.f_min, 0.01, 0.99, 0.01, "f_min")
        self.switch_cost = _slider(now.switch_cost, 0.0, 20.0, 0.5, "switch cost")
        self.named = {name: w.Button(description=name) for name in SETTINGS}
        self.picks = w.ToggleButtons(
            options=["goal", "start"], description="a click sets", style={"button_width": "6em"}
        )
        self.taus.observe(self._on_taus, "value")
        self.f_min.observe(lambda change: self._change(f_min=change["new"]), "value")
        self.switch_cost.observe(lambda change: self._change(switch_cost=change["new"]), "value")
        for box in self.policies.values():
            box.observe(self._on_policies, "value")
        for button in self.named.values():
            button.on_click(self._on_named)
        sliders = w.VBox([self.taus, self.f_min, self.switch_cost])
        boxes = w.HBox(list(self.policies.values()))
        named = w.HBox([w.Label("settings"), *self.named.values()])
        super().__init__([w.HBox([sliders, w.VBox([boxes, named, self.picks])])], self.explorer)
        self._change()

    def _on_taus(self, change: Any) -> None:
        low, high = change["new"]
        self._change(taus=(low, max(high, low + TAU_STEP / 10)))

    def _on_policies(self, _: object) -> None:
        self._change(policies=[name for name, box in self.policies.items() if box.value])

    def _on_named(self, button: w.Button) -> None:
        chosen = SETTINGS[button.description]
        self.f_min.value, self.switch_cost.value = chosen.f_min, chosen.switch_cost
        if chosen.taus == "paper":
            self.taus.value = (TAU_LOW, TAU_HIGH)
        self._change(**asdict(chosen))

    def _change(self, **changes: Any) -> None:
        self.explorer.update(**changes)
        self._present(self._pictures.scene())

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        role = "start" if content.get("shift") or self.picks.value == "start" else "goal"
        elevation = self.explorer.elevation
        if content["kind"] == "move":
            here = elevation.cell_of(*getattr(self.explorer, role))
            moved = np.clip(np.add(here, content["step"]), 0, np.subtract(elevation.shape, 1))
            cells = [(int(moved[0]), int(moved[1]))]
        self._change(**{role: elevation.centre_of(*cells[-1])})


class TerrainPainter(_Board):
    """Paint heights, and see F change: only the cells whose patch saw the stroke are assessed."""

    def __init__(
        self,
        elevation: ElevationMap,
        specialist: Specialist,
        *,
        taus: Taus = "calibrated",
        f_min: float = 0.1,
    ) -> None:
        self.painting = Painting(elevation, specialist, taus=taus, f_min=f_min)
        self.height = _slider(0.15, -0.6, 0.6, 0.01, "height (m)")
        self.radius = _slider(0.2, 0.0, 1.0, 0.05, "brush radius (m)")
        names = self.painting.assessment.headings.names
        self.heading = w.Dropdown(
            options=[("best", None), *((name, k) for k, name in enumerate(names))],
            description="F along heading",
            style=WIDE,
        )
        self.clear = w.Button(description="clear")
        self.heading.observe(self._on_heading, "value")
        self.clear.on_click(self._on_clear)
        super().__init__(
            [self.height, self.radius, w.HBox([self.heading, self.clear])], self.painting
        )
        self._present(self.painting.scene())

    def paint(self, cells: list[Cell]) -> None:
        """Paint with the brush as it is set."""
        self.painting.stroke(cells, self.height.value, self.radius.value)
        self._present(self.painting.scene())

    def _on_heading(self, _: object) -> None:
        self.painting.heading = self.heading.value
        self._present(self.painting.scene())

    def _on_clear(self, _: object) -> None:
        self.painting.clear()
        self._present(self.painting.scene())

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        if cells:
            self.paint(cells)


class DriveA1(w.VBox):
    """Drive a robot by slider: the A1 where `render` draws one, else the toy.

    `render(env)` returns a frame [height, width, 3] of robot 0. Raises what `Drive` raises.
    """

    FPS = 12.5
    """Frames a second that the play button asks for; a slower machine shows fewer."""

    def __init__(
        self,
        terrain: Terrain,
        zoo: Mapping[str, Specialist],
        *,
        render: Render | None = None,
        yaw: float = 0.0,
    ) -> None:
        self.drive = drive = Drive(terrain, zoo, render=render, yaw=yaw)
        self.speed = _slider(drive.speed, 0.0, drive.top_speed, 0.05, "speed (m/s)")
        self.turn = _slider(0.0, -drive.top_turn, drive.top_turn, 0.05, "turn rate (rad/s)")
        self.policy = w.Dropdown(options=list(zoo), description="policy", style=WIDE)
        self.play = w.Play(
            min=0, max=10**6, interval=round(1000 / self.FPS), show_repeat=False, value=0
        )
        self.reset = w.Button(description="reset")
        self.image = w.Image(format="jpeg")
        self.status = w.Label()
        for control, name in ((self.speed, "speed"), (self.turn, "turn"), (self.policy, "policy")):
            control.observe(self._setter(name), "value")
        self.play.observe(self._on_tick, "value")
        self.reset.on_click(self._on_reset)
        super().__init__(
            [self.speed, self.turn, w.HBox([self.policy, self.play, self.reset]),
             self.image, self.status]
        )  # fmt: skip
        self._show()

    def _setter(self, name: str) -> Callable[[Any], None]:
        return lambda change: setattr(self.drive, name, change["new"])

    def _on_tick(self, change: Any) -> None:
        # The play button starts again at 0: no time passes then.
        if change["new"] > 0 and not self.drive.fallen:
            self.drive.advance(1 / self.FPS)
            self._show()
        if self.drive.fallen:
            self.play.playing = False

    def _on_reset(self, _: object) -> None:
        self.play.playing = False
        self.drive.reset()
        self._show()

    def _show(self) -> None:
        buffer = io.BytesIO()
        Image.fromarray(self.drive.frame()).save(buffer, format="JPEG", quality=85)
        self.image.value = buffer.getvalue()
        self.status.value = self.drive.status


def _slider(value: float, low: float, high: float, step: float, name: str) -> w.FloatSlider:
    return w.FloatSlider(
        value=value, min=low, max=high, step=step, description=name, style=WIDE, layout=LAYOUT
    )
