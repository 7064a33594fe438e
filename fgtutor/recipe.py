"""The recipe of a training: its settings, the world it happens in, and rsl_rl's configuration.

Reads a `TrainConfig`, which the command line fills; gives robots on terrain and what rsl_rl needs.
Source: paper, Sec. IV (specialists, DreamWaQ's protocol); PPO's sizes were found by experiment.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from fgtutor.dreamwaq import HISTORY, DreamWaQModel
from fgtutor.errors import ConfigError
from fgtutor.ppo import FeasibilityPPO
from fgtutor.robots import env_class
from fgtutor.robots.base import LocomotionEnv
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
    """Continue from the run folder's checkpoint; with more `iterations`, beyond its end."""
    start_from: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Specialist folder whose policy to start from, such as a walker's, or a run's folder, whose
    critic and, on the same terrain, Feasibility-Net come along (to go on where it is harder);
    default: from nothing."""
    actor: Literal["perceptive", "dreamwaq"] = "perceptive"
    """What the policy observes: its body and a scan of the ground, or, blind, a few steps' history
    from which it imagines the ground (the paper's protocol)."""
    hours: float = 0.0
    """Stop and save after this many hours; --resume goes on. 0 sets no limit."""
    iterations: int = 200
    """PPO iterations in all, over which entropy and the Feasibility-Net's learning rate fall."""
    num_envs: int = 128
    """Robots simulated side by side (by each process)."""
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
    easiest: float = 0.1
    """Difficulty of the first row; that of the last is 1. More for a policy that goes on where
    another stopped."""
    easiest_at_last: float | None = None
    """Difficulty to which the first row's rises, a checkpoint at a time, as the robots outgrow it;
    default, or if it lies below `easiest`: it stays."""
    std_at_last: float | None = None
    """Standard deviation of the action noise that is not exceeded when the first row has risen so
    far; before, in proportion. On a narrow beam nobody learns who is shaken off it."""
    neighbours: float = 0.0
    """Share of terrains with other obstacles at both ends, a landing away, as on mixed terrain; for
    a kind that mixed terrain has."""
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
    context_learning_rate: float = 1e-3
    """Adam learning rate of a blind policy's context encoder."""
    context_batch: int = 2048
    """Steps per update of the context encoder."""
    context_updates: int = 16
    """Updates of the context encoder per iteration."""
    threads: int = 1
    """Torch threads; two trainings side by side with one thread each beat one with two."""
    device: str = "cpu"
    """Where the networks live: cpu, cuda:0, or cuda under torchrun."""

    def __post_init__(self) -> None:
        for name in ("iterations", "num_envs", "steps", "save_every", "rows", "columns", "threads"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("label_seconds", "hours", "critic_warmup"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be 0 or more, got {getattr(self, name)}")
        for name, what in (("easiest", "difficulty"), ("neighbours", "share")):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be a {what} from 0 to 1, got {getattr(self, name)}")
        last, quiet = self.easiest_at_last, self.std_at_last
        if last is not None and not 0 <= last < 1:
            raise ConfigError(f"easiest_at_last must be a difficulty below 1, got {last:g}")
        if quiet is not None and (last is None or not quiet > 0):
            raise ConfigError(f"std_at_last must be above 0 and needs easiest_at_last, got {quiet}")

    @property
    def first_std(self) -> float:
        """Standard deviation of the action noise at the start."""
        return self.warm_std if self.start_from else self.initial_std

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / f"{self.robot}-{self.terrain}"


@dataclass(frozen=True, kw_only=True)
class A1TrainConfig(TrainConfig):
    """The same with the A1's sizes: 13 million samples, an hour on one core."""

    robot: str = "a1"
    terrain: str = "gentle"
    iterations: int = 500
    num_envs: int = 640
    label_seconds: float = 0.8
    rows: int = 5
    columns: int = 10
    easiest_at_last: float | None = 0.85
    std_at_last: float | None = 0.12
    neighbours: float = 0.6
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
    mixed = SCALES[config.robot].mixed
    names = mixed if config.terrain == "general" else (config.terrain,)
    levels = np.linspace(config.easiest, 1.0, config.rows) if config.rows > 1 else np.ones(1)
    dice = np.random.default_rng((config.seed, iteration))
    seeds = 2 * dice.integers(2**30, size=(config.rows, config.columns))
    between = dice.random((config.rows, config.columns)) < config.neighbours
    return World(
        [
            [
                make_terrain(
                    names[column % len(names)],
                    robot=config.robot,
                    difficulty=float(level),
                    seed=int(seeds[row, column]),
                    neighbours=bool(between[row, column]) and names[0] in mixed,
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
        config=dataclasses.replace(
            make.episodes,
            history=HISTORY if config.actor == "dreamwaq" else 0,
        ),
        seed=config.seed,
        device=config.device,
    )


def runner_config(config: TrainConfig, env: LocomotionEnv) -> dict[str, Any]:
    """Return rsl_rl's configuration; a fresh dict each time, since rsl_rl consumes it."""
    network = {"class_name": "MLPModel", "hidden_dims": list(config.hidden), "activation": "elu"}
    noise = {
        "class_name": "GaussianDistribution",
        "init_std": config.first_std,
        "std_type": "log",
        "std_range": (0.05, 2.0),
    }
    actor = network | {"distribution_cfg": noise}
    groups = {"actor": ["policy"], "critic": ["policy"]}
    if config.actor == "dreamwaq":
        mirror = env.mirror and env.mirror.part((*env.unfelt, *env.felt))
        actor |= {"class_name": DreamWaQModel, "mirror": mirror, "history": HISTORY}
        groups = {"actor": ["history"], "critic": ["critic"]}
    elif env.mirror:
        actor |= {"class_name": SymmetricMLPModel, "mirror": env.mirror}
    return {
        "num_steps_per_env": config.steps,
        "save_interval": config.iterations + 1,
        "obs_groups": groups,
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
            "context_learning_rate": config.context_learning_rate,
            "context_batch": config.context_batch,
            "context_updates": config.context_updates,
        },
    }
