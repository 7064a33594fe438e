"""Point clouds: files of every kind, outliers, cells and their statistics, and `fgtutor map`."""

import math
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4 import Encoding, PointCloud

from fgtutor import mapping
from fgtutor.cloudfiles import read_points, save_points
from fgtutor.elevation import ElevationMap
from fgtutor.errors import CloudError, ConfigError, MapError, StorageError
from fgtutor.scanning import WALL, ScanConfig, map_points


def cloud(n: int = 200, seed: int = 0) -> np.ndarray:
    """Return random points to the millimetre, which every file format keeps."""
    return np.random.default_rng(seed).uniform((-1, 2, -0.5), (3, 5, 0.5), (n, 3)).round(3)


def sheet(nx: int = 20, ny: int = 12, *, per_cell: int = 4, seed: int = 0) -> np.ndarray:
    """Return an even sheet of points in cells of 5 cm from (0, 0), with asymmetric relief."""
    rng = np.random.default_rng(seed)
    cell = np.indices((nx, ny)).reshape(2, -1).T.repeat(per_cell, axis=0)
    xy = 0.05 * (cell + rng.uniform(0.1, 0.9, cell.shape))
    z = 0.3 * np.sin(3 * xy[:, 0]) + 0.1 * xy[:, 1] + rng.normal(0, 0.005, len(xy))
    return np.column_stack((xy, z))


# -- files -----------------------------------------------------------------------------------------


def write_ply(path: Path, points: np.ndarray) -> None:
    path.write_bytes(trimesh.PointCloud(points).export(file_type="ply"))  # pyright: ignore


def write_ascii_ply(path: Path, points: np.ndarray) -> None:
    rows = "\n".join(f"7 {x} {y} {z}" for x, y, z in points)
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty uchar intensity\n"
        f"property double x\nproperty double y\nproperty double z\nend_header\n{rows}\n"
    )


def write_pcd(encoding: Encoding) -> Callable[[Path, np.ndarray], None]:
    return lambda path, points: PointCloud.from_xyz_points(points).save(path, encoding)


def write_las(path: Path, points: np.ndarray) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), points.min(axis=0)
    las = laspy.LasData(header)
    las.xyz = points
    las.write(path)


def write_xyz(start: str, separator: str) -> Callable[[Path, np.ndarray], None]:
    def write(path: Path, points: np.ndarray) -> None:
        rows = (separator.join((*map(str, row), "255")) for row in points)
        path.write_text(start + "\n".join(rows) + "\n")

    return write


FORMATS = {
    "binary ply": ("cloud.ply", write_ply),
    "ascii ply": ("cloud.PLY", write_ascii_ply),
    "ascii pcd": ("cloud.pcd", write_pcd(Encoding.ASCII)),
    "binary pcd": ("cloud.pcd", write_pcd(Encoding.BINARY)),
    "compressed pcd": ("cloud.pcd", write_pcd(Encoding.BINARY_COMPRESSED)),
    "las": ("cloud.las", write_las),
    "laz": ("cloud.laz", write_las),
    "xyz": ("cloud.xyz", write_xyz("", " ")),
    "xyz with names": ("cloud.xyz", write_xyz("# by hand\n\nX;Y;Z;I\n", ";")),
    "xyz with commas": ("cloud.xyz", write_xyz("//X,Y,Z,I\n", ", ")),
    "npz": ("cloud.npz", lambda path, points: save_points(points, path)),
}
COUNTED = [name for name in FORMATS if "xyz" not in name]
"""The formats that say how many points they hold, or notice a missing end."""


def written(folder: Path, name: str, points: np.ndarray | None = None) -> Path:
    file, write = FORMATS[name]
    write(folder / file, cloud() if points is None else points)
    return folder / file


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_points_back(tmp_path: Path, name: str) -> None:
    points = read_points(written(tmp_path, name))
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, cloud(), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTED)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_file_cut_off_is_refused(tmp_path: Path, name: str, share: float) -> None:
    path = written(tmp_path, name)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(CloudError, match=path.name):
        read_points(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, name, cloud(20))
    raw = path.read_bytes()

    # Half of all blows fall on the header, which is where a reader can go astray.
    @settings(max_examples=3 if name in ("las", "laz") else 25)  # each LAS file takes a process
    @given(st.integers(0, 300) | st.integers(0, len(raw) - 1), st.integers(0, 255))
    def strike(place: int, value: int) -> None:
        place %= len(raw)
        path.write_bytes(raw[:place] + bytes([value]) + raw[place + 1 :])
        try:
            assert np.isfinite(read_points(path)).all()
        except CloudError as error:
            assert path.name in str(error)

    strike()


def test_a_las_file_that_would_take_the_reader_down_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "laz")
    raw = path.read_bytes()
    path.write_bytes(raw[:100] + b"\xff" * 4 + raw[104:])  # 4 billion records: laspy loops
    with pytest.raises(CloudError, match="promises 4294967295 records"):
        read_points(path)
    points = int.from_bytes(raw[96:100], "little")
    chunks = 4 + int.from_bytes(raw[points : points + 8], "little")
    assert raw[chunks : chunks + 4] == (1).to_bytes(4, "little")  # 200 points are one chunk
    path.write_bytes(raw[:chunks] + b"\xff" * 4 + raw[chunks + 4 :])  # 64 GiB: lazrs aborts
    with pytest.raises(CloudError, match="laspy could not read it"):
        read_points(path)


def test_points_without_an_echo_are_left_out(tmp_path: Path) -> None:
    points = cloud(6).astype(np.float32)
    points[1, 2], points[4] = np.nan, np.inf
    path = written(tmp_path, "binary pcd", points)
    np.testing.assert_array_equal(read_points(path), points[[0, 2, 3, 5]])
    path = written(tmp_path, "binary pcd", np.full((3, 3), np.nan, dtype=np.float32))
    with pytest.raises(CloudError, match="none of the 3 points is finite"):
        read_points(path)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cloud.obj", "v 0 0 0", r"'.obj'; point clouds are .ply, .pcd, .las"),
        ("cloud.xyz", "", "no line of numbers"),
        ("cloud.xyz", "x y z\n", "no line of numbers"),
        ("cloud.xyz", "1 2\n3 4\n", "copy or export it again"),
        ("cloud.xyz", "1 2 3\n4 five 6\n", "five"),
        ("cloud.ply", "not a ply", "corrupt or of another kind"),
        ("cloud.las", "PK", "laspy could not read it .*export it again"),
        ("cloud.npz", "PK", "corrupt or of another kind"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path: Path, file: str, text: str, message: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(CloudError, match=message):
        read_points(tmp_path / file)


def test_missing_files_folders_fields_and_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CloudError, match="check the path"):
        read_points(tmp_path / "none.ply")
    (tmp_path / "folder.las").mkdir()
    with pytest.raises(CloudError, match="check the path"):
        read_points(tmp_path / "folder.las")
    flat = PointCloud.from_points(cloud()[:, :2], ("x", "y"), (np.float32, np.float32))
    flat.save(tmp_path / "flat.pcd")
    with pytest.raises(CloudError, match="without z"):
        read_points(tmp_path / "flat.pcd")
    np.savez(tmp_path / "other.npz", heights=np.zeros((2, 2)))
    with pytest.raises(CloudError, match="'points', found heights"):
        read_points(tmp_path / "other.npz")
    np.savez(tmp_path / "flat.npz", points=np.zeros((4, 2)))
    with pytest.raises(CloudError, match=r"\(4, 2\)"):
        read_points(tmp_path / "flat.npz")
    np.savez(tmp_path / "pickle.npz", points=np.array([{}, []], dtype=object))
    with pytest.raises(CloudError, match="allow_pickle"):
        read_points(tmp_path / "pickle.npz")


def test_points_are_saved_whole_as_npz_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(CloudError, match=r"saved as \.npz"):
        save_points(cloud(), tmp_path / "cloud.ply")
    with pytest.raises(StorageError, match="create the folder"):
        save_points(cloud(), tmp_path / "missing" / "cloud.npz")
    with pytest.raises(CloudError, match="shape"):
        save_points(np.zeros(3), tmp_path / "cloud.npz")
    assert list(tmp_path.iterdir()) == []


# -- cells -----------------------------------------------------------------------------------------


def test_statistics_by_hand() -> None:
    z = np.random.default_rng(0).permutation(np.arange(1, 21)) / 100
    points = [(0.02, 0.03, h) for h in z] + [(0.12, 0.07, 0.5), (0.13, 0.08, 0.7)]
    points += [(0.06, 0.01, 9.0)]  # alone in its cell
    scanned = map_points(np.array(points), config=ScanConfig(neighbours=0, clearance=99))
    assert scanned.elevation.shape == (3, 2)
    assert scanned.elevation.origin == (0.0, 0.0)
    assert scanned.count.tolist() == [[20, 0], [1, 0], [0, 2]]
    # 19 of 20 points do not exceed 0.19, 10 of 20 do not exceed 0.10.
    assert scanned.p95[0, 0] == pytest.approx(0.19)
    assert scanned.elevation.heights[0, 0] == pytest.approx(0.10)
    assert scanned.lowest[0, 0] == pytest.approx(0.01)
    # The variance of 1..n is (n^2 - 1) / 12, here in square centimetres.
    assert scanned.variance[0, 0] == pytest.approx(399 / 12 * 1e-4, rel=1e-4)
    # The lower of two middle heights; their variance is a quarter of the squared difference.
    assert scanned.elevation.heights[2, 1] == pytest.approx(0.5)
    assert scanned.variance[2, 1] == pytest.approx(0.01)
    # One point is too few to know a cell by, yet it is reported.
    assert not scanned.elevation.known[1, 0] and scanned.lowest[1, 0] == pytest.approx(9.0)
    assert np.isnan(scanned.lowest[0, 1]) and np.isnan(scanned.elevation.heights[0, 1])


@given(
    st.integers(1, 60),
    st.integers(0, 10**6),
    st.sampled_from((0.05, 0.1, 0.02)),
    st.integers(1, 3),
    st.sampled_from((-1.0, 0.25)),
)
def test_statistics_against_a_naive_loop(
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
        if not len(z):
            assert np.isnan(scanned.variance[ix, iy])
            continue
        expected = (z.min(), *np.quantile(z, (0.95, 0.5), method="inverted_cdf"), z.var())
        found = (
            scanned.lowest[ix, iy],
            scanned.p95[ix, iy],
            # What lies beside a wall is not the median: see the tests of chasms with the scanner.
            scanned.elevation.heights[ix, iy]
            if len(z) >= least and expected[1] - expected[0] <= WALL - 2e-4
            else expected[2],
            scanned.variance[ix, iy],
        )
        assert found == pytest.approx(expected, abs=2e-4)  # heights are kept to 0.1 mm


def test_cells_begin_at_multiples_of_the_resolution_or_at_the_area() -> None:
    points = np.array([(-0.26, 1.02, 0.0), (-0.24, 1.04, 0.0), (0.31, 1.33, 0.0)]).repeat(2, axis=0)
    config = ScanConfig(resolution=0.1, neighbours=0)
    elevation = map_points(points, config=config).elevation
    assert elevation.origin == (-0.3, 1.0) and elevation.shape == (7, 4)
    elevation = map_points(points, config=config, area=(-0.25, 1.0, 0.2, 1.2)).elevation
    assert elevation.origin == (-0.25, 1.0) and elevation.shape == (5, 2)
    assert np.argwhere(elevation.known).tolist() == [[0, 0]]


def test_the_order_of_the_points_does_not_matter() -> None:
    points = sheet()
    first = map_points(points)
    second = map_points(np.random.default_rng(1).permutation(points))
    np.testing.assert_array_equal(first.elevation.heights, second.elevation.heights)
    np.testing.assert_array_equal(first.variance, second.variance)


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
    assert scanned.overhanging == 0
    assert scanned.p95[:6] - map_points(floor).p95[:6] == pytest.approx(0.75, abs=1e-3)


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
        (1e300 * cloud(), {}, "too far for voxels"),
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
        {"clearance": 0.0},
    ],
)
def test_settings_that_cannot_work_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(fields))):
        ScanConfig(**fields)


# -- the command -----------------------------------------------------------------------------------


def command(*options: object) -> mapping.MapConfig:
    return tyro.cli(mapping.MapConfig, args=[str(option) for option in options])


def test_map_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = sheet()
    path, out, statistics = (tmp_path / name for name in ("c.laz", "m.npz", "s.npz"))
    write_las(path, points[points[:, 0] > 0.2])
    options = ("--out", out, "--statistics", statistics, "--area", 0, 0, 1, 0.6)
    assert mapping.run(command(path, *options)) == 0
    elevation = ElevationMap.load(out)
    assert elevation.shape == (20, 12)
    assert not elevation.known[:4].any() and elevation.known[4:].all()
    assert np.isnan(elevation.heights[:4]).all()
    with np.load(statistics) as file:
        assert set(file) == {"count", "lowest", "p95", "variance"}
        assert file["count"].sum() == (points[:, 0] > 0.2).sum()
    printed = capsys.readouterr().out
    assert "20.0% of the cells are unknown" in printed and "4 points (median)" in printed

    assert mapping.run(command(path, *options, "--fill")) == 0
    filled = ElevationMap.load(out)
    assert np.isfinite(filled.heights).all()
    np.testing.assert_array_equal(filled.known, elevation.known)


def test_map_command_refuses_early_and_keeps_the_old_map(tmp_path: Path) -> None:
    out = tmp_path / "map.npz"
    out.write_text("old")
    with pytest.raises(CloudError, match="check the path"):
        mapping.run(command(tmp_path / "none.las", "--out", out))
    # Before it reads the cloud, which is not there either.
    with pytest.raises(StorageError, match="create the folder"):
        mapping.run(command(tmp_path / "none.las", "--out", tmp_path / "no" / "map.npz"))
    save_points(sheet(), tmp_path / "cloud.npz")
    with pytest.raises(MapError, match=r"\.bmp"):
        mapping.run(command(tmp_path / "cloud.npz", "--out", tmp_path / "map.bmp"))
    assert out.read_text() == "old"
