import json
from collections import Counter
from dataclasses import replace

import pytest

from fgtutor.errors import ConfigError, EvaluationError, TerrainError
from fgtutor.evaluation.newcomer import (
    NewcomerConfig,
    compare_tensors,
    run,
    run_task,
    table,
    terrains,
    zoos,
)
from fgtutor.specialist import save_specialist


@pytest.fixture
def config(make_rolling, tmp_path):
    """One who can do nothing (gaps), a newcomer who rolls (steps), and a generalist."""
    for name, f in (("steps", 0.8), ("gaps", 0.05), ("general", 0.6)):
        save_specialist(make_rolling(name, f=f), tmp_path / "zoo" / name)
    return NewcomerConfig(
        newcomer="steps",
        terrain="flat",
        others=("gaps",),
        trials=2,
        zoo=tmp_path / "zoo",
        workers=1,
        out=tmp_path / "report",
    )


def test_the_folder_is_missing_and_then_there(config):
    names = [list(zoo) for zoo in zoos(config)]
    assert names == [["gaps"], ["gaps", "steps"]]
    assert (config.zoo / "steps" / "specialist.json").exists()


@pytest.mark.slow
def test_a_newcomer_may_lie_outside_the_zoo(config, make_rolling, tmp_path):
    folder = save_specialist(make_rolling("rubble", f=0.8), tmp_path / "run" / "specialist")
    outside = replace(config, newcomer=str(folder))
    assert [list(zoo) for zoo in zoos(outside)] == [["gaps", "steps"], ["gaps", "rubble", "steps"]]
    assert outside.zoo_digests().keys() == {"gaps", "general", "specialist", "steps"}
    assert run(outside) == 0
    written = (config.out / "table.md").read_text()
    assert "tensors of gaps, steps are bit-identical without and with rubble on all 4" in written
    assert not (config.zoo / "rubble").exists()


def test_a_newcomer_of_a_name_that_the_zoo_has_is_refused(config, make_rolling, tmp_path):
    folder = save_specialist(make_rolling("gaps"), tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="gaps is in the zoo already"):
        run(replace(config, newcomer=str(folder)))


@pytest.mark.slow
def test_the_report_tells_before_from_after(config, capsys):
    assert run(config) == 0
    printed = capsys.readouterr().out
    # gaps believes in nothing (f = 0.05 < f_min); the newcomer rolls over flat ground, and drops
    # into the first gap that it believes it can cross.
    assert "| flat | 0 (0-66) | 2 / 0 / 0 | 100 (34-100) | 0 / 0 / 0 |" in printed
    assert "| gaps | 0 (0-66) | 2 / 0 / 0 | 0 (0-66) | 0 / " in printed
    says = "The tensors of gaps are bit-identical without and with steps on all 4 maps (4 pairs"
    assert says in printed
    written = (config.out / "table.md").read_text()
    assert "| terrain | without steps, % |" in written and says in written
    assert "8 trials in all" in written
    rows = json.loads((config.out / "rows.json").read_text())
    assert [row["policy"] for row in rows if row["terrain"] == "flat"] == [
        "without", "without", "with", "with",
    ]  # fmt: skip
    before, after = rows[0]["tensors"], rows[2]["tensors"]
    assert list(before) == ["gaps"] and list(after) == ["gaps", "steps"]
    assert before["gaps"] == after["gaps"] != after["steps"]
    assert (config.out / "figures" / "success.svg").exists()
    assert json.loads((config.out / "run.json").read_text())["settings"]["newcomer"] == "steps"


@pytest.mark.slow
def test_a_tensor_that_changes_is_an_error(config):
    rows = run_task(replace(config, out=None), "flat", ("without", "with"), [0])
    assert "1 maps (1 pairs" in compare_tensors(rows, "steps")
    for tensors in ({"gaps": "0", "steps": "1"}, {"steps": "1"}):
        changed = [row | {"tensors": tensors} if row["policy"] == "with" else row for row in rows]
        with pytest.raises(EvaluationError, match="steps changed the tensor of gaps"):
            compare_tensors(changed, "steps")


def test_the_table_by_hand():
    def trial(terrain, policy, outcome):
        return {"terrain": terrain, "policy": policy, "outcome": outcome}

    trials = [
        *(trial("ramp", "without", outcome) for outcome in ("no_route", "fell")),
        *(trial("ramp", "with", outcome) for outcome in ("reached", "timeout")),
    ]
    assert table(trials, "new").splitlines()[2] == (
        "| ramp | 0 (0-66) | 1 / 1 / 0 | 50 (9-91) | 0 / 0 / 1 |"
    )


def test_terrains_are_its_own_and_the_robots(config):
    assert terrains(config) == ("flat", "gaps")
    default = replace(config, terrain=None, others=())
    assert terrains(default) == ("steps", "gaps", "slopes", "rubble", "mixed")
    assert terrains(replace(default, newcomer="gaps"))[0] == "gaps"


def test_what_cannot_be_compared_is_refused(config, make_rolling, tmp_path):
    with pytest.raises(ConfigError, match="'wings' of gaps, steps"):
        run(replace(config, newcomer="wings"))
    with pytest.raises(ConfigError, match="'general'"):  # it is no specialist
        run(replace(config, newcomer="general"))
    with pytest.raises(TerrainError, match="moon"):
        run(replace(config, terrain="moon"))
    save_specialist(make_rolling("steps"), tmp_path / "alone" / "steps")
    with pytest.raises(ConfigError, match="others"):
        run(replace(config, zoo=tmp_path / "alone"))
    assert not config.out.exists()


@pytest.mark.slow
def test_the_shipped_toys_gain_by_the_rubble_specialist(tmp_path):
    config = NewcomerConfig(others=("rubble",), trials=10, workers=1, out=tmp_path / "report")
    assert run(config) == 0
    rows = json.loads((tmp_path / "report" / "rows.json").read_text())
    reached = Counter(row["policy"] for row in rows if row["outcome"] == "reached")
    assert reached["with"] >= 9 and reached["with"] > reached["without"]
    written = (tmp_path / "report" / "table.md").read_text()
    assert "The tensors of gaps, slopes, steps are bit-identical" in written
    assert "on all 10 maps (30 pairs" in written
