"""What robots endure: their conditions, and the command that drives under each of them."""

import json
from dataclasses import fields, replace

import pytest

from fgtutor.errors import ConfigError, ReportError
from fgtutor.evaluation import robustness
from fgtutor.evaluation.robustness import (
    NOTHING,
    RobustnessConfig,
    axes,
    highest,
    is_passed,
    make_tasks,
    ranges,
    run,
    shares,
    table,
    worst,
)
from fgtutor.robots import ROBOTS, Robot, condition_of, conditions_of, env_class
from fgtutor.robots.a1.conditions import PHRASES, describe
from fgtutor.robots.a1.menagerie import MenagerieConfig
from fgtutor.robots.a1.randomise import DISTURBED, UNDISTURBED, A1EnvConfig
from fgtutor.robots.conditions import Axis, Condition
from fgtutor.statistics import Share
from fgtutor.world.terrain import World, make_terrain


@pytest.fixture
def config(zoo):
    return RobustnessConfig(trials=1, axes=("low-damping",), terrains=("flat",), zoo=zoo, workers=1)


@pytest.fixture
def puck(monkeypatch):
    monkeypatch.setitem(ROBOTS, "puck", Robot(env="puck:PuckEnv"))


# Conditions ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_every_condition_is_a_robot_that_can_be_made(robot):
    known = conditions_of(robot)
    world, made = World([[make_terrain("flat", robot=robot)]]), env_class(robot)
    still = replace(made.episodes, train=False)
    steps = set()
    for axis in known.axes.values():
        assert axis.levels
        for condition in axis.levels.values():
            steps.add(round(made(world, 1, config=still, **condition.options).control_dt, 9))
    assert len(steps) == 1, "policies act at one rate, however finely it is simulated"


@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_a_level_is_not_the_undisturbed_robot_and_no_two_are_alike(robot):
    known = conditions_of(robot)
    seen = [known.undisturbed.ranges]
    for name, axis in known.axes.items():
        for condition in axis.levels.values():
            assert condition.ranges not in seen or name == "together"
            seen.append(condition.ranges)


def test_an_axis_changes_one_thing_of_the_a1():
    for name, axis in conditions_of("a1").axes.items():
        if name in ("together", "model", "simulation"):
            continue
        changed = [
            {
                one.name
                for one in fields(A1EnvConfig)
                if getattr(level.options["settings"], one.name) != getattr(UNDISTURBED, one.name)
            }
            for level in axis.levels.values()
        ]
        assert all(len(own) <= 3 for own in changed), f"{name}: {changed}"
        assert set.intersection(*changed), f"{name} has no field that all its levels change"


def test_a_caption_says_every_range():
    assert describe(UNDISTURBED) == ""
    words = describe(DISTURBED)
    for part in ("friction 0.4 to 1.1", "payload 0 to 2 kg", "delay 0 to 0.03 s", "0.5 m/s"):
        assert part in words
    # A disturbance that training can draw has words: whatever is new must be said, too.
    reward = {"gait_frequency", "swing_height", "weights"}
    silent = {"randomise", "action_scale", "substeps"} | reward
    details = {"push_seconds", "noise_share", "scan_noise"}
    velocity = {"velocity", "velocity_error", "velocity_seconds"}
    assert {f.name for f in fields(A1EnvConfig)} == silent | details | velocity | PHRASES.keys()


def test_what_the_policy_is_told_of_its_velocity_is_said():
    axes = conditions_of("a1").axes
    assert condition_of("a1", "undisturbed").told.startswith("its exact velocity")
    assert axes["velocity"].levels["none"].told.startswith("no velocity")
    assert "0.2 m/s" in axes["velocity-error"].levels["0.2 m/s"].told
    assert condition_of("a1", "disturbed").told == "its velocity by leg odometry"


def test_a_caption_says_which_policies_estimate_their_velocity():
    told = RobustnessConfig(robot="a1").told(condition_of("a1", "disturbed"))
    assert told.endswith(
        "told its velocity by leg odometry; but bridge, gaps, steps, valley estimate the velocity "
        "from what they sense"
    )
    assert "estimate" not in RobustnessConfig(robot="toy").told(condition_of("toy", "undisturbed"))


def test_a_report_keeps_every_range_and_which_model():
    shipped = conditions_of("a1").axes["model"].levels["Menagerie as it ships"]
    assert shipped.ranges["model"]["kind"] == "MenagerieConfig"
    assert shipped.ranges["model"]["damping"] == MenagerieConfig.damping
    assert shipped.ranges["settings"]["friction"] == UNDISTURBED.friction
    assert not condition_of("a1", "undisturbed").ranges["settings"]["randomise"]


def test_a_robot_without_disturbances_says_which_have_some(puck):
    assert condition_of("puck", "undisturbed").options == {}
    with pytest.raises(ConfigError, match="disturbances of puck; choose a robot of toy, a1"):
        condition_of("puck", "disturbed")
    with pytest.raises(ConfigError, match="disturbances of puck; choose a robot of toy, a1"):
        axes(RobustnessConfig(robot="puck"))


# The command --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_drives_every_level_reports_and_resumes(config, capsys, monkeypatch):
    config = replace(config, out=config.zoo.parent / "report")
    assert run(config) == 0
    rows = json.loads((config.out / "rows.json").read_text())
    own = [(NOTHING, "-"), ("low-damping", "x 0.5")]
    assert [(row["axis"], row["level"]) for row in rows] == own
    assert rows[0]["length"] != rows[1]["length"] and rows[0]["ground"] == rows[1]["ground"]
    text = (config.out / "table.md").read_text()
    assert "| undisturbed | - | 100 (21-100) | yes |" in text
    assert "Highest level passed, after all milder ones: low-damping x 0.5." in text
    assert " at 0.85 m/s; told its exact velocity" in text and "Worst: " in text
    assert len(text.strip().split("\n\n")) == 3
    stored = json.loads((config.out / "run.json").read_text())["settings"]["conditions"]
    changes = stored["changes"]["low-friction"]["x 0.4"]["model"]
    assert changes == {"friction": 0.4} and stored[NOTHING]["model"]["friction"] == 1.0
    capsys.readouterr()

    planned, drawn = [], robustness.make_ground
    monkeypatch.setattr(robustness, "make_ground", lambda *a: planned.append(a) or drawn(*a))
    assert run(config) == 0 and not planned
    assert capsys.readouterr().out.startswith("| axis | level | flat | passed |")
    # One more axis in the same folder: only that one is driven.
    assert run(replace(config, axes=(*config.axes, "simulation"))) == 0
    assert "1 of 3 tasks to do" in capsys.readouterr().out
    with pytest.raises(ReportError, match="planner was"):
        run(replace(config, planner="steps"))


def test_tasks_are_one_axis_on_one_terrain_and_wrong_names_are_refused(config):
    tasks = make_tasks(replace(config, trials=60, terrains=("flat", "mixed")))
    assert [task.name for task in tasks[:4]] == [
        "undisturbed-flat-00000-00050",
        "low-damping-flat-00000-00050",
        "undisturbed-flat-00050-00060",
        "low-damping-flat-00050-00060",
    ]
    assert len(tasks) == 2 * 2 * 2
    with pytest.raises(ConfigError, match="axis named wind"):
        run(replace(config, axes=("wind",)))
    with pytest.raises(ConfigError, match="planner named wings"):
        run(replace(config, planner="wings"))
    with pytest.raises(ConfigError, match="wheelbarrow"):
        axes(RobustnessConfig(robot="wheelbarrow"))


def rows(axis, level, terrain, reached, fell=0):
    return [
        {"axis": axis, "level": level, "terrain": terrain, "outcome": outcome}
        for outcome in ["reached"] * reached + ["fell"] * fell
    ]


def test_the_table_the_highest_level_and_the_worst_case_by_hand():
    trials = [
        *rows(NOTHING, "-", "steps", 10),
        *rows(NOTHING, "-", "mixed", 10),
        *rows("delay", "10 ms", "steps", 10),
        *rows("delay", "10 ms", "mixed", 9, 1),
        *rows("delay", "20 ms", "steps", 10),
        *rows("delay", "20 ms", "mixed", 8, 2),
        *rows("delay", "30 ms", "steps", 10),
        *rows("delay", "30 ms", "mixed", 10),
    ]
    assert table(trials, 0.9).splitlines()[2:] == [
        "| undisturbed | - | 100 (72-100) | 100 (72-100) | yes |",
        "| delay | 10 ms | 100 (72-100) | 90 (60-98) | yes |",
        "| delay | 20 ms | 100 (72-100) | 80 (49-94) | no |",
        "| delay | 30 ms | 100 (72-100) | 100 (72-100) | yes |",
    ]
    cells = shares(trials)
    levels = {name: Condition(words=name) for name in ("10 ms", "20 ms", "30 ms")}
    assert highest(cells, "delay", Axis(levels=levels), 0.9) == "delay 10 ms"
    assert highest(cells, "delay", Axis(levels=levels), 0.95) == "delay none"
    assert highest(cells, "delay", Axis(levels=levels), 0.8) == "delay 30 ms"
    unordered = Axis(levels=levels, ordered=False)
    assert highest(cells, "delay", unordered, 0.9) == "delay 10 ms; 30 ms"
    assert worst(cells) == "delay 20 ms on mixed, 80 (49-94) %"
    assert is_passed({"steps": Share(successes=9, trials=10)}, 0.9)


def test_only_what_a_level_changes_is_stored():
    known = conditions_of("a1")
    stored = ranges(known.axes, known.undisturbed)
    delayed = stored["changes"]["delay"]["40 ms"]
    assert delayed == {"settings": {"randomise": True, "delay": (0.04, 0.04)}, "model": {}}
    assert stored["changes"]["model"]["Menagerie as it ships"]["model"]["cone"] == "elliptic"
