import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import ndimage

from fgtutor.__main__ import main
from fgtutor.errors import (
    ConfigError,
    DoubtfulRouteError,
    TerrainError,
    TooLargeError,
    UnreachableError,
)
from fgtutor.evaluation import trials, turned
from fgtutor.evaluation.turned import TurnedConfig, run, shortest, table
from fgtutor.planning import plan_on_map
from fgtutor.robots.a1.env import DROP, RIM
from fgtutor.robots.a1.ground import rims
from fgtutor.specialist import load_zoo
from fgtutor.world.boxes import Box, rasterise
from fgtutor.world.obstacles import Course, TerrainScale
from fgtutor.world.terrain import make_terrain
from fgtutor.world.turned import OVERHANG, lay_turned, make_turned, trimmed
from fgtutor.world.turned import turned as turn

KINDS = ("bridge", "valley", "gaps", "steps", "slopes")


def test_a_quarter_turn_by_hand():
    box = Box(centre=(3.0, 1.0, -0.5), size=(2.0, 1.0, 1.0), rpy=(0.0, -0.3, 0.0))
    (other,) = turn([box], math.pi / 2, (1.0, 1.0), to=(5.0, 0.0))
    # It lay 2 m ahead of the point in +x, so it lies 2 m ahead in +y of where the point is now.
    assert other.centre == pytest.approx((5.0, 2.0, -0.5))
    assert other.size == box.size and other.rpy == pytest.approx((0.0, -0.3, math.pi / 2))
    # Its own x axis rises as before, towards +y.
    assert other.rotation[:, 0] == pytest.approx([0.0, math.cos(0.3), math.sin(0.3)])


@pytest.mark.parametrize("kind", KINDS)
def test_a_quarter_turn_rotates_the_map(kind):
    straight, turned = (make_turned(kind, angle=angle, seed=5).elevation for angle in (0, 90))
    assert straight.shape == (160, 160)
    assert turned.heights == pytest.approx(straight.rotated90(1).heights, abs=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", [22.0, -130.0])
def test_any_turn_moves_every_place_of_the_map(kind, angle):
    straight, turned = (make_turned(kind, angle=a, seed=3) for a in (0.0, angle))
    ground, size = straight.elevation, straight.elevation.size[0]
    x, y = np.meshgrid(*turned.elevation.centres, indexing="ij")
    cos, sin = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    dx, dy = x - size / 2, y - size / 2
    x, y = size / 2 + cos * dx + sin * dy, size / 2 - sin * dx + cos * dy
    # Away from edges, where the cells around agree; a slope changes by up to 8 cm per cell.
    level = ndimage.maximum_filter(ground.heights, 3) - ndimage.minimum_filter(ground.heights, 3)
    inside = (np.minimum(x, y) > 0.1) & (np.maximum(x, y) < size - 0.1)
    ix, iy = (np.floor(at[inside] / ground.resolution).astype(int) for at in (x, y))
    smooth = level[ix, iy] < 0.13
    off = np.abs(turned.elevation.heights[inside] - ground.heights[ix, iy])[smooth]
    assert smooth.sum() > 10_000 and off.max() < 0.07
    assert off[level[ix, iy][smooth] < 1e-6].max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_end_at_the_map_and_nothing_of_it_is_lost(kind):
    terrain, size = make_turned(kind, angle=37, seed=9), (8.0, 8.0)
    for box in terrain.boxes:
        reach = (np.abs(box.rotation) @ (0.5 * np.array(box.size)))[:2]
        # A tilted one leans out by its thickness besides.
        assert (box.centre[:2] - reach > -1.0).all() and (box.centre[:2] + reach < 9.0).all()
    big = Box(centre=(4.0, 3.0, 0.0), size=(30.0, 20.0, 0.4), rpy=(0.2, 0.0, 0.7))
    parts = trimmed([big], size)
    assert 1 < len(parts) < 2000
    assert rasterise(parts, size, 0.1).heights == pytest.approx(
        rasterise([big], size, 0.1).heights, abs=1e-9
    )
    inside = Box(centre=(4.0, 3.0, 0.0), size=(1.0, 1.0, 1.0))
    beside = Box(centre=(-4.0, 3.0, 0.0), size=(1.0, 1.0, 1.0))
    over = Box(centre=(0.0, 3.0, 0.0), size=(2 * OVERHANG, 1.0, 1.0))
    assert trimmed([inside, beside, over], size) == [inside, over]


@pytest.mark.parametrize("angle", [0.0, 22.0, 45.0])
@pytest.mark.parametrize("kind", ["bridge", "valley", "gaps"])
def test_there_is_no_way_round(kind, angle):
    for seed in range(1, 12, 2):
        terrain = make_turned(kind, angle=angle, seed=seed)
        ground = terrain.elevation
        flat, start, goal = (
            np.abs(ground.heights) < 0.35,  # walls and holes are none
            ground.cell_of(*terrain.start),
            ground.cell_of(*terrain.goal),
        )
        way = np.zeros(ground.shape, dtype=bool)
        if len(terrain.lane) == 4:
            begin, end = np.array(terrain.lane[1:3])
            for point in np.linspace(begin, end, 200):
                way[ground.cell_of(*point)] = True
            # The lane is free over its whole length, and as long as the obstacle.
            assert flat[way].all() and math.dist(begin, end) == pytest.approx(3.0)
            way = ndimage.binary_dilation(way, iterations=14)  # with all that is near it
        areas, _ = ndimage.label(flat & ~way, np.ones((3, 3)))
        assert areas[start] and areas[goal] and areas[start] != areas[goal]
        assert (ground.heights[start], ground.heights[goal]) == (0.0, 0.0)
        assert math.dist(terrain.start, terrain.goal) == pytest.approx(6.5)


def test_the_beam_has_the_width_of_the_scale_at_any_angle():
    beam = make_turned("bridge", angle=30, seed=1)
    begin, end = np.array(beam.lane[1:3])
    along = (end - begin) / 3.0
    assert math.degrees(math.atan2(along[1], along[0])) == pytest.approx(30)
    across = np.array([-along[1], along[0]])
    top = [b for b in beam.boxes if np.dot(np.array(b.centre[:2]) - begin, across) < 0.01
           and b.size[1] == pytest.approx(0.35)]  # fmt: skip
    assert top and {round(b.centre[2] + b.size[2] / 2, 6) for b in top} == {0.0}


def test_the_shortest_way_by_hand():
    gaps, beam = (make_turned(kind, angle=30, seed=1) for kind in ("gaps", "bridge"))
    assert shortest(gaps) == pytest.approx(6.5 - 0.35)
    start, begin, end, goal = np.array(beam.lane)
    legs = (np.linalg.norm(begin - start), 3.0, np.linalg.norm(goal - end))
    assert shortest(beam) == pytest.approx(sum(legs) - 0.35)
    assert shortest(beam) > 6.5 - 0.35


@pytest.mark.slow
def test_a_bridge_askew_is_planned_over_without_asking_for_more_headings(monkeypatch, capsys):
    def little_memory(shape, policies, switch_cost, headings):
        if headings.count > 8:
            raise TooLargeError("no room")

    terrain, zoo = make_turned("bridge", angle=22, seed=1), load_zoo("a1")
    given = terrain.elevation, {"bridge": zoo["bridge"]}, terrain.start, terrain.goal
    refused = plan_on_map(*given, finer_headings=8)
    assert refused.fused.shape[-1] == 8
    assert isinstance(refused.answer.error, UnreachableError | DoubtfulRouteError)
    planned = plan_on_map(*given, progress=True)
    assert planned.fused.shape[-1] == planned.route.num_headings == 48
    assert "no route along 8 headings: trying 48" in capsys.readouterr().err
    # Where that many do not fit into memory, the refusal stands.
    monkeypatch.setattr("fgtutor.planning.check_memory", little_memory)
    assert plan_on_map(*given).fused.shape[-1] == 8
    # Tensors that were given have the headings that they have.
    tensors = {"bridge": refused.tensors[0]}
    assert not plan_on_map(*given, tensors=tensors).answer


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kind": "mixed"}, "unknown obstacle 'mixed'"),
        ({"kind": "gaps", "robot": "cat"}, "unknown robot"),
        ({"kind": "gaps", "angle": math.nan}, "angle"),
        ({"kind": "gaps", "difficulty": 2.0}, "difficulty"),
        ({"kind": "gaps", "scale": TerrainScale(apron=3.9)}, "no room for an obstacle"),
    ],
)
def test_what_cannot_be_laid_is_refused(arguments, says):
    with pytest.raises(TerrainError, match=says):
        make_turned(**arguments)


def row(**fields):
    return {
        "terrain": "gaps",
        "angle": 30.0,
        "outcome": "reached",
        "length": 8.0,
        "shortest": 6.0,
        "planning": 1.0,
    } | fields


def test_the_table_by_hand():
    rows = [row(), row(length=5.9, planning=3.0), row(outcome="fell"), row(angle=0.0)]
    text = table([*rows, row(outcome="no_route", angle=0.0, length=0.0)]).splitlines()
    assert text[0] == (
        "| terrain | angle | success (%) | no route | fell | timeout | SPL | planning (s) |"
    )
    # (6 / 8 + 1 + 0) / 3; a way shorter than the shortest, by cutting corners, counts as that.
    assert text[2] == "| gaps | 30 | 67 (21-94) | 0 | 1 | 0 | 0.583 | 1.00 |"
    assert text[3] == "| gaps | 0 | 50 (9-91) | 1 | 0 | 0 | 0.375 | 1.00 |"


@pytest.mark.slow
def test_the_command_drives_reports_and_resumes(zoo, tmp_path, capsys, monkeypatch):
    config = TurnedConfig(
        robot="toy",
        terrains=("flat", "gaps"),
        angles=(0.0, 45.0),
        trials=2,
        zoo=zoo,
        workers=1,
        out=tmp_path / "report",
    )
    assert run(config) == 0
    printed = capsys.readouterr().out
    assert "4 of 4 tasks to do" in printed and "2 trials per cell" in printed
    assert "difficulty 1" in printed and "specialists gaps, steps, tau calibrated" in printed
    rows = json.loads((config.out / "rows.json").read_text())
    assert set(rows[0]) == set(turned.TurnedRow.__annotations__)
    assert [(r["terrain"], r["angle"]) for r in rows[::2]] == [
        ("flat", 0.0), ("flat", 45.0), ("gaps", 0.0), ("gaps", 45.0)]  # fmt: skip
    assert all(r["ground"] % 2 == r["seed"] % 2 == 1 and r["planning"] > 0 for r in rows)
    # A rolling toy reaches its goal on flat ground at any angle, and drops into the first gap.
    assert [r["outcome"] == "reached" for r in rows] == [True] * 4 + [False] * 4
    assert all(r["shortest"] == pytest.approx(7.5 - 0.35) for r in rows)
    assert all(r["planned"] == pytest.approx(7.5, abs=0.1) for r in rows if r["terrain"] == "flat")
    assert "| flat | 45 | 100 (34-100) | 0 | 0 | 0 | " in printed
    ElementTree.parse(config.out / "figures" / "success.svg")
    monkeypatch.setattr(trials, "execute_batch", lambda *_, **__: pytest.fail("driven again"))
    assert run(config) == 0
    assert "tasks to do" not in capsys.readouterr().out


def test_wrong_names_are_refused_before_anything_runs(zoo):
    with pytest.raises(TerrainError, match="unknown obstacle 'mixed'"):
        turned.make_tasks(TurnedConfig(terrains=("mixed",)))
    with pytest.raises(ConfigError, match="angles"):
        TurnedConfig(angles=(math.inf,))
    tasks = turned.make_tasks(TurnedConfig(terrains=("gaps",), angles=(0.0, 22.5), trials=30))
    assert [task.name for task in tasks] == [
        f"gaps-{angle}-{part}" for angle in ("0", "22.5") for part in ("00000-00025", "00025-00030")
    ]


def test_the_command_line_reads_its_options(capsys):
    assert main(["evaluate", "turned", "--angles", "nan"]) == 2
    assert "angles" in capsys.readouterr().err


def test_several_obstacles_share_one_course():
    course = Course(TerrainScale(width=2.0), 1.0, np.random.default_rng(0))
    boxes, (begin, end) = lay_turned("bridge", course, 3.0, (4.0, 5.0), math.pi / 2)
    assert not course.boxes and len(boxes) == 2
    # Along +y about (4, 5); the beam lies up to half a metre beside the middle.
    assert (begin[1], end[1]) == pytest.approx((3.5, 6.5))
    assert begin[0] == pytest.approx(end[0]) and abs(begin[0] - 4.0) <= 0.5


@pytest.mark.parametrize("angle", [0.0, 10.0, 22.0, 30.0, 37.0, 45.0])
def test_a_foot_drops_into_holes_and_into_no_valley_at_any_angle(angle):
    valley, gaps = (
        make_turned(kind, angle=angle, seed=1).elevation.heights for kind in ("valley", "gaps")
    )
    reach = round(RIM / 0.05)
    # At the bottom of walls of 50 degrees it is 25 cm * tan(50) below the ground 25 cm away.
    assert (rims(valley, reach) - valley).max() < 0.30 < DROP
    # A slot of 15 cm is a hole all along, 0.6 m deep; the border bends it.
    hole = (rims(gaps, reach) - gaps > DROP)[15:-15, 15:-15]
    assert (hole == (gaps < -0.5)[15:-15, 15:-15]).all() and hole.any()


@pytest.mark.parametrize("kind", ["gaps", "bridge", "valley", "mixed"])
def test_square_to_the_cells_what_counts_as_a_hole_is_what_a_square_window_says(kind):
    for seed in range(1, 8, 2):
        ground = make_terrain(kind, robot="a1", seed=seed).elevation.heights
        square = ndimage.grey_closing(np.pad(ground, 11, mode="edge"), 11)[11:-11, 11:-11]
        assert ((square - ground > DROP) == (rims(ground, 5) - ground > DROP)).all()
