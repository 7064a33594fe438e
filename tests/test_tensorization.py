"""Tensorization: the fast way against the reference, symmetry, unknown cells, reasons."""

import re

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fgtutor import directions, patches, tiles
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, ThresholdError, TooLargeError
from fgtutor.feasibility import FoldedNet
from fgtutor.io import machine, progress
from fgtutor.patches import PatchGrid
from fgtutor.tensorization import (
    assess,
    assess_all,
    ood_score,
    tensorize,
    why_blocked,
)

ASYMMETRIC = PatchGrid(ahead=0.4, behind=0.2, half_width=0.2)


def rough(nx: int, ny: int, *, seed: int = 0, resolution: float = 0.1, lift: float = 0.0):
    """Return a map without any symmetry: a slope, a step, a trench and noise."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    heights = 0.02 * x + 0.01 * y + 0.2 * (x > nx // 2) - 1.5 * (y == ny // 3)
    heights = heights + 0.05 * rng.random((nx, ny)) + lift
    return ElevationMap(heights, resolution=resolution, origin=(-1.3, 40.7))


def close(one: torch.Tensor, other: torch.Tensor, tolerance: float) -> None:
    torch.testing.assert_close(one, other, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("grid", [ASYMMETRIC, PatchGrid()], ids=["asymmetric", "standard"])
@pytest.mark.parametrize("resolution", [0.1, 0.05, 0.07])
@pytest.mark.parametrize("lift", [0.0, 2000.0], ids=["sea level", "mountain"])
def test_fast_equals_reference_everywhere(make_specialist, grid, resolution, lift):
    specialist = make_specialist(grid=grid)
    elevation = rough(23, 17, resolution=resolution, lift=lift)
    fast, reference = (assess(elevation, specialist, method) for method in ("fast", "reference"))
    close(fast.f, reference.f, 1e-5)
    close(fast.reconstruction, reference.reconstruction, 1e-5)


# The fixture only makes specialists, so that hypothesis may share it between examples.
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(2, 12), st.integers(2, 12), st.integers(0, 10**6))
def test_fast_equals_reference_on_any_small_map(make_specialist, nx, ny, seed):
    elevation, specialist = rough(nx, ny, seed=seed), make_specialist(grid=ASYMMETRIC)
    fast, reference = (assess(elevation, specialist, method) for method in ("fast", "reference"))
    close(fast.f, reference.f, 1e-5)
    close(fast.reconstruction, reference.reconstruction, 1e-5)


@pytest.mark.parametrize("method", ["fast", "reference"])
def test_the_cut_into_tiles_does_not_show(make_specialist, monkeypatch, method):
    specialist, elevation = make_specialist(), rough(23, 17)
    whole = assess(elevation, specialist, method)
    monkeypatch.setattr(tiles, "TILE", 7)  # at the far borders less is left
    strips = assess(elevation, specialist, method)
    close(strips.f, whole.f, 1e-6)
    close(strips.reconstruction, whole.reconstruction, 1e-5)


def test_assess_is_the_network_on_the_patch_a_robot_there_would_see(make_specialist):
    specialist, elevation = make_specialist(grid=ASYMMETRIC), rough(12, 9)
    ix, iy, heading = 3, 5, 7
    ready = patches.prepare(elevation)
    pose = torch.tensor([*elevation.centre_of(ix, iy), directions.YAWS[heading]])
    patch = patches.sample_patches(
        torch.tensor(ready.heights, dtype=torch.float64),
        pose,
        specialist.grid,
        resolution=0.1,
        origin=ready.origin,
    ).float()
    command = torch.tensor(specialist.command)
    assessment = assess(elevation, specialist)
    with torch.no_grad():
        close(
            assessment.f[ix, iy, heading], specialist.feasibility.feasibility(patch, command), 1e-5
        )
        close(
            assessment.reconstruction[ix, iy, heading],
            specialist.feasibility.reconstruction(patch),
            1e-5,
        )


@pytest.mark.parametrize("heading", [0, 3])
def test_the_first_layer_on_all_patches_is_one_convolution_of_the_map(make_specialist, heading):
    """The claim of the module's docstring: W p(x, y) = (M * kernel)(x, y) - ground (W 1)."""
    specialist, elevation = make_specialist(grid=ASYMMETRIC), rough(12, 9)
    grid, weight = specialist.grid, specialist.feasibility.encoder[0].weight.detach().double()
    margin = 6
    size = 2 * margin + 1
    # The kernel, tap by tap: what the points of a patch in the middle see of a map that is 1 in one
    # cell and 0 elsewhere.
    centre = torch.tensor((margin + 0.5) * 0.1, dtype=torch.float64)
    yaw = torch.tensor(directions.YAWS[heading])
    points = patches.rotate(grid.points.double(), yaw) + centre
    basis = torch.eye(size * size, dtype=torch.float64).reshape(-1, size, size)
    taps = [patches.sample_heights(b, points, resolution=0.1, origin=(0.0, 0.0)) for b in basis]
    kernel = (weight @ torch.stack(taps, dim=1)).reshape(-1, 1, size, size)

    heights = np.pad(elevation.heights.astype(float), margin, mode="edge")
    convolved = torch.nn.functional.conv2d(torch.from_numpy(heights)[None, None], kernel)[0]

    ix, iy = torch.meshgrid(torch.arange(12), torch.arange(9), indexing="ij")
    poses = torch.stack(
        ((ix + 0.5) * 0.1, (iy + 0.5) * 0.1, torch.full_like(ix, 1) * yaw), dim=-1
    ).double()
    surface = torch.tensor(elevation.heights, dtype=torch.float64)
    seen = patches.sample_heights(
        surface,
        poses[..., None, :2] + patches.rotate(grid.points.double(), poses[..., 2]),
        resolution=0.1,
        origin=(0.0, 0.0),
    )
    ground = patches.ground_height(seen, grid)
    patch = patches.sample_patches(surface, poses, grid, resolution=0.1)
    expected = convolved.permute(1, 2, 0) - ground * weight.sum(dim=1)
    torch.testing.assert_close(patch @ weight.T, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("method", ["fast", "reference"])
@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_turning_the_map_shifts_the_headings(make_specialist, method, quarter_turns):
    specialist, elevation = make_specialist(grid=ASYMMETRIC), rough(14, 9)
    still = assess(elevation, specialist, method)
    turned = assess(elevation.rotated90(quarter_turns), specialist, method)
    for name in ("f", "reconstruction"):
        expected = torch.rot90(getattr(still, name), quarter_turns, dims=(0, 1))
        close(getattr(turned, name), expected.roll(2 * quarter_turns, dims=2), 1e-5)


def test_lifting_the_map_changes_nothing(make_specialist):
    specialist = make_specialist()
    close(
        assess(rough(9, 9), specialist).reconstruction,
        assess(rough(9, 9, lift=3.0), specialist).reconstruction,
        1e-4,  # the map's own float32 heights round off near 3 m
    )


def test_adding_a_policy_leaves_the_others_as_they_were(make_specialist):
    elevation = rough(15, 11)
    first, second = make_specialist("first"), make_specialist("second", seed=1)
    alone = tensorize(elevation, first, taus="paper")
    tensorize(elevation, second, taus="paper")
    assert torch.equal(tensorize(elevation, first, taus="paper"), alone)
    assert not torch.equal(tensorize(elevation, second, taus="paper"), alone)


def test_a_team_is_assessed_as_each_policy_alone(make_specialist):
    elevation = rough(15, 11)
    team = {
        "first": make_specialist("first"),
        "second": make_specialist("second", seed=1),
        "third": make_specialist("third", grid=ASYMMETRIC, command=(0.3, 0.0, 0.0)),
    }
    for name, one in assess_all(elevation, team).items():
        alone = assess(elevation, team[name])
        assert torch.equal(one.f, alone.f)
        assert torch.equal(one.reconstruction, alone.reconstruction)
    for name, one in assess_all(elevation, team, taus=(0.1, 5.0)).items():
        assert torch.equal(one.weighted(), tensorize(elevation, team[name], taus=(0.1, 5.0)))
        assert one.specialist is team[name] and one.elevation is elevation


def test_equal_patches_are_assessed_once(make_specialist, monkeypatch):
    heights = np.zeros((20, 12))
    heights[10:] = 0.1  # along y all cells look alike, but those near the border
    elevation, specialist = ElevationMap(heights, resolution=0.1), make_specialist()
    asked = []
    plain, folded = specialist.feasibility.reconstruction, FoldedNet.reconstruction
    monkeypatch.setattr(
        FoldedNet,
        "reconstruction",
        lambda net, heights: (asked.append(len(heights)), folded(net, heights))[1],
    )
    assessment = assess(elevation, specialist)
    assert sum(asked) < 0.1 * 8 * heights.size
    # What each cell is given is what the network says of the patch there.
    for heading, yaw in enumerate(directions.YAWS):
        poses = torch.tensor([[*elevation.centre_of(9, 5), yaw]])
        surface = torch.as_tensor(heights, dtype=torch.float32)
        patch = patches.sample_patches(surface, poses, specialist.grid, resolution=0.1)
        torch.testing.assert_close(
            assessment.reconstruction[9, 5, heading], plain(patch.float())[0]
        )


def test_tensorize_weighs_f_by_familiarity(make_specialist):
    specialist, elevation = make_specialist(), rough(10, 8)
    assessment = assess(elevation, specialist)
    w_ood = (1 - (assessment.reconstruction - 0.3) / 1.2).clamp(0, 1)
    close(assessment.ood(0.3, 1.5), w_ood, 1e-6)
    assert torch.equal(
        assess(elevation, specialist, taus=(0.3, 1.5)).ood(), assessment.ood(0.3, 1.5)
    )
    tensor = tensorize(elevation, specialist, taus=(0.3, 1.5), unknown="fill")
    close(tensor, w_ood * assessment.f, 1e-6)
    assert 0 < w_ood.mean() < 1


def test_taus_by_name_and_by_number(make_specialist):
    own = {"0.9": 0.2, "0.99": 1.0}
    specialist = make_specialist(quantiles=own, strangeness=own)
    assert ood_score("paper", specialist).taus == (0.1, 2.0)
    assert ood_score((0.3, 0.4), specialist).taus == (0.3, 0.4)
    ours = ood_score("calibrated", specialist)
    assert ours.taus is None and ours.own == (own, own)


def test_settings_that_cannot_work_are_refused(make_specialist):
    specialist, elevation = make_specialist(), rough(4, 4)
    with pytest.raises(ThresholdError, match="0 <= tau_low < tau_high"):
        tensorize(elevation, specialist, taus=(2.0, 0.1))
    unusable = ["loose", "12", (1.0, 2.0, 3.0), (1.0, 1.0), (-1.0, 1.0), (0.1, np.inf), None, 0.1]
    for taus in [*unusable, (np.nan, 1.0), (0.1, np.nan), ("low", "high")]:
        with pytest.raises(ThresholdError, match="taus must be"):
            tensorize(elevation, specialist, taus=taus)
    with pytest.raises(ConfigError, match="reference, fast"):
        tensorize(elevation, specialist, method="slow")
    with pytest.raises(ConfigError, match="block"):
        tensorize(elevation, specialist, unknown="free")


def with_hole(nx: int = 9, ny: int = 8) -> ElevationMap:
    heights = rough(nx, ny).heights.copy()
    heights[4, 3] = np.nan
    return ElevationMap(heights)


def test_an_unknown_cell_can_be_neither_left_nor_entered(make_specialist):
    elevation = with_hole()
    tensor = tensorize(elevation, make_specialist(), taus=(1e3, 1e4))
    assert not tensor[4, 3].any()
    for heading, (dx, dy) in enumerate(directions.STEPS):
        assert tensor[4 - dx, 3 - dy, heading] == 0
        assert tensor[4 - dx, 3 - dy].count_nonzero() == 7
    filled = tensorize(elevation, make_specialist(), taus=(1e3, 1e4), unknown="fill")
    assert (filled > 0).all()


def test_no_step_leaves_the_map(make_specialist):
    tensor = tensorize(rough(5, 4), make_specialist(), taus=(1e3, 1e4))
    # A corner keeps 3 headings, an edge cell 5: 4 * 3 + (2 * 3 + 2 * 2) * 5 + 6 * 8.
    assert tensor.count_nonzero() == 4 * 3 + 10 * 5 + 6 * 8
    assert not tensor[-1, :, 0].any() and not tensor[:, 0, 6].any()


def test_why_blocked_names_the_layer(make_specialist):
    elevation, specialist = with_hole(), make_specialist("steps")

    def why(x: float, y: float, tau_low: float = 1e3, f_min: float = 0.1) -> str:
        assessment = assess(elevation, specialist, taus=(tau_low, 10 * tau_low))
        return why_blocked(x, y, {"steps": assessment}, f_min=f_min)

    with pytest.raises(ConfigError, match="without an assessment"):
        why_blocked(0.5, 0.5, {})
    assert "off the map" in why(-1.0, 0.2)
    assert "never observed" in why(0.45, 0.35)
    assert "is open: steps leaves it towards" in why(0.65, 0.65)
    assert "would not keep its velocity" in why(0.65, 0.65, f_min=0.99)
    assert "does not know such terrain" in why(0.65, 0.65, tau_low=1e-9)


@pytest.mark.parametrize("origin", [(500000, 4649776), (500000.35, 5648298.15)])
def test_why_blocked_shows_places_to_the_cell_far_from_the_origin(make_specialist, origin):
    elevation = ElevationMap(with_hole().heights, origin=origin)
    assessments = {"steps": assess(elevation, make_specialist("steps"))}
    for dx, dy in ((0.45, 0.35), (0.65, 0.65), (-0.05, 0.35)):
        x, y = origin[0] + dx, origin[1] + dy
        reason = why_blocked(x, y, assessments)
        assert f"({x:.2f}, {y:.2f}) m" in reason


def test_a_map_too_large_for_the_memory_left_is_refused(make_specialist, monkeypatch):
    monkeypatch.setattr(machine, "ALWAYS_LEFT", 0)
    monkeypatch.setattr(machine, "available_memory", lambda: 25_000)
    with pytest.raises(TooLargeError, match=r"10 x 20 cells for 1 policy needs about 2.56e-05 GB"):
        tensorize(rough(10, 20), make_specialist())


def test_a_bar_and_the_expected_time_are_shown_where_asked(make_specialist, monkeypatch, capsys):
    team = {"a": make_specialist("a"), "b": make_specialist("b", grid=ASYMMETRIC)}
    monkeypatch.setattr(tiles, "TILE", 7)
    for name in ("QUICK", "TRIED", "LONG"):
        monkeypatch.setattr(progress, name, 0.0)
    assess_all(rough(15, 20), team)
    assert not capsys.readouterr().err
    assess_all(rough(15, 20), team, progress=True)
    shown = capsys.readouterr().err
    assert re.search("assessing 15 x 20 cells for 2 policies: about [0-9]+ s\n", shown)
    # 3 x 3 tiles and two grids.
    assert "18/18" in shown


def test_what_is_quick_shows_nothing(make_specialist, capsys):
    tensorize(rough(5, 5), make_specialist(), progress=True)
    assert not capsys.readouterr().err


def test_why_blocked_sees_a_cell_walled_in_by_unknown_ones(make_specialist):
    heights = np.full((5, 5), np.nan)
    heights[2, 2] = heights[0, 0] = 0.0
    elevation = ElevationMap(heights)
    assessments = {"steps": assess(elevation, make_specialist())}
    reason = why_blocked(0.25, 0.25, assessments)
    assert "all its neighbours are unknown" in reason
