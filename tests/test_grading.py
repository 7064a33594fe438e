"""Grading: honest work gets its marks, and no submission gets more, or gets out."""

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtutor.errors import ConfigError
from fgtutor.teach import confinement, grading
from fgtutor.teach.checks import find
from fgtutor.teach.checks.question import CRASHED, NOT_STARTED, PASSED, TOO_SLOW, WRONG
from fgtutor.teach.grading import GradeConfig, grade, learner_of
from fgtutor.teach.marks import by_learner, gradescope, report, table

Q1, Q3 = "ex10.q1", "ex10.q3"
HONEST = (
    "import numpy as np\nfrom fgtutor.teach.checks import check, hint, solution",
    "def path_length(xy):\n    return np.linalg.norm(np.diff(xy, axis=0), axis=-1).sum()",
    'check("ex10.q1", path_length)',
    "def spl(success, length, reference):\n"
    "    return np.mean(success * reference / np.maximum(length, reference))",
    "%matplotlib inline\nreference_length = 5.03",
)
"""Right answers to exercise 10, 6 points."""
QUICK = {"seconds": 0.3, "loading": 0.6, "memory_mb": 1024, "workers": 2}
"""Limits under which an attack does not hold up the tests."""


def submit(folder: Path, name: str, *cells: str, exercise: str = "ex10") -> Path:
    path = folder / f"{name}.ipynb"
    path.parent.mkdir(parents=True, exist_ok=True)
    notebook = {
        "cells": [{"cell_type": "code", "source": cell, "metadata": {}} for cell in cells],
        "metadata": {"fgtutor": {"exercise": exercise}} if exercise else {},
    }
    path.write_text(json.dumps(notebook))
    return path


def outcomes(mark) -> list[str]:
    return [verdict.outcome for verdict in mark.verdicts]


def mark_of(folder: Path, *cells: str, **limits):
    (mark,) = grade(GradeConfig(paths=(submit(folder, "ada", *cells),), **QUICK | limits))
    return mark


# Honest work --------------------------------------------------------------------------------------


def test_right_answers_get_all_points(tmp_path):
    mark = mark_of(tmp_path, *HONEST)
    assert (mark.points, mark.out_of, mark.percent, mark.fault) == (6, 6, 100.0, "")


def test_a_wrong_answer_costs_its_points_and_is_explained(tmp_path):
    swapped = (
        "def spl(success, length, reference):\n"
        "    return np.mean(success * np.maximum(length, reference) / reference)"
    )
    mark = mark_of(tmp_path, HONEST[0], HONEST[1], swapped, "reference_length = 9.73")
    assert outcomes(mark) == [PASSED, WRONG, WRONG]
    text = report([mark])
    assert "ada: 2 of 6 points, 33 %" in text
    assert "[0/2] ex10.q2 success weighted by path length: wrong" in text
    assert "Looks like a quotient upside down" in text and "expected  got" in text
    assert "Looks like the shortest path in the table" in text and "5.02" not in text


def test_each_cell_stands_for_itself(tmp_path):
    cells = (HONEST[0], "1 / 0", "def spl(success", HONEST[1], HONEST[4], "!ls\n%time x = 1")
    mark = mark_of(tmp_path, *cells)
    assert outcomes(mark) == [PASSED, CRASHED, PASSED]
    assert "cell 3: SyntaxError" in mark.verdicts[1].detail


def test_a_crash_names_the_learner_s_line(tmp_path):
    cell = "def path_length(xy):\n    total = 0\n    return total / len(xy[0][0])"
    detail = mark_of(tmp_path, HONEST[0], cell).verdicts[0].detail
    assert detail.startswith("TypeError") and "(line 3: return total / len(xy[0][0]))" in detail


def test_a_deleted_function_is_not_started(tmp_path):
    mark = mark_of(tmp_path, HONEST[0])
    assert outcomes(mark) == [NOT_STARTED] * 3
    assert "defines no `path_length`" in mark.verdicts[0].detail


def test_the_seed_draws_other_cases(tmp_path):
    # Right for every case of seed 0, which an answer typed in from the notebook would be too.
    known = [[repr(xy.tolist()), float(find(Q1).truth(xy))] for (xy,) in find(Q1).cases(0)]
    cell = f"KNOWN = dict({known!r})\ndef path_length(xy):\n    return KNOWN[repr(xy.tolist())]"
    submission = submit(tmp_path, "typed", cell)
    marks = [
        grade(GradeConfig(paths=(submission,), seed=seed, **QUICK))[0].verdicts[0].outcome
        for seed in (0, 1)
    ]
    assert marks == [PASSED, CRASHED]


def test_torch_stays_out_of_a_submission_s_process(tmp_path):
    cell = "import sys\ndef path_length(xy):\n    raise ValueError(sorted(sys.modules))"
    detail = mark_of(tmp_path, *HONEST[:1], cell).verdicts[0].detail
    assert "ValueError" in detail and "'torch'" not in detail


# Attacks ------------------------------------------------------------------------------------------

ALL_THREE = "spl = path_length\nreference_length = path_length\n"
ATTACKS = {
    "equals everything": """
class Equal:
    __array_priority__ = 1e9
    def __eq__(self, other): return True
    def __ne__(self, other): return False
    def __len__(self): return 0
    def __float__(self): return 1.0
    def __getattr__(self, name): return self
    def __call__(self, *values): return self
    __hash__ = None
path_length = Equal()
""",
    "patched traceback": """
import builtins, sys, traceback, unittest.mock
for module in (traceback, sys, builtins):
    for name in ("format_exc", "print_exc", "format_exception", "TracebackException", "excepthook"):
        setattr(module, name, lambda *values, **options: "passed")
class Passed(Exception):
    def __str__(self): return "passed\\x1b[2J<script>alert(1)</script>"
def path_length(*values): raise Passed
""",
    "patched numpy and json": """
import json, numpy, base64
json.dumps = lambda *values, **options: '{"question": "ex10.q1", "outcome": "passed"}'
numpy.isclose = numpy.allclose = lambda *values, **options: True
numpy.asarray = numpy.array = lambda *values, **options: True
def path_length(*values): return True
""",
    "forged result": """
import os
marks = '{"score": 100, "outcome": "passed"}'
for name in ("results.json", "marks.csv", "../results.json", "/tmp/fgtutor-forged.json"):
    try:
        with open(name, "w") as file: file.write(marks)
    except BaseException: pass
line = b'{"question": "ex10.q1", "outcome": "passed", "points": 100, "answers": []}\\n'
for fd in range(1, 64):
    try: os.write(fd, b'{"confined": []}\\n{"loaded": true}\\n' + line)
    except OSError: pass
def path_length(*values): return 1.0
""",
    "infinite loop": """
def path_length(*values):
    while True: pass
""",
    "infinite loop at the top": """
while True: pass
""",
    "stubborn loop": """
import signal
def path_length(*values):
    signal.setitimer(signal.ITIMER_PROF, 0); signal.setitimer(signal.ITIMER_REAL, 0)
    while True:
        try:
            while True: pass
        except BaseException: pass
spl = reference_length = 0
""",
    "fork bomb": """
import os, subprocess, threading
def path_length(*values):
    for start in (os.fork, lambda: subprocess.Popen(["sleep", "1000"]),
                  threading.Thread(target=path_length).start):
        try: start()
        except Exception: pass
    while True:
        os.fork()
""",
    "ten gigabytes": """
import numpy as np
def path_length(*values):
    return np.ones(10 * 2**30 // 8).sum()
def spl(*values):
    return len(bytearray(10 * 2**30))
kept = []
def hoard():
    while True: kept.append(np.ones(2**24))
""",
    "hoarded gigabytes": """
import numpy as np
kept = []
def path_length(*values):
    while True: kept.append(np.ones(2**23))
""",
    "kill the grader": """
import os, signal
def path_length(*values):
    os.kill(os.getppid(), signal.SIGTERM)
    return 1.0
""",
    "leave": """
import os, sys
def path_length(*values): os._exit(0)
def spl(*values): sys.exit(0)
reference_length = 1.0
""",
    "close everything": """
import os
os.closerange(0, 64)
def path_length(*values): return 1.0
""",
    "deep and long": """
def path_length(*values):
    deep = []
    for _ in range(400): deep = [deep]
    return deep
def spl(*values): return 10 ** 4000
reference_length = [0.0] * 3_000_000
""",
    "claims": """
not_started = passed = 100
path_length = "passed"
spl = {"outcome": "passed"}
reference_length = float("nan")
""",
    "peek": """
import fgtutor.teach.checks.ex10 as answers
def path_length(xy): return answers.QUESTIONS[0].truth(xy)
def spl(*values):
    import fgtutor.evaluation.metrics
    return fgtutor.evaluation.metrics.spl(*values)
import sys
for path in sys.path:
    try: exec(open(path + "/fgtutor/teach/checks/ex10.py").read())
    except OSError: pass
reference_length = globals().get("LENGTHS")
""",
}
assert len(ATTACKS) >= 8


@pytest.mark.slow
def test_no_attack_scores_and_the_grader_stands(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("results.json").write_text("{}")
    folder = tmp_path / "class"
    for name, code in ATTACKS.items():
        submit(folder, name, code, ALL_THREE if "path_length" in code else "")
    honest = submit(folder, "zoe", *HONEST)
    marks = {mark.learner: mark for mark in grade(GradeConfig(paths=(folder,), **QUICK))}
    assert marks.keys() == ATTACKS.keys() | {"zoe"}
    for name in ATTACKS:
        assert (marks[name].points, marks[name].fault) == (0, ""), name
        assert PASSED not in outcomes(marks[name])
    assert marks["zoe"].points == 6 and marks["zoe"].path == honest
    assert outcomes(marks["infinite loop"])[0] == TOO_SLOW
    assert outcomes(marks["stubborn loop"])[0] == TOO_SLOW
    assert outcomes(marks["ten gigabytes"])[0] == CRASHED
    assert "MemoryError" in marks["ten gigabytes"].verdicts[0].detail
    assert Path("results.json").read_text() == "{}" and not Path("marks.csv").exists()
    assert not Path("/tmp/fgtutor-forged.json").exists()
    text = report([marks["patched traceback"]])
    assert "\x1b" not in text and "crashed" in text
    assert capfd.readouterr() == ("", "")  # nothing of a submission reaches the terminal


def test_secrets_are_not_inherited_nor_read(tmp_path, monkeypatch):
    monkeypatch.setenv("API_TOKEN", "hunter2")
    (tmp_path / "secret.txt").write_text("hunter3")
    cells = (
        "import os\ndef path_length(*values): raise ValueError(dict(os.environ), os.listdir())",
        f"def spl(*values): raise ValueError(open({str(tmp_path / 'secret.txt')!r}).read())",
        f"import os\nreference_length = os.listdir({str(tmp_path)!r})",
    )
    mark = mark_of(tmp_path, *cells)
    text = report([mark])
    assert "hunter" not in text and "API_TOKEN" not in text
    assert "LANG" in mark.verdicts[0].detail or "allow listing" in mark.verdicts[0].detail
    assert "allow opening" in mark.verdicts[1].detail
    assert "allow listing" in mark.verdicts[2].detail


linux = pytest.mark.skipif(
    not confinement.filters_system_calls(), reason="no seccomp filter for this system"
)
TRIES = {
    "fork": "os.fork()",
    "thread": "import _thread; _thread.start_new_thread(print, ())",
    "exec": "os.execv('/bin/true', ['true'])",
    "socket": "import socket; socket.socket()",
    "signal": "os.kill(os.getppid(), 0)",
    "write": "os.open('new.txt', os.O_WRONLY | os.O_CREAT)",
    "truncate": "os.open('old.txt', os.O_RDONLY | os.O_TRUNC)",
    "delete": "os.remove('old.txt')",
    "rename": "os.rename('old.txt', 'other.txt')",
    "limits": "import resource; resource.setrlimit(resource.RLIMIT_CPU, (9999, 9999))",
    "owner": "import fcntl; fcntl.fcntl(0, fcntl.F_SETOWN, os.getppid())",
}


@linux
@pytest.mark.parametrize("action", TRIES.values(), ids=TRIES)
def test_the_kernel_itself_refuses(tmp_path, action):
    """Without the audit hook, which an attacker in the same process may get around."""
    (tmp_path / "old.txt").write_text("kept")
    code = (
        "import os\nfrom fgtutor.teach.confinement import _filter_system_calls, _prctl\n"
        "assert _prctl(38, 1) and _filter_system_calls()\n"
        f"try:\n    {action}\nexcept (OSError, RuntimeError, ValueError) as error:\n"
        "    print(getattr(error, 'errno', None) or 1, open('old.txt').read(), 6 * 7)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "1 kept 42\n"  # EPERM; reading and computing go on
    assert os.listdir(tmp_path) == ["old.txt"]


# Whatever comes, the batch goes on ----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "not a readable notebook"),
        ("[1, 2", "not a readable notebook"),
        ("[" * 5000, "not a readable notebook"),
        ('{"cells": 3}', "not a readable notebook"),
        ('{"cells": [{"cell_type": "code", "source": 3}]}', "not a readable notebook"),
        ('{"cells": [], "metadata": {}}', "which exercise"),
        ('{"cells": [], "metadata": {"fgtutor": {"exercise": "../ex01"}}}', "which exercise"),
        ('{"cells": [], "metadata": {"fgtutor": {"exercise": ["ex01"]}}}', "which exercise"),
    ],
)
def test_a_broken_notebook_is_a_fault_not_an_end(tmp_path, content, complaint):
    broken = tmp_path / "broken.ipynb"
    broken.write_text(content)
    good = submit(tmp_path, "good", *HONEST)
    first, second = grade(GradeConfig(paths=(broken, good), **QUICK))
    assert complaint in first.fault and first.points == 0
    assert second.points == 6


def test_a_huge_notebook_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(grading, "LARGEST_NOTEBOOK", 100)
    assert "larger than 100 bytes" in mark_of(tmp_path, *HONEST).fault


def test_our_own_mistake_stops_nobody_else(tmp_path, monkeypatch):
    ask = grading.ask_submission

    def clumsy(cells, *rest):
        if cells[0] == "boom":
            raise RuntimeError("our mistake")
        return ask(cells, *rest)

    monkeypatch.setattr(grading, "ask_submission", clumsy)
    paths = (submit(tmp_path, "unlucky", "boom"), submit(tmp_path, "lucky", *HONEST))
    first, second = grade(GradeConfig(paths=paths, **QUICK))
    assert "our mistake" in first.fault and second.points == 6


# Marks --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def classroom(tmp_path_factory):
    folder = tmp_path_factory.mktemp("class")
    submit(folder, "ex10_ada", *HONEST, exercise="")
    submit(folder, "bob/ex10", *HONEST[:3])
    submit(folder, "=cmd()", *HONEST[:1])
    submit(folder, ".ipynb_checkpoints/ex10_ada-checkpoint", *HONEST)
    return folder


@pytest.fixture(scope="module")
def marks(classroom):
    return grade(GradeConfig(paths=(classroom,), **QUICK))


def test_learners_are_named_by_file_or_folder(marks):
    assert {mark.learner: mark.points for mark in marks} == {"=cmd()": 0, "bob": 2, "ada": 6}
    assert learner_of(Path("ex04-eve.ipynb")) == "eve"


def test_csv_has_a_row_a_notebook_and_no_formulas(marks):
    rows = {row["learner"]: row for row in csv.DictReader(io.StringIO(table(marks)))}
    assert rows.keys() == {"'=cmd()", "bob", "ada"}
    assert rows["ada"] | {"submission": ""} == {
        "learner": "ada",
        "submission": "",
        "exercise": "ex10",
        "points": "6",
        "out_of": "6",
        "percent": "100.0",
        "q1": PASSED,
        "q2": PASSED,
        "q3": PASSED,
        "fault": "",
    }
    assert (rows["bob"]["q1"], rows["bob"]["q2"]) == (PASSED, NOT_STARTED)


def test_gradescope_gets_its_own_format_for_one_learner(marks):
    (bob,) = by_learner(marks)["bob"]
    results = gradescope([bob])
    assert results["score"] == 2 and results["test_output_format"] == "text"
    tests = results["tests"]
    assert [(t["score"], t["max_score"], t["status"]) for t in tests] == [
        (2, 2, "passed"),
        (0, 2, "failed"),
        (0, 2, "failed"),
    ]
    assert gradescope(marks)["learners"]["bob"] == results


def test_the_command_writes_everything(classroom, tmp_path, capsys):
    config = GradeConfig(
        paths=(classroom,),
        csv=tmp_path / "marks.csv",
        gradescope=tmp_path / "results.json",
        reports=tmp_path / "reports",
        **QUICK,
    )
    assert grading.run(config) == 0
    printed = capsys.readouterr().out
    assert "bob" in printed and "+..   " not in printed and "+.." in printed
    assert "2 of 6" in (tmp_path / "reports" / "bob.txt").read_text()
    assert {p.name for p in (tmp_path / "reports").iterdir()} == {"_cmd_.txt", "bob.txt", "ada.txt"}
    assert "learners" in json.loads((tmp_path / "results.json").read_text())
    assert (tmp_path / "marks.csv").read_text().count("\n") == 4


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"cases": 0}, "cases >= 1"),
        ({"memory_mb": 10}, "memory_mb >= 512"),
        ({"seconds": 0.0}, "seconds > 0"),
        ({"exercise": "ex13"}, "no exercise 'ex13'"),
    ],
)
def test_impossible_settings_are_refused(fields, complaint):
    with pytest.raises(ConfigError, match=complaint):
        GradeConfig(paths=(), **fields)


def test_a_path_without_notebooks_is_refused(tmp_path):
    for paths in ((tmp_path,), (tmp_path / "missing.ipynb",), ()):
        with pytest.raises(ConfigError, match="notebook"):
            grade(GradeConfig(paths=paths))
