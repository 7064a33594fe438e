"""The learner's `mine.py`: each answer that has passed its check, as a module that runs on its own.

Reads and writes `mine.py` in the working folder, a section per question; gives the functions. Only
what has passed is written, whole or not at all, and a file that somebody else wrote or changed is
left as it is. `import mine` in a notebook has them; `fgtutor grade mine.py` marks them.
"""

import ast
import hashlib
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fgtutor.errors import ConfigError, StorageError
from fgtutor.io.storage import atomic_write

FILE = "mine.py"
HEADER = '''"""My planner: what has passed its check in the course of fgtutor, ready to import.

Written by `check`, a section per question: change a function in your notebook and check it again.
"""
'''
"""How the file begins."""
SECTION = re.compile(r"^# %% (ex\d\d\.q\d+)(?: ([0-9a-f]{8}))?$", re.MULTILINE)
"""The line before a section: its question, and a checksum of what follows."""
DRIVE = "/drive"
"""Where JupyterLite shows Python the files that the browser keeps."""
LARGEST = 1_000_000
"""Characters of a file that is read; a whole course takes thirty thousand."""


def sections_of(text: str) -> dict[str, str]:
    """Return the sections of a file by question, whoever wrote them; of two, the last."""
    _, *parts = SECTION.split(text)
    return dict(zip(parts[::3], (part.strip("\n") + "\n" for part in parts[2::3]), strict=True))


def read(folder: Path | None = None) -> dict[str, str]:
    """Return the source that is kept for each question; nothing if there is no file.

    Raises:
        ConfigError: The file is not as `keep` left it. It stays as it is.
        StorageError: The system does not let us read it.
    """
    path = _path(folder)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            text = file.read(LARGEST + 1).replace("\r\n", "\n")
    except FileNotFoundError:
        return {}
    except UnicodeDecodeError:
        raise _damaged(path, "it is no text") from None
    except OSError as error:
        raise StorageError(f"{path} cannot be read: {error.strerror}") from error
    if len(text) > LARGEST:
        raise _damaged(path, f"it is longer than {LARGEST} characters")
    if not text.startswith(HEADER):
        raise _damaged(path, "it does not begin as `check` begins it")
    kept = sections_of(text)
    if changed := _changed(text):
        raise ConfigError(
            f"the section of {changed[0]} in {path} was changed by hand, so it may no longer "
            f'pass: undo the change, or call reset("{changed[0]}") and check it again'
        )
    if text != _text(kept):
        raise _damaged(path, "it holds more than its sections, or a section is incomplete")
    return kept


def keep(question: str, source: str, folder: Path | None = None) -> None:
    """Write the source of an answer that has passed; raises as `read`, and if names clash.

    A second pass replaces the first.
    """
    kept = read(folder)
    clash = _clash(question, source, kept)
    if clash:
        raise ConfigError(clash)
    # In the order of the course, ex04.q10 after ex04.q2.
    order = sorted(
        {**kept, question: source}, key=lambda name: [*map(int, re.findall(r"\d+", name))]
    )
    changed = {name: source if name == question else kept[name] for name in order}
    if sections_of(_text(changed)) != changed:
        raise ConfigError("a line in it begins like a section of mine.py: change that line")
    _write(_path(folder), changed)


def reset(question: str = "", folder: Path | None = None) -> str:
    """Forget what is kept for a question, or everything; return what was done.

    A section that was changed by hand can be reset too. With everything, the file is renamed to
    `mine-old.py`, so that nothing is lost. Raises `ConfigError` for a file that is damaged.
    """
    path = _path(folder)
    if not question:
        if not path.exists():
            return f"there is no {FILE}"
        old = path.with_name("mine-old.py")
        os.replace(path, old)
        return f"{FILE} is now {old.name}, and a new one begins with the next pass"
    try:
        kept = read(folder)
    except ConfigError:
        text = path.read_text(encoding="utf-8", errors="replace")
        kept = sections_of(text)
        if not text.startswith(HEADER) or question not in kept:
            raise
        if any(name != question for name in _changed(text)):
            raise
    if question not in kept:
        return f"nothing is kept for {question}"
    del kept[question]
    _write(path, kept)
    return f"{question} is no longer in {FILE}"


def lasts() -> bool:
    """Return whether a file in the working folder outlives this process; in a browser it may not.

    JupyterLite has its lasting files under `DRIVE`, unless the browser allows no service worker.
    """
    return sys.platform != "emscripten" or Path.cwd().is_relative_to(DRIVE)


def load(folder: Path | None = None) -> dict[str, dict[str, Any]]:
    """Return for each question the variables of its section, run on its own; raises as `read`."""
    return {question: run(source) for question, source in read(folder).items()}


def run(source: str) -> dict[str, Any]:
    """Run a section by itself and return its variables.

    Raises:
        ConfigError: It does not run.
    """
    variables: dict[str, Any] = {"__name__": "mine"}
    try:
        exec(compile(source, f"<{FILE}>", "exec"), variables)
    except Exception as error:
        raise ConfigError(f"on its own it does not run: {type(error).__name__}: {error}") from error
    return variables


def _path(folder: Path | None) -> Path:
    return (folder or Path.cwd()) / FILE


def _damaged(path: Path, reason: str) -> ConfigError:
    return ConfigError(
        f"{path} was not written by `check`, or is damaged ({reason}). It is left as it is: rename "
        "it, and a new one begins with the next pass"
    )


def _clash(question: str, source: str, kept: Mapping[str, str]) -> str:
    """Say which name would mean different things in two sections, as all share one module."""
    written = _statements(source)
    for other, text in kept.items():
        if other == question:
            continue
        theirs = _statements(text)
        for name in written.keys() & theirs.keys():
            if written[name] != theirs[name]:
                return (
                    f"`{name}` means something else in what is kept for {other}: rename one of "
                    f'them, or call reset("{other}") and check both again'
                )
    return ""


def _statements(source: str) -> dict[str, str]:
    """Return the statement behind each name that a section defines."""
    found = {}
    for node in ast.parse(source).body:
        text = ast.unparse(node)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = text
        elif isinstance(node, ast.Assign):
            found |= {t.id: text for t in node.targets if isinstance(t, ast.Name)}
        elif isinstance(node, ast.Import | ast.ImportFrom):
            module = getattr(node, "module", "")
            for alias in node.names:
                name = alias.asname or alias.name.partition(".")[0]
                what = alias.name if alias.asname else name if not module else alias.name
                found[name] = f"{module} {what}"
    return found


def _changed(text: str) -> list[str]:
    """Return the questions whose sections are not as `keep` wrote them."""
    sums = dict(SECTION.findall(text))
    return [name for name, source in sections_of(text).items() if sums[name] != _checksum(source)]


def _checksum(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()[:8]


def _text(kept: Mapping[str, str]) -> str:
    """Return the file that holds these sections."""
    parts = [f"# %% {name} {_checksum(source)}\n{source}" for name, source in kept.items()]
    return "\n\n".join([HEADER, *parts])


def _write(path: Path, kept: Mapping[str, str]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(_text(kept), encoding="utf-8", newline="\n")
