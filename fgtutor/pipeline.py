"""The whole plan in one call: map -> tensors -> fusion -> route.

Reads an elevation map and a zoo; gives a `Plan` that keeps every stage, so that a figure or a
curious reader can look at each. Source: paper, Sec. III-B and III-C.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.fusion import fuse
from fgtutor.planning import Backend, Cost, Point, Route, Search, plan, usable_cell
from fgtutor.progress import QUICK, duration
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.storage import check_writable, write_json
from fgtutor.tensorization import Taus, tensorize_all
from fgtutor.validation import NonNegative, Positive, Unique, check_fields

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


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """Plan a route over an elevation map with the shipped specialists."""

    map: Path
    """Elevation map: .npz, .tif, or .png with its .yaml."""
    start: Point
    """Start x y, m."""
    goal: Point
    """Goal x y, m."""
    robot: str = "toy"
    """Whose specialists plan."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo of the robot."""
    policies: Annotated[tuple[str, ...], Unique] = ()
    """Use only these specialists; default: all."""
    taus: Literal["paper", "calibrated"] = "calibrated"
    """Thresholds of w_ood: the paper's, or each specialist's own."""
    f_min: Annotated[float, Interval(gt=0, le=1)] = 0.1
    """Edges less feasible than this do not exist."""
    cost: Cost = "length"
    """Edge cost: 1 / F_max times the step's length, or 1 / F_max alone (the paper)."""
    switch_cost: NonNegative = 0.0
    """Extra cost of changing the policy, in the unit of `cost` (metres or steps where F is 1); 0 is
    the paper's."""
    backend: Backend = "auto"
    """Which library searches."""
    json: Path | None = None
    """Write the route here."""

    def __post_init__(self) -> None:
        check_fields(self)


def choose(zoo: dict[str, Specialist], names: tuple[str, ...]) -> dict[str, Specialist]:
    """Return the named part of a zoo, all of it for no names; raises `ConfigError` for others."""
    unknown = [name for name in names if name not in zoo]
    if unknown:
        raise ConfigError(f"no specialist named {', '.join(unknown)}; there are {', '.join(zoo)}")
    return {name: zoo[name] for name in names} if names else zoo


def run(config: PlanConfig) -> int:
    """Plan from the command line, print the route's summary and write its JSON."""
    if config.json:
        check_writable(config.json)
    elevation = ElevationMap.load(config.map)
    zoo = choose(load_zoo(config.robot, config.zoo), config.policies)
    with torch.inference_mode():
        planned = plan_on_map(
            elevation,
            zoo,
            config.start,
            config.goal,
            taus=config.taus,
            f_min=config.f_min,
            cost=config.cost,
            backend=config.backend,
            switch_cost=config.switch_cost,
            progress=True,
        )
    print(planned.route)
    if config.json:
        write_json(config.json, planned.route.to_json())
        print(f"route -> {config.json}")
    return 0
