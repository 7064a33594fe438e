"""Keeping what an evaluation has finished: one file per task, so that an interrupted run goes on.

Reads the tasks of a run and the settings that its rows depend on; gives all rows in the order of
the tasks, wherever and whenever each was done. A report folder holds

    settings.json        what the rows depend on: a run with other settings may not go on in it
    shards/<task>.json   the rows of a finished task, its seconds and its machine
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from tqdm import tqdm

from fgtutor import __version__
from fgtutor.errors import ReportError
from fgtutor.evaluation.tasks import Result, Row, Task, run_tasks
from fgtutor.io.storage import LOCK, make_folder, write_json
from fgtutor.io.validation import CountOrZero, NonNegative, check_fields, read_record

SETTINGS, SHARDS = "settings.json", "shards"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Where the tasks of an evaluation run, and where their rows are kept."""

    workers: CountOrZero = 0
    """Processes; 0 takes one per core."""
    ray: str | None = None
    """Address of a Ray cluster to run on instead: HOST:PORT, auto, or local."""
    out: Path | None = None
    """Report folder. Finished tasks are kept in it, and the same command goes on from there."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, kw_only=True)
class _Shard:
    """What a shard's file holds: a `Result`, and the settings of its run."""

    settings: dict[str, Any]
    rows: list[Row]
    seconds: NonNegative
    machine: dict[str, Any]

    def __post_init__(self) -> None:
        json.dumps([self.rows, self.machine], allow_nan=False)  # ValueError for no number


@dataclass(frozen=True, eq=False)
class Run:
    """A finished evaluation."""

    results: Sequence[Result]
    """What each task gave, in the order of the tasks."""

    @property
    def rows(self) -> list[Row]:
        """All rows, in the order of the tasks."""
        return [row for result in self.results for row in result.rows]

    @property
    def seconds(self) -> float:
        """Time that the tasks took, each on one core, s."""
        return sum(result.seconds for result in self.results)

    @property
    def machines(self) -> list[dict[str, Any]]:
        """The different machines that took part."""
        return list({json.dumps(r.machine): r.machine for r in self.results}.values())


def digest(data: bytes) -> str:
    """Return what tells one policy or tensor from another: the first 16 digits of its sha256."""
    return hashlib.sha256(data).hexdigest()[:16]


def settings_of(
    config: RunConfig, command: str, *, without: Collection[str] = (), **more: Any
) -> dict[str, Any]:
    """Return what the rows of a command depend on: its config but for the run's own fields, `more`.

    Where the zoo lies is left out, since machines may differ in it: give digests of it instead.
    `without` names other fields that change no row: where every trial has a ground of its own, a
    folder of 100 trials is the beginning of one of 200.
    """
    own = {field.name for field in fields(RunConfig)} | {"json", "zoo", *without}
    shared = {name: value for name, value in asdict(config).items() if name not in own}
    settings = {"command": command, "fgtutor": __version__, **shared, **more}
    return json.loads(json.dumps(settings, default=str))  # as a file gives it back


def collect(
    tasks: Sequence[Task],
    settings: dict[str, Any],
    config: RunConfig,
    *,
    progress: bool = False,
) -> Run:
    """Do what is left of a run's tasks, keep each as soon as it is finished, and return them all.

    Raises:
        ReportError: The folder holds a run with other settings, or something else.
        StorageError: A shard could not be written; the ones before it are kept.
        FgtutorError: What `run_tasks` raises.
    """
    done = finished(tasks, settings, config)
    left = [task for task in tasks if task.name not in done]
    if config.out:
        make_folder(config.out / SHARDS)
        if not (config.out / SETTINGS).exists():
            write_json(config.out / SETTINGS, settings)
    with tqdm(total=len(left), unit="task", disable=not progress) as bar:
        for task, result in run_tasks(left, workers=config.workers, ray=config.ray):
            if config.out:
                write_json(_shard(config.out, task), {"settings": settings, **asdict(result)})
            done[task.name] = result
            bar.update()
    return Run([done[task.name] for task in tasks])


def finished(
    tasks: Iterable[Task], settings: dict[str, Any], config: RunConfig
) -> dict[str, Result]:
    """Return the results that the report folder holds, by the names of their tasks.

    A shard that cannot be read counts as missing: its task is done again. Raises `ReportError` if
    the folder belongs to a run with other settings, or to something else.
    """
    if config.out is None or not config.out.exists():
        return {}
    _check(config.out, settings)
    done = {}
    for task in tasks:
        path = _shard(config.out, task)
        try:
            shard = read_record(_Shard, path, ReportError)
        except ReportError:
            continue
        if shard.settings != settings:
            raise ReportError(f"{path} comes from a run with other settings: remove it")
        done[task.name] = Result(rows=shard.rows, seconds=shard.seconds, machine=shard.machine)
    return done


def _shard(folder: Path, task: Task) -> Path:
    return folder / SHARDS / f"{task.name}.json"


def _check(folder: Path, settings: dict[str, Any]) -> None:
    """Raise `ReportError` unless the folder is empty or holds a run with these settings."""
    if folder.is_dir() and all(path.name == LOCK for path in folder.iterdir()):
        return
    try:
        theirs = read_record(dict[str, Any], folder / SETTINGS, ReportError)
    except ReportError as error:
        raise ReportError(
            f"{folder} is not a report folder ({error}): choose another one"
        ) from error
    if theirs != settings:
        changes = (
            f"{name if name in settings else repr(name)[:40]} was {theirs.get(name)!r:.200} "
            f"and is {settings.get(name)!r:.200}"
            for name in sorted(settings.keys() | theirs.keys())
            if theirs.get(name) != settings.get(name)
        )
        raise ReportError(
            f"{folder} holds a run with other settings ({'; '.join(changes)}): repeat its "
            "settings to go on with it, or choose another folder"
        )
