"""From elevation map to feasibility tensor: a window slides over the map, once per heading.

Reads an `ElevationMap` M and a specialist (its Feasibility-Net, patch grid and planning command);
gives f, L_recon and F_i = w_ood * f, all [nx, ny, d].
Source: paper, Sec. III-B (Eqs. 4-5). Steps over cells between their ends, and so more than 8
headings, are ours: F_i of such a step is that of the least feasible cell that it leaves.

What is said of a tile of the map (`tiles`) depends, to the last bit, on nothing but the heights
that its patches see. So a changed map costs only the tiles that see the change (`reassess`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fgtutor import patches
from fgtutor.directions import HeadingCount, Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, ThresholdError
from fgtutor.feasibility import TAU_HIGH, TAU_LOW, FoldedNet, OodScore, ood_weight
from fgtutor.grid import point_text
from fgtutor.io.machine import require_memory
from fgtutor.io.progress import watch
from fgtutor.settings import HEADINGS, Taus, Unknown
from fgtutor.tiles import WAYS, Method, Tile, cells_seeing, distinct_patches, tiles_of

if TYPE_CHECKING:
    from fgtutor.specialist import Specialist


CACHED = 1024
"""Patches that the networks are asked about at once: as many as stay in a core's cache."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What one specialist says about every cell and heading of a map."""

    f: Float[Tensor, "nx ny d"]
    """Feasibility f, the predicted r_v in [0, 1]."""
    reconstruction: Float[Tensor, "nx ny d"]
    """L_recon, summed over the patch in the units the VAE sees (metres times `height_scale`)."""
    elevation: ElevationMap
    """The map that was assessed."""
    score: OodScore = field(default_factory=OodScore)
    """What w_ood follows from: the specialist's own calibration, or thresholds on L_recon."""
    specialist: Specialist | None = None
    """Whose assessment it is; None for numbers made by hand."""
    strangeness: Float[Tensor, "nx ny d"] | None = None
    """L_recon as a share of the patch's relief (`FeasibilityNet.losses`), which calibrated weights
    need; None for numbers made by hand."""

    @property
    def headings(self) -> Headings:
        """What the last axis counts."""
        return Headings.of(self.f)

    @property
    def said(self) -> dict[str, Tensor]:
        """The numbers of every cell and heading, by the name of their field."""
        each = {name: getattr(self, name) for name in ("f", "reconstruction", "strangeness")}
        return {name: values for name, values in each.items() if values is not None}

    def ood(self, tau_low: float | None = None, tau_high: float | None = None) -> Tensor:
        """Return w_ood, [nx, ny, d]: by `score`, or by thresholds on L_recon if given (Eq. 4)."""
        if tau_low is None and tau_high is None:
            return self.score.weight(self.reconstruction, self.strangeness)
        low, high = self.score.taus or (TAU_LOW, TAU_HIGH)
        low, high = low if tau_low is None else tau_low, high if tau_high is None else tau_high
        return ood_weight(self.reconstruction, low, high)

    def weighted(
        self,
        tau_low: float | None = None,
        tau_high: float | None = None,
        *,
        unknown: Unknown = "block",
    ) -> Float[Tensor, "nx ny d"]:
        """Return F_i = w_ood * f (Eq. 5), by `score` unless thresholds are given.

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

    def around(self, cell: tuple[int, int]) -> tuple[Assessment, tuple[int, int]]:
        """Return the part that steps from a known cell lead over, and the place of the cell in it.

        What is weighed there of the cell is what would be weighed on the whole map.
        """
        farthest = int(self.headings.moves.max())
        first = ix, iy = max(cell[0] - farthest, 0), max(cell[1] - farthest, 0)
        at = slice(ix, cell[0] + farthest + 1), slice(iy, cell[1] + farthest + 1)
        x, y = (
            corner + n * self.elevation.resolution
            for corner, n in zip(self.elevation.origin, first, strict=True)
        )
        known, heights = self.elevation.known[at], self.elevation.heights[at]
        elevation = replace(self.elevation, heights=heights, known=known, origin=(x, y))
        part = replace(self, elevation=elevation, **{k: v[at] for k, v in self.said.items()})
        return part, (cell[0] - ix, cell[1] - iy)


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

    `headings` is their number: 8, 16, 32 or 48. `taus` is "calibrated" (the specialist's own),
    "paper" or a pair (low, high), `unknown` as in `Assessment.weighted`, `progress` shows a bar if
    it takes long.

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
    if method not in WAYS:
        raise ConfigError(f"method must be one of {', '.join(WAYS)}, got {method!r}")
    scores = {name: ood_score(taus, specialist) for name, specialist in zoo.items()}
    (nx, ny), yaws = elevation.shape, Headings(headings).yaws
    work = f"assessing {nx} x {ny} cells for {len(zoo)} polic{'y' if len(zoo) == 1 else 'ies'}"
    # f, L_recon and the strangeness in 4 bytes each, and one F_i.
    needed = 4.0 * nx * ny * len(yaws) * (3 * len(zoo) + 1)
    require_memory(needed, work, "take a part of the map (ElevationMap.crop) or coarser cells")
    heights = patches.prepare(elevation).heights
    blank = torch.empty(3, nx, ny, len(yaws))
    assessments = {}
    for name, specialist in zoo.items():
        f, loss, strange = blank.clone()
        assessments[name] = Assessment(f, loss, elevation, scores[name], specialist, strange)
    tiles = dict.fromkeys((one.grid for one in zoo.values()), tiles_of(heights.shape))
    _assess_tiles(zoo, heights, tiles, assessments, method, work if progress else None)
    return assessments


@torch.no_grad()
def reassess(
    assessments: Mapping[str, Assessment], elevation: ElevationMap
) -> tuple[dict[str, Assessment], Bool[np.ndarray, "nx ny"]]:
    """Return what `assess_all` says of a map with some heights changed, and which cells see them.

    `assessments` are of the map before the change, by "auto" or "fast". The numbers are those of
    `assess_all`, bit for bit, for the work of the tiles whose patches see a change. Preparing the
    map is not local (an unknown cell takes the nearest known height, from any distance), but cheap:
    the whole map is prepared, and what came out is compared.

    Raises `ConfigError` without an assessment, for one without its specialist, for assessments of
    several maps, and for a map of another shape or resolution.
    """
    zoo = {name: one.specialist for name, one in assessments.items() if one.specialist}
    maps = {id(one.elevation): one.elevation for one in assessments.values()}
    if len(maps) != 1 or len(zoo) < len(assessments):
        raise ConfigError(
            f"reassess needs assessments of one map with their specialists, got {len(assessments)} "
            f"of {len(maps)} maps, {len(zoo)} with a specialist: give what assess_all returned"
        )
    (before,), headings = maps.values(), next(iter(assessments.values())).headings
    if (before.shape, before.resolution) != (elevation.shape, elevation.resolution):
        raise ConfigError(f"{elevation} is not {before} with other heights: assess it as a new map")
    heights = patches.prepare(elevation).heights
    # Compared bit by bit, so that -0 is not 0.
    changed = patches.prepare(before).heights.view(np.int32) != heights.view(np.int32)
    seen = {
        grid: cells_seeing(changed, grid, headings, elevation.resolution)
        for grid in {specialist.grid for specialist in zoo.values()}
    }
    tiles = {
        grid: [tile for tile in tiles_of(elevation.shape) if cells[tile].any()]
        for grid, cells in seen.items()
    }
    renewed = {
        name: replace(one, elevation=elevation, **{k: v.clone() for k, v in one.said.items()})
        for name, one in assessments.items()
    }
    _assess_tiles(zoo, heights, tiles, renewed)
    return renewed, np.logical_or.reduce([*seen.values()])


def _assess_tiles(
    zoo: Mapping[str, Specialist],
    heights: Float[np.ndarray, "nx ny"],
    tiles: Mapping[patches.PatchGrid, Sequence[Tile]],
    assessments: Mapping[str, Assessment],
    method: Method = "auto",
    work: str | None = None,
) -> None:
    """Assess tiles of a prepared map, those of each patch grid, and write them into `assessments`.

    `work` says what a progress bar stands for; None shows none.
    """
    resolution = next((one.elevation.resolution for one in assessments.values()), 1.0)
    yaws = next((one.headings.yaws.tolist() for one in assessments.values()), [])
    cut = (
        (grid, *one)
        for grid, some in tiles.items()
        for one in WAYS[method](heights, yaws, grid, resolution, some)
    )
    nets = {
        name: one.feasibility.folded(torch.tensor(one.command, dtype=torch.float32))
        for name, one in zoo.items()
    }
    total = sum(map(len, tiles.values()))
    shown = watch(cut, total, work or "", show=work is not None, unit="tile")
    for grid, (rows, columns), patch in shown:
        shape = len(yaws), rows.stop - rows.start, columns.stop - columns.start
        distinct, which = distinct_patches(patch.flatten(0, 1))
        team = {name: specialist for name, specialist in zoo.items() if specialist.grid == grid}
        for name, found in _ask(team, nets, distinct).items():
            for values, whole in zip(found, assessments[name].said.values(), strict=True):
                whole[rows, columns] = values[which].reshape(shape).movedim(0, -1)


def _ask(
    team: Mapping[str, Specialist],
    nets: Mapping[str, FoldedNet],
    patch: Float[Tensor, "n points"],
) -> dict[str, Float[Tensor, "3 n"]]:
    """Return f, L_recon and the strangeness of patches, by each specialist's folded net."""
    found = {name: torch.empty(3, len(patch)) for name in team}
    for first in range(0, len(patch), CACHED):
        part = patch[first : first + CACHED]
        reliefs: dict[tuple[float, float | None], tuple[Tensor, Tensor]] = {}
        for name, specialist in team.items():
            net = specialist.feasibility
            units = net.height_scale, net.saturation
            if units not in reliefs:
                heights = net.relief(part)
                reliefs[units] = heights, 1 + heights.square().sum(dim=-1)
            heights, most = reliefs[units]
            f, loss = nets[name].feasibility(part), nets[name].reconstruction(heights)
            found[name][:, first : first + CACHED] = torch.stack((f, loss, loss / most))
    return found


def ood_score(taus: Taus, specialist: Specialist) -> OodScore:
    """Return what w_ood follows from: the specialist's calibration, or thresholds on L_recon.

    Raises `ThresholdError` for a specialist that was never calibrated, for another name, and unless
    0 <= tau_low < tau_high, both finite.
    """
    if taus == "paper":
        return OodScore()
    if taus == "calibrated":
        if not specialist.strangeness:
            raise ThresholdError(
                f"{specialist.name} was never calibrated: run `fgtutor calibrate` on its folder, "
                'or use taus="paper"'
            )
        return OodScore(None, (specialist.quantiles, specialist.strangeness))
    try:
        low, high = (float(tau) for tau in taus)
    except (TypeError, ValueError):
        low = high = math.nan
    if isinstance(taus, str) or not 0 <= low < high < math.inf:
        raise ThresholdError(
            'taus must be "paper", "calibrated" or finite numbers 0 <= tau_low < tau_high, got '
            f"{taus!r}"
        )
    return OodScore((low, high))


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
    parts = {name: assessment.around(cell) for name, assessment in assessments.items()}
    part, at = parts[next(iter(parts))]
    open_headings = np.flatnonzero(headings.steps_within(part.elevation.known)[at])
    if not len(open_headings):
        return f"{where} is closed: all its neighbours are unknown or off the map."
    reasons = []
    for name, (part, at) in parts.items():
        # Of whole steps: what f or w_ood is worst at on the way closes the cell as well.
        F, f, w_ood = (
            values[at][open_headings]
            for values in (part.weighted(), part.closed(part.f), part.closed(part.ood()))
        )
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
