"""Immediate checks of the course's exercises: `check`, `case`, `hint`, `solution`, `with_mine`.

Reads a question's name, such as "ex04.q2", and the learner's function; gives a verdict at once, and
keeps what passes in the learner's `mine.py`. A check inside the learner's own kernel is help, not
security: marks come from `fgtutor grade`, which calls the function in a process of its own with
cases drawn from the instructor's seed.

Each file exNN_SUBJECT.py holds one exercise; CONTRIBUTING.md has the recipe for another.
"""

import copy
import importlib
import json
import sys
from collections import namedtuple
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fgtutor.course import mine
from fgtutor.course.checks.question import CASES, NOT_STARTED, PASSED, Judge, Question, Verdict
from fgtutor.course.grading.replies import reply_of
from fgtutor.course.sources import source_of
from fgtutor.errors import ConfigError, StorageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "EXERCISES",
    "case",
    "check",
    "hint",
    "kept",
    "questions_of",
    "reset",
    "solution",
    "with_mine",
]

_MODULES = {path.stem[:4]: path.stem for path in sorted(Path(__file__).parent.glob("ex??_*.py"))}
EXERCISES = tuple(_MODULES)
"""One for each notebook that has one."""
SOLUTIONS = Path(__file__).with_name("solutions.json")
"""The worked solutions by question; `fgtutor exercises` extracts them from the masters."""
SECONDS = 2.0
"""CPU time for all cases of a question, unless it says that it needs more."""

_passed: set[str] = set()
_tried: set[str] = set()
_hints: dict[str, int] = {}


class Shown(str):
    """Text that a notebook shows as it is, without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def check(question: str, answer: Any, *, seed: int = 0, cases: int = CASES) -> Verdict:
    """Try a function, or a number, and say at once what became of it; keep it if it passes.

    Another `seed` draws other cases. Raises `ConfigError` if there is no such question, or no case.
    """
    asked = find(question)
    arguments = asked.cases(seed, cases)
    judge = Judge(asked, arguments, tell=question in _tried)
    verdict = judge.judge_own(_asked(asked, answer, arguments))
    if verdict.outcome != NOT_STARTED:
        _tried.add(question)
    if verdict.outcome != PASSED:
        lines = [verdict.detail, f'hint("{question}") gives a hint.']
        if verdict.case:
            options = "".join(
                f", {name}={value}"
                for name, value, usual in (("seed", seed, 0), ("cases", cases, CASES))
                if value != usual
            )
            lines.append(f'case("{question}", {verdict.case}{options}) gives you that case.')
        return replace(verdict, detail="\n".join(filter(None, lines)))
    _passed.add(question)
    # With fewer cases it may be a worse answer than the one that is kept.
    said = _keep(judge, answer) if cases >= CASES else "Not kept: that was with fewer cases."
    return replace(verdict, detail=f'{said}\n{progress()}\nsolution("{question}") is open now.')


def case(question: str, number: int, *, seed: int = 0, cases: int = CASES) -> Any:
    """Return the arguments of a case, by name and in order, to try a function on: f(*case(...)).

    Cases count from 1, as verdicts do. Raises `ConfigError` if there is no such question or case.
    """
    asked = find(question)
    arguments = asked.cases(seed, cases)
    if arguments is None:
        raise ConfigError(f"{question} asks for a number to find: it has no cases")
    if type(number) is not int or not 1 <= number <= len(arguments):
        raise ConfigError(f"{question} has cases 1 to {len(arguments)}, got {number!r}")
    return namedtuple("Case", asked.parameters, rename=True)(*copy.deepcopy(arguments[number - 1]))


def hint(question: str) -> Shown:
    """Return the next hint, one more at each call, once the question has been tried.

    Raises `ConfigError` if there is no such question.
    """
    hints = find(question).hints
    if question not in _tried:
        return Shown(f'Hints come after a first try: check("{question}", ...) says how it went.')
    given = _hints[question] = min(_hints.get(question, 0) + 1, len(hints))
    return Shown(f"Hint {given} of {len(hints)}: {hints[given - 1]}")


def solution(question: str) -> Shown:
    """Return the worked solution, once `check` has passed; raises `ConfigError` as `hint`."""
    find(question)
    if question not in passed():
        return Shown(f'The worked solution opens once check("{question}", ...) has passed.')
    return Shown(json.loads(SOLUTIONS.read_text(encoding="utf-8"))[question])


def kept(question: str = "") -> Shown:
    """Return what mine.py holds for a question, or of which questions it holds something.

    Raises what `mine.read` raises, and `ConfigError` as `hint`.
    """
    sections = mine.read()
    if question:
        find(question)
        return Shown(sections.get(question, f"mine.py holds nothing for {question} yet."))
    lines = [f"{name} {_named(name)}" for name in sections] or ["mine.py holds nothing yet."]
    return Shown("\n".join(lines))


def reset(question: str = "") -> Shown:
    """Forget what mine.py holds for a question, or put the whole file aside.

    Raises what `mine.reset` raises, and `ConfigError` as `hint`.
    """
    if question:
        find(question)
    said = mine.reset(question)
    _passed.difference_update({question} if question else set(_passed))
    return Shown(said)


def with_mine(exercise: str) -> "Figure | None":
    """Run the planner with the learner's functions in place of the library's, and draw it.

    `exercise`, such as "ex04", says which part of it is shown. Raises `ConfigError` for another
    name, and what `mine.read` raises. Without torch, as in a browser, it says what is missing.
    """
    questions_of(exercise)
    if find_spec("torch") is None:
        print(
            "The planner with your functions in it needs torch, which is not here: take mine.py "
            "to where fgtutor is installed (`make lab`) and run this cell there."
        )
        return None
    from fgtutor.course.pipeline import show

    functions, faults = {}, []
    for question, source in mine.read().items():
        try:
            functions[_named(question)] = mine.run(source)[_named(question)]
        except (ConfigError, KeyError) as error:
            faults.append(f"{question} in mine.py cannot be used: {error}")
    return show(exercise, functions, faults)


def passed() -> set[str]:
    """Return the questions that have passed, in this kernel or in mine.py."""
    try:
        return _passed | mine.read().keys()
    except (ConfigError, StorageError):
        return set(_passed)


def progress() -> str:
    """Return how much of the whole course has passed."""
    every = [question for exercise in EXERCISES for question in questions_of(exercise)]
    own = passed()
    done = [question for question in every if question.id in own]
    points, out_of = (sum(question.points for question in part) for part in (done, every))
    bar = "#" * round(20 * points / out_of)
    return (
        f"The course so far: {len(done)} of {len(every)} questions, {points} of {out_of} points "
        f"[{bar:.<20}]"
    )


def _asked(asked: Question, answer: Any, arguments: Sequence[tuple] | None) -> dict[str, Any]:
    code = getattr(answer, "__code__", None)
    if asked.harness or "torch" in getattr(code, "co_names", ()):
        _load_torch(asked)
    return reply_of(answer, arguments, max(SECONDS, asked.seconds), harness=asked.harness)


def _load_torch(asked: Question) -> None:
    """Load torch if the answer is going to, so that this does not count as its time."""
    source = asked.harness_source
    if "torch" not in sys.modules and (source is None or "import torch" in source[1]):
        importlib.import_module("torch")


def _keep(judge: Judge, answer: Any) -> str:
    """Keep an answer that has passed, if it passes on its own too; return what was done."""
    asked = judge.question
    try:
        source = source_of(asked.name, answer)
        alone = mine.run(source)[asked.name]
        verdict = judge.judge_own(_asked(asked, alone, copy.deepcopy(judge.cases)))
        if verdict.outcome != PASSED:
            raise ConfigError(f"taken out of the notebook it does not pass: {verdict.detail}")
        mine.keep(asked.id, source)
    except (ConfigError, StorageError) as error:
        return f"It could not be kept in mine.py: {error}."
    if not mine.lasts():
        return "Kept in mine.py until this page closes: the browser gives it no lasting storage."
    return "Kept in mine.py."


def _named(question: str) -> str:
    """Return what a question asks to define; "" if the course has no such question any more."""
    try:
        return find(question).name
    except ConfigError:
        return ""


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
