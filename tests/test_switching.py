import json
import math
from dataclasses import replace

import numpy as np
import pytest
import tyro

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, ReportError, TerrainError
from fgtutor.evaluation import switching
from fgtutor.evaluation import trials as trials_module
from fgtutor.evaluation.switching import (
    NEARLY_FREE,
    SwitchingConfig,
    charts,
    courses,
    lay_course,
    run,
    run_task,
    scan_map,
    table,
    variants,
)
from fgtutor.execution import execute_batch
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.robots import ROBOTS
from fgtutor.settings import PAPER
from fgtutor.world.terrain import make_terrain

ADDITIONS = {"switch_cost": 1.0, "hold_steps": 3}


@pytest.fixture
def config(zoo, monkeypatch):
    """A course of flat ground only, which rolling toys cross."""
    flat = replace(ROBOTS["toy"], order=("flat", "flat"))
    monkeypatch.setitem(ROBOTS, "toy", flat)
    return SwitchingConfig(
        trials=2,
        courses=("flat-flat",),
        planners=("ours", "+ all"),
        levels=((0.0, 0.0), (0.05, 0.02)),
        cost="inverse",  # the paper's winding routes: wandering shows in their length
        scan_spacing=0.5,
        zoo=zoo,
        workers=1,
    )


def test_the_courses_are_the_papers_transitions():
    assert list(courses(SwitchingConfig(robot="a1"))) == [
        "steps-valley", "valley-steps", "steps-gaps", "gaps-bridge", "bridge-steps", "full",
    ]  # fmt: skip
    toy = courses(SwitchingConfig(courses=("full", "gaps-rubble")))
    assert toy == {
        "gaps-rubble": ("gaps", "rubble"),
        "full": ("steps", "slopes", "steps", "gaps", "rubble", "steps"),
    }
    for robot in ROBOTS.values():  # every terrain that a robot specialises in
        assert set(robot.course) == set(robot.scale.mixed)


@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_a_course_lays_what_it_is_asked_for(robot):
    kinds = ROBOTS[robot].course
    terrain = lay_course(kinds, robot=robot, seed=1)
    assert terrain.name == "-".join(kinds)
    assert [part.name for part in terrain.sections] == list(kinds)
    # Apron 1.5 m, six sections of 3 m with five landings of 1 m between them, apron.
    assert terrain.elevation.size == pytest.approx((26.0, 4.0))
    ends = [(part.x0, part.x1) for part in terrain.sections]
    assert ends == [pytest.approx((1.5 + 4 * k, 4.5 + 4 * k)) for k in range(6)]
    assert (terrain.start, terrain.goal) == ((0.75, 2.0), (25.25, 2.0))
    flats = [(0.0, 1.5), *((end, end + 1.0) for _, end in ends[:-1]), (24.5, 26.0)]
    for x0, x1 in flats:
        assert (terrain.elevation.crop(x0, 0, x1, 4).heights == 0).all()
    for (x0, x1), name in zip(ends, kinds, strict=True):
        heights = terrain.elevation.crop(x0, 0, x1, 4).heights
        assert heights.min() < -0.4 if name in ("gaps", "bridge") else np.ptp(heights) > 0.05
    same, other = (lay_course(kinds, robot=robot, seed=seed) for seed in (1, 3))
    np.testing.assert_array_equal(terrain.elevation.heights, same.elevation.heights)
    assert other.elevation.shape == terrain.elevation.shape
    assert (other.elevation.heights != terrain.elevation.heights).any()


def test_the_variants_differ_in_what_they_are_named_after(make_rolling):
    config = SwitchingConfig(switch_cost=4.0, hold_steps=7)
    zoo = {name: make_rolling(name) for name in ("steps", "general")}
    assert {
        name: (settings.switch_cost, settings.hold_steps)
        for name, (_, settings) in variants(config, zoo).items()
    } == {
        "ours": (0.0, 1),
        "+ hysteresis": (0.0, 7),
        "+ both feasible": (NEARLY_FREE, 1),
        "+ switch cost": (4.0, 1),
        "+ all": (4.0, 7),
        "general": (0.0, 1),
    }
    # By the paper's settings too, the additions are ours, unless others are given.
    paper = variants(SwitchingConfig(settings="paper"), zoo)
    assert {(s.taus, s.cost) for _, s in paper.values()} == {("paper", "inverse")}
    assert (paper["ours"][1], paper["+ all"][1]) == (PAPER, replace(PAPER, **ADDITIONS))
    del zoo["general"]
    assert "general" not in variants(config, zoo)
    assert list(variants(replace(config, planners=("+ all",)), zoo)) == ["+ all"]


def test_a_nearly_free_switch_waits_until_both_can():
    # Along one line of 12 cells A can leave cells 0-8 and B cells 5-11, both alike well but for
    # cells 5-8, where A is the worse one; one more policy C is the best of all at cell 10 alone.
    a, b, c = np.zeros((3, 12, 2, 8))
    a[:9, 0, 0], a[5:9, 0, 0], b[5:, 0, 0], c[10, 0, 0] = 0.9, 0.5, 0.9, 0.95
    grid = ElevationMap(np.zeros((12, 2)))
    ends = {"start": (0.05, 0.05), "goal": (1.15, 0.05)}
    routes = [
        plan(*fuse([a, b, c]), grid=grid, tensors=[a, b, c], switch_cost=cost, **ends)
        for cost in (0.0, NEARLY_FREE, 2.0)
    ]
    assert [route.policies.tolist() for route in routes] == [
        [0] * 5 + [1] * 5 + [2],  # P: C at cell 10
        [0] * 5 + [1] * 5 + [2],  # B can leave cell 10 too
        [0] * 5 + [1] * 6,
    ]
    c[10, 0, 0], b[10, 0, 0] = 0.95, 0.0  # now C alone can leave cell 10
    free = plan(*fuse([a, b, c]), grid=grid, tensors=[a, b, c], switch_cost=0.0, **ends)
    assert free.policies.tolist() == [0] * 5 + [1] * 5 + [2]
    paid = plan(*fuse([a, b, c]), grid=grid, tensors=[a, b, c], switch_cost=NEARLY_FREE, **ends)
    assert not paid and "no chain of steps" in paid.reason


@pytest.mark.slow
def test_a_scan_is_close_to_the_truth_and_not_the_truth():
    terrain = make_terrain("steps", robot="toy", seed=1)
    seen = scan_map(terrain, seed=1, spacing=0.5)
    assert seen.shape == terrain.elevation.shape and seen.origin == terrain.elevation.origin
    error = np.abs(seen.heights - terrain.elevation.heights)[seen.known]
    assert 0 < np.median(error) < 0.02 and seen.known.mean() > 0.9
    again, other = (scan_map(terrain, seed=seed, spacing=0.5) for seed in (1, 2))
    np.testing.assert_array_equal(seen.heights, again.heights)
    assert not np.array_equal(seen.heights, other.heights, equal_nan=True)


@pytest.mark.slow
def test_the_command_drives_reports_and_resumes(config, capsys, monkeypatch):
    config = replace(config, out=config.zoo.parent / "report")
    assert run(config) == 0
    printed = capsys.readouterr().out
    assert "1 of 1 tasks to do" in printed
    rows = json.loads((config.out / "rows.json").read_text())
    goal = lay_course(("flat", "flat")).goal
    assert len(rows) == 2 * 2 * 2
    for row in rows:
        assert row["ground"] % 2 == 1 and row["seed"] == row["ground"]
        assert (row["course"], row["outcome"], row["switches"]) == ("flat-flat", "reached", 0)
        # The goal's radius, and half a cell from the goal to the middle of its cell.
        assert math.dist(row["end"], goal) <= 0.40
    # The same start; but who does not know where it is, wanders, and ends elsewhere. The toy's pace
    # is even here, so a length is a whole number of steps: one of the two may be no longer.
    ways = {(row["policy"], row["noise"], row["drift"], row["seed"]): row for row in rows}
    longer = 0.0
    for seed in (1, 3):
        lost, sure = ways["ours", 0.05, 0.02, seed], ways["ours", 0.0, 0.0, seed]
        assert lost["end"] != sure["end"] and lost["length"] >= sure["length"]
        longer += lost["length"] - sure["length"]
    assert longer > 0.02
    text = (config.out / "table.md").read_text()
    assert "| 5 + 2 | follower | + all | 100 (34-100) | 0 | 0 | 0 | 0.0 |" in text
    assert " at 0.85 m/s; told its exact velocity and the true heights around it" in text
    assert "8 trials in all" in text and "hysteresis of 3 steps" in text
    figures = sorted(path.name for path in (config.out / "figures").iterdir())
    assert figures == ["success-0-0.svg", "success-5-2.svg"]

    monkeypatch.setattr(switching, "scan_map", lambda *_, **__: pytest.fail("scanned again"))
    assert run(config) == 0
    assert capsys.readouterr().out == printed[printed.index("| noise") :]
    with pytest.raises(ReportError, match="switch_cost was 1"):
        run(replace(config, switch_cost=3.0))


@pytest.mark.slow
def test_the_fix_misleads_the_follower_or_displaces_the_scan_too(config, monkeypatch):
    config = replace(config, planners=("+ all",), levels=((0.05, 0.02),))
    displaced = []
    monkeypatch.setattr(
        trials_module,
        "execute_batch",
        lambda *given, config, **rest: (
            displaced.append(config.displaced_scan) or execute_batch(*given, config=config, **rest)
        ),
    )
    rows = run_task(replace(config, misled=("follower", "scan")), "flat-flat", range(1))
    assert [row["misled"] for row in rows] == ["follower", "scan"]
    assert displaced == [False, True]
    # A toy that only rolls looks at nothing: it goes the same way.
    assert rows[0] == rows[1] | {"misled": "follower"}


def test_planning_sees_the_scan_and_never_the_truth(config, monkeypatch):
    def blind(terrain, **_):
        heights = terrain.elevation.heights.copy()
        heights[50:52] = np.nan  # a strip that the scanner never saw
        return ElevationMap(heights, resolution=terrain.elevation.resolution)

    monkeypatch.setattr(switching, "scan_map", blind)
    rows = run_task(config, "flat-flat", range(1))
    assert [row["outcome"] for row in rows] == ["no_route"] * 4
    assert all("length" not in row for row in rows)
    assert "| 0 (0-79) | 1 | 0 | 0 | - |" in table(rows)


def trials(course, planner, outcomes, noise=0.03, switches=2, misled="follower"):
    return [
        {
            "course": course,
            "policy": planner,
            "noise": noise,
            "drift": 0.01,
            "misled": misled,
            "outcome": outcome,
            "switches": switches,
        }
        for outcome in outcomes
    ]


def test_the_table_and_the_charts_by_hand(tmp_path):
    rows = [
        *trials("steps-gaps", "ours", ["reached", "fell", "reached", "timeout"]),
        *trials("full", "ours", ["reached"] * 4, switches=5),
        *trials("steps-gaps", "general", ["no_route"] * 4),
        *trials("full", "general", ["no_route"] * 4),
        *trials("steps-gaps", "ours", ["reached"] * 4, noise=0.0, switches=1),
        *trials("full", "ours", ["reached"] * 4, noise=0.0, switches=1),
        *trials("steps-gaps", "ours", ["fell"] * 2, misled="scan"),
        *trials("full", "ours", ["reached", "fell"], misled="scan"),
    ]
    # Switches of the six successes: (2 + 2 + 4 * 5) / 6 = 4.
    assert table(rows).splitlines() == [
        "| noise + drift | misled | planner | steps-gaps | full | no route | fell | timeout "
        "| switches |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        "| 3 + 1 | follower | ours | 50 (15-85) | 100 (51-100) | 0 | 1 | 1 | 4.0 |",
        "| 3 + 1 | follower | general | 0 (0-49) | 0 (0-49) | 8 | 0 | 0 | - |",
        "| 0 + 1 | follower | ours | 100 (51-100) | 100 (51-100) | 0 | 0 | 0 | 1.0 |",
        "| 3 + 1 | scan | ours | 0 (0-66) | 50 (9-91) | 0 | 3 | 0 | 2.0 |",
    ]
    drawn = charts(rows)
    assert list(drawn) == ["success-3-1.svg", "success-0-1.svg", "scan-success-3-1.svg"]
    drawn["success-3-1.svg"](tmp_path / "chart.svg")
    drawn_words = (tmp_path / "chart.svg").read_text()  # letters are paths, words are comments
    assert all(f"<!-- {word}" in drawn_words for word in ("steps-gaps", "full", "ours", "general"))


def test_tasks_are_cut_by_trials_only(monkeypatch):
    tasks = switching.make_tasks(SwitchingConfig(trials=60, courses=("full",)))
    names = ["full-00000-00025", "full-00025-00050", "full-00050-00060"]
    assert [task.name for task in tasks] == names
    assert [list(task.arguments[2])[-1] for task in tasks] == [24, 49, 59]
    assert len(switching.make_tasks(SwitchingConfig(robot="a1", trials=200))) == 6 * 8


@pytest.mark.parametrize(
    "change",
    [
        {"trials": 0},
        {"hold_steps": 0},
        {"switch_cost": 0.0},
        {"levels": ()},
        {"levels": ((0.0, -1.0),)},
        {"scan_spacing": 0.0},
    ],
)
def test_settings_that_cannot_work_are_refused(change):
    with pytest.raises(ConfigError):
        SwitchingConfig(**change)


def test_wrong_names_are_refused_before_anything_runs(zoo):
    with pytest.raises(ConfigError, match="course named steps-moon"):
        run(SwitchingConfig(zoo=zoo, courses=("steps-moon",)))
    with pytest.raises(ConfigError, match="planner named wings"):
        run(SwitchingConfig(zoo=zoo, planners=("wings",)))
    with pytest.raises(ConfigError, match="wheelbarrow"):
        courses(SwitchingConfig(robot="wheelbarrow"))
    for kinds, robot in ((("steps", "moon"), "toy"), ((), "toy"), (("steps",), "wheelbarrow")):
        with pytest.raises(TerrainError, match="cannot lay"):
            lay_course(kinds, robot=robot)


def test_the_command_line_reads_its_options():
    words = [
        "--levels",
        "0",
        "0",
        "0.03",
        "0.01",
        "--courses",
        "full",
        "steps-gaps",
        "--switch-cost",
        "3",
    ]
    config = tyro.cli(SwitchingConfig, args=words)
    assert config.levels == ((0.0, 0.0), (0.03, 0.01))
    assert list(courses(config)) == ["steps-gaps", "full"] and config.switch_cost == 3.0
