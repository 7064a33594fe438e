"""Where modules stand: the course uses the library, and the library holds nothing for it alone."""

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import fgtutor

PACKAGE = Path(__file__).parents[1] / "fgtutor"
COURSE = "fgtutor.course"
SHARED = "fgtutor.figures."
"""Pictures that only notebooks show may stand beside those that commands save."""


def modules() -> dict[str, Path]:
    found = {
        path.relative_to(PACKAGE.parent).with_suffix(""): path for path in PACKAGE.rglob("*.py")
    }
    return {".".join(name.parts).removesuffix(".__init__"): path for name, path in found.items()}


def imported(path: Path) -> Iterator[str]:
    """Every module that a file may import, those inside functions included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def users() -> dict[str, set[str]]:
    """The modules that import each module of the package."""
    there = modules()
    found: dict[str, set[str]] = {name: set() for name in there}
    for name, path in there.items():
        for other in set(imported(path)) & there.keys():
            found[other].add(name)
    return found


def test_nothing_outside_the_course_imports_it():
    for name, by in users().items():
        if name.startswith(COURSE):
            assert all(user.startswith(COURSE) for user in by), f"{name} is imported by {by}"


def test_no_module_outside_the_course_serves_it_alone():
    alone = {
        name
        for name, by in users().items()
        if by and not name.startswith((COURSE, SHARED)) and all(u.startswith(COURSE) for u in by)
    }
    assert alone == set(), f"move these into {COURSE}: {sorted(alone)}"


def test_the_diagram_shows_the_layers_of_the_import_contract():
    settings = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    contract = [re.findall(r"\w+", layer) for layer in layers]
    diagram = (fgtutor.__doc__ or "").split("those below it:\n\n")[1].splitlines()
    shown = [re.split(r" {2,}", line.strip())[0].split(" | ") for line in diagram if line.strip()]
    assert [["__main__"], *shown] == contract
