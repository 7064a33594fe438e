"""Run one submission in a process of its own and collect its replies, whatever it does.

Reads the notebook's cells and the cases of its questions; gives a reply for each question. The
process has its own group, a scrubbed environment and limits (`confinement`); it sends plain JSON
lines, and is killed with its group when it is done or overdue. Only what a submission used itself,
CPU time and sleep, makes it overdue: a machine that keeps it waiting is an error of ours.
"""

import importlib.util
import json
import os
import re
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Annotated, Any

from annotated_types import Interval

from fgtutor.course.grading.answers import LARGEST
from fgtutor.course.grading.replies import CRASHED, PATIENCE, TOO_SLOW
from fgtutor.errors import ConfigError, GradingError, MissingExtraError
from fgtutor.io.validation import check_fields

START = (
    "import sys; sys.path.append(sys.argv[1]); "
    "from fgtutor.course.grading.worker import main; main()"
)
"""What the process runs: our package comes behind everything installed."""
ROOT = str(Path(__file__).resolve().parents[3])
TRIES = 3
"""How often a process is started that ends before it has seen the submission."""
LONGEST_WAIT = 600.0
"""Seconds by clock for one line of a process that waits for a busy machine."""
SLACK = 2.0
"""CPU time after which a process is stopped that has not stopped itself, beside what it has, s."""
TICK = 0.25
"""Seconds between two looks at what a process does."""
TORCH = re.compile(r"^\s*(?:from|import)\b.*\btorch\b", re.MULTILINE)
"""Code that needs torch, which is loaded before the process is confined."""
ROOM = 20_000
"""Bytes for the answer to one case; the largest right one has 2,400."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a submission may use."""

    seconds: Annotated[float, Interval(ge=0.1, le=3600)] = 2.0
    """CPU time for all cases of one question, s."""
    loading: Annotated[float, Interval(ge=0.1, le=3600)] = 5.0
    """CPU time for running all cells, s."""
    memory_mb: Annotated[int, Interval(ge=512, le=2**20)] = 2048
    """Address space, MB; numpy and scipy take 400."""
    idle: Annotated[float, Interval(ge=0.1, le=3600)] = 10.0
    """Sleep in running the cells or in one question, s; in all three times that."""

    def __post_init__(self) -> None:
        check_fields(self)


def check_system() -> None:
    """Raise `ConfigError` or `MissingExtraError` if submissions cannot be run on this system."""
    if sys.platform == "win32":
        raise ConfigError(
            "grading runs other people's code and needs the limits of Linux or macOS: use WSL"
        )
    if importlib.util.find_spec("IPython") is None:
        raise MissingExtraError(
            "grading runs cells as Jupyter does and needs IPython, which is not installed here: in "
            'the clone of fgtutor pip install -c constraints.txt -e ".[lab]"'
        )


def ask_submission(
    cells: Sequence[str],
    questions: Sequence[dict[str, Any]],
    limits: Limits,
    stop: Event | None = None,
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Return a reply to every question, by id, and which protections were in force.

    A question is {"id", "name", "cases"}, its cases encoded, and where it has them "harness", its
    name and source, and "seconds", CPU time that it needs if that is more than usual. A process
    that dies or hangs over one question is started anew for those after it. Setting `stop` ends it
    all at once.

    Raises:
        GradingError: The machine did not let the submission run to its end, or `stop` was set.
    """
    replies: dict[str, dict[str, Any]] = {}
    in_force: list[str] = []
    pending = list(questions)
    slept = 0.0
    while pending:
        with _started(cells, pending, limits, stop or Event(), slept) as worker:
            in_force = worker.confined
            loaded = worker.receive(limits.loading)
            if "loaded" not in loaded:
                detail = _blame(loaded, "running its cells")
                return replies | {q["id"]: detail for q in pending}, in_force
            while pending:
                question = pending.pop(0)
                reply = worker.receive(_seconds(question, limits))
                if reply.get("question") == question["id"]:
                    replies[question["id"]] = reply
                else:
                    replies[question["id"]] = _blame(reply, "answering")
                    break
        slept = worker.slept
    return replies, in_force


def _seconds(question: dict[str, Any], limits: Limits) -> float:
    """Return the CPU time that all cases of a question may take."""
    return max(limits.seconds, question.get("seconds", 0.0))


def needs_torch(cells: Sequence[str], questions: Sequence[dict[str, Any]]) -> bool:
    """Return whether the cells, or what they are asked, use torch."""
    asked = json.dumps([[q["cases"], q.get("harness")] for q in questions])
    return '{"tensor":' in asked or "import torch" in asked or any(map(TORCH.search, cells))


def _blame(message: dict[str, Any], doing: str) -> dict[str, Any]:
    """Turn silence or nonsense into a reply."""
    if message.get("late"):
        return {"outcome": TOO_SLOW, "detail": f"stopped while {doing}: it did not come to an end"}
    return {"outcome": CRASHED, "detail": f"the process died or sent nonsense while {doing}"}


@contextmanager
def _started(
    cells: Sequence[str],
    questions: Sequence[dict[str, Any]],
    limits: Limits,
    stop: Event,
    slept: float,
) -> Iterator["_Worker"]:
    """Yield a worker that is confined and about to run the cells; kill its whole group after.

    Until then nothing of the submission has run, so what goes wrong is not its fault.
    """
    reason = ""
    for attempt in range(TRIES):
        stop.wait(attempt)
        try:
            worker = _Worker(cells, questions, limits, stop, slept)
        except OSError as error:
            reason = str(error)
            continue
        try:
            if worker.confine():
                yield worker
                return
            reason = f"ended with code {worker.process.wait()}"
        finally:
            worker.close()
    raise GradingError(
        f"its process could not be started ({reason}): free memory, or take fewer --workers, and "
        "grade it again"
    )


class _Worker:
    """A running process of a submission."""

    def __init__(
        self,
        cells: Sequence[str],
        questions: Sequence[dict[str, Any]],
        limits: Limits,
        stop: Event,
        slept: float,
    ) -> None:
        self.limits, self.stop, self.slept = limits, stop, slept
        cases = sum(len(q["cases"] or [0]) for q in questions)
        self.longest_line = 2 * LARGEST + ROOM * cases
        self.used = 0.0
        self.usable = limits.loading + sum(_seconds(q, limits) + 1 for q in questions) + SLACK
        self.job = asdict(limits) | {
            "cells": list(cells),
            "torch": needs_torch(cells, questions),
            "questions": list(questions),
            "longest_line": self.longest_line,
            "cpu_seconds": self.usable,
            "grader": os.getpid(),
        }
        self.confined: list[str] = []
        self.buffer = b""
        # LD_LIBRARY_PATH is no secret, and some Pythons do not start without it. Packages may be
        # installed at home. matplotlib wants a folder that looks as if it could be written to.
        kept = {name: os.environ[name] for name in ("LD_LIBRARY_PATH",) if name in os.environ}
        one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        plots = {"MPLBACKEND": "Agg", "MPLCONFIGDIR": tempfile.gettempdir()}
        home = {"HOME": os.path.expanduser("~"), "LANG": "C.UTF-8"}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-B", "-c", START, ROOT],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd="/",  # nothing can be written, so no folder is needed that would have to be removed
            env=kept | one_thread | plots | home,
            start_new_session=True,
        )
        assert self.process.stdin and self.process.stdout
        self.input, self.output = self.process.stdin, self.process.stdout
        self.selector = selectors.DefaultSelector()
        self.selector.register(self.output, selectors.EVENT_READ)

    def confine(self) -> bool:
        """Hand over the job; return whether the process is confined and ready for it."""
        with suppress(BrokenPipeError):  # it died at once, as the missing answer will tell
            self.input.write(json.dumps(self.job).encode())
            self.input.flush()
        with suppress(BrokenPipeError):
            self.input.close()
        message = self.receive(None)
        self.confined = message.get("confined", [])
        return "confined" in message

    def close(self) -> None:
        """Kill its whole group."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.selector.close()
        self.output.close()

    def receive(self, cpu_seconds: float | None) -> dict[str, Any]:
        """Return the next message; {"late": True} if it is overdue, {} for junk or the end.

        Without `cpu_seconds` it is never overdue. Raises `GradingError` if the machine is.
        """
        begun = ticked = time.monotonic()
        used, idle = self.used, self.slept
        while b"\n" not in self.buffer:
            ready = self.selector.select(TICK)
            now = time.monotonic()
            if self.stop.is_set():
                raise GradingError("grading was stopped")
            if now - begun > LONGEST_WAIT:
                raise GradingError(
                    f"the machine was too busy to run it within {LONGEST_WAIT:g} s: take fewer "
                    "--workers, and grade it again"
                )
            if now - ticked >= TICK:
                sleeps, self.used = self._usage(now - begun, used)
                self.slept += TICK * (sleeps and cpu_seconds is not None)
                ticked = now
            if cpu_seconds is not None and (
                self.used - used > cpu_seconds + SLACK
                or self.slept - idle > self.limits.idle
                or self.slept > 3 * self.limits.idle
            ):
                return {"late": True}
            if ready:
                block = os.read(self.output.fileno(), 1 << 16)
                self.buffer += block
                if not block:
                    return {"late": True} if self._was_stopped() else {}
                if len(self.buffer) > self.longest_line:
                    return {}
        line, self.buffer = self.buffer.split(b"\n", 1)
        try:
            message = json.loads(line)
        except (ValueError, RecursionError):
            return {}
        return message if isinstance(message, dict) else {}

    def _usage(self, waited: float, used: float) -> tuple[bool, float]:
        """Return whether it sleeps now, rather than wait for a core, and its CPU time so far, s.

        Source: proc_pid_stat(5). Without that file (macOS) the clock stands for both.
        """
        try:
            stat = Path(f"/proc/{self.process.pid}/stat").read_bytes()
            state, *numbers = stat[stat.rindex(b")") + 1 :].split()
            ticks = int(numbers[10]) + int(numbers[11])
            return state not in (b"R", b"D"), ticks / os.sysconf("SC_CLK_TCK")
        except (OSError, ValueError, IndexError):
            return False, used + waited / PATIENCE

    def _was_stopped(self) -> bool:
        """Return whether the kernel ended it for its CPU time, rather than it ended itself."""
        try:
            code = self.process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:  # it closed its output and goes on
            return True
        if code == -signal.SIGKILL and self.used < self.usable - 1:
            raise GradingError(
                "its process was killed from outside, perhaps for lack of memory: take fewer "
                "--workers, and grade it again"
            )
        return code in (-signal.SIGKILL, -signal.SIGXCPU)
