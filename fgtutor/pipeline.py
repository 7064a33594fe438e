"""The whole plan in one call: map -> tensors -> fusion -> route.

Reads an elevation map and a zoo; gives a `Plan` that keeps every stage, so that a figure or a
curious reader can look at each. Source: paper, Sec. III-B and III-C.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.fusion import fuse
from fgtutor.io.progress import QUICK, duration
from fgtutor.io.validation import NonNegative, Positive
from fgtutor.planning import Backend, Cost, Point, Route, Search, plan, usable_cell
from fgtutor.specialist import Specialist
from fgtutor.tensorization import Taus, tensorize_all

SECONDS_PER_STATE = 1.5e-6
"""What a search takes, in one call that cannot show how far it is (measured, 4 policies)."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A route and everything it was planned from."""

    names: tuple[str, ...]
    """The policies, in the order that indices count."""
    tensors: list[Tensor]
    """F_i of each policy, [nx, ny, 8]."""
    fused: Tensor
    """F_max, [nx, ny, 8]."""
    policy_map: Tensor
    """P, [nx, ny, 8]."""
    route: Route
    """The cheapest route."""


def plan_on_map(
    elevation: ElevationMap,
    zoo: Mapping[str, Specialist],
    start: Point,
    goal: Point,
    *,
    taus: Taus = "calibrated",
    f_min: Positive = 0.1,
    cost: Cost = "inverse",
    backend: Backend = "auto",
    switch_cost: NonNegative = 0.0,
    tensors: Mapping[str, Tensor] | None = None,
    progress: bool = False,
) -> Plan:
    """Tensorize `elevation` for every policy of `zoo`, fuse, and plan from `start` to `goal`.

    `tensors` may hold F_i already computed, by name. `progress` shows a bar if it takes long.
    Raises `ConfigError` for an empty zoo, and whatever the stages raise, at once where it can be
    known before the map is tensorized.
    """
    if not zoo:
        raise ConfigError("planning needs at least one specialist, the zoo is empty")
    search = Search(backend=backend, cost=cost, f_min=f_min, switch_cost=switch_cost)
    search.check_memory(elevation, len(zoo))
    for point, role in ((start, "start"), (goal, "goal")):
        usable_cell(elevation, point, role)
    known = dict(tensors or {})
    known |= tensorize_all(
        elevation,
        {name: one for name, one in zoo.items() if name not in known},
        taus=taus,
        progress=progress,
    )
    each = [known[name] for name in zoo]
    fused, policy_map = fuse(each)
    states = elevation.heights.size * (len(zoo) if switch_cost else 1)
    if progress and states * SECONDS_PER_STATE > QUICK:
        expected = duration(states * SECONDS_PER_STATE)
        print(f"searching the route: about {expected}", file=sys.stderr)
    route = plan(
        fused,
        policy_map,
        grid=elevation,
        start=start,
        goal=goal,
        **vars(search),
        tensors=each,
        names=tuple(zoo),
    )
    return Plan(tuple(zoo), each, fused, policy_map, route)
