"""Marks: at most one per learner and exercise, every name harmless, and all that was asked for."""

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from fgtutor.__main__ import UNREAD, USAGE, main
from fgtutor.course.checks import check, find, questions_of
from fgtutor.course.checks.question import (
    CRASHED,
    NOT_STARTED,
    OUTCOMES,
    PASSED,
    Judge,
    Verdict,
    plain_name,
)
from fgtutor.course.grading import grade as grading
from fgtutor.course.grading.answers import encode
from fgtutor.course.grading.grade import GradeConfig, grade
from fgtutor.course.grading.marks import (
    Mark,
    by_learner,
    gradescope,
    report,
    report_names,
    settle_clashes,
    table,
)
from fgtutor.errors import ConfigError, StorageError
from tests.test_grading import HONEST, QUICK, submit
from tests.test_submissions import ANY


def mark(path: str, learner: str, *outcomes: str, exercise: str = "ex10", **fields) -> Mark:
    """Return a mark as grading gives it, with an outcome for each question."""
    verdicts = tuple(map(Verdict, questions_of(exercise), outcomes))
    return Mark(path=Path(path), learner=learner, exercise=exercise, verdicts=verdicts, **fields)


def rows(marks: list[Mark]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table(marks))))


def is_gradescope(results: dict) -> bool:
    """Return whether results are as Gradescope's documentation wants them."""
    return (
        {"score", "output", "tests"} <= results.keys()
        and results["score"] == sum(test["score"] for test in results["tests"])
        and all(0 <= test["score"] <= test["max_score"] for test in results["tests"])
    )


SOLVED, HALF, EMPTY = (PASSED,) * 3, (PASSED, NOT_STARTED, NOT_STARTED), (NOT_STARTED,) * 3


# One per learner and exercise ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcomes", "best"),
    [
        ((EMPTY, SOLVED, HALF), 1),
        ((HALF, HALF), 0),
        ((SOLVED, SOLVED, SOLVED, SOLVED), 0),
        ((EMPTY, EMPTY), 0),
    ],
)
def test_of_several_notebooks_the_best_counts_and_all_are_named(outcomes, best):
    given = [mark(f"in/ex10 ({n}).ipynb", "ada", *each) for n, each in enumerate(outcomes)]
    marks = settle_clashes([*given, mark("in/ex10_bob.ipynb", "bob", *HALF)])
    assert [each.counts for each in marks] == [n == best for n in range(len(outcomes))] + [True]
    assert [each.points for each in marks[:-1]].count(0) >= len(outcomes) - 1
    *ada, bob = rows(marks)
    clash = f"clash: {len(outcomes)} notebooks for ex10, of which the best counts: ex10 ({best})"
    assert all(row["notes"].startswith(clash) for row in ada) and not bob["notes"]
    assert sum(int(row["out_of"]) for row in ada) == 6
    assert sum(int(row["points"]) for row in ada) == given[best].points <= 6
    results = gradescope(marks[:-1])
    assert is_gradescope(results) and results["score"] == given[best].points
    assert len(results["tests"]) == 3
    for text in (results["output"], report(marks[:-1]), *map(str, marks[:-1])):
        assert clash in text


def test_one_that_cannot_be_graded_does_not_count_against_one_that_can():
    faulty = mark("a/ex10.ipynb", "ada", fault="not a readable notebook")
    first, second = settle_clashes([faulty, mark("b/ex10.ipynb", "ada", *EMPTY)])
    assert (first.counts, second.counts) == (False, True)
    assert "the best counts: b/ex10.ipynb" in first.remarks


def test_other_exercises_and_learners_are_no_clash():
    marks = [
        mark("in/a.ipynb", "ada", *SOLVED),
        mark("in/b.ipynb", "ada", exercise="ex11"),
        mark("in/c.ipynb", "bob", *SOLVED),
        Mark(path=Path("in/d.ipynb"), learner="ada", fault="which exercise?"),
        Mark(path=Path("in/e.ipynb"), learner="ada", fault="which exercise?"),
    ]
    assert settle_clashes(marks) == marks


def test_gradescope_s_format_is_valid_for_one_for_several_and_for_none():
    ada, bob = mark("in/a.ipynb", "ada", *SOLVED), mark("in/b.ipynb", "bob", *HALF)
    assert [test["status"] for test in gradescope([bob])["tests"]] == ["passed", "failed", "failed"]
    assert gradescope([bob])["score"] == 2 and is_gradescope(gradescope([bob]))
    both = gradescope([ada, bob])
    assert is_gradescope(both) and both["score"] == 0
    assert "2 learners (ada, bob) in one submission" in both["output"]
    assert both["learners"] == {"ada": gradescope([ada]), "bob": gradescope([bob])}
    none = gradescope([], "no notebook in submission")
    assert is_gradescope(none) and none["output"] == "no notebook in submission"


# Names --------------------------------------------------------------------------------------------


@given(st.lists(ANY, min_size=1, max_size=6, unique=True))
def test_any_names_end_up_apart_and_harmless_in_every_output(names):
    marks = [
        mark(f"in/{name}/ex10.ipynb", plain_name(name), *HALF, fault="odd" * (n % 2))
        for n, name in enumerate(names)
    ]
    learners = by_learner(settle_clashes(marks))
    assert len(learners) == len(names)
    files = [file.casefold() for file in report_names(learners).values()]
    assert len({*files}) == len(names)
    assert all(len(file.encode()) < 255 and file == Path(file).name for file in files)
    texts = [table(marks), json.dumps(gradescope(marks)), *map(str, marks), report(marks)]
    for text in texts:
        assert text.encode() and all(line.isprintable() for line in text.split("\n"))
    written = rows(marks)
    assert len({row["learner"] for row in written}) == len(written) == len(names)
    assert not any(cell[:1] in (*"=+-@",) for row in written for cell in row.values())


def test_reports_of_names_alike_are_files_apart():
    long = "a" * 60
    names = ["a.b", "a b", "a!b", "A_B", "=x", long + "1", long + "2", "..", "Zoe\u0308", "Zo\xeb"]
    files = report_names(names)
    assert [*files] == names
    assert list(files.values())[:5] == ["a_b.txt", "a_b-2.txt", "a_b-3.txt", "A_B-4.txt", "_x.txt"]
    assert len({file.casefold() for file in files.values()}) == len(names)


# The command --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def classroom(tmp_path_factory):
    """A class whose names are what names are: odd, twice, in folders, and no text at all."""
    folder = tmp_path_factory.mktemp("class")
    submit(folder, "ex10_ada", *HONEST, exercise="")
    submit(folder, "ex10_ada (1)", *HONEST[:2])
    submit(folder, "bob/ex10", *HONEST[:3])
    submit(folder, "=cmd()", *HONEST[:1])
    submit(folder, "ex10_eve\x1b]0;owned\x07\nbob   6 of 6", *HONEST[:1])
    submit(folder, "ex10_eve\u202e", *HONEST[:1])
    submit(folder, os.fsdecode(b"ex10_M\xfcller"), *HONEST)
    submit(folder, "ex12_mallory", *HONEST)
    submit(folder, ".ipynb_checkpoints/ex10_ada-checkpoint", *HONEST)
    (folder / "ex10_ada.pdf").write_text("no notebook")
    return folder


RIGHT = {
    "ada": 6,
    "bob": 2,
    "=cmd()": 0,
    "eve\\x1b]0;owned\\x07\\nbob   6 of 6": 0,
    "eve\\u202e": 0,
    "M\\udcfcller": 6,
    "mallory": 0,
}
"""Points by learner, as they are shown."""


@pytest.mark.slow
def test_the_command_writes_everything(classroom, tmp_path, capsys):
    outputs = {"csv": tmp_path / "m.csv", "gradescope": tmp_path / "r.json"}
    config = GradeConfig(paths=(classroom,), reports=tmp_path / "reports", **outputs, **QUICK)
    assert grading.run(config) == 0
    printed = capsys.readouterr().out
    assert all(line.isprintable() for line in printed.split("\n"))
    assert [line.split()[0] for line in printed.splitlines()].count("bob") == 1
    assert "ex10_ada.pdf" in printed and "Jupyter's own copies" in printed
    assert "ex10 by its metadata, ex12 by its name" in printed

    text = (tmp_path / "m.csv").read_bytes().decode()
    written = list(csv.DictReader(io.StringIO(text, newline="")))
    assert len(written) == 8
    points = {}
    for row in written:
        name = row["learner"].removeprefix("'")
        points[name] = points.get(name, 0) + int(row["points"])
    assert points == RIGHT
    (ada,) = (row for row in written if row["learner"] == "ada" and row["counts"] == "yes")
    assert ada == {
        **{"learner": "ada", "exercise": "ex10", "points": "6", "out_of": "6"},
        **{"percent": "100.0", "counts": "yes", "q1": PASSED, "q2": PASSED, "q3": PASSED},
        "submission": str(classroom / "ex10_ada.ipynb"),
        "fault": "",
        "notes": "clash: 2 notebooks for ex10, of which the best counts: ex10_ada.ipynb",
    }
    learners = json.loads((tmp_path / "r.json").read_text())["learners"]
    assert {name: results["score"] for name, results in learners.items()} == RIGHT
    assert all(map(is_gradescope, learners.values()))
    reports = [path.read_text(encoding="utf-8") for path in (tmp_path / "reports").iterdir()]
    assert {text.split(": ")[0] for text in reports} == RIGHT.keys()


@pytest.mark.slow
def test_one_output_that_fails_takes_no_other_with_it(tmp_path, capsys):
    path = submit(tmp_path / "in", "ex10", *HONEST[:2])
    (tmp_path / "reports/in.txt").mkdir(parents=True)
    config = GradeConfig(
        paths=(path,), csv=tmp_path / "m.csv", reports=tmp_path / "reports", **QUICK
    )
    with pytest.raises(StorageError, match=r"in\.txt"):
        grading.run(config)
    assert "in: 2 of 6 points" in capsys.readouterr().out
    assert "in," in (tmp_path / "m.csv").read_text()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--csv FOLDER", "the path is a folder"),
        ("--gradescope FOLDER", "the path is a folder"),
        ("--reports FILE", "cannot write"),
        ("--csv NONE/m.csv", "create the folder first"),
        ("--csv in/ex10.ipynb", "is a notebook or another output"),
        ("--csv m.csv --gradescope m.csv", "is a notebook or another output"),
    ],
)
def test_what_cannot_be_written_is_said_before_anything_runs(
    tmp_path, monkeypatch, capsys, words, complaint
):
    monkeypatch.chdir(tmp_path)
    submit(tmp_path / "in", "ex10", *HONEST)
    (tmp_path / "FOLDER").mkdir()
    (tmp_path / "FILE").touch()
    before = sorted(tmp_path.rglob("*"))
    assert main(["grade", "in", "--reports", "reports", *words.split()]) == USAGE
    said = capsys.readouterr()
    assert complaint in said.err and said.err.count("\n") == 1 and not said.out
    assert {*tmp_path.rglob("*")} - {*before} <= {tmp_path / "reports"}


@pytest.mark.slow
def test_a_reader_who_stops_reading_loses_no_file(tmp_path):
    submit(tmp_path / "in", "ex10", *HONEST[:2])
    reader, writer = os.pipe()
    os.close(reader)
    words = ["grade", "in", "--csv", "m.csv", "--reports", "reports", "--gradescope", "r.json"]
    command = [sys.executable, "-P", "-m", "fgtutor", *words]
    done = subprocess.run(command, cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert done.returncode == UNREAD and "Traceback" not in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"in", "m.csv", "reports", "r.json"}


def test_nothing_to_grade_is_one_line_and_a_valid_result(tmp_path, capsys):
    (tmp_path / "ex10_ada.zip").touch()
    results = tmp_path / "results.json"
    assert main(["grade", str(tmp_path), "--gradescope", str(results)]) == USAGE
    assert "an archive: unpack it first" in capsys.readouterr().err
    assert is_gradescope(json.loads(results.read_text()))
    for paths in ((tmp_path,), (tmp_path / "missing.ipynb",), ()):
        with pytest.raises(ConfigError, match="no notebook"):
            grade(GradeConfig(paths=paths))


@pytest.mark.slow
def test_an_exercise_that_is_given_overrides_what_notebooks_say(tmp_path):
    submit(tmp_path, "ex12_ada", *HONEST)
    (graded,) = grade(GradeConfig(paths=(tmp_path,), exercise="ex10", **QUICK))
    assert (graded.exercise, graded.points, graded.fault) == ("ex10", 6, "")


@pytest.mark.slow
def test_a_file_that_goes_away_is_a_fault_of_nobody(tmp_path, capsys):
    gone, there = tmp_path / "in/ex10_eve.ipynb", submit(tmp_path / "in", "ex10_ada", *HONEST)
    first, second = grade(GradeConfig(paths=(tmp_path / "in",), **QUICK), [gone, there])
    assert first.fault == "cannot be read: No such file or directory" and first.not_run
    assert second.points == 6


@pytest.mark.slow
def test_a_mistake_of_ours_names_the_file_and_stops_nobody_else(tmp_path, monkeypatch, capsys):
    ask = grading.ask_submission

    def clumsy(cells, *rest):
        if cells == ["boom"]:
            raise RuntimeError("our mistake")
        return ask(cells, *rest)

    monkeypatch.setattr(grading, "ask_submission", clumsy)
    submit(tmp_path, "ex10_unlucky", "boom")
    submit(tmp_path, "ex10_lucky", *HONEST)
    assert grading.run(GradeConfig(paths=(tmp_path,), **QUICK)) == 1
    lucky, unlucky, *_ = capsys.readouterr().out.splitlines()
    assert "6 of 6" in lucky
    assert "a mistake of fgtutor" in unlucky and "our mistake" in unlucky
    assert unlucky.endswith("ex10_unlucky.ipynb]")


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"cases": 0}, "cases: "),
        ({"cases": -1}, "cases: "),
        ({"seed": -1}, "seed: "),
        ({"memory_mb": 10}, "memory_mb: "),
        ({"memory_mb": 10**15}, "memory_mb: "),
        ({"seconds": 0.0}, "seconds: "),
        ({"seconds": float("inf")}, "seconds: "),
        ({"loading": 1e300}, "loading: "),
        ({"loading": float("nan")}, "loading: "),
        ({"workers": -1}, "workers: "),
        ({"learner": "name"}, "learner: "),
        ({"exercise": "ex99"}, "no exercise 'ex99'"),
    ],
)
def test_impossible_settings_are_refused(fields, complaint):
    with pytest.raises(ConfigError, match=complaint):
        GradeConfig(paths=(), **fields)


# Answers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("question", ["ex10.q1", "ex10.q3"])
@pytest.mark.parametrize("fields", [{"cases": 0}, {"cases": -1}, {"cases": 1e9}, {"seed": -1}])
def test_a_check_without_cases_passes_nobody(question, fields):
    with pytest.raises(ConfigError, match=next(iter(fields))):
        check(question, lambda *values: 1.0, **fields)


ARRAYS = arrays(
    st.sampled_from(["float64", "int64", "uint64", "bool"]),
    array_shapes(min_dims=0, min_side=0, max_side=4),
).map(encode)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | ARRAYS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.fixed_dictionaries({"tuple": st.lists(inner, max_size=4)})
        | st.fixed_dictionaries({"list": st.lists(inner, max_size=4)})
        | st.fixed_dictionaries({"array": st.lists(inner, min_size=3, max_size=3)})
        | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=20,
)
KEYS = ("question", "outcome", "detail", "changed", "answers", "points")
JUDGES = [Judge(find(f"ex10.q{n}"), find(f"ex10.q{n}").cases(0, 1)) for n in (1, 2, 3)]


@pytest.mark.slow
@given(
    st.dictionaries(st.sampled_from(KEYS), JSON | st.sampled_from(OUTCOMES))
    | st.builds(dict, answers=st.lists(JSON, max_size=4))
    | st.builds(dict, answers=st.lists(JSON, min_size=1, max_size=1)),
)
def test_no_reply_fails_the_judge(reply):
    for judge in JUDGES:
        verdict = judge.judge(reply)
        assert verdict.outcome in OUTCOMES and verdict.outcome != PASSED
        assert all(line.isprintable() for line in verdict.detail.split("\n"))
        assert verdict.outcome != CRASHED or verdict.detail or "detail" in reply
