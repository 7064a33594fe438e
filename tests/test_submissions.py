"""Submissions: whose each notebook is, what it holds, and nothing left out without a word."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtutor.course.checks.question import plain_name
from fgtutor.course.grading.submissions import (
    LARGEST_CODE,
    LARGEST_NOTEBOOK,
    base_of,
    exercise_of,
    find_notebooks,
    learners_of,
    read_submission,
)
from fgtutor.errors import ConfigError, NotebookError
from tests.test_grading import HONEST, submit


def put(folder: Path, names: dict[str, str] | list[str]) -> None:
    """Write a notebook of each name, whose metadata say an exercise, or nothing."""
    for name in names:
        exercise = names[name] if isinstance(names, dict) else ""
        path = submit(folder, "made", "x = 1", exercise=exercise)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        path.rename(folder / name)


def listed(*paths: Path, rule="path") -> dict[str, str]:
    """Return learner and exercise of every notebook, by its path below what is named."""
    notebooks, _ = find_notebooks(paths)
    base = base_of(paths)
    found = {}
    for path, (learner, _) in zip(notebooks, learners_of(notebooks, base, rule), strict=True):
        try:
            exercise = exercise_of(path, base, read_submission(path).exercise)
        except NotebookError as error:
            exercise = str(error).partition("?")[0]
        found[os.path.relpath(path, base)] = f"{learner} {exercise}"
    return found


# Whose --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "right",
    [
        {"ada/ex06 (1).ipynb": "ada ex06", "bob/ex06 (1).ipynb": "bob ex06"},
        {"alex04_ex06.ipynb": "alex04 ex06", "alex12_ex06.ipynb": "alex12 ex06"},
        {"ex06.ipynb": "class ex06", "ex06-Copy1.ipynb": "class ex06"},
        {"fri/ex06_ada.ipynb": "fri/ada ex06", "mon/ex06_ada.ipynb": "mon/ada ex06"},
        {"EX06_ada.ipynb": "ada ex06", "Ex07-bob.IPYNB": "bob ex07"},
        {"ex06_ada.ipynb.txt": "ada ex06", "ex06_bob.ipynb.json": "bob ex06"},
        {"ada/ex06_end.ipynb": "ada/end ex06", "bob/ex06_end.ipynb": "bob/end ex06"},
        {"ex06/ada.ipynb": "ada ex06", "ex07/ada.ipynb": "ada ex07"},
        {"ada/ex06_ada.ipynb": "ada ex06", "ex07_ada.ipynb": "ada ex07"},
        {"ada/week 1/ex06.ipynb": "ada/week 1 ex06"},
        {"Copy of ex06_ada.ipynb": "ada ex06", "ex06_bob - Copy (2).ipynb": "bob ex06"},
        {"ex06 copy 2.ipynb": "class ex06", "ex06_copy.ipynb": "class ex06"},
        {"ada_ex06_lovelace.ipynb": "ada_lovelace ex06"},
        {"ex10 .ipynb": "class ex10", "ex10-.ipynb": "class ex10"},
        {"ex06.ipynb": "class ex06", "ada (1)/ex06.ipynb": "ada (1) ex06"},
        {"simplex06_bob.ipynb": "simplex06_bob which exercise"},
    ],
)
def test_everyday_names_say_whose_it_is_and_what(tmp_path, right):
    put(tmp_path / "class", list(right))
    assert listed(tmp_path / "class") == right


def test_the_rule_can_be_chosen(tmp_path):
    put(tmp_path, ["friday/ex06_ada.ipynb", "monday/ex06_ada.ipynb", "monday/ex07.ipynb"])
    by_rule = {
        rule: [entry.split()[0] for entry in listed(tmp_path, rule=rule).values()]
        for rule in ("path", "file", "folder", "one")
    }
    assert by_rule == {
        "path": ["friday/ada", "monday/ada", "monday"],
        "file": ["ada", "ada", "monday"],
        "folder": ["friday", "monday", "monday"],
        "one": [tmp_path.name] * 3,
    }


def test_a_name_in_two_folders_is_a_doubt_that_is_told(tmp_path):
    put(tmp_path, ["friday/ex06_ada.ipynb", "monday/ex06_ada.ipynb", "ex06_bob.ipynb"])
    notebooks, _ = find_notebooks([tmp_path])
    doubts = [doubt for _, doubt in learners_of(notebooks, tmp_path, "path")]
    assert doubts[0] == "" and doubts[1] == doubts[2]
    assert "ada is the name in different folders" in doubts[1] and "--learner file" in doubts[1]


def test_folders_named_one_by_one_name_their_learners(tmp_path):
    put(tmp_path, ["ada/ex06.ipynb", "bob/ex06.ipynb"])
    right = {"ada/ex06.ipynb": "ada ex06", "bob/ex06.ipynb": "bob ex06"}
    assert listed(tmp_path / "ada", tmp_path / "bob") == right
    assert listed(tmp_path / "ada/ex06.ipynb", tmp_path / "bob", tmp_path / "bob") == right
    assert listed(tmp_path / "ada") == {"ex06.ipynb": "ada ex06"}


ANY = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0/")
    | st.characters(min_codepoint=0xDC80, max_codepoint=0xDCFF),
    min_size=1,
    max_size=60,
)
"""Any file name, bytes that are no text included, as Python reads them."""


@given(ANY, ANY)
def test_any_names_can_be_shown_and_no_two_look_the_same(one, other):
    shown = [plain_name(name) for name in (one, other)]
    assert all(name.isprintable() and name.encode() for name in shown)
    assert (shown[0] == shown[1]) == (one == other)


@given(ANY, ANY)
def test_no_two_learners_become_one(one, other):
    # Letters around keep what is stripped from the ends; the rest of the rule stays out of it.
    one, other = (re.sub(r"copy|\(\d+\)|ex\d", "", f"n{n}n", flags=re.I) for n in (one, other))
    for form in ("ex06_{}.ipynb", "{} ex06 (1).ipynb", "{}/ex06.ipynb", "x/{}/ex06-Copy1.ipynb"):
        paths = [Path("/in", form.format(name)) for name in (one, other)]
        (first, _), (second, _) = learners_of(paths, Path("/in"), "path")
        assert (first == second) == (one == other)
        assert exercise_of(paths[0], Path("/in"), "") == "ex06"


# Which exercise -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "metadata", "complaint"),
    [
        ("ex12.ipynb", "ex10", "ex10 by its metadata, ex12 by its name"),
        ("ex12/ada.ipynb", "ex10", "ex10 by its metadata, ex12 by its folder"),
        ("ex12/ex10.ipynb", "", "ex10 by its name, ex12 by its folder"),
        ("ex10_ex11.ipynb", "", "ex10 and ex11 by its name"),
        ("ex14_ada.ipynb", "", "ex14 by its name"),
        ("ex14_ada.ipynb", "ex10", "ex10 by its metadata, ex14 by its name"),
        ("ada.ipynb", "", "do not say"),
        ("ada.ipynb", "../ex01", "do not say"),
        ("ex\u0660\u0666.ipynb", "", "do not say"),  # digits, but not of a name of ours
    ],
)
def test_what_says_two_exercises_or_none_is_not_graded_as_one(tmp_path, name, metadata, complaint):
    put(tmp_path, {name: metadata})
    metadata = read_submission(tmp_path / name).exercise
    with pytest.raises(NotebookError, match=complaint):
        exercise_of(tmp_path / name, tmp_path, metadata)


# Nothing is left out without a word, nor opened that was not handed in ----------------------------


def test_what_is_no_notebook_is_named_with_the_reason(tmp_path):
    put(tmp_path, ["ex06_ada.ipynb"])
    for name in (
        *("__MACOSX/._ex06_ada.ipynb", "._ex06_ada.ipynb", ".ipynb_checkpoints/ex06_ada.ipynb"),
        *("ex06_bob.zip", "ex06_eve.pdf", ".git/HEAD", "deep/er/notes.txt"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "deep")
    notebooks, skipped = find_notebooks([tmp_path])
    assert [path.name for path in notebooks] == ["ex06_ada.ipynb"]
    reasons = {str(path.relative_to(tmp_path)): reason for path, reason in skipped.items()}
    assert reasons == {
        "__MACOSX": "macOS's own data",
        "._ex06_ada.ipynb": "macOS's data on another file",
        ".ipynb_checkpoints": "Jupyter's own copies",
        "ex06_bob.zip": "an archive: unpack it first",
        "ex06_eve.pdf": "no notebook (.ipynb) and no mine.py",
        ".git": "a hidden folder",
        "deep/er/notes.txt": "no notebook (.ipynb) and no mine.py",
        "link": "a link, which is not followed: the file itself must be handed in",
    }


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
def test_links_pipes_and_devices_are_not_read(tmp_path):
    solved = submit(tmp_path / "solutions", "ex10", *HONEST)
    inside = tmp_path / "in"
    inside.mkdir()
    for name, target in {"a": solved, "b": "/dev/zero", "c": "/proc/kmsg", "d": "none"}.items():
        (inside / f"{name}.ipynb").symlink_to(target)
    os.mkfifo(inside / "e.ipynb")
    (inside / "f").symlink_to(solved.parent)
    notebooks, skipped = find_notebooks([inside])
    assert [path.stem for path in notebooks] == ["a", "b", "c", "d", "e"]
    assert [*skipped] == [inside / "f"]
    for path in notebooks:
        with pytest.raises(NotebookError, match=r"not read: (a link|no file, but a pipe)"):
            read_submission(path)
    # As a shell gives them for in/*; one folder alone is the instructor's own link.
    assert find_notebooks(sorted(inside.iterdir())) == (notebooks, skipped)
    assert find_notebooks([inside / "f"]) == ([inside / "f" / "ex10.ipynb"], {})


def test_a_path_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"missing\.ipynb is no notebook and no folder"):
        find_notebooks([tmp_path, tmp_path / "missing.ipynb"])


# What it holds ------------------------------------------------------------------------------------


def read(folder: Path, content: str | bytes) -> tuple[str, list[str], str]:
    path = folder / "ex10.ipynb"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_submission(path)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "not a readable notebook: Expecting value"),
        ("[1, 2", "not a readable notebook: Expecting"),
        (b'{"cells": "M\xfcller"}', "not a readable notebook: 'utf-8' codec"),
        ("[" * 100_000, "not a readable notebook: maximum recursion depth"),
        ('{"cells": [' + "9" * 5000 + "]}", "not a readable notebook: Exceeds the limit"),
        ("[]", "its JSON is no object"),
        ('{"cells": 3}', "no list of cells"),
        ('{"nbformat": 4, "metadata": {}}', "no list of cells"),
        ('{"nbformat": 3, "worksheets": [{"cells": []}]}', "nbformat 3 .* open and save it in Jup"),
        ('{"worksheets": []}', "nbformat 3 .* open and save it in Jupyter"),
        ('{"nbformat": 2, "cells": []}', "nbformat 3 or older"),
        ('{"cells": [0' + ", 0" * 10_000 + "]}", "more than 10000 cells"),
    ],
)
def test_what_is_no_notebook_of_today_is_named_as_such(tmp_path, content, complaint):
    with pytest.raises(NotebookError, match=complaint):
        read(tmp_path, content)


CODE = {"cell_type": "code", "source": ["x = 1\n", "y = 2"], "metadata": {}}


@pytest.mark.parametrize(
    ("changes", "damage"),
    [
        ({}, ""),
        ({"metadata": None}, "damaged: its metadata are missing"),
        ({"metadata": [1]}, "damaged: its metadata are a list"),
        ({"metadata": {"fgtutor": None}}, ""),
        ({"metadata": {"fgtutor": {"exercise": ["ex01"]}}}, ""),
        ({"nbformat": None}, "damaged: its nbformat is missing instead of 4"),
        ({"nbformat": 5}, "damaged: its nbformat is 5 instead of 4"),
        ({"nbformat": [[[]]]}, "damaged: its nbformat is a list instead of 4"),
        ({"cells": [{"cell_type": "code"}, CODE]}, "damaged: cell 1 has no source"),
        ({"cells": [CODE, {"cell_type": "code", "source": 3}]}, "damaged: cell 2 has no source"),
        ({"cells": [CODE, CODE | {"source": ["x", 3]}]}, "damaged: cell 2 has no source"),
        ({"cells": [{"source": "x"}, CODE]}, "damaged: cell 1 has no type"),
        (
            {"cells": [CODE] + [3] * 9},
            "damaged: cell 2 has no type, cell 3 has no type, cell 4 has no type and 6 more",
        ),
    ],
)
def test_of_a_damaged_notebook_the_code_is_read_that_is_left(tmp_path, changes, damage):
    whole = {"cells": [CODE], "metadata": {}, "nbformat": 4}
    assert read(tmp_path, json.dumps(whole | changes)) == ("", ["x = 1\ny = 2"], damage)


def test_sizes_beyond_any_exercise_are_refused(tmp_path):
    with pytest.raises(NotebookError, match=f"more than {LARGEST_CODE} characters of code"):
        read(tmp_path, json.dumps({"cells": [CODE | {"source": "x" * (LARGEST_CODE + 1)}]}))
    with (tmp_path / "sparse.ipynb").open("wb") as file:
        file.truncate(LARGEST_NOTEBOOK + 1)
    with pytest.raises(NotebookError, match=f"larger than {LARGEST_NOTEBOOK} bytes"):
        read_submission(tmp_path / "sparse.ipynb")


@pytest.mark.slow
def test_what_the_system_keeps_from_us_is_no_fault_of_theirs(tmp_path):
    put(tmp_path, ["closed/ex06.ipynb", "ex06_ada.ipynb"])
    (tmp_path / "closed").chmod(0)
    (tmp_path / "ex06_ada.ipynb").chmod(0)
    code = """
import os, sys
from pathlib import Path
from fgtutor.course.grading.submissions import find_notebooks, read_submission
os.chdir(sys.argv[1])
if os.geteuid() == 0:
    os.setresuid(65534, 65534, 65534)
notebooks, skipped = find_notebooks([Path(".")])
print(notebooks[0].name, skipped)
try:
    read_submission(notebooks[0])
except PermissionError:
    print("not ours")
"""
    command = [sys.executable, "-P", "-c", code, str(tmp_path)]
    tmp_path.chmod(0o755)  # for the user that root becomes
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    (tmp_path / "closed").chmod(0o755)
    assert done.stdout == (
        "ex06_ada.ipynb {PosixPath('closed'): 'cannot be read: Permission denied'}\nnot ours\n"
    )
