"""The folder that a command leaves behind: table, every trial, figures, and where they came from.

Reads a finished run, its table and its figures; writes beside the shards (see `shards`)

    table.md     title, table, and a caption that says how many trials it stands on
    rows.json    every trial, one per line
    run.json     settings with seeds, machines with versions, times, numbers of tasks and trials
    figures/     what the command draws

Another experiment needs four things. A function of a module that takes plain arguments and returns
rows (`trials.drive` does the driving). Its tasks, `[Task(name=..., function=..., arguments=...)]`.
A config that inherits `RunConfig`. And a function that makes `Findings` of the rows (`markdown`,
`Share`), for `run_and_report`.
"""

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgtutor.evaluation.cost import Cost
from fgtutor.evaluation.shards import Run, RunConfig, collect, finished
from fgtutor.evaluation.tasks import Task
from fgtutor.io.machine import usable_cores
from fgtutor.io.storage import atomic_write, locked_folder, make_folder, write_json
from fgtutor.statistics import Share

TABLE, ROWS, RUN, FIGURES = "table.md", "rows.json", "run.json", "figures"

Draw = Callable[[Path], object]
"""Draws a figure into a file."""


def shares_chart(groups: Mapping[str, Mapping[str, Share]], title: str) -> Draw:
    """Return what draws shares within groups, when and if the report is written."""

    def draw(path: Path) -> None:
        from fgtutor.figures.charts import draw_shares  # matplotlib: no worker needs it

        draw_shares(groups, title=title).savefig(path)

    return draw


def reliability_chart(trials: Sequence[Mapping[str, Any]]) -> dict[str, Draw]:
    """Return what draws the promises of routes against how many arrived, by the file's name.

    Refused trials promise nothing, and neither do rows of before rows said it; nothing is drawn
    where none does.
    """
    driven = [row for row in trials if row.get("promise") is not None]
    if not driven:
        return {}
    promised = np.array([row["promise"] for row in driven])
    arrived = np.array([row["outcome"] == "reached" for row in driven])

    def draw(path: Path) -> None:
        from fgtutor.figures.charts import draw_reliability

        draw_reliability(promised, arrived).savefig(path)

    return {"reliability.svg": draw}


def markdown(columns: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    cells = [columns, ["---"] * len(columns), *lines]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in cells)


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What the rows of a finished run come to."""

    table: str
    """As Markdown."""
    caption: str
    """What the table's numbers are, and how they were got."""
    figures: Mapping[str, Draw] = field(default_factory=dict)
    """By the name of their file."""
    rows: str = "trials"
    """What the rows are called."""


def run_and_report(
    config: RunConfig,
    *,
    title: str,
    tasks: Sequence[Task],
    settings: dict[str, Any],
    cost: Callable[[], Cost] | None = None,
    find: Callable[[list[Any]], Findings],
    watched: AbstractContextManager[None] | None = None,
) -> int:
    """Say what an evaluation will cost, do what is left of it, print and keep what it found.

    `find` gets the rows that the tasks returned, in the order of the tasks; `watched` surrounds the
    tasks, to show more of them than how many are done.
    Returns the exit status of its command, 0. Raises what `collect` and `write_report` raise.
    """
    began = time.time()
    with locked_folder(config.out) if config.out else nullcontext():
        left = len(tasks) - len(finished(tasks, settings, config))
        if left:
            # How many cores a cluster will give is not known before it does.
            cores = 1 if config.ray else config.workers or usable_cores()
            takes = f"; all of them: {cost().on(cores)}" if cost else ""
            print(f"{left} of {len(tasks)} tasks to do{takes}", flush=True)
        with watched or nullcontext():
            run = collect(tasks, settings, config, progress=True)
        found = find(run.rows)
        if config.out:
            write_report(config.out, run, found, title=title, settings=settings, began=began)
        print(f"{found.table}\n\n{found.caption}")
        if config.out:
            print(f"report -> {config.out}")
        return 0


def write_report(
    folder: Path,
    run: Run,
    found: Findings,
    *,
    title: str,
    settings: Mapping[str, Any],
    began: float,
) -> None:
    """Write what a finished run found; `began` is the `time.time()` at which this command did.

    Raises `StorageError` if the system refuses.
    """
    rows = run.rows
    caption = f"{found.caption} {len(rows):,} {found.rows} in all."
    make_folder(folder / FIGURES)
    for name, draw in found.figures.items():
        with atomic_write(folder / FIGURES / name) as path:
            draw(path)
    with atomic_write(folder / ROWS) as path:
        path.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    provenance = {
        "title": title,
        "settings": settings,
        "trials": len(rows),
        "tasks": len(run.results),
        "machines": run.machines,
        "task_seconds": round(run.seconds, 1),
        "wall_seconds": round(time.time() - began, 1),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    write_json(folder / RUN, provenance)
    # Last, since a folder with a table is a finished one.
    with atomic_write(folder / TABLE) as path:
        path.write_text(f"# {title}\n\n{found.table}\n\n{caption}\n")
