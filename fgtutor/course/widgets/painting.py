"""Painting heights, and seeing which feasibilities follow: only those whose patch was touched.

Reads a map and one specialist; gives f, L_recon and F of the painted map. A stroke assesses the
tiles whose patches see it, not the map (`reassess`). Source: paper, Sec. III-B (a patch is local).
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import find_objects

from fgtutor.course.widgets.panels import (
    Cell,
    Panel,
    Scene,
    cell_table,
    check_cell,
    feasibility_picture,
    ground_picture,
)
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.style import policy_colours
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, Taus, assess, reassess

Window = tuple[slice, slice]


class Painting:
    """A map to paint on, and what one specialist says of it at every moment."""

    def __init__(
        self,
        elevation: ElevationMap,
        specialist: Specialist,
        *,
        taus: Taus = "calibrated",
        f_min: float = 0.1,
    ) -> None:
        """Assess the whole map once; cells that were never observed become ground as filled.

        Raises `ThresholdError` for taus that cannot be used.
        """
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
        return self.window

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
        """Draw M and F side by side, the window of the last stroke outlined."""
        name, ny = self.specialist.name, self.elevation.shape[1]
        box = None
        if self.window is not None:
            ix, iy = self.window
            box = (float(ix.start), float(ny - iy.stop), float(ix.stop), float(ny - iy.start))
        return Scene(
            rows=(
                (
                    Panel(
                        key="M", title="Elevation map M: paint here", caption="blue low, brown high"
                    ),
                    Panel(
                        key="F",
                        title=f"F of {name}, {self._way('best heading')}",
                        caption="yellow: feasible; dark: closed; the frame: sees the last stroke",
                        colour=policy_colours([name])[name],
                    ),
                ),
            ),
            pictures={
                "M": ground_picture(self.elevation),
                "F": feasibility_picture(self.shown, self.elevation.known, self.f_min),
            },
            box=box,
            status=self.status,
        )
