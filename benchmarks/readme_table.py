"""Write a table into the README or docs/results.md, with the number of trials it stands on.

Reads folders that a `fgtutor evaluate` command has finished; replaces what stands between
`<!-- table NAME -->` and `<!-- end NAME -->` in the page that has these lines. Folders of other
policies, planners or terrains, all else being equal, join the first one's table: a specialist that
has changed need not wait for the others again. Folders of other settings (the paper's beside ours)
have a table of their own below, under their own caption.
Without folders, the commands of the table are run first: those that docs/results.md shows with
`# NAME` after them. Interrupted, the same line goes on; a table takes minutes to hours.
Use: python benchmarks/readme_table.py NAME [FOLDER ...]
"""

import json
import re
import shlex
import sys
from collections.abc import Sequence, Set
from functools import reduce
from pathlib import Path
from typing import Any

from fgtutor.__main__ import main as fgtutor
from fgtutor.errors import ReportError
from fgtutor.evaluation.report import ROWS, RUN, TABLE, markdown
from fgtutor.io.storage import atomic_write

PAGES = (Path("README.md"), Path("docs/results.md"))
RUNS = Path("runs/tables")
"""Where the commands of tables leave their reports."""
FREE = {"policies", "planners", "terrains", "zoo"}
"""Settings in which folders of one table may differ."""


def run(name: str, pages: Sequence[Path]) -> list[Path]:
    """Run the commands that the pages show for a table; return their report folders."""
    text = "".join(page.read_text() for page in pages).replace("\\\n", " ")
    lines = re.findall(rf"^ +fgtutor (.+\S) +# {re.escape(name)}$", text, re.MULTILINE)
    if not lines:
        raise ReportError(f"no page shows a command with `# {name}` after it: give its folders")
    folders = [RUNS / f"{name}-{number}" for number in range(1, len(lines) + 1)]
    for line, folder in zip(lines, folders, strict=True):
        print(f"fgtutor {line} --out {folder}", file=sys.stderr)
        if fgtutor([*shlex.split(line), "--out", str(folder)]):
            raise ReportError(f"`fgtutor {line}` failed: see above")
    return folders


def fill(pages: Sequence[Path], name: str, block: str) -> None:
    """Write the block between the markers of `name`, of which there is one pair in all pages."""
    begin, end = f"<!-- table {name} -->", f"<!-- end {name} -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    texts = {page: page.read_text() for page in pages}
    found = [page for page, text in texts.items() for _ in pattern.finditer(text)]
    if len(found) != 1:
        raise ReportError(
            f"expected one pair of lines {begin} and {end}, found {len(found)}: have them once in "
            + " or ".join(map(str, pages))
        )
    with atomic_write(found[0]) as path:
        path.write_text(pattern.sub(lambda _: f"{begin}\n{block}\n{end}", texts[found[0]]))


def block_of(folders: Sequence[Path]) -> str:
    """Return the tables of report folders, with all trials counted and the date."""
    tables: dict[str, list[list[list[str]]]] = {}  # by caption, which names the settings
    runs: dict[str, list[dict[str, Any]]] = {}
    trials = 0
    for folder in folders:
        try:
            _, table, caption = (folder / TABLE).read_text().strip().split("\n\n")
            trials += len(json.loads((folder / ROWS).read_bytes()))
            run = json.loads((folder / RUN).read_bytes())
        except (OSError, ValueError) as error:
            raise ReportError(
                f"{folder} holds no finished report ({error}): run the command with --out to its "
                "end"
            ) from error
        head, _, *lines = (line.strip("| ").split(" | ") for line in table.splitlines())
        caption = re.sub(r" [\d,]+ trials in all\.$", "", caption)
        tables.setdefault(caption, []).append([head, *lines])
        runs.setdefault(caption, []).append(run)
    parts = []
    for caption, joined in tables.items():
        _check([run["settings"] for run in runs[caption]], FREE)
        head, *lines = reduce(join, joined)
        parts += [markdown(head, lines), caption]
    every = [run for some in runs.values() for run in some]
    settings = [run["settings"] for run in every]
    _check(settings, {name for one in settings for name in one} - {"command"})
    date, command = max(run["finished"] for run in every)[:10], settings[0]["command"]
    return "\n\n".join([*parts, f"*{trials:,} trials of `fgtutor {command}`, {date}.*"])


def join(one: list[list[str]], other: list[list[str]]) -> list[list[str]]:
    """Return two tables as one: below each other if their heads are the same, else side by side."""
    if one[0] == other[0]:
        return one + other[1:]
    if [line[0] for line in one] == [line[0] for line in other]:
        return [mine + theirs[1:] for mine, theirs in zip(one, other, strict=True)]
    raise ReportError("the folders' tables share neither their lines nor their columns")


def _check(settings: Sequence[dict[str, Any]], free: Set[str]) -> None:
    """Raise `ReportError` if one differs from the first in more than `free`, or in a specialist."""
    first = settings[0]
    for later in settings[1:]:
        changed = {
            name for name in first.keys() | later.keys() if first.get(name) != later.get(name)
        }
        zoos = first.get("zoo", {}), later.get("zoo", {})
        retrained = {name for name in zoos[0].keys() & zoos[1] if zoos[0][name] != zoos[1][name]}
        if wrong := (changed - free) | retrained:
            raise ReportError(f"the folders differ in {', '.join(sorted(wrong))}: not one table")


def main(arguments: Sequence[str]) -> None:
    name, *given = arguments
    folders = [Path(folder) for folder in given] or run(name, PAGES)
    fill(PAGES, name, block_of(folders))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1:])
    except ReportError as error:
        sys.exit(str(error))
