"""Grading: from submitted notebooks to marks, one process per submission, none of them trusted.

Reads .ipynb files and what the checks keep (`mine.py`: one mark per exercise in it), and a seed;
gives a `Mark` each, and on request a CSV, Gradescope's JSON and a
report per learner. What a submission sends are answers, as plain JSON; right or wrong is decided
here, against answers worked out here. Hidden cases follow from the seed: there is no secret file.
"""

import json
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Annotated

import tyro
from annotated_types import Interval

from fgtutor.course.checks import EXERCISES, questions_of
from fgtutor.course.checks.question import CASES, Cases, Judge, plain_name, plain_text
from fgtutor.course.grading.answers import encode
from fgtutor.course.grading.confinement import WALLS
from fgtutor.course.grading.marks import (
    KEY,
    Mark,
    by_learner,
    gradescope,
    report,
    report_names,
    settle_clashes,
    table,
)
from fgtutor.course.grading.sandbox import Limits, ask_submission, check_system
from fgtutor.course.grading.submissions import (
    UNREADABLE,
    Rule,
    base_of,
    exercise_of,
    find_notebooks,
    is_mine,
    learners_of,
    read_mine,
    read_submission,
)
from fgtutor.errors import ConfigError, GradingError, NotebookError, StorageError
from fgtutor.io.machine import usable_cores
from fgtutor.io.progress import watch
from fgtutor.io.storage import atomic_write, check_writable, make_folder, write_json
from fgtutor.io.validation import Seed, check_fields

SHOWN = 20
"""Files named of those that are not graded for the same reason."""


@dataclass(frozen=True, kw_only=True)
class GradeConfig:
    """Grade submitted exercise notebooks, one learner's or a whole class's."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Notebooks, or folders of notebooks."""
    csv: Path | None = None
    """Write one row per notebook here."""
    gradescope: Path | None = None
    """Write Gradescope's results.json here."""
    reports: Path | None = None
    """Write a report per learner into this folder."""
    seed: Seed = 0
    """What the hidden cases are drawn from: choose your own, and keep it to yourself."""
    cases: Cases = CASES
    """Hidden cases per question."""
    exercise: str = ""
    """Grade all as this exercise; default: what a notebook's metadata, its name (exNN between
    anything but letters and digits) and its folder say, which must not disagree."""
    learner: Rule = "path"
    """Who a notebook is from: its path below the folder named here, without exNN and the mark of a
    copy, so folder and file name (path); the file name alone (file); the folder alone (folder); or
    all are one learner's, as on Gradescope (one). Of one learner and exercise the best counts."""
    workers: Annotated[int, Interval(ge=0, le=1024)] = 0
    """Submissions side by side; 0 takes one per core that a container or affinity leaves us."""
    seconds: float = Limits.seconds
    """CPU time for all cases of a question, s."""
    loading: float = Limits.loading
    """CPU time for running all cells of a notebook, s."""
    memory_mb: int = Limits.memory_mb
    """Memory of a submission, MB."""

    def __post_init__(self) -> None:
        check_fields(self)
        self.limits()
        if self.exercise and self.exercise not in EXERCISES:
            raise ConfigError(f"no exercise {self.exercise!r}: there are {', '.join(EXERCISES)}")

    def limits(self) -> Limits:
        """Return what a submission may use; raises `ConfigError` for what makes no sense."""
        return Limits(seconds=self.seconds, loading=self.loading, memory_mb=self.memory_mb)


class Examiner:
    """The questions of one exercise, their cases and right answers, worked out once for all."""

    def __init__(self, exercise: str, seed: int, cases: int) -> None:
        self.judges = [Judge(q, q.cases(seed, cases)) for q in questions_of(exercise)]
        self.questions = [
            {
                "id": judge.question.id,
                "name": judge.question.name,
                "cases": judge.cases and [encode(case, tensors=True) for case in judge.cases],
                "harness": judge.question.harness_source,
                "seconds": judge.question.seconds,
            }
            for judge in self.judges
        ]


def grade(
    config: GradeConfig, notebooks: Sequence[Path] | None = None, *, progress: bool = False
) -> list[Mark]:
    """Return a mark for every notebook, by default all that `config.paths` hold, in their order.

    Raises:
        ConfigError: A path does not exist or holds no notebook, or the system cannot grade.
        MissingExtraError: IPython is not installed, in whose syntax cells are written.
    """
    check_system()
    if notebooks is None:
        notebooks, skipped = find_notebooks(config.paths)
        if not notebooks:
            raise ConfigError(_nothing(config.paths, skipped))
    read = _read(notebooks, config)
    wanted = sorted({mark.exercise for mark, _ in read if not mark.fault})
    examiners = {name: Examiner(name, config.seed, config.cases) for name in wanted}
    stop = Event()

    def one(submission: tuple[Mark, list[str]]) -> Mark:
        return _grade(*submission, examiners, config.limits(), stop)

    with ThreadPoolExecutor(config.workers or usable_cores()) as pool:
        marks = pool.map(one, read)
        try:
            watched = watch(marks, len(read), "grading", show=progress, unit="notebook")
            return settle_clashes(list(watched))
        except BaseException:  # Ctrl-C: the pool waits for what runs, so that ends now
            stop.set()
            raise


def _nothing(paths: Sequence[Path], skipped: Mapping[Path, str]) -> str:
    """Say that there is no notebook, and what there is instead."""
    there = "; ".join([*map(plain_name, paths), *_skips(skipped)]) or "nothing was named"
    return f"no notebook to grade ({there}): name one, or a folder of them"


def _skips(skipped: Mapping[Path, str]) -> list[str]:
    """Return which files were not graded, a line per reason."""
    groups: dict[str, list[str]] = defaultdict(list)
    for path, reason in skipped.items():
        groups[reason].append(plain_name(path))
    return [
        f"not graded, {reason}: {', '.join(names[:SHOWN])}"
        + f" and {len(names) - SHOWN} more" * (len(names) > SHOWN)
        for reason, names in groups.items()
    ]


def _read(notebooks: Sequence[Path], config: GradeConfig) -> list[tuple[Mark, list[str]]]:
    """Return for each notebook its code, and its mark so far: whose it is and what is wrong.

    A file of kept answers has one of each exercise that it holds something of.
    """
    base = base_of(config.paths)
    read = []
    for path, (learner, doubt) in zip(
        notebooks, learners_of(notebooks, base, config.learner), strict=True
    ):
        mark, cells, said, damage = Mark(path=path, learner=learner), [], "", ""
        if is_mine(path.name):
            read += _read_mine(mark, doubt, config.exercise)
            continue
        try:
            said, cells, damage = read_submission(path)
        except NotebookError as error:
            mark = replace(mark, fault=str(error))
        except OSError as error:
            mark = replace(mark, fault=f"{UNREADABLE}: {error.strerror or error}", not_run=True)
        try:
            exercise = config.exercise or exercise_of(path, base, said)
            mark = replace(mark, exercise=exercise)
        except NotebookError as error:
            mark = replace(mark, fault=mark.fault or str(error))
        notes = tuple(filter(None, (damage, doubt)))
        read.append((replace(mark, notes=notes), cells))
    return read


def _read_mine(mark: Mark, doubt: str, only: str) -> list[tuple[Mark, list[str]]]:
    """Return for each exercise of a file of kept answers, or the `only` one, its mark and code."""
    mark = replace(mark, exercise=only, notes=(doubt,) if doubt else ())
    try:
        kept = read_mine(mark.path)
    except NotebookError as error:
        return [(replace(mark, fault=str(error)), [])]
    except OSError as error:
        fault = f"{UNREADABLE}: {error.strerror or error}"
        return [(replace(mark, fault=fault, not_run=True), [])]
    if only and only not in kept:
        return [(replace(mark, fault=f"it holds no answer of {only}"), [])]
    return [
        (replace(mark, exercise=exercise), cells)
        for exercise, cells in kept.items()
        if not only or exercise == only
    ]


def _grade(
    mark: Mark, cells: list[str], examiners: Mapping[str, Examiner], limits: Limits, stop: Event
) -> Mark:
    if mark.fault:
        return mark
    examiner = examiners[mark.exercise]
    try:
        replies, in_force = ask_submission(cells, examiner.questions, limits, stop)
        verdicts = tuple(judge.judge(replies[judge.question.id]) for judge in examiner.judges)
    except GradingError as error:
        return replace(mark, fault=f"not graded: {error}", not_run=True)
    except Exception as error:  # what no submission can bring about stops no other one either
        fault = f"not graded, by a mistake of fgtutor, please report it: {error!r}"
        return replace(mark, fault=plain_text(fault), not_run=True)
    return replace(mark, verdicts=verdicts, in_force=tuple(map(plain_text, in_force)))


def run(config: GradeConfig) -> int:
    """Grade from the command line: write what was asked for, and print the list or the report.

    Returns 1 if something could not be graded for a reason that is none of the learner.
    """
    notebooks, skipped = find_notebooks(config.paths)
    _check_outputs(config, notebooks)
    if not notebooks:
        reason = _nothing(config.paths, skipped)
        if config.gradescope:
            write_json(config.gradescope, gradescope([], reason))
        raise ConfigError(reason)
    marks = grade(config, notebooks, progress=True)
    learners = by_learner(marks)
    problems = _write(config, marks, learners)  # then print, as a reader may have seen enough
    if len(learners) == 1:
        print(report(marks))
    else:
        print("\n".join(map(str, marks)))
        print(f"{KEY}; {len(marks)} notebooks, seed {config.seed}, {config.cases} cases")
        if config.gradescope:
            print(f'{plain_name(config.gradescope)} has {len(learners)} results under "learners".')
    if config.learner == "path" and (both := [name for name in learners if "/" in name]):
        print(
            f"{len(both)} learners, such as {both[0]}, are told apart by folder and file name: use "
            "--learner file or --learner folder if only one of the two is a name"
        )
    for line in _skips(skipped):
        print(line)
    lacking = {wall for mark in marks if mark.in_force for wall in WALLS - {*mark.in_force}}
    if lacking:
        print(f"This system lacks: {', '.join(sorted(lacking))}; see docs/instructor.md.")
    if problems:
        raise StorageError("; ".join(problems))
    unread = any(reason.startswith(UNREADABLE) for reason in skipped.values())
    return int(unread or any(mark.not_run for mark in marks))


def _check_outputs(config: GradeConfig, notebooks: Sequence[Path]) -> None:
    """Raise an error of ours if the results could not be written, before anything is graded."""
    files = [path for path in (config.csv, config.gradescope) if path]
    real = [os.path.realpath(path) for path in (*files, *notebooks)]
    for path in files:
        if real.count(os.path.realpath(path)) > 1:
            raise ConfigError(
                f"{plain_name(path)} is to be written, but is a notebook or another output"
            )
        check_writable(path)
    if config.reports:
        make_folder(config.reports)
        check_writable(config.reports / "report.txt")


def _write(
    config: GradeConfig, marks: Sequence[Mark], learners: Mapping[str, Sequence[Mark]]
) -> list[str]:
    """Write all that was asked for; return what could not be written, and why."""
    texts: dict[Path, str] = {}
    if config.csv:
        texts[config.csv] = table(marks)
    if config.gradescope:
        texts[config.gradescope] = json.dumps(gradescope(marks), indent=1)
    if config.reports:
        names = report_names(learners)
        texts |= {config.reports / names[name]: report(own) for name, own in learners.items()}
    problems = []
    for path, text in texts.items():
        try:
            with atomic_write(path) as temporary:
                temporary.write_text(text, encoding="utf-8")
        except StorageError as error:
            problems.append(str(error))
    return problems
