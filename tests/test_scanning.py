"""From points to maps: outliers, cells and their heights."""

import math

import numpy as np
import pytest
from cloud_writers import cloud, sheet
from hypothesis import given
from hypothesis import strategies as st

from fgtutor.errors import CloudError, ConfigError
from fgtutor.grid import MOST_CELLS
from fgtutor.world import scanning
from fgtutor.world.scanning import WALL, ScanConfig, map_points

# -- cells -----------------------------------------------------------------------------------------


def test_heights_by_hand() -> None:
    z = np.random.default_rng(0).permutation(np.arange(1, 21)) / 100
    points = [(0.02, 0.03, h) for h in z] + [(0.12, 0.07, 0.5), (0.13, 0.08, 0.7)]
    points += [(0.06, 0.01, 9.0)]  # alone in its cell
    scanned = map_points(np.array(points), config=ScanConfig(neighbours=0, clearance=99))
    assert scanned.elevation.shape == (3, 2)
    assert scanned.elevation.origin == (0.0, 0.0)
    assert scanned.count.tolist() == [[20, 0], [1, 0], [0, 2]]
    # 10 of 20 points do not exceed 0.10.
    assert scanned.elevation.heights[0, 0] == pytest.approx(0.10)
    # The lower of two middle heights.
    assert scanned.elevation.heights[2, 1] == pytest.approx(0.5)
    # One point is too few to know a cell by.
    assert not scanned.elevation.known[1, 0]
    assert np.isnan(scanned.elevation.heights[[1, 0], [0, 1]]).all()


@given(
    st.integers(1, 60),
    st.integers(0, 10**6),
    st.sampled_from((0.05, 0.1, 0.02)),
    st.integers(1, 3),
    st.sampled_from((-1.0, 0.25)),
)
def test_heights_against_a_naive_loop(
    n: int, seed: int, step: float, least: int, low: float
) -> None:
    points = np.random.default_rng(seed).uniform((-0.2, 0.3, low), (0.2, 0.5, 0.4), (n, 3))
    points = np.concatenate((points, np.full((least, 3), 0.4)))  # one cell is surely known
    area = (-0.2, 0.3, 0.6, 0.6)
    config = ScanConfig(resolution=step, neighbours=0, min_points=least)
    scanned = map_points(points, config=config, area=area)
    assert scanned.elevation.shape == (round(0.8 / step), round(0.3 / step))
    for ix, iy in np.ndindex(scanned.elevation.shape):
        inside = (np.floor((points[:, :2] - (-0.2, 0.3)) / step) == (ix, iy)).all(axis=1)
        z = points[inside, 2]
        assert scanned.count[ix, iy] == len(z)
        assert scanned.elevation.known[ix, iy] == (len(z) >= least)
        # What lies beside a wall is not the median: see the tests of chasms with the scanner.
        if len(z) >= least and np.quantile(z, 0.95, method="inverted_cdf") - z.min() <= WALL - 2e-4:
            median = np.quantile(z, 0.5, method="inverted_cdf")  # heights are kept to 0.1 mm
            assert scanned.elevation.heights[ix, iy] == pytest.approx(median, abs=2e-4)


def test_cells_begin_at_multiples_of_the_resolution_or_at_the_area() -> None:
    points = np.array([(-0.26, 1.02, 0.0), (-0.24, 1.04, 0.0), (0.31, 1.33, 0.0)]).repeat(2, axis=0)
    config = ScanConfig(resolution=0.1, neighbours=0)
    elevation = map_points(points, config=config).elevation
    assert elevation.origin == (-0.3, 1.0) and elevation.shape == (7, 4)
    elevation = map_points(points, config=config, area=(-0.25, 1.0, 0.2, 1.2)).elevation
    assert elevation.origin == (-0.25, 1.0) and elevation.shape == (5, 2)
    assert np.argwhere(elevation.known).tolist() == [[0, 0]]


POSTS = np.indices((40, 40)).reshape(2, -1).repeat(2, axis=1).T
"""Two posts for every cell."""


@pytest.mark.parametrize("step", [0.05, 0.1, 0.2, 0.03, 1.0, 0.3048])
@pytest.mark.parametrize("origin", [(0, 0), (-1, -3), (500000, 4649776), (500000.35, 5648298.15)])
def test_points_on_borders_fill_every_cell(step: float, origin: tuple[float, float]) -> None:
    # As decimals are written, and as LAS computes them: a whole number times scale plus offset.
    first = np.round(np.array(origin) / step) * step
    written = np.char.mod("%.6f", POSTS * step + first).astype(float)
    computed = (POSTS * round(step * 1e4)) * 1e-4 + first
    for xy in (written, computed):
        height = np.where(POSTS[:, 0] >= 20, 0.1, 0.0)
        points = np.column_stack((xy, height))
        scanned = map_points(points, config=ScanConfig(resolution=step))
        assert scanned.elevation.shape == (40, 40) and (scanned.count == 2).all()
        np.testing.assert_allclose(scanned.elevation.heights[:, 0], height[::80], atol=2e-4)
        area = (*first, *(first + 40 * step))
        scanned = map_points(points, config=ScanConfig(resolution=step), area=area)
        assert scanned.elevation.shape == (40, 40) and (scanned.count == 2).all()
        assert scanned.outside == 0
        x, y = xy[160]
        assert scanned.elevation.cell_of(x, y) == (2, 0)


@given(st.integers(1, 400), st.integers(-(10**8), 10**8), st.integers(0, 10**6))
def test_cells_are_those_of_exact_integers(cell: int, offset: int, seed: int) -> None:
    # Coordinates to the centimetre, anywhere up to 1000 km away.
    whole = np.random.default_rng(seed).integers(0, 5 * cell, (30, 2)) + offset
    points = np.column_stack((whole * 0.01, np.zeros(30)))
    config = ScanConfig(resolution=cell / 100, neighbours=0, min_points=1)
    scanned = map_points(points, config=config)
    expected = whole // cell - (whole // cell).min(axis=0)
    found = np.argwhere(scanned.count)
    assert {*map(tuple, found)} == {*map(tuple, expected.tolist())}
    assert scanned.elevation.origin == pytest.approx((whole // cell).min(axis=0) * cell / 100)


def test_what_lies_outside_the_area_is_counted_and_its_last_cell_is_whole() -> None:
    points = np.array([(x, 0.5, 0.0) for x in (-0.01, 0.0, 0.5, 1.02, 1.04, 1.05, 9)]).repeat(2, 0)
    scanned = map_points(points, config=ScanConfig(neighbours=0), area=(0, 0, 1.03, 1))
    assert scanned.elevation.shape == (21, 20)
    assert scanned.outside == 6 and scanned.count.sum() == 8 and scanned.count[20, 10] == 4


def test_points_in_cells_with_too_few_are_counted() -> None:
    points = np.array([(0, 0, 0), (0.01, 0, 0), (0.07, 0, 0), (0, 0.07, 0)], dtype=float)
    scanned = map_points(points)
    assert scanned.sparse == 2 and scanned.elevation.known.sum() == 1


def test_places_in_messages_are_given_to_the_centimetre() -> None:
    points = cloud() + np.array((500000, 4649776, 0))
    with pytest.raises(CloudError, match=r"y 46497\d\d\.\d\d\.\.46497\d\d\.\d\d m"):
        map_points(points, area=(0, 0, 1, 1))


def test_neighbours_are_searched_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    points = cloud(2000)
    whole = map_points(points, config=ScanConfig(outlier_ratio=0.1, resolution=0.1))
    monkeypatch.setattr(scanning, "_DISTANCES", 500)
    parts = map_points(points, config=ScanConfig(outlier_ratio=0.1, resolution=0.1))
    assert 0 < parts.outliers == whole.outliers
    np.testing.assert_array_equal(parts.count, whole.count)


def test_the_order_of_the_points_does_not_matter() -> None:
    points = sheet()
    first = map_points(points)
    second = map_points(np.random.default_rng(1).permutation(points))
    np.testing.assert_array_equal(first.elevation.heights, second.elevation.heights)


def test_a_turned_cloud_gives_the_turned_map() -> None:
    points = sheet(seed=3)
    plain = map_points(points).elevation
    turned = map_points(points @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]).elevation  # (x, y) -> (-y, x)
    np.testing.assert_array_equal(turned.heights, plain.rotated90().heights)
    assert turned.origin == pytest.approx(plain.rotated90().origin)


def test_a_map_in_national_coordinates_is_as_exact() -> None:
    plain = map_points(sheet()).elevation
    offset = np.array((450_000.0, 5_400_000.0, 0.0))
    moved = map_points(sheet() + offset).elevation
    assert moved.origin == (450_000.0, 5_400_000.0)
    np.testing.assert_array_equal(moved.heights, plain.heights)


def test_unknown_cells_stay_unknown_until_filled_and_known_as_such_after() -> None:
    points = sheet()
    hole = (points[:, 0] > 0.25) & (points[:, 0] < 0.4) & (points[:, 1] < 0.2)
    elevation = map_points(points[~hole]).elevation
    assert (~elevation.known).sum() == 3 * 4
    assert np.isnan(elevation.heights[5:8, :4]).all()
    filled = elevation.filled()
    assert np.isfinite(filled.heights).all()
    np.testing.assert_array_equal(filled.known, elevation.known)


# -- what is no ground -----------------------------------------------------------------------------


def test_stray_points_are_removed_and_the_edges_of_the_map_are_not() -> None:
    points = sheet()
    stray = np.array([(0.5, 0.3, 1.0), (0.2, 0.1, 0.8), (0.7, 0.4, -0.9), (0.9, 0.5, 1.3)])
    scanned = map_points(np.concatenate((points, stray)))
    assert scanned.outliers == len(stray)
    assert scanned.count.sum() == len(points)
    np.testing.assert_array_equal(scanned.elevation.heights, map_points(points).elevation.heights)


@pytest.mark.parametrize("ratio", [0.0, 1.0, 3.0])
def test_outliers_against_a_naive_loop(ratio: float) -> None:
    # One point in every voxel at most: the points are the voxels' centres.
    points = np.random.default_rng(2).uniform(0, 1, (60, 3)) ** 3
    points = points[np.unique(np.floor(points / 0.05), axis=0, return_index=True)[1]]
    distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    mean = distances[:, 1:6].mean(axis=1)
    limit = max(mean.mean() + ratio * mean.std(), 0.125)
    config = ScanConfig(neighbours=5, outlier_ratio=ratio, min_points=1)
    scanned = map_points(points, config=config, area=(0, 0, 1, 1))
    assert 0 < (mean > limit).sum() < len(points)
    assert scanned.outliers == (mean > limit).sum()


def test_a_cell_of_10_cm_is_tested_in_voxels_of_5_cm() -> None:
    assert ScanConfig(resolution=0.1).voxel == 0.05
    assert ScanConfig(resolution=0.02).voxel == 0.02
    assert ScanConfig(resolution=0.12).voxel == 0.06


def test_a_ceiling_is_no_ground_but_a_table_is() -> None:
    floor = sheet()
    table = floor[floor[:, 0] < 0.3] + np.array((0, 0, 0.75))
    ceiling = floor + np.array((0, 0, 2.4))
    scanned = map_points(np.concatenate((floor, ceiling)))
    assert scanned.overhanging == len(ceiling) and scanned.outliers == 0
    np.testing.assert_allclose(
        scanned.elevation.heights, map_points(floor).elevation.heights, atol=2e-4
    )
    scanned = map_points(np.concatenate((floor, table)))
    assert scanned.overhanging == 0 and scanned.count.sum() == len(floor) + len(table)


# -- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "fields", "message"),
    [
        (np.zeros((5, 2)), {}, r"\[n, 3\].*\(5, 2\)"),
        (np.zeros((0, 3)), {}, "none of the 0 points"),
        (np.full((5, 3), np.nan), {}, "none of the 5 points"),
        (cloud(), {"config": ScanConfig(min_points=50)}, "no cell of 0.05 m holds 50 points"),
        (cloud(), {"area": (7, 7, 8, 8)}, r"no point lies in the area.*x -0.9"),
        (cloud(), {"area": (1, 1, 0, 2)}, "is empty"),
        (1e3 * cloud(), {}, "check that it is in metres"),
        (1e9 * cloud(), {}, "too far for voxels"),
        (1e300 * cloud(), {}, "subtract an offset"),
        (np.full((5, 3), 1.7e308), {}, "subtract an offset"),
        (cloud() * (1, 1, 1e12), {}, "too far for voxels|heights reach"),
        (cloud(), {"area": (0, 0, math.inf, 2)}, "area.*finite"),
        (cloud(), {"area": (0, math.nan, 1, 2)}, "area.*finite"),
        (cloud(), {"area": (0, 0, 1e9, 1e9)}, f"more than {MOST_CELLS}"),
        (cloud(), {"area": (0, 0, 1e-300, 1e300)}, f"more than {MOST_CELLS}"),
        (cloud(3), {"config": ScanConfig(resolution=0.001)}, "too large"),
    ],
)
def test_unusable_clouds_are_refused(points: np.ndarray, fields: dict, message: str) -> None:
    with pytest.raises(CloudError, match=message):
        map_points(points, **fields)


@pytest.mark.parametrize(
    "fields",
    [
        {"resolution": 0.0},
        {"resolution": math.nan},
        {"neighbours": -1},
        {"min_points": 0},
        {"outlier_ratio": math.nan},
        {"outlier_ratio": math.inf},
        {"clearance": 0.0},
        {"clearance": math.nan},
        {"resolution": math.inf},
        {"resolution": 1e300},
        {"resolution": "0.1"},
        {"neighbours": 10**6},
        {"neighbours": 2.5},
        {"min_points": 10**12},
    ],
)
def test_settings_that_cannot_work_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(fields))):
        ScanConfig(**fields)
