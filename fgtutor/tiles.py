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

from collections.abc import Iterable, Iterator, Sequence
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
    yaws: Sequence[float],
    grid: patches.PatchGrid,
    resolution: float,
    tiles: Iterable[Tile],
) -> Iterator[tuple[Tile, Float[Tensor, "d cells points"]]]:
    """Reference: cut the patch of every cell and heading by itself."""
    # Positions in float64: in float32, metres ten from the origin round off 1e-5 of a cell.
    surface = torch.tensor(heights, dtype=torch.float64)
    x, y = ((torch.arange(n, dtype=torch.float64) + 0.5) * resolution for n in heights.shape)
    for rows, columns in tiles:
        poses = torch.cartesian_prod(torch.tensor(yaws, dtype=torch.float64), x[rows], y[columns])
        patch = patches.sample_patches(surface, poses.roll(-1, 1), grid, resolution=resolution)
        yield (rows, columns), patch.float().unflatten(0, (len(yaws), -1))


def _shifted(
    heights: Float[np.ndarray, "nx ny"],
    yaws: Sequence[float],
    grid: patches.PatchGrid,
    resolution: float,
    tiles: Iterable[Tile],
) -> Iterator[tuple[Tile, Float[Tensor, "d cells points"]]]:
    """Fast: one point of the patch, for all cells, is the map shifted by that point's offset."""
    offsets = [_offsets(grid, yaw, resolution) for yaw in yaws]
    margin = max(reach for *_, reach in offsets)
    # A patch that reaches as far back as ahead has, turned round, the same points in reverse.
    reversible = grid.ahead == grid.behind
    if reversible:
        offsets = offsets[: len(yaws) // 2]
    surface = torch.from_numpy(np.pad(heights, margin, mode="edge"))
    for rows, columns in tiles:
        nx, ny = (at.stop - at.start for at in (rows, columns))
        seen = surface[rows.start :, columns.start :][: nx + 2 * margin, : ny + 2 * margin]
        # Only height differences matter; small numbers keep float32 sharp on high ground.
        seen = seen - seen.mean()
        # A view, not a copy: shifted[i, j] is the tile moved by (i - margin, j - margin) cells.
        shifted = seen.unfold(0, nx, 1).unfold(1, ny, 1)
        patch = torch.stack([_blended(shifted, margin, *one[:2]) for one in offsets])
        patch -= patches.ground_height(patch, grid)
        yield (rows, columns), torch.cat((patch, patch.flip(-1))) if reversible else patch


def _blended(
    shifted: Float[Tensor, "i j nx ny"],
    margin: int,
    whole: Int[Tensor, "points 2"],
    part: Float[Tensor, "points 2"],
) -> Float[Tensor, "cells points"]:
    """Return every point of the patch for all cells of a tile, by the rule of `sample_heights`.

    A shift by part of a cell blends its neighbours.
    """
    i, j = (whole + margin).T
    patch = shifted[i, j]
    if part.any():
        a, b = part.float().T[..., None, None]
        near = torch.lerp(patch, shifted[i, j + 1], b)
        far = torch.lerp(shifted[i + 1, j], shifted[i + 1, j + 1], b)
        patch = torch.lerp(near, far, a)
    return patch.flatten(1).T


def _offsets(
    grid: patches.PatchGrid, yaw: float, resolution: float
) -> tuple[Int[Tensor, "points 2"], Float[Tensor, "points 2"], int]:
    """Return where points lie from their cell, in whole cells and parts, and how far they see."""
    offsets = patches.rotate(grid.points.double(), torch.tensor(yaw)) / resolution
    # The cosine of a right angle is 6e-17: such a point lies on a cell's centre, not beside it.
    offsets = torch.where((offsets - offsets.round()).abs() < 1e-9, offsets.round(), offsets)
    whole = offsets.floor().long()
    return whole, offsets - whole, int(whole.abs().max()) + 1


def distinct_patches(
    patch: Float[Tensor, "n points"],
) -> tuple[Float[Tensor, "distinct points"], Int[Tensor, " n"]]:
    """Return each distinct patch once, and which of them every given one is.

    Ground that was built repeats itself: beside a step, cells in a row look alike, and flat ground
    looks alike along every heading.
    """
    rows = patch.numpy()
    bits = rows.view(np.uint32)
    # Patches are told apart by a number each; equal numbers are then compared point by point.
    factors = np.random.default_rng(0).integers(2**64, size=bits.shape[1], dtype=np.uint64)
    _, first, which = np.unique(bits @ factors, return_index=True, return_inverse=True)
    if len(first) == len(rows):
        return patch, torch.arange(len(rows))
    if not np.array_equal(bits[first][which], bits):
        _, first, which = np.unique(bits, axis=0, return_index=True, return_inverse=True)
    return patch[first], torch.from_numpy(which)


WAYS = {"auto": _shifted, "reference": _sampled, "fast": _shifted}
