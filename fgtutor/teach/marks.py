"""Marks: what became of each submission, as a report for a learner, a CSV and Gradescope's JSON.

Reads verdicts; gives plain text. Nothing that a submission wrote is passed on as HTML, as a
terminal command or as a spreadsheet formula.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

from fgtutor.teach.checks.question import OUTCOMES, Verdict

INDENT = " " * 6
_SIGN = dict(zip(OUTCOMES, "+.x!~", strict=True))


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One graded notebook."""

    path: Path
    """The submission."""
    learner: str
    """Whose it is, from its file or folder name."""
    exercise: str
    """Such as "ex04"; empty if it could not be told."""
    verdicts: tuple[Verdict, ...] = ()
    """One a question, in order."""
    fault: str = ""
    """Why it could not be graded at all."""
    not_run: bool = False
    """Whether that is no fault of the submission: it is to be graded again."""
    in_force: tuple[str, ...] = ()
    """The protections under which it ran."""

    @property
    def points(self) -> int:
        """Points earned."""
        return sum(verdict.points for verdict in self.verdicts)

    @property
    def out_of(self) -> int:
        """Points that could be earned."""
        return sum(verdict.question.points for verdict in self.verdicts)

    @property
    def percent(self) -> float:
        """Share of the points, %."""
        return 100 * self.points / self.out_of if self.out_of else 0.0

    def __repr__(self) -> str:
        """Read as one line of a list."""
        signs = "".join(_SIGN[verdict.outcome] for verdict in self.verdicts)
        tail = self.fault or f"{self.points:>3} of {self.out_of:<3} {signs}"
        return f"{self.learner:<24.24} {self.exercise:<5} {tail}"


KEY = "  ".join(f"{sign} {outcome}" for outcome, sign in _SIGN.items())
"""What the signs in a list of marks mean."""


def report(marks: Sequence[Mark]) -> str:
    """Return what one learner should read: every question, its outcome, and why."""
    lines = [f"{marks[0].learner}: {_total(marks)}", ""]
    for mark in marks:
        lines += [f"{mark.exercise or 'unknown exercise'} ({mark.path.name})", "=" * 60]
        if mark.fault:
            lines += [mark.fault, ""]
            continue
        lines += [f"{mark.points} of {mark.out_of} points, {mark.percent:.0f} %", ""]
        for verdict in mark.verdicts:
            question = verdict.question
            lines.append(
                f"[{verdict.points}/{question.points}] {question.id} {question.title}: "
                f"{verdict.outcome}"
            )
            for line in verdict.detail.splitlines():
                lines += wrap(line, 96, initial_indent=INDENT, subsequent_indent=INDENT)
        lines.append("")
    return "\n".join(lines)


def table(marks: Sequence[Mark]) -> str:
    """Return the marks as CSV, one row a notebook."""
    widest = max((len(mark.verdicts) for mark in marks), default=0)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    questions = [f"q{number}" for number in range(1, widest + 1)]
    head = ["learner", "submission", "exercise", "points", "out_of", "percent"]
    writer.writerow([*head, *questions, "fault"])
    for mark in marks:
        outcomes = [verdict.outcome for verdict in mark.verdicts]
        row = [mark.learner, str(mark.path), mark.exercise, mark.points, mark.out_of]
        row += [f"{mark.percent:.1f}", *outcomes, *[""] * (widest - len(outcomes)), mark.fault]
        writer.writerow([_harmless(cell) for cell in row])
    return buffer.getvalue()


def _harmless(cell: Any) -> Any:
    """Keep a spreadsheet from reading a learner's file name as a formula."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(tuple("=+-@\t\r")) else cell


def gradescope(marks: Sequence[Mark]) -> dict[str, Any]:
    """Return Gradescope's results: of one learner its own format, of several one such each.

    Source: the autograder documentation, "results.json".
    """
    learners = by_learner(marks)
    if len(learners) == 1:
        return _results(marks)
    return {"learners": {name: _results(own) for name, own in learners.items()}}


def by_learner(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Group marks by learner, in order."""
    groups: dict[str, list[Mark]] = {}
    for mark in marks:
        groups.setdefault(mark.learner, []).append(mark)
    return groups


def _results(marks: Sequence[Mark]) -> dict[str, Any]:
    faults = [f"{mark.path.name}: {mark.fault}" for mark in marks if mark.fault]
    return {
        "score": sum(mark.points for mark in marks),
        "output": "\n".join([_total(marks), *faults]),
        "output_format": "text",
        "test_output_format": "text",
        "tests": [
            {
                "name": f"{verdict.question.id} {verdict.question.title}",
                "score": verdict.points,
                "max_score": verdict.question.points,
                "status": "passed" if verdict.points else "failed",
                "output": f"{verdict.outcome}\n{verdict.detail}".strip(),
                "output_format": "text",
            }
            for mark in marks
            for verdict in mark.verdicts
        ],
    }


def _total(marks: Sequence[Mark]) -> str:
    points, out_of = sum(m.points for m in marks), sum(m.out_of for m in marks)
    percent = f", {100 * points / out_of:.0f} %" if out_of else ""
    return f"{points} of {out_of} points{percent}"
