import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from fgtutor import patches, planning
from fgtutor.cli.plan import PlanConfig, choose, run
from fgtutor.elevation import ElevationMap
from fgtutor.errors import (
    ConfigError,
    InfeasibleCellError,
    MapError,
    OffMapError,
    StorageError,
    ThresholdError,
    UnknownCellError,
    UnreachableError,
)
from fgtutor.io import progress
from fgtutor.planning import PAPER, Refusal, Route, plan_on_map
from fgtutor.specialist import save_specialist


@pytest.fixture
def case(make_rolling, tmp_path):
    """A flat map with one unknown cell, and a zoo of a sure and an unsure policy on disk."""
    heights = np.zeros((30, 20))
    heights[15, 10] = np.nan
    ElevationMap(heights).save(tmp_path / "map.npz")
    for name, f in (("sure", 0.9), ("unsure", 0.3)):
        save_specialist(make_rolling(name, f=f), tmp_path / "zoo" / name)
    return {
        "map": tmp_path / "map.npz",
        "zoo": tmp_path / "zoo",
        "start": (0.5, 1.0),
        "goal": (2.5, 1.0),
        "taus": "paper",
    }


def test_the_command_plans_and_writes_the_route(case, tmp_path, capsys):
    assert run(PlanConfig(json=tmp_path / "route.json", **case)) == 0
    route = Route.from_json(json.loads((tmp_path / "route.json").read_text()))
    assert route.names == ("sure", "unsure") and set(route.policies) == {0}
    # 18 straight steps and, around the unknown cell, two diagonal ones, all of f = 0.9.
    assert route.cost == pytest.approx(0.1 * (18 + 2 * math.sqrt(2)) / 0.9, rel=1e-5)
    assert [15, 10] not in route.cells.tolist()
    assert "20 steps" in capsys.readouterr().out


@pytest.mark.slow
def test_the_plan_is_drawn_and_so_is_a_refusal(case, tmp_path, capsys):
    assert run(PlanConfig(figure=tmp_path / "plan.png", **case)) == 0
    assert "figure -> " in capsys.readouterr().out
    with pytest.raises(InfeasibleCellError):
        run(PlanConfig(figure=tmp_path / "refused.png", f_min=0.95, **case))
    for name in ("plan.png", "refused.png"):
        with Image.open(tmp_path / name) as picture:
            assert picture.width > 800
    with pytest.raises(StorageError, match="nowhere"):
        run(PlanConfig(figure=tmp_path / "nowhere" / "plan.png", **case))


def test_every_stage_is_kept(case, make_rolling):
    zoo = {"a": make_rolling("a", f=0.4), "b": make_rolling("b", f=0.6)}
    elevation = ElevationMap.load(case["map"])
    plan = plan_on_map(elevation, zoo, case["start"], case["goal"], settings=PAPER)
    assert plan.names == ("a", "b") and len(plan.tensors) == 2
    assert torch.equal(plan.fused, torch.maximum(*plan.tensors))
    assert plan.route.choices.shape == (20, 2)


def test_tensors_already_computed_are_used(case, make_rolling):
    elevation = ElevationMap.load(case["map"])
    ones = torch.ones(30, 20, 8)
    plan = plan_on_map(
        elevation, {"a": make_rolling("a")}, case["start"], case["goal"], tensors={"a": ones}
    )
    assert plan.tensors[0] is ones and plan.weights == {}
    assert plan.route.cost == pytest.approx(0.1 * (18 + 2 * math.sqrt(2)))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"start": (9.0, 1.0)}, OffMapError, "start"),
        ({"goal": (1.55, 1.05)}, UnknownCellError, "goal"),
        ({"f_min": 0.95}, InfeasibleCellError, "f_min"),
        ({"policies": ("wings",)}, ConfigError, "wings"),
        ({"policies": ("sure", "sure")}, ConfigError, "policies: .*only once"),
        ({"start": (math.nan, 1.0)}, ConfigError, "start.*finite"),
        ({"goal": (1.0, math.inf)}, ConfigError, "goal.*finite"),
        ({"f_min": math.nan}, ConfigError, "f_min"),
        ({"f_min": 0.0}, ConfigError, "f_min"),
        ({"switch_cost": -1.0}, ConfigError, "switch_cost"),
        ({"switch_cost": math.inf}, ConfigError, "switch_cost"),
    ],
)
def test_bad_requests_say_which_and_what_to_do(case, change, error, message):
    with pytest.raises(error, match=message):
        run(PlanConfig(**case | change))


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"start": (9.0, 1.0)}, OffMapError),
        ({"goal": "there"}, ConfigError),
        ({"f_min": -1.0}, ConfigError),
        ({"backend": "astar"}, ConfigError),
        ({"taus": (2.0, 1.0)}, ThresholdError),
    ],
)
def test_what_cannot_work_is_refused_before_the_map_is_tensorized(
    case, make_rolling, monkeypatch, change, error
):
    monkeypatch.setattr(patches, "prepare", None)  # the first thing that tensorizing calls
    arguments = {"start": case["start"], "goal": case["goal"]} | change
    with pytest.raises(error):
        plan_on_map(ElevationMap.load(case["map"]), {"a": make_rolling("a")}, **arguments)


def test_a_refusal_says_for_each_policy_what_it_finds_there(case, make_rolling, capsys):
    heights = np.zeros((30, 20))
    heights[14:17] = np.nan
    ElevationMap(heights).save(case["map"])
    with pytest.raises(UnreachableError, match=r"nearest to the goal .* \(1.35, 1.05\) m"):
        run(PlanConfig(**case))
    assert "leads onto ground that was never observed" in capsys.readouterr().out

    zoo = {"a": make_rolling("a"), "b": make_rolling("b")}
    elevation = ElevationMap(np.zeros((9, 9)))
    known = {name: torch.ones(9, 9, 8) for name in zoo}
    known["a"][4], known["b"][4] = 0.05, 0.0
    plan = plan_on_map(elevation, zoo, (0.15, 0.45), (0.85, 0.45), tensors=known)
    weights = {"a": torch.full((9, 9, 8), 0.9), "b": torch.zeros(9, 9, 8)}
    assert replace(plan, weights=weights).why_not(elevation) == [
        "On from (0.45, 0.45) m towards +x:",
        "a: F = 0.05, w_ood = 0.90 (it knows such ground)",
        "b: F = 0.00, w_ood = 0.00 (it has hardly seen such ground)",
    ]
    assert plan.why_not(elevation)[1:] == ["a: F = 0.05", "b: F = 0.00"]  # of given tensors
    assert plan_on_map(elevation, zoo, (0.15, 0.45), (0.25, 0.45)).why_not(elevation) == []


def test_an_end_never_observed_is_refused_before_the_map_is_tensorized(
    case, make_rolling, monkeypatch
):
    monkeypatch.setattr(patches, "prepare", None)
    arguments = {"start": case["start"], "goal": (1.55, 1.05)}
    plan = plan_on_map(ElevationMap.load(case["map"]), {"a": make_rolling("a")}, **arguments)
    assert isinstance(plan.answer, Refusal) and isinstance(plan.answer.error, UnknownCellError)
    with pytest.raises(UnknownCellError):
        plan.route  # noqa: B018


def test_a_long_plan_says_how_long(case, monkeypatch, capsys):
    for name in ("QUICK", "TRIED", "LONG"):
        monkeypatch.setattr(progress, name, 0.0)
    monkeypatch.setattr(planning, "QUICK", 0.0)
    assert run(PlanConfig(**case)) == 0
    shown = capsys.readouterr()
    assert "assessing 30 x 20 cells for 2 policies: about" in shown.err
    assert "searching the route: about 0 s" in shown.err
    assert shown.out.startswith("Route(") and "\n" not in shown.out.strip()


def test_a_missing_map_and_a_folder_that_is_none(case, tmp_path):
    with pytest.raises(MapError, match="nowhere"):
        run(PlanConfig(**case | {"map": tmp_path / "nowhere.npz"}))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        run(PlanConfig(json=tmp_path / "file" / "route.json", **case))


def test_an_empty_zoo_is_refused(case):
    with pytest.raises(ConfigError, match="at least one"):
        plan_on_map(ElevationMap.load(case["map"]), {}, (0.5, 1.0), (2.5, 1.0))


def test_choose_keeps_the_order_asked_for(make_rolling):
    zoo = {name: make_rolling(name) for name in ("a", "b", "c")}
    assert list(choose(zoo, ("c", "a"))) == ["c", "a"]
    assert choose(zoo, ()) is zoo
