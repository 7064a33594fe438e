"""The demo: whole with the shipped zoo, and its errors name what to do."""

import json

import pytest
from PIL import Image

from fgtutor import demo
from fgtutor.errors import SpecialistError, StorageError
from fgtutor.routes import Route


@pytest.mark.slow
def test_the_demo_reaches_the_goal_and_says_so(tmp_path, capsys):
    out = tmp_path / "new" / "demo"
    assert demo.run(demo.DemoConfig(out=out, video="gif")) == 0
    names = {"plan.png", "route.json", "drive.gif", "drive.png"}
    assert {path.name for path in out.iterdir()} == names
    said = capsys.readouterr().out
    assert all(str(out / name) in said for name in names) and "reached" in said
    route = Route.from_json(json.loads((out / "route.json").read_text()))
    assert route.switches > 0
    with Image.open(out / "plan.png") as picture:
        assert picture.width > 1000
    assert (out / "drive.gif").stat().st_size < 4_000_000


def test_the_demo_map_joins_start_and_goal():
    elevation = demo.ElevationMap.load(demo.MAP)
    for point in (demo.START, demo.GOAL):
        assert elevation.known[elevation.cell_of(*point)]
    assert not elevation.known.all()


def test_an_empty_zoo_is_named(tmp_path):
    (tmp_path / "zoo").mkdir()
    with pytest.raises(SpecialistError, match="holds no specialist"):
        demo.run(demo.DemoConfig(out=tmp_path / "demo", zoo=tmp_path / "zoo"))


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"file.*demo"):
        demo.run(demo.DemoConfig(out=tmp_path / "file" / "demo"))
