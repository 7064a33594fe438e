"""Many trainings side by side: terrains, seeds and the values of one setting, compared.

Reads a training's settings and what to vary; trains a specialist each, drives it over held-out
terrain with its own plan, and gives a row a crossing. A training is a task of the runner, so cores,
a Ray cluster or machines with a part each share them. Its run folder lies in the report folder;
a worker that is killed in it costs the time since the last checkpoint, and not a bit of the result.
"""

import contextlib
import io
import math
import re
import threading
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval, MinLen
from tqdm import tqdm

from fgtutor.baselines import single
from fgtutor.errors import ConfigError, EvaluationError, FgtutorError, SpecialistError
from fgtutor.evaluation import calibration, report
from fgtutor.evaluation.calibration import CalibrationConfig
from fgtutor.evaluation.cost import on_cores
from fgtutor.evaluation.report import Findings, markdown
from fgtutor.evaluation.shards import RunConfig, digest, settings_of
from fgtutor.evaluation.success import TrialsConfig, by_cell, cut, make_ground
from fgtutor.evaluation.tasks import Row, Task
from fgtutor.evaluation.trials import drive
from fgtutor.figures.charts import draw_shares
from fgtutor.io.machine import usable_cores
from fgtutor.io.storage import make_folder
from fgtutor.io.validation import Seed, Unique, parse_options
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
"""How often to look how far they are, s."""
OURS_TO_SET = {
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
    """Report folder, with a run folder a training in `runs`. The same command goes on from there;
    with more terrains, seeds or values only the new ones are trained, and with other `trials`
    none."""
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
        untouched = type(self.train)()
        for name in OURS_TO_SET:
            given = getattr(self.train, name)
            if given != getattr(untouched, name) and (name, given) != ("robot", self.robot):
                raise _set_elsewhere(name)
        if len(self.vary) == 1:
            raise ConfigError(f"nothing to vary {self.vary[0]} by: give its values too")
        name = self.vary[0].replace("-", "_") if self.vary else ""
        if name in OURS_TO_SET:
            raise _set_elsewhere(name)
        if name in ("from", "start_from"):
            raise ConfigError("all trainings of a sweep start alike: a sweep for each --train.from")

    @property
    def folder(self) -> Path:
        """The report folder, from wherever a worker looks at it."""
        return Path(self.out or "").resolve()


@dataclass(frozen=True, kw_only=True)
class A1SweepConfig(SweepConfig):
    """The same with the A1's sizes: about an hour of one core a training."""

    robot: str = "a1"
    train: TrainConfig = field(default_factory=A1TrainConfig)


def config_of(words: Sequence[str]) -> type[SweepConfig]:
    """Return the config class for command line `words`, which may hold `--robot NAME`.

    Raises `ConfigError` if they set what the sweep itself sets, were it to the default.
    """
    for word in words:
        name = word.partition("=")[0].removeprefix("--train.").replace("-", "_")
        if word.startswith("--train.") and name in OURS_TO_SET:
            raise _set_elsewhere(name)
    return A1SweepConfig if training.config_of(words) is A1TrainConfig else SweepConfig


def _set_elsewhere(name: str) -> ConfigError:
    return ConfigError(f"a sweep sets {name} of its trainings: use {OURS_TO_SET[name]}")


@dataclass(frozen=True, kw_only=True)
class Training:
    """One training of a sweep."""

    name: str
    """Unlike any other's; it names the run folder."""
    setting: str
    """The value of what is varied, or nothing."""
    config: TrainConfig
    """All its settings."""


def trainings(config: SweepConfig) -> list[Training]:
    """Return the trainings of a sweep, in the table's order.

    Raises `ConfigError` if a value does not fit, or two trainings would be the same.
    """
    env_class(config.robot)  # an unknown robot fails here
    terrains, start = config.terrains or ROBOTS[config.robot].scale.mixed, config.train.start_from
    shared = replace(config.train, robot=config.robot, start_from=start and start.resolve())
    for terrain in terrains:  # as does an unknown terrain
        training_world(replace(shared, terrain=terrain, rows=1, columns=1))
    option, *values = config.vary or ("", "")
    varied = {value: _with(shared, option, value) if option else shared for value in values}
    everyone = []
    for terrain, value, seed in product(terrains, values, config.seeds):
        setting = f"{option}-{re.sub(r'[^A-Za-z0-9.+-]', '_', value)}" if option else ""
        name = "-".join(filter(None, (terrain, setting, str(seed))))
        own = replace(varied[value], terrain=terrain, seed=seed, out=config.folder / RUNS / name)
        everyone.append(Training(name=name, setting=value, config=own))
    names = [each.name for each in everyone]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ConfigError(f"asked twice for {', '.join(sorted(twice))}: give each value once")
    return everyone


def _with(config: TrainConfig, option: str, value: str) -> TrainConfig:
    """Return the settings with one of them read from the command line's words for it."""
    words, said = [f"--{option}", *value.split()], io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return parse_options(type(config), words, "fgtutor train", config)
    except SystemExit as error:
        lines = (line.strip("│ ") for line in said.getvalue().splitlines() if "│" in line)
        why = next(lines, "there is no such option")
        raise ConfigError(
            f"cannot train with {' '.join(words)} ({why}): `fgtutor train --help` says what can be"
        ) from error


def run_task(work: Training, trials: int) -> list[Row]:
    """Do one task: train, or go on where a worker was lost, then cross held-out terrain."""
    resume = (work.config.folder / CHECKPOINT).exists()
    try:
        training.train(replace(work.config, resume=resume), attended=False)
        # As a zoo would: on the CPU, wherever it was trained.
        return _crossings(work, load_specialist(work.config.folder / "specialist"), trials)
    except FgtutorError as error:
        raise EvaluationError(
            f"training {work.name}: {error} (the others are kept: correct this, or leave it out, "
            "and run again)"
        ) from error


def _crossings(work: Training, specialist: Specialist, trials: int) -> list[Row]:
    """Return a row a crossing of held-out terrain, as `fgtutor evaluate matrix` would drive it."""
    config = work.config
    kinds = ROBOTS[config.robot].scale.mixed if config.terrain == GENERAL else (config.terrain,)
    known = {
        "training": work.name,
        "trained_on": config.terrain,
        "setting": work.setting,
        "training_seed": config.seed,
        "samples": specialist.provenance["samples"],
        **_tracking(specialist, kinds, trials),
    }
    crossings = TrialsConfig(robot=config.robot, trials=trials)
    rows = []
    for indices in cut(trials):
        grounds = [make_ground(crossings, kinds[i % len(kinds)], i) for i in indices]
        planned = {specialist.name: partial(single, specialist.name)}
        driven = drive(grounds, planned, {specialist.name: specialist}, settings=crossings.planning)
        rows += [known | asdict(trial) for trial in driven]
    return rows


def _tracking(specialist: Specialist, kinds: Sequence[str], envs: int) -> dict[str, float]:
    """Return the mean r_v on held-out terrain, and how far its prediction is from it."""
    config = CalibrationConfig(robot=specialist.robot, envs=envs)
    drives = [calibration.drive(specialist, kind, config) for kind in kinds]
    measured = np.concatenate([drive.measured for drive in drives])
    _, error = compare(np.concatenate([drive.predicted for drive in drives]), measured)
    return {"r_v": round(float(measured.mean()), 4), "calibration_error": round(error, 4)}


def make_tasks(works: Sequence[Training], trials: int) -> list[Task]:
    """Return a task a training, with the cores and the GPU that it takes."""
    return [
        Task(
            name=f"{each.name}-crossed-{trials}",
            function=run_task,
            arguments=(each, trials),
            cores=each.config.threads,
            gpus=int(each.config.device.startswith("cuda")),
        )
        for each in works
    ]


@dataclass(frozen=True, kw_only=True)
class TrainingCost:
    """What the trainings take, if all stay as fast as they begin."""

    trainings: int
    samples: int
    """Of all trainings."""
    seconds: float
    """Of all trainings one after the other, s."""

    def on(self, cores: int) -> str:
        """Say it, for a number of trainings at a time."""
        rounds = math.ceil(self.trainings / cores)
        return (
            f"{self.trainings} training{'s' * (self.trainings > 1)} with {self.samples:,} samples, "
            f"at least {on_cores(self.seconds / self.trainings * rounds * cores, cores)}"
        )


def estimate(works: Sequence[Training]) -> TrainingCost:
    """Measure the second iteration of a training for each value, and work out what all take.

    That is done on the CPU, here: a cluster's GPU may be elsewhere. Raises what a training would if
    a value does not fit the others, before hours have gone into them.
    """
    samples, seconds = 0, 0.0
    for setting in dict.fromkeys(each.setting for each in works):
        same = [each.config for each in works if each.setting == setting]
        trainer = Trainer(replace(same[0], device="cpu"))
        first, second = (trainer.iterate()["seconds"] for _ in range(2))
        del trainer  # this process only waits from here on, and a world of A1s is large
        give_back_memory()
        size = same[0].num_envs * same[0].steps
        samples += len(same) * same[0].iterations * size
        seconds += len(same) * same[0].iterations * (second - first)
    return TrainingCost(trainings=len(works), samples=samples, seconds=seconds)


def _groups(rows: Sequence[Row]) -> Iterator[tuple[tuple[str, str], dict[int, list[Row]]]]:
    """Give for every terrain and value the crossings by seed, in the order of the trainings."""
    for group, crossings in by_cell(rows, ("trained_on", "setting")).items():
        seeds = by_cell(crossings, ("training_seed",))
        yield group, {seed: same for (seed,), same in seeds.items()}


def table(rows: Sequence[Row], option: str = "") -> str:
    """Return the crossings as a Markdown table: a line a terrain and value, a column a seed."""
    lines, seeds = [], list(dict.fromkeys(row["training_seed"] for row in rows))
    for (terrain, setting), by_seed in _groups(rows):
        shares = [Share.reached(by_seed[seed]) for seed in seeds]
        firsts = [by_seed[seed][0] for seed in seeds]
        lines.append(
            [
                terrain,
                *([setting] if option else []),
                f"{firsts[0]['samples']:,}",
                *shares,
                f"{100 * fmean(share.successes / share.trials for share in shares):.1f}",
                f"{fmean(first['r_v'] for first in firsts):.3f}",
                f"{fmean(first['calibration_error'] for first in firsts):.3f}",
            ]
        )
    varied, names = ([option] if option else []), (f"seed {seed}" for seed in seeds)
    return markdown(
        ["terrain", *varied, "samples", *names, "mean", "r_v", "calibration error"], lines
    )


def run(config: SweepConfig) -> int:
    """Train from the command line, print the table and write the report."""
    option = config.vary[0] if config.vary else ""
    # A training's own threads are cores that no other one has.
    workers = config.workers or max(1, usable_cores() // config.train.threads)
    title = f"Trainings side by side ({config.robot})"
    iterations = "" if option == "iterations" else f", {config.train.iterations} iterations"

    def find(rows: list[Row]) -> Findings:
        groups = {
            " ".join(filter(None, (terrain, option, setting))): {
                f"seed {seed}": Share.reached(crossings) for seed, crossings in by_seed.items()
            }
            for (terrain, setting), by_seed in _groups(rows)
        }
        chart = draw_shares(groups, title=title)
        return Findings(
            table=table(rows, option),
            caption=f"Success in % with 95 % intervals, {config.trials} crossings of held-out "
            f"terrain a training, each with its own plan; r_v and calibration error there are "
            f"means over the seeds; robot {config.robot}{iterations}.",
            figures={"success.svg": chart.savefig},
        )

    works = trainings(config)
    settings = _settings(config)
    make_folder(config.folder)
    print(f"the curves, while they train: tensorboard --logdir {config.folder / RUNS}")
    return report.run_and_report(
        replace(config, workers=workers),
        title=title,
        tasks=make_tasks(works, config.trials),
        settings=settings,
        cost=partial(estimate, works),
        find=find,
        watched=_watched([work.config for work in works]),
    )


@contextlib.contextmanager
def _watched(runs: Sequence[TrainConfig]) -> Iterator[None]:
    """Show how far the trainings are, wherever they run, by the snapshots in their run folders."""
    over = threading.Event()

    def watch() -> None:
        ended = over.wait(WATCH_SECONDS)
        if ended:  # nothing was left to train
            return
        total, done = sum(run.iterations for run in runs), _iterations(runs)
        with tqdm(total=total, initial=done, unit="it", desc="trained") as bar:
            while not ended:
                ended = over.wait(WATCH_SECONDS)
                bar.n = _iterations(runs)
                bar.refresh()

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
    """Return what a training's crossings depend on, but for what tells the trainings apart."""
    start, shared = config.train.start_from, comparable(config.train)
    for name in ("robot", "terrain", "seed", "start_from"):
        del shared[name]
    return settings_of(
        config,
        COMMAND,
        without=("terrains", "seeds", "vary", "trials", "train"),
        vary=config.vary[:1],
        start=_digest(start) if start else None,
        **{f"train.{name}": value for name, value in shared.items()},
    )


def _digest(start: Path) -> str:
    """Return a digest of the policy to start from; raises `SpecialistError` if there is none."""
    files = [start / name for name in (CHECKPOINT, DESCRIPTION) if (start / name).is_file()]
    if not files:
        raise SpecialistError(f"{start} holds no specialist to start from: give another folder")
    return digest(files[0].read_bytes())
