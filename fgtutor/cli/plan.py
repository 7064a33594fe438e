"""`fgtutor plan`: a route over a map file with the specialists of a zoo.

Reads a map and a zoo; prints the route, or why there is none, and writes it as JSON.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from annotated_types import Interval

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.io.storage import check_writable, write_json
from fgtutor.io.validation import NonNegative, Unique, check_fields
from fgtutor.pipeline import plan_on_map
from fgtutor.planning import Backend, Cost, Point
from fgtutor.specialist import Specialist, load_zoo


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
