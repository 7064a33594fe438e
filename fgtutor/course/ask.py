"""Questions to the learner: predict, then see the result beside the prediction.

Reads what the learner chooses or types below a cell; gives it back beside the answer. Nothing here
waits for anybody: a notebook that runs without a reader prints the question and, later, the answer.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fgtutor.errors import ConfigError, MissingExtraError

ALONE = {"text/plain": {"alone": True}}
"""Metadata of an output whose text tells as much as its widget, so that it is kept without one."""
OPEN = "nothing"
"""What stands for a prediction that was not made."""


@dataclass
class Prediction:
    """A question that was put, and what the learner said."""

    prompt: str
    """The question."""
    choices: tuple[str, ...] = ()
    """What can be chosen; empty for an answer in the learner's own words."""
    said: str = ""
    """The learner's prediction; empty until there is one."""

    @property
    def text(self) -> str:
        """The question and its choices, a line each."""
        letters = zip("abcdefghijklmnopqrstuvwxyz", self.choices, strict=False)
        lines = [f"  {letter}) {choice}" for letter, choice in letters]
        return "\n".join([f"Predict first: {self.prompt}", *lines])


_asked: list[Prediction] = []
"""The questions put so far; `reveal` answers the last one."""


def predict(prompt: str, choices: Sequence[str] | None = None) -> None:
    """Ask for a prediction; what the learner says is kept until `reveal`.

    Asks and goes on at once. In a live notebook a list of the choices, or a line to write on,
    stands below the question; elsewhere it is printed. Raises `ConfigError` for an empty question
    or fewer than two choices.
    """
    options = tuple(choices or ())
    if not prompt.strip():
        raise ConfigError("a prediction needs a question: say what the learner should predict")
    if choices is not None and (len(options) < 2 or isinstance(choices, str)):
        raise ConfigError(f"give at least two choices, or leave them out, got {choices!r}")
    question = Prediction(prompt, options)
    _asked.append(question)
    if not _show_field(question):
        print(question.text)


def _show_field(question: Prediction) -> bool:
    """Show the question with what takes the prediction; return whether a notebook can.

    Where nothing is live, as on a page without a kernel, the same output reads as text.
    """
    try:
        from IPython import get_ipython  # pyright: ignore[reportPrivateImportUsage]
        from IPython.display import display

        from fgtutor.course.widgets.still import w
    except (ImportError, MissingExtraError):
        return False
    if get_ipython() is None:
        return False
    field: Any
    if question.choices:
        field = w.RadioButtons(options=question.choices, value=None, layout={"width": "auto"})
    else:
        field = w.Text(placeholder="your prediction", layout={"width": "32em"})

    def take(change: Any) -> None:
        question.said = change["new"] or ""

    field.observe(take, "value")
    heading = w.HTML(f"<b>Predict first:</b> {html.escape(question.prompt)}")
    live: Any = w.VBox([heading, field])._repr_mimebundle_()
    data = live[0] if isinstance(live, tuple) else live or {}
    display({**data, "text/plain": question.text}, metadata=ALONE, raw=True)
    return True


class Answer:
    """A prediction beside the answer, as a table or as text."""

    def __init__(self, question: Prediction, answer: str) -> None:
        self.question, self.answer = question, answer

    @property
    def verdict(self) -> str:
        """Whether the prediction is the answer, where both come from a list of choices."""
        known = self.answer in self.question.choices and self.question.said
        if not known:
            return ""
        return "as you predicted" if self.question.said == self.answer else "not as you predicted"

    def __repr__(self) -> str:
        lines = [f"You predicted: {self.question.said}"] if self.question.said else []
        verdict = f" ({self.verdict})" if self.verdict else ""
        return "\n".join([*lines, f"The answer:    {self.answer}{verdict}"])

    def _repr_html_(self) -> str:
        said, answer = (html.escape(text) for text in (self.question.said or OPEN, self.answer))
        verdict = f" ({self.verdict})" if self.verdict else ""
        rows = (("question", html.escape(self.question.prompt)), ("you predicted", said),
                ("the answer", f"<b>{answer}</b>{verdict}"))  # fmt: skip
        cells = "".join(
            f'<tr><th style="text-align: left">{name}</th>'
            f'<td style="text-align: left">{text}</td></tr>'
            for name, text in rows
        )
        return f"<table>{cells}</table>"


def reveal(answer: str) -> Answer:
    """Return the answer to the last `predict`, beside what the learner said; show it as a result.

    Raises `ConfigError` if nothing was asked.
    """
    if not _asked:
        raise ConfigError("nothing was predicted yet: run the cell with predict(...) first")
    return Answer(_asked[-1], str(answer))
