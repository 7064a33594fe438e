"""`fgtutor plan`: a route over a map file with the specialists of a zoo.

Reads a map and a zoo; prints the route, or why there is none, and writes it as JSON.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import plan_figure
from fgtutor.figures.style import save_figure
from fgtutor.io.storage import check_writable, write_json
from fgtutor.io.validation import Unique, check_fields
from fgtutor.planning import Point, plan_on_map
from fgtutor.settings import Backend, PlanOptions
from fgtutor.specialist import Specialist, load_zoo


@dataclass(frozen=True, kw_only=True)
class MapOptions(PlanOptions):
    """What is planned over, from where to where, and by whose specialists."""

    map: Path
    """Elevation map: .npz, .tif, or .png with its .yaml; `fgtutor map` makes one of a scan."""
    start: Point
    """Start x y, m."""
    goal: Point
    """Goal x y, m."""
    robot: str = "toy"
    """Whose specialists."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo of the robot."""
    policies: Annotated[tuple[str, ...], Unique] = ()
    """Use only these specialists; default: all."""

    def __post_init__(self) -> None:
        check_fields(self)

    def load(self) -> tuple[ElevationMap, dict[str, Specialist]]:
        """Return the map and the specialists."""
        elevation = ElevationMap.load(self.map)
        return elevation, choose(load_zoo(self.robot, self.zoo), self.policies)


@dataclass(frozen=True, kw_only=True)
class PlanConfig(MapOptions):
    """Plan a route over an elevation map with the shipped specialists."""

    backend: Backend = "auto"
    """Which library searches."""
    json: Path | None = None
    """Write the route here."""
    figure: Path | None = None
    """Draw the plan here: the map with the route, w_ood, F_max and the policy map."""


def choose(zoo: dict[str, Specialist], names: tuple[str, ...]) -> dict[str, Specialist]:
    """Return the named part of a zoo, all of it for no names; raises `ConfigError` for others."""
    unknown = [name for name in names if name not in zoo]
    if unknown:
        raise ConfigError(f"no specialist named {', '.join(unknown)}; there are {', '.join(zoo)}")
    return {name: zoo[name] for name in names} if names else zoo


def run(config: PlanConfig) -> int:
    """Plan from the command line, print the route's summary and write its JSON."""
    for path in (config.json, config.figure):
        if path:
            check_writable(path)
    elevation, zoo = config.load()
    with torch.inference_mode():
        settings = replace(config.planning, backend=config.backend)
        planned = plan_on_map(
            elevation, zoo, config.start, config.goal, settings=settings, progress=True
        )
    if config.figure and planned.tensors:  # of a refusal too: it shows where the ground is closed
        save_figure(plan_figure(elevation, planned, f_min=settings.f_min), config.figure)
    if config.json and planned.answer:
        write_json(config.json, planned.route.to_json())
    for reason in planned.why_not(elevation):
        print(reason)
    print(planned.route)
    for what, path in (("route", config.json), ("figure", config.figure)):
        if path:
            print(f"{what} -> {path}")
    return 0
