"""A changed map: its assessment is that of the whole, bit for bit, for the work of what changed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fgtutor import tiles
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.feasibility import FoldedNet
from fgtutor.patches import PatchGrid
from fgtutor.tensorization import Assessment, assess, assess_all, reassess

LOPSIDED = PatchGrid(ahead=0.4, behind=0.1, half_width=0.2)


def rough(nx: int, ny: int, rng: np.random.Generator, resolution: float = 0.1) -> ElevationMap:
    """Return noise with a gap, which levelling changes from a distance, and unknown ground."""
    heights = np.round(rng.normal(0, 0.1, (nx, ny)), 2)
    heights[nx // 3] = -1.0
    heights[rng.random((nx, ny)) < 0.1] = np.nan
    heights[nx // 2 :, : ny // 2] = np.nan  # filled from far away
    heights[0, 0] = 0.0
    return ElevationMap(heights, resolution, (3.0, -1.0))


def stroke(elevation: ElevationMap, rng: np.random.Generator) -> ElevationMap:
    """Return the map with a rectangle raised, dug out, forgotten or made known."""
    heights = elevation.heights.copy()
    (ix, iy), (dx, dy) = rng.integers(0, elevation.shape), rng.integers(1, 4, 2)
    heights[ix : ix + dx, iy : iy + dy] = rng.choice([0.0, -0.0, 0.3, -2.0, np.nan])
    return elevation if np.isnan(heights).all() else ElevationMap(heights, elevation.resolution)


# The fixture only makes specialists, so that hypothesis may share it between examples.
@settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    shape=st.tuples(st.integers(2, 24), st.integers(2, 16)),
    headings=st.sampled_from([8, 16, 32, 48]),
    resolution=st.sampled_from([0.1, 0.05]),
    seed=st.integers(0, 10**6),
)
@pytest.mark.slow
def test_strokes_give_what_the_whole_map_would(make_specialist, shape, headings, resolution, seed):
    rng = np.random.default_rng(seed)
    team = {"a": make_specialist("a"), "b": make_specialist("b", seed=1, grid=LOPSIDED)}
    elevation = rough(*shape, rng, resolution)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tiles, "TILE", 8)  # many tiles, and the last ones smaller
        said = assess_all(elevation, team, headings=headings)
        for _ in range(2):
            before, elevation = said, stroke(elevation, rng)
            said, seen = reassess(said, elevation)
            whole = assess_all(elevation, team, headings=headings)
            for name, one in said.items():
                assert one.elevation is elevation
                assert torch.equal(one.f, whole[name].f)
                assert torch.equal(one.reconstruction, whole[name].reconstruction)
                assert torch.equal(one.weighted(), whole[name].weighted())
                # Where no patch sees the stroke, nothing else than rounding can differ.
                blind = torch.from_numpy(~seen)
                torch.testing.assert_close(before[name].f[blind], one.f[blind], atol=1e-4, rtol=0)


def test_filling_reaches_any_distance(make_specialist):
    heights = np.full((60, 30), np.nan)
    heights[0], heights[-1] = 0.0, 0.2
    before = assess_all(ElevationMap(heights), {"a": make_specialist("a")})
    heights[29] = 0.1  # known now: half of what was filled from either end follows
    said, seen = reassess(before, after := ElevationMap(heights))
    assert seen[16:44].all() and not seen[:5].any()
    assert torch.equal(said["a"].f, assess_all(after, {"a": make_specialist("a")})["a"].f)


@pytest.mark.parametrize("resolution", [0.1, 0.05])
@pytest.mark.slow
def test_a_dot_costs_a_thirtieth_of_a_map_of_400_cells(make_specialist, monkeypatch, resolution):
    rng = np.random.default_rng(0)
    heights = rng.normal(0, 0.02, (400, 400))
    specialist = make_specialist(grid=PatchGrid())
    elevation = ElevationMap(heights, resolution)
    # What the map's cells would be told is of no matter here: of a small map, blown up to its size.
    small = assess(elevation.crop(0, 0, 1, 1), specialist)
    numbers = {name: one for name, one in vars(small).items() if isinstance(one, torch.Tensor)}
    blank = {name: torch.zeros(400, 400, 8) for name in numbers}
    before = {"a": replace(small, elevation=elevation, **blank)}
    assessed = []
    plain = FoldedNet.feasibility
    monkeypatch.setattr(
        FoldedNet,
        "feasibility",
        lambda net, patch: (assessed.append(len(patch)), plain(net, patch))[1],
    )
    # In the middle of a tile, on a corner where four meet, and at the map's own corner.
    for cell in ((204, 204), (192, 192), (399, 0)):
        assessed.clear()
        heights = elevation.heights.copy()
        heights[cell] += 0.1
        _, seen = reassess(before, ElevationMap(heights, resolution))
        assert seen[cell]
        assert seen.sum() * 8 <= sum(assessed) <= 400 * 400 * 8 / 30


def test_a_map_that_did_not_change_costs_nothing(make_specialist, monkeypatch):
    elevation = rough(12, 9, np.random.default_rng(0))
    specialist = make_specialist("a")
    before = assess_all(elevation, {"a": specialist})
    monkeypatch.setattr(FoldedNet, "feasibility", None)  # would raise if called
    said, seen = reassess(before, elevation)
    assert torch.equal(said["a"].f, before["a"].f) and not seen.any()


def test_what_cannot_be_reassessed_is_refused(make_specialist):
    elevation = rough(12, 9, np.random.default_rng(0))
    said = assess_all(elevation, {"a": make_specialist("a")})
    with pytest.raises(ConfigError, match="got 0 of 0 maps"):
        reassess({}, elevation)
    with pytest.raises(ConfigError, match="2 of 2 maps, 2 with a specialist"):
        other = rough(12, 9, np.random.default_rng(1))
        reassess(said | assess_all(other, {"b": make_specialist("b")}), elevation)
    with pytest.raises(ConfigError, match="1 of 1 maps, 0 with a specialist"):
        reassess({"a": Assessment(said["a"].f, said["a"].f, elevation)}, elevation)
    for changed in (elevation.rotated90(), ElevationMap(elevation.heights, 0.2)):
        with pytest.raises(ConfigError, match="with other heights: assess it as a new map"):
            reassess(said, changed)


@pytest.mark.parametrize("headings", [8, 16, 32, 48])
def test_weighing_around_a_cell_gives_what_weighing_the_map_gives(make_specialist, headings):
    elevation = rough(13, 9, np.random.default_rng(2))
    one = assess_all(elevation, {"a": make_specialist("a")}, headings=headings)["a"]
    w_ood, F = one.weigh(0.0, 50.0)
    for cell in np.argwhere(elevation.known).tolist():
        part, at = one.around((cell[0], cell[1]))
        assert max(part.elevation.shape) <= 2 * Headings(headings).moves.max() + 1
        for whole, near in zip((w_ood, F), part.weigh(0.0, 50.0), strict=True):
            assert torch.equal(near[at], whole[tuple(cell)])
        x, y = elevation.centre_of(*cell)
        assert part.elevation.cell_of(x, y) == at
