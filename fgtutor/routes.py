"""The answer of planning: a route, step by step with the reasons, or a refusal with its reason.

Reads the cells, policies and numbers that `planning` chose; gives lengths, switches, explanations
and JSON. Source: paper, Sec. III-C ("full transparency in policy selection decisions").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, NoReturn, Self

import numpy as np
from annotated_types import Interval, Len
from jaxtyping import Float, Int

from fgtutor.directions import HeadingCount, Headings
from fgtutor.errors import PlanningError
from fgtutor.io.validation import parse_record

HAZARD, RELIEF = 4.0, 20.0
"""Walks that end per metre are exp(`HAZARD` - `RELIEF` F): about the likeliest values (4.6, 22.2)
for 142 routes of the undisturbed A1 over the open ground of seed 0, 23 of which failed."""
LARGEST = 1e12
"""The largest number in a route; sums of larger ones lose their metres, or overflow."""


@dataclass(frozen=True, eq=False)
class Refusal:
    """There is no route, and why; as a condition it is False."""

    error: PlanningError
    """The reason, by its type: `UnknownCellError`, `InfeasibleCellError`, `UnreachableError`,
    `DoubtfulRouteError`."""
    nearest: tuple[float, float] | None = None
    """Where it fails, m, if start and goal can be used: the place nearest to the goal that can be
    reached, or where the worst step of a route begins that promises too little."""
    heading: int = 0
    """The heading on from there: towards the goal, or that of the worst step."""

    @property
    def reason(self) -> str:
        """The reason in words: which place, why, and what to change."""
        return str(self.error)

    def raise_for(self) -> NoReturn:
        """Raise the reason; a `Route` returns itself."""
        raise self.error

    def __bool__(self) -> bool:
        return False

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"there is no route, so no {name!r}: {self.__dict__.get('error')}")

    def __repr__(self) -> str:
        return f"Refusal({self.error})"


@dataclass(frozen=True, kw_only=True, eq=False)
class Route:
    """A planned route of n cells, hence n - 1 steps; a route of one cell has no step.

    Raises:
        PlanningError: The arrays do not fit each other, or a value is out of range.
        ConfigError: There is no such number of headings.
    """

    cells: Int[np.ndarray, "n 2"]
    """The cells (ix, iy) from start to goal."""
    xy: Float[np.ndarray, "n 2"]
    """Their centres, m."""
    headings: Int[np.ndarray, " steps"]
    """The heading of each step."""
    policies: Int[np.ndarray, " steps"]
    """The policy of each step, an index into `names`."""
    feasibility: Float[np.ndarray, " steps"]
    """F of that policy for that step: F_max unless switching has a cost."""
    costs: Float[np.ndarray, " steps"]
    """What each step adds to the cost, a switch before it included."""
    length: float
    """Length along the cell centres, m."""
    names: tuple[str, ...]
    """Names of all policies that were planned with."""
    num_headings: HeadingCount = 8
    """How many headings `headings` count: 8, 16, 32 or 48."""
    choices: Float[np.ndarray, "steps policies"] | None = None
    """F_i of every policy at each step, if known."""
    ood: Float[np.ndarray, "steps policies"] | None = None
    """w_ood of every policy in the cell that each step leaves first, if known."""

    def __post_init__(self) -> None:
        names, headings = self.names, Headings(self.num_headings)
        if not names or not all(isinstance(n, str) and n.isprintable() for n in names):
            raise PlanningError(f"names should be printable texts, one per policy, got {names}")
        if len(set(names)) < len(names):
            raise PlanningError(f"each policy needs a name of its own, got {', '.join(names)}")
        for name, (kind, shape) in _layout(len(self.headings), len(names)).items():
            array = getattr(self, name)
            if array is None and name in ("choices", "ood"):
                continue
            if not isinstance(array, np.ndarray) or array.shape != shape:
                got = getattr(array, "shape", type(array).__name__)
                raise PlanningError(f"{name} should be an array {shape}, is {got}")
            if array.dtype.kind not in ("iu" if kind is int else "iuf"):
                raise PlanningError(f"{name} should hold {kind.__name__}, holds {array.dtype}")
            if not (np.abs(array) <= LARGEST).all():
                raise PlanningError(f"{name} should hold finite numbers up to {LARGEST:g}")
        for what, count in (("headings", headings.count), ("policies", len(names))):
            if not all(0 <= index < count for index in getattr(self, what).tolist()):
                raise PlanningError(f"{what} should be numbers from 0 to {count - 1}")
        if (np.diff(self.cells.astype(int), axis=0) != headings.steps[self.headings]).any():
            raise PlanningError("each cell should be where the heading leads from the last one")
        if not (0 <= self.length <= LARGEST and (self.costs >= 0).all()):
            raise PlanningError("length and costs should be numbers from 0")

    @property
    def cost(self) -> float:
        """The sum of the steps' costs."""
        return float(self.costs.sum())

    @property
    def switches(self) -> int:
        """How often the policy changes on the way."""
        return int(np.count_nonzero(np.diff(self.policies)))

    @property
    def promise(self) -> float:
        """How likely the route is to be walked to its end, from 0 to 1.

        The product over its steps of exp(-l exp(`HAZARD` - `RELIEF` F)), l being a step's metres:
        the lower F, the more walks end per metre. F itself is no probability of passing a step but
        a tracking reward, and a product of them falls to 0 on every long route. It was fitted to
        the A1 on one set of maps. On another (open ground of seed 1) the 124 routes that arrived
        promise 0.87 or more and the 16 that failed 0.10 or less. Of the toy it says little: of 299
        drives over its own and mixed ground three failed, of routes that promise 0.79, 1 and 1.
        """
        lengths = np.hypot(*np.diff(self.xy, axis=0).T)
        ends = lengths * np.exp(HAZARD - RELIEF * self.feasibility)
        return float(np.exp(-ends.sum()))

    def raise_for(self) -> Self:
        """Return the route; a `Refusal` raises its reason."""
        return self

    def explain(self) -> list[dict[str, Any]]:
        """Say for every step where it goes, with which policy, and what the others offered."""
        total, names = self.cost, Headings(self.num_headings).names
        steps = []
        for i, heading in enumerate(self.headings.tolist()):
            step = {
                "cell": tuple(self.cells[i].tolist()),
                "heading": names[heading],
                "policy": self.names[self.policies[i]],
                "F_max": float(self.feasibility[i]),
                "cost": float(self.costs[i]),
                "share": float(self.costs[i]) / total if total else 0.0,
            }
            if self.choices is not None:
                step["F"] = dict(zip(self.names, self.choices[i].tolist(), strict=True))
            if self.ood is not None:
                step["w_ood"] = dict(zip(self.names, self.ood[i].tolist(), strict=True))
            steps.append(step)
        return steps

    def to_json(self) -> dict[str, Any]:
        """Return the route as plain numbers and lists; `from_json` reads it back."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        plain = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in values.items()
        }
        return plain | {"names": list(self.names), "cost": self.cost, "switches": self.switches}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild a route from `to_json`; raises `PlanningError` if it is not one."""
        told = "not a route (pass what Route.to_json() gave, unchanged)"
        record = vars(parse_record(_Record, data, PlanningError, told))
        layout = _layout(len(record["cells"]) - 1, len(record["names"]))
        try:
            # An empty list has lost its other dimensions: give them back.
            arrays: dict[str, Any] = {
                name: np.array(record[name], dtype=kind).reshape(shape)
                for name, (kind, shape) in layout.items()
                if record[name] is not None
            }
            return cls(**arrays | {name: record[name] for name in _KEPT})
        except ValueError as error:
            raise PlanningError(f"{told}: {error}") from error

    def __repr__(self) -> str:
        if not len(self.headings):
            return f"Route(start and goal in one cell {tuple(self.cells[0].tolist())})"
        turns = np.flatnonzero(np.diff(self.policies, prepend=-1))
        order = " -> ".join(self.names[policy] for policy in self.policies[turns])
        low, high = self.feasibility.min(), self.feasibility.max()
        return (
            f"Route({len(self.headings)} steps, {self.length:.2f} m, cost {self.cost:.2f}, "
            f"F {low:.2f}..{high:.2f}, {self.switches} switches: {order})"
        )


_KEPT = ("length", "names", "num_headings")
"""What of a route is no array."""
_Index = Annotated[int, Interval(ge=0, le=10**6)]


@dataclass(frozen=True, kw_only=True)
class _Record:
    """A route as JSON; see `Route`."""

    cells: Annotated[list[tuple[_Index, _Index]], Len(1)]
    xy: list[tuple[float, float]]
    headings: list[_Index]
    policies: list[_Index]
    feasibility: list[float]
    costs: list[float]
    length: float
    names: tuple[str, ...]
    num_headings: HeadingCount = 8  # what a route was before it said so
    choices: list[list[float]] | None
    ood: list[list[float]] | None
    cost: float
    switches: int


def _layout(steps: int, policies: int) -> dict[str, tuple[type, tuple[int, ...]]]:
    """Return type and shape of each array of a route."""
    return {
        "cells": (int, (steps + 1, 2)),
        "xy": (float, (steps + 1, 2)),
        "headings": (int, (steps,)),
        "policies": (int, (steps,)),
        "feasibility": (float, (steps,)),
        "costs": (float, (steps,)),
        "choices": (float, (steps, policies)),
        "ood": (float, (steps, policies)),
    }
