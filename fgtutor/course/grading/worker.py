"""The process of one submission: run its cells, ask its functions, send back plain values.

Reads a job as JSON from stdin; gives one JSON line per question on stdout. `sandbox` starts it with
nothing inherited. The grader does not trust what it sends: no verdict is made here.
"""

import importlib
import json
import linecache
import os
import re
import sys
import time
import types
from collections.abc import Callable
from typing import Any, BinaryIO

from fgtutor.course.grading.answers import decode
from fgtutor.course.grading.cells import Cells
from fgtutor.course.grading.confinement import confine
from fgtutor.course.grading.replies import (
    CRASHED,
    NOT_STARTED,
    TOO_SLOW,
    TooSlow,
    explain,
    reply_of,
    time_limit,
)

OFFERED = ("fgtutor.directions",)
"""Modules of ours that a submission may import; they load neither torch nor a simulator."""

STUBBED = ("case", "check", "hint", "kept", "reset", "solution", "with_mine")
"""What a notebook imports from the checks; a submission that needs what they give must fail."""


def main() -> None:
    """Do the job on stdin, then leave without running anything that the submission left behind."""
    job = json.loads(sys.stdin.buffer.read())
    answers = os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    for name in OFFERED:  # before the door closes
        importlib.import_module(name)
    mapped = load_torch() if job["torch"] else 0
    sys.path.remove(sys.argv.pop())
    in_force = confine(
        grader=job["grader"], memory_mb=job["memory_mb"] + mapped, cpu_seconds=job["cpu_seconds"]
    )
    send(answers, {"confined": in_force})
    namespace, faults = load(job["cells"], job["loading"])
    send(answers, {"loaded": True})
    for question in job["questions"]:
        cases = question["cases"]
        arguments = None if cases is None else [decode(case, tensors=True) for case in cases]
        seconds = max(job["seconds"], question.get("seconds", 0.0))
        harness = made(question.get("harness"))
        reply = answer(namespace, faults, question["name"], arguments, seconds, harness)
        if not send(answers, {"question": question["id"], **reply}, job["longest_line"]):
            detail = "the answers together are larger than any should be"
            send(answers, {"question": question["id"], "outcome": CRASHED, "detail": detail})
    os._exit(0)


def load_torch() -> int:
    """Load torch and all that a training needs: it opens libraries, which is refused afterwards.

    One thread computes, as no other can be started then, nor would one be confined that is there.
    Returns the address space that all this takes, MB: it is not the submission's.
    """
    import torch
    import torch.nn.functional

    torch.set_num_threads(1)
    torch.set_num_interop_threads(1)
    net = torch.nn.Linear(1, 1)
    optimizer = torch.optim.Adam(net.parameters())
    net(torch.ones(1, 1)).sum().backward()
    optimizer.step()
    optimizer.zero_grad()
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE") // 2**20
    except OSError:  # macOS, where memory is not limited
        return 0


def made(harness: list[str] | None) -> Callable[..., Any] | None:
    """Return the function of a question that calls what is asked for, from its name and source."""
    if harness is None:
        return None
    name, source = harness
    namespace: dict[str, Any] = {}
    exec(source, namespace)
    return namespace[name]


def send(answers: BinaryIO, message: dict[str, Any], longest: int = 10**6) -> bool:
    """Write one line, unless it is longer than the grader reads; return whether it was written."""
    line = json.dumps(message).encode() + b"\n"
    if len(line) <= longest:
        answers.write(line)
        answers.flush()
    return len(line) <= longest


def load(cells: list[str], seconds: float) -> tuple[dict[str, Any], list[tuple[str, dict]]]:
    """Run all cells in order; return what they define, and (source, reply) of each that failed.

    A failing cell does not stop the others, as in a notebook. All share `seconds` of CPU time.
    """
    stub_checks()
    module = types.ModuleType("__main__")
    module.__dict__["display"] = lambda *values, **options: None
    sys.modules["__main__"] = module
    notebook = Cells(module.__dict__)
    faults = []
    left = seconds
    for number, source in enumerate(cells):
        name = f"<cell {number + 1}>"
        linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
        begun = time.process_time()
        try:
            code = notebook.compiled(source, name)
            begun = time.process_time()  # that IPython is loaded for it is not the cell's time
            with time_limit(max(left, 0.2), patience=0):
                notebook.run(code)
        except TooSlow:
            detail = f"cell {number + 1} runs on and on, and was stopped"
            faults.append((source, {"outcome": TOO_SLOW, "detail": detail}))
        except BaseException as error:
            detail = f"cell {number + 1}: {explain(error, name)}"
            faults.append((source, {"outcome": CRASHED, "detail": detail}))
        left -= time.process_time() - begun
    return module.__dict__, faults


def stub_checks() -> None:
    """Offer `check` and its like, which do nothing here: a submission is asked from outside."""
    checks = types.ModuleType("fgtutor.course.checks")
    for name in STUBBED:
        checks.__dict__[name] = lambda *values, **options: None
    sys.modules["fgtutor.course.checks"] = checks


def answer(
    namespace: dict[str, Any],
    faults: list[tuple[str, dict]],
    name: str,
    cases: list[tuple] | None,
    seconds: float,
    harness: Callable[..., Any] | None = None,
) -> dict[str, Any]:
    """Ask one question; where the name is missing, say which failing cell should have given it."""
    if name not in namespace:
        gives = re.compile(
            rf"^ *(?:async )?(?:(?:def|class) {name}\b|(?:from|import) .*\b{name}\b"
            rf"|(?:\w+, *)*{name}\b[^()\n=]*=(?!=))",
            re.MULTILINE,
        )
        for source, reply in faults:
            if gives.search(source):
                return reply
        return {"outcome": NOT_STARTED, "detail": f"the notebook defines no `{name}`"}
    try:
        return reply_of(namespace[name], cases, seconds, patience=0, harness=harness)
    except BaseException as error:  # whatever a submission raises to get out of here
        return {"outcome": CRASHED, "detail": type(error).__name__}
