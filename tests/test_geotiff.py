"""GeoTIFF: what a raster says of its numbers is obeyed, or the raster is refused."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from fgtutor.elevation import ElevationMap
from fgtutor.errors import MapError

FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937


def geotiff(path: Path, values: object, *, place: tuple | None = None, **change: object) -> Path:
    """Write bands [band, row, column] (or one) as a GeoTIFF, with what `change` says of them."""
    import rasterio

    bands = np.asarray(values)
    bands = bands[None] if bands.ndim == 2 else bands
    told = {name: change.pop(name, None) for name in ("scales", "offsets", "units", "colorinterp")}
    tags, mask = change.pop("tags", {}), change.pop("mask", None)
    profile = {"width": bands.shape[2], "height": bands.shape[1], "count": len(bands)}
    place = rasterio.Affine(*(place or (2, 0, 500000, 0, -2, 4649776)))
    profile |= {"dtype": bands.dtype.name, "transform": place, "driver": "GTiff"}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", **(profile | change)) as file,
    ):
        file.update_tags(**tags)
        for name, value in told.items():
            if value is not None:
                setattr(file, name, value)
        file.write(bands)
        if mask is not None:
            file.write_mask(np.asarray(mask))
    return path


def test_geotiff_is_where_other_tools_expect_it(tmp_path: Path) -> None:
    import rasterio

    elevation = ElevationMap(np.arange(12.0).reshape(4, 3), resolution=0.5, origin=(10.0, 20.0))
    elevation.save(tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as file:
        for ix, iy in np.ndindex(elevation.shape):
            (value,) = next(file.sample([elevation.centre_of(ix, iy)]))
            assert value == elevation.heights[ix, iy]


@pytest.mark.parametrize(
    ("transform", "crs", "message"),
    [
        (None, None, "no georeference"),
        ((0.5, 0, 0, 0, -0.5, 0), "EPSG:4326", "in degrees"),
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


# -- what a raster says of its numbers -------------------------------------------------------------

GRID = np.array([[100, 101, 102], [103, 104, 105]], np.float32)
"""Two rows from north to south; so the cell (0, 0) holds 103."""


@pytest.mark.parametrize("kind", ["int8", "uint8", "int16", "uint16", "int32", "uint32", "int64"])
def test_scale_and_offset_of_whole_numbers(tmp_path: Path, kind: str) -> None:
    path = geotiff(tmp_path / "m.tif", GRID.astype(kind), scales=(0.01,), offsets=(100.0,))
    expected = np.float32(100 + 0.01 * np.array([[103, 100], [104, 101], [105, 102]]))
    np.testing.assert_array_equal(ElevationMap.load(path).heights, expected)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        *((word, 1.0) for word in ("m", "metre", "Meter", " metres ", "")),
        *((word, FOOT) for word in ("ft", "foot", "Feet")),
        *((word, SURVEY_FOOT) for word in ("US survey foot", "us-ft", "ftUS")),
        *(("dm", 0.1), ("cm", 0.01), ("centimetre", 0.01), ("mm", 0.001), ("km", 1000.0)),
    ],
)
def test_heights_are_in_the_unit_of_the_band(tmp_path: Path, unit: str, metres: float) -> None:
    values = GRID / 10
    path = geotiff(tmp_path / "m.tif", values, units=(unit,), crs="EPSG:32631", offsets=(5.0,))
    loaded = ElevationMap.load(path)
    np.testing.assert_allclose(loaded.heights, metres * (5 + values[::-1].T), rtol=1e-6)
    assert loaded.resolution == 2.0 and loaded.origin == (500000.0, 4649772.0)


@pytest.mark.parametrize(
    ("crs", "units", "plane", "up"),
    [
        *((f"EPSG:{code}", ("m",), SURVEY_FOOT, 1.0) for code in (2263, 6529, 2229)),
        ("EPSG:2994", ("ft",), FOOT, FOOT),
        ("EPSG:2263+6360", None, SURVEY_FOOT, SURVEY_FOOT),
        ("EPSG:2263+5703", None, SURVEY_FOOT, 1.0),
        ("EPSG:32631+6360", None, 1.0, SURVEY_FOOT),
        ("EPSG:32631+6360", ("m",), 1.0, 1.0),  # the band's word is nearer to the numbers
        ("EPSG:27700", None, 1.0, 1.0),
        ('LOCAL_CS["hall",UNIT["metre",1]]', None, 1.0, 1.0),
        ('LOCAL_CS["hall",UNIT["foot",0.3048]]', ("m",), FOOT, 1.0),
    ],
)
def test_a_plane_in_feet_becomes_metres(tmp_path: Path, crs, units, plane, up) -> None:
    loaded = ElevationMap.load(geotiff(tmp_path / "m.tif", GRID, crs=crs, units=units))
    assert loaded.resolution == pytest.approx(2 * plane, rel=1e-12)
    assert loaded.origin == pytest.approx((500000 * plane, 4649772 * plane), abs=1e-8)
    np.testing.assert_allclose(loaded.heights, up * GRID[::-1].T, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"crs": "EPSG:2263"}, "US survey foot of 0.3048006 m and the unit of its heights"),
        ({"crs": "EPSG:2994"}, r"foot of 0\.3048 m"),
        ({"crs": "EPSG:3857"}, "stretches lengths"),
        ({"crs": "EPSG:4326"}, "degrees"),
        ({"crs": "EPSG:4326+5773"}, "degrees"),
        ({"crs": "EPSG:4978"}, "geocentric"),
        ({"crs": "EPSG:32631+5715"}, "depth"),
        ({"units": ("kelvin",)}, "'kelvin'"),
        ({"units": ("fathom",)}, "'fathom'"),
        ({"scales": (0.0,)}, "scale 0.0"),
        ({"scales": (math.nan,)}, "scale nan"),
        ({"offsets": (math.inf,)}, "offset inf"),
        ({"place": (1 / 3600, 0, 7, 0, -1 / 3600, 51)}, "1'' in all likelihood"),
        ({"place": (1 / 120, 0, 7, 0, -1 / 120, 51)}, "30'' in all likelihood"),
        ({"place": (1e-5, 0, 7, 0, -1e-5, 51), "crs": "EPSG:32631"}, "resolution: should be"),
        ({"place": (2, 0, 0, 0, -2.02, 0)}, "square cells"),
        ({"nodata": -1.0, "offsets": (3e4,)}, "check the unit"),
    ],
)
def test_a_raster_that_cannot_be_obeyed_is_refused(tmp_path: Path, change, message) -> None:
    with pytest.raises(MapError, match=message):
        ElevationMap.load(geotiff(tmp_path / "m.tif", GRID, **change))


@pytest.mark.parametrize(
    ("bands", "change", "message"),
    [
        (np.zeros((3, 3, 3), np.uint8), {"photometric": "RGB"}, "3 .red, green, blue.*-b 1"),
        (np.zeros((4, 3, 3), np.uint8), {"photometric": "RGB", "alpha": "YES"}, "4 .red"),
        (np.zeros((2, 3, 3), np.float32), {}, "has one band, this raster has 2"),
        (np.zeros((1, 3, 3), np.uint8), {"photometric": "PALETTE"}, "picture .palette"),
        (np.zeros((1, 3, 3), np.complex64), {}, "real numbers.*complex64"),
    ],
)
def test_a_raster_that_is_no_elevation_is_refused(tmp_path: Path, bands, change, message) -> None:
    with pytest.raises(MapError, match=message):
        ElevationMap.load(geotiff(tmp_path / "m.tif", bands, **change))


def test_a_tiff_of_several_pages_is_refused(tmp_path: Path) -> None:
    geotiff(tmp_path / "m.tif", GRID)
    geotiff(tmp_path / "m.tif", GRID, APPEND_SUBDATASET="YES")
    with pytest.raises(MapError, match="2 rasters"):
        ElevationMap.load(tmp_path / "m.tif")


def test_mask_nodata_alpha_and_nan_are_unknown_together(tmp_path: Path) -> None:
    values, mask = GRID.copy(), np.full(GRID.shape, 255, np.uint8)
    values[0, 0], values[0, 1], mask[0, 2] = np.nan, -7, 0
    expected = [[True, False], [True, False], [True, False]]
    path = geotiff(tmp_path / "m.tif", values, nodata=-7, mask=mask)
    assert ElevationMap.load(path).known.tolist() == expected
    values[0, 0] = -7
    alpha = np.stack([values, mask]).astype(np.int16)
    path = geotiff(tmp_path / "a.tif", alpha, nodata=-7, alpha="YES", offsets=(9.0, 0.0))
    loaded = ElevationMap.load(path)
    assert loaded.known.tolist() == expected and loaded.heights[0, 0] == 112


@pytest.mark.parametrize(
    ("kind", "nodata"),
    [
        ("float32", math.nan),
        ("float32", -3.4028234663852886e38),
        ("float64", -1.7976931348623157e308),
        ("int16", -32768),
        ("uint16", 65535),
        ("int32", -(2**31)),
    ],
)
def test_no_data_at_the_end_of_a_type(tmp_path: Path, kind: str, nodata: float) -> None:
    values = GRID.astype(kind)
    values[1, 0] = nodata
    loaded = ElevationMap.load(geotiff(tmp_path / "m.tif", values, nodata=nodata))
    assert loaded.known.tolist() == [[False, True], [True, True], [True, True]]
    values[0, 0] = nodata if kind != "float32" else 1e38
    with pytest.raises(MapError, match="declare it in the file"):
        ElevationMap.load(geotiff(tmp_path / "m.tif", values))


def test_no_data_outside_of_a_type_is_nowhere(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "m.tif", GRID.astype(np.uint8), nodata=255)
    path.write_bytes(path.read_bytes().replace(b"255\0", b"-99\0"))
    assert ElevationMap.load(path).known.all()


def test_a_point_raster_lies_half_a_cell_lower(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "m.tif", GRID, tags={"AREA_OR_POINT": "Point"}, crs="EPSG:32631")
    # GDAL writes the centre of the first cell then, and gives its corner again.
    assert struct.pack("<dd", 500001, 4649775) in path.read_bytes()
    assert ElevationMap.load(path).origin == (500000.0, 4649772.0)


def test_overviews_are_not_read(tmp_path: Path) -> None:
    import rasterio

    values = np.arange(64 * 64, dtype=np.float32).reshape(64, 64)
    path = geotiff(tmp_path / "m.tif", values)
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2, 4])
    np.testing.assert_array_equal(ElevationMap.load(path).heights, values[::-1].T)


def test_large_heights_keep_their_digits(tmp_path: Path) -> None:
    values = np.array([[4000.001, 4000.002], [4000.003, 4000.004]])
    path = geotiff(tmp_path / "m.tif", values * 1e6, scales=(1e-6,))
    np.testing.assert_allclose(ElevationMap.load(path).heights, values[::-1].T, atol=2.5e-4)
