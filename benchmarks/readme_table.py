"""Write a table into the README from a report folder, with the number of trials it stands on.

Reads a folder that a `fgtutor evaluate` command has finished; replaces what stands between
`<!-- table NAME -->` and `<!-- end NAME -->`.
Use: python benchmarks/readme_table.py FOLDER NAME [README.md]
"""

import json
import re
import sys
from pathlib import Path

from fgtutor.errors import ReportError
from fgtutor.evaluation.report import ROWS, RUN, TABLE
from fgtutor.storage import atomic_write


def fill(text: str, name: str, block: str) -> str:
    """Return the text with the block between the markers of `name`, of which there is one pair."""
    begin, end = f"<!-- table {name} -->", f"<!-- end {name} -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ReportError(f"expected one pair of lines {begin} and {end}: add them to the file")
    return pattern.sub(lambda _: f"{begin}\n{block}\n{end}", text)


def block_of(folder: Path) -> str:
    """Return table and caption of a report folder, with its trials counted and its date."""
    try:
        table = (folder / TABLE).read_text().split("\n", 2)[2].strip()
        trials = len(json.loads((folder / ROWS).read_bytes()))
        run = json.loads((folder / RUN).read_bytes())
        date, command = run["finished"][:10], run["settings"]["command"]
    except (OSError, ValueError, LookupError) as error:
        raise ReportError(
            f"{folder} holds no finished report ({error}): run the command with --out to its end"
        ) from error
    return f"{table}\n\n*{trials:,} trials of `fgtutor {command}`, {date}.*"


def main(arguments: list[str]) -> None:
    folder, name, *rest = arguments
    readme = Path(rest[0] if rest else "README.md")
    text = fill(readme.read_text(), name, block_of(Path(folder)))
    with atomic_write(readme) as path:
        path.write_text(text)


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        main(sys.argv[1:])
    except ReportError as error:
        sys.exit(str(error))
