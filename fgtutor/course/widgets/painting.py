"""Painting heights, and seeing which feasibilities follow: only those whose patch was touched.

Reads a map and one specialist, and where wanted a start and a goal; gives f, L_recon and F of the
painted map, the route over it, and the drive along that route. A stroke assesses the tiles whose
patches see it, not the map (`reassess`). Source: paper, Sec. III-B (a patch is local).
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import find_objects

from fgtutor.course.widgets.panels import (
    Cell,
    Panel,
    Point,
    Scene,
    cell_table,
    check_cell,
    feasibility_picture,
    ground_picture,
    on_picture,
)
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode, FollowConfig, execute
from fgtutor.figures.style import INK, Photo, policy_colours
from fgtutor.figures.videos import film_strip
from fgtutor.planning import plan
from fgtutor.routes import Refusal, Route
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, Taus, assess, reassess
from fgtutor.world.terrain import Terrain

Window = tuple[slice, slice]
FOLLOW = FollowConfig(patience=1.5, grace=2.0)
"""How a painted route is driven: who is stuck is not waited for."""
SMALL = 0.6
"""A stroke that more than this share of the cells sees lies on a map too small to show that the
rest stays as it was."""


class Painting:
    """A map to paint on, and what one specialist says of it at every moment."""

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
        """Assess the whole map once; cells that were never observed become ground as filled.

        With `start` and `goal`, (x, y) in m, a route is planned after every stroke.

        Raises:
            ConfigError: There is a start without a goal, or a goal without a start.
            OffMapError: Start or goal is off the map.
            ThresholdError: The taus cannot be used.
        """
        if (start is None) != (goal is None):
            raise ConfigError("a route needs a start and a goal: give both of them, or neither")
        self.ends = None if start is None or goal is None else (start, goal)
        """Start and goal (x, y), m, if a route is planned."""
        self.specialist, self.f_min = specialist, f_min
        self._taus: Taus = taus
        self._blank = elevation.filled().heights
        self._resolution, self._origin = elevation.resolution, elevation.origin
        self.heading: int | None = None
        """The heading whose F is shown; None shows each cell's best."""
        self.clear()

    def clear(self) -> None:
        """Take back every stroke."""
        self.elevation = self._map(self._blank)
        """The map as painted so far."""
        self.assessment: Assessment = assess(self.elevation, self.specialist, taus=self._taus)
        """f and L_recon of the painted map."""
        self.window: Window | None = None
        """The rectangle around the cells whose patches see the last stroke."""
        self._plan()

    def stroke(self, cells: Sequence[Cell], height: float, radius: float) -> Window | None:
        """Set the ground within `radius` (m) of each cell's centre to `height` (m).

        Returns the rectangle of cells whose patches see a change, None if there is none.
        Raises `ConfigError` if a number is not finite, the radius is negative or a cell is off the
        map.
        """
        if not (math.isfinite(height) and math.isfinite(radius) and radius >= 0):
            raise ConfigError(
                f"a stroke needs a finite height and a radius of 0 m or more, got {height} and "
                f"{radius}"
            )
        nx, ny = self.elevation.shape
        ix, iy = np.ogrid[:nx, :ny]
        heights = self.elevation.heights.copy()
        for cell in cells:
            check_cell(self.elevation, cell)
            away = np.hypot(ix - cell[0], iy - cell[1]) * self._resolution
            heights[away <= radius + 1e-9] = height
        self.elevation = self._map(heights)
        name = self.specialist.name
        said, seen = reassess({name: self.assessment}, self.elevation)
        self.assessment, self.window = said[name], next(iter(find_objects(seen.astype(int))), None)
        self._plan()
        return self.window

    def _plan(self) -> None:
        """Plan over the map as it is; a drive over the map as it was is forgotten."""
        self.answer: Route | Refusal | None = None
        """The cheapest route, or why there is none; None without start and goal."""
        self.episode: Episode | None = None
        """How the robot drove that route."""
        if self.ends is None:
            return
        F, (start, goal) = self.assessment.weighted(), self.ends
        self.answer = plan(
            F,
            np.zeros(F.shape, dtype=int),
            grid=self.elevation,
            start=start,
            goal=goal,
            names=(self.specialist.name,),
            f_min=self.f_min,
        )

    def drive(self) -> Episode:
        """Drive the route, and return what came of it.

        Raises `ConfigError` without start and goal, and the reason, a `PlanningError`, if there is
        no route.
        """
        if self.ends is None or self.answer is None:
            raise ConfigError("a drive needs a route: give the painting a start and a goal")
        terrain, name = self._terrain(self.ends), self.specialist.name
        self.episode = execute(self.answer, terrain, {name: self.specialist}, config=FOLLOW)
        return self.episode

    def strip(self) -> Photo:
        """Return four moments of the drive; raises `ConfigError` before it."""
        if self.ends is None or self.episode is None or not isinstance(self.answer, Route):
            raise ConfigError("nothing was driven on this map yet: drive first")
        return film_strip(self.episode, self._terrain(self.ends), self.answer, count=4)

    def _terrain(self, ends: tuple[Point, Point]) -> Terrain:
        """Return the painted map as ground to drive on."""
        return Terrain.from_elevation(self.elevation, *ends, robot=self.specialist.robot)

    def _map(self, heights: np.ndarray) -> ElevationMap:
        """Return heights as a map in its place, with every cell known."""
        return ElevationMap(heights, self._resolution, self._origin)

    @property
    def shown(self) -> Float[np.ndarray, "nx ny"]:
        """F of the chosen heading, or of each cell's best."""
        F = self.assessment.weighted().numpy()
        return F.max(axis=-1) if self.heading is None else F[..., self.heading]

    @property
    def status(self) -> str:
        """One line: how much of the map is open, and what the last stroke cost."""
        nx, ny = self.elevation.shape
        open_ = (self.shown >= self.f_min).mean()
        said = f"{open_:.0%} of the cells can be left towards {self._way('some heading')}"
        if self.window is not None:
            ix, iy = self.window
            cells = (ix.stop - ix.start) * (iy.stop - iy.start)
            said += f"; {cells} of {nx * ny} cells see the last stroke"
            if cells > SMALL * nx * ny:
                said += " (this map is hardly larger than what a patch sees)"
        if isinstance(self.answer, Refusal):
            said += f"; no route: {self.answer.reason}"
        elif self.answer is not None:
            said += f"; route: {self.answer.length:.2f} m, cost {self.answer.cost:.2f}"
        if self.episode is not None:
            said += f"; driven: {self.episode.reason} after {self.episode.seconds:.1f} s"
        return said

    def _way(self, otherwise: str) -> str:
        """Name the chosen heading."""
        return otherwise if self.heading is None else self.assessment.headings.names[self.heading]

    def read(self, cell: Cell) -> str:
        """Return a cell's numbers; raises `ConfigError` off the map."""
        check_cell(self.elevation, cell)
        part, at = self.assessment.around(cell)
        w_ood, F = part.weigh()
        tensors = {"f": part.f, "L_recon": part.reconstruction, "w_ood": w_ood, "F": F}
        rows = {label: tensor[at].tolist() for label, tensor in tensors.items()}
        return cell_table(self.elevation, cell, part.headings, rows)

    def scene(self) -> Scene:
        """Draw M and F side by side: the window of the last stroke, the route, and the drive."""
        name, ny = self.specialist.name, self.elevation.shape[1]
        colour = policy_colours([name])[name]
        box = None
        if self.window is not None:
            ix, iy = self.window
            box = (float(ix.start), float(ny - iy.stop), float(ix.stop), float(ny - iy.start))
        lines = []
        if isinstance(self.answer, Route) and len(self.answer.cells) > 1:
            lines.append((colour, on_picture(self.answer.cells, ny)))
        if self.episode is not None:
            lines.append((INK, self._placed(self.episode.poses[:, :2])))
        drive = "; black: the drive" if self.episode is not None else ""
        ends = zip(("start", "goal"), self.ends or (), strict=False)
        return Scene(
            rows=(
                (
                    Panel(
                        key="M",
                        title="Elevation map M: paint here",
                        caption=f"blue low, brown high{drive}",
                    ),
                    Panel(
                        key="F",
                        title=f"F of {name}, {self._way('best heading')}",
                        caption="yellow: feasible; dark: closed; the frame: sees the last stroke",
                        colour=colour,
                    ),
                ),
            ),
            pictures={
                "M": ground_picture(self.elevation),
                "F": feasibility_picture(self.shown, self.elevation.known, self.f_min),
            },
            lines=lines,
            marks={role: self._placed(np.array([point]))[0] for role, point in ends},
            box=box,
            extent=self.elevation.extent,
            status=self.status,
        )

    def _placed(self, points: Float[np.ndarray, "n 2"]) -> list[Point]:
        """Return where points (x, y), m, lie in a picture, (right, down), in cells."""
        across = (points - np.array(self.elevation.origin)) / self.elevation.resolution
        return [(u, self.elevation.shape[1] - v) for u, v in across.tolist()]
