"""The benchmarks run: every one of them on its smallest size, with no word on how fast."""

import importlib
import json
import math
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"
BENCHES = ("tensorize", "plan", "widgets", "env", "scan", "map", "growth")


@pytest.fixture(autouse=True)
def beside(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.slow
def test_a_benchmark_gives_numbers(name):
    rows = importlib.import_module("run").run("tiny", [name])
    assert rows
    for row in rows:
        assert row.bench and row.what and row.unit in {"x", "s", "ms", "MB", "exponent"}
        assert all(map(math.isfinite, (row.low, row.median, row.high)))
        assert row.low <= row.median <= row.high
        assert row.unit == "exponent" or row.low >= 0


def test_every_benchmark_is_run():
    assert set(importlib.import_module("run").BENCHES) == set(BENCHES)
    assert {path.stem.removeprefix("bench_") for path in FOLDER.glob("bench_*.py")} == {
        *BENCHES, "grading",  # which measures a class, not the method
    }  # fmt: skip


def test_rivals_take_turns_and_ratios_are_of_one_round():
    harness = importlib.import_module("harness")
    order = []
    times = harness.in_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3  # the first round only warms up
    assert [len(spent) for spent in times.values()] == [2, 2]
    assert harness.ratios({"slow": [6.0, 9.0], "fast": [2.0, 1.0]}, "slow", "fast") == [3.0, 9.0]
    row = harness.row("bench", "what", [3.0, 9.0, 4.0])
    assert (row.low, row.median, row.high) == (3.0, 4.0, 9.0)
    assert harness.exponent([1, 4, 16], [5.0, 40.0, 320.0]) == pytest.approx(1.5)


def test_the_table_and_the_file_say_the_same(monkeypatch, tmp_path, capsys):
    run = importlib.import_module("run")
    row = importlib.import_module("harness").row("scan", "mapping / sorting", [2.0, 3.0, 5.0])
    monkeypatch.setattr(run, "run", lambda size, names: [row])
    run.main(["--quick", "--only", "scan", "--out", str(tmp_path / "results.json")])
    assert "| scan | mapping / sorting | 3 x | 2 to 5 |" in capsys.readouterr().out
    report = json.loads((tmp_path / "results.json").read_text())
    assert report["quick"] and report["machine"]["cores"] >= 1 and report["versions"]["torch"]
    assert [(one["low"], one["median"], one["high"]) for one in report["rows"]] == [(2, 3, 5)]
