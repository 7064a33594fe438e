"""The widgets in Python: what a browser would send, and what it would get."""

import base64
import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.elevation import ElevationMap
from fgtutor.settings import SETTINGS
from fgtutor.tensorization import Assessment
from fgtutor.world.terrain import make_terrain

NAMES = ("steps", "gaps", "slopes")
START, GOAL = (0.25, 0.25), (4.25, 3.25)


@pytest.fixture
def grid() -> ElevationMap:
    return ElevationMap(np.zeros((9, 7)), resolution=0.5)


@pytest.fixture
def said(grid) -> dict[str, Assessment]:
    """What three specialists say of the map."""
    rng = np.random.default_rng(9)
    return {
        name: Assessment(
            torch.tensor(rng.uniform(0, 1, (9, 7, 8)), dtype=torch.float32),
            torch.tensor(rng.gamma(1.0, 1.0, (9, 7, 8)), dtype=torch.float32),
            grid,
        )
        for name in NAMES
    }


@pytest.fixture
def widgets():
    """The module of the widgets, which needs the lab extra."""
    pytest.importorskip("ipywidgets", reason="the lab extra is not installed: make test does")
    pytest.importorskip("anywidget", reason="the lab extra is not installed: make test does")
    from fgtutor.course.widgets import jupyter

    return jupyter


def shown(widget) -> tuple[Image.Image, str]:
    """The picture that a page without a kernel shows, and its words."""
    data, words = widget._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in data
    picture = Image.open(io.BytesIO(base64.b64decode(data["image/png"])))
    return picture, words["image/png"]["alt"]


def say(board, **content) -> None:
    """What the canvas sends when a person does something."""
    board.view._handle_custom_msg(content, [])


def test_a_drag_redraws_and_the_text_follows(widgets, grid, said):
    board = widgets.TauExplorer(grid, said, START, GOAL)
    before = dict(board.view.pictures), board.view.frame
    board.taus.value = (0.2, 0.7)
    alone = Explorer(grid, said, START, GOAL, taus=(0.2, 0.7))
    assert board.view.status == alone.status
    assert board.view.frame == before[1] + 1
    assert board.view.pictures["M"] == before[0]["M"]
    assert board.view.pictures["w gaps"] != before[0]["w gaps"]
    assert board.view.pictures["P"] == TauPictures(alone).scene().pictures["P"].tobytes()
    board.policies["steps"].value = False
    board.f_min.value, board.switch_cost.value = 0.05, 1.5
    assert board.explorer.settings == replace(alone.settings, f_min=0.05, switch_cost=1.5)
    assert board.explorer.policies == NAMES[1:]
    board.taus.value = (1.0, 1.0)  # where the ends meet, w_ood is nearly a step
    loss = said["gaps"].reconstruction
    clear = (loss - 1).abs() > 0.01
    assert torch.equal(board.explorer.plan.weights["gaps"][clear], (loss < 1)[clear].float())


@pytest.mark.parametrize(("name", "settings"), SETTINGS.items())
def test_a_button_chooses_ours_or_the_papers(widgets, grid, said, name, settings):
    board = widgets.TauExplorer(grid, said, START, GOAL, taus=(0.3, 0.4), f_min=0.2, switch_cost=9)
    board.named[name].click()
    alone = Explorer(grid, said, START, GOAL, settings)
    assert board.explorer.settings == settings and board.view.status == alone.status
    assert board.switch_cost.value == settings.switch_cost


def test_the_calibrated_thresholds_are_one_press_away(widgets, grid, said):
    """The slider holds one pair for all; while each policy has its own, it says nothing."""
    board = widgets.TauExplorer(grid, said, START, GOAL)
    assert board.rule.value == "calibrated" and board.explorer.settings.taus == "calibrated"
    board.taus.value = (0.2, 0.7)
    assert board.rule.value == "one pair" and board.explorer.settings.taus == (0.2, 0.7)
    board.rule.value = "calibrated"
    assert board.view.status == Explorer(grid, said, START, GOAL).status
    board.rule.value = "one pair"
    assert board.explorer.settings.taus == (0.2, 0.7)


def test_every_widget_brings_a_picture_of_itself(
    widgets, grid, said, make_specialist, make_rolling
):
    ground = ElevationMap(np.zeros((20, 16)))
    for widget, words in (
        (widgets.TauExplorer(grid, said, START, GOAL), "w_ood of gaps"),
        (widgets.TerrainPainter(ground, make_specialist()), "Elevation map M: paint here"),
        (widgets.DriveA1(make_terrain("flat", robot="toy"), {"steps": make_rolling()}), "steps at"),
    ):
        picture, alt = shown(widget)
        assert picture.width >= 700 and words in alt
        assert np.asarray(picture.convert("L")).std() > 5


def test_clicks_arrows_and_hovering_reach_the_explorer(widgets, grid, said):
    board = widgets.TauExplorer(grid, said, START, GOAL)
    say(board, kind="press", cells=[[2, 5]], shift=False)
    assert board.explorer.goal == grid.centre_of(2, 5)
    say(board, kind="drag", cells=[[3, 5], [4, 6]], shift=False)
    assert board.explorer.goal == grid.centre_of(4, 6)
    say(board, kind="press", cells=[[1, 1]], shift=True)
    assert board.explorer.start == grid.centre_of(1, 1)
    board.picks.value = "start"
    say(board, kind="move", step=[1, -9], shift=False)
    assert board.explorer.start == grid.centre_of(2, 0)  # it stays on the map
    say(board, kind="hover", cells=[[4, 4]])
    assert board.view.reading == board.explorer.read((4, 4))
    before = board.view.reading
    board.taus.value = (0.0, 0.3)
    assert board.view.reading == board.explorer.read((4, 4)) != before
    say(board, kind="hover", cells=[])
    assert board.view.reading == ""
    say(board, kind="hover", cells=[[99, 0]])
    assert "no cell (99, 0)" in board.view.status


def test_a_painter_paints_what_is_dragged_over(widgets, make_specialist):
    board = widgets.TerrainPainter(ElevationMap(np.zeros((20, 16))), make_specialist())
    before = dict(board.view.pictures)
    board.height.value, board.radius.value = 0.3, 0.1
    say(board, kind="drag", cells=[[5, 5], [8, 5]], shift=False)
    heights = board.painting.elevation.heights
    assert heights[5, 6] == heights[8, 4] == np.float32(0.3) and heights[7, 7] == 0
    assert board.view.pictures["M"] != before["M"] and board.view.overlay["box"] is not None
    say(board, kind="hover", cells=[[5, 5]])
    assert "height 0.30 m" in board.view.reading
    assert board.heading.label == "best"  # not an empty field
    board.heading.value = 0
    assert board.view.rows[0][1]["title"].endswith("+x")
    board.clear.click()
    assert board.view.pictures["M"] == before["M"]


def test_a_painter_paints_by_keyboard(widgets, make_specialist):
    board = widgets.TerrainPainter(ElevationMap(np.zeros((20, 16))), make_specialist())
    board.height.value, board.radius.value = 0.3, 0.0
    say(board, kind="move", step=[-2, 1], shift=False)
    assert board.view.overlay["marks"]["brush"] == (8.5, 16 - 9 - 0.5)
    say(board, kind="enter")
    assert np.argwhere(board.painting.elevation.heights).tolist() == [[8, 9]]
    say(board, kind="move", step=[-99, 99], shift=False)
    say(board, kind="enter")
    assert board.painting.elevation.heights[0, 15] == np.float32(0.3)


def test_a_painter_plans_and_drives(widgets, make_rolling):
    ground, ends = ElevationMap(np.zeros((40, 20))), {"start": (0.65, 1.05), "goal": (3.05, 1.05)}
    specialist = make_rolling("steps", f=0.9)
    board = widgets.TerrainPainter(ground, specialist, taus=(50.0, 100.0), **ends)
    assert len(board.view.overlay["lines"]) == 1 and "route: 2.40 m" in board.view.status
    assert not board.drive.disabled and board.film.layout.display == "none"
    board.drive.click()
    assert "driven: reached" in board.view.status
    assert len(board.view.overlay["lines"]) == 2 and board.film.layout.display == ""
    assert Image.open(io.BytesIO(board.film.value)).width > 700
    say(board, kind="press", cells=[[20, 10]], shift=False)
    assert "driven" not in board.view.status and board.film.layout.display == "none"
    assert widgets.TerrainPainter(ElevationMap(np.zeros((9, 9))), make_rolling()).drive.disabled


def test_a_drive_plays_pauses_and_resets(widgets, make_rolling):
    board = widgets.DriveA1(make_terrain("flat", robot="toy"), {"steps": make_rolling()})
    first = board.image.value
    assert Image.open(io.BytesIO(first)).size == (720, 272)
    assert board.image.layout.align_self == "flex-start"  # not stretched to the page
    board.speed.value = -0.4
    assert board.drive.speed == -0.4
    board.speed.value = 0.5
    board.play.value = 1
    board.play.value = 2
    assert len(board.drive.episode.poses) == 5 and board.drive.speed == 0.5
    assert board.image.value != first and "command (0.50 m/s" in board.status.value
    board.reset.click()
    assert len(board.drive.episode.poses) == 1 and not board.play.playing


@pytest.mark.slow
def test_without_the_lab_extra_the_message_says_how_to_install_it():
    code = "import sys; sys.modules['anywidget'] = None; import fgtutor.course.widgets.jupyter"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    said = done.stderr.splitlines()[-1]
    assert said.startswith("fgtutor.errors.MissingExtraError: the widgets need the package anywid")
    assert 'pip install -c constraints.txt -e ".[lab]"' in said


def test_the_front_end_is_shipped_and_asks_no_network(widgets):
    from fgtutor.course.widgets.board import STATIC, Canvas

    for name in ("panels.js", "panels.css"):
        text = (STATIC / name).read_text(encoding="utf-8")
        assert "://" not in text and "import " not in text
    assert "export default" in Canvas._esm
