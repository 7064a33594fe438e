"""Joint training of a policy and its Feasibility-Net, from first to last iteration.

Reads a `TrainConfig`; gives a `Specialist` folder and, on the way, tensorboard curves and
checkpoints to resume from (see `trainer`). A run folder serves one run, and one process at a time.
Source: paper, Sec. III-A and Fig. 2.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from fgtutor.errors import CheckpointError
from fgtutor.io.storage import locked_folder, storage_error
from fgtutor.learning import distributed
from fgtutor.learning.calibrate import CalibrateConfig, calibrated
from fgtutor.learning.config import TrainConfig, config_of, training_world
from fgtutor.learning.distributed import leads
from fgtutor.learning.trainer import CHECKPOINT, Trainer
from fgtutor.robots import env_class
from fgtutor.specialist import Specialist, load_specialist, save_specialist

__all__ = ["TrainConfig", "Trainer", "config_of", "run", "train"]

INTERRUPTED = 130
"""Exit code after a Ctrl-C, as shells report it."""


def train(
    config: TrainConfig,
    *,
    on_iteration: Callable[[dict[str, float]], None] | None = None,
    attended: bool = True,
) -> Specialist:
    """Train one specialist; write its folder to `<run>/specialist` and return it.

    Shows a progress bar with the time left. Ctrl-C saves a checkpoint and returns what has been
    learned; `config.resume` continues. `on_iteration` gets each iteration's numbers (the notebooks
    draw them).

    An unattended run has no bar, and Ctrl-C ends it at once: it resumes from its last checkpoint.
    (One more checkpoint would move it to other ground, and make another run of it.)

    Raises:
        ConfigError: The settings do not fit each other.
        CheckpointError: There is nothing to resume or to start from, or it does not fit; or the
            folder holds a run that is not to be resumed.
        DivergedError: A number is no longer finite.
        StorageError: The run folder cannot be written, or another process trains in it; its last
            checkpoint is whole.
    """
    return _train(config, on_iteration, attended)[0]


def _train(
    config: TrainConfig,
    on_iteration: Callable[[dict[str, float]], None] | None = None,
    attended: bool = True,
) -> tuple[Specialist, bool]:
    """Train as `train` says; return the specialist, and whether a Ctrl-C ended it."""
    env_class(config.robot)  # an unknown robot or terrain fails before there is a folder
    training_world(replace(config, rows=1, columns=1))
    with (
        locked_folder(config.folder) if leads() else nullcontext(),
        distributed.leave_at_end(),
    ):
        if leads() and not config.resume and (config.folder / CHECKPOINT).exists():
            raise CheckpointError(
                f"{config.folder} holds a run already: go on with --resume, or give another --out"
            )
        trainer = Trainer(config)
        if config.resume:
            trainer.resume()
        try:
            interrupted = _iterate(trainer, on_iteration, attended)
        except OSError as error:  # of the curves: tensorboard raises what the system does
            raise storage_error(config.folder, error) from error
        except (KeyboardInterrupt, SystemExit):
            if attended and leads() and trainer.saved:
                print(
                    f"\n{config.folder} keeps the checkpoint of iteration {trainer.saved}: the "
                    "same command with --resume goes on from there",
                    file=sys.stderr,
                )
            raise
        specialist = trainer.specialist()
        if leads():
            folder = save_specialist(specialist, config.folder / "specialist")
            if not interrupted:
                # Loaded again: it drives on the CPU, wherever it was trained, and is safe by now.
                own = _calibration(config, trainer.env.control_dt)
                specialist = calibrated(load_specialist(folder), own)
                save_specialist(specialist, folder)
        return specialist, interrupted


def _calibration(config: TrainConfig, dt: float) -> CalibrateConfig:
    """Return how a finished run is calibrated: at length, but not for longer than it trained."""
    trained = config.iterations * config.steps * dt
    return CalibrateConfig(
        folder=config.folder,
        envs=min(CalibrateConfig.envs, config.num_envs),
        seconds=min(CalibrateConfig.seconds, trained),
        seed=config.seed,
    )


def _iterate(
    trainer: Trainer, on_iteration: Callable[[dict[str, float]], None] | None, attended: bool
) -> bool:
    """Train to the end, the time limit or a Ctrl-C; leave a checkpoint; tell if it was a Ctrl-C."""
    from torch.utils.tensorboard import SummaryWriter

    config, began = trainer.config, time.monotonic()
    curves = SummaryWriter(str(config.folder / "tensorboard")) if leads() else None
    bar = tqdm(
        desc=f"{config.robot} {config.terrain}",
        total=config.iterations,
        initial=trainer.iteration,
        unit="it",
        disable=not (attended and leads()),
    )
    with curves or nullcontext(), bar, stop_on_interrupt(attended) as stopped, _quiet_threads():
        while trainer.iteration < config.iterations:
            row = trainer.iterate()
            if curves:
                for name, value in row.items():
                    curves.add_scalar(name, value, trainer.iteration)
            bar.update()
            bar.set_postfix(
                r_v=f"{row['r_v']:.2f}", row=f"{row['row']:.1f}", std=f"{row['std']:.2f}"
            )
            if on_iteration:
                on_iteration(row)
            if trainer.iteration % config.save_every == 0:
                trainer.save()
            late = config.hours > 0 and time.monotonic() - began > 3600 * config.hours
            # A process must not stop while another one waits for its gradients.
            if any(distributed.gather(stopped() or late)):
                break
        if trainer.iteration != trainer.saved:
            trainer.save()
        return stopped() and trainer.iteration < config.iterations


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Let threads print no OSError: the run raises what stops tensorboard's thread as its own."""
    before = threading.excepthook
    threading.excepthook = lambda what: (
        None if isinstance(what.exc_value, OSError) else before(what)
    )
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def stop_on_interrupt(attended: bool = True) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a request to stop after this iteration; the second one interrupts.

    Unattended, and outside the main thread, where signals cannot be handled, Ctrl-C keeps its usual
    meaning.
    """
    asked = False

    def ask(*_: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    if not (attended and threading.current_thread() is threading.main_thread()):
        yield lambda: False
        return
    previous = signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)


def run(config: TrainConfig) -> int:
    """Train from the command line and say where the result lies."""
    specialist, interrupted = _train(config)
    if leads():
        samples = f"{config.robot} {config.terrain}: {specialist.provenance['samples']:,} samples"
        print(f"{samples} -> {config.folder / 'specialist'}")
        if interrupted:
            print("interrupted: the same command with --resume goes on", file=sys.stderr)
    return INTERRUPTED if interrupted else 0
