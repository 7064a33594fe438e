"""Running an evaluation as many small tasks: on this machine's cores, or on a Ray cluster.

Reads tasks, each a function of a module and plain arguments; gives every task's rows as soon as it
has finished. A task's rows depend on its arguments only, so the order, the place and the number of
workers change nothing. A worker that vanishes (killed, out of memory) costs its task one more try.
"""

import os
import pickle
import signal
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import connection, get_context, parent_process
from typing import Any

from tqdm import tqdm

from fgtutor.errors import ConfigError, EvaluationError, FgtutorError, MissingExtraError
from fgtutor.evaluation.provenance import machine
from fgtutor.io.machine import usable_cores

Row = dict[str, Any]
"""One trial, as JSON keeps it."""
ATTEMPTS = 3
"""A task that has taken down this many workers is not tried again."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A part of an evaluation that can be done anywhere, at any time."""

    name: str
    """Unlike any other task's; it names the file that keeps the rows."""
    function: Callable[..., list[Row]]
    """Computes the rows from the arguments alone; workers import it from its module."""
    arguments: tuple[Any, ...] = ()
    """What it is called with; they are pickled."""
    cores: int = 1
    """Cores that it takes of a Ray cluster; on this machine, `workers` says how many share it."""
    gpus: int = 0
    """GPUs that it takes of a Ray cluster."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of a task."""

    rows: list[Row]
    """One a trial."""
    seconds: float
    """How long it took, s."""
    machine: dict[str, Any] = field(default_factory=dict)
    """Where it ran, with which versions."""


@dataclass(frozen=True, kw_only=True)
class _Failure:
    """An exception on its way from a worker."""

    error: FgtutorError | None
    """Set if fgtutor raised it on purpose."""
    trace: str
    """How it came about."""


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
    if ray is not None:
        yield from _on_ray(tasks, ray)
        return
    workers = min(workers or usable_cores(), len(tasks))
    if workers > 1:
        yield from _on_processes(tasks, workers)
        return
    for task in tasks:
        yield task, _unwrap(task, _work(pickle.dumps(task)))


def _work(pickled: bytes) -> Result | _Failure:
    """Do one task; what it raises is returned, so that it reaches the caller."""
    try:
        task: Task = pickle.loads(pickled)
        began = time.perf_counter()
        with _one_thread():
            rows = task.function(*task.arguments)
        return Result(rows=rows, seconds=time.perf_counter() - began, machine=machine())
    except Exception as error:
        expected = error if isinstance(error, FgtutorError) else None
        return _Failure(error=expected, trace=traceback.format_exc())


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one thread: a task has one core, and sums then round alike everywhere."""
    torch = sys.modules.get("torch")  # if a task needs it, unpickling the task has imported it
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _unwrap(task: Task, outcome: Result | _Failure) -> Result:
    if isinstance(outcome, Result):
        return outcome
    if outcome.error is not None:
        raise outcome.error
    raise EvaluationError(
        f"task {task.name} failed; the finished ones are kept, correct this and run again:\n"
        f"{outcome.trace}"
    )


def _lost(task: Task, how: str) -> EvaluationError:
    return EvaluationError(
        f"task {task.name} took its worker down {ATTEMPTS} times ({how}): look for what kills "
        "it (exit code -9 often means that memory ran out: take fewer workers); the finished "
        "tasks are kept, run again to go on"
    )


class _Worker:
    """A process that does one task after another, and the line to it."""

    def __init__(self) -> None:
        # Spawned, not forked: torch's threads do not survive a fork.
        context = get_context("spawn")
        self.line, theirs = context.Pipe()
        # A daemon is stopped when this process ends; if it is killed, the worker sees to that.
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _safe_path():
            self.process.start()
        theirs.close()  # or the end of the worker would not be the end of the line
        self.task: Task | None = None

    def give(self, task: Task) -> None:
        """Hand over a task; if the worker has died meanwhile, reading its answer will tell."""
        self.task = task
        with suppress(OSError):
            self.line.send_bytes(pickle.dumps(task))

    def stop(self) -> None:
        """End the process: with a farewell if it waits, without one if it is at work."""
        self.line.close()
        if self.task is None:
            self.process.join(timeout=5.0)
        self.process.terminate()
        self.process.join()


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


def _serve(line: connection.Connection) -> None:
    """Do the tasks that come down the line, until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asked
    # Its default is one between processes, which a process that is stopped leaves behind.
    tqdm.set_lock(threading.RLock())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            line.send(_work(line.recv_bytes()))


def _end_with_parent() -> None:
    """End this process as soon as the one that asked has, even in the middle of a task."""
    if parent := parent_process():
        parent.join()
        os._exit(1)


def _on_processes(tasks: Sequence[Task], workers: int) -> Iterator[tuple[Task, Result]]:
    waiting, deaths = deque(tasks), Counter[str]()
    team = [_Worker() for _ in range(workers)]
    try:
        while waiting or any(worker.task for worker in team):
            for worker in team:
                if worker.task is None and waiting:
                    worker.give(waiting.popleft())
            busy = [(worker, worker.task) for worker in team if worker.task]
            ready = connection.wait([worker.line for worker, _ in busy])
            for worker, task in busy:
                if worker.line not in ready:
                    continue
                worker.task = None
                try:
                    outcome = worker.line.recv()
                except (EOFError, OSError):
                    worker.stop()
                    deaths[task.name] += 1
                    if deaths[task.name] == ATTEMPTS:
                        how = f"the last time with exit code {worker.process.exitcode}"
                        raise _lost(task, how) from None
                    team[team.index(worker)] = _Worker()
                    waiting.appendleft(task)
                    continue
                yield task, _unwrap(task, outcome)
    finally:
        # Whoever is at work first: the others take their leave, and meanwhile it would go on.
        for worker in sorted(team, key=lambda worker: worker.task is None):
            worker.stop()


def _on_ray(tasks: Sequence[Task], address: str) -> Iterator[tuple[Task, Result]]:
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
        # Ray itself does a task again whose worker vanished.
        remote = ray.remote(max_retries=ATTEMPTS - 1)(_work)
        running = {
            remote.options(num_cpus=task.cores, num_gpus=task.gpus).remote(pickle.dumps(task)): task
            for task in tasks
        }
        while running:
            (done,), _ = ray.wait(list(running), num_returns=1)
            task = running.pop(done)
            try:
                outcome = ray.get(done)
            except ray.exceptions.RayError as error:
                raise _lost(task, str(error)) from error
            yield task, _unwrap(task, outcome)
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
