"""Open ground: what was laid says what can be crossed, and the experiment counts what it should."""

import json
import math
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from fgtutor.__main__ import main
from fgtutor.baselines import Classical
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, TerrainError
from fgtutor.evaluation import openground, trials
from fgtutor.evaluation.openground import OpenGroundConfig, shortest_ways, ways
from fgtutor.evaluation.openground_tables import OpenRow, failed_where, table
from fgtutor.figures.maps import draw_elevation
from fgtutor.robots import ROBOTS
from fgtutor.specialist import ZOO, load_zoo
from fgtutor.world.boxes import rasterise
from fgtutor.world.nist import INCLINE, NIST, RISE, STEPFIELD, WALL, corner_lanes
from fgtutor.world.obstacles import Course
from fgtutor.world.openground import (
    CELL,
    IMPOSSIBLE,
    LEAST,
    UNSEEN,
    away,
    make_open_ground,
    own_frame,
)


@pytest.fixture(scope="module", params=["seen", "unseen"])
def ground(request):
    return make_open_ground(5, group=request.param)


def components(mask):
    """Number the places that steps to 8 neighbours join, from 1; 0 is closed."""
    places = np.zeros(mask.shape, dtype=int)
    ndimage.label(mask, np.ones((3, 3)), output=places)
    return places


def test_a_map_is_whole_and_its_tasks_are_what_they_say(ground):
    elevation = ground.terrain.elevation
    assert elevation.known.all()
    assert all(12.0 <= side <= 20.0 for side in elevation.size)
    places = components(ground.passable)
    for index, task in enumerate(ground.tasks):
        a, b = (places[tuple(int(v / CELL) for v in end)] for end in (task.start, task.goal))
        assert a and b and (a == b) == task.feasible == (index % IMPOSSIBLE != IMPOSSIBLE - 1)
        assert math.dist(task.start, task.goal) >= LEAST
        for end in (task.start, task.goal):  # on level ground, or nearly
            assert abs(float(elevation.height_at(*end))) < 0.2


def test_the_shortest_way_joins_what_is_feasible(ground):
    for task, length in zip(ground.tasks, shortest_ways(ground), strict=True):
        assert (length is not None) == task.feasible
        if length is not None:  # less than the radius of the goal, more than nothing round corners
            assert math.dist(task.start, task.goal) - 0.35 <= length + 2 * CELL


def test_kinds_are_those_of_training_or_none_of_them(ground):
    kinds = {crossing.kind for crossing in ground.crossings}
    trained = set(ROBOTS["a1"].scale.mixed)
    assert kinds <= trained if ground.group == "seen" else not kinds & trained
    assert trained.isdisjoint(UNSEEN)


def test_every_way_over_a_river_or_wall_leads_through_a_crossing(ground):
    shape, size = ground.passable.shape, ground.terrain.elevation.size
    cells = np.stack(np.meshgrid(*((np.arange(n) + 0.5) * CELL for n in shape), indexing="ij"), -1)
    x, y = own_frame(cells, ground.yaw, size)
    closed = ground.passable.copy()
    for lane in (lane for crossing in ground.crossings for lane in crossing.lanes):
        closed &= away(lane, x, y) > CELL
    before, after = (
        np.bincount(components(mask).ravel())[1:] for mask in (ground.passable, closed)
    )
    barriers = len({crossing.area[:2] for crossing in ground.crossings})
    assert (before > 200).sum() == 1 and (after > 200).sum() == barriers + 1
    middle = ground.crossings[0].area
    at = np.argmin(np.hypot(x - (middle[0] + middle[1]) / 2, y - (middle[2] + middle[3]) / 2))
    assert ground.crossing_near(tuple(cells.reshape(-1, 2)[at])) is ground.crossings[0]


def test_a_seed_gives_the_same_map_and_another_another():
    one, two, other = (make_open_ground(seed, tasks=1) for seed in (3, 3, 5))
    assert (one.terrain.elevation.heights == two.terrain.elevation.heights).all()
    assert one.tasks == two.tasks and one.tasks != other.tasks


def test_an_unknown_robot_is_refused():
    with pytest.raises(TerrainError, match="unknown robot 'cat'"):
        make_open_ground(1, robot="cat")


def laid(kind, length, width):
    course = Course(ROBOTS["a1"].scale, 1.0, np.random.default_rng(0))
    course.width = width
    NIST[kind](course, 0.0, length)
    return rasterise(course.boxes, (length, width), 0.05).heights


def test_tiles_have_the_published_dimensions():
    # Posts of 10 cm are 2 x 2 cells; half of 0 to 40 cm.
    posts = laid("stepfield", 1.0, 1.0)[::2, ::2]
    assert posts.shape == (10, 10) and STEPFIELD.max() == 0.2
    assert any(posts == pytest.approx(np.rot90(STEPFIELD, k), abs=1e-6) for k in range(4))
    assert np.unique(STEPFIELD) == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
    # 15 degrees: 60 cm up to 16 cm, and down again.
    ramps = laid("ramps", 1.2, 1.2)[:, 3]
    assert ramps.max() == pytest.approx((0.6 - 0.025) * math.tan(INCLINE), abs=1e-6)
    assert ramps == pytest.approx(ramps[::-1], abs=1e-6)


def test_stairs_round_a_corner_are_walked_along_their_lanes():
    heights = laid("corner", 2.6, 3.5)
    (a, b, c) = corner_lanes(3.5, 0.0, 2.6, 0.25)
    for x0, x1, y0, y1 in ((0.0, *a[1:]), b, (c[0], 2.6, *c[2:])):
        part = heights[round(x0 / 0.05) : round(x1 / 0.05), round(y0 / 0.05) : round(y1 / 0.05)]
        assert part.max() <= 4 * RISE + 1e-6
        for axis in (0, 1):
            assert np.abs(np.diff(part, axis=axis)).max(initial=0) <= RISE + 1e-6
    assert heights.max() == pytest.approx(WALL)


def row(**changes: Any) -> OpenRow:
    base: Any = {
        "terrain": "seen", "policy": "ours", "ground": 1, "seed": 1, "outcome": "reached",
        "length": 12.0, "seconds": 20.0, "switches": 2, "promise": 0.9, "map": 0, "task": 0,
        "feasible": True, "noise": 0.0, "drift": 0.0, "shortest": 9.0, "planned": 11.0,
        "assessing": 3.0, "planning": 0.5, "near": None,
    }  # fmt: skip
    return base | changes


def test_the_table_counts_refusals_right_and_wrong():
    refused: Any = {"outcome": "no_route", "promise": None, "length": 0.0, "near": "bridge"}
    rows = [
        row(),
        row(task=1, length=9.0),
        row(task=2, outcome="fell", near="steps"),
        row(task=3, **refused),
        row(task=4, feasible=False, shortest=None, **refused),
        row(task=5, feasible=False, shortest=None, outcome="timeout", near="gaps"),
    ]
    line = [cell.strip() for cell in table(rows).splitlines()[-1].strip("|").split("|")]
    # Of 4 feasible ones 2 arrive; SPL is (9 / 12 + 1) / 4; 1 of 2 impossible ones and 1 of 2
    # refusals is right; promises of 0.9 come true in 2 of 4 drives: 0.5 * 0.01 + 0.5 * 0.81.
    assert line[:3] == ["seen", "0 + 0", "ours"]
    assert line[3].startswith("50 (") and line[4:8] == ["1", "1", "0", "0.438"]
    assert line[8].startswith("50 (") and line[9].startswith("50 (") and line[10] == "0.410"
    assert failed_where(rows) == "steps fell 1, bridge no_route 1"


def test_planners_have_names_and_steps():
    zoo = load_zoo("toy", include_general=True)
    config = OpenGroundConfig(robot="toy", planners=("ours", "paper", "occupancy@0.2"))
    found = ways(config, zoo)
    assert list(found) == ["ours", "paper", "occupancy@0.2"]
    assert found["paper"][1].taus == "paper" and found["ours"][1].taus == "calibrated"
    step = ElevationMap(np.repeat([[0.0], [0.15]], 20, axis=0) * np.ones((40, 40)))
    for name, open_ in (("occupancy@0.2", True), ("occupancy@0.1", False)):
        planner, _ = ways(OpenGroundConfig(robot="toy", planners=(name,)), zoo)[name]
        assert isinstance(planner, Classical)
        cells = planner.cells(step, 0.1)
        assert (cells > 0).all() == open_
    for name in ("occupancy@high", "nonsense", "ours@0.2"):
        with pytest.raises(ConfigError):
            ways(OpenGroundConfig(robot="toy", planners=(name,)), zoo)


@pytest.mark.slow
def test_the_command_plans_drives_and_reports(tmp_path, capsys):
    words = "evaluate openground --robot toy --maps 2 --tasks 3 --workers 1 --levels 0 0"
    assert main([*words.split(), "--planners", "ours", "occupancy", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 2 * 3 * 2 and {row["terrain"] for row in rows} == {"seen", "unseen"}
    assert all((row["outcome"] == "no_route") == (row["promise"] is None) for row in rows)
    assert (tmp_path / "figures" / "map-00000.png").exists()
    assert "recall" in capsys.readouterr().out


def test_refused_tasks_are_drawn_without_planning_them_again(tmp_path, monkeypatch):
    config = OpenGroundConfig(robot="toy", maps=1, tasks=3)
    starts = []

    def plan_all(planner, grounds, *rest):
        starts.extend(ground.terrain.start for ground in grounds)
        return trials.plan_all(planner, grounds, *rest)

    monkeypatch.setattr(openground, "plan_all", plan_all)
    rows: list[Any] = [
        {"task": task, "outcome": outcome, "feasible": True}
        for task, outcome in enumerate(("no_route", "reached", "no_route"))
    ]
    openground.picture(config, 0, rows)(tmp_path / "map.png")
    assert starts == [openground.make_ground(config, 0).tasks[1].start]
    openground.picture(config, 0, [rows[0]])(tmp_path / "refused.png")
    assert len(starts) == 1 and (tmp_path / "refused.png").exists()


def test_the_shipped_map_of_real_stairs_is_read():
    stairs = ElevationMap.load(ZOO / "maps" / "real_stairs.npz")
    assert stairs.shape == (122, 71) and stairs.resolution == 0.04
    assert not stairs.known.all() and np.nanmax(stairs.heights) == pytest.approx(0.95, abs=0.01)
    assert "MIT License" in (ZOO / "maps" / "LICENSE-elevation_mapping_cupy").read_text()
    draw_elevation(stairs)
