"""A question: what it asks, how answers are judged, and what a wrong one most likely got wrong.

Reads a learner's answers; gives a `Verdict` that states the property the answer must have, names
the mistake if it is a known one, and shows where it differs. A typical mistake is kept as the wrong
function itself: an answer with the same results has made it.
"""

import copy
import html
import inspect
import json
import textwrap
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval

from fgtutor.course.grading.answers import (
    arrays_of,
    decode,
    describe,
    difference,
    not_integers,
)
from fgtutor.course.grading.replies import CRASHED, NOT_STARTED, TOO_SLOW
from fgtutor.errors import ConfigError

PASSED, WRONG = "passed", "wrong"
OUTCOMES: tuple[str, ...] = (PASSED, NOT_STARTED, WRONG, CRASHED, TOO_SLOW)
SIGNS: dict[str, str] = dict(
    zip(OUTCOMES, "\N{CHECK MARK}\N{WHITE CIRCLE}\N{BALLOT X}\N{BALLOT X}\N{BALLOT X}", strict=True)
)
"""What stands before an outcome: a tick, a circle where nothing was tried, else a cross."""
COLOURS: dict[str, str] = dict(
    zip(OUTCOMES, ("#00795a", "#767676", "#b34700", "#b34700", "#b34700"), strict=True)
)
"""Colours of outcomes on white or black; the sign and the word say the same."""
LONGEST = 5000
"""Most characters of a text that is shown; no path is longer."""
CASES = 10
"""Drawn cases of a question, unless the instructor wants more."""
DRAWN = 1, 10_000
"""Fewest and most cases that may be asked for."""
Cases = Annotated[int, Interval(ge=DRAWN[0], le=DRAWN[1])]
"""How many cases are drawn; with none, any answer would be right."""


@dataclass(frozen=True)
class Mistake:
    """A typical wrong answer."""

    says: str
    """What went wrong, in a few words and a sentence: "swapped taus: tau_low comes first."."""
    answer: Callable[..., Any]
    """The wrong function, called as the right one is."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """One small function to write, or one number to find."""

    id: str
    """Such as "ex04.q2"."""
    name: str
    """The function or variable that the learner defines."""
    points: int
    """What it is worth."""
    title: str
    """What it asks for, a few words."""
    expects: str
    """The property that a right answer has: a sentence or two."""
    truth: Callable[..., Any]
    """A right answer, written otherwise than the worked solution where there is another way."""
    draw: Callable[[np.random.Generator], tuple] | None = None
    """Draws the arguments of one case; None for a number to find."""
    examples: tuple[tuple, ...] = ()
    """Cases that are always tried, before the drawn ones: edges that a draw may miss."""
    mistakes: tuple[Mistake, ...]
    """What learners typically do wrong; the first that fits is named."""
    hints: tuple[str, ...]
    """Hints, from a nudge to nearly the answer."""
    rtol: float = 1e-5
    """Relative tolerance of an answer."""
    atol: float = 1e-8
    """Absolute tolerance of an answer."""
    single: bool = True
    """Whether an answer in float32 may be as far off as float32 is."""
    integers: bool = False
    """Whether the answer must be of an integer type."""
    seconds: float = 0.0
    """CPU time for all its cases, s, where the usual is not enough."""
    harness: Callable[..., Any] | None = None
    """Calls what the learner defines, a class or a training: harness(target, *arguments) gives the
    answer. A plain `def` that does its imports inside and uses no other global: its source is sent
    to the submission's process. The `truth` and the mistakes are then targets like the learner's.
    """
    faults: Callable[..., dict[str, str]] | None = None
    """Judges an answer that need not equal the truth: faults(answer, *arguments) gives sentences by
    kind of fault, none for a good answer. It runs in the grader, and may know what the submission
    was not given. A mistake is named by the kinds of its faults.
    """
    most: int = 0
    """Most cases that are drawn, where each takes long; 0 for as many as are asked for."""

    @property
    def worth(self) -> str:
        """What it is worth, in words."""
        return f"{self.points} point{'s' * (self.points != 1)}"

    @property
    def parameters(self) -> list[str]:
        """The names of a case's arguments."""
        names = [*inspect.signature(self.harness or self.truth).parameters]
        return names[1:] if self.harness else names

    @property
    def call(self) -> str:
        """How the function is called: its name with its parameters; of other things, the name."""
        if self.draw is None or self.harness:
            return self.name
        return f"{self.name}({', '.join(self.parameters)})"

    @property
    def harness_source(self) -> list[str] | None:
        """The harness by name and source; None if there is none."""
        if self.harness is None:
            return None
        return [self.harness.__name__, textwrap.dedent(inspect.getsource(self.harness))]

    def answers(self, target: Callable[..., Any], cases: Sequence[tuple] | None) -> list[Any]:
        """Return what a target answers to each case, without letting it touch the cases."""
        with np.errstate(all="ignore"):
            if cases is None:
                return [target()]
            called = (target,) if self.harness else ()
            function = self.harness or target
            return [arrays_of(function(*called, *copy.deepcopy(case))) for case in cases]

    def cases(self, seed: int = 0, cases: int = CASES) -> list[tuple] | None:
        """Return the arguments of every case; the same for one seed. None for a number to find.

        Raises:
            ConfigError: Nothing, or more than makes sense, would be drawn, or the seed is none.
        """
        for name, value, least, most in (("seed", seed, 0, 2**32 - 1), ("cases", cases, *DRAWN)):
            whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not whole or not least <= value <= most:
                raise ConfigError(
                    f"{name}: should be a whole number from {least} to {most}, got {value!r:.60}"
                )
        if self.draw is None:
            return None
        rng = np.random.default_rng((seed, zlib.crc32(self.id.encode())))
        drawn = min(cases, self.most or cases)
        return [*self.examples, *(self.draw(rng) for _ in range(drawn))]


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What `replies.reply_of` gives, and what a submission may forge."""

    question: str = ""
    """Its id, where several are asked."""
    outcome: Literal["not started", "crashed", "too slow"] | None = None
    """Why there are no answers."""
    detail: str = ""
    """The same in words."""
    changed: Annotated[int, Interval(ge=0)] | None = None
    """Which of its arguments the function changed."""
    answers: list[Any] | None = None
    """An encoded answer to every case."""


@dataclass(frozen=True)
class Verdict:
    """What became of one answer."""

    question: Question
    """What was asked."""
    outcome: str
    """passed | not started | wrong | crashed | too slow"""
    detail: str = ""
    """Why, over one or more lines."""
    case: int | None = None
    """The first case that the answer fails in, from 1."""

    @property
    def points(self) -> int:
        """Points earned."""
        return self.question.points if self.outcome == PASSED else 0

    @property
    def head(self) -> str:
        """A sign and a word: what became of which question."""
        return f"{SIGNS[self.outcome]} {self.question.id} {self.question.title}: {self.outcome}"

    def __repr__(self) -> str:
        """Read as a sentence, for a terminal."""
        return f"{self.head}\n{self.detail}" if self.detail else self.head

    def _repr_html_(self) -> str:
        """Return the same in colour, for a notebook; nothing in it is the learner's own HTML."""
        colour = COLOURS[self.outcome]
        return (
            f'<div style="border-left: 5px solid {colour}; padding: 2px 10px">'
            f'<b style="color: {colour}">{html.escape(self.head)}</b>'
            f'<pre style="margin: 4px 0 0; white-space: pre-wrap">{html.escape(self.detail)}</pre>'
            "</div>"
        )


class Judge:
    """Judges answers to one question over fixed cases, whose right answers are worked out once."""

    def __init__(
        self, question: Question, cases: Sequence[tuple] | None, *, tell: bool = True
    ) -> None:
        """Prepare to judge; with `tell` a wrong answer is told the property that a right one has.

        That is often the formula itself, so a first try is better not told.
        """
        self.question, self.cases, self.tell = question, cases, tell
        # Where faults are looked for, there is nothing to compare with.
        self.right = (
            [None] * len(cases or ())
            if question.faults
            else question.answers(question.truth, cases)
        )
        self._wrong_answers: dict[str, list[Any] | None] = {}

    def judge(self, reply: Mapping[str, Any]) -> Verdict:
        """Turn a submission's reply, which may be forged or broken, into a verdict."""
        # Imported here: no browser has pydantic, and none judges what others send.
        from fgtutor.io.validation import parse_record

        try:
            said = parse_record(Reply, reply, ConfigError, "the reply")
        except ConfigError as error:
            return self._unreadable(error)
        return self._judge(said)

    def judge_own(self, reply: Mapping[str, Any]) -> Verdict:
        """Turn a reply that this process got from `replies.reply_of` into a verdict."""
        # As JSON it holds plain values alone, as it would from another process.
        return self._judge(Reply(**json.loads(json.dumps(reply))))

    def _unreadable(self, error: ConfigError) -> Verdict:
        return Verdict(self.question, CRASHED, plain_text(f"unreadable answer: {error}"))

    def _judge(self, said: Reply) -> Verdict:
        try:
            answers = [decode(answer) for answer in said.answers or []]
        except ConfigError as error:
            return self._unreadable(error)
        if said.outcome:
            return Verdict(self.question, said.outcome, plain_text(said.detail))
        if said.changed is not None:
            return Verdict(self.question, WRONG, self._changed(said.changed))
        if len(answers) != len(self.right):
            return Verdict(self.question, CRASHED, f"{len(answers)} answers to {len(self.right)}")
        for number, got in enumerate(answers):
            if text := self._what_is_wrong(number, got):
                case = None if self.cases is None else number + 1
                return Verdict(self.question, WRONG, self._wrong(number, text, answers), case)
        return Verdict(self.question, PASSED)

    def _what_is_wrong(self, number: int, got: Any) -> str:
        """Say what is wrong with the answer to a case; "" if nothing is."""
        if self.question.faults:
            return "\n".join(self._faults(number, got).values())
        return self._difference(self.right[number], got)

    def _same(self, number: int, one: Any, other: Any) -> bool:
        """Return whether two answers to a case are the same, or have the same faults."""
        if self.question.faults:
            return self._faults(number, one).keys() == self._faults(number, other).keys()
        return not self._difference(one, other)

    def _faults(self, number: int, got: Any) -> dict[str, str]:
        asked, case = self.question, (self.cases or ())[number]
        if asked.faults is None:
            return {}
        try:
            return asked.faults(got, *case)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            return {"form": f"Got {describe(got)}, which is not what was asked for."}

    def _difference(self, expected: Any, got: Any) -> str:
        asked = self.question
        # Where a number is to be found, the message must not tell it.
        shown = asked.draw is not None
        options = {"rtol": asked.rtol, "atol": asked.atol, "single": asked.single}
        text = difference(expected, got, show=shown, **options)
        return text or (not_integers(got) if asked.integers else "")

    def _wrong(self, number: int, text: str, answers: Sequence[Any]) -> str:
        lines = self._told()
        mistake = self._recognise(answers)
        if mistake:
            lines.append(f"Looks like {mistake.says}")
        if self.cases is not None:
            given = ", ".join(
                f"{name} = {_short(value)}"
                for name, value in zip(self.question.parameters, self.cases[number], strict=True)
            )
            lines.append(f"In case {number + 1} of {len(self.cases)}, with {given}:")
        return plain_text("\n".join([*lines, text]))

    def _told(self) -> list[str]:
        return [f"Expected: {self.question.expects}"] if self.tell else []

    def _changed(self, place: int) -> str:
        names = self.question.parameters
        name = names[place] if place < len(names) else "?"
        change = (
            f"The function changes its argument `{name}`, which belongs to the caller: work on a "
            f"copy, `{name} = {name}.copy()`."
        )
        return "\n".join([*self._told(), change])

    def _recognise(self, answers: Sequence[Any]) -> Mistake | None:
        """Return the first typical mistake whose answers are these in every case."""
        for mistake in self.question.mistakes:
            wrong = self._made_by(mistake)
            if wrong is not None and all(
                self._same(number, *pair)
                for number, pair in enumerate(zip(wrong, answers, strict=True))
            ):
                return mistake
        return None

    def _made_by(self, mistake: Mistake) -> list[Any] | None:
        """Return what a mistake answers, worked out once; None if it does not fit every case."""
        if mistake.says not in self._wrong_answers:
            try:
                answers = self.question.answers(mistake.answer, self.cases)
            except (ArithmeticError, LookupError, ValueError):
                answers = None
            self._wrong_answers[mistake.says] = answers
        return self._wrong_answers[mistake.says]


def plain_text(text: Any, *, kept: str = "\n\\") -> str:
    """Return text in which all that cannot be seen, or turns others around, is escaped.

    So a name or a message cannot pass for something else on a terminal or in a file.
    """
    return "".join(
        c if c in kept or (c.isprintable() and c != "\\") else c.encode("unicode_escape").decode()
        for c in str(text)[:LONGEST]
    )


def plain_name(name: Any) -> str:
    """Return a path or name in one line as `plain_text`, so that no two of them look the same."""
    return plain_text(name, kept="")


def _short(value: Any) -> str:
    """Return an argument as a message can show it: whole if small, else what it is."""
    if isinstance(value, np.ndarray) and value.size <= 8:
        return np.array2string(value, precision=4, separator=", ").replace("\n", "")
    return describe(value).removeprefix("the number ").removeprefix("the text ")
