"""Slides: sliders above a picture that follows them, one or two for each notebook.

Reads what a notebook has at hand; gives widgets. A slide is a pure function from the sliders'
values to a picture (`slide_curves`, `slide_maps`) and a control for each of its arguments.
"""

import html
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from fgtutor.course.widgets.panels import Point
from fgtutor.course.widgets.slide_curves import (
    FASTEST,
    draw_advantage,
    draw_label_window,
    draw_reward,
)
from fgtutor.course.widgets.slide_maps import Frontier, Survey, draw_pose
from fgtutor.course.widgets.slide_routes import SWITCH_COSTS, Familiarity, Gates, SwitchPrices
from fgtutor.course.widgets.still import AS_DRAWN, LAYOUT, WIDE, Pictured, png, slider, w
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, FgtutorError
from fgtutor.feasibility import SIGMA
from fgtutor.figures.style import Picture
from fgtutor.patches import PatchGrid
from fgtutor.planning import Plan
from fgtutor.robots.lidar import LidarConfig
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

__all__ = [
    "AdvantageSlides",
    "FrontierSlides",
    "GateSlides",
    "LabelSlides",
    "LidarSlides",
    "PatchSlides",
    "RouteSlides",
    "Slides",
    "SwitchSlides",
    "TrackingSlides",
]


class Slides(Pictured):
    """Controls, and a picture drawn anew whenever one of them is moved.

    `draw(**values)` gets the value of each control by its name; what its picture says of itself
    (`alt`) stands below it. Arrow keys move a slider that has the focus.
    """

    def __init__(self, draw: Callable[..., Picture], **controls: w.ValueWidget) -> None:
        self.draw, self.controls = draw, controls
        self.image = w.Image(format="png", layout=AS_DRAWN)
        self.status = w.HTML()  # a label would cut a long line off
        for control in controls.values():
            control.observe(self._show, "value")
        super().__init__([*controls.values(), self.image, self.status])
        self._show()

    @property
    def values(self) -> dict[str, object]:
        """The value of each control, by its name."""
        return {name: control.value for name, control in self.controls.items()}

    def still(self) -> Picture:
        """Draw what the controls say."""
        return self.draw(**self.values)

    def _show(self, _: object = None) -> None:
        try:
            picture = self.still()
        except FgtutorError as error:
            self.status.value = html.escape(str(error), quote=False)
            return
        self.image.value = png(picture)
        self.status.value = html.escape(picture.alt, quote=False)


class PatchSlides(Slides):
    """Move a robot over a map and turn it: its window on the map, and the patch that it sees."""

    def __init__(self, elevation: ElevationMap, grid: PatchGrid | None = None) -> None:
        grid = grid or PatchGrid()
        (x0, y0, x1, y1), step = elevation.extent, elevation.resolution
        super().__init__(
            lambda x, y, yaw: draw_pose(elevation, grid, x, y, yaw),
            x=slider((x0 + x1) / 2, x0, x1, step / 2, "x (m)"),
            y=slider((y0 + y1) / 2, y0, y1, step / 2, "y (m)"),
            yaw=slider(0.0, -180.0, 180.0, 5.0, "yaw (degrees)"),
        )


class TrackingSlides(Slides):
    """How steeply r_v falls off with the speed, for any sigma (m/s)."""

    def __init__(self, command: float = 0.85, sigma: float = SIGMA) -> None:
        super().__init__(
            draw_reward,
            sigma=slider(sigma, 0.05, 1.0, 0.05, "sigma (m/s)"),
            command=slider(command, 0.0, FASTEST, 0.05, "command (m/s)"),
            speed=slider(0.6 * command, -0.5, FASTEST, 0.05, "speed (m/s)"),
        )


class LabelSlides(Slides):
    """The window of r_v that becomes the label of a moment.

    `tracking` holds (r_v, failed, ended) of one robot at each step, [time, 3], `dt` s apart. Raises
    `ConfigError` for other shapes.
    """

    def __init__(self, tracking: ArrayLike, dt: float, *, seconds: float = 1.0) -> None:
        rows = np.asarray(tracking)
        draw_label_window(rows, dt, 1, 0)  # what does not fit is said at once
        fails = np.flatnonzero(rows[:, 1])
        window = max(1, round(seconds / dt))
        moment = max(0, int(fails[0]) - window // 2) if len(fails) else len(rows) // 3
        super().__init__(
            lambda window, step: draw_label_window(rows, dt, window, step),
            window=_whole(window, 1, min(2 * window, len(rows) - 1), "window (steps)"),
            step=_whole(moment, 0, len(rows) - 1, "moment (step)"),
        )


class FrontierSlides(Slides):
    """A search over F_max [nx, ny, d], cell by cell: what is settled, and where the frontier is.

    Raises what `Frontier` raises.
    """

    def __init__(
        self,
        elevation: ElevationMap,
        fused: ArrayLike,
        start: Point,
        goal: Point,
        *,
        f_min: float = 0.1,
    ) -> None:
        self.frontier = Frontier(elevation, fused, start, goal, f_min=f_min)
        super().__init__(
            self.frontier.draw,
            search=w.ToggleButtons(
                options=list(self.frontier.orders), description="search", style=WIDE
            ),
            share=slider(40.0, 0.0, 100.0, 1.0, "settled (%)"),
        )


class SwitchSlides(Slides):
    """One map, planned with a dearer and dearer switch; raises what `SwitchPrices` raises."""

    def __init__(self, elevation: ElevationMap, planned: Plan, start: Point, goal: Point) -> None:
        self.prices = SwitchPrices(elevation, planned, start, goal)
        super().__init__(self.prices.draw, price=_choice(SWITCH_COSTS, 1.0, "switch cost"))


class AdvantageSlides(Slides):
    """How far back blame goes: the advantage of each step of one episode, for any lambda.

    There is one value more than rewards; else a `ConfigError` is raised.
    """

    def __init__(
        self, rewards: ArrayLike, values: ArrayLike, *, gamma: float = 0.99, lam: float = 0.95
    ) -> None:
        super().__init__(
            lambda lam, gamma: draw_advantage(rewards, values, gamma, lam),
            lam=slider(lam, 0.0, 1.0, 0.01, "lambda"),
            gamma=slider(gamma, 0.8, 0.999, 0.001, "gamma"),
        )


class GateSlides(Slides):
    """Which gates f_min leaves open to each policy, and how far its route goes round.

    `tensors` holds F [nx, ny, d] by name. Raises `ConfigError` without any.
    """

    def __init__(
        self,
        elevation: ElevationMap,
        tensors: Mapping[str, ArrayLike],
        start: Point,
        goal: Point,
        *,
        f_min: float = 0.1,
    ) -> None:
        self.gates = Gates(elevation, tensors, start, goal)
        super().__init__(self.gates.draw, f_min=slider(f_min, 0.01, 0.8, 0.01, "f_min"))


class RouteSlides(Slides):
    """Walk along a route: who drives there, and how familiar each policy finds the ground.

    `weights` holds w_ood [nx, ny, d] by policy. Raises what `Familiarity` raises.
    """

    def __init__(
        self, route: Route, elevation: ElevationMap, weights: Mapping[str, ArrayLike]
    ) -> None:
        self.familiarity = Familiarity(route, elevation, weights)
        super().__init__(
            self.familiarity.draw,
            metre=slider(route.length / 2, 0.0, route.length, elevation.resolution, "metres"),
        )


class LidarSlides(Slides):
    """A map that grows with the poses it was scanned from; raises what `scan_terrain` raises."""

    def __init__(
        self,
        terrain: Terrain,
        poses: Float[np.ndarray, "poses 6"],
        *,
        config: LidarConfig | None = None,
    ) -> None:
        self.survey = Survey(terrain, poses, config=config)
        count = len(self.survey.poses)
        super().__init__(self.survey.draw, count=_whole((count + 1) // 2, 1, count, "poses"))


def _whole(value: int, low: int, high: int, name: str) -> w.IntSlider:
    return w.IntSlider(value=value, min=low, max=high, description=name, style=WIDE, layout=LAYOUT)


def _choice(values: tuple[float, ...], value: float, name: str) -> w.SelectionSlider:
    if value not in values:
        raise ConfigError(f"{name} should be one of {values}, got {value}")
    return w.SelectionSlider(
        options=[(f"{one:g}", one) for one in values], value=value, description=name,
        style=WIDE, layout=LAYOUT,
    )  # fmt: skip
