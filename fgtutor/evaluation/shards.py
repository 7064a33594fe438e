"""Keeping what an evaluation has finished: one file a task, so that a run can be taken up again.

Reads the tasks of a run and the settings that its rows depend on; gives all rows in the order of
the tasks, wherever and whenever each was done. A report folder holds

    settings.json        what the rows depend on: a run with other settings may not go on in it
    shards/<task>.json   the rows of a finished task, its seconds and its machine

Several machines share the work with `--part 1 2` and `--part 2 2`, each into a folder of its own;
then the same command with `--merge FOLDER FOLDER` has all shards and writes the whole table.
"""

import dataclasses
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from fgtutor import __version__
from fgtutor.errors import ConfigError, ReportError
from fgtutor.evaluation.tasks import Result, Row, Task, run_tasks
from fgtutor.io.storage import LOCK, make_folder, write_json
from fgtutor.io.validation import Count, CountOrZero, NonNegative, check_fields, read_record

T = TypeVar("T")
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
    part: tuple[Count, Count] = (1, 1)
    """Do only this part of the tasks: 2 4 is the second of four."""
    merge: tuple[Path, ...] = ()
    """Report folders of other parts: their finished tasks are taken over."""

    def __post_init__(self) -> None:
        check_fields(self)
        which, of = self.part
        if which > of:
            raise ConfigError(f"part: there is no part {which} of {of}")
        if of > 1 and self.out is None:
            raise ConfigError("a part is of use only in a folder: say --out FOLDER as well")


@dataclass(frozen=True, kw_only=True)
class _Shard:
    """What a shard's file holds: a `Result`, and the settings of its run."""

    settings: dict[str, Any]
    rows: list[Row]
    seconds: NonNegative
    machine: dict[str, Any]

    def __post_init__(self) -> None:
        json.dumps([self.rows, self.machine], allow_nan=False)  # ValueError for no number


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What has been done of an evaluation."""

    tasks: int
    """How many tasks it has."""
    results: tuple[Result, ...]
    """Those that are finished, in the order of the tasks."""

    @property
    def complete(self) -> bool:
        """Whether no task is missing."""
        return len(self.results) == self.tasks

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

    def __repr__(self) -> str:
        return f"{len(self.results)} of {self.tasks} tasks done, in {self.seconds / 3600:.2f} h"


def settings_of(
    config: RunConfig, command: str, *, without: Collection[str] = (), **more: Any
) -> dict[str, Any]:
    """Return what the rows of a command depend on: its config but for the run's own fields, `more`.

    Where the zoo lies is left out, since machines may differ in it: give digests of it instead.
    `without` names other fields that change no row: where every trial has a ground of its own, a
    folder of 100 trials is the beginning of one of 200.
    """
    own = {field.name for field in dataclasses.fields(RunConfig)} | {"json", "zoo", *without}
    fields = {name: value for name, value in asdict(config).items() if name not in own}
    settings = {"command": command, "fgtutor": __version__, **fields, **more}
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
        ReportError: A folder holds a run with other settings, or something else.
        StorageError: A shard could not be written; the ones before it are kept.
        FgtutorError: What `run_tasks` raises.
    """
    done = finished(tasks, settings, config)
    left = [task for task in part_of(tasks, config) if task.name not in done]
    if config.out:
        _open(config.out, settings)
        for task in tasks:  # what came from elsewhere
            if task.name in done and not _shard(config.out, task).exists():
                _keep(config.out, task, done[task.name], settings)
    with tqdm(total=len(left), unit="task", disable=not progress) as bar:
        for task, result in run_tasks(left, workers=config.workers, ray=config.ray):
            if config.out:
                _keep(config.out, task, result, settings)
            done[task.name] = result
            bar.update()
    return Run(tasks=len(tasks), results=tuple(done[t.name] for t in tasks if t.name in done))


def finished(
    tasks: Iterable[Task], settings: dict[str, Any], config: RunConfig
) -> dict[str, Result]:
    """Return the results of the tasks that earlier runs, here or elsewhere, have finished.

    A shard that cannot be read counts as missing: its task is done again. Raises `ReportError` if a
    folder belongs to a run with other settings.
    """
    folders = [*config.merge, *([config.out] if config.out and config.out.exists() else [])]
    for folder in folders:
        _check(folder, settings, new=folder == config.out)
    done = {}
    for folder in folders:
        for task in tasks:
            try:
                shard = read_record(_Shard, _shard(folder, task), ReportError)
            except ReportError:
                continue
            if shard.settings != settings:
                raise ReportError(
                    f"{_shard(folder, task)} comes from a run with other settings: remove it"
                )
            done[task.name] = Result(rows=shard.rows, seconds=shard.seconds, machine=shard.machine)
    return done


def part_of(tasks: Sequence[T], config: RunConfig) -> Sequence[T]:
    """Take every n-th task: neighbours resemble each other in cost, so the parts do too."""
    which, of = config.part
    return tasks[which - 1 :: of]


def _shard(folder: Path, task: Task) -> Path:
    return folder / SHARDS / f"{task.name}.json"


def _keep(folder: Path, task: Task, result: Result, settings: dict[str, Any]) -> None:
    write_json(_shard(folder, task), {"settings": settings, **asdict(result)})


def _open(folder: Path, settings: dict[str, Any]) -> None:
    make_folder(folder / SHARDS)
    if not (folder / SETTINGS).exists():
        write_json(folder / SETTINGS, settings)


def _check(folder: Path, settings: dict[str, Any], *, new: bool) -> None:
    """Raise `ReportError` unless the folder is this run's, or empty where a `new` one may begin."""
    if new and folder.is_dir() and all(path.name == LOCK for path in folder.iterdir()):
        return
    try:
        theirs = read_record(dict[str, Any], folder / SETTINGS, ReportError)
    except ReportError as error:
        raise ReportError(
            f"{folder} is not a report folder ({error}): choose another one"
        ) from error
    if theirs != settings:
        names = sorted(settings.keys() | theirs.keys())
        changes = (
            f"{name if name in settings else repr(name)[:40]} was {theirs.get(name)!r:.200} "
            f"and is {settings.get(name)!r:.200}"
            for name in names
            if theirs.get(name) != settings.get(name)
        )
        raise ReportError(
            f"{folder} holds a run with other settings ({'; '.join(changes)}): repeat its "
            "settings to go on with it, or choose another folder"
        )
