"""A reply: what a learner's function answers to every case, or why there are no answers.

Reads a function (or, for a judgement, a value) and cases; calls it within a time limit and gives
plain values. The same code runs in the learner's own kernel and in the grader's worker.
"""

import copy
import linecache
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

from fgtutor.course.grading.answers import encode
from fgtutor.errors import ConfigError

NOT_STARTED, CRASHED, TOO_SLOW = "not started", "crashed", "too slow"
PATIENCE = 10.0
"""Wall time allowed as a multiple of CPU time, for machines that do other work too."""
SLOW = (
    "it took more than {:g} s of CPU time: look for a loop that does not end, or for work that is "
    "done again and again"
)
"""What a learner is told whose answer ran out of time."""
LONGEST = 300
"""Longest message of an error that is passed on, characters."""


class TooSlow(BaseException):
    """The time limit has passed. No `Exception`, so that `except Exception` does not swallow it."""


@contextmanager
def time_limit(seconds: float, patience: float = PATIENCE) -> Iterator[None]:
    """Raise `TooSlow` in the block after `seconds` of CPU time, or `patience` times that by clock.

    With patience 0 the clock does not count: the grader watches whether the process sleeps. Where
    there are no such timers (Windows, threads, a browser) there is no limit: interrupt the
    kernel, or in a browser restart it.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not (in_main and hasattr(signal, "setitimer")):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooSlow

    clocks = {
        signal.SIGPROF: (signal.ITIMER_PROF, seconds),
        signal.SIGALRM: (signal.ITIMER_REAL, patience * seconds),
    }
    before = {number: signal.signal(number, stop) for number in clocks}
    try:
        for timer, after in clocks.values():
            signal.setitimer(timer, after, 1.0)  # again every second, if the first is swallowed
        yield
    finally:
        for timer, _ in clocks.values():
            signal.setitimer(timer, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def reply_of(
    target: Any,
    cases: Sequence[tuple] | None,
    seconds: float,
    patience: float = PATIENCE,
    harness: Callable[..., Any] | None = None,
) -> dict[str, Any]:
    """Return {"answers": [...]}, encoded, or {"outcome": ..., "detail": ...}.

    With `cases` None the target is itself the answer. With a `harness` the target need not be a
    function: harness(target, *arguments) gives the answer. "changed" counts the argument that the
    function modified although it is the caller's.
    """
    if target is ... or target is None:
        return {"outcome": NOT_STARTED, "detail": "it still holds the three dots"}
    try:
        with time_limit(seconds, patience):
            try:
                if cases is None:
                    return {"answers": [encode(target)]}
                if not callable(target):
                    detail = f"a function is expected, not {target!r:.{LONGEST}}"
                    return {"outcome": CRASHED, "detail": detail}
                return _call(partial(harness, target) if harness else target, cases)
            except NotImplementedError:
                return {
                    "outcome": NOT_STARTED,
                    "detail": "its `raise NotImplementedError` still runs",
                }
            except ConfigError as error:
                return {"outcome": CRASHED, "detail": f"the answer is {error}"}
            except (Exception, SystemExit) as error:
                name = getattr(getattr(target, "__code__", None), "co_filename", "")
                return {"outcome": CRASHED, "detail": explain(error, name)}
    except TooSlow:
        return {"outcome": TOO_SLOW, "detail": SLOW.format(seconds)}


def _call(target: Callable[..., Any], cases: Sequence[tuple]) -> dict[str, Any]:
    answers = []
    for arguments in cases:
        given = copy.deepcopy(arguments)
        answers.append(encode(target(*given)))
        for place, (own, lent) in enumerate(zip(arguments, given, strict=True)):
            if encode(own) != encode(lent):
                return {"answers": [], "changed": place}
    return {"answers": answers}


def explain(error: BaseException, filename: str) -> str:
    """Return an error in one line, with the learner's line that it came from.

    It walks the traceback itself: a submission may have replaced the `traceback` module.
    """
    try:
        message = f"{type(error).__name__}: {error}"
    except Exception:  # an error whose own text fails
        message = type(error).__name__
    if isinstance(error, SyntaxError):
        return f"{message[:LONGEST]}: {(error.text or '').strip()[:LONGEST]}"
    step, line = error.__traceback__, 0
    while step is not None:
        if step.tb_frame.f_code.co_filename == filename:
            line = step.tb_lineno
        step = step.tb_next
    source = linecache.getline(filename, line).strip()
    where = f"  (line {line}: {source[:LONGEST]})" if line else ""
    return message[:LONGEST] + where
