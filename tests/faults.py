"""A process to do harm to: it runs commands of fgtutor that may be killed, starved or locked out.

All that a command imports is loaded once, and each command runs in a fork of that process: so a
kill hits the work, not the imports, and a hundred of them take minutes.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

KILLED = -signal.SIGKILL

_SERVER = """
import json, os, resource, signal, sys, traceback
import torch, tyro
from torch.utils.tensorboard import SummaryWriter
import fgtutor.learning.training, fgtutor.evaluation.sweep, fgtutor.evaluation.matrix
import fgtutor.cli.map
import fgtutor.course.grading.grade, fgtutor.cli.export, fgtutor.cli.plan, fgtutor.robots.toy
from fgtutor import __main__ as cli
torch.set_num_threads(1)
for line in sys.stdin:
    order = json.loads(line)
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            os.setsid()
            os.dup2(2, 1)
            if order["user"]:
                os.setgroups([]), os.setgid(order["user"]), os.setuid(order["user"])
            if order["bytes"]:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (order["bytes"],) * 2)
            code = cli.main(order["words"])
        except SystemExit as stop:
            code = stop.code
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                try:
                    stream.flush()
                except OSError:
                    pass
            os._exit(code or 0)
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


class Victim:
    """A process that runs one command at a time, for a `with` block."""

    def __init__(self, folder: Path) -> None:
        """Load what the commands need; they run in `folder`."""
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", _SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pipesize=2**20,
            text=True,
            cwd=folder,
            env=environment,
        )
        self.said = cast(IO[str], self.process.stderr).fileno()
        os.set_blocking(self.said, False)
        self.run(["--version"])  # until it is ready

    def start(self, words: Sequence[object], *, largest: int = 0, user: int = 0) -> int:
        """Begin a command, with files of at most `largest` bytes, as `user`; return its process."""
        order = {
            "words": [str(word) for word in words],
            "bytes": largest,
            "user": user,
        }
        cast(IO[str], self.process.stdin).write(json.dumps(order) + "\n")
        cast(IO[str], self.process.stdin).flush()
        return self._answer()

    def end(self) -> int:
        """Wait for the command; return its exit code, negative for the signal that ended it."""
        return self._answer()

    def run(self, words: Sequence[object], *, largest: int = 0, user: int = 0) -> tuple[int, str]:
        """Run a command to its end; return its exit code and all that it said."""
        self.start(words, largest=largest, user=user)
        code = self.end()
        with suppress(BlockingIOError):
            return code, os.read(self.said, 2**20).decode(errors="replace")
        return code, ""

    def kill(self, words: Sequence[object], after: float) -> int:
        """Run a command and kill it after so many seconds; return its exit code."""
        pid = self.start(words)
        time.sleep(after)
        with suppress(ProcessLookupError):  # if it was faster
            os.kill(pid, signal.SIGKILL)
        code = self.end()
        with suppress(BlockingIOError):
            os.read(self.said, 2**20)
        return code

    def close(self) -> None:
        """End the process."""
        self.process.communicate()

    def _answer(self) -> int:
        return int(cast(IO[str], self.process.stdout).readline())


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file under a folder that is no curve of a training."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "tensorboard" not in path.parts
    }


def moments(kills: int, seconds: float, seed: int) -> list[float]:
    """Return when to kill, at random within the time that a command takes."""
    rng = random.Random(seed)
    return [rng.uniform(0, seconds) for _ in range(kills)]
