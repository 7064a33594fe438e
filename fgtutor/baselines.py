"""Other ways to plan, through the same search: classical costs, one policy, parts of ours left out.

Reads a map and a zoo; gives the layers F [nx, ny, d] that `planning.plan` searches, one for each
policy that may drive. So a baseline differs from ours in these layers and in nothing else.
Sources: leggedrobotics/traversability_estimation (Wermelinger et al., "Navigation planning for
legged robots in challenging terrain", 2016) for the traversability and the values of its
`robot_filter_parameter.yaml`; Nav2's inflation layer and NavFn planner for the occupancy grid.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.fusion import fuse
from fgtutor.io.validation import Count, Positive, check_fields
from fgtutor.planning import Point, finer, plan_on_map, stands
from fgtutor.routes import Refusal, Route
from fgtutor.settings import HEADINGS, PlanSettings, Taus
from fgtutor.specialist import GENERAL, Specialist
from fgtutor.tensorization import Assessment, assess_all

Radius = Annotated[float, Interval(ge=0, le=10)]
"""How far something reaches, m."""
OURS = "ours"
"""The paper's planner: all specialists, fused."""


@dataclass(frozen=True, kw_only=True)
class TraversabilityConfig:
    """What the classical traversability counts as critical; a cell that reaches it is closed."""

    slope: Annotated[float, Interval(gt=0, le=math.pi / 2)] = 1.0
    """Critical slope, rad (slopeFilter)."""
    step: Positive = 0.12
    """Critical height of a step, m (stepFilter)."""
    step_cells: Count = 4
    """Cells with a critical step that it takes to close a cell (stepFilter)."""
    step_radius: Radius = 0.04
    """Radius of both windows of the step, m (stepFilter)."""
    roughness: Positive = 0.05
    """Critical standard deviation from the plane, m (roughnessFilter)."""
    plane_radius: Radius = 0.05
    """Radius in which the plane is fitted, m (surfaceNormalsFilter, roughnessFilter)."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, kw_only=True)
class OccupancyConfig:
    """What an occupancy grid calls an obstacle, and how it is inflated."""

    step: Positive = 0.12
    """A cell is lethal where the heights of it and its 8 neighbours differ by more, m. Nav2 knows
    flat floors only; this is the critical step of `TraversabilityConfig`."""
    inflation_radius: Radius = 0.55
    """How far an obstacle costs anything, m (Nav2's default)."""
    cost_scaling: Annotated[float, Interval(gt=0, le=1000)] = 10.0
    """How fast the cost decays, 1/m (Nav2's default)."""

    def __post_init__(self) -> None:
        check_fields(self)


def traversability(
    elevation: ElevationMap, radius: float, config: TraversabilityConfig | None = None
) -> Float[np.ndarray, "nx ny"]:
    """Return how traversable a robot of `radius` (m) finds each cell, from 0 (closed) to 1.

    The mean of three layers, each 1 - value / critical value: slope and roughness of the plane
    fitted around the cell, and the highest step nearby. A cell where one layer is 0 is closed, and
    so is the robot wherever its disc holds such a cell; elsewhere it gets the disc's mean.

    Radii of the original are smaller than our cells are large, so each reaches at least the 8
    neighbours. It lets a footprint tolerate a few critical cells and narrow gaps; this does not.
    """
    critical = config or TraversabilityConfig()
    heights = elevation.filled().heights.astype(np.float64)
    slope, roughness = _plane(heights, elevation.resolution, critical.plane_radius)
    step = _highest_step(heights, elevation.resolution, critical)
    layers = np.stack(
        [slope / critical.slope, step / critical.step, roughness / critical.roughness]
    )
    layers = 1 - np.minimum(layers, 1)
    free = (layers > 0).all(axis=0)
    disc = _disc(radius, elevation.resolution)
    mean = ndimage.convolve(layers.mean(axis=0), disc / disc.sum(), mode="nearest")
    return np.where(ndimage.minimum_filter(free, footprint=disc, mode="nearest"), mean, 0.0)


def _plane(
    heights: Float[np.ndarray, "nx ny"], resolution: float, radius: float
) -> tuple[Float[np.ndarray, "nx ny"], Float[np.ndarray, "nx ny"]]:
    """Fit a plane around each cell; return its slope, rad, and the deviation from it, m."""
    disc = _disc(max(radius, 1.5 * resolution), resolution).astype(np.float64)
    reach = len(disc) // 2
    across = np.arange(-reach, reach + 1)[:, None] * resolution * disc
    n, spread = disc.sum(), (across**2).sum()

    def total(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return ndimage.correlate(values, weights, mode="nearest")

    # Least squares on a symmetric window: the sums of x, y and xy vanish.
    gradient = [total(heights, weights) / spread for weights in (across, across.T)]
    steepness = gradient[0] ** 2 + gradient[1] ** 2
    mean = total(heights, disc) / n
    residual = total(heights**2, disc) - n * mean**2 - steepness * spread
    # Heights deviate along z, the plane's normal leans by the slope: distances are shorter.
    deviation = np.sqrt(np.maximum(residual, 0) / (n - 1) / (1 + steepness))
    return np.arctan(np.sqrt(steepness)), deviation


def _highest_step(
    heights: Float[np.ndarray, "nx ny"], resolution: float, critical: TraversabilityConfig
) -> Float[np.ndarray, "nx ny"]:
    """Return the highest step near each cell, less where only few cells have a critical one, m."""
    disc = _disc(max(critical.step_radius, 1.5 * resolution), resolution)
    window = {"footprint": disc, "mode": "nearest"}
    step = ndimage.maximum_filter(heights, **window) - ndimage.minimum_filter(heights, **window)
    count = ndimage.convolve((step > critical.step).astype(float), disc * 1.0, mode="nearest")
    return ndimage.maximum_filter(step, **window) * np.minimum(1, count / critical.step_cells)


def occupancy(
    elevation: ElevationMap, radius: float, config: OccupancyConfig | None = None
) -> Float[np.ndarray, "nx ny"]:
    """Return the feasibility that makes 1 / F the cost of an inflated occupancy grid.

    A cell nearer than `radius` (m, the robot's inscribed one) to a lethal cell is closed; beyond it
    the cost decays exponentially, c = 252 exp(-scaling (distance - radius)), and NavFn's step costs
    50 + 0.8 c; F is 50 over that.
    """
    settings = config or OccupancyConfig()
    heights = elevation.filled().heights
    around = {"size": 3, "mode": "nearest"}
    relief = ndimage.maximum_filter(heights, **around) - ndimage.minimum_filter(heights, **around)
    lethal = relief > settings.step
    if not lethal.any():
        return np.ones(elevation.shape)
    distance = np.asarray(ndimage.distance_transform_edt(~lethal)) * elevation.resolution
    cost = 252 * np.exp(-settings.cost_scaling * (distance - radius))
    cost[distance > settings.inflation_radius] = 0
    return np.where(distance <= radius, 0.0, 50 / (50 + 0.8 * cost))


def _disc(radius: float, resolution: float) -> Bool[np.ndarray, "side side"]:
    """Return which cells around one have their centre within `radius`, m."""
    reach = math.floor(radius / resolution + 1e-6)
    offset = np.arange(-reach, reach + 1)
    return np.hypot(*np.meshgrid(offset, offset)) <= radius / resolution + 1e-6


@dataclass(frozen=True, eq=False)
class AssessedMap:
    """A map and what each policy says of it, computed when it is first asked for."""

    elevation: ElevationMap
    """The map that is planned on."""
    zoo: Mapping[str, Specialist]
    """All policies, the generalist among them."""
    taus: Taus = "calibrated"
    """Thresholds of w_ood."""
    headings: HeadingCount = HEADINGS
    """The number of headings that cells can be left along."""
    _known: dict[str, Assessment] = field(default_factory=dict)
    _along: dict[HeadingCount, "AssessedMap"] = field(default_factory=dict)

    def along(self, headings: HeadingCount) -> "AssessedMap":
        """Return the same map along another number of headings."""
        if headings not in self._along:
            self._along[headings] = AssessedMap(self.elevation, self.zoo, self.taus, headings)
        return self._along[headings]

    @property
    def specialists(self) -> list[str]:
        """The names of all policies but the generalist."""
        return [name for name in self.zoo if name != GENERAL]

    @property
    def radius(self) -> float:
        """The robot's inscribed radius, as its patch grid's footprint has it, m."""
        return next(iter(self.zoo.values())).grid.footprint[1]

    def assessment(self, name: str) -> Assessment:
        """Return what one policy says."""
        if name not in self._known:
            # The specialists share their patches. The generalist is assessed apart: few planners
            # ask for both.
            team = [name] if name == GENERAL else self.specialists
            asked = {member: self.zoo[member] for member in team}
            options = {"taus": self.taus, "headings": self.headings}
            self._known.update(assess_all(self.elevation, asked, **options))
        return self._known[name]

    def tensors(self, *names: str) -> "Layers":
        """Return F_i of the named policies, of all specialists unless names are given."""
        return {name: self.assessment(name).weighted() for name in names or self.specialists}


Layers = dict[str, Float[Tensor, "nx ny d"]]
"""F of each policy that may drive, by name."""
Planner = Callable[[AssessedMap], Sequence[Layers]]
"""Gives the layers to plan on; of several, the cheapest route is taken."""
Cells = Callable[[ElevationMap, float], Float[np.ndarray, "nx ny"]]
"""A classical map: one number per cell, for a robot of a radius, m."""


def single(name: str, ground: AssessedMap) -> Sequence[Layers]:
    """Plan for one policy, by its own tensor."""
    return [ground.tensors(name)]


def straight(name: str, ground: AssessedMap) -> Sequence[Layers]:
    """Plan for one policy as if it could take every step: straight on, without asking it."""
    return [{name: torch.ones(*ground.elevation.shape, ground.headings)}]


def ours(ground: AssessedMap) -> Sequence[Layers]:
    """Plan for all specialists, fused (the paper)."""
    return [ground.tensors()]


def without_ood(ground: AssessedMap) -> Sequence[Layers]:
    """Ours without w_ood: believe each f wherever it is asked."""
    assessments = {name: ground.assessment(name) for name in ground.specialists}
    return [{name: one.closed(one.f) for name, one in assessments.items()}]


def without_heading(ground: AssessedMap) -> Sequence[Layers]:
    """Ours with one number per cell, the mean of F_i over the headings.

    That is no step's F, so its routes promise nothing (see `find_route`).
    """
    tensors = ground.tensors()
    return [{name: _all_headings(tensor.mean(dim=-1), ground) for name, tensor in tensors.items()}]


def without_fusion(ground: AssessedMap) -> Sequence[Layers]:
    """Ours without fusion: one specialist drives all the way, the one with the cheapest route."""
    return [{name: tensor} for name, tensor in ground.tensors().items()]


@dataclass(frozen=True)
class Classical:
    """Plan on a classical map, which knows of no policies; the generalist drives.

    Its F is a cost in disguise, so its routes promise nothing (see `find_route`).
    """

    cells: Cells

    def __call__(self, ground: AssessedMap) -> Sequence[Layers]:
        """Return the one layer, that of the generalist."""
        return [{GENERAL: self.layer(ground)}]

    def layer(self, ground: AssessedMap) -> Float[Tensor, "nx ny d"]:
        """Return what the map says of every step."""
        values = torch.from_numpy(self.cells(ground.elevation, ground.radius))
        return _all_headings(values, ground)


class Switched(Classical):
    """Plan on a classical map; our policy map P says which specialist drives.

    A change of policies costs its search nothing, and each step has one driver only.
    """

    def __call__(self, ground: AssessedMap) -> Sequence[Layers]:
        """Return the layers: each step stands in that of its driver."""
        layer, tensors = self.layer(ground), ground.tensors()
        _, policy_map = fuse(list(tensors.values()))
        return [{name: layer * (policy_map == i) for i, name in enumerate(tensors)}]


def _all_headings(values: Float[Tensor, "nx ny"], ground: AssessedMap) -> Float[Tensor, "nx ny d"]:
    """Return what one number per cell says of steps: the least of the cells that each leaves."""
    headings = Headings(ground.headings)
    everywhere = values[..., None].expand(-1, -1, headings.count)
    return torch.from_numpy(headings.least(everywhere.numpy()))


def planners(zoo: Mapping[str, Specialist]) -> dict[str, Planner]:
    """Return every planner that a zoo allows, by name; without a generalist, those it drives for
    are missing."""
    generalist = GENERAL in zoo
    return {
        **{name: partial(single, name) for name in zoo if name != GENERAL},
        OURS: ours,
        **({GENERAL: partial(single, GENERAL)} if generalist else {}),
        "no-ood": without_ood,
        "no-heading": without_heading,
        "no-fusion": without_fusion,
        **({"traversability": Classical(traversability)} if generalist else {}),
        "traversability+P": Switched(traversability),
        **({"occupancy": Classical(occupancy)} if generalist else {}),
        "occupancy+P": Switched(occupancy),
    }


def find_route(
    planner: Planner,
    ground: AssessedMap,
    start: Point,
    goal: Point,
    settings: PlanSettings | None = None,
    **changes: Any,
) -> Route | Refusal:
    """Return the planner's cheapest route, whose `names` are the policies that may drive it.

    `settings` and `changes` are those of `planning.plan`, but for the thresholds and headings,
    which are the map's; `finer_headings` are tried after those as by `plan_on_map`.
    Where F is not what a policy says of a step (classical maps, no heading) every route will do;
    where P names the drivers (`Switched`) changes of policy are free. Raises `ConfigError` if the
    planner offers no layers.
    """
    settings = replace(settings or PlanSettings(), **changes | {"headings": ground.headings})
    if isinstance(planner, Classical) or planner is without_heading:
        settings = replace(settings, least_promise=0.0)
    if isinstance(planner, Switched):
        settings = replace(settings, switch_cost=0.0)
    answers = []
    for layers in planner(ground):
        team = {name: ground.zoo[name] for name in layers}
        options = {"settings": settings, "tensors": layers}
        answers.append(plan_on_map(ground.elevation, team, start, goal, **options).answer)
    if not answers:
        raise ConfigError("this planner has no policy to plan for: the zoo is empty")
    routes = [answer for answer in answers if isinstance(answer, Route)]
    best = min(routes, key=lambda route: route.cost, default=answers[-1])
    more = finer(settings, best)
    if more is None:
        return best
    other = find_route(planner, ground.along(more.headings), start, goal, more)
    return best if stands(best, other) else other
