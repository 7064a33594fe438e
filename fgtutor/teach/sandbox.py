"""One submission in a process of its own: what it answers, whatever it does.

Reads the notebook's cells and the cases of its questions; gives a reply for each question. The
process has its own group, a scrubbed environment, an empty folder and limits (`confinement`); it
sends plain JSON lines, and is killed with its group when it is done or overdue.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgtutor.teach.asking import CRASHED, PATIENCE, TOO_SLOW
from fgtutor.teach.values import LARGEST

START = "import sys; sys.path.append(sys.argv[1]); from fgtutor.teach.worker import main; main()"
"""What the process runs: our package comes behind everything installed."""
ROOT = str(Path(__file__).resolve().parents[2])
GRACE = 10.0
"""Seconds by clock for starting Python and numpy on a busy machine, and between two lines."""
LONGEST_LINE = 20 * LARGEST
"""Bytes of one line; a process that sends more is not answering."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a submission may use."""

    seconds: float = 2.0
    """CPU time for all cases of one question, s."""
    loading: float = 5.0
    """CPU time for running all cells, s."""
    memory_mb: int = 2048
    """Address space, MB; numpy and scipy take 400."""


def ask_submission(
    cells: Sequence[str], questions: Sequence[dict[str, Any]], limits: Limits
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Return a reply to every question, by id, and which protections were in force.

    A question is {"id", "name", "cases"}, its cases encoded. A process that dies or hangs over one
    question is started anew for those after it.
    """
    replies: dict[str, dict[str, Any]] = {}
    in_force: list[str] = []
    pending = list(questions)
    while pending:
        with _Worker(cells, pending, limits) as worker:
            confined = worker.receive(GRACE)
            in_force = confined.get("confined") or in_force
            loaded = worker.receive(PATIENCE * limits.loading + GRACE)
            if "loaded" not in loaded:
                detail = _blame(loaded, "running its cells")
                return replies | {q["id"]: detail for q in pending}, in_force
            while pending:
                reply = worker.receive(PATIENCE * limits.seconds + GRACE)
                question = pending.pop(0)
                if reply.get("question") == question["id"]:
                    replies[question["id"]] = reply
                else:
                    replies[question["id"]] = _blame(reply, "answering")
                    break
    return replies, in_force


def _blame(message: dict[str, Any], doing: str) -> dict[str, Any]:
    """Turn silence or nonsense into a reply."""
    if message.get("late"):
        return {"outcome": TOO_SLOW, "detail": f"stopped while {doing}: it did not come to an end"}
    return {"outcome": CRASHED, "detail": f"the process died or sent nonsense while {doing}"}


class _Worker:
    """A running worker; leaving the block kills its whole group."""

    def __init__(
        self, cells: Sequence[str], questions: Sequence[dict[str, Any]], limits: Limits
    ) -> None:
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        job = {
            "cells": list(cells),
            "questions": list(questions),
            "seconds": limits.seconds,
            "loading": limits.loading,
            "memory_mb": limits.memory_mb,
        }
        # LD_LIBRARY_PATH is no secret, and some Pythons do not start without it.
        kept = {name: os.environ[name] for name in ("LD_LIBRARY_PATH",) if name in os.environ}
        one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-B", "-c", START, ROOT],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=self.folder.name,
            env=kept | one_thread | {"LANG": "C.UTF-8", "MPLBACKEND": "Agg"},
            start_new_session=True,
        )
        assert self.process.stdin and self.process.stdout
        self.buffer = b""
        self.selector = selectors.DefaultSelector()
        self.selector.register(self.process.stdout, selectors.EVENT_READ)
        with suppress(BrokenPipeError):  # it died at once, as the missing answer will tell
            self.process.stdin.write(json.dumps(job).encode())
            self.process.stdin.flush()
        with suppress(BrokenPipeError):
            self.process.stdin.close()

    def __enter__(self) -> "_Worker":
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.selector.close()
        assert self.process.stdout
        self.process.stdout.close()
        self.folder.cleanup()

    def receive(self, seconds: float) -> dict[str, Any]:
        """Return the next message; {"late": True} if none came in time, {} for junk or the end."""
        assert self.process.stdout
        end = time.monotonic() + seconds
        while b"\n" not in self.buffer:
            if not self.selector.select(max(end - time.monotonic(), 0)):
                return {"late": True}
            block = os.read(self.process.stdout.fileno(), 1 << 16)
            self.buffer += block
            if not block or len(self.buffer) > LONGEST_LINE:
                return {"late": True} if not block and self._was_killed() else {}
        line, self.buffer = self.buffer.split(b"\n", 1)
        try:
            message = json.loads(line)
        except (ValueError, RecursionError):
            return {}
        return message if isinstance(message, dict) else {}

    def _was_killed(self) -> bool:
        """Return whether the kernel ended it, for its CPU time, rather than it ended itself."""
        try:
            return self.process.wait(timeout=1.0) in (-signal.SIGKILL, -signal.SIGXCPU)
        except subprocess.TimeoutExpired:  # it closed its output and goes on
            return True
