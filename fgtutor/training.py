"""Joint training: PPO for the policy, and its Feasibility-Net on the very same rollouts.

Reads a robot, a terrain name and a `TrainConfig`; gives a `Specialist` folder and, on the way,
tensorboard curves and checkpoints to resume from. No data is collected for the Feasibility-Net
alone: labels come from the tracking rewards in rsl_rl's rollout storage. Under torchrun, several
processes train one specialist together (see `distributed`).
Source: paper, Sec. III-A (Eqs. 1-3) and Fig. 2; PPO from rsl_rl.
"""

import contextlib
import ctypes
import io
import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

# rsl_rl's logger imports GitPython, which otherwise refuses to load where git is not installed.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
from tqdm import tqdm

from fgtutor import distributed
from fgtutor.distributed import leads
from fgtutor.errors import CheckpointError, ConfigError
from fgtutor.ppo import QUANTILES, FeasibilityPPO
from fgtutor.recipe import (
    A1TrainConfig,
    TrainConfig,
    comparable,
    config_of,
    make_training_env,
    runner_config,
    training_world,
)
from fgtutor.robots.base import LocomotionEnv
from fgtutor.specialist import Specialist, load_specialist, save_specialist
from fgtutor.storage import atomic_write, make_folder, storage_error

__all__ = ["A1TrainConfig", "TrainConfig", "Trainer", "config_of", "run", "train", "training_world"]

CHECKPOINT = "checkpoint.pt"
"""The file in a run's folder from which it goes on."""
OUTGROWN = 0.45
"""Share of the way to the last row at which, on the mean, robots have outgrown the first one."""
LIFT = 0.25
"""Share of what is missing to full difficulty by which the first row is then lifted."""


class Trainer:
    """One training run: environment, runner, checkpoints, curves."""

    def __init__(self, config: TrainConfig) -> None:
        """Build the world, the robots and the learner; nothing is simulated yet."""
        start = config.start_from
        if start and start.resolve().is_relative_to(config.folder.resolve()):
            raise ConfigError(
                f"{config.folder} would be overwritten by the run that starts from it: give "
                "another --out, or go on with --resume and without --from"
            )
        self.config = config
        self.iteration = 0
        self.easiest = config.easiest
        torch.set_num_threads(config.threads)
        torch.manual_seed(distributed.own_seed(config.seed))
        self.env = self._make_env()
        half_window = (round(config.label_seconds / self.env.control_dt) + 1) // 2
        if config.steps <= half_window:
            raise ConfigError(
                f"rollouts of {config.steps} steps never see half of a {config.label_seconds:g} s "
                f"label: set steps to {half_window + 1} or more, or label_seconds lower"
            )
        with contextlib.redirect_stdout(io.StringIO()):
            self.runner = distributed.Runner(
                self.env,
                runner_config(config, self.env),
                log_dir=None,
                device=distributed.own_device(config.device),
            )
        self.algorithm: FeasibilityPPO = self.runner.alg  # type: ignore[assignment]
        self.samples_before = 0
        self.critic_warmup = 0
        if config.start_from:
            self._start_from(config.start_from)
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []

    @property
    def checkpoint(self) -> Path:
        """Where this run's checkpoint lies."""
        return self.config.folder / CHECKPOINT

    @property
    def samples(self) -> int:
        """Control steps learned from so far, those of the policy it started from included."""
        own = self.iteration * self.config.num_envs * self.config.steps
        return self.samples_before + own * distributed.processes()

    def _make_env(self) -> LocomotionEnv:
        """Build this process's robots, on the CPU as their physics, on ground of its own."""
        seed = distributed.own_seed(self.config.seed)
        config = replace(self.config, seed=seed, device="cpu", easiest=self.easiest)
        return make_training_env(config, self.iteration)

    def _start_from(self, folder: Path) -> None:
        """Take over a trained policy, all but its action noise.

        From a run's folder, finished or not, its critic comes along, and on the same terrain its
        Feasibility-Net; otherwise these are new, and the critic learns first, alone.
        """
        checkpoint = folder / CHECKPOINT
        run = _read(checkpoint) if checkpoint.exists() else None
        specialist = load_specialist(folder / f"snapshots/{run['iteration']}" if run else folder)
        mine, start = self.algorithm.get_policy(), specialist.policy
        if specialist.robot != self.config.robot or start.obs_dim != mine.obs_dim:
            raise CheckpointError(
                f"{self.config.start_from} drives {specialist.robot} on {start.obs_dim} numbers of "
                f"{start.obs_groups}, {self.config.robot} with the {self.config.actor} actor needs "
                f"{mine.obs_dim} of {mine.obs_groups}: start from another"
            )
        self.samples_before = int(specialist.provenance.get("samples", 0))
        noise = {k: v for k, v in mine.state_dict().items() if k.startswith("distribution")}
        mine.load_state_dict(start.state_dict() | noise)
        if run:
            self.algorithm.critic.load_state_dict(run["algorithm"]["critic_state_dict"])
            if specialist.name == self.config.terrain:
                self.algorithm.feasibility.load_state_dict(specialist.feasibility.state_dict())
        else:
            self.critic_warmup = self.config.critic_warmup

    def iterate(self) -> dict[str, float]:
        """Collect one rollout, learn from it, and return this iteration's numbers."""
        if self.config.start_from and self.iteration in (0, self.critic_warmup):
            warm = self.iteration < self.critic_warmup
            self.algorithm.get_policy().requires_grad_(not warm)
            self.algorithm.learning_rate = self.config.learning_rate
        began, done = time.monotonic(), self.iteration / self.config.iterations
        self.algorithm.entropy_coef = self.config.entropy * max(0.0, 1 - 1.25 * done)
        for group in self.algorithm.feasibility_optimizer.param_groups:
            group["lr"] = self.config.feasibility_learning_rate * 0.05**done
        self.runner.learn(1)
        self._quieten()
        self.iteration += 1
        self.seconds += time.monotonic() - began
        row = {
            "iteration": self.iteration,
            "samples": self.samples,
            "seconds": self.seconds,
            **distributed.mean(
                {
                    "row": self.env.row.float().mean().item(),
                    "easiest": self.easiest,
                    "std": self.algorithm.get_policy().output_std.mean().item(),
                    **self.algorithm.metrics,
                }
            ),
        }
        self.history.append(row)
        return row

    def _harden(self, rows: torch.Tensor) -> torch.Tensor:
        """Lift the first row where the robots have outgrown it; return the rows they stand on then.

        A robot keeps its difficulty, as far as there is still such a row.
        """
        last, top = self.config.easiest_at_last, self.config.rows - 1
        if last is None or self.easiest >= last or top < 1:
            return rows
        if self.history[-1]["row"] < OUTGROWN * top:
            return rows
        difficulty = self.easiest + (1 - self.easiest) * rows / top
        self.easiest = min(last, self.easiest + LIFT * (1 - self.easiest))
        lifted = top * (difficulty - self.easiest) / (1 - self.easiest)
        return lifted.round().clamp(min=0).long()

    @torch.no_grad()
    def _quieten(self) -> None:
        """Hold the action noise down as far as the first row has risen."""
        config, last = self.config, self.config.easiest_at_last
        if last is None or config.std_at_last is None:
            return
        way = last - config.easiest
        risen = (self.easiest - config.easiest) / way if way > 0 else 1.0
        most = config.first_std * (config.std_at_last / config.first_std) ** risen
        noise = self.algorithm.get_policy().get_parameter("distribution.log_std_param")
        noise.clamp_(max=math.log(most))

    def save(self) -> None:
        """Write the checkpoint atomically, and a snapshot, and go on in a new world.

        Physics engines keep caches that no checkpoint can hold. So a checkpoint is a point where
        the physics is rebuilt, in the run that goes on as in the run that resumes: both continue
        from the same state, bit for bit. The new world holds other terrain of the same kind, so
        that a policy sees many variants of it and a simulation at a time only few.

        Of several processes the first one writes, for all of them.
        """
        mine = {"env": self.env.state_dict(), "torch_random": torch.get_rng_state()}
        mine["env"]["row"] = self._harden(mine["env"]["row"])
        first, *others = distributed.gather(mine)
        if leads():
            self._write(first | {"others": others})
        self._renew(mine["env"])
        self.algorithm.memory.clear()

    def _write(self, processes: dict[str, Any]) -> None:
        """Write checkpoint and snapshot, with what is each process's own."""
        state = {
            "config": json.dumps(comparable(self.config)),
            "iteration": self.iteration,
            "samples_before": self.samples_before,
            "critic_warmup": self.critic_warmup,
            "easiest": self.easiest,
            "seconds": self.seconds,
            "history": json.dumps(self.history),
            "algorithm": self.algorithm.save(),
            **processes,
        }
        # Through memory: torch's own writer reports a full disk as something else than an OSError.
        buffer = io.BytesIO()
        torch.save(state, buffer)
        with atomic_write(self.checkpoint) as temporary:
            temporary.write_bytes(buffer.getvalue())
        save_specialist(self.specialist(), self.config.folder / "snapshots" / f"{self.iteration}")

    def _renew(self, state: dict[str, torch.Tensor]) -> None:
        """Move to the world that belongs to this iteration, with the curriculum of `state`."""
        self.env = self.runner.env = self._make_env()
        self.env.load_state_dict(state)
        self.env.reset_all()
        give_back_memory()

    def resume(self) -> None:
        """Continue from the run folder's checkpoint, to more iterations if `config` says so.

        What the run once started from need not be given again, nor still be there. Raises
        `CheckpointError` if there is no checkpoint, it cannot be read, or it is of another run.
        """
        path = self.checkpoint
        if not path.exists():
            raise CheckpointError(f"no checkpoint at {path}: start without --resume")
        state = _read(path)
        # A setting younger than the checkpoint had what is now its default.
        stored = comparable(type(self.config)()) | state["config"]
        if stored["start_from"] and not self.config.start_from:
            self.config = replace(self.config, start_from=Path(stored["start_from"]))
        mine = comparable(self.config)
        changed = sorted(k for k in mine if k != "iterations" and stored.get(k) != mine[k])
        if changed:
            what = ", ".join(f"{k} was {stored.get(k)!r}, now {mine[k]!r}" for k in changed)
            raise CheckpointError(
                f"{path} belongs to another run: {what}. Use the same settings, or another --out"
            )
        everyone = [state, *state.get("others", ())]
        if len(everyone) != distributed.processes():
            raise CheckpointError(
                f"{path} was written by {len(everyone)} processes, these are "
                f"{distributed.processes()}: go on with as many, or use another --out"
            )
        own = everyone[distributed.rank()]
        self.algorithm.load(state["algorithm"])
        self.samples_before = state.get("samples_before", self.samples_before)
        self.critic_warmup = state.get("critic_warmup", self.critic_warmup)
        warm = state["iteration"] < self.critic_warmup
        self.algorithm.get_policy().requires_grad_(not warm)
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self.easiest = state.get("easiest", self.easiest)
        self._renew(own["env"])
        self.history = state["history"]
        torch.set_rng_state(own["torch_random"])

    def specialist(self) -> Specialist:
        """Return what has been learned so far as a `Specialist`."""
        config = self.config
        recent = self.history[-10:]
        every = max(1, len(self.history) // 100)
        return Specialist(
            name=config.terrain,
            robot=config.robot,
            policy=self.algorithm.get_policy(),
            feasibility=self.algorithm.feasibility,
            grid=self.env.grid,
            command=(config.planning_speed, 0.0, 0.0),
            label_seconds=config.label_seconds,
            quantiles={
                str(q): sum(row[f"L_recon_{q}"] for row in recent) / len(recent) for q in QUANTILES
            },
            provenance={
                "terrain": config.terrain,
                "iteration": self.iteration,
                "samples": self.samples,
                "seed": config.seed,
                "processes": distributed.processes(),
                "seconds": round(self.seconds, 1),
                "config": comparable(config),
                "versions": {p: version(p) for p in ("torch", "rsl-rl-lib", "pymunk", "mujoco")},
                "curve": self.history[::every],
            },
        )


def give_back_memory() -> None:
    """Ask glibc, where there is one, to return to the system what the last world has freed.

    It keeps freed pieces between others still in use: 0.4 GB for each world of 640 A1s.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _read(checkpoint: Path) -> dict[str, Any]:
    """Return what a checkpoint holds."""
    try:
        state = torch.load(checkpoint, weights_only=True, map_location="cpu")
        return state | {name: json.loads(state[name]) for name in ("config", "history")}
    except Exception as error:
        raise CheckpointError(
            f"{checkpoint} is not a readable checkpoint ({type(error).__name__}): delete the "
            "folder and train anew"
        ) from error


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

    A run that nobody attends has no bar, and Ctrl-C is not its own: it ends where it is and resumes
    from its last checkpoint as if nothing had been. (A checkpoint moves the run to other ground, so
    one that Ctrl-C asks for makes another run of it.)

    Raises:
        ConfigError: The settings do not fit each other.
        CheckpointError: There is nothing to resume or to start from, or it does not fit.
        StorageError: The run folder cannot be written; its last checkpoint is whole.
    """
    with distributed.leave_at_end():
        trainer = Trainer(config)
        if config.resume:
            trainer.resume()
        try:
            _iterate(trainer, on_iteration, attended)
        except OSError as error:  # of the curves: tensorboard raises what the system does
            raise storage_error(config.folder, error) from error
        specialist = trainer.specialist()
        if leads():
            save_specialist(specialist, config.folder / "specialist")
        return specialist


def _iterate(
    trainer: Trainer, on_iteration: Callable[[dict[str, float]], None] | None, attended: bool
) -> None:
    """Train to the end, to the time limit or to a Ctrl-C, and leave a checkpoint."""
    from torch.utils.tensorboard import SummaryWriter

    config, began = trainer.config, time.monotonic()
    if leads():
        make_folder(config.folder)
    with (
        SummaryWriter(str(config.folder / "tensorboard"))
        if leads()
        else contextlib.nullcontext() as writer,
        tqdm(
            total=config.iterations,
            initial=trainer.iteration,
            unit="it",
            disable=not (attended and leads()),
        ) as bar,
        stop_on_interrupt() if attended else contextlib.nullcontext(lambda: False) as stopped,
    ):
        bar.set_description(f"{config.robot} {config.terrain}")
        while trainer.iteration < config.iterations:
            row = trainer.iterate()
            if writer:
                for name, value in row.items():
                    writer.add_scalar(name, value, trainer.iteration)
            bar.update()
            bar.set_postfix(
                r_v=f"{row['r_v']:.2f}", row=f"{row['row']:.1f}", std=f"{row['std']:.2f}"
            )
            if on_iteration:
                on_iteration(row)
            if trainer.iteration % config.save_every == 0:
                trainer.save()
            late = config.hours > 0 and time.monotonic() - began > 3600 * config.hours
            # One process must not stop while the others wait for its gradients.
            if any(distributed.gather(stopped() or late)):
                break
        if trainer.iteration % config.save_every:
            trainer.save()


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a request to stop after this iteration; the second one interrupts.

    Outside the main thread, where signals cannot be handled, Ctrl-C keeps its usual meaning.
    """
    asked = False

    def ask(*_: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    try:
        previous = signal.signal(signal.SIGINT, ask)
    except ValueError:
        yield lambda: False
        return
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)


def run(config: TrainConfig) -> int:
    """Train from the command line and say where the result lies."""
    specialist = train(config)
    samples = specialist.provenance["samples"]
    if leads():
        done = f"{config.robot} {config.terrain}: {samples:,} samples"
        print(f"{done} -> {config.folder / 'specialist'}")
    return 0
