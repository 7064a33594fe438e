"""The course's live widgets: drag the taus, paint a terrain, drive a robot.

Reads a map and a zoo; gives ipywidgets that a notebook shows. What they compute is in `explorer`,
`painting` and `driving`, which know no notebook; `board` shows it.
"""

import io
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from PIL import Image

from fgtutor.course.widgets.board import Board
from fgtutor.course.widgets.driving import Drive, Render
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.painting import Painting
from fgtutor.course.widgets.panels import Cell, Point, Scene, on_picture
from fgtutor.course.widgets.still import AS_DRAWN, LAYOUT, WIDE, Pictured, slider, w
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.elevation import ElevationMap
from fgtutor.errors import FgtutorError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW
from fgtutor.figures.style import Photo
from fgtutor.settings import SETTINGS, PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, Taus
from fgtutor.world.terrain import Terrain

CALIBRATED, PAIR = "calibrated", "one pair"
"""Whose thresholds weigh: each policy's own, or those of the slider for all."""
BEST = -1
"""The choice of no heading. Not None, by which a list shows that nothing is chosen."""
TAU_STEP = 0.05
"""Step of the tau slider. Where its ends meet, they are kept a tenth of it apart."""


class TauExplorer(Board):
    """Drag tau_low and tau_high and see what the robot dares: w_ood, F_max, P and the route follow.

    Its thresholds are those of each policy ("calibrated") until the slider, one pair for all, is
    moved. Below the maps stands how L_recon is spread on them, and the weight that it gets. A click
    sets the goal, or with Shift (or the switch above the map) the start; arrow keys move it. It
    begins with `settings` and `changes` as an `Explorer` does; its buttons choose ours or the
    paper's. `zoo` may hold `Assessment`s that were computed already. Raises what `Explorer` raises.
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
        self.rule = w.ToggleButtons(
            options=[CALIBRATED, PAIR],
            value=CALIBRATED if now.taus == CALIBRATED else PAIR,
            description="thresholds",
            tooltips=["each policy's own", "those of the slider, for all"],
            style=WIDE | {"button_width": "7em"},
            layout=LAYOUT,
        )
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
        self.f_min = slider(now.f_min, 0.01, 0.99, 0.01, "f_min")
        self.switch_cost = slider(now.switch_cost, 0.0, 20.0, 0.5, "switch cost")
        self.named = {name: w.Button(description=name) for name in SETTINGS}
        self.picks = w.ToggleButtons(
            options=["goal", "start"],
            description="a click sets",
            style={"button_width": "6em"},
            layout={"width": "24em"},
        )
        self.rule.observe(self._on_rule, "value")
        self.taus.observe(self._on_taus, "value")
        self.f_min.observe(lambda change: self._change(f_min=change["new"]), "value")
        self.switch_cost.observe(lambda change: self._change(switch_cost=change["new"]), "value")
        for box in self.policies.values():
            box.observe(self._on_policies, "value")
        for button in self.named.values():
            button.on_click(self._on_named)
        sliders = w.VBox([self.rule, self.taus, self.f_min, self.switch_cost])
        boxes = w.HBox([w.Label("may drive"), *self.policies.values()])
        named = w.HBox([w.Label("settings"), *self.named.values()])
        # Side by side where there is room, else below each other: nothing runs into anything.
        groups = w.HBox(
            [sliders, w.VBox([boxes, named, self.picks])],
            layout={"flex_flow": "row wrap", "grid_gap": "0 3em"},
        )
        super().__init__([groups], self.explorer)
        self._change()

    def _scene(self) -> Scene:
        return self._pictures.scene()

    def _on_rule(self, _: object) -> None:
        low, high = self.taus.value
        pair = (low, max(high, low + TAU_STEP / 10))
        self._change(taus=CALIBRATED if self.rule.value == CALIBRATED else pair)

    def _on_taus(self, change: Any) -> None:
        if self.rule.value == PAIR:
            self._on_rule(change)
        else:
            self.rule.value = PAIR

    def _on_policies(self, _: object) -> None:
        self._change(policies=[name for name, box in self.policies.items() if box.value])

    def _on_named(self, button: w.Button) -> None:
        chosen = SETTINGS[button.description]
        self.f_min.value, self.switch_cost.value = chosen.f_min, chosen.switch_cost
        if chosen.taus == "paper":
            self.taus.value = (TAU_LOW, TAU_HIGH)
        self.rule.value = CALIBRATED if chosen.taus == CALIBRATED else PAIR
        self._change(**asdict(chosen))

    def _change(self, **changes: Any) -> None:
        self.explorer.update(**changes)
        self._present()

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        role = "start" if content.get("shift") or self.picks.value == "start" else "goal"
        elevation = self.explorer.elevation
        if content["kind"] == "move":
            here = elevation.cell_of(*getattr(self.explorer, role))
            cells = [moved(elevation, here, content["step"])]
        if cells:
            self._change(**{role: elevation.centre_of(*cells[-1])})


class TerrainPainter(Board):
    """Paint heights, and see F change: only the cells whose patch saw the stroke are assessed.

    With `start` and `goal`, (x, y) in m, a route is planned around what is painted, and "drive"
    drives it. Arrow keys move the brush, Enter or Space paints. Raises what `Painting` raises.
    """

    def __init__(
        self,
        elevation: ElevationMap,
        specialist: Specialist,
        *,
        taus: Taus = "calibrated",
        f_min: float = 0.1,
        start: Point | None = None,
        goal: Point | None = None,
    ) -> None:
        self.painting = Painting(
            elevation, specialist, taus=taus, f_min=f_min, start=start, goal=goal
        )
        self._brush: Cell | None = None
        self.height = slider(0.15, -0.6, 0.6, 0.01, "height (m)")
        self.radius = slider(0.2, 0.0, 1.0, 0.05, "brush radius (m)")
        names = self.painting.assessment.headings.names
        self.heading = w.Dropdown(
            options=[("best", BEST), *((name, k) for k, name in enumerate(names))],
            value=BEST,
            description="F along heading",
            style=WIDE,
        )
        self.clear = w.Button(description="clear")
        self.drive = w.Button(description="drive", disabled=start is None)
        self.film = w.Image(format="png", layout=AS_DRAWN | {"display": "none"})
        self.heading.observe(self._on_heading, "value")
        self.clear.on_click(self._on_clear)
        self.drive.on_click(self._on_drive)
        super().__init__(
            [self.height, self.radius, w.HBox([self.heading, self.clear, self.drive])],
            self.painting,
        )
        self.children = (*self.children, self.film)
        self._present()

    def paint(self, cells: list[Cell]) -> None:
        """Paint with the brush as it is set."""
        self.painting.stroke(cells, self.height.value, self.radius.value)
        self.film.layout.display = "none"
        self._present()

    def _scene(self) -> Scene:
        scene = self.painting.scene()
        if self._brush is None:
            return scene
        place = on_picture(np.array([self._brush]), self.painting.elevation.shape[1])[0]
        return replace(scene, marks={**scene.marks, "brush": place})

    def _on_heading(self, _: object) -> None:
        self.painting.heading = None if self.heading.value == BEST else self.heading.value
        self._present()

    def _on_clear(self, _: object) -> None:
        self.painting.clear()
        self.film.layout.display = "none"
        self._present()

    def _on_drive(self, _: object) -> None:
        self.view.status = "driving ..."
        try:
            self.painting.drive()
            self._present()
            self.film.value = self.painting.strip()._repr_png_()
            self.film.layout.display = ""
        except FgtutorError as error:
            self.view.status = str(error)

    def _act(self, content: dict[str, Any], cells: list[Cell]) -> None:
        elevation = self.painting.elevation
        here = self._brush or (elevation.shape[0] // 2, elevation.shape[1] // 2)
        if content["kind"] == "move":
            self._brush = moved(elevation, here, content["step"])
            self._present()
        elif content["kind"] == "enter":
            self.paint([here])
        elif cells:
            self.paint(cells)


class DriveA1(Pictured):
    """Drive a robot by slider: the A1 where `render` draws one, else the toy.

    It begins with the policy that has the ground's name, if there is one; the hull has the colour
    of the policy that drives. `render(env)` returns a frame [height, width, 3] of robot 0. Raises
    what `Drive` raises.
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
        self.speed = slider(drive.speed, -drive.top_speed, drive.top_speed, 0.05, "speed (m/s)")
        self.turn = slider(0.0, -drive.top_turn, drive.top_turn, 0.05, "turn rate (rad/s)")
        self.policy = w.Dropdown(
            options=list(zoo), value=drive.policy, description="policy", style=WIDE
        )
        self.play = w.Play(
            min=0, max=10**6, interval=round(1000 / self.FPS), show_repeat=False, value=0
        )
        self.reset = w.Button(description="reset")
        self.image = w.Image(format="jpeg", layout=AS_DRAWN)
        self.status = w.Label()
        for control, name in ((self.speed, "speed"), (self.turn, "turn"), (self.policy, "policy")):
            control.observe(self._setter(name), "value")
        self.play.observe(self._on_tick, "value")
        self.reset.on_click(self._on_reset)
        super().__init__(
            [self.speed, self.turn, w.HBox([self.policy, self.play, self.reset]),
             self.status, self.image]
        )  # fmt: skip
        self._show()

    def still(self) -> Photo:
        """Return the robot as it stands."""
        return Photo(Image.fromarray(self.drive.frame()), f"The robot: {self.drive.status}")

    def _setter(self, name: str) -> Callable[[Any], None]:
        def take(change: Any) -> None:
            setattr(self.drive, name, change["new"])
            if not self.play.playing:  # else the next frame shows it
                self._show()

        return take

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
        Image.fromarray(self.drive.frame()).save(buffer, format="JPEG", quality=92)
        self.image.value = buffer.getvalue()
        self.status.value = self.drive.status


def moved(elevation: ElevationMap, cell: Cell, step: list[int]) -> Cell:
    """Return the cell a step away, or the last one before the edge of the map."""
    ix, iy = np.clip(np.add(cell, step), 0, np.subtract(elevation.shape, 1)).tolist()
    return ix, iy
