"""Immediate checks of the course's exercises: `check`, `hint` and `solution`.

Reads a question's name, such as "ex04.q2", and the learner's function; gives a verdict at once. A
check inside the learner's own kernel is help, not security: marks come from `fgtutor grade`, which
calls the function in a process of its own with cases drawn from the instructor's seed.

Each file exNN_SUBJECT.py holds one exercise; CONTRIBUTING.md has the recipe for another.
"""

import importlib
import json
from pathlib import Path
from typing import Any

from fgtutor.course.checks.question import CASES, PASSED, Judge, Question, Verdict
from fgtutor.course.grading.replies import reply_of
from fgtutor.errors import ConfigError

__all__ = ["EXERCISES", "check", "hint", "questions_of", "solution"]

_MODULES = {path.stem[:4]: path.stem for path in sorted(Path(__file__).parent.glob("ex??_*.py"))}
EXERCISES = tuple(_MODULES)
"""One for each of the notebooks 01-12."""
SOLUTIONS = Path(__file__).with_name("solutions.json")
"""The worked solutions by question; `fgtutor exercises` extracts them from the masters."""
SECONDS = 2.0
"""CPU time for all cases of a question."""

_passed: set[str] = set()
_hints: dict[str, int] = {}


class Shown(str):
    """Text that a notebook shows as it is, without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def check(question: str, answer: Any, *, seed: int = 0, cases: int = CASES) -> Verdict:
    """Try a function, or a number, and say at once what became of it.

    Another `seed` draws other cases. Raises `ConfigError` if there is no such question, or no case.
    """
    asked = find(question)
    arguments = asked.cases(seed, cases)
    verdict = Judge(asked, arguments).judge(reply_of(answer, arguments, SECONDS))
    if verdict.outcome != PASSED:
        advice = f'hint("{question}") gives a hint.'
        return Verdict(asked, verdict.outcome, f"{verdict.detail}\n{advice}".lstrip())
    _passed.add(question)
    siblings = questions_of(question.partition(".")[0])
    done = sum(sibling.id in _passed for sibling in siblings)
    detail = f'{done} of {len(siblings)} in this exercise. solution("{question}") is open now.'
    return Verdict(asked, PASSED, detail)


def hint(question: str) -> Shown:
    """Return the next hint, one more at each call; raises `ConfigError` if there is no question."""
    hints = find(question).hints
    given = _hints[question] = min(_hints.get(question, 0) + 1, len(hints))
    return Shown(f"Hint {given} of {len(hints)}: {hints[given - 1]}")


def solution(question: str) -> Shown:
    """Return the worked solution, once `check` has passed; raises `ConfigError` as `hint`."""
    find(question)
    if question not in _passed:
        return Shown(f'The worked solution opens once check("{question}", ...) has passed.')
    return Shown(json.loads(SOLUTIONS.read_text(encoding="utf-8"))[question])


def questions_of(exercise: str) -> tuple[Question, ...]:
    """Return the questions of an exercise; raises `ConfigError` if there is none of that name."""
    if exercise not in EXERCISES:
        raise ConfigError(f"no exercise {exercise!r}: there are {', '.join(EXERCISES)}")
    return importlib.import_module(f"{__name__}.{_MODULES[exercise]}").QUESTIONS


def find(question: str) -> Question:
    """Return a question by its name; raises `ConfigError`, listing those of its exercise."""
    exercise = question.partition(".")[0]
    for candidate in questions_of(exercise):
        if candidate.id == question:
            return candidate
    known = ", ".join(q.id for q in questions_of(exercise))
    raise ConfigError(f"no question {question!r}: {exercise} has {known}")
