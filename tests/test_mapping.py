"""`fgtutor map`: a cloud becomes a map, and the last line says what was left out of it and why."""

from pathlib import Path

import numpy as np
import pytest
from cloud_writers import geokeys, las, sheet

from fgtutor.cli import map
from fgtutor.elevation import ElevationMap
from fgtutor.errors import CloudError, ConfigError, MapError, StorageError
from fgtutor.io.validation import parse_options


def command(*options: object) -> map.MapConfig:
    return parse_options(map.MapConfig, [str(option) for option in options], "fgtutor map")


def test_map_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = sheet()
    path, out = tmp_path / "c.laz", tmp_path / "m.npz"
    las(path, points[points[:, 0] > 0.2])
    options = ("--out", out, "--area", 0, 0, 1, 0.6)
    assert map.run(command(path, *options)) == 0
    elevation = ElevationMap.load(out)
    assert elevation.shape == (20, 12)
    assert not elevation.known[:4].any() and elevation.known[4:].all()
    assert np.isnan(elevation.heights[:4]).all()
    printed = capsys.readouterr().out
    assert "20.0% of the cells are unknown" in printed and "4 points (median)" in printed
    assert printed.endswith("left out or converted: nothing\n")

    assert map.run(command(path, *options, "--fill")) == 0
    filled = ElevationMap.load(out)
    assert np.isfinite(filled.heights).all()
    np.testing.assert_array_equal(filled.known, elevation.known)


def test_map_command_refuses_early_and_keeps_the_old_map(tmp_path: Path) -> None:
    out = tmp_path / "map.npz"
    out.write_text("old")
    with pytest.raises(CloudError, match="check the path"):
        map.run(command(tmp_path / "none.las", "--out", out))
    # Before it reads the cloud, which is not there either.
    with pytest.raises(StorageError, match="create the folder"):
        map.run(command(tmp_path / "none.las", "--out", tmp_path / "no" / "map.npz"))
    np.savez_compressed(tmp_path / "cloud.npz", points=sheet())
    with pytest.raises(MapError, match=r"\.bmp"):
        map.run(command(tmp_path / "cloud.npz", "--out", tmp_path / "map.bmp"))
    assert out.read_text() == "old"


def test_the_last_line_says_what_was_left_out_and_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = sheet()
    ceiling = points[points[:, 0] < 0.1] + (0, 0, 2.4)
    stray = np.array([(0.5, 0.3, 1.0), (0.7, 0.4, -0.9)])
    far = np.array([(1.52, 0.02, 0.1)])
    everything = np.concatenate((points, ceiling, stray, far, points[:7], points[:5]))
    classes = np.r_[np.full(len(everything) - 12, 2), np.full(7, 7), np.full(5, 2)].astype("u1")
    withheld = (np.arange(len(everything)) >= len(everything) - 5).astype("u1")
    path = tmp_path / "c.las"
    keys = geokeys((3072, 0, 2263))
    feet = everything / (1200 / 3937)
    las(path, feet, scale=1e-5, records=(keys,), classification=classes, withheld=withheld)
    options = ("--out", tmp_path / "m.npz", "--area", 0, 0, 1, 0.6)
    assert map.run(command(path, *options)) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.removeprefix("left out or converted: ").split("; ") == [
        "7 points of the noise classes 7 and 18",
        "5 withheld points",
        "x and y in 'US survey foot' and z in 'US survey foot' converted to metres",
        "1 point outside the area",
        "2 outliers far from the others",
        f"{len(ceiling)} points hanging 1.5 m above others or more",
    ]


@pytest.mark.parametrize(
    ("area", "message"),
    [
        ((0, 0, "inf", 2), "area.*finite"),
        ((0, "nan", 1, 2), "area.*finite"),
        ((0, 0, 0, 2), "is empty"),
        ((0, 0, 1e6, 1e6), "cells are more than"),
    ],
)
def test_areas_that_cannot_be_are_refused(tmp_path: Path, area: tuple, message: str) -> None:
    np.savez_compressed(tmp_path / "cloud.npz", points=sheet())
    out = tmp_path / "map.npz"
    with pytest.raises((CloudError, ConfigError), match=message):
        map.run(command(tmp_path / "cloud.npz", "--out", out, "--area", *area))
    assert not out.exists()
