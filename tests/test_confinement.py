"""What a submission can read: what computing needs, and no answer, hand-in or secret."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtutor.course.grading import grade as grading
from fgtutor.course.grading import sandbox
from fgtutor.course.grading.answers import decode
from fgtutor.course.grading.confinement import landlock_version
from fgtutor.course.grading.grade import GradeConfig, grade
from tests.test_grading import HONEST, QUICK, submit
from tests.test_sandbox import asked

CLONE = Path(__file__).resolve().parents[1]
DISARM = """
import gc, types
for thing in gc.get_objects():
    if type(thing) is types.FunctionType and thing.__qualname__ == "_watch.<locals>.hook":
        for cell in thing.__closure__:
            cell.cell_contents = lambda path: True
        thing.__globals__.update(WRITING=0, _REFUSED=frozenset())
"""
"""Takes the audit hook away, as anybody can who shares a process with it."""
OPEN = """
import ctypes, io, mmap, os, pathlib, linecache, numpy
def by_ctypes(path):
    libc = ctypes.CDLL(None, use_errno=True)
    number = libc.open(os.fsencode(path), 0)
    if number < 0:
        raise OSError(ctypes.get_errno(), "by ctypes")
    return os.read(number, 9)
WAYS = {
    "open": lambda path: open(path, "rb").read(9),
    "os.open": lambda path: os.read(os.open(path, 0), 9),
    "FileIO": lambda path: io.FileIO(path).read(9),
    "open_code": lambda path: io.open_code(path).read(9),
    "pathlib": lambda path: pathlib.Path(path).read_bytes(),
    "numpy": lambda path: numpy.fromfile(path, numpy.uint8, 9).tobytes(),
    "os.path": lambda path: open(os.path.join("/proc/self/root", path[1:]), "rb").read(9),
    "relative": lambda path: open("./" + path[1:], "rb").read(9),
    "ctypes": by_ctypes,
}
def tried(paths):
    got = []
    for path in paths:
        for way, take in WAYS.items():
            try:
                got.append([path, way, take(path).hex()])
            except OSError as error:
                got.append([path, way, error.errno or 0])
    return got
def listed(paths):
    got = []
    for path in paths:
        try:
            got.append([path, *os.listdir(path)])
        except OSError as error:
            got.append([path, error.errno or 0])
    return got
"""
EACCES = 13
walled = pytest.mark.skipif(not landlock_version(), reason="no Landlock in this kernel")


@walled
@pytest.mark.parametrize("hook", ["", DISARM], ids=["with the hook", "without the hook"])
def test_the_kernel_opens_no_answer_no_hand_in_and_no_secret(tmp_path, hook):
    """Without the hook it is the kernel that answers EACCES; with it, the hook comes first."""
    submit(tmp_path, "bob", *HONEST)
    (tmp_path / "marks.csv").write_text("bob,6")
    (tmp_path / "link.py").symlink_to(CLONE / "solutions" / "src" / "ex10.py")
    closed = [
        *(CLONE / "solutions").rglob("ex10.*"),
        *(CLONE / "fgtutor/course/checks").glob("*.*"),
        *(CLONE / "fgtutor/evaluation").glob("metrics.py"),
        CLONE / "pyproject.toml",
        *tmp_path.iterdir(),
        *(Path("/proc", str(os.getpid()), name) for name in ("cmdline", "environ", "maps", "mem")),
        *(Path("/proc/self", name) for name in ("cmdline", "maps", "mem", "environ")),
        Path("/etc/passwd"),
        Path("/etc/shadow"),
    ]
    assert len(closed) > 25
    folders = [CLONE, CLONE / "solutions", CLONE / "fgtutor/course/checks", tmp_path, "/", "/proc"]
    opened, lists = [*map(str, closed), np_file()], [*map(str, folders)]
    replies = asked([OPEN, hook], tried=(opened,), listed=(lists,))
    (got,), (seen,) = (map(decode, replies[name]["answers"]) for name in ("tried", "listed"))
    taken = [entry for entry in got if isinstance(entry[2], str)]
    # What is Python's own is opened, so the ways of opening work.
    assert {entry[0] for entry in taken} == {np_file()} and len(taken) >= 7
    # The hook's own errors have no number.
    assert {entry[2] for entry in got if entry[0] != np_file()} == {EACCES if hook else 0}
    assert [entry[1:] for entry in seen] == [[EACCES if hook else 0]] * len(folders)


def np_file() -> str:
    """A file that any submission may read."""
    import numpy

    return str(numpy.__file__)


@walled
def test_our_package_is_closed_also_where_it_is_installed_among_others(tmp_path):
    packages = tmp_path / "lib" / "python3.11" / "site-packages"
    for name in ("numpy/a.py", "fgtutor/course/checks/ex01.py", "single.py"):
        (packages / name).parent.mkdir(parents=True, exist_ok=True)
        (packages / name).write_text(name)
    (packages / "other").symlink_to(packages / "fgtutor")
    (packages / "~gtutor").symlink_to(packages / "numpy")
    code = (
        "import os, sys\nfrom fgtutor.course.grading import confinement as c\n"
        f"root, packages = {str(tmp_path / 'lib')!r}, {str(packages)!r}\n"
        "sys.path.append(packages)\n"
        "folders, closed = c.readable()\n"
        "assert packages in folders and packages + '/fgtutor' in closed\n"
        "assert c._prctl(38, 1) and c._wall_off_files([*folders, root], closed)\n"
        "for name in ('numpy/a.py', 'single.py', 'fgtutor/course/checks/ex01.py',\n"
        "             'other/course/checks/ex01.py'):\n"
        "    try: print(open(os.path.join(packages, name)).read())\n"
        "    except PermissionError: print('closed')\n"
        "print(len(os.listdir(packages)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["numpy/a.py", "single.py", "closed", "closed", "5"]


THIEVES = {
    "the worked solution": """
import sys
for root in [*sys.path, {clone!r}]:
    try:
        text = open(root + "/solutions/src/ex10.py").read()
        exec(compile(text.replace("check(", "(lambda *a, **k: None)("), "s", "exec"))
    except Exception:
        pass
""",
    "another hand-in": """
import glob, json, sys
for root in [*sys.path, {clone!r}, {folder!r}]:
    try:
        for path in glob.glob(root + "/**/*ada*", recursive=True) + [{folder!r} + "/ada.ipynb"]:
            for cell in json.load(open(path))["cells"]:
                exec("".join(cell["source"]))
    except Exception:
        pass
""",
    "the marks": """
def path_length(xy):
    raise ValueError(open({folder!r} + "/marks.csv").read())
""",
    "the seed": """
import os
def path_length(xy):
    raise ValueError(open(f"/proc/{{os.getppid()}}/cmdline").read())
""",
    "the course's checks": """
import importlib, sys
for name in ("fgtutor.course.checks", "fgtutor.course.checks.ex10_path_length"):
    sys.modules.pop(name, None)
sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "_Offered"]
sys.path.append({clone!r})
importlib.invalidate_caches()
try:
    import fgtutor.course.checks.ex10_path_length as answers
    path_length, spl, reference_length = [question.truth for question in answers.QUESTIONS]
except Exception:
    pass
""",
}


@pytest.mark.slow
def test_no_thief_scores_or_reports_what_he_took(tmp_path):
    folder = tmp_path / "class"
    submit(folder, "ada", *HONEST)
    (folder / "marks.csv").write_text("ada,hunter2")
    for name, code in THIEVES.items():
        text = code.format(clone=str(CLONE), folder=str(folder))
        submit(folder, name, text)
        if landlock_version():
            submit(folder, f"{name}, disarmed", DISARM, text)
    config = GradeConfig(paths=(folder,), **QUICK | {"seed": 20417, "loading": 2.0})
    marks = {mark.learner: mark for mark in grade(config)}
    assert {name: mark.points for name, mark in marks.items() if mark.points} == {"ada": 6}
    assert not any(mark.fault for mark in marks.values())
    texts = [verdict.detail for mark in marks.values() for verdict in mark.verdicts]
    assert not any("hunter2" in text or "test_sandbox" in text for text in texts)


def test_without_landlock_the_hook_stands_and_the_grader_says_so(tmp_path, monkeypatch, capsys):
    older = "import fgtutor.course.grading.confinement as c; c.landlock_version = lambda: 0; main()"
    monkeypatch.setattr(sandbox, "START", sandbox.START.replace("main()", older))
    cell = f"def path_length(xy): return open({str(CLONE / 'solutions/src/ex10.py')!r}).read()"
    path = submit(tmp_path, "ada", HONEST[0], cell, *HONEST[3:])
    assert grading.run(GradeConfig(paths=(path,), **QUICK)) == 0
    printed = capsys.readouterr().out
    assert "lacks: other files unread;" in printed and "4 of 6" in printed
    assert "does not allow opening" in printed
