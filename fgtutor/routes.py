"""The route: what planning found, step by step, with the reasons.

Reads the cells, policies and numbers that `planning` chose; gives lengths, switches, explanations
and JSON. Source: paper, Sec. III-C ("full transparency in policy selection decisions").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from jaxtyping import Float, Int

from fgtutor import directions
from fgtutor.errors import PlanningError


@dataclass(frozen=True, kw_only=True, eq=False)
class Route:
    """A planned route of n cells, hence n - 1 steps; a route of one cell has no step."""

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
    choices: Float[np.ndarray, "steps policies"] | None = None
    """F_i of every policy at each step, if known."""
    ood: Float[np.ndarray, "steps policies"] | None = None
    """w_ood of every policy at each step, if known."""

    @property
    def cost(self) -> float:
        """The sum of the steps' costs."""
        return float(self.costs.sum())

    @property
    def switches(self) -> int:
        """How often the policy changes on the way."""
        return int(np.count_nonzero(np.diff(self.policies)))

    def explain(self) -> list[dict[str, Any]]:
        """Say for every step where it goes, with which policy, and what the others offered."""
        total = self.cost
        steps = []
        for i, heading in enumerate(self.headings.tolist()):
            step = {
                "cell": tuple(self.cells[i].tolist()),
                "heading": directions.NAMES[heading],
                "policy": self.names[self.policies[i]],
                "F_max": float(self.feasibility[i]),
                "cost": float(self.costs[i]),
                "share": float(self.costs[i]) / total,
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
        try:
            n, policies = len(data["cells"]), len(data["names"])
            shapes = {
                "cells": (int, (n, 2)),
                "xy": (float, (n, 2)),
                "headings": (int, (n - 1,)),
                "policies": (int, (n - 1,)),
                "feasibility": (float, (n - 1,)),
                "costs": (float, (n - 1,)),
            }
            for name in ("choices", "ood"):
                if data.get(name) is not None:
                    shapes[name] = (float, (n - 1, policies))
            arrays = {
                # An empty list has lost its other dimensions: give them back.
                name: np.array(data[name], dtype=kind).reshape(shape)
                for name, (kind, shape) in shapes.items()
            }
            return cls(length=float(data["length"]), names=tuple(data["names"]), **arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise PlanningError(
                f"not a route: {error!r}; pass what Route.to_json() gave, unchanged"
            ) from error

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
