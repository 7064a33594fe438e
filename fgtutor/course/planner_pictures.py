"""Pictures of the learner's planner: her patch, w_ood, tensor and route, and her robot crossing.

Reads the stages with her functions; draws each on the corridor.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.ndimage import median_filter

from fgtutor import patches
from fgtutor.course.patch_pictures import heading_maps, patch_at
from fgtutor.course.route_pictures import draw_drive
from fgtutor.course.stages import (
    Stages,
    assessed,
    corridor,
    driven,
    fused,
    planned,
    same_shape,
    weights,
    zoo,
)
from fgtutor.directions import NUM_HEADINGS
from fgtutor.elevation import ElevationMap
from fgtutor.figures.maps import draw_elevation, draw_route
from fgtutor.figures.style import TITLE, Picture
from fgtutor.tensorization import assess_all

OWN = slice(95, 126)
"""Where along x the corridor has steps, the own terrain of the steps specialist."""


def draw_patch(own: Stages) -> Figure:
    """Draw the patch before the first gap's rim, and which way is up from every cell."""
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
    figure = Picture(7.4, 5.0)
    above, left, right = figure.subplot_mosaic([["map", "map"], ["patch", "rise"]]).values()
    draw_elevation(elevation.crop(0.0, 0.0, 6.0, 4.0), axes=above, bare=True)
    above.scatter(*points.T, s=5, color="black")
    centres = origin + (cells + 0.5) * resolution
    above.scatter(*centres.T, s=3, color="#D55E00")
    above.set_title("Points of the patch (black), their cells (orange)", **TITLE, loc="left")
    shape = grid.shape
    extent = (-grid.behind, grid.ahead, -grid.half_width, grid.half_width)
    image = left.imshow(patch.reshape(shape).T, origin="lower", extent=extent, cmap="cividis")
    figure.colorbar(image, ax=left, orientation="horizontal", label="height (m)")
    left.set_title("The patch", **TITLE, loc="left")
    left.set(xlabel="ahead (m)", ylabel="left (m)")
    reach = float(np.nanmax(np.abs(rise[:60])))
    image = right.imshow(
        rise[:60].T, origin="lower", extent=(0, 6, 0, 4), cmap="BrBG_r", vmin=-reach, vmax=reach
    )
    figure.colorbar(image, ax=right, orientation="horizontal", label="rise (m)")
    right.set_title("Up or down along heading 0 (+x)", **TITLE, loc="left")
    right.set(xlabel="x (m)", ylabel="y (m)")
    return figure


def draw_weights(own: Stages) -> Figure:
    """Draw L_recon and w_ood of every specialist along +x."""
    elevation, every = corridor().elevation, weights(own)
    net: Any = zoo()["steps"].feasibility
    grid = zoo()["steps"].grid
    x, y = (torch.tensor(centres, dtype=torch.float32) for centres in elevation.centres)
    poses = torch.cartesian_prod(x, y, torch.zeros(1))
    with torch.no_grad():
        seen = net.relief(patch_at(elevation, poses, grid))
        decoded = net.decoder(net.encoder(seen).chunk(2, dim=-1)[0]).double().numpy()
    heights = seen.double().numpy() / net.height_scale
    ours = assessed()["steps"].reconstruction[..., 0].numpy()
    loss = own.run(
        "reconstruction_loss",
        lambda: ours,
        lambda f: same_shape(f(heights, decoded, net.height_scale), ours.ravel()).reshape(
            ours.shape
        ),
    )
    flat, known = loss.ravel(), loss[OWN].ravel()
    share = np.array([(known >= one).mean() for one in flat])
    trust = own.run(
        "conformal_weight",
        lambda: np.minimum(share / 0.1, 1.0),
        lambda f: same_shape(f(flat.copy(), known.copy(), 0.1), flat),
    ).reshape(loss.shape)
    panels = {
        "L_recon of steps, up to 5": np.minimum(loss, 5) / 5,
        "the same as a p-value's weight (alpha = 0.1)": trust,
        **{f"w_ood of {name}": weight[..., 0] for name, weight in every.items()},
    }
    return layers(panels, "Which ground does each specialist know? Heading 0 (+x)")


def layers(panels: Mapping[str, np.ndarray], title: str) -> Picture:
    """Draw maps [nx, ny] of numbers from 0 to 1 below each other, beside the map itself."""
    figure = Picture(7.4, 1.5 * (len(panels) + 1))
    rows = figure.subplots(len(panels) + 1, 1, sharex=True)
    elevation = corridor().elevation
    draw_elevation(elevation, axes=rows[0], bare=True)
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
    """Draw f of the steps specialist along the four axes, by one layer slid over turned maps."""
    part = corridor().elevation.crop(4.5, 0.0, 9.5, 4.0)
    steps = {"steps": zoo()["steps"]}
    ours = assess_all(part, steps)["steps"].f.double().numpy()
    answer = np.zeros_like(ours)
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
    worst = float(np.abs(answer - ours)[..., ::2].max())
    answer[..., 1::2] = ours[..., 1::2]
    figure = heading_maps(answer, part, label="f of steps")
    figure.suptitle(
        f"f of steps over the slopes, by convolution: off by {worst:.0e} at most\n(along the "
        "axes; the diagonals are the library's)",
        **TITLE,
        x=0.01,
    )
    return figure


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
    """Draw F_max and the route over the corridor."""
    best, _ = fused(own)
    route = planned(own)
    figure = Picture(7.4, 4.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    elevation = corridor().elevation
    x0, y0, x1, y1 = elevation.extent
    image = upper.imshow(
        best.max(axis=-1).T, origin="lower", extent=(x0, x1, y0, y1), vmin=0, vmax=1, aspect="auto"
    )
    figure.colorbar(image, ax=upper, label="F_max")
    upper.set_title("F_max along the best heading of each cell", **TITLE, loc="left")
    draw_elevation(elevation, axes=lower, bare=True)
    draw_route(route, elevation, axes=lower)
    cost = own.run(
        "route_cost",
        lambda: route.cost / elevation.resolution,  # the exercise counts in cells
        lambda f: float(f(best.copy(), route.cells.copy())),
    )
    lower.set_title(f"The route: {route.length:.1f} m at a cost of {cost:.1f}", **TITLE, loc="left")
    return figure


def draw_crossing(own: Stages) -> Figure:
    """Draw the robot's drive over the route, with every stage of the planner."""
    route = planned(own)
    episode, _ = driven(own, route)
    return draw_drive(episode, route, corridor().elevation)
