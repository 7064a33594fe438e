import json
from dataclasses import replace

import pytest

from fgtutor.errors import ConfigError, StorageError, TerrainError
from fgtutor.evaluation.matrix import (
    MatrixConfig,
    Trial,
    evaluate,
    policies,
    run,
    summarise,
    table,
    terrain_seed,
)
from fgtutor.specialist import save_specialist


@pytest.fixture
def zoo(make_rolling, tmp_path):
    """Three policies that only roll: two say they can, one (gaps) says it can do nothing."""
    for name, f in (("steps", 0.8), ("gaps", 0.05), ("general", 0.6)):
        save_specialist(make_rolling(name, f=f), tmp_path / "zoo" / name)
    return tmp_path / "zoo"


@pytest.fixture
def config(zoo):
    return MatrixConfig(
        trials=3, terrains=("flat", "gaps"), zoo=zoo, workers=1, json=zoo.parent / "rows.json"
    )


def test_rows_name_every_outcome(config):
    rows = {(row["terrain"], row["policy"]): row for row in evaluate(config)}
    assert list(rows) == [
        (terrain, policy)
        for terrain in ("flat", "gaps")
        for policy in ("gaps", "steps", "ours", "general")
    ]
    for row in rows.values():
        assert row["trials"] == 3 == row["successes"] + sum(row["failures"].values())
        assert set(row["failures"]) == {"no_route", "fell", "timeout"}
        assert 0 <= row["ci95"][0] <= row["successes"] / 3 <= row["ci95"][1] <= 1
    # On flat ground rolling is enough; a policy that predicts f = 0.05 refuses everywhere (f_min).
    assert rows["flat", "steps"]["successes"] == rows["flat", "ours"]["successes"] == 3
    assert rows["flat", "gaps"]["failures"]["no_route"] == 3
    # A rolling toy that believes in itself drops an axle into the first gap, and hangs there.
    assert rows["gaps", "steps"]["successes"] == 0
    assert rows["gaps", "steps"]["failures"]["no_route"] == 0


def test_the_number_of_workers_changes_nothing(config, monkeypatch):
    monkeypatch.setattr("fgtutor.evaluation.matrix.BATCH", 2)
    alone = evaluate(replace(config, terrains=("gaps",)))
    assert evaluate(replace(config, terrains=("gaps",), workers=2)) == alone


def test_a_part_of_the_table_equals_that_part_of_the_whole(config):
    whole = {(row["terrain"], row["policy"]): row for row in evaluate(config)}
    part = evaluate(replace(config, terrains=("gaps",), policies=("ours",)))
    assert part == [whole["gaps", "ours"]]


def test_the_command_writes_rows_and_prints_a_table(config, capsys):
    assert run(replace(config, terrains=("flat",))) == 0
    rows = json.loads(config.json.read_text())
    assert [row["policy"] for row in rows] == ["gaps", "steps", "ours", "general"]
    printed = capsys.readouterr().out
    assert "| flat | 0.0 | 100.0 | 100.0 | 100.0 |" in printed and "3 trials a cell" in printed


def test_evaluation_never_draws_a_training_seed():
    seeds = {terrain_seed(seed, trial) for seed in range(3) for trial in range(500)}
    assert len(seeds) == 1500 and all(seed % 2 == 1 for seed in seeds)


def test_summary_by_hand():
    outcomes = ("reached", "reached", "fell", "no_route")
    row = summarise(
        [Trial(terrain="t", policy="p", seed=i, outcome=o) for i, o in enumerate(outcomes)]
    )
    assert row["successes"] == 2 and row["failures"] == {"no_route": 1, "fell": 1, "timeout": 0}
    assert row["ci95"] == pytest.approx([0.15, 0.85], abs=0.005)  # Wilson's interval for 2 of 4
    assert table([row]) == "| terrain | p |\n|---|---|\n| t | 50.0 |"


def test_wrong_names_are_refused_before_anything_runs(config):
    with pytest.raises(TerrainError, match="moon"):
        evaluate(replace(config, terrains=("moon",)))
    with pytest.raises(TerrainError, match="moon"):
        evaluate(replace(config, terrains=("flat", "moon")))
    with pytest.raises(ConfigError, match="wings"):
        evaluate(replace(config, policies=("wings",)))
    with pytest.raises(ConfigError, match="trials"):
        MatrixConfig(trials=0)


def test_policies_come_in_the_tables_order(config, make_rolling):
    zoo = {name: make_rolling(name) for name in ("general", "steps", "gaps")}
    assert policies(config, zoo) == ("steps", "gaps", "ours", "general")
    assert policies(replace(config, policies=("ours", "gaps")), zoo) == ("gaps", "ours")


def test_rows_that_cannot_be_written_are_reported_before_the_work(config):
    (config.zoo.parent / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        run(replace(config, json=config.zoo.parent / "file" / "rows.json"))
