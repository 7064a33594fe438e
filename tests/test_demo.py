"""The demo: whole with the shipped zoo, and its errors name what to do."""

import json
import math

import imageio_ffmpeg
import mujoco
import pytest
import torch
from PIL import Image

from fgtutor.cli import demo
from fgtutor.errors import RenderingError, SpecialistError, StorageError
from fgtutor.feasibility import FeasibilityNet
from fgtutor.policies.symmetry import SymmetricMLPModel
from fgtutor.robots.a1.env import A1_GRID, A1Env
from fgtutor.robots.offscreen import Renderer
from fgtutor.routes import Route
from fgtutor.specialist import save_specialist
from fgtutor.world.terrain import World, make_terrain

BALL = '<mujoco><worldbody><geom size="0.1"/></worldbody></mujoco>'


@pytest.fixture
def a1_zoo(make_specialist, tmp_path):
    """Return a zoo of one A1 that finds everything feasible and falls at its first step."""
    env = A1Env(World([[make_terrain("flat", robot="a1")]]), 1)
    policy = SymmetricMLPModel(
        env.get_observations(), {"actor": ["policy"]}, "actor", 12, mirror=env.mirror,
        hidden_dims=[4],
    )  # fmt: skip
    net = FeasibilityNet(A1_GRID.num_points, hidden=(8, 8), vae_hidden=(8, 8), latent=2)
    with torch.no_grad():
        for parameter in (*policy.parameters(), *net.parameters()):
            parameter.zero_()
        net.head[-1].bias.fill_(math.log(9.0))  # F = 0.9
        policy.mlp[-1].bias[1::3] = 3.0  # all thighs back: it falls on its nose
    quantiles = {"0.5": 1.0, "0.9": 9e3, "0.95": 9.5e3, "0.99": 9.9e3}
    fields = {"policy": policy, "feasibility": net, "grid": A1_GRID, "quantiles": quantiles}
    save_specialist(make_specialist(robot="a1", **fields), tmp_path / "zoo" / "steps")
    return tmp_path / "zoo"


@pytest.mark.slow
def test_the_demo_reaches_the_goal_and_says_so(tmp_path, capsys):
    out = tmp_path / "new" / "demo"
    assert demo.run(demo.DemoConfig(robot="toy", out=out, video="gif")) == 0
    names = {"plan.png", "route.json", "episode.json", "drive.gif", "drive.png"}
    assert {path.name for path in out.iterdir()} == names
    said = capsys.readouterr().out
    assert all(str(out / name) in said for name in names) and "reached" in said
    route = Route.from_json(json.loads((out / "route.json").read_text()))
    assert route.switches > 0
    with Image.open(out / "plan.png") as picture:
        assert picture.width > 1000
    assert (out / "drive.gif").stat().st_size < 4_000_000


@pytest.mark.slow
def test_the_a1_demo_shows_even_a_fall(a1_zoo, tmp_path, capsys, monkeypatch):
    try:
        Renderer(mujoco.MjModel.from_xml_string(BALL), 16, 16).close()
    except RenderingError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(demo, "a1_terrain", lambda: make_terrain("steps", robot="a1", seed=3))
    out = tmp_path / "demo"
    assert demo.run(demo.DemoConfig(robot="a1", out=out, zoo=a1_zoo, taus="calibrated")) == 1
    names = {"plan.png", "route.json", "episode.json", "drive.mp4", "drive.png"}
    assert {path.name for path in out.iterdir()} == names
    said = capsys.readouterr().out
    assert all(str(out / name) in said for name in names) and "fell" in said
    _, seconds = imageio_ffmpeg.count_frames_and_secs(str(out / "drive.mp4"))
    assert 1.2 < seconds < 10


@pytest.mark.slow
def test_without_graphics_the_a1_demo_still_plans(a1_zoo, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "a1_terrain", lambda: make_terrain("steps", robot="a1", seed=3))
    monkeypatch.setenv("MUJOCO_GL", "off")
    out = tmp_path / "demo"
    assert demo.run(demo.DemoConfig(robot="a1", out=out, zoo=a1_zoo, taus="calibrated")) == 1
    assert {path.name for path in out.iterdir()} == {"plan.png", "route.json", "episode.json"}
    said = capsys.readouterr().out
    assert "no film of it" in said and "apt install" in said and "fell" in said


@pytest.mark.slow
def test_the_shipped_a1_walks_over_all_four_obstacles(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert demo.run(demo.DemoConfig(robot="a1", out=tmp_path)) == 0
    route = Route.from_json(json.loads((tmp_path / "route.json").read_text()))
    x = (route.xy[:-1, 0] + route.xy[1:, 0]) / 2
    sections = demo.a1_terrain().sections
    assert {part.name for part in sections} == {"steps", "gaps", "bridge", "valley"}
    for part in sections:  # each with its own specialist, but for a few steps at its ends
        there = route.policies[(x > part.x0) & (x < part.x1)]
        assert (there == route.names.index(part.name)).mean() > 0.8


def test_the_demo_map_joins_start_and_goal():
    elevation = demo.ElevationMap.load(demo.MAP)
    for point in (demo.START, demo.GOAL):
        assert elevation.known[elevation.cell_of(*point)]
    assert not elevation.known.all()


def test_an_empty_zoo_is_named(tmp_path):
    (tmp_path / "zoo").mkdir()
    with pytest.raises(SpecialistError, match="holds no specialist"):
        demo.run(demo.DemoConfig(robot="toy", out=tmp_path / "demo", zoo=tmp_path / "zoo"))


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"file.*demo"):
        demo.run(demo.DemoConfig(robot="toy", out=tmp_path / "file" / "demo"))
