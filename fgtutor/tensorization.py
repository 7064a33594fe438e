"""From elevation map to feasibility tensor: a window slides over the map, once per heading.

Reads an `ElevationMap` M and a specialist (its Feasibility-Net, patch grid and planning command);
gives f, L_recon and F_i = w_ood * f, all [nx, ny, d].
Source: paper, Sec. III-B (Eqs. 4-5). Steps over cells between their ends, and so more than 8
headings, are ours: F_i of such a step is that of the least feasible cell that it leaves.

Two ways lead to the same numbers. The *reference* cuts every patch with `sample_patches`, as
training does. The *fast* way turns the loop inside out: seen from all cells at once, one point of
the patch is the whole map, shifted. So the network's first layer, a weighted sum of patch points,
is a weighted sum of shifted maps: a convolution of M. It is evaluated as one matrix product per
strip of the map, with a shifted strip as each row, so that memory stays flat. A convolution routine
was no faster along the axes and slower along the diagonals, where the turned kernel has two to
eight times more taps (at cells of 0.1 and 0.05 m) than the patch has points. Equal patches are
assessed once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fgtutor import patches
from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, ThresholdError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW, calibrated_taus, ood_weight
from fgtutor.grid import point_text
from fgtutor.io.machine import require_memory
from fgtutor.io.progress import watch
from fgtutor.settings import HEADINGS, Taus, Unknown

if TYPE_CHECKING:
    from fgtutor.specialist import Specialist

Method = Literal["auto", "reference", "fast"]

STRIP_CELLS = 2048
"""Cells assessed at a time: 187 points of each are 1.5 MB. The speed hardly depends on it."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What one specialist says about every cell and heading of a map."""

    f: Float[Tensor, "nx ny d"]
    """Feasibility f, the predicted r_v in [0, 1]."""
    reconstruction: Float[Tensor, "nx ny d"]
    """L_recon, summed over the patch in the units the VAE sees (metres times `height_scale`)."""
    elevation: ElevationMap
    """The map that was assessed."""
    taus: tuple[float, float] = (TAU_LOW, TAU_HIGH)
    """Thresholds of w_ood: the specialist's own, unless others were asked for."""
    specialist: Specialist | None = None
    """Whose assessment it is; None for numbers made by hand."""

    @property
    def headings(self) -> Headings:
        """What the last axis counts."""
        return Headings.of(self.f)

    def ood(self, tau_low: float | None = None, tau_high: float | None = None) -> Tensor:
        """Return w_ood (Eq. 4), [nx, ny, d], by `taus` unless thresholds are given."""
        low, high = self.taus
        low, high = low if tau_low is None else tau_low, high if tau_high is None else tau_high
        return ood_weight(self.reconstruction, low, high)

    def weighted(
        self,
        tau_low: float | None = None,
        tau_high: float | None = None,
        *,
        unknown: Unknown = "block",
    ) -> Float[Tensor, "nx ny d"]:
        """Return F_i = w_ood * f (Eq. 5), by `taus` unless thresholds are given.

        Of a step over several cells it is the least of theirs. It is 0 where a step would start
        from, pass through or end on an unknown cell, or leave the map; `unknown="fill"` trusts the
        filled heights instead.
        """
        return self.weigh(tau_low, tau_high, unknown=unknown)[1]

    def weigh(
        self,
        tau_low: float | None = None,
        tau_high: float | None = None,
        *,
        unknown: Unknown = "block",
    ) -> tuple[Float[Tensor, "nx ny d"], Float[Tensor, "nx ny d"]]:
        """Return w_ood and F_i, as `ood` and `weighted` do, computing w_ood once."""
        w_ood = self.ood(tau_low, tau_high)
        weighted = w_ood * self.f
        return w_ood, self.closed(weighted) if unknown == "block" else self._least(weighted)

    def closed(self, values: Float[Tensor, "nx ny d"]) -> Float[Tensor, "nx ny d"]:
        """Return what holds for whole steps, if `values` hold for leaving cells.

        It is the least value of the cells that a step leaves, and 0 for steps from, over or to an
        unknown cell or off the map.
        """
        within = self.headings.steps_within(self.elevation.known)
        return self._least(values) * torch.from_numpy(within)

    def _least(self, values: Float[Tensor, "nx ny d"]) -> Float[Tensor, "nx ny d"]:
        return torch.from_numpy(self.headings.least(values.numpy()))


def tensorize(
    elevation: ElevationMap,
    specialist: Specialist,
    *,
    taus: Taus = "calibrated",
    headings: HeadingCount = HEADINGS,
    method: Method = "auto",
    unknown: Unknown = "block",
    progress: bool = False,
) -> Float[Tensor, "nx ny d"]:
    """Return F_i(x, y, k) = w_ood * f: how well this specialist leaves a cell along heading k.

    `headings` is their number: 8, 16 or 32. `taus` is "calibrated" (the specialist's own), "paper"
    or a pair (low, high), `unknown` as in `Assessment.weighted`, `progress` shows a bar if it takes
    long.

    Raises:
        ThresholdError, ConfigError: A setting has a value without meaning.
        TooLargeError: The tensors do not fit into memory.
    """
    if unknown not in get_args(Unknown):
        raise ConfigError(f"unknown must be one of {', '.join(get_args(Unknown))}, got {unknown!r}")
    options = {"taus": taus, "headings": headings, "progress": progress}
    assessment = assess(elevation, specialist, method, **options)
    return assessment.weighted(unknown=unknown)


def assess(
    elevation: ElevationMap,
    specialist: Specialist,
    method: Method = "auto",
    *,
    taus: Taus = "calibrated",
    headings: HeadingCount = HEADINGS,
    progress: bool = False,
) -> Assessment:
    """Return f and L_recon of every cell and heading; unknown cells are read as filled.

    Give the map as it was loaded: it is prepared for patches here. "auto" is the fast way, which
    won on every map measured. Raises what `tensorize` raises.
    """
    team = {specialist.name: specialist}
    said = assess_all(elevation, team, method, taus=taus, headings=headings, progress=progress)
    return said[specialist.name]


@torch.no_grad()
def assess_all(
    elevation: ElevationMap,
    zoo: Mapping[str, Specialist],
    method: Method = "auto",
    *,
    taus: Taus = "calibrated",
    headings: HeadingCount = HEADINGS,
    progress: bool = False,
) -> dict[str, Assessment]:
    """Return what each policy of `zoo` says; those with the same patch grid share its patches.

    The numbers are those of `assess`, in less time. Raises what `tensorize` raises.
    """
    if method not in _WAYS:
        raise ConfigError(f"method must be one of {', '.join(_WAYS)}, got {method!r}")
    thresholds = {name: resolve_taus(taus, specialist) for name, specialist in zoo.items()}
    (nx, ny), yaws = elevation.shape, Headings(headings).yaws
    work = f"assessing {nx} x {ny} cells for {len(zoo)} polic{'y' if len(zoo) == 1 else 'ies'}"
    # f and L_recon in 4 bytes each, and one F_i.
    needed = 4.0 * nx * ny * len(yaws) * (2 * len(zoo) + 1)
    require_memory(needed, work, "take a part of the map (ElevationMap.crop) or coarser cells")
    heights = patches.prepare(elevation).heights
    blank = torch.empty(nx, ny, len(yaws))
    assessments = {
        name: Assessment(blank.clone(), blank.clone(), elevation, thresholds[name], specialist)
        for name, specialist in zoo.items()
    }
    grids = {specialist.grid for specialist in zoo.values()}
    tiles = (
        (grid, heading, rows, patch)
        for grid in grids
        for heading, yaw in enumerate(yaws)
        for rows, patch in _WAYS[method](heights, yaw, grid, elevation.resolution)
    )
    total = len(grids) * len(yaws) * len(list(_strips(heights.shape)))
    for grid, heading, rows, patch in watch(tiles, total, work, show=progress, unit="tile"):
        distinct, cells = _distinct(patch)
        for name, specialist in zoo.items():
            if specialist.grid != grid:
                continue
            net, one = specialist.feasibility, assessments[name]
            command = torch.tensor(specialist.command, dtype=torch.float32)
            f = net.feasibility(distinct, command.expand(len(distinct), -1))
            one.f[rows, :, heading] = f[cells].reshape(-1, ny)
            loss = net.reconstruction(distinct)
            one.reconstruction[rows, :, heading] = loss[cells].reshape(-1, ny)
    return assessments


def resolve_taus(taus: Taus, specialist: Specialist) -> tuple[float, float]:
    """Return (tau_low, tau_high) for a choice by name, or the given pair.

    Raises `ThresholdError` for another name, and unless 0 <= tau_low < tau_high, both finite.
    """
    if taus == "paper":
        return TAU_LOW, TAU_HIGH
    if taus == "calibrated":
        return calibrated_taus(specialist.quantiles)
    try:
        low, high = (float(tau) for tau in taus)
    except (TypeError, ValueError):
        low = high = math.nan
    if isinstance(taus, str) or not 0 <= low < high < math.inf:
        raise ThresholdError(
            'taus must be "paper", "calibrated" or finite numbers 0 <= tau_low < tau_high, got '
            f"{taus!r}"
        )
    return low, high


def why_blocked(
    x: float, y: float, assessments: Mapping[str, Assessment], *, f_min: float = 0.1
) -> str:
    """Say which layer closes the cell at (x, y), m: the map, unknown cells, f or w_ood.

    `assessments` holds what each policy says of one map (`assess_all`). A cell is closed when no
    policy can leave it with F >= f_min. Raises `ConfigError` if there is no assessment.
    """
    if not assessments:
        raise ConfigError("without an assessment nothing is known of the map: give assess_all's")
    first = next(iter(assessments.values()))
    elevation, headings = first.elevation, first.headings
    place = f"{point_text((x, y), elevation.resolution)} m"
    if not elevation.contains(x, y):
        return f"{place} is off the map."
    cell = elevation.cell_of(x, y)
    where = f"Cell {cell} at {place}"
    if not elevation.known[cell]:
        return f"{where} is closed: it was never observed."
    open_headings = np.flatnonzero(headings.steps_within(elevation.known)[cell])
    if not len(open_headings):
        return f"{where} is closed: all its neighbours are unknown or off the map."
    reasons = []
    for name, assessment in assessments.items():
        # Of whole steps: what f or w_ood is worst at on the way closes the cell as well.
        whole = assessment.closed(assessment.f), assessment.closed(assessment.ood())
        F, f, w_ood = (values[cell][open_headings] for values in (assessment.weighted(), *whole))
        best = int(F.argmax())
        towards = headings.names[open_headings[best]]
        if F[best] >= f_min:
            return f"{where} is open: {name} leaves it towards {towards} with F = {F[best]:.2f}."
        if f.max() < f_min:
            reasons.append(f"{name} would not keep its velocity (f <= {f.max():.2f})")
        else:
            reasons.append(
                f"{name} does not know such terrain (f reaches {f.max():.2f}, "
                f"but w_ood only {w_ood.max():.2f})"
            )
    return f"{where} is closed at f_min = {f_min:g}: {'; '.join(reasons)}."


def _strips(shape: tuple[int, int]) -> Iterator[slice]:
    """Cut the map's rows into strips of about `STRIP_CELLS` cells."""
    rows = max(1, STRIP_CELLS // shape[1])
    for start in range(0, shape[0], rows):
        yield slice(start, min(start + rows, shape[0]))


def _sampled(
    heights: Float[np.ndarray, "nx ny"], yaw: float, grid: patches.PatchGrid, resolution: float
) -> Iterator[tuple[slice, Float[Tensor, "cells points"]]]:
    """Reference: cut the patch of every cell by itself."""
    # Positions in float64: in float32, metres ten from the origin round off 1e-5 of a cell.
    surface = torch.tensor(heights, dtype=torch.float64)
    y = (torch.arange(heights.shape[1], dtype=torch.float64) + 0.5) * resolution
    for rows in _strips(heights.shape):
        x = (torch.arange(rows.start, rows.stop, dtype=torch.float64) + 0.5) * resolution
        poses = torch.cartesian_prod(x, y, torch.tensor([yaw], dtype=torch.float64))
        patch = patches.sample_patches(surface, poses, grid, resolution=resolution)
        yield rows, patch.float()


def _shifted(
    heights: Float[np.ndarray, "nx ny"], yaw: float, grid: patches.PatchGrid, resolution: float
) -> Iterator[tuple[slice, Float[Tensor, "cells points"]]]:
    """Fast: one point of the patch, for all cells, is the map shifted by that point's offset."""
    ny = heights.shape[1]
    offsets = patches.rotate(grid.points.double(), torch.tensor(yaw)) / resolution
    whole = offsets.floor().long()
    a, b = (offsets - whole).float().T[..., None, None]
    margin = int(whole.abs().max()) + 1
    i, j = (whole + margin).T
    surface = torch.from_numpy(np.pad(heights, margin, mode="edge"))
    for rows in _strips(heights.shape):
        strip = surface[rows.start : rows.stop + 2 * margin]
        # Only height differences matter; small numbers keep float32 sharp on high ground.
        strip = strip - strip.mean()
        # A view, not a copy: shifted[i, j] is the strip moved by (i - margin, j - margin) cells.
        shifted = strip.unfold(0, rows.stop - rows.start, 1).unfold(1, ny, 1)
        # The bilinear rule of `sample_heights`: a shift by part of a cell blends its neighbours.
        near = torch.lerp(shifted[i, j], shifted[i, j + 1], b)
        far = torch.lerp(shifted[i + 1, j], shifted[i + 1, j + 1], b)
        patch = torch.lerp(near, far, a).flatten(1).T
        yield rows, patch - patches.ground_height(patch, grid)


def _distinct(
    patch: Float[Tensor, "cells points"],
) -> tuple[Float[Tensor, "distinct points"], Int[Tensor, " cells"]]:
    """Return each distinct patch once, and which of them every cell has.

    Ground that was built repeats itself: of 2000 cells beside a step, 30 look different.
    """
    rows = np.ascontiguousarray(patch.numpy())
    whole = rows.view(f"V{rows.strides[0]}").ravel()  # a row is compared as one run of bytes
    _, first, cells = np.unique(whole, return_index=True, return_inverse=True)
    return torch.from_numpy(rows[first]), torch.from_numpy(cells)


_WAYS = {"auto": _shifted, "reference": _sampled, "fast": _shifted}
