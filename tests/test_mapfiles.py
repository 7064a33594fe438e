"""Files of elevation maps: what they say is obeyed or refused, and nothing is half written."""

import contextlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from test_elevation import hilly, maps

from fgtutor.elevation import ElevationMap
from fgtutor.errors import MapError, StorageError

SUFFIXES = (".npz", ".tif", ".png")


@st.composite
def far_maps(draw: st.DrawFn) -> ElevationMap:
    """Draw a map whose origin is that of a UTM survey, to the centimetre."""
    near = draw(maps())
    places = (st.integers(100_000_00, 900_000_00), st.integers(0, 10_000_000_00))
    origin = tuple(draw(place) / 100 for place in places)
    return ElevationMap(near.heights, resolution=near.resolution, origin=origin)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_map_just_below_the_origin_is_in_its_place(tmp_path: Path, suffix: str) -> None:
    elevation = ElevationMap(np.arange(12.0).reshape(4, 3), resolution=1.0, origin=(0.0, -3.0))
    elevation.save(tmp_path / f"m{suffix}")
    assert ElevationMap.load(tmp_path / f"m{suffix}").extent == elevation.extent


@given(st.one_of(maps(), far_maps()))
@settings(max_examples=40, deadline=None)
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
        ("scale: 1", r"map\.png\.yaml: offset: field required"),
        ("", "must hold lines such as"),
        ("[1, 2", "write it again"),
        ("{scale: a, offset: 0, resolution: 1, origin: [0, 0]}", "scale: should be a valid number"),
        ("{scale: 1, offset: 0, resolution: 0, origin: [0, 0]}", "resolution: should be"),
        ("{scale: 1, offset: 0, resolution: 1, origin: [0]}", "origin.1: field required"),
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


def spoilt_npz(path: Path, **change: object) -> None:
    parts = {"heights": np.zeros((3, 3)), "known": np.ones((3, 3), bool), "resolution": 0.1}
    parts |= {"origin": (0.0, 0.0)} | change
    np.savez(path, **{name: part for name, part in parts.items() if part is not None})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extra": 1}, "this file holds .*extra"),
        ({"known": None}, "known.npy"),
        ({"heights": np.zeros((3, 3), complex)}, "heights.npy holds complex128"),
        ({"heights": np.array([[{}] * 2] * 2)}, "heights.npy holds object"),
        ({"heights": np.zeros((3, 3), "U4")}, "heights.npy holds <U4"),
        ({"heights": np.zeros((3, 3), "M8[s]")}, "heights.npy holds datetime64"),
        ({"heights": np.zeros((3, 3), [("x", "f4")])}, "heights.npy holds"),
        ({"known": np.ones((3, 3))}, "known.npy holds float64, no truths"),
        ({"known": np.ones((2, 3), bool)}, "known has shape"),
        ({"resolution": [0.1]}, "must be one number"),
        ({"resolution": math.nan}, "resolution: should be"),
        ({"origin": [[0.0], [1.0]]}, "the origin two"),
        ({"origin": [0.0]}, "the origin two"),
        ({"origin": ["a", "b"]}, "origin.npy holds <U1"),
    ],
)
def test_npz_files_that_do_not_fit(tmp_path: Path, change: dict, message: str) -> None:
    spoilt_npz(tmp_path / "m.npz", **change)
    with pytest.raises(MapError, match=message) as caught:
        ElevationMap.load(tmp_path / "m.npz")
    assert str(caught.value).startswith(str(tmp_path / "m.npz"))


@pytest.mark.parametrize("what", ["encrypted", "open bracket", "beyond 64 bits", "checksum"])
def test_damaged_npz_files(tmp_path: Path, what: str) -> None:
    path = tmp_path / "m.npz"
    spoilt_npz(path)
    content = bytearray(path.read_bytes())
    if what == "encrypted":
        for mark, at in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
            content[content.index(mark) + at] |= 1
    elif what == "checksum":
        content[content.index(b"NUMPY") + 130] ^= 1
    else:
        shape = {"open bracket": b"((((((", "beyond 64 bits": b"(9" + b"9" * 30}[what]
        place = content.index(b"(3, 3)")
        content[place : place + len(shape)] = shape
        with contextlib.suppress(ValueError):
            content[content.index(b", }", place) - 1] = ord(")")
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"m\.npz"):
        ElevationMap.load(path)


@pytest.mark.parametrize(
    ("notes", "message"),
    [
        ("origin: [a, b]", "origin.0: should be a valid number, got 'a'"),
        ("origin: [[1], [2]]", "must hold lines such as"),
        ("origin: {x: 1, y: 2}", "must hold lines such as"),
        ("origin: 5", "origin: should be"),
        (f"scale: {'9' * 400}", "scale"),
        (f"offset: -{'9' * 2000}", "offset"),
        ("scale: .nan", "scale: should be a finite number"),
        ("offset: .inf", "offset: should be a finite number"),
        ("scale: true", "scale: should be a valid number"),
        ("scale: '1'", "scale: should be a valid number"),
        ("scale: 2001-01-01", "is not JSON"),
        ("scale: null", "scale: should be a valid number"),
        ("unknown: x", "unknown: should be a valid integer"),
        ("unknown: 1.5", "unknown: should be a valid integer"),
        ("heights: 3", "heights: unexpected keyword"),
        ("scale: 2\nscale: 3", "gives a key twice"),
        ("a: &a [1]\nscale: [*a, *a]", "must hold lines such as"),
        ("<<: {scale: 1}", "must hold lines such as"),
        ("scale: &s [1]\nunknown: *s", "scale: should be a valid number"),
        ("scale: " + "[" * 3000, "corrupt"),
        ("#" * 4001, "more than 4000 bytes"),
        ("- 1\n- 2", "corrupt"),
        ("scale: !!python/name:os.system", "corrupt"),
        ("\x00", "corrupt"),
    ],
)
def test_png_sidecars_that_say_something_else(tmp_path: Path, notes: str, message: str) -> None:
    Image.fromarray(np.ones((3, 3), np.uint16)).save(tmp_path / "m.png")
    whole = {"scale": "1", "offset": "0", "resolution": "0.1", "origin": "[0, 0]"}
    whole.pop(notes.split(":")[0], None)
    text = "".join(f"{key}: {value}\n" for key, value in whole.items()) + notes
    (tmp_path / "m.png.yaml").write_text(text)
    with pytest.raises(MapError, match=message) as caught:
        ElevationMap.load(tmp_path / "m.png")
    assert "m.png" in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (Image.new("1", (4, 4)), "8 or 16 bits, this one holds 1"),
        (Image.new("P", (4, 4)), "one channel of grey.*holds P"),
        (Image.new("LA", (4, 4)), "one channel of grey.*holds LA"),
        (Image.new("RGBA", (4, 4)), "one channel of grey.*holds RGBA"),
    ],
)
def test_pngs_that_are_no_heights(tmp_path: Path, picture: Image.Image, message: str) -> None:
    picture.save(tmp_path / "m.png")
    notes = {"scale": 1, "offset": 0, "resolution": 0.1, "origin": [0, 0]}
    (tmp_path / "m.png.yaml").write_text(json.dumps(notes))
    with pytest.raises(MapError, match=message):
        ElevationMap.load(tmp_path / "m.png")


def test_a_value_that_is_transparent_is_unknown(tmp_path: Path) -> None:
    rows = np.array([[1, 2], [3, 4]], np.uint8)
    Image.fromarray(rows).save(tmp_path / "m.png", transparency=3)
    notes = {"scale": 1, "offset": 0, "resolution": 0.1, "origin": [0, 0], "unknown": None}
    (tmp_path / "m.png.yaml").write_text(json.dumps(notes))
    loaded = ElevationMap.load(tmp_path / "m.png")
    np.testing.assert_array_equal(loaded.heights, [[np.nan, 1], [4, 2]])


# -- a picture and its sidecar ---------------------------------------------------------------------


def test_a_picture_with_another_sidecar_is_refused(tmp_path: Path) -> None:
    one, other = tmp_path / "one.png", tmp_path / "other.png"
    hilly(seed=1).save(one)
    hilly(seed=2).save(other)
    os.replace(one, other)
    with pytest.raises(MapError, match=r"not the picture that other\.png\.yaml describes"):
        ElevationMap.load(other)
    sidecar = tmp_path / "other.png.yaml"
    lines = sidecar.read_text().splitlines()
    sidecar.write_text("\n".join(line for line in lines if not line.startswith("picture")))
    assert ElevationMap.load(other).shape == (7, 5)


def test_a_failed_save_leaves_picture_and_sidecar_as_they_were(tmp_path: Path) -> None:
    path, sidecar = tmp_path / "m.png", tmp_path / "m.png.yaml"
    hilly(seed=1).save(path)
    before = path.read_bytes()
    sidecar.unlink()
    sidecar.mkdir()
    with pytest.raises(StorageError, match=r"m\.png\.yaml: .*is a folder"):
        hilly(seed=2).save(path)
    assert path.read_bytes() == before and sorted(tmp_path.iterdir()) == [path, sidecar]


_KILLING = """
import os, random, signal, sys, time
import numpy as np
from fgtutor.elevation import ElevationMap
path = sys.argv[1]
maps = [ElevationMap(np.full((200, 200), z) + np.eye(200) * z) for z in (1.0, 5.0)]
maps[0].save(path)
for _ in range(12):
    child = os.fork()
    while not child:
        for elevation in maps:
            elevation.save(path)
    time.sleep(random.Random(child).uniform(0.01, 0.2))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    try:
        loaded = ElevationMap.load(path)
        print(loaded.heights.min(), loaded.heights.max())
    except ValueError as error:
        print(error)
maps[1].save(path)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_killed_save_leaves_one_map_or_an_error(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    done = subprocess.run(
        [sys.executable, "-c", _KILLING, str(path)], capture_output=True, text=True, check=True
    )
    outcomes = done.stdout.splitlines()
    assert len(outcomes) == 12
    for outcome in outcomes:
        assert outcome in ("1.0 2.0", "5.0 10.0") or (suffix == ".png" and "describes" in outcome)
    assert ElevationMap.load(path).heights.max() == 10
    names = {path.name, f"{path.name}.yaml"} if suffix == ".png" else {path.name}
    assert {file.name for file in tmp_path.iterdir()} == names


# -- paths -----------------------------------------------------------------------------------------


def test_paths_that_hold_no_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hilly().save(tmp_path / "m.npz")
    (tmp_path / "folder.npz").mkdir()
    os.mkfifo(tmp_path / "pipe.npz")
    for name, message in (
        ("m", "has no suffix; maps are .npz"),
        ("folder.npz", "is a folder or a device"),
        ("pipe.npz", "is a folder or a device"),
        ("none.npz", "there is no map file"),
        ("m.npz/x.npz", "cannot read .*[Nn]ot a directory"),
        ("x" * 300 + ".npz", "cannot read .*too long"),
    ):
        with pytest.raises(MapError, match=message):
            ElevationMap.load(tmp_path / name)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # as root every file can be read
    with pytest.raises(MapError, match=r"cannot read .*m\.npz: Permission denied; check"):
        ElevationMap.load(tmp_path / "m.npz")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", ["zip:x!y", "vsizip", "ü ä", "a#b?c=d", "M\udcfcller", "x" * 240])
def test_any_name_holds_a_map(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / f"{name}{suffix}"
    hilly().save(path)
    np.testing.assert_array_equal(ElevationMap.load(path).known, hilly().known)
