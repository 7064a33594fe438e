"""Settings of a training, the terrain it happens on, and rsl_rl's configuration.

Reads a `TrainConfig`, which the command line fills; gives robots on terrain and what rsl_rl needs.
Source: paper, Sec. IV (specialists, DreamWaQ's protocol); PPO's sizes were found by experiment.
"""

import dataclasses
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from annotated_types import Interval, MinLen

from fgtutor.errors import ConfigError
from fgtutor.io.validation import (
    Ascending,
    Count,
    CountOrZero,
    NonNegative,
    Seed,
    Share,
    check_fields,
)
from fgtutor.learning.ppo import FeasibilityPPO
from fgtutor.policies.dreamwaq import HISTORY, LONGER, DreamWaQModel, EstimatingModel
from fgtutor.policies.symmetry import SymmetricMLPModel
from fgtutor.robots import ROBOTS, env_class
from fgtutor.robots.base import LocomotionEnv
from fgtutor.world.obstacles import OBSTACLES
from fgtutor.world.terrain import Terrain, World, make_terrain
from fgtutor.world.turned import make_turned

Robots = Annotated[int, Interval(ge=1, le=100_000)]
"""Robots, or steps of one: as many as memory may hold."""
Side = Annotated[int, Interval(ge=1, le=1000)]
"""Terrains along one side of a world."""
Widths = Annotated[tuple[Annotated[int, Interval(ge=1, le=4096)], ...], MinLen(1)]
"""Widths of a network's hidden layers, at least one."""
Seconds = Annotated[float, Interval(ge=0, le=60)]
"""A part of an episode, s."""
Speed = Annotated[float, Interval(gt=0, le=10)]
"""A commanded speed, m/s."""
Rate = Annotated[float, Interval(gt=0, le=1)]
"""A learning rate."""
Std = Annotated[float, Interval(gt=0, le=2)]
"""A standard deviation of the action noise, which stays below 2."""
Threads = Annotated[int, Interval(ge=1, le=256)]
"""Threads of one process; torch ends the process if they are too many for the system."""
FRAMES = {"estimating": LONGER, "dreamwaq": HISTORY}
"""Frames that an actor remembers, if it does."""
MINI_BATCHES = 4
"""Parts of a rollout that PPO learns from one after the other."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train one specialist together with its Feasibility-Net."""

    robot: str = "toy"
    """Which robot: toy or a1."""
    terrain: str = "steps"
    """Terrain to specialise in, or `general` for all of the robot's terrains."""
    out: Path | None = None
    """Run folder for checkpoints, curves and the specialist; default
    runs/ROBOT-TERRAIN-seedSEED."""
    resume: bool = False
    """Continue from the run folder's checkpoint; with more `iterations`, beyond its end."""
    start_from: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Specialist folder whose policy to start from, such as a walker's, or a run's folder, whose
    critic comes along (to go on where it is harder); on the same terrain, so does its
    Feasibility-Net. An estimating policy may start from one that was told its velocity. Default:
    from nothing."""
    actor: Literal["perceptive", "estimating", "dreamwaq"] = "perceptive"
    """What the policy observes: its body, its velocity and a scan of the ground; a short history
    instead of the velocity, which it estimates, and the scan; or, blind, a history from which it
    imagines the ground (the paper's protocol)."""
    disturbances: Literal["usual", "wide"] = "usual"
    """How far robots, sensors and ground differ from one another; wide, of robots that have it, for
    policies that shall hold under disturbance and on other models."""
    hours: NonNegative = 0.0
    """Stop and save after this many hours; --resume goes on. 0 sets no limit."""
    iterations: Count = 200
    """PPO iterations in all, over which entropy and the Feasibility-Net's learning rate fall."""
    num_envs: Robots = 128
    """Robots simulated side by side (by each process)."""
    steps: Robots = 40
    """Control steps per robot and iteration."""
    seed: Seed = 1
    """Seed of everything random."""
    save_every: Count = 25
    """Iterations between checkpoints; each one also starts every episode anew."""
    label_seconds: Seconds = 1.0
    """Window over which r_v is averaged into a label, s; 0 is the paper's instantaneous label."""
    rows: Side = 6
    """Difficulty rows of the training world."""
    columns: Side = 12
    """Terrain variants per row."""
    easiest: Share = 0.1
    """Difficulty of the first row; that of the last is 1. More for a policy that goes on where
    another stopped."""
    easiest_at_last: Annotated[float, Interval(ge=0, lt=1)] | None = None
    """Difficulty to which the first row's rises, a checkpoint at a time, as the robots outgrow it;
    default, or if it lies below `easiest`: it stays."""
    std_at_last: Std | None = None
    """Standard deviation of the action noise that is not exceeded when the first row has risen so
    far; before, in proportion. A robot that its noise shakes off a narrow beam learns nothing."""
    neighbours: Share = 0.0
    """Share of terrains with other obstacles at both ends, a landing away, as on mixed terrain; for
    a kind that mixed terrain has."""
    turned: Share = 0.0
    """Share of terrains whose obstacle lies at any angle, as on open ground; then all terrains are
    square."""
    speed: Annotated[tuple[Speed, Speed], Ascending] | None = None
    """Range of the commanded forward speed, m/s; default: the robot's own."""
    planning_speed: Speed = 0.85
    """Forward speed at which the policy drives a route, and which planning pairs with every patch,
    m/s."""
    hidden: Widths = (128, 64)
    """Hidden widths of actor and critic."""
    gamma: Share = 0.98
    """Discount per control step; at 25 Hz, 0.98 looks two seconds ahead."""
    learning_rate: Rate = 1e-3
    """Initial PPO learning rate; adapted to the KL divergence. A trained policy begins at
    a fiftieth of it."""
    entropy: Share = 0.003
    """PPO entropy coefficient at the start; it falls to zero over the run."""
    initial_std: Std = 0.6
    """Standard deviation of the action noise at the start."""
    warm_std: Std = 0.25
    """The same for a run that starts from a trained policy."""
    critic_warmup: CountOrZero = 10
    """First iterations of such a run in which only the critic learns, since it is new."""
    feasibility_learning_rate: Rate = 2e-3
    """Adam learning rate of the Feasibility-Net; it falls to a twentieth over the run."""
    threads: Threads = 1
    """Torch threads; two trainings side by side with one thread each beat one with two."""
    device: str = "cpu"
    """Where the networks live: cpu, cuda:0, or cuda under torchrun."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.std_at_last is not None and self.easiest_at_last is None:
            raise ConfigError("std_at_last needs easiest_at_last, as it falls while that rises")
        if self.speed and not self.speed[0] <= self.planning_speed <= self.speed[1]:
            raise ConfigError(
                f"planning_speed should lie between the speeds trained with, {self.speed[0]:g} and "
                f"{self.speed[1]:g} m/s, got {self.planning_speed:g}"
            )
        if not re.fullmatch(r"cpu|cuda(:[0-9]{1,3})?", self.device):
            raise ConfigError(f"device should be cpu, cuda or cuda:NUMBER, got {self.device!r}")
        try:
            str(self.folder).encode()
        except UnicodeEncodeError:
            raise ConfigError(f"out: {str(self.folder)!r} is no name in UTF-8") from None
        if self.num_envs * self.steps < MINI_BATCHES:
            raise ConfigError(
                f"{self.num_envs} robots with {self.steps} steps make no {MINI_BATCHES} "
                "mini-batches: set num_envs or steps higher"
            )

    @property
    def first_std(self) -> float:
        """Standard deviation of the action noise at the start."""
        return self.warm_std if self.start_from else self.initial_std

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / f"{self.robot}-{self.terrain}-seed{self.seed}"


@dataclass(frozen=True, kw_only=True)
class A1TrainConfig(TrainConfig):
    """The same with the A1's sizes: 13 million samples, an hour on one core."""

    robot: str = "a1"
    terrain: str = "gentle"
    actor: Literal["perceptive", "estimating", "dreamwaq"] = "estimating"
    disturbances: Literal["usual", "wide"] = "wide"
    iterations: Count = 500
    num_envs: Robots = 640
    label_seconds: Seconds = 0.8
    rows: Side = 5
    columns: Side = 10
    easiest_at_last: Annotated[float, Interval(ge=0, lt=1)] | None = 0.85
    std_at_last: Std | None = 0.12
    neighbours: Share = 0.6
    turned: Share = 0.4
    planning_speed: Speed = 0.65
    hidden: Widths = (256, 128)
    gamma: Share = 0.99
    entropy: Share = 0.001
    initial_std: Std = 0.5
    feasibility_learning_rate: Rate = 1e-3


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
    values["speed"] = list(config.speed) if config.speed else None
    values["start_from"] = str(config.start_from) if config.start_from else None
    return values


def training_world(config: TrainConfig, iteration: int = 0) -> World:
    """Lay out rows of rising difficulty, each with its own terrain variants.

    `general` takes the robot's specialties in turn, column by column. Seeds are even here, and odd
    wherever terrain is evaluated, so nothing is ever evaluated on terrain trained on.
    """
    mixed = ROBOTS[config.robot].scale.mixed
    names = mixed if config.terrain == "general" else (config.terrain,)
    levels = np.linspace(config.easiest, 1.0, config.rows) if config.rows > 1 else np.ones(1)
    shape = config.rows, config.columns
    rng = np.random.default_rng((config.seed, iteration))
    seeds = 2 * rng.integers(2**30, size=shape)
    between = rng.random(shape) < config.neighbours
    turned = rng.random(shape) < config.turned
    angles = rng.uniform(-180.0, 180.0, size=shape)

    def tile(row: int, column: int) -> Terrain:
        return training_tile(
            names[column % len(names)],
            robot=config.robot,
            difficulty=float(levels[row]),
            seed=int(seeds[row, column]),
            neighbours=bool(between[row, column]) and names[0] in mixed,
            angle=float(angles[row, column]) if turned[row, column] else None,
            square=config.turned > 0,
        )

    return World([[tile(row, column) for column in range(shape[1])] for row in range(shape[0])])


def training_tile(
    kind: str,
    *,
    robot: str,
    difficulty: float,
    seed: int,
    neighbours: bool = False,
    angle: float | None = None,
    square: bool = False,
) -> Terrain:
    """Return one terrain as a training has it.

    `neighbours` puts other obstacles at both ends; an `angle` (degrees) turns the obstacle, where
    the kind is one that can be turned. Terrains of a world that has turned ones are all `square`.
    """
    scale = ROBOTS[robot].scale
    if square:
        scale = dataclasses.replace(scale, width=scale.length)
    if angle is not None and kind in OBSTACLES:
        return make_turned(
            kind, robot=robot, angle=angle, difficulty=difficulty, seed=seed, scale=scale
        )
    return make_terrain(
        kind, robot=robot, difficulty=difficulty, seed=seed, scale=scale, neighbours=neighbours
    )


def make_training_env(config: TrainConfig, iteration: int = 0) -> LocomotionEnv:
    """Build the robots on the world in which training goes on from `iteration`."""
    make = env_class(config.robot)
    if config.disturbances not in make.disturbances:
        raise ConfigError(
            f"{config.robot} knows no {config.disturbances} disturbances: leave them usual"
        )
    settings = make.disturbances[config.disturbances]
    return make(
        training_world(config, iteration),
        config.num_envs,
        config=dataclasses.replace(
            make.episodes,
            speed=config.speed or make.episodes.speed,
            history=FRAMES.get(config.actor, 0),
            oblique=config.disturbances == "wide",
        ),
        seed=config.seed,
        device=config.device,
        **({"settings": settings} if settings else {}),
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
    if frames := FRAMES.get(config.actor):
        groups = {"actor": ["history"], "critic": ["critic"]}
        keep = [*env.unfelt, *env.felt]
        actor |= {"class_name": DreamWaQModel, "history": frames}
        if config.actor == "estimating":
            observations = env.get_observations()
            size, seen = (observations[group].shape[-1] for group in ("policy", "scan"))
            keep += range(size - seen, size)
            groups["actor"].append("scan")
            actor |= {"class_name": EstimatingModel, "seen": seen}
        actor["mirror"] = env.mirror and env.mirror.part(keep)
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
            "num_mini_batches": MINI_BATCHES,
            "clip_param": 0.2,
            "gamma": config.gamma,
            "lam": 0.95,
            "value_loss_coef": 0.5,
            "entropy_coef": config.entropy,
            "learning_rate": config.learning_rate,
            "desired_kl": 0.012,
            "label_steps": round(config.label_seconds / env.control_dt),
        },
    }
