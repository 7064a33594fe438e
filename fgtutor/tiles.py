"""The patches of a whole map, cut tile by tile: what `tensorization` asks the networks about.

Reads the heights of a prepared map, a heading and a patch grid; gives a tile of cells at a time,
and the patch of each. Source: paper, Sec. III-B (a window slides over the map).

Two ways lead to the same numbers. The *reference* cuts every patch with `sample_patches`, as
training does. The *fast* way turns the loop inside out: seen from all cells at once, one point of
the patch is the whole map, shifted. So the network's first layer, a weighted sum of patch points,
is a weighted sum of shifted maps: a convolution of M. It is evaluated as one matrix product per
tile of the map, with a shifted tile as each row, so that memory stays flat. A convolution routine
was no faster along the axes and slower along the diagonals, where the turned kernel has two to
eight times more taps (at cells of 0.1 and 0.05 m) than the patch has points. Equal patches of a
tile are assessed once.
"""

from collections.abc import Iterable, Iterator
from itertools import product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from fgtutor import patches
from fgtutor.directions import Headings

Method = Literal["auto", "reference", "fast"]
Tile = tuple[slice, slice]

TILE = 24
"""Side of a tile in cells. Larger ones see more of a change, smaller ones repeat more of what equal
patches could share: on ground that was built a quarter more time is spent at 24 than at 45, on
ground where no two patches are alike none. With 24 a dot painted on 400 x 400 cells of 0.05 or
0.1 m makes at most a thirtieth of them be assessed anew."""


def tiles_of(shape: tuple[int, int]) -> list[Tile]:
    """Cut a map into squares of `TILE` cells, from its corner; at the far borders less is left."""
    rows, columns = ([slice(at, min(at + TILE, n)) for at in range(0, n, TILE)] for n in shape)
    return list(product(rows, columns))


def cells_seeing(
    changed: Bool[np.ndarray, "nx ny"],
    grid: patches.PatchGrid,
    headings: Headings,
    resolution: float,
) -> Bool[np.ndarray, "nx ny"]:
    """Return the cells whose patches, along some heading, see a changed cell of a prepared map."""
    margin = max(_offsets(grid, yaw, resolution)[2] for yaw in headings.yaws)
    return ndimage.maximum_filter(changed, 2 * margin + 1, mode="constant")


def _sampled(
    heights: Float[np.ndarray, "nx ny"],
    yaw: float,
    grid: patches.PatchGrid,
    resolution: float,
    tiles: Iterable[Tile],
) -> Iterator[tuple[Tile, Float[Tensor, "cells points"]]]:
    """Reference: cut the patch of every cell by itself."""
    # Positions in float64: in float32, metres ten from the origin round off 1e-5 of a cell.
    surface = torch.tensor(heights, dtype=torch.float64)
    x, y = ((torch.arange(n, dtype=torch.float64) + 0.5) * resolution for n in heights.shape)
    for rows, columns in tiles:
        heading = torch.tensor([yaw], dtype=torch.float64)
        poses = torch.cartesian_prod(x[rows], y[columns], heading)
        patch = patches.sample_patches(surface, poses, grid, resolution=resolution)
        yield (rows, columns), patch.float()


def _shifted(
    heights: Float[np.ndarray, "nx ny"],
    yaw: float,
    grid: patches.PatchGrid,
    resolution: float,
    tiles: Iterable[Tile],
) -> Iterator[tuple[Tile, Float[Tensor, "cells points"]]]:
    """Fast: one point of the patch, for all cells, is the map shifted by that point's offset."""
    whole, part, margin = _offsets(grid, yaw, resolution)
    a, b = part.float().T[..., None, None]
    i, j = (whole + margin).T
    surface = torch.from_numpy(np.pad(heights, margin, mode="edge"))
    for rows, columns in tiles:
        nx, ny = (at.stop - at.start for at in (rows, columns))
        seen = surface[rows.start :, columns.start :][: nx + 2 * margin, : ny + 2 * margin]
        # Only height differences matter; small numbers keep float32 sharp on high ground.
        seen = seen - seen.mean()
        # A view, not a copy: shifted[i, j] is the tile moved by (i - margin, j - margin) cells.
        shifted = seen.unfold(0, nx, 1).unfold(1, ny, 1)
        # The bilinear rule of `sample_heights`: a shift by part of a cell blends its neighbours.
        near = torch.lerp(shifted[i, j], shifted[i, j + 1], b)
        far = torch.lerp(shifted[i + 1, j], shifted[i + 1, j + 1], b)
        patch = torch.lerp(near, far, a).flatten(1).T
        yield (rows, columns), patch - patches.ground_height(patch, grid)


def _offsets(
    grid: patches.PatchGrid, yaw: float, resolution: float
) -> tuple[Int[Tensor, "points 2"], Float[Tensor, "points 2"], int]:
    """Return where points lie from their cell, in whole cells and parts, and how far they see."""
    offsets = patches.rotate(grid.points.double(), torch.tensor(yaw)) / resolution
    whole = offsets.floor().long()
    return whole, offsets - whole, int(whole.abs().max()) + 1


def distinct_patches(
    patch: Float[Tensor, "cells points"],
) -> tuple[Float[Tensor, "distinct points"], Int[Tensor, " cells"]]:
    """Return each distinct patch once, and which of them every cell has.

    Ground that was built repeats itself: beside a step, cells in a row look alike.
    """
    rows = np.ascontiguousarray(patch.numpy())
    whole = rows.view(f"V{rows.strides[0]}").ravel()  # a row is compared as one run of bytes
    _, first, cells = np.unique(whole, return_index=True, return_inverse=True)
    return torch.from_numpy(rows[first]), torch.from_numpy(cells)


WAYS = {"auto": _shifted, "reference": _sampled, "fast": _shifted}
