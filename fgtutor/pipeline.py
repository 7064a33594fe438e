"""The whole plan in one call: map -> tensors -> fusion -> route.

Reads an elevation map and a zoo; gives a `Plan` that keeps every stage, so that a figure or a
curious reader can look at each. Source: paper, Sec. III-B and III-C.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.fusion import fuse
from fgtutor.planning import Route, plan
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.storage import check_writable, write_json
from fgtutor.tensorization import Taus, tensorize_all


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
    start: tuple[float, float],
    goal: tuple[float, float],
    *,
    taus: Taus = "calibrated",
    f_min: float = 0.1,
    cost: str = "inverse",
    backend: str = "auto",
    switch_cost: float = 0.0,
    tensors: Mapping[str, Tensor] | None = None,
) -> Plan:
    """Tensorize `elevation` for every policy of `zoo`, fuse, and plan from `start` to `goal`.

    `tensors` may hold F_i already computed, by name. Raises `ConfigError` for an empty zoo, and
    whatever the stages raise.
    """
    if not zoo:
        raise ConfigError("planning needs at least one specialist, the zoo is empty")
    known = dict(tensors or {})
    known |= tensorize_all(
        elevation, {name: one for name, one in zoo.items() if name not in known}, taus=taus
    )
    each = [known[name] for name in zoo]
    fused, policy_map = fuse(each)
    route = plan(
        fused,
        policy_map,
        grid=elevation,
        start=start,
        goal=goal,
        backend=backend,
        cost=cost,
        f_min=f_min,
        switch_cost=switch_cost,
        tensors=each,
        names=tuple(zoo),
    )
    return Plan(tuple(zoo), each, fused, policy_map, route)


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """Plan a route over an elevation map with the shipped specialists."""

    map: Path
    """Elevation map: .npz, .tif, or .png with its .yaml."""
    start: tuple[float, float]
    """Start x y, m."""
    goal: tuple[float, float]
    """Goal x y, m."""
    robot: str = "toy"
    """Whose specialists plan."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo of the robot."""
    policies: tuple[str, ...] = ()
    """Use only these specialists; default: all."""
    taus: Literal["paper", "calibrated"] = "calibrated"
    """Thresholds of w_ood: the paper's, or each specialist's own."""
    f_min: float = 0.1
    """Edges less feasible than this do not exist."""
    cost: Literal["inverse", "length"] = "length"
    """Edge cost: 1 / F_max times the step's length, or 1 / F_max alone (the paper)."""
    switch_cost: float = 0.0
    """Extra cost of changing the policy, in the unit of `cost` (metres or steps where F is 1); 0 is
    the paper's."""
    backend: Literal["auto", "networkx", "scipy"] = "auto"
    """Which library searches."""
    json: Path | None = None
    """Write the route here."""


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
        )
    print(planned.route)
    if config.json:
        write_json(config.json, planned.route.to_json())
        print(f"route -> {config.json}")
    return 0
