"""From a master to an exercise: the same notebook, without its solutions.

Reads `solutions/src/exNN.py` (jupytext percent format), in which a solution stands between
`# BEGIN SOLUTION` and `# END SOLUTION`; gives `solutions/exNN.ipynb`, `exercises/exNN.ipynb` (both
without outputs) and the worked solutions that `checks.solution` opens. Titles and points of the
questions come from their checks, so they stand in one place.
"""

import ast
import copy
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fgtutor.course.checks import EXERCISES, SOLUTIONS, questions_of
from fgtutor.course.notebooks import read_source
from fgtutor.errors import NotebookError
from fgtutor.io.progress import waiting
from fgtutor.io.storage import atomic_write, make_folder

if TYPE_CHECKING:
    from nbformat import NotebookNode

REGION = re.compile(
    r"^(?P<indent> *)# BEGIN SOLUTION\n(?P<code>.*?)^ *# END SOLUTION(?:\n|\Z)", re.M | re.S
)
MARK = re.compile(r"^ *# (?:BEGIN|END) SOLUTION(?:\n|\Z)", re.M)
HEADING = re.compile(r"^## (ex\d\d\.q\d+)$", re.M)
METADATA = "fgtutor"
"""Where a notebook's metadata say which exercise it is."""


@dataclass(frozen=True, eq=False)
class Built:
    """What one master gives."""

    exercise: "NotebookNode"
    """The notebook that learners get."""
    solution: "NotebookNode"
    """The same with its solutions."""
    worked: dict[str, str]
    """The worked solution of each question."""


def build(master: Path) -> Built:
    """Build one exercise.

    Raises:
        NotebookError: A question has no heading, or no cell with a solution that defines its name.
    """
    name = master.stem
    solution = read_source(master)
    solution.metadata[METADATA] = {"exercise": name}
    questions = {question.id: question for question in questions_of(name)}
    found = [match for cell in solution.cells for match in HEADING.findall(cell.source)]
    if found != list(questions):
        raise NotebookError(
            f"{master}: the headings are {', '.join(found)}, the checks hold "
            f"{', '.join(questions)}: give each question one `## {name}.qN`, in order"
        )
    for cell in solution.cells:
        if cell.cell_type == "markdown":
            cell.source = HEADING.sub(
                lambda match: (
                    f"## {match[1]} · {questions[match[1]].title} ({questions[match[1]].worth})"
                ),
                cell.source,
            )
    exercise = copy.deepcopy(solution)
    worked = {}
    for kept, stripped in zip(solution.cells, exercise.cells, strict=True):
        if REGION.search(kept.source):
            defined = set(_defined(ast.parse(kept.source)))
            stripped.source = REGION.sub(_blank, kept.source).rstrip()
            kept.source = MARK.sub("", kept.source).rstrip()
            for question in questions.values():
                if question.name in defined:
                    worked[question.id] = kept.source
        if "SOLUTION" in stripped.source or "SOLUTION" in kept.source:
            raise NotebookError(f"{master}: BEGIN SOLUTION without END in\n{kept.source}")
    missing = [question for question in questions if question not in worked]
    if missing:
        raise NotebookError(
            f"{master}: no solution region defines what {', '.join(missing)} asks for: write "
            f"{', '.join(questions[question].call for question in missing)}"
        )
    return Built(exercise, solution, {question: worked[question] for question in questions})


def _blank(region: re.Match[str]) -> str:
    """Return what a learner finds in place of a solution."""
    if region["indent"]:
        return f"{region['indent']}raise NotImplementedError  # your code here\n"
    names = _defined(ast.parse(region["code"]))
    return "".join(f"{name} = ...  # your number here\n" for name in names)


def _defined(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a cell defines."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


# The command --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ExercisesConfig:
    """Build the exercises and their solutions from the masters."""

    solutions: Path = Path("solutions")
    """Folder of the solutions; the masters lie in its src."""
    exercises: Path = Path("exercises")
    """Folder of the exercises."""
    check: bool = False
    """Write nothing; say which files are not what the masters give, and fail if any."""


def outputs(config: ExercisesConfig) -> dict[Path, str]:
    """Return every file that the masters give; raises `NotebookError` if a master is missing."""
    import nbformat

    files, worked = {}, {}
    for name in EXERCISES:
        master = config.solutions / "src" / f"{name}.py"
        if not master.is_file():
            raise NotebookError(f"no master {master}: run this in the repository")
        built = build(master)
        worked |= built.worked
        for folder, notebook in (
            (config.exercises, built.exercise),
            (config.solutions, built.solution),
        ):
            files[folder / f"{name}.ipynb"] = nbformat.writes(notebook) + "\n"
    return files | {SOLUTIONS: json.dumps(worked, indent=1) + "\n"}


def run(config: ExercisesConfig) -> int:
    """Write the files that changed, or say which ones would."""
    with waiting("building the exercises"):
        files = outputs(config)
    changed = [
        (path, text)
        for path, text in files.items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]
    for path, text in changed:
        if config.check:
            print(f"{path.name} is not what its master gives: run `fgtutor exercises`")
            continue
        make_folder(path.parent)
        with atomic_write(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"wrote {path.parent.name}/{path.name}")
    return int(config.check and bool(changed))
