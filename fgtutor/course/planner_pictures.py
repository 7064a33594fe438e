"""Pictures of the learner's planner: her patch, w_ood, tensor and route, and her robot crossing.

Reads the stages with her functions; draws each on the corridor.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.ndimage import median_filter

from fgtutor import patches
from fgtutor.course.crossing import driven, glided
from fgtutor.course.patch_pictures import heading_maps, patch_at
from fgtutor.course.route_pictures import draw_drive
from fgtutor.course.stages import (
    F_MIN,
    asked,
    corridor,
    edges,
    ends,
    fused,
    library_plan,
    planned,
    route_of,
    routed,
    tensors,
    weights,
    zoo,
)
from fgtutor.course.substitutes import Stages, same_shape
from fgtutor.directions import NUM_HEADINGS
from fgtutor.elevation import ElevationMap
from fgtutor.figures.maps import draw_elevation, draw_route
from fgtutor.figures.relief import GROUND
from fgtutor.figures.style import TITLE, Picture
from fgtutor.routes import Route

SWITCH = 2.0
"""What a change of policy costs, in steps over perfect ground."""


def draw_patch(own: Stages) -> Figure:
    """Draw a patch at the edge of the rubble, and how much higher the next cell along +x is."""
    grid, elevation = zoo()["steps"].grid, patches.prepare(corridor().elevation)
    pose = np.array([1.4, 2.0, math.radians(20)])
    offsets = grid.points.double().numpy()
    ours = patches.rotate(grid.points.double(), torch.tensor(pose[2])).numpy() + pose[:2]
    points = own.run(
        "patch_points",
        lambda: ours,
        lambda f: same_shape(f(offsets.copy(), pose.copy()), ours),
    )
    heights = elevation.heights.astype(float)
    origin, resolution = np.array(elevation.origin), elevation.resolution
    under = np.zeros(len(offsets), dtype=bool)
    under[grid.footprint_index.numpy()] = True
    sampled = patch_at(elevation, pose, grid).double().numpy()
    patch = own.run(
        "cut_patch",
        lambda: sampled,
        lambda f: same_shape(
            f(heights.copy(), origin.copy(), resolution, pose.copy(), offsets.copy(), under.copy()),
            sampled,
        ),
    )
    inside = np.floor((points - origin) / resolution).astype(int)
    cells = own.run(
        "cells_of",
        lambda: inside,
        lambda f: same_shape(f(points.copy(), origin.copy(), resolution), inside).astype(int),
    )
    after = np.pad(heights, ((0, 1), (0, 0)), constant_values=np.nan)[1:] - heights
    rise = own.run("rise", lambda: after, lambda f: same_shape(f(heights.copy(), 0), after))
    figure = Picture(7.4, 4.6)
    above, right, left = figure.subplot_mosaic([["map", "rise"], ["patch", "patch"]]).values()
    draw_elevation(elevation.crop(0.0, 0.0, 6.0, 4.0), axes=above, bare=True)
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.scatter(*points.T, s=5, color="black")
    centres = origin + (cells + 0.5) * resolution
    above.scatter(*centres.T, s=3, color="#D55E00")
    above.set_title("Points of the patch (black)\nand their cells (orange)", **TITLE, loc="left")
    shape = grid.shape
    extent = (-grid.behind, grid.ahead, -grid.half_width, grid.half_width)
    tall = float(np.nanmax(np.abs(patch)))
    image = left.imshow(
        patch.reshape(shape).T, origin="lower", extent=extent, cmap=GROUND, vmin=-tall, vmax=tall
    )
    figure.colorbar(image, ax=left, label="height (m)", shrink=0.8)
    left.set_title("The patch", **TITLE, loc="left")
    left.set(xlabel="ahead (m)", ylabel="left (m)")
    reach = float(np.nanmax(np.abs(rise[:60])))
    image = right.imshow(
        rise[:60].T, origin="lower", extent=(0, 6, 0, 4), cmap="BrBG_r", vmin=-reach, vmax=reach
    )
    figure.colorbar(image, ax=right, label="rise (m)", shrink=0.6)
    right.set_title("Up or down\nalong heading 0 (+x)", **TITLE, loc="left")
    right.set(xlabel="x (m)", ylabel="y (m)")
    return figure


def draw_weights(own: Stages) -> Figure:
    """Draw L_recon of the steps specialist, and w_ood of all of them, along +x."""
    losses = {name: loss for name, (_, loss) in asked(own).items()}
    every = weights(own, losses)
    panels = {
        "L_recon of steps, up to 5": np.minimum(losses["steps"][..., 0], 5) / 5,
        **{f"w_ood of {name}": weight[..., 0] for name, weight in every.items()},
    }
    return layers(
        panels,
        "Which ground does each specialist know? Heading 0 (+x)\n(w_ood: the smaller one of "
        "Eq. 4 and of the p-value's weight)",
    )


def layers(panels: Mapping[str, np.ndarray], title: str) -> Picture:
    """Draw maps [nx, ny] of numbers from 0 to 1 below each other, beside the map itself."""
    figure = Picture(7.4, 1.5 * (len(panels) + 1))
    rows = figure.subplots(len(panels) + 1, 1, sharex=True)
    elevation = corridor().elevation
    draw_elevation(elevation, axes=rows[0], bare=True)
    rows[0].set_aspect("auto")  # as wide as the maps below it
    x0, y0, x1, y1 = elevation.extent
    for axes, (name, values) in zip(rows[1:], panels.items(), strict=True):
        axes.imshow(
            values.T, origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=1, aspect="auto"
        )
        axes.set_title(name, fontsize=9, loc="left")
        axes.set_ylabel("y (m)", fontsize=8)
    rows[-1].set_xlabel("x (m)")
    figure.colorbar(rows[-1].images[0], ax=rows, shrink=0.6)
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def draw_tensor(own: Stages) -> Figure:
    """Draw f of the steps specialist over the slopes, and say two shorter ways to it."""
    x0, x1, around = 4.5, 9.5, 13  # cells: a patch reaches no further
    shown, elevation = slice(around, -around), corridor().elevation
    margin = around * elevation.resolution
    first, last = (round(x / elevation.resolution) for x in (x0, x1))
    answer = asked(own)["steps"][0][first:last]
    part = elevation.crop(x0 - margin, 0.0, x1 + margin, 4.0)
    along = convolved(own, part)[shown]
    worst = float(np.abs(along - answer)[..., ::2].max())
    again, windows = renewed(own, part)
    figure = heading_maps(answer, elevation.crop(x0, 0.0, x1, 4.0), label="f of steps")
    figure.suptitle(
        f"f of steps over the slopes; by convolution, it differs by {worst:.0e} at most\n"
        f"With a box put down here, {again:,} of {windows:,} windows along +x are asked again",
        **TITLE,
        x=0.01,
    )
    return figure


def convolved(own: Stages, part: ElevationMap) -> Float[np.ndarray, "nx ny 8"]:
    """Return f of the steps specialist along the four axes, by one layer slid over turned maps."""
    answer = np.zeros((*part.shape, NUM_HEADINGS))
    for quarters in range(4):
        turned = part.rotated90(-quarters % 4)
        along = np.zeros((*turned.shape, NUM_HEADINGS))
        along[..., 0] = ahead(own, turned)
        back = np.roll(np.rot90(along, quarters), 2 * quarters, axis=-1)
        answer += own.run(
            "turned",
            lambda back=back: back,
            lambda f, along=along, q=quarters, back=back: same_shape(f(along, q), back),
        )
    return answer


def renewed(own: Stages, part: ElevationMap) -> tuple[int, int]:
    """Put a box of 3 x 3 cells on the map; return how many windows were asked again, and of all.

    Raises `ValueError` inside the stage, so that it is named, if an answer differs from the net's.
    """
    specialist = zoo()["steps"]
    grid, command = specialist.grid, torch.tensor(specialist.command)
    rows, columns = grid.shape
    before = patches.prepare(part).heights.astype(float)
    after = before.copy()
    after[part.shape[0] // 2 :, part.shape[1] // 2 :][:3, :3] += 0.15
    count = 0

    def ask(windows: np.ndarray) -> np.ndarray:
        nonlocal count
        count += len(windows)
        cut = torch.tensor(windows).float()
        with torch.no_grad():
            relative = cut - patches.ground_height(cut, grid)
            f = specialist.feasibility.feasibility(relative, command.expand(len(cut), -1))
        return f.double().numpy()

    def windows_of(heights: np.ndarray) -> np.ndarray:
        view = np.lib.stride_tricks.sliding_window_view(heights, (rows, columns))
        return view.reshape(*view.shape[:2], -1)

    old, new = windows_of(before), windows_of(after)
    known, wanted = (ask(w.reshape(-1, w.shape[-1])).reshape(w.shape[:2]) for w in (old, new))

    def hers(function: Any) -> int:
        nonlocal count
        count = 0
        answer = same_shape(
            function(known.copy(), before.copy(), after.copy(), rows, columns, ask), known
        )
        if np.abs(answer - wanted).max() > 1e-5:
            raise ValueError(
                "its answers are not those of the network for the map after the change"
            )
        return count

    return own.run("reassess", lambda: int((old != new).any(axis=-1).sum()), hers), known.size


def ahead(own: Stages, elevation: ElevationMap) -> Float[np.ndarray, "nx ny"]:
    """Return f of the steps specialist along heading 0, its first layer slid over the map."""
    specialist = zoo()["steps"]
    net, grid = specialist.feasibility, specialist.grid
    first: Any = net.head[0]
    command = torch.tensor(specialist.command)
    rows, columns = grid.shape
    behind, aside = round(grid.behind / grid.spacing), columns // 2
    surface = patches.prepare(elevation).heights.astype(float)
    reach = ((behind, rows - 1 - behind), (aside, aside))
    padded = np.pad(surface, reach, mode="edge")
    kernels = first.weight.detach()[:, : grid.num_points].double() * net.height_scale
    kernels = kernels.reshape(-1, rows, columns).numpy()
    image, filters = torch.tensor(padded)[None, None], torch.tensor(kernels)[:, None]
    ours = torch.nn.functional.conv2d(image, filters)[0].numpy()
    slid = own.run(
        "first_layer",
        lambda: ours,
        lambda f: same_shape([f(padded.copy(), kernel.copy(), 0.0) for kernel in kernels], ours),
    )
    under = [2 * round(half / grid.spacing) + 1 for half in grid.footprint]
    ground = median_filter(surface, size=under, mode="nearest")
    with torch.no_grad():
        constant = first.weight[:, grid.num_points :] @ command + first.bias
        sums = torch.tensor(slid - kernels.sum(axis=(1, 2))[:, None, None] * ground).float()
        hidden = (sums + constant[:, None, None]).movedim(0, -1)
        return torch.sigmoid(net.head[1:](hidden)).squeeze(-1).double().numpy()


def draw_plan(own: Stages) -> Figure:
    """Draw F_max and the route over the corridor, and what it costs with and without switches."""
    every = tensors(own)
    best, policy = fused(own, every)
    route = routed(own, best, policy)
    figure = Picture(7.4, 4.8)
    upper, lower = figure.subplots(2, 1, sharex=True)
    elevation = corridor().elevation
    x0, y0, x1, y1 = elevation.extent
    image = upper.imshow(
        best[..., 0].T, origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=1, aspect="auto"
    )
    figure.colorbar(image, ax=upper, label="F_max")
    upper.set_title("F_max along heading 0 (+x)", **TITLE, loc="left")
    upper.set_ylabel("y (m)")
    draw_elevation(elevation, axes=lower, bare=True)
    draw_route(route, elevation, axes=lower)
    cost = own.run(
        "route_cost",
        lambda: float((1 / route.feasibility).sum()),
        lambda f: float(f(best.copy(), route.cells.copy())),
    )
    least = own.run(
        "cheapest",
        lambda: float(library_plan(best, policy).costs.sum()),
        lambda f: float(f(edges(own, best).copy(), *ends())),
    )
    thinking = own.run(
        "cheapest_switching",
        lambda: float(library_plan(best, policy, tensors=[*every], switch_cost=SWITCH).costs.sum()),
        lambda f: float(f(every.copy(), F_MIN, SWITCH, *ends())),
    )
    lower.set_title(
        f"The route: {route.length:.1f} m, cost {cost:.1f}; the least there is: {least:.1f}\n"
        f"If a switch costs {SWITCH:g}: {cost + SWITCH * route.switches:.1f} with its "
        f"{route.switches} switches; the best: {thinking:.1f}",
        **TITLE,
        loc="left",
    )
    return figure


def draw_crossing(own: Stages) -> Figure:
    """Draw the robot's drive over the route, with every stage of the planner."""
    return crossed(own, planned(own))


def draw_capstone(own: Stages) -> Figure:
    """Draw the drive over the route that `face_map` plans from F_i, with its policies."""
    every = tensors(own)

    def hers(function: Any) -> Route:
        cells, policies = (np.asarray(part) for part in function(every.copy(), F_MIN, *ends()))
        best, policy = every.max(axis=0), every.argmax(axis=0)
        route = route_of(cells, best, policy, 1 / np.maximum(best, F_MIN))
        if policies.shape != route.policies.shape or not {*policies.tolist()} <= {
            *range(len(every))
        }:
            raise ValueError("it does not name a policy for each step")
        return replace(route, policies=policies.astype(int))

    return crossed(own, own.run("face_map", lambda: routed(own, *fused(own, every)), hers))


def crossed(own: Stages, route: Route) -> Figure:
    """Draw the robot's drive over a route, dotted what it would be without physics."""
    episode, _ = driven(own, route)
    figure = draw_drive(episode, route, corridor().elevation)
    ghost = glided(own, route, episode.seconds / len(episode.poses))
    axes = figure.axes[0]
    axes.plot(*ghost[:, :2].T, ":", color="black", linewidth=1.5)
    axes.set_title(f"{axes.get_title(loc='left')}; dotted: without physics", **TITLE, loc="left")
    return figure
