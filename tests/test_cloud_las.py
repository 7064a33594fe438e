"""LAS and LAZ: units, noise and withheld points, headers that lie, and what is told of it."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from cloud_writers import cloud, geokeys, las
from rasterio.crs import CRS

from fgtutor.errors import CloudError
from fgtutor.io.clouds import read_cloud
from fgtutor.world.scanning import ScanConfig, map_points

FOOT, US_FOOT = 0.3048, 1200 / 3937
UTM, LONG_ISLAND, NAVD88_FEET = 32631, 2263, 6360


def wkt(*codes: int) -> tuple[int, bytes]:
    """Return the record of a reference system, or of one for x and y and one for z."""
    parts = [CRS.from_epsg(code).to_wkt() for code in codes]
    text = parts[0] if len(parts) == 1 else f'COMPD_CS["both",{",".join(parts)}]'
    return 2112, text.encode() + b"\0"


def doubles(*values: float) -> tuple[int, bytes]:
    return 34736, struct.pack(f"<{len(values)}d", *values)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("form", range(11))
def test_every_point_format_gives_what_laspy_gives(tmp_path: Path, suffix: str, form: int) -> None:
    path = tmp_path / f"cloud{suffix}"
    if form in (4, 5, 9, 10) and suffix == ".laz":
        form = 3  # lazrs writes no waveforms
    las(path, cloud(), form=form, scale=0.0007)
    np.testing.assert_array_equal(read_cloud(path).points, laspy.read(path).xyz)


@pytest.mark.parametrize("version", ["1.2", "1.3", "1.4"])
def test_extra_bytes_and_many_blocks(tmp_path: Path, version: str) -> None:
    for suffix in (".las", ".laz"):
        path = tmp_path / f"cloud{suffix}"
        header = laspy.LasHeader(point_format=1, version=version)
        header.add_extra_dim(laspy.ExtraBytesParams("deviation", "f4"))
        header.scales = np.full(3, 0.001)
        file = laspy.LasData(header)
        file.x, file.y, file.z = cloud(150_000).T
        file.classification = np.arange(150_000) % 8
        file.write(path)
        read = read_cloud(path)
        np.testing.assert_array_equal(read.points, file.xyz[np.arange(150_000) % 8 != 7])
        assert read.notes == ("18750 points of the noise classes 7 and 18",)


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("records", "plane", "up"),
    [
        ((geokeys((1024, 0, 1), (3072, 0, LONG_ISLAND), (3076, 0, 9003)),), US_FOOT, US_FOOT),
        ((geokeys((3072, 0, LONG_ISLAND)),), US_FOOT, US_FOOT),
        ((geokeys((3072, 0, 2994)),), FOOT, FOOT),
        ((geokeys((3076, 0, 9002)),), FOOT, FOOT),
        ((geokeys((3072, 0, UTM)),), 1, 1),
        ((geokeys((3072, 0, UTM), (4099, 0, 9003)),), 1, US_FOOT),
        ((geokeys((3072, 0, LONG_ISLAND), (4099, 0, 9001)),), US_FOOT, 1),
        ((geokeys((3072, 0, LONG_ISLAND), (4096, 0, 5703)),), US_FOOT, 1),
        ((geokeys((3072, 0, UTM), (4096, 0, NAVD88_FEET)),), 1, US_FOOT),
        ((geokeys((3072, 0, LONG_ISLAND), (4096, 0, 5103)),), US_FOOT, US_FOOT),  # a datum
        ((geokeys((3072, 0, 32767), (3076, 0, 32767), (3077, 34736, 1)), doubles(9, 2)), 2, 2),
        ((geokeys((3072, 0, 32767)),), 1, 1),
        ((geokeys(),), 1, 1),
        ((wkt(LONG_ISLAND),), US_FOOT, US_FOOT),
        ((wkt(LONG_ISLAND, NAVD88_FEET),), US_FOOT, US_FOOT),
        ((wkt(LONG_ISLAND, 5703),), US_FOOT, 1),
        ((wkt(UTM, NAVD88_FEET),), 1, US_FOOT),
        ((wkt(UTM),), 1, 1),
        (((2112, b'LOCAL_CS["site",UNIT["foot",0.3048]]'),), FOOT, FOOT),
        (((2112, CRS.from_epsg(2994).to_wkt(version="WKT2_2019").encode()),), FOOT, FOOT),
        (((2112, b"\0\0"),), 1, 1),
        # The header's bit says which of two counts.
        ((wkt(2994), geokeys((3072, 0, UTM))), FOOT, FOOT),
    ],
)
def test_units_are_those_of_the_projection_records(
    tmp_path: Path, records: tuple, plane: float, up: float
) -> None:
    path = tmp_path / "cloud.las"
    las(path, cloud(), records=records, wkt=True)
    read = read_cloud(path)
    np.testing.assert_allclose(read.points, cloud() * (plane, plane, up), rtol=1e-12, atol=1e-12)
    assert (plane, up) == (1, 1) or "converted to metres" in read.notes[0]
    assert (plane, up) != (1, 1) or read.notes == ()


def test_geokeys_count_if_the_header_does_not_say_that_wkt_does(tmp_path: Path) -> None:
    records = wkt(2994), geokeys((3072, 0, UTM))
    las(tmp_path / "cloud.las", cloud(), records=records, form=1, version="1.2")
    assert read_cloud(tmp_path / "cloud.las").notes == ()


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (geokeys((1024, 0, 2), (2048, 0, 4326)), "degrees"),
        (geokeys((2048, 0, 4326), (2054, 0, 9102)), "degrees"),
        (geokeys((3072, 0, 4326)), "degrees .*WGS 84"),
        (geokeys((1024, 0, 3)), "geocentric"),
        (geokeys((3072, 0, 3857)), "stretches"),
        (geokeys((3072, 0, UTM), (4096, 0, 5715)), "depth .*turn its sign"),
        (wkt(UTM, 5715), "depth .*turn its sign"),
        (geokeys((3072, 0, 1)), "not known .*convert to metres"),
        (geokeys((3076, 0, 9099)), "unit 9099 .* is not known"),
        (geokeys((3076, 0, 32767)), "unit 32767 .* is not known"),
        (geokeys((4099, 0, 9099)), "unit 9099 .* is not known"),
        (wkt(4326), "degrees"),
        (wkt(6318, 5703), "degrees"),
        (wkt(4978), "geocentric"),
        ((2112, b'PROJCS["half'), "is not known"),
    ],
)
def test_what_is_no_length_on_a_plane_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], record: tuple, message: str
) -> None:
    las(tmp_path / "cloud.las", cloud(), records=(record,), wkt=True)
    with pytest.raises(CloudError, match=message):
        read_cloud(tmp_path / "cloud.las")
    assert capfd.readouterr() == ("", "")  # GDAL likes to print


def test_a_step_in_feet_is_as_high_as_in_metres(tmp_path: Path) -> None:
    points = np.random.default_rng(0).random((20000, 3)) * (4, 4, 0)
    points[:, 2] = np.where(points[:, 0] > 2, 0.15, 0)
    keys = geokeys((1024, 0, 1), (3072, 0, LONG_ISLAND), (3076, 0, 9003))
    path = tmp_path / "feet.las"
    las(path, points / US_FOOT, form=0, version="1.2", records=(keys,))
    elevation = map_points(read_cloud(path)).elevation
    assert elevation.size == pytest.approx((4, 4))
    assert np.nanmax(elevation.heights) == pytest.approx(0.15, abs=2e-4)


# -- points that are none --------------------------------------------------------------------------


def ground_and_noise() -> np.ndarray:
    rng = np.random.default_rng(0)
    ground = np.column_stack((rng.random((60000, 2)) * 5, np.full(60000, 100.0)))
    below = np.column_stack((2 + rng.random((400, 2)) * 0.5, np.full(400, 95.0)))
    return np.concatenate((ground, below))


@pytest.mark.parametrize("form", [0, 6])
@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"classification": 7}, "400 points of the noise classes 7 and 18"),
        ({"classification": 18}, "400 points of the noise classes 7 and 18"),
        ({"withheld": 1}, "400 withheld points"),
        ({"withheld": 1, "classification": 7}, "400 withheld points"),
    ],
)
def test_noise_and_withheld_points_are_left_out(
    tmp_path: Path, form: int, suffix: str, fields: dict, words: str
) -> None:
    points, path = ground_and_noise(), tmp_path / f"noise{suffix}"
    last = np.arange(len(points)) >= 60000
    las(path, points, form=form, **{name: last * np.uint8(v) for name, v in fields.items()})
    read = read_cloud(path)
    assert len(read.points) == 60000 and read.notes == (words,)
    scanned = map_points(read, config=ScanConfig(resolution=0.1))
    assert scanned.overhanging == 0
    assert np.nanmin(scanned.elevation.heights) == pytest.approx(100.0)


@pytest.mark.parametrize("form", [0, 6])
def test_ground_seen_twice_and_points_of_models_are_kept(tmp_path: Path, form: int) -> None:
    marks = {"classification": np.arange(200) % 7}
    flags = ("synthetic", "key_point", *(("overlap",) if form == 6 else ()))
    marks |= dict.fromkeys(flags, np.ones(200, np.uint8))
    las(tmp_path / "cloud.las", cloud(), form=form, **marks)
    assert len(read_cloud(tmp_path / "cloud.las").points) == 200
    las(tmp_path / "cloud.las", cloud(), form=form, classification=np.full(200, 12))
    assert len(read_cloud(tmp_path / "cloud.las").points) == 200


def test_a_cloud_of_noise_is_none(tmp_path: Path) -> None:
    las(tmp_path / "cloud.las", cloud(), classification=np.full(200, 7))
    with pytest.raises(CloudError, match="no point is left: 200 points of the noise classes"):
        read_cloud(tmp_path / "cloud.las")


def test_decimal_scales_finer_than_the_cell_serve_and_coarser_ones_do_not(tmp_path: Path) -> None:
    x, y = np.indices((40, 40)).reshape(2, -1).repeat(2, axis=1) * 0.05
    las(tmp_path / "cloud.las", np.column_stack((x, y, x > 1)), scale=0.01)
    assert (map_points(read_cloud(tmp_path / "cloud.las")).count == 2).all()
    las(tmp_path / "cloud.las", np.column_stack((x, y, x > 1)) * 20, scale=1.0)
    with pytest.raises(CloudError, match=r"steps of 1 m, too coarse for cells of 0\.05 m: .*scale"):
        map_points(read_cloud(tmp_path / "cloud.las"))


# -- headers that lie ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at", "layout", "value", "message"),
    [
        (0, "4s", b"LASX", "no LAS file"),
        (24, "B", 2, "version is 2.4"),
        (25, "B", 9, "version is 1.9"),
        (94, "H", 100, "shorter than that of LAS 1.4"),
        (94, "H", 60000, "do not fit into the file"),
        (96, "I", 2**32 - 1, "do not fit into the file"),
        (96, "I", 100, "do not fit into the file"),
        (100, "I", 2**32 - 1, "promises 4294967295 records"),
        (104, "B", 44, "point format 44"),
        (105, "H", 19, "records of 19 bytes"),
        (131, "d", 0.0, r"scales \[0.0"),
        (131, "d", np.nan, r"scales \[nan"),
        (139, "d", np.inf, "scales"),
        (155, "d", -np.inf, "offsets"),
        (163, "d", 1e308, "offsets"),
        (235, "QI", (2**63, 3), "promises 3 records"),
        (247, "Q", 2**62, "promises 4611686018427387904 points"),
        (247, "Q", 201, "promises 201 points and 200 are there"),
    ],
)
def test_absurd_headers_are_refused(
    tmp_path: Path, at: int, layout: str, value: object, message: str
) -> None:
    path = tmp_path / "cloud.las"
    las(path, cloud(), form=6)
    raw = bytearray(path.read_bytes())
    struct.pack_into(f"<{layout}", raw, at, *(value if isinstance(value, tuple) else (value,)))
    path.write_bytes(raw)
    with pytest.raises(CloudError, match=message):
        read_cloud(path)


def test_a_laz_file_that_would_take_the_reader_down_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    las(path, cloud())
    raw = path.read_bytes()
    points = int.from_bytes(raw[96:100], "little")
    chunks = 4 + int.from_bytes(raw[points : points + 8], "little")
    assert raw[chunks : chunks + 4] == (1).to_bytes(4, "little")  # 200 points are one chunk
    path.write_bytes(raw[:chunks] + b"\xff" * 4 + raw[chunks + 4 :])  # 64 GiB: lazrs aborts
    with pytest.raises(CloudError, match=r"lazrs could not decompress it .*export it again"):
        read_cloud(path)
    record = raw.index(b"laszip encoded") - 2 + 54
    path.write_bytes(raw[: record + 36] + b"\xff\xff" + raw[record + 38 :])
    with pytest.raises(CloudError, match="does not describe the points"):
        read_cloud(path)
