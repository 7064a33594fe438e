"""The stages of the planner, each the learner's function if it has passed, else the library's.

Reads functions by name (`substitutes`); runs them on one terrain of the toy, a corridor with all
four obstacles across it, and gives each stage's answer to the next: patches, f and L_recon, w_ood,
F_i, F_max and P, and a route, which `crossing` drives.
"""

import itertools
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from fgtutor import patches
from fgtutor.course import own_net
from fgtutor.course.patch_pictures import patch_at
from fgtutor.course.substitutes import Stages, same_shape
from fgtutor.directions import STEPS, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import ALPHA, ood_weight
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.routes import Route
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.tensorization import assess
from fgtutor.world.terrain import Terrain, make_terrain

SEED = 1
"""The corridor that is planned over: its four obstacles can all be crossed."""
TAUS = 0.1, 2.0
"""The paper's thresholds on L_recon."""
TRAINED = "steps"
"""The specialist on whose drives the learner's Feasibility-Net is trained."""
F_MIN = 0.1
"""Least feasibility of an edge."""
AHEAD = [1, 7]
"""The diagonal headings that lead towards the goal; the learner's patches are cut along them."""


# What the planner runs on -------------------------------------------------------------------------


@cache
def corridor() -> Terrain:
    """Return the terrain: steps, slopes, rubble and gaps, one after another, from wall to wall."""
    return make_terrain("mixed", robot="toy", seed=SEED)


@cache
def zoo() -> dict[str, Specialist]:
    """Return the shipped specialists of the toy."""
    return dict(load_zoo("toy"))


@cache
def library_patches() -> Float[np.ndarray, "nx ny 8 points"]:
    """Return the patch of every cell and heading, m, as the library cuts it."""
    x, y = (torch.tensor(centres) for centres in corridor().elevation.centres)
    poses = torch.cartesian_prod(x, y, torch.tensor(Headings().yaws))
    cut = patch_at(corridor().elevation, poses, _grid())
    return cut.reshape(len(x), len(y), Headings().count, -1).numpy()


@cache
def own_losses() -> dict[str, Float[np.ndarray, " n"]]:
    """Return for each specialist L_recon on its own terrain, at places of another map."""
    found = {}
    for name, specialist in zoo().items():
        elevation = make_terrain(name, robot="toy", seed=SEED + 1).elevation
        losses = assess(elevation, specialist).reconstruction[..., 0].double().numpy()
        found[name] = losses[::4, ::4].ravel()
    return found


def _grid() -> patches.PatchGrid:
    """Return where the points of a patch lie; the toy's specialists agree on it."""
    return zoo()["steps"].grid


# The stages ---------------------------------------------------------------------------------------


def seen(own: Stages) -> Float[np.ndarray, "nx ny 8 points"]:
    """Return the patch H_xy of every cell and heading, m, relative to the ground below the robot.

    `tensorize` slides the windows along the four axes. `cut_patch` cuts the patches along the two
    diagonals ahead, one call for each; those of the way back stay the library's.
    """
    ours = library_patches()
    surface = patches.prepare(corridor().elevation)
    patch = ours.copy()
    patch[:, :, ::2] = own.run(
        "tensorize", lambda: ours[:, :, ::2], lambda f: windows_of(f, surface)
    )
    patch[:, :, AHEAD] = own.run(
        "cut_patch", lambda: ours[:, :, AHEAD], lambda f: diagonals_of(f, surface)
    )
    return patch


def windows_of(function: Callable[..., Any], surface: ElevationMap) -> np.ndarray:
    """Return the patches [nx, ny, 4, points] that the learner's `tensorize` asks about.

    The network that it asks only counts the windows, so the tensor says which window belongs to
    which cell. Her robot stands in the first row of a window, ours `behind` further ahead.
    """
    grid, (nx, ny) = _grid(), surface.shape
    rows, columns = grid.shape
    around = max(rows, columns)  # beyond its edge the map goes on as it ends
    heights = np.pad(surface.heights.astype(float), around, mode="edge")
    asked: list[np.ndarray] = []

    def ask(windows: np.ndarray) -> np.ndarray:
        asked.extend(np.array(windows))
        return np.arange(len(asked) - len(windows), len(asked)) + 1.0

    answer = same_shape(function(heights, rows, columns, ask), np.zeros((*heights.shape, 4)))
    back = around - round(grid.behind / grid.spacing) * STEPS[::2]
    number = [answer[x : x + nx, y : y + ny, k] for k, (x, y) in enumerate(back.tolist())]
    which = np.stack(number, axis=-1).astype(int) - 1
    if which.min() < 0 or which.max() >= len(asked):
        raise ValueError("its tensor lacks windows of the map, or changes what `ask` answers")
    cut = np.array(asked)[which]
    return cut - np.median(cut[..., grid.footprint_index.numpy()], axis=-1, keepdims=True)


def diagonals_of(function: Callable[..., Any], surface: ElevationMap) -> np.ndarray:
    """Return the patches [nx, ny, 2, points] that the learner's `cut_patch` cuts ahead."""
    grid, (x, y), yaws = _grid(), surface.centres, Headings().yaws
    offsets, under = grid.points.double().numpy(), np.zeros(grid.num_points, dtype=bool)
    under[grid.footprint_index.numpy()] = True
    # Points beyond the map are unknown to her: there the map goes on as it ends.
    around = round(patches.reach(grid) / surface.resolution) + 1
    heights = np.pad(surface.heights.astype(float), around, mode="edge")
    origin = np.array(surface.origin) - around * surface.resolution
    given = heights, origin, surface.resolution
    poses = np.array([*itertools.product(x, y, yaws[AHEAD])])
    cut = np.array([function(*given, pose, offsets, under) for pose in poses])
    return cut.reshape(len(x), -1, 2, grid.num_points)


def asked(own: Stages) -> dict[str, tuple[Float[np.ndarray, "nx ny 8"], ...]]:
    """Return f and L_recon of every cell and heading, by each specialist's networks.

    For the specialist `TRAINED`, f comes from the learner's own net, if hers has passed.
    """
    patch, found = torch.tensor(seen(own)), {}
    for name, specialist in zoo().items():
        net: Any = specialist.feasibility
        with torch.no_grad():
            command = torch.tensor(specialist.command).expand(*patch.shape[:-1], -1)
            f = net.feasibility(patch, command).double().numpy()
        if name == TRAINED:
            f = own_net.feasibility(own, name, patch, command, f)
        with torch.no_grad():
            relief = net.relief(patch)
            decoded = net.decoder(net.encoder(relief).chunk(2, dim=-1)[0])
            ours = (decoded - relief).square().sum(dim=-1).double().numpy()
        # In metres, as the autoencoder sees them: it may let great heights saturate.
        heights = relief.flatten(0, -2).double().numpy() / net.height_scale
        flat = decoded.flatten(0, -2).double().numpy()
        loss = own.run(
            "reconstruction_loss",
            lambda ours=ours: ours,
            lambda g, h=heights, d=flat, scale=net.height_scale, ours=ours: same_shape(
                g(h, d, scale), ours.ravel()
            ).reshape(ours.shape),
        )
        found[name] = f, loss
    return found


def weights(
    own: Stages, losses: Mapping[str, Float[np.ndarray, "nx ny 8"]]
) -> dict[str, Float[np.ndarray, "nx ny 8"]]:
    """Return w_ood of each specialist: what it knows by the paper's thresholds AND by its p-value.

    The smaller counts of Eq. 4 and of clip(p / alpha), p among the losses on its own terrain.
    """
    found = {}
    for name, loss in losses.items():
        known = np.sort(own_losses()[name])
        flat = loss.ravel()
        by_loss = own.run(
            "ood_weight",
            lambda loss=loss: ood_weight(loss, *TAUS),
            lambda f, loss=loss: same_shape(f(loss.copy(), *TAUS), loss),
        )
        by_share = own.run(
            "conformal_weight",
            lambda flat=flat, known=known: p_weight(flat, known),
            lambda f, flat=flat, known=known: same_shape(f(flat.copy(), known.copy(), ALPHA), flat),
        )
        found[name] = np.minimum(by_loss, by_share.reshape(loss.shape))
    return found


def p_weight(losses: Float[np.ndarray, " m"], known: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return clip(p / alpha), p the share of the sorted `known` losses that are as large."""
    beyond = len(known) - np.searchsorted(known, losses)
    return np.clip(beyond / len(known) / ALPHA, 0, 1)


def tensors(own: Stages) -> Float[np.ndarray, "policies nx ny 8"]:
    """Return F_i = w_ood f of each specialist, 0 where a step leaves the map (Eq. 5)."""
    said = asked(own)
    trust = weights(own, {name: loss for name, (_, loss) in said.items()})
    inside = Headings().steps_within(corridor().elevation.known)
    return np.stack([np.where(inside, trust[name] * f, 0.0) for name, (f, _) in said.items()])


def fused(
    own: Stages, every: Float[np.ndarray, "policies nx ny 8"]
) -> tuple[Float[np.ndarray, "nx ny 8"], Int[np.ndarray, "nx ny 8"]]:
    """Return F_max and P of all specialists (Eqs. 6-7)."""
    ours = tuple(np.asarray(part) for part in fuse([*every]))

    def hers(function: Any) -> tuple[np.ndarray, np.ndarray]:
        best, policy = function(every.copy())
        return same_shape(best, ours[0]), same_shape(policy, ours[1]).astype(int)

    return own.run("fuse", lambda: ours, hers)


def edges(own: Stages, best: Float[np.ndarray, "nx ny 8"]) -> Float[np.ndarray, "nx ny 8"]:
    """Return the cost of every step, 1 / F_max, infinite below F_MIN (Sec. III-C)."""
    with np.errstate(divide="ignore"):
        costs = np.where(best >= F_MIN, 1 / best, np.inf)
    return own.run("edge_costs", lambda: costs, lambda f: same_shape(f(best.copy(), F_MIN), costs))


def planned(own: Stages) -> Route:
    """Return the cheapest route over the corridor, by all stages that come before it."""
    return routed(own, *fused(own, tensors(own)))


@cache
def library_route() -> Route:
    """Return the route that the library plans over the corridor."""
    return planned(Stages({}, []))


def routed(
    own: Stages, best: Float[np.ndarray, "nx ny 8"], policy: Int[np.ndarray, "nx ny 8"]
) -> Route:
    """Return the cheapest route by F_max and P (Sec. III-C)."""
    costs = edges(own, best)

    def hers(function: Any) -> Route:
        return route_of(np.asarray(function(costs.copy(), *ends())), best, policy, costs)

    return own.run("cheapest_route", lambda: library_plan(best, policy), hers)


def library_plan(best: np.ndarray, policy: np.ndarray, **options: Any) -> Route:
    """Return the library's route by F_max and P, each step at the paper's cost 1 / F.

    Raises a `PlanningError` if there is none.
    """
    terrain = corridor()
    options |= {"grid": terrain.elevation, "start": terrain.start, "goal": terrain.goal}
    options |= {"names": tuple(zoo()), "f_min": F_MIN, "cost": "inverse"}
    return plan(best, policy, **options).raise_for()


def ends() -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the cells of the start and the goal."""
    terrain = corridor()
    return terrain.elevation.cell_of(*terrain.start), terrain.elevation.cell_of(*terrain.goal)


def route_of(
    cells: Int[np.ndarray, "n 2"],
    best: Float[np.ndarray, "nx ny 8"],
    policy: Int[np.ndarray, "nx ny 8"],
    costs: Float[np.ndarray, "nx ny 8"],
) -> Route:
    """Describe a chain of cells; raises `ValueError` if it is none from start to goal."""
    grid, headings = corridor().elevation, Headings()
    if len(cells) < 2 or (*map(tuple, cells[[0, -1]].tolist()),) != ends():
        raise ValueError("its cells do not lead from the start to the goal")
    steps = np.diff(cells, axis=0)
    if not (steps[:, None] == STEPS).all(axis=-1).any(axis=-1).all():
        raise ValueError("its cells are not all neighbours")
    along = headings.index_of(steps)
    at = (*cells[:-1].T, along)
    x, y = grid.centres
    return Route(
        cells=cells,
        xy=np.stack((x[cells[:, 0]], y[cells[:, 1]]), axis=-1),
        headings=along,
        policies=policy[at],
        feasibility=best[at],
        costs=costs[at],
        length=float(headings.lengths[along].sum() * grid.resolution),
        names=tuple(zoo()),
    )
