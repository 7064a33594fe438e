"""Patches: what a robot at a pose sees of the map."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.patches import (
    HOLE_DEPTH,
    SPACING,
    PatchGrid,
    ground_height,
    prepare,
    reach,
    sample_heights,
    sample_patches,
)
from fgtutor.world.terrain import make_terrain

GRID = PatchGrid(ahead=0.3, behind=0.1, half_width=0.1, spacing=0.1, footprint=(0.1, 0.1))


def patch_at(heights: np.ndarray, x: float, y: float, yaw: float) -> torch.Tensor:
    surface = torch.as_tensor(heights, dtype=torch.float64)
    pose = torch.tensor([x, y, yaw], dtype=torch.float64)
    return sample_patches(surface, pose, GRID, resolution=0.1).reshape(GRID.shape)


def test_points_run_from_behind_to_ahead_and_from_right_to_left():
    assert GRID.shape == (5, 3) and GRID.num_points == 15
    torch.testing.assert_close(GRID.points[0], torch.tensor([-0.1, -0.1]))
    torch.testing.assert_close(GRID.points[-1], torch.tensor([0.3, 0.1]))
    assert len(GRID.footprint_index) == 9
    assert reach(GRID) == pytest.approx(math.hypot(0.3, 0.1))


def test_the_standard_patch_has_187_points():
    assert PatchGrid().shape == (17, 11)


@pytest.mark.parametrize(
    ("yaw", "rows"), [(0.0, [0, 0, 1, 1, 1]), (math.pi, [1, 0, 0, 0, 0])], ids=["up", "away"]
)
def test_a_step_lies_ahead_or_behind(yaw, rows):
    heights = np.zeros((20, 20))
    heights[10:] = 1.0
    # Cell (9, 9) has its centre at (0.95, 0.95); the step starts one cell further along x.
    assert patch_at(heights, 0.95, 0.95, yaw)[:, 1].round().tolist() == rows


def test_left_is_left():
    heights = np.tile(np.arange(20) * 0.1, (20, 1))  # rises with y
    torch.testing.assert_close(
        patch_at(heights, 0.95, 0.95, 0.0)[0], torch.tensor([-0.1, 0.0, 0.1]).double()
    )
    torch.testing.assert_close(
        patch_at(heights, 0.95, 0.95, math.pi)[0], torch.tensor([0.1, 0.0, -0.1]).double()
    )


def test_the_ground_is_the_median_under_the_footprint():
    heights = np.zeros((20, 20))
    heights[9, 9] = 5.0  # one post under the robot does not lift the ground
    patch = patch_at(heights, 0.95, 0.95, 0.0)
    assert patch[1, 1] == pytest.approx(5.0) and patch.sum() == pytest.approx(5.0)
    even = PatchGrid(ahead=0.1, behind=0.0, half_width=0.0, footprint=(0.1, 0.1))
    assert ground_height(torch.tensor([1.0, 3.0]), even).item() == 1.0


def test_heights_between_centres_are_bilinear():
    heights = torch.tensor([[0.0, 1.0], [2.0, 5.0]])
    xy = torch.tensor([[1.0, 1.0], [0.75, 0.5], [0.5, 1.0]])
    # Centres lie at 0.5 and 1.5: the middle is the mean 8 / 4; then a quarter from 0 to 2; then
    # half-way from 0 to 1.
    expected = torch.tensor([2.0, 0.5, 0.5])
    torch.testing.assert_close(
        sample_heights(heights, xy, resolution=1.0, origin=(0.0, 0.0)), expected
    )


def test_sampling_agrees_with_the_map_everywhere_and_beyond():
    rng = np.random.default_rng(3)
    elevation = ElevationMap(rng.random((7, 5)), resolution=0.2, origin=(-3.0, 2.0))
    xy = rng.uniform((-4.0, 1.0), (-1.0, 4.0), (500, 2))
    sampled = sample_heights(
        torch.tensor(elevation.heights, dtype=torch.float64),
        torch.tensor(xy),
        resolution=elevation.resolution,
        origin=elevation.origin,
    )
    np.testing.assert_allclose(sampled, elevation.height_at(*xy.T), atol=1e-7)


@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.floats(-1000, 1000))
def test_turning_map_and_robot_together_changes_nothing(seed, quarter_turns, lift):
    heights = np.random.default_rng(seed).random((9, 12))
    elevation = ElevationMap(heights)
    turned = elevation.rotated90(quarter_turns)
    yaw = 0.3
    angle = quarter_turns * math.pi / 2
    x, y = 0.4, 0.7
    cos, sin = math.cos(angle), math.sin(angle)
    poses = [(x, y, yaw), (cos * x - sin * y, sin * x + cos * y, yaw + angle)]
    one, other = (
        sample_patches(
            torch.tensor(m.heights, dtype=torch.float64) + up,
            torch.tensor(pose, dtype=torch.float64),
            GRID,
            resolution=m.resolution,
            origin=m.origin,
        )
        for m, pose, up in zip((elevation, turned), poses, (0.0, lift), strict=True)
    )
    torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


def test_a_point_that_is_nan_has_no_height_on_a_map_of_any_shape():
    for shape in ((4, 4), (5, 3), (3, 7), (1, 1)):
        xy = torch.tensor([[math.nan, 0.1], [0.1, math.nan], [0.1, 0.1]])
        found = sample_heights(torch.ones(shape), xy, resolution=0.1, origin=(0.0, 0.0))
        assert found.isnan().tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("heights", "poses", "fields", "message"),
    [
        (torch.zeros(4, 4, dtype=torch.int64), torch.zeros(3), {}, "must be floats"),
        (torch.zeros(4, 4), torch.zeros(3), {"resolution": 0.0}, "resolution"),
        (torch.zeros(4, 4), torch.zeros(3), {"resolution": math.nan}, "resolution"),
        (torch.zeros(4, 4), torch.zeros(3), {"origin": (math.inf, 0.0)}, "origin"),
        (torch.zeros(4, 4), torch.zeros(3), {"origin": (5e5, 4649776.0)}, "4649776.00.*float64"),
    ],
)
def test_inputs_that_cannot_work_are_refused(heights, poses, fields, message):
    with pytest.raises(ConfigError, match=message):
        sample_patches(heights, poses, GRID, **({"resolution": 0.1} | fields))


@pytest.mark.parametrize("bad", ["heights", "pose"])
def test_nan_does_not_spread_silently(bad):
    heights, pose = torch.zeros(4, 4), torch.zeros(3)
    (heights if bad == "heights" else pose).flatten()[0] = math.nan
    with pytest.raises(ConfigError, match="prepare"):
        sample_patches(heights, pose, GRID, resolution=0.1)


@pytest.mark.parametrize("fields", [{"spacing": 0.0}, {"ahead": -0.1}, {"footprint": (-1.0, -1.0)}])
def test_a_grid_that_cannot_work_is_refused(fields):
    with pytest.raises(ConfigError):
        PatchGrid(**fields)


def test_prepare_fills_the_unknown_and_levels_the_bottomless():
    heights = np.zeros((30, 30))
    heights[10:12] = -3.0
    heights[20, 20] = math.nan
    ready = prepare(ElevationMap(heights))
    assert ready.heights.min() == pytest.approx(-HOLE_DEPTH)
    assert ready.heights[20, 20] == 0.0 and not ready.known[20, 20]


def test_prepare_leaves_the_steepest_valley_as_deep_as_it_is():
    for seed in range(5):
        valley = make_terrain("valley", robot="a1", difficulty=1.0, seed=seed).elevation
        ready, smooth = prepare(valley), valley.filled().smoothed(SPACING)
        np.testing.assert_allclose(ready.heights, smooth.heights, atol=1e-3)
