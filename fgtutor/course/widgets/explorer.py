"""What the tau sliders do: re-weight, fuse and plan anew, fast enough to follow a finger.

Reads a map, what each specialist says of it (f and L_recon, computed once by `assess`), and the
settings of the sliders; gives F_max, P and the route (`tau_views` draws them).
Source: paper, Eqs. 4-7 and Sec. III-C; the settings f_min and switch_cost are ours (`planning`).

Numbers are kept as [policy, heading, ix, iy] in float32 and overwritten in place: each operation
then runs over whole maps in memory order, which makes a drag several times cheaper than the same
lines in `tensorization` and `fusion`, whose results they must equal (a test).
"""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from fgtutor import directions
from fgtutor.course.widgets.corridor import Corridor
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, PlanningError, ThresholdError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW
from fgtutor.planning import Planner, Route, Tree
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, assess_all, steps_on_known

Cell = tuple[int, int]
Point = tuple[float, float]

NARROWEST = 1e-4
"""Least distance between the taus: where the slider's ends meet, w_ood becomes a step."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Where the sliders stand."""

    taus: tuple[float, float] = (TAU_LOW, TAU_HIGH)
    """(tau_low, tau_high), the same for every policy."""
    policies: tuple[str, ...]
    """The policies that may drive."""
    start: Point
    """Start (x, y), m."""
    goal: Point
    """Goal (x, y), m."""
    f_min: float = 0.1
    """Edges less feasible than this do not exist."""
    switch_cost: float = 0.0
    """Extra cost of changing the policy."""

    def __post_init__(self) -> None:
        low, high = self.taus
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise ThresholdError(
                f"the taus must be finite with tau_low <= tau_high, got {low} and {high}"
            )
        if not (math.isfinite(self.f_min) and self.f_min > 0):
            raise ConfigError(f"f_min must be above 0 (an edge costs 1 / F), got {self.f_min}")
        if not (math.isfinite(self.switch_cost) and self.switch_cost >= 0):
            raise ConfigError(f"switch_cost must be finite and >= 0, got {self.switch_cost}")


class Explorer:
    """One map under a set of specialists; `update` moves the sliders."""

    def __init__(
        self,
        elevation: ElevationMap,
        zoo: Mapping[str, Specialist | Assessment],
        start: Point,
        goal: Point,
        **settings: Any,
    ) -> None:
        """Assess the map, a second or so a specialist; an `Assessment` is taken as it is.

        Raises:
            ConfigError: There is no specialist, an assessment is of another map, or a setting is
                out of range.
            ThresholdError: The taus are not tau_low <= tau_high.
        """
        if not zoo:
            raise ConfigError("an Explorer needs at least one specialist, the zoo is empty")
        self.elevation, self.names = elevation, tuple(zoo)
        given = {name: one for name, one in zoo.items() if isinstance(one, Assessment)}
        asked = {name: one for name, one in zoo.items() if not isinstance(one, Assessment)}
        known = given | assess_all(elevation, asked)
        said = [known[name] for name in zoo]
        self._f = self._layers([one.f.numpy() for one in said])
        # A step from or to a cell that was never observed is closed, as in `tensorize`.
        self._f *= np.moveaxis(steps_on_known(elevation.known), -1, 0)
        self._loss = self._layers([one.reconstruction.numpy() for one in said])
        self._w, self._weighted = np.empty_like(self._f), np.empty_like(self._f)
        self._fused = np.empty_like(self._f[0])
        self._policy = np.empty(self._fused.shape, dtype=np.uint8)
        self._better = np.empty(self._fused.shape, dtype=bool)
        self._corridor = Corridor(elevation.shape)
        self._tree: Tree | None = None
        self.route: Route | None = None
        """The cheapest route; None if there is none, and `trouble` says why."""
        self.trouble = ""
        """Why there is no route, else empty."""
        self.milliseconds = 0.0
        """How long the last update took to compute."""
        self.settings = self._checked(
            Settings(**{"policies": self.names, "start": start, "goal": goal} | settings)
        )
        """Where the sliders stand; `update` changes them."""
        self._weigh()
        self._fuse()
        self._plan()

    def _layers(self, tensors: list[np.ndarray]) -> Float[np.ndarray, "policies 8 nx ny"]:
        """Stack what all specialists say, headings first, or say what does not fit."""
        shape = (*self.elevation.shape, directions.NUM_HEADINGS)
        for name, tensor in zip(self.names, tensors, strict=True):
            if tensor.shape != shape:
                raise ConfigError(
                    f"the assessment of {name!r} has shape {tensor.shape}, the map asks for "
                    f"{shape}: assess and explore the same map"
                )
        stacked = np.stack([np.moveaxis(tensor, -1, 0) for tensor in tensors])
        return np.ascontiguousarray(stacked, dtype=np.float32)

    # What the sliders do --------------------------------------------------------------------------

    def update(self, **changes: Any) -> None:
        """Take over new `Settings` by name and compute what depends on them.

        A route that does not exist is no error here: `route` is None and `trouble` says why.

        Raises:
            ConfigError: A policy is unknown, or f_min or switch_cost is out of range.
            ThresholdError: The taus are not tau_low <= tau_high.
        """
        began = time.perf_counter()
        before, now = self.settings, self._checked(replace(self.settings, **changes))
        self.settings = now
        if (now.taus, now.policies) != (before.taus, before.policies):
            self._weigh()
            self._fuse()
        if replace(now, start=before.start) != before:
            self._tree = None
        if now != before:
            self._plan()
        self.milliseconds = 1000 * (time.perf_counter() - began)

    def _checked(self, settings: Settings) -> Settings:
        unknown = [name for name in settings.policies if name not in self.names]
        if unknown:
            raise ConfigError(f"no policy {', '.join(unknown)}; there are {', '.join(self.names)}")
        return settings

    def _weigh(self) -> None:
        """Compute w_ood, and F_i = w_ood f (Eqs. 4-5) of the policies that may drive."""
        low, high = self.settings.taus
        high = max(high, low + NARROWEST)
        np.subtract(np.float32(high), self._loss, out=self._w)
        self._w *= np.float32(1 / (high - low))
        np.clip(self._w, 0, 1, out=self._w)
        np.multiply(self._w, self._f, out=self._weighted)
        for i, name in enumerate(self.names):
            if name not in self.settings.policies:
                self._weighted[i] = 0

    def _fuse(self) -> None:
        """Compute F_max and P (Eqs. 6-7); on a tie the first policy is taken."""
        self._fused[:], self._policy[:] = self._weighted[0], 0
        for i, tensor in enumerate(self._weighted[1:], 1):
            np.greater(tensor, self._fused, out=self._better)
            np.copyto(self._fused, tensor, where=self._better)
            np.copyto(self._policy, i, where=self._better)

    def _plan(self) -> None:
        """Search the route, or note why there is none."""
        self.route, self.trouble = None, ""
        if not self.settings.policies:
            self.trouble = "No policy may drive: tick at least one"
            return
        try:
            self.route = self._search()
        except PlanningError as error:
            self.trouble = f"No route: {error}"

    def _search(self) -> Route:
        now = self.settings
        if now.switch_cost > 0:
            route = self._search_corridor()
            if route is not None:
                return route
        if self._tree is None:  # kept while only the start moves
            planner = self._planner(self.elevation, self.fused, self.policy_map, self.tensors)
            self._tree = planner.towards(now.goal)
        return self._tree.route(now.start)

    def _search_corridor(self) -> Route | None:
        """Search only where the route can lie; None where that is not known beforehand."""
        now, grid = self.settings, self.elevation
        points = (now.start, now.goal)
        if not all(grid.contains(*point) and grid.known[grid.cell_of(*point)] for point in points):
            return None
        start, goal = (grid.cell_of(*point) for point in points)
        keep = self._corridor.promising(
            self.tensors, self.fused, start, goal, f_min=now.f_min, switch_cost=now.switch_cost
        )
        if keep is None or not keep.any():
            return None
        used = np.logical_or.reduce(keep, axis=-1)
        used[goal] = True
        ix, iy = _span(used, 0), _span(used, 1)
        corner = (
            grid.origin[0] + ix.start * grid.resolution,
            grid.origin[1] + iy.start * grid.resolution,
        )
        part = ElevationMap(grid.heights[ix, iy], grid.resolution, corner, grid.known[ix, iy])
        keep = keep[ix, iy]
        planner = self._planner(
            part, self.fused[ix, iy] * keep, self.policy_map[ix, iy], self.tensors[:, ix, iy] * keep
        )
        route = planner.towards(grid.centre_of(*goal)).route(grid.centre_of(*start))
        return replace(route, cells=route.cells + np.array((ix.start, iy.start)))

    def _planner(
        self, grid: ElevationMap, fused: np.ndarray, policy_map: np.ndarray, tensors: np.ndarray
    ) -> Planner:
        return Planner(
            fused=fused,
            policy_map=policy_map,
            grid=grid,
            f_min=self.settings.f_min,
            switch_cost=self.settings.switch_cost,
            tensors=list(tensors),
            names=self.names,
        )

    # What came out --------------------------------------------------------------------------------

    @property
    def tensors(self) -> Float[np.ndarray, "policies nx ny 8"]:
        """F_i as they stand, 0 for policies that may not drive; the next update overwrites them."""
        return np.moveaxis(self._weighted, 1, -1)

    @property
    def fused(self) -> Float[np.ndarray, "nx ny 8"]:
        """F_max as it stands; the next update overwrites it."""
        return np.moveaxis(self._fused, 0, -1)

    @property
    def policy_map(self) -> Int[np.ndarray, "nx ny 8"]:
        """P as it stands, an index into `names`; the next update overwrites it."""
        return np.moveaxis(self._policy, 0, -1)

    @property
    def weights(self) -> dict[str, Float[np.ndarray, "nx ny 8"]]:
        """w_ood of every policy as it stands; the next update overwrites it."""
        return dict(zip(self.names, np.moveaxis(self._w, 1, -1), strict=True))

    @property
    def best(self) -> tuple[Float[np.ndarray, "nx ny"], Int[np.ndarray, "nx ny"]]:
        """F_max of each cell's best heading, and P there."""
        best, policy = self._fused[0].copy(), self._policy[0].copy()
        for f, who in zip(self._fused[1:], self._policy[1:], strict=True):
            better = f > best
            np.copyto(best, f, where=better)
            np.copyto(policy, who, where=better)
        return best, policy

    @property
    def status(self) -> str:
        """One line: the thresholds, and the route's cost, length and switches."""
        low, high = self.settings.taus
        said = f"tau {low:.2f} to {high:.2f}: "
        if self.route is None:
            return said + self.trouble
        route = self.route
        metres = directions.STEP_LENGTHS[route.headings] * self.elevation.resolution
        drives = ", ".join(
            f"{name} {metres[route.policies == i].sum():.1f} m"
            for i, name in enumerate(self.names)
            if (route.policies == i).any()
        )
        return said + (
            f"cost {route.cost:.2f}, {route.length:.2f} m, policy switches: {route.switches}"
            + f" ({drives})" * bool(drives)
        )

    def read(self, cell: Cell) -> str:
        """Return every number of a cell as a small table; raises `ConfigError` off the map."""
        nx, ny = self.elevation.shape
        ix, iy = cell
        if not (0 <= ix < nx and 0 <= iy < ny):
            raise ConfigError(f"there is no cell {cell} on a map of {nx} x {ny} cells")
        x, y = self.elevation.centre_of(ix, iy)
        height = self.elevation.heights[ix, iy]
        rows = [f"cell ({ix}, {iy})   x {x:.2f} m, y {y:.2f} m, height {height:.2f} m"]
        if not self.elevation.known[ix, iy]:
            rows[0] = rows[0].split(", height")[0] + ", never observed: closed"
        rows.append("heading    " + "".join(f"{name:>8}" for name in directions.NAMES))
        chosen = [self.names[i] for i in self._policy[:, ix, iy]]
        for label, values in [
            *((f"f {name}", self._f[i, :, ix, iy]) for i, name in enumerate(self.names)),
            *((f"L {name}", self._loss[i, :, ix, iy]) for i, name in enumerate(self.names)),
            *((f"w {name}", self._w[i, :, ix, iy]) for i, name in enumerate(self.names)),
            ("F_max", self._fused[:, ix, iy]),
        ]:
            rows.append(f"{label:<11.11}" + "".join(f"{value:8.2f}" for value in values.tolist()))
        rows.append("P          " + "".join(f"{name:>8.7}" for name in chosen))
        return "\n".join(rows)


def _span(used: Bool[np.ndarray, "nx ny"], axis: int) -> slice:
    """Return the range along an axis that holds every used cell, one more at each end."""
    places = np.nonzero(used)[axis]
    return slice(max(int(places.min()) - 1, 0), min(int(places.max()) + 2, used.shape[axis]))
