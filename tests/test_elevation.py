"""ElevationMap: cells, heights and derived maps."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fgtutor.elevation import ElevationMap
from fgtutor.errors import MapError, OffMapError
from fgtutor.grid import MOST_CELLS


def hilly(nx: int = 7, ny: int = 5, *, resolution: float = 0.1, seed: int = 0) -> ElevationMap:
    """Return a random, asymmetric map with one unknown cell, away from the world's corner."""
    heights = np.random.default_rng(seed).normal(size=(nx, ny))
    heights[2, 3] = np.nan
    return ElevationMap(heights, resolution=resolution, origin=(1.3, -2.7))


@st.composite
def maps(draw: st.DrawFn) -> ElevationMap:
    """Draw a map of any small shape, with some unknown cells."""
    shape = draw(st.tuples(st.integers(2, 9), st.integers(2, 9)))
    heights = draw(arrays(np.float32, shape, elements=st.floats(-50, 50, width=32)))
    unknown = draw(arrays(np.bool_, shape))
    unknown[draw(st.integers(0, shape[0] - 1)), 0] = False
    resolution = draw(st.sampled_from((0.05, 0.1, 0.25, 1.0, 0.3)))
    origin = draw(st.tuples(*[st.integers(-(10**6), 10**6).map(lambda n: n / 1000)] * 2))
    return ElevationMap(np.where(unknown, np.nan, heights), resolution=resolution, origin=origin)


# -- construction ----------------------------------------------------------------------------------


def test_heights_are_a_read_only_float32_copy() -> None:
    source = np.zeros((2, 3))
    elevation = ElevationMap(source)
    source[0, 0] = 5.0
    assert elevation.heights.dtype == np.float32 and elevation.heights[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        elevation.heights[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        elevation.known[0, 0] = False


@pytest.mark.parametrize(
    ("heights", "fields", "message"),
    [
        (np.zeros((1, 5)), {}, r"2 x 2 cells.*\(1, 5\)"),
        (np.zeros(4), {}, "2 x 2 cells"),
        (np.zeros((0, 0)), {}, "2 x 2 cells"),
        (np.zeros((2, 2, 1)), {}, "2 x 2 cells"),
        ([["a", "b"], ["c", "d"]], {}, "holds <U1"),
        ([[1, 2], [3]], {}, "no array of numbers"),
        ([[1, 2], [3, None]], {}, "holds object"),
        (np.ones((2, 2), complex), {}, "holds complex128"),
        (np.ones((2, 2), bool), {}, "holds bool"),
        (np.zeros((2, 2), "M8[s]"), {}, "holds datetime64"),
        (np.zeros((2, 2), object), {}, "holds object"),
        (np.zeros((2, 2), [("z", "f4")]), {}, "holds"),
        ([[0, -3.4e38], [0, 0]], {}, r"cell \(0, 1\) has a height of -3\.4e\+38 m.*declare it"),
        ([[0, 0], [-9999, -9999]], {}, r"cell \(1, 0\).*2 such cells"),
        (np.array([[0, 65535], [0, 0]], np.uint16), {}, "65535 m"),
        ([[0, -32768], [0, 0]], {}, "check the unit"),
        ([[0, 0], [0, math.inf]], {}, r"cell \(1, 1\)"),
        ([[0, 1e300], [0, 0]], {}, r"cell \(0, 1\)"),
        (np.full((3, 3), np.nan), {}, "every cell"),
        (np.zeros((2, 2)), {"known": np.zeros((2, 2), bool)}, "every cell"),
        (np.zeros((2, 2)), {"known": np.ones((2, 3), bool)}, "shape"),
        ([[np.nan, 0], [0, 0]], {"known": np.ones((2, 2), bool)}, r"cell \(0, 0\)"),
        (np.zeros((2, 2)), {"known": np.ones((2, 2))}, "True or False.*float64"),
        (np.zeros((2, 2)), {"known": [[True, math.nan]] * 2}, "True or False"),
        (np.zeros((2, 2)), {"known": [["yes", "no"]] * 2}, "True or False"),
        (np.zeros((2, 2)), {"resolution": 1 / 3600}, "resolution"),
        (np.zeros((2, 2)), {"resolution": "0.1"}, "resolution"),
        (np.zeros((2, 2)), {"resolution": [0.1, 0.1]}, "resolution"),
        (np.zeros((2, 2)), {"origin": ("a", "b")}, "origin"),
        (np.zeros((2, 2)), {"origin": [[1], [2]]}, "origin"),
        (np.zeros((2, 2)), {"origin": (10**400, 0)}, "origin"),
        (np.zeros((2, 2)), {"origin": (1e12, 0.0)}, "subtract an offset"),
        (np.zeros((2, 2)), {"resolution": 0.0}, "resolution"),
        (np.zeros((2, 2)), {"resolution": math.nan}, "resolution"),
        (np.zeros((2, 2)), {"resolution": math.inf}, "resolution"),
        (np.zeros((2, 2)), {"origin": (0.0, math.nan)}, "origin"),
        (np.zeros((2, 2)), {"origin": (0.0, 0.0, 0.0)}, "origin"),
    ],
)
def test_unusable_maps_are_refused(heights: object, fields: dict, message: str) -> None:
    with pytest.raises(MapError, match=message):
        ElevationMap(heights, **fields)


def test_masked_cells_are_unknown() -> None:
    rows = np.ma.masked_equal([[1.0, 2.0, -9999.0], [3.0, 4.0, 5.0]], -9999.0)
    expected = [[True, True, False], [True, True, True]]
    for heights in (rows, rows.astype(int), rows.astype(np.float32), list(rows)):
        elevation = ElevationMap(heights)
        assert elevation.known.tolist() == expected
        assert np.isnan(elevation.heights[0, 2]) and elevation.heights[1, 2] == 5.0
    known = np.ma.masked_array(np.ones((2, 2), bool), [[True, False], [False, False]])
    assert ElevationMap(np.zeros((2, 2)), known=known).known.tolist() == [[False, True], [True] * 2]


def test_tensors_and_arrays_of_any_kind_are_taken() -> None:
    expected = [[1.0, 2.0], [3.0, 4.0]]
    for heights in (
        torch.tensor(expected, requires_grad=True),
        torch.tensor(expected, dtype=torch.int16),
        *(np.array(expected, kind) for kind in ("f2", ">f4", "f8", "i1", "u8")),
    ):
        elevation = ElevationMap(
            heights, resolution=np.float64(0.5), origin=np.array([1, 2]), known=torch.ones(2, 2) > 0
        )
        assert elevation.heights.tolist() == expected and elevation.heights.dtype == np.float32
        assert elevation.origin == (1.0, 2.0) and elevation.resolution == 0.5
    assert ElevationMap(np.zeros((2, 2)), origin=torch.tensor([3.0, 4.0])).origin == (3.0, 4.0)


def test_geometry_by_hand() -> None:
    elevation = ElevationMap(np.zeros((4, 3)), resolution=0.5, origin=(1.0, 2.0))
    assert elevation.shape == (4, 3)
    assert elevation.size == (2.0, 1.5)
    assert elevation.extent == (1.0, 2.0, 3.0, 3.5)
    assert elevation.centres[0].tolist() == [1.25, 1.75, 2.25, 2.75]
    assert elevation.centres[1].tolist() == [2.25, 2.75, 3.25]
    assert "4 x 3 cells of 0.5 m" in repr(elevation)


# -- cells and heights -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("point", "cell"),
    [
        ((0.0, 0.0), (0, 0)),
        ((0.05, 0.15), (0, 1)),
        ((0.3, 0.1), (3, 1)),  # 0.3 / 0.1 is 2.9999999999999996
        ((0.7, 0.2), (7, 2)),
        ((1.0, 0.4), (9, 3)),  # the far corner belongs to the last cell
    ],
)
def test_cell_of(point: tuple[float, float], cell: tuple[int, int]) -> None:
    assert ElevationMap(np.zeros((10, 4))).cell_of(*point) == cell


@pytest.mark.parametrize("point", [(-0.01, 0.0), (0.0, 0.41), (1.1, 0.2), (math.nan, 0.1)])
def test_points_off_the_map(point: tuple[float, float]) -> None:
    elevation = ElevationMap(np.zeros((10, 4)))
    assert not elevation.contains(*point)
    with pytest.raises(OffMapError, match=r"x from 0\.00 to 1\.00 m and y from 0\.00 to 0\.40 m"):
        elevation.cell_of(*point)


def test_all_borders_of_a_map_in_utm() -> None:
    for origin in ((500000, 4649776), (500000.35, 5648298.15)):
        elevation = ElevationMap(np.zeros((200, 200)), 0.1, origin)
        for n in range(201):
            point = [float(f"{corner + n / 10:.2f}") for corner in origin]  # as it is written
            assert elevation.cell_of(*point) == (min(n, 199), min(n, 199))
            assert elevation.contains(*point)
    assert not elevation.contains(500000.349, 5648299.0)
    assert not elevation.contains(500001.0, 5648318.151)


def test_messages_show_coordinates_to_the_cell() -> None:
    elevation = ElevationMap(np.zeros((60, 60)), 0.1, (500000, 4649776))
    with pytest.raises(OffMapError) as caught:
        elevation.cell_of(500001, 4649775)
    assert str(caught.value) == (
        "(500001.00, 4649775.00) m is off the map, which covers x from 500000.00 to 500006.00 m "
        "and y from 4649776.00 to 4649782.00 m: choose a point inside"
    )
    with pytest.raises(MapError, match=r"\(500001\.00, 4649700\.00, 500002\.00, 4649775\.00\)"):
        elevation.crop(500001, 4649700, 500002, 4649775)


@given(maps(), st.data())
@settings(max_examples=50, deadline=None)
def test_centre_of_and_cell_of_are_inverse(elevation: ElevationMap, data: st.DataObject) -> None:
    cell = tuple(data.draw(st.integers(0, n - 1)) for n in elevation.shape)
    assert elevation.cell_of(*elevation.centre_of(*cell)) == cell


def test_height_at_by_hand() -> None:
    elevation = ElevationMap([[0.0, 1.0], [2.0, 3.0]], resolution=1.0)
    assert elevation.height_at(0.5, 0.5) == 0.0
    assert elevation.height_at(1.0, 0.5) == 1.0  # half way from 0 to 2
    assert elevation.height_at(1.0, 1.0) == 1.5
    assert elevation.height_at(0.75, 1.25) == 0.25 * 2 + 0.75 * 1  # 2 per m in x, 1 per m in y
    assert elevation.height_at(-9.0, 0.9) == pytest.approx(0.4)  # the edge cell continues
    both = elevation.height_at(np.array([0.5, 1.5])[:, None], np.array([0.5, 1.5])[None, :])
    assert both.tolist() == [[0.0, 1.0], [2.0, 3.0]]


def test_height_at_is_nan_only_where_an_unknown_cell_carries_weight() -> None:
    elevation = ElevationMap([[0.0, np.nan], [2.0, 3.0]], resolution=1.0)
    assert elevation.height_at(0.5, 0.5) == 0.0
    assert elevation.height_at(1.0, 0.5) == 1.0
    assert np.isnan(elevation.height_at(0.5, 0.6))


def test_height_at_is_nan_where_the_point_is() -> None:
    elevation = ElevationMap([[0.0, 1.0], [2.0, 3.0]], resolution=1.0)
    assert np.isnan(elevation.height_at(math.nan, 0)) and np.isnan(elevation.height_at(0, math.nan))
    assert elevation.height_at(math.inf, -math.inf) == 2.0  # the edge cell continues
    assert elevation.height_at(-1e308, 1e308) == 1.0
    masked = np.ma.masked_equal([0.5, 1.5], 1.5)
    np.testing.assert_array_equal(elevation.height_at(masked, 0.5), [0.0, math.nan])
    assert elevation.height_at(torch.tensor([0.5], requires_grad=True), 0.5).tolist() == [0.0]
    for wrong in ("1", None, 1j, [[1], [2, 3]]):
        with pytest.raises(MapError, match=r"x (is no array of numbers|holds)"):
            elevation.height_at(wrong, 0.5)


# -- derived maps ----------------------------------------------------------------------------------


def test_filled_takes_the_nearest_known_height() -> None:
    heights = np.full((4, 6), np.nan)
    heights[0, 0], heights[3, 5] = 1.0, 2.0
    filled = ElevationMap(heights).filled()
    assert filled.heights[1, 1] == 1.0 and filled.heights[3, 3] == 2.0
    assert filled.known.sum() == 2, "filling must not make a cell known"
    np.testing.assert_array_equal(filled.filled().heights, filled.heights)


@given(maps(), st.floats(0, 2), st.floats(0, 0.5))
@settings(max_examples=40, deadline=None)
def test_levelled_against_a_naive_loop(elevation: ElevationMap, depth: float, reach: float) -> None:
    filled = elevation.filled()
    n = round(reach / elevation.resolution)
    ground = np.pad(filled.heights, 2 * n, mode="edge")
    for pick in (np.max, np.min):  # dilation, then erosion
        source = np.pad(ground, n, mode="edge")
        ground = np.array(
            [
                [pick(source[i : i + 2 * n + 1, j : j + 2 * n + 1]) for j in range(ground.shape[1])]
                for i in range(ground.shape[0])
            ]
        )
    ground = ground[2 * n : 2 * n + filled.shape[0], 2 * n : 2 * n + filled.shape[1]]
    levelled = filled.levelled(depth, reach)
    np.testing.assert_array_equal(
        levelled.heights, np.maximum(filled.heights, ground - np.float32(depth))
    )
    np.testing.assert_array_equal(levelled.known, elevation.known)


def test_levelled_raises_a_gap_but_not_the_foot_of_a_wall_or_a_ramp() -> None:
    heights = np.zeros((60, 20))
    heights[10:13] = -1.0  # a gap of 0.3 m
    heights[30:32] = 1.2  # a wall
    heights[44:] = 0.1 * np.arange(16)[:, None]  # a ramp of 45 degrees
    levelled = ElevationMap(heights, resolution=0.1).levelled(0.5, 0.8).heights
    assert levelled[10:13] == pytest.approx(-0.5)
    heights[10:13] = -0.5
    np.testing.assert_allclose(levelled, heights, atol=1e-6)


def test_levelled_sees_a_gap_beside_a_wall() -> None:
    heights = np.zeros((40, 20))
    heights[20:23], heights[:, 10:12] = -1.0, 1.0
    levelled = ElevationMap(heights, resolution=0.1).levelled(0.5, 0.3).heights
    assert levelled[21, 5] == pytest.approx(-0.5)


def test_levelled_needs_a_filled_map_and_positive_numbers() -> None:
    with pytest.raises(MapError, match="filled"):
        hilly().levelled(0.5, 0.8)
    with pytest.raises(MapError, match=r"depth: .*greater than or equal to 0"):
        hilly().filled().levelled(-0.5, 0.8)


@pytest.mark.parametrize("k", [-1, 0, 1, 2, 3, 4, 5])
def test_rotated90_turns_points_about_the_world_origin(k: int) -> None:
    elevation = hilly().filled()
    turned = elevation.rotated90(k)
    x, y = np.random.default_rng(1).uniform([1.2, -2.8], [2.1, -2.1], (50, 2)).T
    angle = k * math.pi / 2
    turned_x = math.cos(angle) * x - math.sin(angle) * y
    turned_y = math.sin(angle) * x + math.cos(angle) * y
    np.testing.assert_allclose(
        turned.height_at(turned_x, turned_y), elevation.height_at(x, y), atol=1e-5
    )
    np.testing.assert_array_equal(turned.rotated90(-k).heights, elevation.heights)
    assert turned.rotated90(-k).origin == pytest.approx(elevation.origin)


def test_rotated90_by_hand() -> None:
    # A map of 2 x 3 cells whose corner is (0, 0): +x becomes +y, so its left side becomes its foot.
    turned = ElevationMap([[0, 1, 2], [3, 4, 5]], resolution=1.0).rotated90()
    assert turned.heights.tolist() == [[2, 5], [1, 4], [0, 3]]
    assert turned.origin == (-3.0, 0.0)


def test_crop_keeps_cells_where_they_were() -> None:
    elevation = hilly(resolution=0.5)
    part = elevation.crop(1.8, -2.2, 3.9, 99.0)
    assert part.shape == (4, 4)
    assert part.origin == pytest.approx((1.8, -2.2))
    np.testing.assert_array_equal(part.heights, elevation.heights[1:5, 1:5])
    with pytest.raises(MapError, match="at least 2 x 2"):
        elevation.crop(1.8, -2.2, 2.2, 99.0)


def test_crop_keeps_the_cells_on_its_border_at_any_origin() -> None:
    elevation = ElevationMap(np.zeros((200, 200)), 0.1, (500000.35, 5648298.15))
    for n in range(100):
        x0, y0 = (float(f"{corner + (n + 0.5) / 10:.2f}") for corner in elevation.origin)
        x1, y1 = (float(f"{corner + (n + 50.5) / 10:.2f}") for corner in elevation.origin)
        part = elevation.crop(x0, y0, x1, y1)
        assert part.shape == (51, 51)
        assert part.origin == pytest.approx((x0 - 0.05, y0 - 0.05), abs=1e-6)
    assert elevation.crop(-math.inf, 0, math.inf, math.inf).shape == (200, 200)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, -1.0, "1", None, 1j, 1e300])
@pytest.mark.parametrize(
    "call",
    [
        lambda elevation, number: elevation.smoothed(number),
        lambda elevation, number: elevation.levelled(0.5, number),
        lambda elevation, number: elevation.crop(0, 0, 1, math.nan),
        lambda elevation, number: elevation.rotated90(1.0 if number == -1.0 else number),
    ],
    ids=["smoothed", "levelled", "crop", "rotated90"],
)
def test_numbers_that_make_no_sense_are_refused(call, number) -> None:
    with pytest.raises(MapError):
        call(ElevationMap(np.zeros((20, 20))), number)


def test_maps_too_large_are_refused_before_memory_is_taken() -> None:
    with pytest.raises(MapError, match=f"more than {MOST_CELLS}"):
        ElevationMap(np.zeros((100, 100))).levelled(0.5, 1000.0)
