import json
from dataclasses import replace

import pytest
import torch

from fgtutor.errors import ConfigError, StorageError
from fgtutor.evaluation.calibration import CalibrationConfig, drive, evaluate, report, run
from fgtutor.specialist import load_zoo, save_specialist


@pytest.fixture
def config(make_rolling, tmp_path):
    """Two toys that only roll and predict f = 0.95 wherever they are."""
    for name in ("flat", "gaps"):
        save_specialist(
            make_rolling(name, f=0.95, provenance={"terrain": name}), tmp_path / "zoo" / name
        )
    return CalibrationConfig(envs=4, seconds=4.0, zoo=tmp_path / "zoo", taus="paper")


def test_a_drive_pairs_predictions_with_what_followed(make_rolling, config):
    driven = drive(make_rolling("flat", f=0.8), "flat", config)
    assert len(driven.predicted) == len(driven.measured) == len(driven.patch) > 100
    assert driven.predicted == pytest.approx(0.8, abs=1e-5)
    # Rolling on flat ground tracks well; r_v is never above 1.
    assert 0.6 < driven.measured.mean() < 1.0 and driven.measured.max() <= 1.0


def test_a_net_that_promises_too_much_is_found_out(config):
    results = evaluate(config)
    # A rolling toy drops into gaps and then tracks nothing, whatever its net predicts.
    assert results["gaps"]["calibration_error"] > results["flat"]["calibration_error"] + 0.1
    for name, row in results.items():
        assert set(row["w_ood_others"]) == {"flat", "gaps"} - {name}
        assert sum(count for *_, count in row["calibration"]) == row["samples"]


def test_a_net_of_zeros_knows_flat_ground_and_no_gap(config):
    results = evaluate(config)
    # It reconstructs zeros: no error on flat ground, a large one at gaps.
    assert results["flat"]["w_ood_own"] == 1.0
    assert results["flat"]["w_ood_others"]["gaps"] < 0.3


def test_the_command_prints_a_table_and_writes_the_numbers(config, capsys, tmp_path):
    out = tmp_path / "numbers.json"
    assert run(replace(config, json=out)) == 0
    results = json.loads(out.read_text())
    printed = capsys.readouterr().out
    assert report(results) in printed and "tau paper" in printed


def test_the_same_seed_gives_the_same_numbers(config):
    torch.manual_seed(1)
    first = evaluate(config)
    torch.manual_seed(2)
    assert evaluate(config) == first


def test_what_cannot_be_checked_is_refused(config, tmp_path):
    with pytest.raises(ConfigError, match="envs"):
        CalibrationConfig(envs=0)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        run(replace(config, json=tmp_path / "file" / "numbers.json"))


def test_the_a1_s_shipped_specialists_can_be_checked():
    steps = load_zoo("a1")["steps"]
    driven = drive(steps, "steps", CalibrationConfig(robot="a1", envs=2, seconds=1.6))
    assert len(driven.predicted) == len(driven.measured) > 20
    assert driven.measured.min() >= 0 and driven.predicted.std() > 0
