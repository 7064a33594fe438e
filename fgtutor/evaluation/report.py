"""The folder that a command leaves behind: table, every trial, figures, and where they came from.

Reads a finished run, its table and its figures; writes beside the shards (see `shards`)

    table.md     title, table, and a caption that says how many trials it stands on
    rows.json    every trial, one a line
    run.json     settings with seeds, machines with versions, times, numbers of tasks and trials
    figures/     what the command draws

Another experiment needs four things. A function of a module that takes plain arguments and returns
rows (`trials.drive` does the driving). Its tasks, `[Task(name=..., function=..., arguments=...)]`.
A config that inherits `RunConfig`. And a `run` like `matrix.run`: `collect` the rows under
`settings_of(config, ...)`, make a table of them (`markdown`, `Share`), and `write_report`.
"""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from fgtutor.evaluation.metrics import wilson_interval
from fgtutor.evaluation.shards import Run
from fgtutor.storage import atomic_write, make_folder, write_json

TABLE, ROWS, RUN, FIGURES = "table.md", "rows.json", "run.json", "figures"

Draw = Callable[[Path], object]
"""Writes a figure to a path: `figure.savefig`, or `lambda path: path.write_text(svg)`."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of some trials succeeded, with its 95 % interval (Wilson)."""

    successes: int
    trials: int

    @classmethod
    def of(cls, successes: Iterable[bool]) -> Self:
        """Count successes."""
        outcomes = [bool(success) for success in successes]
        return cls(successes=sum(outcomes), trials=len(outcomes))

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the interval, in [0, 1]."""
        return wilson_interval(self.successes, self.trials)

    def __str__(self) -> str:
        """Write percent with as many digits as the trials bear: 96 (87-99), 99.96 (99.90-99.98)."""
        digits = 0 if self.trials < 1000 else 1 if self.trials < 10_000 else 2
        share, low, high = (
            f"{100 * x:.{digits}f}" for x in (self.successes / self.trials, *self.interval)
        )
        return f"{share} ({low}-{high})"


def markdown(columns: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    cells = [columns, ["---"] * len(columns), *lines]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in cells)


def write_report(
    folder: Path,
    run: Run,
    *,
    title: str,
    table: str,
    caption: str,
    settings: Mapping[str, Any],
    began: float,
    figures: Mapping[str, Draw] | None = None,
) -> None:
    """Write what a finished run found; `began` is the `time.time()` at which this command did.

    Raises `StorageError` if the system refuses.
    """
    rows = run.rows
    caption = f"{caption} {len(rows):,} trials in all."
    make_folder(folder / FIGURES)
    for name, draw in (figures or {}).items():
        with atomic_write(folder / FIGURES / name) as path:
            draw(path)
    with atomic_write(folder / ROWS) as path:
        path.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    provenance = {
        "title": title,
        "settings": settings,
        "trials": len(rows),
        "tasks": run.tasks,
        "machines": run.machines,
        "task_seconds": round(run.seconds, 1),
        "wall_seconds": round(time.time() - began, 1),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    write_json(folder / RUN, provenance)
    # Last, since a folder with a table is a finished one.
    with atomic_write(folder / TABLE) as path:
        path.write_text(f"# {title}\n\n{table}\n\n{caption}\n")
