"""Grading: from submitted notebooks to marks, one process a submission, none of them trusted.

Reads .ipynb files and a seed; gives a `Mark` each, and on request a CSV, Gradescope's JSON and a
report per learner. What a submission sends are answers, as plain JSON; right or wrong is decided
here, against answers worked out here. Hidden cases follow from the seed: there is no secret file.
"""

import json
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import tyro
from tqdm import tqdm

from fgtutor.errors import ConfigError, GradingError, NotebookError
from fgtutor.machine import usable_cores
from fgtutor.storage import atomic_write, check_writable, make_folder, write_json
from fgtutor.teach.checks import EXERCISES, questions_of
from fgtutor.teach.checks.question import CASES, Judge, plain_text
from fgtutor.teach.confinement import WALLS
from fgtutor.teach.marks import KEY, Mark, by_learner, gradescope, report, table
from fgtutor.teach.sandbox import Limits, ask_submission, check_system
from fgtutor.teach.values import encode

LARGEST_NOTEBOOK = 20_000_000
"""Bytes; an exercise without outputs has ten thousand."""


@dataclass(frozen=True, kw_only=True)
class GradeConfig:
    """Grade submitted exercise notebooks, one learner's or a whole class's."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Notebooks, or folders of notebooks."""
    csv: Path | None = None
    """Write one row a notebook here."""
    gradescope: Path | None = None
    """Write Gradescope's results.json here."""
    reports: Path | None = None
    """Write a report per learner into this folder."""
    seed: int = 0
    """What the hidden cases are drawn from: choose your own, and keep it to yourself."""
    cases: int = CASES
    """Hidden cases per question."""
    exercise: str = ""
    """Grade all as this exercise; default: what a notebook's metadata or file name says."""
    workers: int = 0
    """Submissions side by side; 0 takes one per core that a container or affinity leaves us."""
    seconds: float = Limits.seconds
    """CPU time for all cases of a question, s."""
    loading: float = Limits.loading
    """CPU time for running all cells of a notebook, s."""
    memory_mb: int = Limits.memory_mb
    """Memory of a submission, MB."""

    def __post_init__(self) -> None:
        if self.cases < 1 or self.workers < 0 or self.memory_mb < 512:
            raise ConfigError(
                "need cases >= 1, workers >= 0 and memory_mb >= 512 (numpy itself takes 400), got "
                f"{self.cases}, {self.workers} and {self.memory_mb}"
            )
        if not (self.seconds > 0 and self.loading > 0):
            raise ConfigError(
                f"need seconds > 0 and loading > 0, got {self.seconds} and {self.loading}"
            )
        if self.exercise and self.exercise not in EXERCISES:
            raise ConfigError(f"no exercise {self.exercise!r}: there are {', '.join(EXERCISES)}")


class Examiner:
    """The questions of one exercise, their cases and right answers, worked out once for all."""

    def __init__(self, exercise: str, seed: int, cases: int) -> None:
        self.judges = [Judge(q, q.cases(seed, cases)) for q in questions_of(exercise)]
        self.questions = [
            {
                "id": judge.question.id,
                "name": judge.question.name,
                "cases": None if judge.cases is None else [encode(c) for c in judge.cases],
            }
            for judge in self.judges
        ]


def grade(config: GradeConfig, *, progress: bool = False) -> list[Mark]:
    """Return a mark for every notebook, in the order of their paths.

    Raises:
        ConfigError: A path does not exist or holds no notebook, or the system cannot grade.
        MissingExtraError: IPython is not installed, in whose syntax cells are written.
    """
    check_system()
    submissions = find_notebooks(config.paths)
    read = [_read(path, config.exercise) for path in submissions]
    wanted = sorted({exercise for exercise, _, _ in read if exercise})
    examiners = {name: Examiner(name, config.seed, config.cases) for name in wanted}
    limits = Limits(seconds=config.seconds, loading=config.loading, memory_mb=config.memory_mb)

    stop = Event()

    def one(number: int) -> Mark:
        return _grade(submissions[number], *read[number], examiners, limits, stop)

    with ThreadPoolExecutor(config.workers or usable_cores()) as pool:
        marks = pool.map(one, range(len(submissions)))
        try:
            return list(tqdm(marks, total=len(submissions), unit="notebook", disable=not progress))
        except BaseException:  # Ctrl-C: the pool waits for what runs, so that ends now
            stop.set()
            raise


def find_notebooks(paths: Sequence[Path]) -> list[Path]:
    """Return the notebooks among files and folders; raises `ConfigError` for a path without."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("*.ipynb")) if path.is_dir() else [path]
        inside = [p for p in inside if p.is_file() and ".ipynb_checkpoints" not in p.parts]
        if not inside:
            raise ConfigError(f"{path} is no notebook and no folder with one: check the path")
        found += inside
    if not found:
        raise ConfigError("name at least one notebook, or a folder of them")
    return list(dict.fromkeys(found))


def read_submission(path: Path) -> tuple[str, list[str]]:
    """Return what exercise a notebook says it is ("" if it does not) and its code cells.

    Raises:
        NotebookError: It is no notebook, or larger than any.
    """
    try:
        if path.stat().st_size > LARGEST_NOTEBOOK:
            raise NotebookError(f"larger than {LARGEST_NOTEBOOK} bytes: clear its outputs")
        notebook = json.loads(path.read_bytes())
        cells = [
            "".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"
        ]
        own = notebook.get("metadata", {}).get("fgtutor", {})
        exercise = own.get("exercise", "") if isinstance(own, dict) else ""
    except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        if isinstance(error, NotebookError):
            raise
        raise NotebookError(f"not a readable notebook ({type(error).__name__})") from error
    match = re.search(r"ex\d\d", path.stem)
    named = match[0] if match else ""
    return next((name for name in (exercise, named) if name in EXERCISES), ""), cells


def _read(path: Path, exercise: str) -> tuple[str, list[str], str]:
    """Return exercise, cells and, if it cannot be graded, why."""
    try:
        said, cells = read_submission(path)
    except NotebookError as error:
        return exercise, [], str(error)
    name = exercise or said
    unknown = "" if name else "which exercise? Its metadata and name do not say: use --exercise"
    return name, cells, unknown


def _grade(
    path: Path,
    exercise: str,
    cells: list[str],
    fault: str,
    examiners: Mapping[str, Examiner],
    limits: Limits,
    stop: Event,
) -> Mark:
    learner = learner_of(path)
    if fault:
        return Mark(path=path, learner=learner, exercise=exercise, fault=fault)
    examiner = examiners[exercise]
    try:
        replies, in_force = ask_submission(cells, examiner.questions, limits, stop)
        verdicts = tuple(judge.judge(replies[judge.question.id]) for judge in examiner.judges)
    except GradingError as error:
        fault = f"not graded: {error}"
        return Mark(path=path, learner=learner, exercise=exercise, fault=fault, not_run=True)
    except Exception as error:  # one submission never stops the batch, not even by our mistake
        fault = f"the grader itself failed on it, look at it by hand: {error!r}"
        fault = plain_text(fault)
        return Mark(path=path, learner=learner, exercise=exercise, fault=fault, not_run=True)
    return Mark(
        path=path,
        learner=learner,
        exercise=exercise,
        verdicts=verdicts,
        in_force=tuple(plain_text(name) for name in in_force),
    )


def learner_of(path: Path) -> str:
    """Return who a submission is from: its file name without the exercise, else its folder."""
    own = re.sub(r"ex\d\d", "", path.stem).strip(" _-.")
    return plain_text(own or path.resolve().parent.name)[:60]


def run(config: GradeConfig) -> int:
    """Grade from the command line: print the list or the report, and write what was asked for."""
    for path in (config.csv, config.gradescope):
        if path:
            check_writable(path)
    marks = grade(config, progress=True)
    learners = by_learner(marks)
    if len(learners) == 1:
        print(report(marks))
    else:
        print("\n".join(map(str, marks)))
        print(f"{KEY}; {len(marks)} notebooks, seed {config.seed}, {config.cases} cases")
    if config.csv:
        _write(config.csv, table(marks))
    if config.gradescope:
        write_json(config.gradescope, gradescope(marks))
    if config.reports:
        make_folder(config.reports)
        for name, own in learners.items():
            safe = re.sub(r"[^\w-]+", "_", name)
            _write(config.reports / f"{safe}.txt", report(own))
    lacking = {wall for mark in marks if mark.in_force for wall in WALLS - {*mark.in_force}}
    if lacking:
        print(f"This system lacks: {', '.join(sorted(lacking))}; see docs/instructor.md.")
    return int(any(mark.not_run for mark in marks))


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
