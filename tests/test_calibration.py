import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.evaluation.calibration import (
    CalibrationConfig,
    drive,
    run,
    run_task,
    strange_grounds,
    table,
)
from fgtutor.specialist import load_zoo, save_specialist


@pytest.fixture(scope="module")
def config(make_rolling, tmp_path_factory):
    """Two toys that only roll and predict f = 0.95 wherever they are."""
    zoo = tmp_path_factory.mktemp("zoo")
    for name in ("flat", "gaps"):
        save_specialist(make_rolling(name, f=0.95, provenance={"terrain": name}), zoo / name)
    return CalibrationConfig(envs=4, seconds=4.0, zoo=zoo, taus="paper", workers=1)


def evaluate(config):
    """Return the rows of both specialists by name."""
    return {name: run_task(config, name)[0] for name in ("flat", "gaps")}


@pytest.fixture(scope="module")
def results(config):
    """What the evaluation of these two says."""
    torch.manual_seed(1)
    return evaluate(config)


def test_a_drive_pairs_patches_with_what_followed(make_rolling, config):
    driven = drive(make_rolling("flat"), "flat", config)
    assert len(driven.label) == len(driven.command) == len(driven.patch) > 100
    # Rolling on flat ground tracks well; r_v is never above 1.
    assert 0.6 < driven.label.mean() < 1.0 and driven.label.max() <= 1.0


def test_a_net_that_promises_too_much_is_found_out(results):
    # A rolling toy drops into gaps and then tracks nothing, whatever its net predicts.
    assert results["gaps"]["calibration_error"] > results["flat"]["calibration_error"] + 0.1
    for name, row in results.items():
        assert row["ground"] == name and set(row["w_ood"]) == {"flat", "gaps"}
        assert sum(count for *_, count in row["calibration"]) == row["samples"]


def test_a_net_of_zeros_knows_flat_ground_and_no_gap(results):
    # It reconstructs zeros: no error on flat ground, a large one at gaps.
    assert results["flat"]["w_ood"] == {"flat": 1.0, "gaps": None}  # nothing is distinctive there
    assert results["gaps"]["w_ood"]["flat"] < 0.3


@pytest.mark.slow
def test_the_command_prints_a_table_and_writes_the_report(config, capsys, tmp_path):
    out = tmp_path / "report"
    assert run(replace(config, out=out)) == 0
    rows = json.loads((out / "rows.json").read_text())
    printed = capsys.readouterr().out
    assert "4 of 4 tasks to do\n" in printed
    assert table(rows) in printed and "tau paper" in printed
    text = (out / "table.md").read_text()
    assert table(rows) in text and "4 grounds in all" in text


def test_the_table_by_hand():
    def row(ground, error, flat, gaps):
        w_ood, auroc = ({"flat": a, "gaps": b} for a, b in zip(flat, gaps, strict=True))
        return {"ground": ground, "calibration_error": error, "w_ood": w_ood, "auroc": auroc}

    rows = [
        row("flat", 0.1, (0.9, None), (None, None)),
        row("gaps", 0.25, (0.3, 0.95), (0.8, None)),
        row("quarry", None, (0.1, 0.99), (0.2, 0.9)),
    ]
    # A column says whose patches they are, a line who is asked about them.
    assert table(rows).splitlines() == [
        "| specialist | calibration error | w_ood own | flat | gaps | quarry |",
        "| --- | --- | --- | --- | --- | --- |",
        "| flat | 0.100 | 0.90 | - | 0.30 / 0.95 | 0.10 / 0.99 |",
        "| gaps | 0.250 | 0.80 | - / - | - | 0.20 / 0.90 |",
    ]


def test_strange_ground_is_stranger_than_home(config, tmp_path):
    rng = np.random.default_rng(0)
    ElevationMap(rng.normal(0, 2.0, (40, 40)), 0.05).save(tmp_path / "cliffs.npz")
    config = replace(config, maps=(tmp_path / "cliffs.npz",))
    names = strange_grounds(config)
    assert names == ["rubble", "natural", "cliffs"]
    twice = replace(config, maps=(*config.maps, tmp_path / "elsewhere" / "cliffs.npz"))
    with pytest.raises(ConfigError, match=r"cliffs, cliffs: rename a map"):
        strange_grounds(twice)
    (row,) = run_task(config, names[-1])
    assert row["ground"] == "cliffs" and row["calibration_error"] is None
    assert row["w_ood"]["gaps"] < 0.05 and row["auroc"]["gaps"] > 0.9


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(config, results):
    torch.manual_seed(2)
    assert evaluate(config) == results


def test_what_cannot_be_checked_is_refused():
    with pytest.raises(ConfigError, match="envs"):
        CalibrationConfig(envs=0)


def test_the_a1_s_shipped_specialists_can_be_checked():
    steps = load_zoo("a1")["steps"]
    driven = drive(steps, "steps", CalibrationConfig(robot="a1", envs=2, seconds=1.6))
    assert len(driven.patch) == len(driven.command) == len(driven.label) > 20
    assert driven.label.min() >= 0 and steps.feasibility.reconstruction(driven.patch).std() > 0


def test_a_drive_is_under_the_conditions_asked_for(make_rolling, config):
    rolling = make_rolling("flat")
    training, same, other = (
        drive(rolling, "flat", replace(config, conditions=name))
        for name in ("training", "undisturbed", "disturbed")
    )
    assert (training.label == same.label).all()  # a toy is not disturbed in training
    assert (training.label != other.label).any()
