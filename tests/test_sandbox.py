"""A submission's process: only its own doings count against it, and nothing of it is left."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fgtutor.course.grading import grade as grading
from fgtutor.course.grading import sandbox
from fgtutor.course.grading.answers import encode
from fgtutor.course.grading.confinement import WALLS, landlock_version
from fgtutor.course.grading.grade import GradeConfig, grade
from fgtutor.course.grading.marks import table
from fgtutor.course.grading.replies import CRASHED, NOT_STARTED, TOO_SLOW
from fgtutor.course.grading.sandbox import Limits, ask_submission
from fgtutor.errors import ConfigError, GradingError
from tests.test_grading import HONEST, QUICK, submit

SHORT = Limits(seconds=0.5, idle=0.5)
"""Limits under which a sleeper does not hold up the tests."""


def asked(cells: list[str], limits: Limits = SHORT, **functions: tuple | None) -> dict[str, dict]:
    """Ask for functions by name, each for one case; None asks for a value."""
    questions = [
        {"id": name, "name": name, "cases": None if case is None else [encode(case)]}
        for name, case in functions.items()
    ]
    replies, in_force = ask_submission(cells, questions, limits)
    assert {"memory limited", *(WALLS if landlock_version() else ())} <= {*in_force}
    return replies


def children(parent: int) -> Iterator[int]:
    """Yield the submissions' processes that a process has started."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text, command = stat.read_text(), stat.with_name("cmdline").read_text()
        except OSError:  # it has just ended
            continue
        if int(text.rpartition(")")[2].split()[1]) == parent and "grading.worker" in command:
            yield int(stat.parent.name)


def until(happens, seconds: float = 60.0):
    """Wait for something to be true, and return it."""
    end = time.monotonic() + seconds
    while not (value := happens()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)
    return value


def test_the_code_of_the_current_folder_does_not_run(tmp_path, monkeypatch):
    for name in ("numpy", "json", "random", "IPython", "fgtutor", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('ran the wrong file')")
    monkeypatch.chdir(tmp_path)
    cell = "import numpy, random\n%matplotlib inline\ndef f(k): return k + 1"
    assert asked([cell], f=(2,))["f"]["answers"] == [3]


@pytest.mark.slow
def test_torch_can_be_used_and_the_walls_stand():
    cells = [
        "import torch\nfrom torch import nn",
        "def f(x):\n"
        "    net = nn.Linear(2, 1)\n    optimizer = torch.optim.SGD(net.parameters(), 0.1)\n"
        "    for _ in range(20):\n        loss = (net(x) - 1).square().mean()\n"
        "        optimizer.zero_grad(); loss.backward(); optimizer.step()\n"
        "    return loss < 0.5, torch.get_num_threads()",
        "def g(k):\n    import os, ctypes\n    failed = []\n"
        "    for act in (os.fork, lambda: open('/etc/passwd'),\n"
        "                lambda: ctypes.CDLL(None),\n"
        "                lambda: __import__('socket').socket(), lambda: os.kill(os.getppid(), 9),\n"
        "                lambda: torch.load('/etc/passwd'), lambda: torch.save(k, '/tmp/x.pt')):\n"
        "        try: act()\n        except (OSError, RuntimeError): failed.append(1)\n"
        "    return len(failed)",
    ]
    import torch

    case = [encode((torch.ones(3, 2),), tensors=True)]
    questions = [
        {"id": "f", "name": "f", "cases": case},
        {"id": "g", "name": "g", "cases": [encode((1,))]},
        {"id": "h", "name": "f", "cases": case, "harness": ["h", HARNESS]},
    ]
    replies, in_force = ask_submission(cells, questions, Limits(seconds=2, loading=1))
    assert {"memory limited", *(WALLS if landlock_version() else ())} <= {*in_force}
    assert replies["f"]["answers"][0]["tuple"][1] == 1, replies
    assert replies["g"]["answers"] == [7], replies
    assert replies["h"]["answers"] == [3], replies  # one thread and two columns


HARNESS = (
    "def h(target, x):\n    import torch\n"
    "    return int(torch.as_tensor(target(x)[1]) + x.shape[1])\n"
)


@pytest.mark.parametrize(
    ("cell", "needed"),
    [
        ("import torch", True),
        ("    from torch import nn", True),
        ("import numpy as np, torch as t", True),
        ("import torch.nn.functional as F", True),
        ("import numpy  # not torch's", True),
        ("torch = 3", False),
        ("import torchvision", False),
        ("import numpy", False),
    ],
)
def test_torch_is_loaded_only_for_those_who_use_it(cell, needed):
    assert sandbox.needs_torch([cell], []) == needed


# What counts against it ---------------------------------------------------------------------------


@pytest.mark.slow
def test_a_late_start_costs_nothing(monkeypatch):
    monkeypatch.setattr(sandbox, "START", f"import time; time.sleep(2)\n{sandbox.START}")
    assert asked(["def f(k): return k + 1"], f=(2,))["f"]["answers"] == [3]


@pytest.mark.slow
def test_a_start_that_fails_is_tried_again(monkeypatch, tmp_path):
    flaky = (
        f"import os\nonce = {str(tmp_path / 'once')!r}\n"
        "if not os.path.exists(once):\n    os.mkdir(once)\n    os._exit(7)\n"
    )
    monkeypatch.setattr(sandbox, "START", flaky + sandbox.START)
    assert asked(["def f(k): return k + 1"], f=(2,))["f"]["answers"] == [3]


@pytest.mark.slow
def test_a_submission_that_could_not_be_run_is_a_fault_and_an_error(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sandbox, "START", "raise SystemExit(7)")
    monkeypatch.setattr(sandbox, "TRIES", 2)
    config = GradeConfig(paths=(submit(tmp_path, "ada", *HONEST),), csv=tmp_path / "m.csv", **QUICK)
    (mark,) = grade(config)
    assert "could not be started (ended with code 7)" in mark.fault and mark.not_run
    assert "ended with code 7" in table([mark])
    assert grading.run(config) != 0
    assert "grade it again" in capsys.readouterr().out


@pytest.mark.slow
def test_a_machine_too_busy_is_a_fault_of_nobody(monkeypatch):
    monkeypatch.setattr(sandbox, "LONGEST_WAIT", 1.0)
    cell = "def f(k):\n    while True: pass"
    with pytest.raises(GradingError, match="too busy"):
        asked([cell], Limits(seconds=60), f=(2,))


@pytest.mark.slow
def test_a_process_killed_from_outside_is_no_crash_of_its_own():
    def kill() -> None:
        time.sleep(1)
        (worker,) = until(lambda: [*children(os.getpid())])
        os.kill(worker, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(GradingError, match="killed from outside"):
        asked(["def f(k):\n    while True: pass"], Limits(seconds=60), f=(2,))
    killer.join()


@pytest.mark.slow
def test_sleep_is_limited_for_a_question_and_in_all():
    cells = ["import time\ndef a(k): time.sleep(999)\ndef b(k): return k\nc = d = e = a"]
    replies = asked(cells, a=(1,), b=(1,), c=(1,), d=(1,), e=(1,))
    assert [replies[name].get("outcome") for name in "acde"] == [TOO_SLOW] * 4
    assert replies["b"]["answers"] == [1]


@pytest.mark.slow
def test_a_sleeper_gains_no_time_by_dripping():
    drip = """
import os, time
def f(k):
    while True:
        for number in range(3, 64):
            try: os.write(number, b" ")
            except OSError: pass
        time.sleep(0.02)
"""
    assert asked([drip], f=(1,))["f"]["outcome"] == TOO_SLOW


@pytest.mark.slow
def test_stopping_ends_what_runs():
    stop = threading.Event()
    timer = threading.Timer(1.0, stop.set)
    timer.start()
    question = {"id": "f", "name": "f", "cases": [encode((1,))]}
    with pytest.raises(GradingError, match="stopped"):
        ask_submission(["import time\ntime.sleep(3000)"], [question], Limits(idle=3600), stop)
    timer.join()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.slow
def test_nothing_outlives_the_grader(tmp_path, how):
    path = submit(tmp_path, "ada", "import time\nwhile True: time.sleep(999)")
    code = (
        "import signal\nfrom pathlib import Path\nfrom fgtutor.course.grading.grade import *\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"grade(GradeConfig(paths=(Path({str(path)!r}),)))\n"
    )
    # A folder that is empty before and after shows that nothing temporary is left.
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary)}
    with subprocess.Popen(
        [sys.executable, "-P", "-c", code], env=environment, stderr=subprocess.DEVNULL
    ) as grader:
        (worker,) = until(lambda: [*children(grader.pid)])
        until(lambda: asleep(worker))
        grader.send_signal(how)
        grader.wait(timeout=60)
    until(lambda: not Path(f"/proc/{worker}").exists() or zombie(worker))
    assert [*temporary.iterdir()] == []


def asleep(pid: int) -> bool:
    text = Path(f"/proc/{pid}/status").read_text()
    return "State:\tS" in text and "Seccomp:\t2" in text


def zombie(pid: int) -> bool:
    try:
        return "State:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return True


# What it says -------------------------------------------------------------------------------------


FORGED = (
    '{"question": "ex10.q1", "changed": 0.0}',
    '{"question": "ex10.q1", "changed": "xy"}',
    '{"question": "ex10.q1", "answers": {"0": 1}}',
    '{"question": "ex10.q1", "answers": [1e999, NaN]}',
    '{"question": "ex10.q1", "outcome": "passed", "points": 100}',
    '{"question": "ex10.q1", "outcome": null, "detail": null, "answers": null}',
    '{"question": "ex10.q1", "late": true}',
    '{"question": ["ex10.q1"]}',
    "[" * 100_000,
    "7" * 100_000,
    "null",
)


@pytest.mark.slow
def test_whatever_a_submission_says_is_a_mark(tmp_path):
    for number, line in enumerate(FORGED):
        cell = (
            f"import os\nline = {line!r}.encode() + b'\\n'\n"
            "def path_length(xy):\n    for number in range(3, 64):\n"
            "        try: os.write(number, line)\n        except OSError: pass\n    os._exit(0)\n"
        )
        submit(tmp_path, f"forger{number}", cell)
    marks = grade(GradeConfig(paths=(tmp_path,), **QUICK))
    assert len(marks) == len(FORGED)
    for mark in marks:
        assert (mark.points, mark.fault) == (0, "")
        assert mark.verdicts[0].outcome == CRASHED


def test_answers_larger_than_any_are_named_so():
    cells = [
        "def a(): return [0.0] * 300_000\ndef b(): return 'x' * 10**7\ndef c(): return 10**4000",
        "import numpy\ndef d(): return numpy.zeros(10**6)\ndef e(): return [[[[[1]]]]]",
    ]
    replies = asked(cells, a=(), b=(), c=(), d=(), e=())
    assert [reply["outcome"] for reply in replies.values()] == [CRASHED] * 5
    details = [replies[name]["detail"] for name in "abcde"]
    assert all("larger than any" in details[place] for place in (0, 1, 3))
    assert "13288 bits" in details[2] and "4 deep" in details[4]


def test_a_renamed_function_is_not_defined_rather_than_crashed():
    cells = ["def Fuse(k): return k", 'check("ex05.q1", fuse)', "print(fuse(3), fuse == 3)"]
    reply = asked(cells, fuse=(1,))["fuse"]
    assert (reply["outcome"], reply["detail"]) == (NOT_STARTED, "the notebook defines no `fuse`")


@pytest.mark.parametrize(
    "cell",
    [
        "def fuse(k) return k",
        "1 / 0\nfuse = 3",
        "1 / 0\nother, fuse = 3, 4",
        "1 / 0\nfuse: int = 3",
        "1 / 0\nclass fuse: pass",
        "1 / 0\nasync def fuse(): pass",
        "from nowhere import other, fuse",
    ],
)
def test_a_cell_that_should_have_defined_it_is_blamed(cell):
    assert asked([cell], fuse=(1,))["fuse"]["detail"].startswith("cell 1: ")


def test_what_is_installed_at_home_is_found(tmp_path, monkeypatch):
    code = "import site; print(site.getusersitepackages())"
    environment = {**os.environ, "HOME": str(tmp_path)}
    found = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    monkeypatch.setenv("HOME", str(tmp_path))
    packages = Path(found.stdout.strip())
    packages.mkdir(parents=True)
    (packages / "own.py").write_text("x = 7")
    # A virtual environment leaves these out; by hand, what site does elsewhere.
    start = f"import sys, site; sys.path.append(site.getusersitepackages())\n{sandbox.START}"
    monkeypatch.setattr(sandbox, "START", start)
    assert asked(["import own\nx = own.x"], x=None)["x"]["answers"] == [7]


@pytest.mark.slow
def test_what_learners_import_can_be_imported_without_a_home(tmp_path, monkeypatch):
    cell = "import matplotlib.pyplot as plt\nplt.plot([1, 2])\nimport scipy.sparse, networkx\nx = 1"
    monkeypatch.setenv("HOME", str(tmp_path / "none"))
    assert asked([cell], Limits(), x=None)["x"]["answers"] == [1]


@pytest.mark.parametrize(
    "fields",
    [
        {"seconds": float("inf")},
        {"seconds": float("nan")},
        {"seconds": 0.0},
        {"loading": 1e300},
        {"loading": -1.0},
        {"memory_mb": 10},
        {"memory_mb": 10**12},
        {"idle": float("inf")},
    ],
)
def test_limits_without_sense_are_refused_before_anything_runs(fields):
    (name,) = fields
    with pytest.raises(ConfigError, match=name):
        Limits(**fields)
