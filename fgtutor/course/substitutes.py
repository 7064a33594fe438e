"""The learner's functions in the planner, each in place of the library's.

Reads functions by name; runs them where a stage asks for one. A function that fails on the real
data is named, and the library's runs in its place.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fgtutor.course.grading.replies import TooSlow, explain, time_limit

SECONDS = 20.0
"""CPU time that one stage may take with a function of the learner's, s."""


class Stages:
    """The learner's functions, which of them ran, and what went wrong."""

    def __init__(self, functions: Mapping[str, Callable[..., Any]], faults: Sequence[str]) -> None:
        self.functions = dict(functions)
        self.faults = [*faults]
        self.hers: dict[str, None] = {}
        self.ours: dict[str, None] = {}

    def run(self, name: str, ours: Callable[[], Any], hers: Callable[[Any], Any]) -> Any:
        """Return hers(function) if the learner's function has passed and runs here, else ours()."""
        function = self.functions.get(name)
        if function is not None:
            try:
                with time_limit(SECONDS):
                    value = hers(function)
            except TooSlow:
                self._give_up(name, f"it took more than {SECONDS:g} s")
            except Exception as error:
                self._give_up(name, explain(error, ""))
            else:
                self.hers[name] = None
                return value
        if name not in self.hers:
            self.ours[name] = None
        return ours()

    def _give_up(self, name: str, reason: str) -> None:
        del self.functions[name]  # from here on the library's
        self.hers.pop(name, None)
        self.faults.append(f"Your `{name}` fails on the real data, so the library's runs: {reason}")

    def report(self) -> str:
        """Say whose each stage was, and what went wrong."""
        yours, ours = (", ".join(names) or "nothing yet" for names in (self.hers, self.ours))
        return "\n".join([f"Yours: {yours}.", f"The library's: {ours}.", *self.faults])


def same_shape(value: Any, like: Any) -> np.ndarray:
    """Return an answer as an array; raises `ValueError` if its shape is not the library's."""
    array = np.asarray(value, dtype=float)
    if array.shape != np.shape(like):
        raise ValueError(f"it gives an array of shape {array.shape} instead of {np.shape(like)}")
    return array
