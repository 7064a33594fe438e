"""Running an evaluation as many small tasks: on this machine's cores, or on a Ray cluster.

Reads tasks, each a function of a module and plain arguments; gives every task's rows as soon as it
has finished. A task's rows depend on its arguments only, so the order, the place and the number of
workers change nothing. A worker that dies (killed, out of memory) costs its own task another try.
"""

import os
import pickle
import platform
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import version
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool
from tqdm import tqdm

from fgtutor import __version__
from fgtutor.errors import ConfigError, EvaluationError, FgtutorError, MissingExtraError
from fgtutor.io.machine import one_thread, usable_cores

Row = dict[str, Any]
"""One trial, as JSON keeps it."""
ATTEMPTS = 3
"""A task that has taken down this many workers is not tried again."""
PACKAGES = ("torch", "numpy", "scipy", "rsl-rl-lib", "pymunk", "mujoco")
"""Whose versions may change a result."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A part of an evaluation that can be done anywhere, at any time."""

    name: str
    """Unlike any other task's; it names the file that keeps the rows."""
    function: Callable[..., list[Any]]
    """Computes the rows from the arguments alone; workers import it from its module."""
    arguments: tuple[Any, ...] = ()
    """What it is called with; they are pickled."""
    cores: int = 1
    """Cores that it takes of a Ray cluster; on this machine, `workers` says how many share it."""
    gpus: int = 0
    """GPUs that it takes of a Ray cluster."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a task gave."""

    rows: list[Row]
    """One per trial."""
    seconds: float
    """How long it took, s."""
    machine: dict[str, Any] = field(default_factory=dict)
    """Where it ran, with which versions."""


Submit = Callable[[Task], Future[Result | FgtutorError]]
"""Hands a task to a worker; its future raises only if that worker dies."""


def run_tasks(
    tasks: Sequence[Task], *, workers: int = 0, ray: str | None = None
) -> Iterator[tuple[Task, Result]]:
    """Run tasks and give each with its result, in the order in which they finish.

    Tasks run on `workers` processes (0: one per core; 1: in this process), or on the Ray cluster at
    the address `ray`, where fgtutor must be installed in the same version.

    Raises:
        EvaluationError: A task raised something unexpected, or its worker died `ATTEMPTS` times.
        FgtutorError: What a task raised on purpose, as it is.
        MissingExtraError: `ray` is given, but Ray is not installed.
        ConfigError: No Ray cluster answers at that address, or none of its machines has the cores
            or GPUs that a task takes.
    """
    at_once = len(tasks) if ray is not None else min(workers or usable_cores(), len(tasks))
    if ray is not None:
        place = _ray_cluster(ray, tasks)
    elif at_once > 1:
        place = _processes(at_once)
    else:
        place = nullcontext(_do_here)
    with place as submit:
        yield from _finished(tasks, submit, at_once)


def _do_here(task: Task) -> Future[Result | FgtutorError]:
    done = Future()
    done.set_result(_work(task.name, pickle.dumps(task)))
    return done


def _work(name: str, pickled: bytes) -> Result | FgtutorError:
    """Do the task `name`; what it raises is returned, so that every kind of worker gives it alike.

    It comes pickled, so that a worker accepts it before importing what it needs.
    """
    try:
        task: Task = pickle.loads(pickled)
        began = time.perf_counter()
        # A task has one core. If it needs torch, unpickling it has imported torch.
        with one_thread() if "torch" in sys.modules else nullcontext():
            rows = task.function(*task.arguments)
        return Result(rows=rows, seconds=time.perf_counter() - began, machine=machine())
    except FgtutorError as error:
        return error
    except Exception:
        return EvaluationError(
            f"task {name} failed; the finished ones are kept, correct this and run again:\n"
            f"{traceback.format_exc()}"
        )


def _finished(tasks: Sequence[Task], submit: Submit, at_once: int) -> Iterator[tuple[Task, Result]]:
    """Submit tasks, `at_once` at a time, and yield each with its result when it is done."""
    waiting, deaths = deque(tasks), Counter[str]()
    running: dict[Future[Result | FgtutorError], Task] = {}
    while waiting or running:
        while waiting and len(running) < at_once:
            task = waiting.popleft()
            running[submit(task)] = task
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            task = running.pop(future)
            if death := future.exception():
                deaths[task.name] += 1
                if deaths[task.name] == ATTEMPTS or isinstance(death, BrokenProcessPool):
                    raise _lost(task, deaths[task.name], death)
                waiting.appendleft(task)
                continue
            outcome = future.result()
            if isinstance(outcome, FgtutorError):
                raise outcome
            yield task, outcome


def _lost(task: Task, attempt: int, death: BaseException) -> EvaluationError:
    how = f"exit code {death.exitcode}" if isinstance(death, ProcessExpired) else str(death)
    return EvaluationError(
        f"task {task.name} lost its worker on attempt {attempt} of {ATTEMPTS} ({how}): look for "
        "what ends it (exit code -9 often means that memory ran out: take fewer workers); the "
        "finished tasks are kept, run again to go on"
    )


@contextmanager
def _processes(workers: int) -> Iterator[Submit]:
    """Offer processes of this machine, which end with the block, even in the middle of a task."""
    # Spawned, not forked: torch's threads do not survive a fork.
    pool = ProcessPool(workers, initializer=_prepare_worker, context=get_context("spawn"))
    with _safe_path():
        try:
            yield lambda task: pool.schedule(_work, (task.name, pickle.dumps(task)))
        finally:
            pool.stop()
            pool.join()


def _prepare_worker() -> None:
    """Let this process end at once if it is told to, or if the one that asked has ended."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # The default is a lock between processes, which a process that is stopped leaves behind.
    tqdm.set_lock(threading.RLock())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let a Python started in the block take no module from the current folder.

    multiprocessing starts its own with `-c`, which would look there first, even for Python's own.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        del os.environ["PYTHONSAFEPATH"]
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _ray_cluster(address: str, tasks: Sequence[Task]) -> Iterator[Submit]:
    """Offer the workers of a Ray cluster, which must be able to do the tasks."""
    try:
        ray = import_module("ray")
    except ImportError as error:
        raise MissingExtraError(
            "running on a cluster needs Ray, which is not installed here: in the clone of fgtutor "
            'pip install -c constraints.txt -e ".[cluster]", or leave out --ray to use this '
            "machine's cores"
        ) from error
    try:
        ray.init(address=address, log_to_driver=False)
    except Exception as error:  # Ray raises whatever it meets, bare Exception included
        raise ConfigError(
            f"no Ray cluster answers at {address!r} ({error}): start one with `ray start --head`, "
            "or say --ray local for one on this machine only"
        ) from error
    try:
        _check_cluster([node["Resources"] for node in ray.nodes() if node["Alive"]], tasks)
        remote = ray.remote(max_retries=0)(_work)  # `_finished` tries again
        yield (
            lambda task: (
                remote.options(num_cpus=task.cores, num_gpus=task.gpus)
                .remote(task.name, pickle.dumps(task))
                .future()
            )
        )
    finally:
        ray.shutdown()


def _check_cluster(machines: Sequence[dict[str, float]], tasks: Sequence[Task]) -> None:
    """Raise `ConfigError` if a task takes more than any machine has: Ray would wait for ever."""
    for task in tasks:
        if task.cores == 1 and not task.gpus:  # any machine will do, also one that is yet to join
            continue
        if not any(
            machine.get("CPU", 0) >= task.cores and machine.get("GPU", 0) >= task.gpus
            for machine in machines
        ):
            raise ConfigError(
                f"task {task.name} takes {task.cores} cores and {task.gpus} GPUs, more than any "
                f"of the cluster's {len(machines)} machines has: ask for fewer, or let a larger "
                "machine join"
            )


@cache
def machine() -> dict[str, Any]:
    """Return this machine's processor, cores and system, and the versions of what computes here.

    Not its name: a report may be published.
    """
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {
            "fgtutor": __version__,
            "python": platform.python_version(),
            **{package: version(package) for package in PACKAGES},
        },
    }


def _processor() -> str:
    """Return the processor's name; Linux tells it only in a file."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
