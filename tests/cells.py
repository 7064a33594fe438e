"""Cells of a notebook that tests run: their source is kept, as a kernel keeps it."""

import linecache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fgtutor.course import exercises


def run_cell(source: str, namespace: dict[str, Any]) -> None:
    """Run a cell among a notebook's variables."""
    name = f"<cell {len(linecache.cache)}>"
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    exec(compile(source, name, "exec"), namespace)


def cell(source: str, **variables) -> SimpleNamespace:
    """Run a cell as a notebook does, which keeps its source, and return what it defines."""
    namespace = {"__name__": "__main__"} | variables
    run_cell(source, namespace)
    return SimpleNamespace(**namespace)


def solved(root: Path, exercise: str) -> dict:
    """Run the worked solutions of an exercise, with their checks, and return what they define."""
    built = exercises.build(root / "solutions" / "src" / f"{exercise}.py")
    namespace = {"__name__": "__main__"}
    for source in (one.source for one in built.solution.cells if one.cell_type == "code"):
        if "with_mine(" not in source:
            run_cell(source, namespace)
    return namespace
