"""Grading: honest work gets its marks, and no submission gets more, or gets out."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtutor.course.checks import find
from fgtutor.course.checks.question import CRASHED, NOT_STARTED, PASSED, TOO_SLOW, WRONG
from fgtutor.course.grading import confinement
from fgtutor.course.grading.grade import GradeConfig, grade
from fgtutor.course.grading.marks import report

Q1, Q3 = "ex10.q1", "ex10.q3"
HONEST = (
    "import numpy as np\nfrom fgtutor.course.checks import check, hint, solution",
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
        "nbformat": 4,
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
import fgtutor.course.checks.ex10_path_length as answers
def path_length(xy): return answers.QUESTIONS[0].truth(xy)
def spl(*values):
    import fgtutor.statistics
    return fgtutor.statistics.spl(*values)
import sys
for path in sys.path:
    try: exec(open(path + "/fgtutor/course/checks/ex10_path_length.py").read())
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
        "import os\nfrom fgtutor.course.grading.confinement import _filter_system_calls, _prctl\n"
        "assert _prctl(38, 1) and _filter_system_calls()\n"
        f"try:\n    {action}\nexcept (OSError, RuntimeError, ValueError) as error:\n"
        "    print(getattr(error, 'errno', None) or 1, open('old.txt').read(), 6 * 7)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "1 kept 42\n"  # EPERM; reading and computing go on
    assert os.listdir(tmp_path) == ["old.txt"]
