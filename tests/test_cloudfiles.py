"""Point clouds from files: what all formats have in common, and .npz."""

import resource
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from cloud_writers import FORMATS, cloud, las, pcd, written
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtutor.errors import CloudError
from fgtutor.io.cloud import cloud_of
from fgtutor.io.clouds import read_cloud
from fgtutor.world.scanning import map_points

COUNTED = [name for name in FORMATS if "xyz" not in name]
"""The formats that say how many points they hold, or notice a missing end."""


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_points_back(tmp_path: Path, name: str) -> None:
    read = read_cloud(written(tmp_path, name))
    assert read.points.dtype == np.float64 and read.notes == ()
    np.testing.assert_allclose(read.points, cloud(), atol=1e-6)


@pytest.mark.parametrize("name", COUNTED)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_file_cut_off_is_refused(tmp_path: Path, name: str, share: float) -> None:
    path = written(tmp_path, name)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(CloudError, match=path.name):
        read_cloud(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, name, cloud(20))
    raw = path.read_bytes()

    # Half of all blows fall on the header, which is where a reader can go astray.
    @settings(max_examples=25)
    @given(st.integers(0, 300) | st.integers(0, len(raw) - 1), st.integers(0, 255))
    def strike(place: int, value: int) -> None:
        place %= len(raw)
        path.write_bytes(raw[:place] + bytes([value]) + raw[place + 1 :])
        try:
            assert np.isfinite(read_cloud(path).points).all()
        except CloudError as error:
            assert path.name in str(error)

    strike()


def test_points_without_an_echo_are_left_out_and_counted(tmp_path: Path) -> None:
    points = cloud(6)
    points[1, 2], points[4] = np.nan, np.inf
    for name in ("binary pcd", "ascii pcd", "binary ply", "xyz"):
        read = read_cloud(written(tmp_path, name, points))
        np.testing.assert_array_equal(read.points, points[[0, 2, 3, 5]])
        assert read.notes == ("2 points not finite",)
    path = written(tmp_path, "binary pcd", np.full((3, 3), np.nan))
    with pytest.raises(CloudError, match="none of the 3 points is finite"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cloud.obj", "v 0 0 0", r"'.obj'; point clouds are .ply, .pcd, .las"),
        ("cloud.ply", "not a ply", "corrupt or of another kind"),
        ("cloud.las", "PK", "no LAS file.*export it again"),
        ("cloud.npz", "PK", "corrupt or of another kind"),
    ],
)
def test_bad_files_say_what_is_wrong(tmp_path: Path, file: str, text: str, message: str) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(CloudError, match=message):
        read_cloud(tmp_path / file)


def test_missing_files_folders_and_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CloudError, match="check the path"):
        read_cloud(tmp_path / "none.ply")
    (tmp_path / "folder.las").mkdir()
    with pytest.raises(CloudError, match="check the path"):
        read_cloud(tmp_path / "folder.las")
    np.savez(tmp_path / "other.npz", heights=np.zeros((2, 2)))
    with pytest.raises(CloudError, match=r"expected points\.npy, this file holds 'heights.npy'"):
        read_cloud(tmp_path / "other.npz")
    np.savez(tmp_path / "flat.npz", points=np.zeros((4, 2)))
    with pytest.raises(CloudError, match=r"\(4, 2\)"):
        read_cloud(tmp_path / "flat.npz")
    np.savez(tmp_path / "pickle.npz", points=np.array([{}, []], dtype=object))
    with pytest.raises(CloudError, match="pickled objects"):
        read_cloud(tmp_path / "pickle.npz")


def test_a_file_that_the_system_keeps_back_is_not_called_corrupt(tmp_path: Path) -> None:
    # Even root gets an input/output error from /proc/self/mem at address 0.
    (tmp_path / "cloud.xyz").symlink_to("/proc/self/mem")
    with pytest.raises(CloudError, match=r"cannot read .*cloud\.xyz: Input/output error") as caught:
        read_cloud(tmp_path / "cloud.xyz")
    assert "corrupt" not in str(caught.value)


def test_npz_keeps_orders_and_types(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npz"
    for points in (np.asfortranarray(cloud()), cloud().astype(">f4"), cloud().astype(np.int16)):
        np.savez_compressed(path, points=points, other=np.zeros(3))
        np.testing.assert_array_equal(read_cloud(path).points, points.astype(float))


@pytest.mark.parametrize("shape", ["(130000000, 3)", "(4, 3)", "(99999999999999999999, 3)"])
def test_an_npz_that_claims_more_than_it_holds_takes_no_memory(tmp_path: Path, shape: str) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    for zeros in (0, 300):  # the second is a bomb: 300 MB in 300 kB
        path = tmp_path / "cloud.npz"
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
            file.open("points.npy", "w") as member,
        ):
            member.write(start)
            for _ in range(zeros):
                member.write(bytes(10**6))
        with pytest.raises(CloudError, match=r"promised, it was cut off|fill the memory"):
            read_cloud(path)


def test_an_honest_cloud_of_ten_million_points_is_no_bomb(tmp_path: Path) -> None:
    # To the centimetre and in order, which compresses better than scans do.
    points = np.arange(3_000_000, dtype=float).reshape(-1, 3).round(2) % 100
    path = tmp_path / "cloud.npz"
    np.savez_compressed(path, points=points)
    assert path.stat().st_size < points.nbytes / 20
    assert len(read_cloud(path).points) == 1_000_000


# -- arrays ----------------------------------------------------------------------------------------


def test_masked_rows_are_no_points() -> None:
    points = np.ma.masked_equal(np.array([[0, 0, 1], [1, 2, -9999], [0.01, 0, 1]]), -9999)
    read = cloud_of(points)
    assert read.points.tolist() == [[0, 0, 1], [0.01, 0, 1]]
    assert read.notes == ("1 point not finite",)
    scanned = map_points(points)
    assert scanned.count.sum() == 2 and scanned.elevation.heights[0, 0] == 1


@pytest.mark.parametrize(
    "points",
    [
        np.ones((4, 3), dtype=complex),
        np.ones((4, 3), dtype=bool),
        np.ones((4, 3), dtype="datetime64[s]"),
        np.ones((4, 3), dtype=object),
        np.full((4, 3), "1"),
        [[1, 2, 3], [1, 2]],
        None,
    ],
)
def test_what_is_no_array_of_real_numbers_is_refused(points: object, tmp_path: Path) -> None:
    with pytest.raises(CloudError, match=r"points (hold|is no array)"):
        map_points(points)  # pyright: ignore[reportArgumentType]
    if isinstance(points, np.ndarray) and points.dtype != object:
        np.savez(tmp_path / "cloud.npz", points=points)
        with pytest.raises(CloudError, match="real numbers"):
            read_cloud(tmp_path / "cloud.npz")


@pytest.mark.parametrize("name", ["laz", "las", "npz", "compressed pcd"])
def test_no_code_of_the_working_folder_runs(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, name)
    modules = [*sys.stdlib_module_names, "laspy", "lazrs", "numpy", "lzf"]
    for module in modules:
        (tmp_path / f"{module}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert len(read_cloud(path).points) == 200
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("suffix", [".las", ".laz", ".pcd"])
def test_a_claim_of_many_points_takes_no_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    if suffix == ".pcd":
        path.write_bytes(pcd("binary", cloud(), COUNT="1 1 1000000000"))
    else:
        las(path, cloud(), form=6)
        raw = bytearray(path.read_bytes())
        raw[247:255] = (150_000_000).to_bytes(8, "little")
        path.write_bytes(raw)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CloudError, match=r"cut off|fill the memory|one number each"):
        read_cloud(path)
    taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert taken < 50_000, f"{taken} kB"
