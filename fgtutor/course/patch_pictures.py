"""Pictures of patches and of single headings: where a patch lies, what it shows, what F says there.

Reads maps, poses, patches and tensors [nx, ny, d]; gives matplotlib figures, as `figures.maps` does
for whole maps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.image import AxesImage
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import ArrayLike
from torch import Tensor

from fgtutor import patches
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.figures.maps import draw_elevation
from fgtutor.figures.relief import GROUND
from fgtutor.figures.style import F_COLOURS, INK, TITLE, Panels, Picture
from fgtutor.io.validation import check_arguments
from fgtutor.patches import PatchGrid, sample_patches

F_SCALE: dict[str, Any] = {"vmin": 0.0, "vmax": 1.0, "cmap": F_COLOURS}
"""How numbers from 0 to 1 are coloured."""
SMALL = {"fontsize": 8.5, "loc": "left"}
"""Titles of small panels."""


def patch_at(elevation: ElevationMap, pose: ArrayLike, grid: PatchGrid) -> Float[Tensor, " points"]:
    """Return the patch H_xy at a pose (x, y, yaw), cut from the prepared map as training does."""
    ground = patches.prepare(elevation)
    return sample_patches(
        torch.tensor(ground.heights),
        torch.tensor(np.asarray(pose), dtype=torch.float32),
        grid,
        resolution=ground.resolution,
        origin=ground.origin,
    )


def draw_windows(elevation: ElevationMap, poses: ArrayLike, grid: PatchGrid) -> Picture:
    """Draw on the map where the patches at some poses (x, y, yaw) lie, and where each one looks."""
    title = "The windows that patches are cut from"
    caption = "Outline: the window of a patch. Its arrow points ahead"
    figure = draw_elevation(elevation, title=title, caption=caption)
    for pose in np.atleast_2d(np.asarray(poses, dtype=float)):
        _window(figure.axes[0], pose, grid)
    return figure  # pyright: ignore[reportReturnType]


def patch_gallery(
    shown: Sequence[ArrayLike],
    grid: PatchGrid,
    captions: Sequence[str],
    *,
    columns: Panels = 4,
    title: str = "",
    unit: str = "height (m)",
) -> Picture:
    """Draw patches side by side, all in one scale of colours; the robot looks to the right.

    Anything with one number per point may be shown so, such as the weights of a first layer.
    """
    check_arguments(patch_gallery, locals(), ConfigError)
    rows = -(-len(shown) // columns)
    x, y = _span(grid)
    figure = Picture(7.2, 0.45 + rows * (0.35 + 6.2 / columns * (y[1] - y[0]) / (x[1] - x[0])))
    panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
    reach = max(0.1, *(float(np.abs(np.asarray(values)).max()) for values in shown))
    image = None
    for axes, values, caption in zip(panels, shown, captions, strict=False):
        image = _patch(axes, values, grid, reach)
        axes.set_title(caption, fontsize=8.5, loc="left")
    for axes in panels[len(shown) :]:
        axes.remove()
    if image is not None:
        figure.colorbar(image, ax=figure.axes, shrink=0.8, pad=0.01, label=unit)
    figure.suptitle(title, **TITLE, x=0.01)
    return figure


def patch_rose(elevation: ElevationMap, x: float, y: float, grid: PatchGrid) -> Picture:
    """Draw the patches of one place along eight headings, around the map's window at that place.

    Every patch is turned so that the robot looks to the right: this is what a network is shown.
    """
    figure = Picture(7.6, 6.2)
    headings = Headings(8)
    poses = np.column_stack((np.tile((x, y), (headings.count, 1)), headings.yaws))
    shown = patch_at(elevation, poses, grid).numpy()
    reach = max(0.1, float(np.abs(shown).max()))
    around = 1.1 * patches.reach(grid)
    panels = figure.subplots(3, 3)
    _compass(
        panels,
        lambda axes, heading: _patch(axes, shown[heading], grid, reach),
        elevation.crop(x - around, y - around, x + around, y + around),
        headings,
        label="height (m)",
    )
    panels[1, 1].set(xticks=(), yticks=())
    panels[1, 1].set_title("the place on the map", **SMALL)
    for pose in poses:
        _window(panels[1, 1], pose, grid, colour="#00000055")
    figure.suptitle("One place, eight headings, eight patches", **TITLE, x=0.01)
    return figure


def heading_maps(tensor: ArrayLike, grid: ElevationMap, *, label: str = "F") -> Picture:
    """Draw the channels of a tensor [nx, ny, d], each at the side that its heading points to.

    In the middle lies the map.
    """
    values = np.asarray(tensor)
    headings = Headings.of(values)
    width, height = grid.size
    figure = Picture(7.6, float(np.clip(7.0 * height / width, 2.0, 7.0)) + 0.8)
    x0, y0, x1, y1 = grid.extent
    _compass(
        figure.subplots(*[headings.count // 4 + 1] * 2, sharex=True, sharey=True),
        # An image is [row = y, column = x]: transpose, with its first row at the bottom.
        lambda axes, heading: axes.imshow(
            values[..., heading].T, origin="lower", extent=(x0, x1, y0, y1), **F_SCALE
        ),
        grid,
        headings,
        label=label,
    )
    figure.suptitle(f"{label}: one map per heading", **TITLE, x=0.01)
    return figure


def feasibility_maps(
    tensors: Mapping[str, ArrayLike], grid: ElevationMap, *, label: str = "F, mean of the headings"
) -> Picture:
    """Draw tensors [nx, ny, d] of one map side by side, each as its mean over the headings."""
    width, height = 6.6 / max(len(tensors), 1), grid.size[1] / grid.size[0]
    figure = Picture(7.6, float(np.clip(width * height, 1.2, 7.0)) + 0.9)
    panels = figure.subplots(1, len(tensors), sharex=True, sharey=True, squeeze=False)[0]
    x0, y0, x1, y1 = grid.extent
    image = None
    for axes, (name, tensor) in zip(panels, tensors.items(), strict=True):
        mean = np.asarray(tensor).mean(axis=-1)
        # An image is [row = y, column = x]: transpose, with its first row at the bottom.
        image = axes.imshow(mean.T, origin="lower", extent=(x0, x1, y0, y1), **F_SCALE)
        axes.set_title(name, **TITLE, loc="left")
        axes.set_xlabel("x (m)", fontsize=9)
        axes.tick_params(labelsize=8)
    panels[0].set_ylabel("y (m)", fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=list(panels), shrink=0.9, pad=0.01, label=label)
    return figure


def _compass(
    panels: np.ndarray,
    draw: Callable[[Axes, int], AxesImage],
    middle: ElevationMap,
    headings: Headings,
    *,
    label: str,
) -> None:
    """Draw something for each heading at the side that it points to, and a map in the middle."""
    image = None
    # d headings surround a square: 8 one of 1 x 1 panels, 16 one of 3 x 3, 32 one of 7 x 7. The
    # first stands at the middle of its right side, the next ones above it.
    far, d = headings.count // 8, headings.count
    apart = np.abs((np.arange(d) + d // 2) % d - d // 2)
    across = np.clip(2 * far - apart, -far, far)
    up = np.roll(across, d // 4)
    around: list[Axes] = panels[far - up, far + across].tolist()  # rows count down, columns up
    for heading, axes in enumerate(around):
        image = draw(axes, heading)
        axes.set_title(f"heading {heading}: {headings.names[heading]}", **SMALL)
    inside: Axes = panels[far, far]
    for axes in {*panels.flat} - {inside, *around}:
        axes.remove()
    inside.set_subplotspec(panels[0, 0].get_gridspec()[1:-1, 1:-1])
    figure = draw_elevation(middle, axes=inside, bare=True)
    inside.set_title("the map", **SMALL)
    if image is not None:
        figure.colorbar(image, ax=figure.axes, shrink=0.6, pad=0.01, label=label)


def _span(grid: PatchGrid) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the area that a patch's points stand for, in the robot's yaw frame, m."""
    half = grid.spacing / 2
    (x0, y0), (x1, y1) = grid.points.amin(0).tolist(), grid.points.amax(0).tolist()
    return (x0 - half, x1 + half), (y0 - half, y1 + half)


def _patch(axes: Axes, values: ArrayLike, grid: PatchGrid, reach: float) -> AxesImage:
    """Show one number per point, with the robot's footprint and where it looks."""
    (x0, x1), (y0, y1) = _span(grid)
    # Points are [x, y]; an image is [row = y, column = x]: transpose, first row at the bottom.
    image = axes.imshow(
        np.asarray(values).reshape(grid.shape).T,
        cmap=GROUND,
        norm=Normalize(-reach, reach),
        origin="lower",
        extent=(x0, x1, y0, y1),
    )
    length, width = grid.footprint
    axes.add_patch(
        Rectangle((-length, -width), 2 * length, 2 * width, fill=False, edgecolor=INK, linewidth=1)
    )
    axes.plot((0, length), (0, 0), color=INK, linewidth=1)
    axes.set(xticks=(), yticks=())
    return image


def _window(axes: Axes, pose: ArrayLike, grid: PatchGrid, colour: str = "#D55E00") -> None:
    """Outline on a map the area of a patch, and point ahead."""
    x, y, yaw = np.asarray(pose, dtype=float)
    (x0, x1), (y0, y1) = _span(grid)
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = np.array(((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    outline = corners @ np.array(((cos, sin), (-sin, cos))) + (x, y)
    axes.add_patch(Polygon(outline, fill=False, edgecolor=colour, linewidth=1.5))
    axes.annotate(
        "",
        (x + 0.8 * x1 * cos, y + 0.8 * x1 * sin),
        (x, y),
        arrowprops={"arrowstyle": "->", "color": colour},
    )
