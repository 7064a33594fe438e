"""What the tau sliders do: weight, fuse and plan anew each time that one of them is moved.

Reads a map, what each specialist says of it (`assess`, once), and the settings of the sliders;
gives w_ood, F_max, P and the route, or why there is none (`tau_pictures` draws them).
Source: paper, Eqs. 4-7 and Sec. III-C, by `Assessment`, `fuse` and `plan`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fgtutor.course.widgets.panels import Cell, Point, cell_table, check_cell
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW
from fgtutor.fusion import fuse
from fgtutor.planning import Plan, plan
from fgtutor.routes import Refusal, Route
from fgtutor.settings import PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Assessment, assess_all


class Explorer:
    """One map under a set of specialists; `update` moves the sliders.

    Attributes:
        settings: How the present route was planned.
        policies: The policies that may drive.
        start: Start (x, y), m.
        goal: Goal (x, y), m.
        plan: The route, or why there is none, and every stage on the way; F_i is 0 for policies
            that may not drive.
    """

    settings: PlanSettings
    policies: tuple[str, ...]
    start: Point
    goal: Point
    plan: Plan

    def __init__(
        self,
        elevation: ElevationMap,
        zoo: Mapping[str, Specialist | Assessment],
        start: Point,
        goal: Point,
        settings: PlanSettings | None = None,
        **changes: Any,
    ) -> None:
        """Assess the map, a second or so per specialist; an `Assessment` is taken as it is.

        `settings` are `PlanSettings()` unless given, `changes` are those of `update`.

        Raises:
            ConfigError: There is no specialist, or an assessment is of another map.
            ConfigError, ThresholdError, OffMapError: See `update`.
        """
        if not zoo:
            raise ConfigError("an Explorer needs at least one specialist, the zoo is empty")
        self.elevation, self.names = elevation, tuple(zoo)
        given = {name: one for name, one in zoo.items() if isinstance(one, Assessment)}
        asked = {name: one for name, one in zoo.items() if not isinstance(one, Assessment)}
        settings = settings or PlanSettings()
        if given:  # they hold what was asked of them
            headings = next(iter(given.values())).headings
            settings = replace(settings, headings=headings.count)
        known = given | assess_all(elevation, asked, headings=settings.headings)
        self.assessments = {name: known[name] for name in zoo}
        shape = (*elevation.shape, settings.headings)
        for name, one in self.assessments.items():
            if one.f.shape != shape:
                raise ConfigError(
                    f"the assessment of {name!r} has shape {tuple(one.f.shape)}, the map asks for "
                    f"{shape}: assess and explore the same map"
                )
        self.settings, self.policies = settings, self.names
        self.start, self.goal = start, goal
        self.update(**changes)

    def update(
        self,
        *,
        start: Point | None = None,
        goal: Point | None = None,
        policies: Sequence[str] | None = None,
        **changes: Any,
    ) -> None:
        """Take over what is given, `changes` being fields of `PlanSettings`, and plan anew.

        A route that does not exist is no error: `status` says why. "calibrated" thresholds are
        those of each assessment. After an error everything is as it was.

        Raises:
            ConfigError: A policy is unknown, or a setting has a value without meaning.
            ThresholdError: The taus are not finite numbers 0 <= tau_low < tau_high.
            OffMapError: Start or goal is off the map.
        """
        settings = replace(self.settings, **changes)
        if settings.headings != self.settings.headings:
            raise ConfigError(
                f"the map was assessed along {self.settings.headings} headings, not "
                f"{settings.headings}: make another Explorer"
            )
        start, goal = start or self.start, goal or self.goal
        policies = self.policies if policies is None else tuple(policies)
        unknown = [name for name in policies if name not in self.names]
        if unknown:
            raise ConfigError(f"no policy {', '.join(unknown)}; there are {', '.join(self.names)}")
        weights, tensors, taus = {}, [], _thresholds(settings)
        for name, one in self.assessments.items():
            weights[name], tensor = one.weigh(*taus, unknown=settings.unknown)
            tensors.append(tensor * (name in policies))
        fused, policy_map = fuse(tensors)
        answer = plan(
            fused,
            policy_map,
            grid=self.elevation,
            start=start,
            goal=goal,
            settings=settings,
            tensors=tensors,
            names=self.names,
        )
        self.settings, self.policies, self.start, self.goal = settings, policies, start, goal
        self.plan = Plan(self.names, tensors, weights, fused, policy_map, answer)

    @property
    def route(self) -> Route | None:
        """The cheapest route; None if there is none, and `status` says why."""
        return self.plan.answer if isinstance(self.plan.answer, Route) else None

    @property
    def best(self) -> tuple[Float[np.ndarray, "nx ny"], Int[np.ndarray, "nx ny"]]:
        """F_max of each cell's best heading, and P there."""
        feasibility, heading = self.plan.fused.max(dim=-1)
        policy = self.plan.policy_map.gather(-1, heading[..., None])[..., 0]
        return feasibility.numpy(), policy.numpy()

    @property
    def status(self) -> str:
        """One line: the thresholds, and the route in numbers, or why there is none."""
        taus = self.settings.taus
        shown = taus if isinstance(taus, str) else "{:.2f} to {:.2f}".format(*taus)
        if not self.policies:
            return f"tau {shown}: No policy may drive: tick at least one"
        route = self.plan.answer
        if isinstance(route, Refusal):
            return f"tau {shown}: No route: {route.reason}"
        metres = np.hypot(*np.diff(route.xy, axis=0).T)
        drives = ", ".join(
            f"{self.names[i]} {metres[route.policies == i].sum():.1f} m"
            for i in np.unique(route.policies).tolist()
        )
        return (
            f"tau {shown}: cost {route.cost:.2f}, {route.length:.2f} m, policy switches: "
            f"{route.switches}" + f" ({drives})" * bool(drives)
        )

    def read(self, cell: Cell) -> str:
        """Return every number of a cell as a small table; raises `ConfigError` off the map."""
        check_cell(self.elevation, cell)
        said = self.assessments.items()
        rows = {
            **{f"f {name}": one.f[cell].tolist() for name, one in said},
            **{f"L {name}": one.reconstruction[cell].tolist() for name, one in said},
            **{f"w {name}": weight[cell].tolist() for name, weight in self.plan.weights.items()},
            "F_max": self.plan.fused[cell].tolist(),
            "P": [self.names[i] for i in self.plan.policy_map[cell].tolist()],
        }
        return cell_table(self.elevation, cell, Headings(self.settings.headings), rows)


def _thresholds(settings: PlanSettings) -> tuple[float, ...]:
    """Return (tau_low, tau_high) for all policies, or nothing: by each policy's own calibration."""
    if settings.taus == "calibrated":
        return ()
    return (TAU_LOW, TAU_HIGH) if settings.taus == "paper" else settings.taus
