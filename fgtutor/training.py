"""Joint training: PPO for the policy, and its Feasibility-Net on the very same rollouts.

Reads a robot, a terrain name and a `TrainConfig`; gives a `Specialist` folder and, on the way,
tensorboard curves and checkpoints to resume from. No data is collected for the Feasibility-Net
alone: labels come from the tracking rewards in rsl_rl's rollout storage.
Source: paper, Sec. III-A (Eqs. 1-3) and Fig. 2; PPO from rsl_rl.
"""

import contextlib
import dataclasses
import io
import itertools
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

# rsl_rl's logger imports GitPython, which otherwise refuses to load where git is not installed.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import numpy as np
import torch
import tyro
from rsl_rl.runners import OnPolicyRunner
from tqdm import tqdm

from fgtutor.errors import CheckpointError, ConfigError
from fgtutor.ppo import QUANTILES, FeasibilityPPO
from fgtutor.robots import env_class
from fgtutor.robots.base import LocomotionEnv
from fgtutor.specialist import Specialist, load_specialist, save_specialist
from fgtutor.storage import atomic_write, make_folder
from fgtutor.symmetry import SymmetricMLPModel
from fgtutor.terrain import SCALES, World, make_terrain


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train one specialist together with its Feasibility-Net."""

    robot: str = "toy"
    """Which robot: toy or a1."""
    terrain: str = "steps"
    """Terrain to specialise in, or `general` for all of the robot's terrains."""
    out: Path | None = None
    """Run folder for checkpoints, curves and the specialist; default runs/ROBOT-TERRAIN."""
    resume: bool = False
    """Continue from the run folder's checkpoint."""
    start_from: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Specialist folder whose policy to start from, such as a walker's; default: from nothing."""
    hours: float = 0.0
    """Stop and save after this many hours; --resume goes on. 0 sets no limit."""
    iterations: int = 200
    """PPO iterations in all."""
    num_envs: int = 128
    """Robots simulated side by side."""
    steps: int = 40
    """Control steps per robot and iteration."""
    seed: int = 1
    """Seed of everything random."""
    save_every: int = 25
    """Iterations between checkpoints; each one also starts every episode anew."""
    label_seconds: float = 1.0
    """Window over which r_v is averaged into a label, s; 0 is the paper's instantaneous label."""
    rows: int = 6
    """Difficulty rows of the training world."""
    columns: int = 12
    """Terrain variants per row."""
    planning_speed: float = 0.85
    """Forward speed of the command that planning pairs with every patch, m/s."""
    hidden: tuple[int, ...] = (128, 64)
    """Hidden widths of actor and critic."""
    gamma: float = 0.98
    """Discount per control step; at 25 Hz, 0.98 looks two seconds ahead."""
    learning_rate: float = 1e-3
    """Initial PPO learning rate; adapted to the KL divergence."""
    entropy: float = 0.003
    """PPO entropy coefficient at the start; it falls to zero over the run."""
    initial_std: float = 0.6
    """Standard deviation of the action noise at the start."""
    warm_std: float = 0.25
    """The same for a run that starts from a trained policy."""
    critic_warmup: int = 10
    """First iterations of such a run in which only the critic learns, since it is new."""
    feasibility_learning_rate: float = 2e-3
    """Adam learning rate of the Feasibility-Net; it falls to a twentieth over the run."""
    feasibility_batch: int = 512
    """Patches per Feasibility-Net update."""
    feasibility_updates: int = 24
    """Feasibility-Net updates per iteration, on patches of all rollouts since the checkpoint."""
    threads: int = 1
    """Torch threads; two trainings side by side with one thread each beat one with two."""
    device: str = "cpu"
    """Where the networks live: cpu, or cuda:0."""

    def __post_init__(self) -> None:
        for name in ("iterations", "num_envs", "steps", "save_every", "rows", "columns", "threads"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("label_seconds", "hours", "critic_warmup"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be 0 or more, got {getattr(self, name)}")

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / f"{self.robot}-{self.terrain}"


@dataclass(frozen=True, kw_only=True)
class A1TrainConfig(TrainConfig):
    """The same with the A1's sizes: 9 million samples, half an hour on one core."""

    robot: str = "a1"
    terrain: str = "gentle"
    iterations: int = 350
    num_envs: int = 640
    save_every: int = 50
    label_seconds: float = 0.8
    rows: int = 10
    columns: int = 5
    planning_speed: float = 0.65
    hidden: tuple[int, ...] = (256, 128)
    gamma: float = 0.99
    entropy: float = 0.001
    initial_std: float = 0.5
    feasibility_learning_rate: float = 1e-3


CONFIGS = {"toy": TrainConfig, "a1": A1TrainConfig}
"""The default sizes of a training, by robot."""


def config_of(words: Sequence[str]) -> type[TrainConfig]:
    """Return the config class for command line `words`, which may hold `--robot NAME`."""
    following = dict(itertools.pairwise([w for word in words for w in word.split("=", 1)]))
    return CONFIGS.get(following.get("--robot", "toy"), TrainConfig)


class Trainer:
    """One training run: environment, runner, checkpoints, curves."""

    def __init__(self, config: TrainConfig) -> None:
        """Build the world, the robots and the learner; nothing is simulated yet."""
        self.config = config
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.env = make_training_env(config)
        self.iteration = 0
        half_window = (round(config.label_seconds / self.env.control_dt) + 1) // 2
        if config.steps <= half_window:
            raise ConfigError(
                f"rollouts of {config.steps} steps never see half of a {config.label_seconds:g} s "
                f"label: set steps to {half_window + 1} or more, or label_seconds lower"
            )
        with contextlib.redirect_stdout(io.StringIO()):
            self.runner = OnPolicyRunner(
                self.env, runner_config(config, self.env), log_dir=None, device=config.device
            )
        self.algorithm: FeasibilityPPO = self.runner.alg  # type: ignore[assignment]
        self.samples_before = 0
        if config.start_from:
            self._start_from(load_specialist(config.start_from))
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []

    @property
    def checkpoint(self) -> Path:
        """Where this run's checkpoint lies."""
        return self.config.folder / "checkpoint.pt"

    @property
    def samples(self) -> int:
        """Control steps learned from so far, those of the policy it started from included."""
        own = self.iteration * self.config.num_envs * self.config.steps
        return self.samples_before + own

    def _start_from(self, specialist: Specialist) -> None:
        """Take over a trained policy, all but its action noise; the Feasibility-Net stays new."""
        mine = self.algorithm.get_policy()
        if specialist.robot != self.config.robot or specialist.policy.obs_dim != mine.obs_dim:
            raise CheckpointError(
                f"{self.config.start_from} drives {specialist.robot} on {specialist.policy.obs_dim}"
                f" observations, {self.config.robot} needs {mine.obs_dim}: start from another"
            )
        self.samples_before = int(specialist.provenance.get("samples", 0))
        noise = {k: v for k, v in mine.state_dict().items() if k.startswith("distribution")}
        mine.load_state_dict(specialist.policy.state_dict() | noise)

    def iterate(self) -> dict[str, float]:
        """Collect one rollout, learn from it, and return this iteration's numbers."""
        if self.config.start_from and self.iteration in (0, self.config.critic_warmup):
            warm = self.iteration < self.config.critic_warmup
            self.algorithm.get_policy().requires_grad_(not warm)
            self.algorithm.learning_rate = self.config.learning_rate
        began, done = time.monotonic(), self.iteration / self.config.iterations
        self.algorithm.entropy_coef = self.config.entropy * max(0.0, 1 - 1.25 * done)
        for group in self.algorithm.feasibility_optimizer.param_groups:
            group["lr"] = self.config.feasibility_learning_rate * 0.05**done
        self.runner.learn(1)
        self.iteration += 1
        self.seconds += time.monotonic() - began
        row = {
            "iteration": self.iteration,
            "samples": self.samples,
            "seconds": self.seconds,
            "row": self.env.row.float().mean().item(),
            "std": self.algorithm.get_policy().output_std.mean().item(),
            **self.algorithm.metrics,
        }
        self.history.append(row)
        return row

    def save(self) -> None:
        """Write the checkpoint atomically, and a snapshot, and go on in a new world.

        Physics engines keep caches that no checkpoint can hold. So a checkpoint is a point where
        the physics is rebuilt, in the run that goes on as in the run that resumes: both continue
        from the same state, bit for bit. The new world holds other terrain of the same kind, so
        that a policy sees many variants of it and a simulation at a time only few.
        """
        state = {
            "config": json.dumps(comparable(self.config)),
            "iteration": self.iteration,
            "seconds": self.seconds,
            "history": json.dumps(self.history),
            "algorithm": self.algorithm.save(),
            "env": self.env.state_dict(),
            "torch_random": torch.get_rng_state(),
        }
        # Through memory: torch's own writer reports a full disk as something else than an OSError.
        buffer = io.BytesIO()
        torch.save(state, buffer)
        with atomic_write(self.checkpoint) as temporary:
            temporary.write_bytes(buffer.getvalue())
        save_specialist(self.specialist(), self.config.folder / "snapshots" / f"{self.iteration}")
        self._renew(state["env"])
        self.algorithm.memory.clear()

    def _renew(self, state: dict[str, torch.Tensor]) -> None:
        """Move to the world that belongs to this iteration, with the curriculum of `state`."""
        self.env = self.runner.env = make_training_env(self.config, self.iteration)
        self.env.load_state_dict(state)
        self.env.reset_all()

    def resume(self) -> None:
        """Continue from the run folder's checkpoint.

        Raises `CheckpointError` if there is none, it cannot be read, or it is of another run.
        """
        path = self.checkpoint
        if not path.exists():
            raise CheckpointError(f"no checkpoint at {path}: start without --resume")
        try:
            state = torch.load(path, weights_only=True, map_location=self.config.device)
            stored, mine = json.loads(state["config"]), comparable(self.config)
        except Exception as error:
            raise CheckpointError(
                f"{path} is not a readable checkpoint ({type(error).__name__}): delete the folder "
                "and train anew"
            ) from error
        changed = sorted(k for k in mine if stored.get(k) != mine[k])
        if changed:
            what = ", ".join(f"{k} was {stored.get(k)!r}, now {mine[k]!r}" for k in changed)
            raise CheckpointError(
                f"{path} belongs to another run: {what}. Use the same settings, or another --out"
            )
        self.algorithm.load(state["algorithm"])
        warm = self.config.start_from and state["iteration"] < self.config.critic_warmup
        self.algorithm.get_policy().requires_grad_(not warm)
        self.iteration, self.seconds = state["iteration"], state["seconds"]
        self._renew(state["env"])
        self.history = json.loads(state["history"])
        torch.set_rng_state(state["torch_random"].cpu())

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
                "samples": self.samples,
                "seed": config.seed,
                "seconds": round(self.seconds, 1),
                "config": comparable(config),
                "versions": {p: version(p) for p in ("torch", "rsl-rl-lib", "pymunk", "mujoco")},
                "curve": self.history[::every],
            },
        )


def comparable(config: TrainConfig) -> dict[str, Any]:
    """Return the settings that must not change between a run and its continuation."""
    values = dataclasses.asdict(config)
    for name in ("out", "resume", "hours", "threads", "device"):
        del values[name]
    values["hidden"] = list(values["hidden"])
    values["start_from"] = str(config.start_from) if config.start_from else None
    return values


def training_world(config: TrainConfig, iteration: int = 0) -> World:
    """Lay out rows of rising difficulty, each with its own terrain variants.

    `general` takes the robot's specialties in turn, column by column. Seeds are even here, and odd
    wherever terrain is evaluated, so nothing is ever evaluated on terrain trained on.
    """
    names = SCALES[config.robot].mixed if config.terrain == "general" else (config.terrain,)
    levels = np.linspace(0.1, 1.0, config.rows) if config.rows > 1 else np.ones(1)
    dice = np.random.default_rng((config.seed, iteration))
    seeds = 2 * dice.integers(2**30, size=(config.rows, config.columns))
    return World(
        [
            [
                make_terrain(
                    names[column % len(names)],
                    robot=config.robot,
                    difficulty=float(level),
                    seed=int(seeds[row, column]),
                )
                for column in range(config.columns)
            ]
            for row, level in enumerate(levels)
        ]
    )


def make_training_env(config: TrainConfig, iteration: int = 0) -> LocomotionEnv:
    """Build the robots on the world in which training goes on from `iteration`."""
    make = env_class(config.robot)
    return make(
        training_world(config, iteration),
        config.num_envs,
        seed=config.seed,
        device=config.device,
    )


def runner_config(config: TrainConfig, env: LocomotionEnv) -> dict[str, Any]:
    """Return rsl_rl's configuration; a fresh dict each time, since rsl_rl consumes it."""
    network = {"class_name": "MLPModel", "hidden_dims": list(config.hidden), "activation": "elu"}
    noise = {
        "class_name": "GaussianDistribution",
        "init_std": config.warm_std if config.start_from else config.initial_std,
        "std_type": "log",
        "std_range": (0.05, 2.0),
    }
    actor = network | {"distribution_cfg": noise}
    if env.mirror:
        actor |= {"class_name": SymmetricMLPModel, "mirror": env.mirror}
    return {
        "num_steps_per_env": config.steps,
        "save_interval": config.iterations + 1,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": actor,
        "critic": dict(network),
        "algorithm": {
            "class_name": FeasibilityPPO,
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "clip_param": 0.2,
            "gamma": config.gamma,
            "lam": 0.95,
            "value_loss_coef": 0.5,
            "entropy_coef": config.entropy,
            "learning_rate": config.learning_rate,
            "desired_kl": 0.012,
            "label_steps": round(config.label_seconds / env.control_dt),
            "feasibility_learning_rate": config.feasibility_learning_rate,
            "feasibility_batch": config.feasibility_batch,
            "feasibility_updates": config.feasibility_updates,
        },
    }


def train(
    config: TrainConfig, *, on_iteration: Callable[[dict[str, float]], None] | None = None
) -> Specialist:
    """Train one specialist; write its folder to `<run>/specialist` and return it.

    Shows a progress bar with the time left. Ctrl-C saves a checkpoint and returns what has been
    learned; `config.resume` continues. `on_iteration` gets each iteration's numbers (the notebooks
    draw them).
    """
    trainer = Trainer(config)
    if config.resume:
        trainer.resume()
    from torch.utils.tensorboard import SummaryWriter

    make_folder(config.folder)
    began = time.monotonic()
    with (
        SummaryWriter(str(config.folder / "tensorboard")) as writer,
        tqdm(total=config.iterations, initial=trainer.iteration, unit="it") as bar,
        stop_on_interrupt() as stopped,
    ):
        bar.set_description(f"{config.robot} {config.terrain}")
        while trainer.iteration < config.iterations:
            row = trainer.iterate()
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
            if stopped() or (config.hours and time.monotonic() - began > 3600 * config.hours):
                break
        if trainer.iteration % config.save_every:
            trainer.save()
    specialist = trainer.specialist()
    save_specialist(specialist, config.folder / "specialist")
    return specialist


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
    print(f"{config.robot} {config.terrain}: {samples:,} samples -> {config.folder / 'specialist'}")
    return 0
