"""ElevationMap: cells, heights, derived maps and files."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from fgtutor.elevation import ElevationMap
from fgtutor.errors import MapError, OffMapError, StorageError

SUFFIXES = (".npz", ".tif", ".png")


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
        ([["a", "b"], ["c", "d"]], {}, "grid of numbers"),
        ([[0, 0], [0, math.inf]], {}, r"cell \(1, 1\)"),
        ([[0, 1e300], [0, 0]], {}, r"cell \(0, 1\)"),
        (np.full((3, 3), np.nan), {}, "every cell"),
        (np.zeros((2, 2)), {"known": np.zeros((2, 2), bool)}, "every cell"),
        (np.zeros((2, 2)), {"known": np.ones((2, 3), bool)}, "shape"),
        ([[np.nan, 0], [0, 0]], {"known": np.ones((2, 2), bool)}, r"cell \(0, 0\)"),
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
    with pytest.raises(MapError, match="depth >= 0"):
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


def test_resample_by_hand() -> None:
    fine = ElevationMap([[0.0, 0.0], [4.0, 4.0]], resolution=1.0).resample(0.5)
    assert fine.heights[:, 0].tolist() == [0.0, 1.0, 3.0, 4.0]
    assert fine.shape == (4, 4)
    coarse = ElevationMap(np.arange(16.0).reshape(4, 4), resolution=0.5).resample(1.0)
    assert coarse.heights.tolist() == [[2.5, 4.5], [10.5, 12.5]]  # means of 2 x 2 cells


def test_resample_keeps_unknown_cells_unknown() -> None:
    elevation = hilly(resolution=0.2)
    fine = elevation.resample(0.1)
    np.testing.assert_array_equal(fine.known, np.kron(elevation.known, np.ones((2, 2), bool)))
    np.testing.assert_array_equal(np.isnan(fine.heights), ~fine.known)
    assert np.isfinite(elevation.filled().resample(0.1).heights).all()
    with pytest.raises(MapError, match="resolution"):
        elevation.resample(-1.0)


# -- files -----------------------------------------------------------------------------------------


@given(maps())
@settings(max_examples=25, deadline=None)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, elevation: ElevationMap
) -> None:
    path = tmp_path_factory.mktemp("maps") / f"map{suffix}"
    elevation.save(path)
    again = ElevationMap.load(path)
    assert again.resolution == elevation.resolution
    assert again.origin == elevation.origin
    np.testing.assert_array_equal(again.known, elevation.known)
    spread = np.nanmax(elevation.heights) - np.nanmin(elevation.heights)
    # A PNG has 65534 steps over the spread; float32 adds its own rounding at 50 m.
    tolerance = 0.5 * spread / 65534 + 4e-6 if suffix == ".png" else 0.0
    np.testing.assert_allclose(again.heights, elevation.heights, rtol=0, atol=tolerance)


def test_npz_keeps_filled_heights_and_images_keep_what_was_observed(tmp_path: Path) -> None:
    filled = hilly().filled()
    for suffix in SUFFIXES:
        filled.save(tmp_path / f"map{suffix}")
        again = ElevationMap.load(tmp_path / f"map{suffix}")
        np.testing.assert_array_equal(again.known, filled.known)
        assert np.isnan(again.heights[2, 3]) == (suffix != ".npz")


def test_geotiff_is_where_other_tools_expect_it(tmp_path: Path) -> None:
    import rasterio

    elevation = ElevationMap(np.arange(12.0).reshape(4, 3), resolution=0.5, origin=(10.0, 20.0))
    elevation.save(tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as file:
        for ix, iy in np.ndindex(elevation.shape):
            (value,) = next(file.sample([elevation.centre_of(ix, iy)]))
            assert value == elevation.heights[ix, iy]


def test_png_from_elsewhere(tmp_path: Path) -> None:
    rows = np.array([[3, 4], [1, 2], [0, 7]], dtype=np.uint16)  # the first row is the north
    Image.fromarray(rows).save(tmp_path / "map.png")
    notes = {"scale": 0.5, "offset": 1.0, "resolution": 0.2, "origin": [0, 0], "unknown": 7}
    (tmp_path / "map.png.yaml").write_text(yaml.safe_dump(notes))
    heights = ElevationMap.load(tmp_path / "map.png").heights
    np.testing.assert_array_equal(heights, [[1.0, 1.5, 2.5], [np.nan, 2.0, 3.0]])


def test_flat_map_survives_png(tmp_path: Path) -> None:
    ElevationMap(np.full((3, 3), 0.7)).save(tmp_path / "map.png")
    assert (ElevationMap.load(tmp_path / "map.png").heights == np.float32(0.7)).all()


@given(data=st.data())
@settings(max_examples=40, deadline=None)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_files_are_map_errors_or_still_maps(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("maps") / f"map{suffix}"
    hilly().save(path)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    try:
        ElevationMap.load(path)
    except MapError as error:
        assert path.name in str(error)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"not a map", b"\x00" * 500])
def test_other_files_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"map{suffix}"
    hilly().save(path)
    path.write_bytes(content)
    with pytest.raises(MapError, match="write it again"):
        ElevationMap.load(path)


def test_what_a_file_must_say(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="there is no map file"):
        ElevationMap.load(tmp_path / "none.npz")
    with pytest.raises(MapError, match=r"\.npz, \.tif, \.tiff, \.png"):
        ElevationMap.load(tmp_path / "map.obj")
    with pytest.raises(MapError, match=r"\.npz, \.tif, \.tiff, \.png"):
        hilly().save(tmp_path / "map.obj")
    np.savez(tmp_path / "half.npz", heights=np.zeros((3, 3)))
    with pytest.raises(MapError, match="known"):
        ElevationMap.load(tmp_path / "half.npz")
    np.savez(tmp_path / "pickle.npz", heights=np.array([{}], dtype=object))
    with pytest.raises(MapError, match=r"pickle\.npz"):
        ElevationMap.load(tmp_path / "pickle.npz")


@pytest.mark.parametrize(
    ("notes", "message"),
    [
        (None, "a PNG holds no metres"),
        ("scale: 1", "lacks offset, origin, resolution"),
        ("", "lacks"),
        ("[1, 2", "write it again"),
        ("{scale: a, offset: 0, resolution: 1, origin: [0, 0]}", "write it again"),
        ("{scale: 1, offset: 0, resolution: 0, origin: [0, 0]}", "resolution must be"),
        ("{scale: 1, offset: 0, resolution: 1, origin: [0]}", "origin must be"),
    ],
)
def test_png_sidecar_faults(tmp_path: Path, notes: str | None, message: str) -> None:
    path = tmp_path / "map.png"
    hilly().save(path)
    sidecar = tmp_path / "map.png.yaml"
    sidecar.unlink() if notes is None else sidecar.write_text(notes)
    with pytest.raises(MapError, match=message):
        ElevationMap.load(path)


def test_colour_png_is_refused(tmp_path: Path) -> None:
    hilly().save(tmp_path / "map.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "map.png")
    with pytest.raises(MapError, match="one channel"):
        ElevationMap.load(tmp_path / "map.png")


@pytest.mark.parametrize(
    ("transform", "crs", "message"),
    [
        (None, None, "no georeference"),
        ((0.5, 0, 0, 0, -0.5, 0), "EPSG:4326", "reproject"),
        ((0.5, 0, 0, 0, -0.7, 0), None, "square cells"),
        ((0.5, 0.1, 0, 0.1, -0.5, 0), None, "north-up"),
        ((0.5, 0, 0, 0, 0.5, 0), None, "north-up"),
    ],
)
@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_geotiffs_that_do_not_fit(
    tmp_path: Path, transform: tuple | None, crs: str | None, message: str
) -> None:
    import rasterio

    place = rasterio.Affine(*transform) if transform else None
    with rasterio.open(
        tmp_path / "map.tif",
        "w",
        driver="GTiff",
        width=3,
        height=3,
        count=1,
        dtype="float32",
        transform=place,
        crs=crs,
    ) as file:
        file.write(np.zeros((3, 3), np.float32), 1)
    with pytest.raises(MapError, match=message):
        ElevationMap.load(tmp_path / "map.tif")


def test_integer_geotiff_with_nodata(tmp_path: Path) -> None:
    import rasterio

    with rasterio.open(
        tmp_path / "map.tif",
        "w",
        driver="GTiff",
        width=2,
        height=2,
        count=1,
        dtype="int16",
        nodata=-999,
        compress="lzw",
        transform=rasterio.Affine(1.0, 0, 5.0, 0, -1.0, 9.0),
    ) as file:
        file.write(np.array([[1, 2], [3, -999]], np.int16), 1)
    elevation = ElevationMap.load(tmp_path / "map.tif")
    np.testing.assert_array_equal(elevation.heights, [[3, 1], [np.nan, 2]])
    assert elevation.origin == (5.0, 7.0)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_full_disk_keeps_the_old_map(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    hilly().save(path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    big = ElevationMap(np.random.default_rng(0).normal(size=(100, 100)))
    resource, signal = pytest.importorskip("resource"), pytest.importorskip("signal")  # POSIX
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
        with pytest.raises(StorageError, match=path.name):
            big.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_save_into_a_missing_folder(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(StorageError, match="create the folder first"):
        hilly().save(tmp_path / "no" / f"map{suffix}")
