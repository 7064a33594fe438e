"""Many trainings side by side: terrains, seeds and the values of one setting, compared.

Reads a training's settings and what to vary; trains a specialist for each combination, drives it
over held-out terrain with its own plan, and gives a row per crossing. A training is a task, so
cores or a Ray cluster share them. Its run folder lies in the report folder; a worker that is killed
costs the time since the training's last checkpoint, and not a bit of the result.
"""

import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Interval, MinLen
from pydantic import TypeAdapter, ValidationError
from tqdm import tqdm

from fgtutor.baselines import single
from fgtutor.errors import ConfigError, EvaluationError, FgtutorError, SpecialistError
from fgtutor.evaluation import calibration, report
from fgtutor.evaluation.calibration import CalibrationConfig
from fgtutor.evaluation.cost import Cost
from fgtutor.evaluation.report import Findings, markdown
from fgtutor.evaluation.shards import RunConfig, digest, settings_of
from fgtutor.evaluation.success import TrialsConfig, cut, make_ground
from fgtutor.evaluation.tasks import Row, Task
from fgtutor.evaluation.trials import by_cell, drive
from fgtutor.io.machine import usable_cores
from fgtutor.io.storage import make_folder
from fgtutor.io.validation import Seed, Unique
from fgtutor.learning import training
from fgtutor.learning.config import A1TrainConfig, TrainConfig, comparable, training_world
from fgtutor.learning.trainer import CHECKPOINT, Trainer, give_back_memory
from fgtutor.robots import ROBOTS, env_class
from fgtutor.specialist import DESCRIPTION, GENERAL, Specialist, load_specialist
from fgtutor.statistics import Share
from fgtutor.statistics import calibration as compare

COMMAND, RUNS = "sweep", "runs"
"""Its name, and where in the report folder the run folders lie."""
WATCH_SECONDS = 10.0
"""How often the progress bar looks into the run folders, s."""
CELL = ("trained_on", "setting", "training_seed")
"""What tells the crossings of one training from those of another."""
SET_BY_SWEEP = {
    "robot": "--robot",
    "terrain": "--terrains",
    "seed": "--seeds",
    "out": "--out",
    "resume": "the same command, which goes on by itself",
    "hours": "--train.iterations, since a table must not depend on a machine's speed",
}
"""Settings of a training that a sweep sets, and what to use instead."""


@dataclass(frozen=True, kw_only=True)
class SweepConfig(RunConfig):
    """Train a specialist for every terrain, seed and value of a setting, and compare them."""

    out: Path | None = Path("runs/sweep")
    """Report folder; each training has its run folder in `runs`. The same command goes on from
    there: more terrains, seeds or values train only the new ones, other `trials` train none."""
    robot: str = "toy"
    """Which robot."""
    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Terrains to specialise in; default: the robot's own."""
    seeds: Annotated[tuple[Seed, ...], MinLen(1), Unique] = (1, 2, 3)
    """Seeds of the trainings."""
    vary: tuple[str, ...] = ()
    """One more thing to vary: an option of `fgtutor train` and its values, as in `learning-rate
    1e-3 3e-4`."""
    trials: Annotated[int, Interval(ge=1, le=100_000)] = 50
    """Held-out terrains of full difficulty that each specialist then crosses."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """What all trainings share, as for `fgtutor train`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.out is None:
            raise ConfigError("trainings keep their checkpoints in a folder: give --out FOLDER")
        shared, default = self.train, type(self.train)()
        if shared.robot == self.robot:
            shared = replace(shared, robot=default.robot)
        for name in SET_BY_SWEEP:
            if getattr(shared, name) != getattr(default, name):
                raise _set_by_sweep(name)
        if len(self.vary) == 1:
            raise ConfigError(f"nothing to vary {self.option} by: give its values too")
        if self.option in SET_BY_SWEEP:
            raise _set_by_sweep(self.option)
        if self.option in ("from", "start-from", "start_from"):
            raise ConfigError("all trainings of a sweep start alike: a sweep for each --train.from")

    @property
    def option(self) -> str:
        """The option of `fgtutor train` that is varied, or nothing."""
        return self.vary[0] if self.vary else ""

    @property
    def folder(self) -> Path:
        """The report folder, from wherever a worker looks at it."""
        return Path(self.out or "").resolve()


@dataclass(frozen=True, kw_only=True)
class A1SweepConfig(SweepConfig):
    """The same with the A1's sizes: about an hour of one core per training."""

    robot: str = "a1"
    train: TrainConfig = field(default_factory=A1TrainConfig)


def config_of(words: Sequence[str]) -> type[SweepConfig]:
    """Return the config class for command line `words`, which may hold `--robot NAME`.

    Raises `ConfigError` if they set what the sweep itself sets, even to the default.
    """
    for word in words:
        name = word.partition("=")[0].removeprefix("--train.").replace("-", "_")
        if word.startswith("--train.") and name in SET_BY_SWEEP:
            raise _set_by_sweep(name)
    return A1SweepConfig if training.config_of(words) is A1TrainConfig else SweepConfig


def _set_by_sweep(name: str) -> ConfigError:
    return ConfigError(f"a sweep sets {name} of its trainings: use {SET_BY_SWEEP[name]}")


def trainings(config: SweepConfig) -> dict[str, tuple[str, TrainConfig]]:
    """Return each training's varied value and settings by its name, in the table's order.

    Raises `ConfigError` if a value does not fit, or two trainings would be the same.
    """
    env_class(config.robot)  # an unknown robot fails here
    terrains, start = config.terrains or ROBOTS[config.robot].scale.mixed, config.train.start_from
    shared = replace(config.train, robot=config.robot, start_from=start and start.resolve())
    for terrain in terrains:  # as does an unknown terrain
        training_world(replace(shared, terrain=terrain, rows=1, columns=1))
    option, values = config.option, config.vary[1:] or ("",)
    varied = {value: _with(shared, option, value) if option else shared for value in values}
    found = {}
    for terrain, value, seed in product(terrains, values, config.seeds):
        setting = f"{option}-{re.sub(r'[^A-Za-z0-9.+-]', '_', value)}" if option else ""
        name = "-".join(filter(None, (terrain, setting, str(seed))))
        if name in found:
            raise ConfigError(f"asked twice for {name}: give each value once")
        own = replace(varied[value], terrain=terrain, seed=seed, out=config.folder / RUNS / name)
        found[name] = value, own
    return found


def _with(config: TrainConfig, option: str, value: str) -> TrainConfig:
    """Return the settings with one of them as the command line's words give it."""
    name = option.replace("-", "_")
    kind = get_type_hints(type(config)).get(name)
    if kind is None:
        raise ConfigError(f"cannot vary {option}: `fgtutor train --help` says what can be set")
    several = tuple in [get_origin(one) for one in (kind, *get_args(kind))]  # perhaps or None
    words = value.split() if several else value
    try:
        read = TypeAdapter(kind).validate_python(words)
    except ValidationError as error:
        raise ConfigError(
            f"cannot train with --{option} {value}: {error.errors()[0]['msg']}"
        ) from None
    return replace(config, **{name: read})


def make_tasks(config: SweepConfig) -> list[Task]:
    """Return a task per training, with the cores and the GPU that it takes."""
    return [
        Task(
            name=f"{name}-crossed-{config.trials}",
            function=run_task,
            arguments=(name, value, train, config.trials),
            cores=train.threads,
            gpus=int(train.device.startswith("cuda")),
        )
        for name, (value, train) in trainings(config).items()
    ]


def run_task(name: str, value: str, config: TrainConfig, trials: int) -> list[Row]:
    """Do one task: train, or go on where a worker was lost, then cross held-out terrain."""
    resume = (config.folder / CHECKPOINT).exists()
    try:
        training.train(replace(config, resume=resume), attended=False)
        # As a zoo would: on the CPU, wherever it was trained.
        specialist = load_specialist(config.folder / "specialist")
        known = {"training": name, "trained_on": config.terrain, "setting": value}
        known |= {"training_seed": config.seed, "samples": specialist.provenance["samples"]}
        return _crossings(specialist, config, trials, known)
    except FgtutorError as error:
        raise EvaluationError(
            f"training {name}: {error} (the others are kept: correct this, or leave it out, and "
            "run again)"
        ) from error


def _crossings(specialist: Specialist, config: TrainConfig, trials: int, known: Row) -> list[Row]:
    """Return a row per crossing of held-out terrain, driven as by `fgtutor evaluate matrix`."""
    robot, terrain = config.robot, config.terrain
    kinds = ROBOTS[robot].scale.mixed if terrain == GENERAL else (terrain,)
    free = CalibrationConfig(robot=robot, envs=trials)
    drives = [calibration.drive(specialist, kind, free) for kind in kinds]
    each = (calibration.promised(specialist, driven) for driven in drives)
    predicted, measured = map(np.concatenate, zip(*each, strict=True))
    _, error = compare(predicted, measured)
    known |= {"r_v": round(float(measured.mean()), 4), "calibration_error": round(error, 4)}
    crossings = TrialsConfig(robot=robot, trials=trials)
    planned = {specialist.name: partial(single, specialist.name)}
    rows = []
    for indices in cut(trials):
        grounds = [make_ground(crossings, kinds[i % len(kinds)], i) for i in indices]
        driven = drive(grounds, planned, {specialist.name: specialist}, settings=crossings.planning)
        rows += [known | trial.row for trial in driven]
    return rows


def estimate(config: SweepConfig) -> Cost:
    """Measure the second iteration of a training for each value, and work out what all take.

    That is done on the CPU, here: a cluster's GPU may be elsewhere. Raises what a training would if
    a value does not fit the others, before hours have gone into them.
    """
    works = trainings(config).values()
    samples, seconds = 0, 0.0
    for value in dict.fromkeys(value for value, _ in works):
        same = [train for own, train in works if own == value]
        trainer = Trainer(replace(same[0], device="cpu"))
        first, second = (trainer.iterate()["seconds"] for _ in range(2))
        del trainer  # this process only waits from here on, and a world of A1s is large
        give_back_memory()
        iterations = len(same) * same[0].iterations
        samples += iterations * same[0].num_envs * same[0].steps
        seconds += iterations * (second - first)
    many = "1 training" if len(works) == 1 else f"{len(works)} trainings"
    return Cost(
        work=f"{many} with {samples:,} samples, at least", seconds=seconds, parts=len(works)
    )


def table(rows: Sequence[Row], option: str = "") -> str:
    """Return the crossings as Markdown: a line per terrain and value, a column per seed."""
    cells = by_cell(rows, CELL)
    seeds = list(dict.fromkeys(seed for _, _, seed in cells))
    lines = []
    for terrain, value in dict.fromkeys((terrain, value) for terrain, value, _ in cells):
        own = [cells[terrain, value, seed] for seed in seeds]
        shares = [Share.reached(crossings) for crossings in own]
        mean = fmean(share.successes / share.trials for share in shares)
        r_v = fmean(crossings[0]["r_v"] for crossings in own)
        error = fmean(crossings[0]["calibration_error"] for crossings in own)
        line = [
            f"{own[0][0]['samples']:,}",
            *shares,
            f"{100 * mean:.1f}",
            f"{r_v:.3f}",
            f"{error:.3f}",
        ]
        lines.append([terrain, value, *line] if option else [terrain, *line])
    names = ["samples", *(f"seed {seed}" for seed in seeds), "mean", "r_v", "calibration error"]
    return markdown(["terrain", option, *names] if option else ["terrain", *names], lines)


def run(config: SweepConfig) -> int:
    """Train from the command line, print the table and write the report."""
    option, tasks, settings = config.option, make_tasks(config), _settings(config)
    title = f"Trainings side by side ({config.robot})"
    iterations = "" if option == "iterations" else f", {config.train.iterations} iterations"

    def find(rows: list[Row]) -> Findings:
        groups: dict[str, dict[str, Share]] = {}
        for (terrain, setting, seed), crossings in by_cell(rows, CELL).items():
            group = " ".join(filter(None, (terrain, option, setting)))
            groups.setdefault(group, {})[f"seed {seed}"] = Share.reached(crossings)
        return Findings(
            table=table(rows, option),
            caption=f"Success in % with 95 % intervals, {config.trials} crossings of held-out "
            f"terrain per training, each with its own plan; r_v and calibration error there are "
            f"means over the seeds; robot {config.robot}{iterations}; undisturbed, but r_v and "
            "calibration error under the usual disturbances of training.",
            figures={"success.svg": report.shares_chart(groups, title)},
        )

    make_folder(config.folder)
    print(f"the curves, while they train: tensorboard --logdir {config.folder / RUNS}")
    return report.run_and_report(
        # A training's own threads are cores that no other one has.
        replace(config, workers=config.workers or max(1, usable_cores() // config.train.threads)),
        title=title,
        tasks=tasks,
        settings=settings,
        cost=partial(estimate, config),
        find=find,
        watched=_progress([train for _, train in trainings(config).values()]),
    )


@contextmanager
def _progress(runs: Sequence[TrainConfig]) -> Iterator[None]:
    """Show how far the trainings are, wherever they run, by the snapshots in their run folders."""
    over, total = threading.Event(), sum(run.iterations for run in runs)

    def watch() -> None:
        if over.wait(WATCH_SECONDS):  # nothing was left to train
            return
        with tqdm(total=total, initial=_iterations(runs), unit="it", desc="trained") as bar:
            while not over.wait(WATCH_SECONDS):
                bar.update(_iterations(runs) - bar.n)
            bar.update(_iterations(runs) - bar.n)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _iterations(runs: Sequence[TrainConfig]) -> int:
    """Return the iterations of the last snapshots in the run folders, in all."""
    snapshots = (run.folder.glob("snapshots/[0-9]*") for run in runs)
    return sum(max((int(path.name) for path in paths), default=0) for paths in snapshots)


def _settings(config: SweepConfig) -> dict[str, Any]:
    """Return what a training's crossings depend on, but for what tells the trainings apart.

    Raises `SpecialistError` if there is nothing where they are to start from.
    """
    shared, start, told = comparable(config.train), config.train.start_from, None
    for name in ("robot", "terrain", "seed", "start_from"):
        del shared[name]
    if start:
        files = [start / name for name in (CHECKPOINT, DESCRIPTION) if (start / name).is_file()]
        if not files:
            raise SpecialistError(f"{start} holds no specialist to start from: give another folder")
        told = digest(files[0].read_bytes())
    return settings_of(
        config,
        COMMAND,
        without=("terrains", "seeds", "vary", "trials", "train"),
        vary=config.vary[:1],
        start=told,
        **{f"train.{name}": value for name, value in shared.items()},
    )
