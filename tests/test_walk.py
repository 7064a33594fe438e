"""`fgtutor walk`: a map of one's own is planned over and driven, from the command line's words."""

import json

import numpy as np
import pytest
from PIL import Image

from fgtutor.__main__ import main
from fgtutor.cli import demo
from fgtutor.elevation import ElevationMap
from fgtutor.routes import Route

ENDS = ["--start", "1", "4", "--goal", "11", "4"]


@pytest.mark.slow
def test_a_map_of_ones_own_is_walked(tmp_path, capsys):
    out = tmp_path / "walk"
    words = ["walk", "--map", str(demo.MAP), "--robot", "toy", *ENDS]
    assert main([*words, "--video", "gif", "--out", str(out)]) == 0
    names = {"route.json", "plan.png", "episode.json", "drive.gif", "drive.png"}
    assert {path.name for path in out.iterdir()} == names
    said = capsys.readouterr().out
    assert all(str(out / name) in said for name in names)
    route = Route.from_json(json.loads((out / "route.json").read_text()))
    episode = json.loads((out / "episode.json").read_text())
    assert episode["outcome"] == "reached" and episode["robot"] == "toy"
    assert np.hypot(episode["end"][0] - 11, episode["end"][1] - 4) <= 0.35
    assert list(episode["seconds_per_policy"]) == list(route.names)
    assert sum(episode["seconds_per_policy"].values()) == pytest.approx(episode["seconds"], abs=0.1)


@pytest.mark.slow
def test_the_a1_walks_a_height_field_of_ones_own(tmp_path, monkeypatch):
    """Gentle bumps of 2 cm, no cell as high as the next: no boxes, and a hole in what is known."""
    monkeypatch.setenv("MUJOCO_GL", "off")
    x, y = np.meshgrid(np.arange(80) * 0.05, np.arange(40) * 0.05, indexing="ij")
    heights = 0.02 * np.sin(2 * x) * np.cos(3 * y)
    heights[60:64, 2:6] = np.nan
    ElevationMap(heights, resolution=0.05).save(tmp_path / "bumps.npz")
    words = [
        "walk",
        "--map",
        str(tmp_path / "bumps.npz"),
        "--start",
        "0.7",
        "1",
        "--goal",
        "3.3",
        "1",
    ]
    assert main([*words, "--out", str(tmp_path / "walk")]) == 0
    episode = json.loads((tmp_path / "walk" / "episode.json").read_text())
    assert episode["outcome"] == "reached" and episode["robot"] == "a1"


@pytest.mark.slow
def test_a_refusal_is_drawn_and_told(tmp_path, capsys):
    heights = np.zeros((40, 20))
    heights[13:27] = -1.0  # a chasm from border to border
    ElevationMap(heights).save(tmp_path / "chasm.npz")
    words = ["walk", "--map", str(tmp_path / "chasm.npz"), "--robot", "toy"]
    assert main([*words, "--start", "0.8", "1", "--goal", "3.2", "1", "--out", str(tmp_path)]) == 2
    assert "no chain of steps" in capsys.readouterr().err
    assert not (tmp_path / "route.json").exists()
    with Image.open(tmp_path / "plan.png") as picture:
        assert picture.width > 800


def test_what_cannot_be_walked_is_told_before_anything_is_computed(tmp_path, capsys):
    out = ["--out", str(tmp_path / "walk")]
    for words, told in (
        (["--map", str(tmp_path / "no.npz"), "--robot", "toy", *ENDS], "no.npz"),
        (
            ["--map", str(demo.MAP), "--robot", "toy", "--start", "1", "4", "--goal", "99", "4"],
            "off",
        ),
        (["--map", str(demo.MAP), "--robot", "horse", *ENDS], "horse"),
        (["--map", str(demo.MAP), "--robot", "toy", *ENDS, "--policies", "wings"], "wings"),
    ):
        assert main(["walk", *words, *out]) == 2
        assert told in capsys.readouterr().err
    assert not (tmp_path / "walk").exists()
