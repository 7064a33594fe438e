"""Marks: what became of each submission, as a report for a learner, a CSV and Gradescope's JSON.

Reads verdicts; gives plain text. Nothing that a submission wrote is passed on as HTML, as a
terminal command or as a spreadsheet formula. Of one learner and exercise at most one notebook
counts; all others have no points, so that every sum over notebooks is right.
"""

import csv
import io
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

from fgtutor.course.checks.question import OUTCOMES, Verdict, plain_name

INDENT = " " * 6
_SIGN = dict(zip(OUTCOMES, "+.x!~", strict=True))


@dataclass(frozen=True, kw_only=True)
class Mark:
    """One graded notebook."""

    path: Path
    """The submission."""
    learner: str
    """Whose it is, readable and unlike any other; see `submissions.learners_of`."""
    exercise: str = ""
    """Such as "ex04"; empty if it could not be told."""
    verdicts: tuple[Verdict, ...] = ()
    """One per question, in order."""
    fault: str = ""
    """Why it could not be graded at all."""
    notes: tuple[str, ...] = ()
    """What somebody should look at: a clash, a doubtful name, damage."""
    counts: bool = True
    """Whether it is the one that counts of this learner and exercise."""
    not_run: bool = False
    """Whether a fault is none of the submission: it is to be graded again."""
    in_force: tuple[str, ...] = ()
    """The protections under which it ran."""

    @property
    def earned(self) -> int:
        """Points earned, whether they count or not."""
        return sum(verdict.points for verdict in self.verdicts)

    @property
    def points(self) -> int:
        """Points that count."""
        return self.earned if self.counts else 0

    @property
    def out_of(self) -> int:
        """Points that could be earned and count."""
        return sum(verdict.question.points for verdict in self.verdicts) if self.counts else 0

    @property
    def percent(self) -> float:
        """Share of the points, %."""
        return 100 * self.points / self.out_of if self.out_of else 0.0

    @property
    def remarks(self) -> str:
        """The fault and the notes; "" if there are none."""
        return "; ".join(filter(None, (self.fault, *self.notes)))

    def __repr__(self) -> str:
        """Read as one line of a list."""
        signs = "".join(_SIGN[verdict.outcome] for verdict in self.verdicts)
        points = f"{self.points:>3} of {self.out_of:<3}" if self.counts else " not counted"
        tail = "" if self.fault else f"{points} {signs} "
        tail += f"{self.remarks} [{plain_name(self.path)}]" if self.remarks else ""
        return f"{self.learner:<24} {self.exercise:<5} {tail}".rstrip()


def settle_clashes(marks: Sequence[Mark]) -> list[Mark]:
    """Let only the best count of several notebooks of one learner and exercise, and say so.

    Of equally good ones it is the first.
    """
    groups: dict[tuple[str, str], list[Mark]] = defaultdict(list)
    for mark in marks:
        groups[mark.learner, mark.exercise].append(mark)
    settled = {}
    for (_, exercise), group in groups.items():
        best = max(group, key=lambda mark: (not mark.fault, mark.earned))
        if exercise and len(group) > 1:
            common = os.path.commonpath([os.path.abspath(mark.path.parent) for mark in group])
            which = plain_name(os.path.relpath(os.path.abspath(best.path), common))
            note = (
                f"clash: {len(group)} notebooks for {exercise}, of which the best counts: {which}"
            )
            for mark in group:
                settled[mark.path, exercise] = replace(
                    mark, notes=(*mark.notes, note), counts=mark is best
                )
    return [settled.get((mark.path, mark.exercise), mark) for mark in marks]


KEY = "  ".join(f"{sign} {outcome}" for outcome, sign in _SIGN.items())
"""What the signs in a list of marks mean."""


def report(marks: Sequence[Mark]) -> str:
    """Return what one learner should read: every question, its outcome, and why."""
    lines = [f"{marks[0].learner}: {_total(marks)}", ""]
    for mark in marks:
        lines += [f"{mark.exercise or 'unknown exercise'} ({plain_name(mark.path.name)})", "=" * 60]
        lines += filter(None, (mark.fault, *mark.notes))
        if mark.fault or not mark.counts:
            lines.append("")
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
    """Return the marks as CSV, one row per notebook."""
    widest = max((len(mark.verdicts) for mark in marks), default=0)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    questions = [f"q{number}" for number in range(1, widest + 1)]
    head = ["learner", "submission", "exercise", "points", "out_of", "percent", "counts"]
    writer.writerow([*head, *questions, "fault", "notes"])
    for mark in marks:
        outcomes = [verdict.outcome for verdict in mark.verdicts]
        row = [mark.learner, plain_name(mark.path), mark.exercise, mark.points, mark.out_of]
        row += [f"{mark.percent:.1f}", "yes" if mark.counts and not mark.fault else "no"]
        row += [*outcomes, *[""] * (widest - len(outcomes)), mark.fault, "; ".join(mark.notes)]
        writer.writerow([_harmless(cell) for cell in row])
    return buffer.getvalue()


def _harmless(cell: Any) -> Any:
    """Keep a spreadsheet from reading a learner's file name as a formula, wide signs included."""
    first = unicodedata.normalize("NFKC", cell[:1]) if isinstance(cell, str) else ""
    return f"'{cell}" if first and first in "=+-@'\t\r\n" else cell


def gradescope(marks: Sequence[Mark], nothing: str = "") -> dict[str, Any]:
    """Return Gradescope's results: of one learner, or of `nothing` that could be graded, and why.

    Of several, whom Gradescope could not tell apart, they have no points and one such object each
    under "learners". Source: the autograder documentation, "results.json".
    """
    learners = by_learner(marks)
    if len(learners) == 1:
        return _results(marks)
    some = ", ".join([*learners][:3]) + ", ..." * (len(learners) > 3)
    said = nothing or (
        f"{len(learners)} learners ({some}) in one submission: hand in only your own notebooks, "
        "or grade with --learner one"
    )
    return {
        **_results([], said),
        **({"learners": {n: _results(own) for n, own in learners.items()}} if learners else {}),
    }


def report_names(learners: Iterable[str]) -> dict[str, str]:
    """Return a file name for each learner's report, different on every file system."""
    names: dict[str, str] = {}
    taken = set()
    for learner in learners:
        safe = re.sub(r"[^\w-]+", "_", learner)[:50]
        name, number = safe, 1
        while (key := unicodedata.normalize("NFKD", name).casefold()) in taken:
            number += 1
            name = f"{safe}-{number}"
        taken.add(key)
        names[learner] = f"{name}.txt"
    return names


def by_learner(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Group marks by learner, in order."""
    groups: dict[str, list[Mark]] = {}
    for mark in marks:
        groups.setdefault(mark.learner, []).append(mark)
    return groups


def _results(marks: Sequence[Mark], said: str = "") -> dict[str, Any]:
    remarks = [f"{plain_name(m.path.name)}: {m.remarks}" for m in marks if m.remarks]
    return {
        "score": sum(mark.points for mark in marks),
        "output": "\n".join([said or _total(marks), *remarks]),
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
            if mark.counts
            for verdict in mark.verdicts
        ],
    }


def _total(marks: Sequence[Mark]) -> str:
    points, out_of = sum(m.points for m in marks), sum(m.out_of for m in marks)
    percent = f", {100 * points / out_of:.0f} %" if out_of else ""
    return f"{points} of {out_of} points{percent}"
