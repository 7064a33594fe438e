"""One default everywhere: whoever plans on a map by settings of one name gets the same route."""

import ast
import importlib
import json
import re
import shlex
from dataclasses import fields, replace
from pathlib import Path

import pytest
import tyro

from fgtutor import fuse, load_zoo, plan, tensorize
from fgtutor.__main__ import COMMANDS
from fgtutor.baselines import AssessedMap, find_route, ours
from fgtutor.cli import demo
from fgtutor.cli import plan as plan_command
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.evaluation import trials
from fgtutor.execution import FollowConfig
from fgtutor.planning import PAPER, SETTINGS, PlanSettings, plan_on_map
from fgtutor.settings import PlanOptions

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks" / "src").glob("[01]*.py"))
PLANNING = ("demo", "plan", *(name for name in COMMANDS if name.startswith("evaluate ")))
# Calibration only weighs, and switching compares what each of our additions buys.
PLANNING = tuple(name for name in PLANNING if name.split()[-1] not in ("calibration", "switching"))


@pytest.fixture(scope="module")
def ground():
    return demo.toy_terrain()


@pytest.fixture(scope="module")
def zoo():
    return load_zoo("toy")


@pytest.fixture(scope="module", params=list(SETTINGS))
def asked(request, ground, zoo):
    """The name of the settings, and the route by `plan_on_map`."""
    settings = SETTINGS[request.param]
    return request.param, plan_on_map(
        ground.elevation, zoo, ground.start, ground.goal, settings=settings
    ).route


def same(route, expected) -> bool:
    return json.dumps(route) == json.dumps(expected.to_json())


def test_the_two_settings_say_what_they_are():
    assert PlanSettings() == SETTINGS["ours"] and SETTINGS["paper"] == PAPER
    assert str(PAPER) == (
        "tau paper, 8 headings, f_min 0.1, cost inverse, switch cost 0, hysteresis of 1 steps"
    )
    assert str(PlanSettings(taus=(0.2, 1.5))).startswith("tau 0.2 to 1.5, ")
    assert FollowConfig().hold_steps == PlanSettings().hold_steps


@pytest.mark.parametrize("command", PLANNING)
def test_every_command_that_plans_takes_the_settings_by_name(command):
    module, config, _ = COMMANDS[command]
    kind = getattr(importlib.import_module(f"fgtutor.{module}"), config)
    assert issubclass(kind, PlanOptions)
    needed = {"map": demo.MAP, "start": demo.START, "goal": demo.GOAL} if command == "plan" else {}
    needed |= {"newcomer": "steps"} if command == "evaluate newcomer" else {}
    for name, settings in SETTINGS.items():
        # Table I may go around: it asks for more feasible steps.
        f_min = 0.45 if command == "evaluate adaptation" else settings.f_min
        # The standard terrains lie along the axes: no others are tried for those that refuse.
        askew = command in ("demo", "plan", "walk", "evaluate turned", "evaluate openground")
        finer = settings.finer_headings if askew else 8
        expected = replace(settings, f_min=f_min, finer_headings=finer)
        assert kind(settings=name, **needed).planning == expected


def test_single_options_change_one_thing():
    assert PlanOptions().planning == PlanSettings()
    assert PlanOptions(settings="paper").planning == PAPER
    one = PlanOptions(settings="paper", switch_cost=2.0).planning
    assert (one.switch_cost, one.cost, one.taus) == (2.0, "inverse", "paper")


@pytest.mark.slow
def test_stage_by_stage(asked, ground, zoo):
    name, expected = asked
    settings = SETTINGS[name]
    options = {"taus": settings.taus, "headings": settings.headings}
    tensors = [tensorize(ground.elevation, one, **options) for one in zoo.values()]
    route = plan(
        *fuse(tensors),
        grid=ground.elevation,
        start=ground.start,
        goal=ground.goal,
        settings=settings,
        tensors=tensors,
        names=tuple(zoo),
    ).raise_for()
    assert same(route.to_json(), expected)


@pytest.mark.slow
def test_as_the_tables_plan(asked, ground, zoo):
    name, expected = asked
    ends, settings = (ground.start, ground.goal), SETTINGS[name]
    assessed = AssessedMap(ground.elevation, zoo, settings.taus, settings.headings)
    assert same(find_route(ours, assessed, *ends, settings).raise_for().to_json(), expected)


@pytest.mark.slow
def test_as_the_plan_command_plans(asked, tmp_path, capsys):
    name, expected = asked
    (x0, y0), (x1, y1) = demo.START, demo.GOAL
    line = f"--map {shlex.quote(str(demo.MAP))} --start {x0} {y0} --goal {x1} {y1}"
    line += f" --settings {name} --json {tmp_path / 'route.json'}"
    assert plan_command.run(tyro.cli(plan_command.PlanConfig, args=shlex.split(line))) == 0
    assert same(json.loads((tmp_path / "route.json").read_text()), expected)


@pytest.mark.slow
def test_as_the_demo_plans(asked, tmp_path, capsys):
    name, expected = asked
    config = demo.DemoConfig(robot="toy", out=tmp_path, settings=name, video="gif")
    demo.run(config)
    assert same(json.loads((tmp_path / "route.json").read_text()), expected)


def test_as_trials_plan_and_follow(asked, ground, zoo, monkeypatch):
    name, expected = asked
    driven = []

    def noted(routes, terrains, zoo, *, seeds, config, condition):
        driven.extend((route.to_json(), config.hold_steps) for route in routes)
        raise KeyboardInterrupt

    monkeypatch.setattr(trials, "execute_batch", noted)
    grounds = [trials.Ground(terrain=ground, seeds=(0,))]
    with pytest.raises(KeyboardInterrupt):
        list(trials.drive(grounds, {"ours": ours}, zoo, settings=SETTINGS[name]))
    ((route, hold_steps),) = driven
    assert same(route, expected) and hold_steps == SETTINGS[name].hold_steps


def test_as_the_sliders_plan(asked, ground, zoo):
    name, expected = asked
    explorer = Explorer(ground.elevation, zoo, ground.start, ground.goal, SETTINGS[name])
    assert explorer.route is not None and same(explorer.route.to_json(), expected)


def test_as_the_readme_plans(ground, zoo, monkeypatch, capsys):
    expected = plan_on_map(ground.elevation, zoo, ground.start, ground.goal).route
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    monkeypatch.setattr("fgtutor.make_terrain", lambda *_, **__: ground)
    monkeypatch.setattr("fgtutor.execute", lambda *_, **__: None)
    names: dict = {}
    exec(example, names)
    assert same(names["route"].to_json(), expected)


def settings_given(source: str) -> list[str]:
    """Return what a notebook's calls of the planner set by hand, as written."""
    planners = {"plan", "plan_on_map", "find_route", "drive", "tensorize", "assess", "AssessedMap"}
    names = {one.name for one in fields(PlanSettings)} | {"settings"}
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    return [
        ast.unparse(keyword)
        for call in calls
        if isinstance(call.func, ast.Name) and call.func.id in planners
        for keyword in call.keywords
        if keyword.arg in names
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem[:2])
def test_notebooks_plan_by_our_settings_but_where_another_is_the_subject(path):
    """05 and 06 show the paper's beside ours, 10 varies f_min, 07 and 12 the price of a switch."""
    subject = {
        "05": ["taus='paper'"],
        "06": ["settings=PAPER"] * 2,
        "07": ["switch_cost=0.0", "switch_cost=8.0"],
        "10": ["f_min=f_min"],
        "12": ["switch_cost=price"],
    }
    ours_said_aloud = ("taus='calibrated'", "settings=PlanSettings()")
    given = [one for one in settings_given(path.read_text()) if one not in ours_said_aloud]
    assert given == subject.get(path.stem[:2], [])


def test_no_command_of_a_table_needs_an_option_to_plan_as_the_table_did():
    pages = [ROOT / "README.md", ROOT / "docs" / "results.md"]
    lines = [
        line for page in pages for line in re.findall(r"fgtutor evaluate [^\n`]*", page.read_text())
    ]
    assert len(lines) > 5
    for line in lines:
        assert not re.search(r"--(cost|switch-cost|f-min|hold-steps)\b", line), line
