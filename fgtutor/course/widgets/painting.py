"""Painting heights, and seeing which feasibilities follow: only those whose patch was touched.

Reads a map and one specialist; gives f, L_recon and F of the painted map. A stroke assesses the
window of cells that can have changed, not the map. Source: paper, Sec. III-B (a patch is local).
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import find_objects

from fgtutor import patches
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
from fgtutor.tensorization import Assessment, Taus, assess

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
        self._prepared = patches.prepare(self.elevation).heights
        self.assessment: Assessment = assess(self.elevation, self.specialist, taus=self._taus)
        """f and L_recon of the painted map."""
        self.window: Window | None = None
        """The cells that the last stroke assessed anew."""

    def stroke(self, cells: Sequence[Cell], height: float, radius: float) -> Window | None:
        """Set the ground within `radius` (m) of each cell's centre to `height` (m).

        Returns the window of cells whose F was computed anew, None if no patch saw a change.
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
        prepared = patches.prepare(self.elevation).heights
        changed = prepared != self._prepared
        self._prepared = prepared
        self.window = self._assess_around(changed) if changed.any() else None
        return self.window

    def _assess_around(self, changed: np.ndarray) -> Window:
        """Assess the cells whose patches reach a changed cell; return their window."""
        # Interpolation between cells looks one cell further than the patch's farthest point.
        sees = patches.reach(self.specialist.grid) + self._resolution
        # What a prepared cell depends on: the closing's dilation, then its erosion, then smoothing.
        depends = 2 * patches.HOLE_REACH + patches.SPACING + self._resolution
        window = self._grown(find_objects(changed.astype(int))[0], sees)
        # The map around the window is only read, so that its cells come out as on the whole map.
        read = self._grown(window, sees + depends)
        part = assess(self._map(self.elevation.heights[read], read), self.specialist)
        inner = tuple(
            slice(w.start - r.start, w.stop - r.start) for w, r in zip(window, read, strict=True)
        )
        self.assessment.f[window] = part.f[inner]
        self.assessment.reconstruction[window] = part.reconstruction[inner]
        return window

    def _grown(self, window: Window, metres: float) -> Window:
        """Return a window with `metres` more to each side, as far as there is map."""
        cells = math.ceil(metres / self._resolution)
        ix, iy = (
            slice(max(at.start - cells, 0), min(at.stop + cells, n))
            for at, n in zip(window, self.elevation.shape, strict=True)
        )
        return ix, iy

    def _map(self, heights: np.ndarray, at: Window = (slice(0, None), slice(0, None))):
        """Return heights as a map in its place, with every cell known."""
        x, y = (
            corner + span.start * self._resolution
            for corner, span in zip(self._origin, at, strict=True)
        )
        return ElevationMap(heights, self._resolution, (x, y))

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
            said += f"; the last stroke computed {cells} of {nx * ny} cells anew"
        return said

    def _way(self, otherwise: str) -> str:
        """Name the chosen heading."""
        return otherwise if self.heading is None else self.assessment.headings.names[self.heading]

    def read(self, cell: Cell) -> str:
        """Return a cell's numbers; raises `ConfigError` off the map."""
        check_cell(self.elevation, cell)
        assessment = self.assessment
        w_ood, F = assessment.weigh()
        tensors = {
            "f": assessment.f, "L_recon": assessment.reconstruction, "w_ood": w_ood, "F": F
        }  # fmt: skip
        rows = {label: tensor[cell].tolist() for label, tensor in tensors.items()}
        return cell_table(self.elevation, cell, assessment.headings, rows)

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
                        caption="yellow: feasible; dark: closed; the frame: computed anew",
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
