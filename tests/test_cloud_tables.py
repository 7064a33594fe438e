"""PLY and PCD: every way in which their headers are written, and what is not in the table."""

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_writers import DOUBLES, SPARE, cloud, pcd, ply

from fgtutor.errors import CloudError
from fgtutor.io.clouds import read_cloud
from fgtutor.world.scanning import ScanConfig, map_points

POINTS = cloud(4)
FACES = "element face 2\nproperty list uchar int vertex_indices"
FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


def faces(form: str) -> bytes:
    """Return a triangle and a square."""
    if form == "ascii":
        return b"3 0 1 2\n4 0 1 2 3\n"
    return struct.pack((">" if "big" in form else "<") + "B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)


def read(path: Path, data: bytes) -> np.ndarray:
    path.write_bytes(data)
    return read_cloud(path).points


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "cloud.ply"


@pytest.fixture
def pcd_file(tmp_path: Path) -> Path:
    return tmp_path / "cloud.pcd"


# -- PLY -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
def test_a_mesh_of_mixed_polygons_gives_its_vertices(file: Path, form: str, ends: str) -> None:
    data = ply(form, DOUBLES, POINTS, more=FACES, ends=ends) + faces(form)
    np.testing.assert_array_equal(read(file, data), POINTS)
    np.testing.assert_array_equal(read(file, data[:-3]), POINTS)  # the faces are not looked at
    assert read_cloud(file).notes == ()


@pytest.mark.parametrize("form", FORMS)
def test_other_elements_may_come_before_the_vertices(file: Path, form: str) -> None:
    head, body = ply(form, DOUBLES, POINTS).split(b"end_header\n")
    first, vertices = head.split(b"element vertex")
    order = ">" if "big" in form else "<"
    camera = b"1 2\n" if form == "ascii" else struct.pack(order + "fB", 1, 2)
    data = b"element camera 1\nproperty float f\nproperty uchar k\n" + FACES.encode() + b"\n"
    data = first + data + b"element vertex" + vertices + b"end_header\n" + camera
    np.testing.assert_array_equal(read(file, data + faces(form) + body), POINTS)


@pytest.mark.parametrize("form", FORMS)
def test_a_list_in_the_vertices_is_passed_over(file: Path, form: str) -> None:
    head, _ = ply(form, DOUBLES, POINTS).split(b"end_header\n")
    head = head.replace(b"property double z", b"property list uchar short near\nproperty double z")
    body = b""
    for count, (x, y, z) in enumerate(POINTS):
        if form == "ascii":
            body += " ".join(map(str, (x, y, count, *range(count), z))).encode() + b"\n"
        else:
            order = ">" if "big" in form else "<"
            body += struct.pack(f"{order}2dB{count}hd", x, y, count, *range(count), z)
    np.testing.assert_array_equal(read(file, head + b"end_header\n" + body), POINTS)
    with pytest.raises(CloudError, match="'vertex' 4 of 4 is cut off"):
        read(file, head + b"end_header\n" + body[:-20])


@pytest.mark.parametrize("form", FORMS)
def test_bytes_after_the_last_vertex_are_noted(file: Path, form: str) -> None:
    data = ply(form, SPARE, np.column_stack((np.full(4, 7), POINTS)))
    np.testing.assert_array_equal(read(file, data + b"tail"), POINTS)
    assert read_cloud(file).notes == ("4 bytes after the last vertex",)


def test_names_in_capitals_and_types_by_size(file: Path) -> None:
    data = ply("binary_little_endian", {"Z": "double", "X": "float", "y": "int"}, [[1, 2, 3]])
    data = (
        data.replace(b"float", b"float32").replace(b"double", b"float64").replace(b"int", b"int32")
    )
    assert read(file, data).tolist() == [[2, 3, 1]]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("element vertex 4", "element vertex 0", "none of the 0 points"),
        ("element vertex 4", "element vertex 5", "promises 5 points and 4 are there"),
        ("element vertex 4", "element vertex -1", "whole number"),
        ("element vertex 4", "element vertex 999999999999999", "4 are there"),
        ("element vertex 4", f"element vertex {10**30}", "whole number"),
        ("element vertex 4", "element corner 4", "no vertices"),
        ("double z", "double depth", "without z|'x, y, depth'"),
        ("double z", "double y", "each of x, y and z once"),
        ("double z", "quadruple z", "makes no sense: 'property quadruple z'"),
        ("format", "shape", "makes no sense"),
        ("end_header", "end_heading", "no end_header"),
        ("format binary_little_endian 1.0\n", "", "no format"),
        ("property double z", "property list int int z", "each of x, y and z once"),
    ],
)
def test_ply_headers_that_make_no_sense_are_refused(
    file: Path, old: str, new: str, message: str
) -> None:
    data = ply("binary_little_endian", DOUBLES, POINTS)
    with pytest.raises(CloudError, match=message):
        read(file, data.replace(old.encode(), new.encode()))


def test_an_ascii_row_that_is_short_is_named(file: Path) -> None:
    data = ply("ascii", DOUBLES, POINTS).split(b"\n")
    data[8] = data[8].rsplit(b" ", 1)[0]
    with pytest.raises(CloudError, match="line 9 has 2 columns, expected 3"):
        read(file, b"\n".join(data))


# -- PCD -------------------------------------------------------------------------------------------

DATA = ("ascii", "binary", "binary_compressed")


@pytest.mark.parametrize("data", DATA)
@pytest.mark.parametrize(
    "header",
    [
        {"VERSION": ".5", "VIEWPOINT": ""},
        {"VERSION": ".6"},
        {"VERSION": ".7", "COUNT": ""},
        {"FIELDS": "X Y Z"},
        {"FIELDS": "x\ty\tz"},
        {"FIELDS": "", "COLUMNS": "x y z"},
        {"POINTS": ""},
        {"WIDTH": "2", "HEIGHT": "2"},
        {"WIDTH": "", "HEIGHT": ""},
        {"TYPE": "f f f"},
    ],
)
def test_pcd_headers_as_pcl_reads_them(pcd_file: Path, data: str, header: dict) -> None:
    np.testing.assert_array_equal(read(pcd_file, pcd(data, POINTS, **header)), POINTS)


def test_pcd_headers_with_capitals_crlf_and_foreign_comments(pcd_file: Path) -> None:
    data = pcd("ascii", POINTS).replace(b"DATA ascii", b"DATA ASCII")
    data = b"# M\xfcnchen\n" + data.replace(b"\n", b"\r\n")
    np.testing.assert_array_equal(read(pcd_file, data), POINTS)


def test_the_smallest_pcd_of_version_5(pcd_file: Path) -> None:
    head = "VERSION .5\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    assert read(pcd_file, f"{head}POINTS 1\nDATA ascii\n1 2 3\n".encode()).tolist() == [[1, 2, 3]]


def test_fields_of_any_count_are_passed_over(pcd_file: Path) -> None:
    rows = np.zeros(4, [("n", "<i2", 3), ("x", "<f8"), ("y", "<f4"), ("z", "<f8"), ("e", "u1", 5)])
    rows["x"], rows["y"], rows["z"] = POINTS.T
    header = {
        "FIELDS": "n x _ y z _",
        "SIZE": "2 8 1 4 8 1",
        "TYPE": "I F U F F U",
        "COUNT": "3 1 0 1 1 5",
    }
    head = pcd("binary", POINTS[:0], WIDTH="4", POINTS="4", **header)
    np.testing.assert_allclose(read(pcd_file, head + rows.tobytes()), POINTS, atol=1e-6)
    text = "".join(f"1 2 3 {x} {y} {z} 1 2 3 4 5\n" for x, y, z in POINTS)
    head = pcd("ascii", POINTS[:0], WIDTH="4", POINTS="4", **header)
    np.testing.assert_array_equal(read(pcd_file, head + text.encode()), POINTS)


def test_words_for_no_number_are_points_without_an_echo(pcd_file: Path) -> None:
    words = ("nan", "-nan(ind)", "NaN", "-1.#IND", "inf", "nan(snan)")
    text = "1 2 3\n" + "".join(f"1 {word} 3\n" for word in words)
    head = pcd("ascii", POINTS[:0], WIDTH="7", POINTS="7")
    assert read(pcd_file, head + text.encode()).tolist() == [[1, 2, 3]]
    assert read_cloud(pcd_file).notes == ("6 points not finite",)


def test_a_viewpoint_and_what_follows_the_points_are_noted(pcd_file: Path) -> None:
    pose = "1 2 0 1 0 0 0"
    read(pcd_file, pcd("binary", POINTS, VIEWPOINT=pose) + b"tail")
    viewpoint, tail = read_cloud(pcd_file).notes
    assert pose in viewpoint and tail == "4 bytes after the last point"


@pytest.mark.parametrize("data", DATA)
@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"VERSION": "0.8"}, "version is '0.8', expected .5, .6 or .7"),
        ({"FIELDS": "x y w"}, "'x, y, w', without z"),
        ({"FIELDS": "x y"}, "2 FIELDS, but 3 SIZE"),
        ({"FIELDS": "x x z"}, "without y"),
        ({"COUNT": "1 1 1000000000"}, "one number each"),
        ({"COUNT": "1 1 -1"}, "whole number"),
        ({"SIZE": "8 8 3"}, "one number each"),
        ({"TYPE": "F F Q"}, "one number each"),
        ({"WIDTH": "3"}, "contradicts itself"),
        ({"POINTS": "", "WIDTH": ""}, "neither POINTS nor WIDTH"),
        ({"POINTS": "9" * 40}, "whole number"),
        ({"COLOUR": "red"}, "makes no sense: 'COLOUR red'"),
        ({"WIDTH": "5", "POINTS": "5"}, "promises 5 points and 4 are there|bytes of points are"),
        ({"WIDTH": "1000000000000", "POINTS": "1000000000000"}, "4 are there|bytes of points are"),
    ],
)
def test_pcd_headers_that_make_no_sense_are_refused(
    pcd_file: Path, data: str, header: dict, message: str
) -> None:
    with pytest.raises(CloudError, match=message) as caught:
        read(pcd_file, pcd(data, POINTS, **header))
    assert "http" not in str(caught.value)


def test_padding_of_a_billion_is_refused_at_once(pcd_file: Path) -> None:
    header = {
        "FIELDS": "x y z _",
        "SIZE": "4 4 4 1",
        "TYPE": "F F F U",
        "COUNT": "1 1 1 1000000000",
    }
    for data in DATA:
        with pytest.raises(CloudError, match=r"cut off|expected 1000000003|bytes of points"):
            read(pcd_file, pcd(data, POINTS, "F 4", **header))


def test_more_points_than_promised_are_not_a_file_cut_off(pcd_file: Path) -> None:
    with pytest.raises(CloudError, match="has more points than its header says, 4 instead of 3"):
        read(pcd_file, pcd("ascii", POINTS, WIDTH="3", POINTS="3"))
    with pytest.raises(CloudError, match="DATA is 'base64'"):
        read(pcd_file, pcd("base64", POINTS))


@pytest.mark.parametrize("at", [0, 4, 40])
def test_damaged_compression_is_refused(pcd_file: Path, at: int) -> None:
    data = bytearray(pcd("binary_compressed", cloud()))
    start = data.index(b"compressed\n") + 11
    data[start + at : start + at + 4] = b"\xff\xff\xff\xff"
    with pytest.raises(CloudError, match=r"cut off|bytes of points are expected|are damaged"):
        read(pcd_file, bytes(data))


# -- what 32 bits lose -----------------------------------------------------------------------------


def test_coordinates_coarser_than_the_cell_are_refused(file: Path, pcd_file: Path) -> None:
    rng = np.random.default_rng(0)
    local = np.column_stack((rng.random((40000, 2)) * 5, rng.normal(0, 0.01, 40000)))
    far = local + np.array((665171, 5648340, 233))
    single = dict.fromkeys("xyz", "float")
    np.savez(pcd_file.with_suffix(".npz"), points=far.astype(np.float32))
    pcd_file.write_bytes(pcd("binary", far, "F 4"))
    file.write_bytes(ply("binary_little_endian", single, far))
    for path in (file, pcd_file, pcd_file.with_suffix(".npz")):
        with pytest.raises(CloudError, match=r"steps of 0\.5 m.*subtract an offset.*doubles"):
            map_points(read_cloud(path))
    with pytest.raises(CloudError, match="subtract an offset"):
        map_points(far.astype(np.float32))
    # One coarse coordinate is enough.
    file.write_bytes(ply("binary_little_endian", DOUBLES | {"y": "float"}, far))
    with pytest.raises(CloudError, match="subtract an offset"):
        map_points(read_cloud(file))
    file.write_bytes(ply("binary_little_endian", DOUBLES, far))
    assert map_points(read_cloud(file)).count.sum() == 40000
    file.write_bytes(ply("binary_little_endian", single, local))
    assert map_points(read_cloud(file)).count.sum() == 40000


@pytest.mark.parametrize("step", [0.05, 0.1, 0.02])
def test_decimals_in_32_bits_lie_in_the_cells_of_their_decimals(
    pcd_file: Path, step: float
) -> None:
    x, y = np.indices((60, 60)).reshape(2, -1).repeat(2, axis=1) * step
    pcd_file.write_bytes(pcd("binary", np.column_stack((x, y, x > 1)), "F 4"))
    config = ScanConfig(resolution=step)
    assert (map_points(read_cloud(pcd_file), config=config).count == 2).all()
