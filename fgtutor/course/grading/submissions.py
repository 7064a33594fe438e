"""Submissions: which notebooks were handed in, whose each one is, and what code it holds.

Reads folders, .ipynb files and what the checks keep (`mine.py`), none of them trusted; gives paths,
names and the text of cells. Links are not followed and pipes not opened, so what is read was handed
in. Names keep apart what differs: one learner under two names can be put together, two under one
cannot be told apart.
"""

import json
import os
import re
import stat
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fgtutor.course.checks import EXERCISES
from fgtutor.course.checks.question import plain_name, plain_text
from fgtutor.course.mine import sections_of
from fgtutor.errors import ConfigError, NotebookError

Rule = Literal["path", "file", "folder", "one"]
"""What names a learner; see `learners_of`."""
LARGEST_NOTEBOOK = 20_000_000
"""Bytes; an exercise without outputs has ten thousand."""
MOST_CELLS = 10_000
"""An exercise has thirty."""
LARGEST_CODE = 1_000_000
"""Characters in all code cells; a solution has five thousand."""
UNREADABLE = "cannot be read"
"""How a reason begins that is no fault of the learner."""
LINK = "a link, which is not followed: the file itself must be handed in"

_ENDING = re.compile(r"\.ipynb(\.txt|\.json)?$", re.IGNORECASE)
"""How a notebook's name ends; browsers and mail programs add to it."""
_MINE = re.compile(r"[ _.-]*(?<![^\W_])mine(?![^\W_])[ _.-]*", re.IGNORECASE)
"""What marks a file of kept answers, beside its ending."""
_EXERCISE = re.compile(r"[ _.-]*(?<![^\W_])(ex[0-9]{2})(?![^\W_])[ _.-]*", re.IGNORECASE)
"""The exercise in a name, between anything but letters and digits."""
_COPY = re.compile(r"\(\d{1,3}\)|(?<![^\W_])copy( of|[ _]?\d{0,3})(?![^\W_])", re.IGNORECASE)
"""What browsers, Jupyter, Colab and desktops add to the name of a copy."""
_FOLDERS = {".ipynb_checkpoints": "Jupyter's own copies", "__MACOSX": "macOS's own data"}
_ARCHIVE = re.compile(r"\.(zip|tar|tgz|gz|bz2|xz|7z|rar)$", re.IGNORECASE)


class Content(NamedTuple):
    """What a notebook holds."""

    exercise: str
    """What its metadata say it is; "" if they do not."""
    cells: list[str]
    """Its code."""
    damage: str
    """What is wrong with it although its code could be read."""


# Which --------------------------------------------------------------------------------------------


def find_notebooks(paths: Sequence[Path]) -> tuple[list[Path], dict[Path, str]]:
    """Return the notebooks among files and folders, and why each other file there is none.

    A folder that is a link is followed only if it is all that `paths` names: of several, as a shell
    makes them of `submissions/*`, one may have been handed in.

    Raises:
        ConfigError: A path does not exist.
    """
    found: dict[str, Path] = {}
    skipped: dict[Path, str] = {}
    for path in paths:
        if not os.path.lexists(path):
            raise ConfigError(f"{plain_name(path)} is no notebook and no folder: check the path")
        if not os.path.isdir(path):
            inside = [path]
        elif path.is_symlink() and len(paths) > 1:
            inside, skipped[path] = [], LINK
        else:
            inside = sorted(_walk(path, skipped))
        for file in inside:
            if reason := _not_a_notebook(file.name):
                skipped[file] = reason
            else:
                found.setdefault(os.path.abspath(file), file)
    return list(found.values()), skipped


def _walk(folder: Path, skipped: dict[Path, str]) -> list[Path]:
    """Return all files below a folder, and add the folders that are left out to `skipped`."""

    def unread(error: OSError) -> None:
        skipped[Path(error.filename)] = f"{UNREADABLE}: {error.strerror}"

    files = []
    for name, folders, inside in os.walk(folder, onerror=unread):
        here = Path(name)
        for child in list(folders):
            linked = LINK if (here / child).is_symlink() else ""
            hidden = "a hidden folder" if child.startswith(".") else ""
            if reason := _FOLDERS.get(child) or linked or hidden:
                folders.remove(child)
                skipped[here / child] = reason
        files += [here / child for child in inside]
    return files


def _not_a_notebook(name: str) -> str:
    """Return why a file is none, by its name; "" if it may be one."""
    if name.startswith("._"):
        return "macOS's data on another file"
    if _ENDING.search(name):
        return ""
    if is_mine(name):
        return ""
    if _ARCHIVE.search(name):
        return "an archive: unpack it first"
    return "no notebook (.ipynb) and no mine.py"


def is_mine(name: str) -> bool:
    """Return whether a file is one of kept answers by its name: mine.py, ada_mine.py and so on."""
    return name.lower().endswith(".py") and bool(_MINE.search(name[:-3]))


# Whose --------------------------------------------------------------------------------------------


def base_of(paths: Sequence[Path]) -> Path:
    """Return the folder that the named paths have in common, which says nothing about a learner."""
    return Path(
        os.path.commonpath([os.path.abspath(p if os.path.isdir(p) else p.parent) for p in paths])
    )


def learners_of(notebooks: Sequence[Path], base: Path, rule: Rule) -> list[tuple[str, str]]:
    """Return for each notebook whose it is, readable and unlike any other, and what is in doubt.

    "file" takes the file's name, without the exercise and the mark of a copy; if nothing is left,
    the folders. "folder" takes the folders below `base`, without the exercise; if there are none,
    that one's name. "path" takes both, so that nobody is put together with somebody else. "one"
    says that all are one learner's.
    """
    named = []
    alike: dict[str, set[str]] = defaultdict(set)
    for notebook in notebooks:
        folders = [left for part in _folders(notebook, base) if (left := _without_exercise(part))]
        own = _COPY.sub("", _without_ending(notebook.name))
        own = _without_exercise(own).strip(" _-.")
        parts = {
            "path": [*folders, *([own] if own and [own] != folders[-1:] else [])],
            "file": [own] if own else folders,
            "folder": folders,
            "one": [],
        }[rule]
        learner = plain_name("/".join(parts) or base.name or "learner")
        named.append((learner, own))
        alike[own].add(learner)
    return [
        (
            learner,
            f"{plain_name(own)} is the name in different folders, taken for {number} learners: if "
            "these are attempts of one, use --learner file"
            if own and rule == "path" and (number := len(alike[own])) > 1
            else "",
        )
        for learner, own in named
    ]


def _without_ending(name: str) -> str:
    """Return a file's name without what says that it is a notebook or one of kept answers."""
    return _MINE.sub("_", name[:-3]) if is_mine(name) else _ENDING.sub("", name)


def _folders(notebook: Path, base: Path) -> tuple[str, ...]:
    return Path(os.path.relpath(os.path.abspath(notebook), base)).parts[:-1]


def _without_exercise(name: str) -> str:
    """Return what a name says beside the exercise."""
    left = _EXERCISE.sub("_", name)
    return name if left == name else left.strip("_")


# What ---------------------------------------------------------------------------------------------


def exercise_of(notebook: Path, base: Path, metadata: str) -> str:
    """Return which exercise a notebook is, by its metadata, its name and its nearest folder.

    Raises:
        NotebookError: None of them says, or they disagree.
    """
    folders = [names for part in _folders(notebook, base) if (names := _exercises_in(part))]
    said = {
        "its metadata": {metadata} & {*EXERCISES},
        "its name": _exercises_in(_without_ending(notebook.name)),
        "its folder": folders[-1] if folders and len(folders[-1]) == 1 else set(),
    }
    different = set().union(*said.values())
    if not different:
        raise NotebookError("which exercise? Its metadata and name do not say: use --exercise")
    if len(different) > 1 or not different <= {*EXERCISES}:
        words = [f"{' and '.join(sorted(what))} by {who}" for who, what in said.items() if what]
        raise NotebookError(
            f"which exercise? One of {EXERCISES[0]} to {EXERCISES[-1]} is expected, it is "
            f"{', '.join(words)}: correct it, or use --exercise"
        )
    return different.pop()


def _exercises_in(name: str) -> set[str]:
    return {match[1].lower() for match in _EXERCISE.finditer(name)}


def read_submission(path: Path) -> Content:
    """Return what a notebook holds; of a damaged one, the code that can still be had.

    Raises:
        NotebookError: It is no notebook, or larger than any.
        OSError: The system does not let us read it, which is no fault of its own.
    """
    data = _read(path)
    try:
        notebook = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise NotebookError(f"not a readable notebook: {plain_text(error)[:200]}") from error
    if not isinstance(notebook, dict):
        raise NotebookError("not a readable notebook: its JSON is no object")
    version = notebook.get("nbformat")
    if "worksheets" in notebook or version in (1, 2, 3):
        raise NotebookError(
            "written as nbformat 3 or older, which Jupyter wrote until 2015: open and save it in "
            "Jupyter, and hand in what it saves"
        )
    if not isinstance(notebook.get("cells"), list):
        raise NotebookError("not a readable notebook: it has no list of cells")
    if len(notebook["cells"]) > MOST_CELLS:
        raise NotebookError(f"more than {MOST_CELLS} cells: hand in less")
    damage = [] if version == 4 else [f"its nbformat is {_brief(version)} instead of 4"]
    metadata = notebook.get("metadata")
    if not isinstance(metadata, dict):
        damage.append(f"its metadata are {_brief(metadata)}")
        metadata = {}
    cells = []
    for number, cell in enumerate(notebook["cells"], 1):
        own = cell if isinstance(cell, dict) else {}
        source: Any = own.get("source")
        lines = [source] if isinstance(source, str) else source
        if not isinstance(own.get("cell_type"), str):
            damage.append(f"cell {number} has no type")
        elif not (isinstance(lines, list) and all(isinstance(line, str) for line in lines)):
            damage.append(f"cell {number} has no source")
        elif own["cell_type"] == "code":
            cells.append("".join(lines))
    if sum(map(len, cells)) > LARGEST_CODE:
        raise NotebookError(f"more than {LARGEST_CODE} characters of code: hand in less")
    own = metadata.get("fgtutor")
    exercise = own.get("exercise") if isinstance(own, dict) else None
    more = f" and {len(damage) - 3} more" * (len(damage) > 3)
    said = f"damaged: {', '.join(damage[:3])}{more}" if damage else ""
    return Content(exercise if isinstance(exercise, str) else "", cells, said)


def read_mine(path: Path) -> dict[str, list[str]]:
    """Return what a file of kept answers holds, by exercise: each answer is a cell.

    Whether an answer was changed since it passed does not matter, as it is asked again.

    Raises:
        NotebookError: It holds no answer, or is no text, or larger than any.
        OSError: The system does not let us read it, which is no fault of its own.
    """
    try:
        text = _read(path).decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise NotebookError("not a readable mine.py: it is no text") from error
    if len(text) > LARGEST_CODE:
        raise NotebookError(f"more than {LARGEST_CODE} characters of code: hand in less")
    found: dict[str, list[str]] = {}
    for question, source in sections_of(text).items():
        found.setdefault(question.partition(".")[0], []).append(source)
    kept = {exercise: found[exercise] for exercise in EXERCISES if exercise in found}
    if not kept:
        raise NotebookError("no answer in it: hand in the mine.py that `check` has written")
    return kept


def _read(path: Path) -> bytes:
    """Return the bytes of a file that was handed in itself; raises as `read_submission`."""
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        raise NotebookError(f"not read: {LINK}")
    if not stat.S_ISREG(mode):
        raise NotebookError("not read: no file, but a pipe, a device or the like")
    with path.open("rb") as file:
        data = file.read(LARGEST_NOTEBOOK + 1)
    if len(data) > LARGEST_NOTEBOOK:
        raise NotebookError(f"larger than {LARGEST_NOTEBOOK} bytes: clear its outputs")
    return data


def _brief(value: Any) -> str:
    if isinstance(value, int | float):
        return f"{value!r:.20}"
    return "missing" if value is None else f"a {type(value).__name__}"
