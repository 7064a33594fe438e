"""What a Feasibility-Net says of its own terrain, measured with the finished policy on new ground.

Reads a specialist; gives quantiles of L_recon and of the strangeness on held-out terrain, driven
with deterministic actions, and, if asked for, a Feasibility-Net fitted anew (`refit`) to what the
finished policy meets where it was trained, or an f scaled to what it reaches. The policy is never
changed.
Source: paper, Sec. III-A (Eqs. 1-3); the calibration is ours (`feasibility.OodScore`).
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
import tyro
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.errors import ConfigError
from fgtutor.feasibility import (
    LEVELS,
    FeasibilityNet,
    HeightScale,
    Saturation,
    feasibility_labels,
)
from fgtutor.io.validation import Count, CountOrZero, Seed, Share, Width, check_fields
from fgtutor.learning.config import Speed, training_tile
from fgtutor.learning.refit import refitted, scaled
from fgtutor.robots import ROBOTS, condition_of, env_class
from fgtutor.specialist import GENERAL, Specialist, load_specialist, save_specialist
from fgtutor.world.terrain import Terrain, World

T = TypeVar("T")

HELD_OUT = 2**40
"""Where the seeds of calibration terrain begin: odd, so never trained on, and beyond the seeds of
every evaluation."""
RELIEF = 0.06
"""A patch with at least this difference of heights is distinctive of its terrain, m: flat ground is
familiar to every policy, and says nothing about which one."""


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Calibrate a specialist on held-out terrain of its own kind; its policy stays as it is."""

    folder: Annotated[Path, tyro.conf.Positional]
    """The specialist's folder."""
    out: Path | None = None
    """Where to write the calibrated specialist; default: in its place."""
    updates: CountOrZero = 0
    """Updates of a new autoencoder, fitted to what the policy meets on training terrain; with 0 it
    stays as it is."""
    hidden: tuple[Width, Width] | None = None
    """Widths of a smaller head, fitted to the old f in a quarter of the updates; None: it stays."""
    vae_hidden: tuple[Width, Width] = (64, 32)
    """Widths of the new encoder; the decoder mirrors them."""
    latent: Width = 24
    """Width of the new latent."""
    height_scale: HeightScale = 6.0
    """Units of height per metre of the new autoencoder."""
    saturation: Saturation | None = None
    """Difference of heights beyond which it hardly tells more from less, m; None: there is none."""
    easiest: Share = 0.85
    """Difficulty of the easiest terrain that it is fitted to: on easy ground, every specialist is
    at home. Less makes more ground familiar."""
    planning_speed: Speed | None = None
    """Forward speed at which the policy drives a route from now on, and which planning pairs with
    every patch, m/s, one that it was trained with; default: as it is."""
    agree_under: tuple[Literal["undisturbed", "disturbed"], ...] = ()
    """Presets under which f shall agree with r_v, in the mean over them: it is scaled to what the
    policy reaches on drives over held-out terrain under each; what is feasible stays so. Default:
    f stays as it is."""
    worlds: Count = 4
    """Training worlds that the patches for the new one come from."""
    envs: Annotated[int, Interval(ge=1, le=10_000)] = 100
    """Robots driven side by side, each on a terrain of its own."""
    seconds: Annotated[float, Interval(gt=0, le=3600)] = 16.0
    """How long they drive, s; ended episodes begin anew."""
    seed: Seed = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.hidden and not self.updates:
            raise ConfigError("a smaller head has to be fitted: give --updates with --hidden")


@dataclass(frozen=True, eq=False)
class Rollout:
    """Patches that a policy has met, and how it fared there."""

    patch: Float[Tensor, "n points"]
    """The patches under it, m."""
    command: Float[Tensor, "n command"]
    """The velocity that it was told."""
    label: Float[Tensor, "n"]
    """The mean r_v that followed, over the specialist's label window."""

    @property
    def distinctive(self) -> Float[Tensor, "m points"]:
        """The patches that are not flat; all of them, if all are."""
        relief = self.patch.amax(dim=-1) - self.patch.amin(dim=-1)
        return self.patch[relief >= min(RELIEF, relief.max().item())]


@torch.no_grad()
def roll_out(
    specialist: Specialist,
    tiles: Sequence[Terrain],
    num_envs: int,
    seconds: float,
    *,
    seed: int = 0,
    noise: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Rollout:
    """Drive a specialist over terrains; places, headings and commands are drawn as in training.

    Its actions are deterministic, unless they shall have the `noise` that it was trained with.
    `options` go to the robot's environment.
    """
    make = env_class(specialist.robot)
    episodes = replace(
        make.episodes, history=specialist.history, speed=speeds_trained_with(specialist)
    )
    env = make(World([tiles]), num_envs, config=episodes, seed=seed, **(options or {}))
    std = torch.zeros(env.num_actions)
    if noise:
        std += specialist.policy.state_dict()["distribution.log_std_param"].exp()
    rng = torch.Generator().manual_seed(seed)
    observations = env.get_observations()
    seen: dict[str, list[Tensor]] = {"tracking": [], "patch": [], "command": []}
    for _ in range(round(seconds / env.control_dt)):
        for name, values in seen.items():
            values.append(observations[name])
        actions = specialist.act(observations)
        observations, *_ = env.step(
            actions + std * torch.randn(actions.shape, generator=rng) if noise else actions
        )
    rollout = {name: torch.stack(values) for name, values in seen.items()}
    label, valid = feasibility_labels(
        rollout["tracking"], round(specialist.label_seconds / env.control_dt)
    )
    return Rollout(rollout["patch"][valid], rollout["command"][valid], label[valid])


def own_terrain(
    specialist: Specialist, count: int, first: int, *, easiest: float = 1.0
) -> list[Terrain]:
    """Return terrains of a specialist's kind, of seeds `first`, `first` + 2, ...

    As many of them have neighbours, or lie at any angle, as in its training.
    """
    kind = str(specialist.provenance.get("terrain", specialist.name))
    mixed = ROBOTS[specialist.robot].scale.mixed
    between, turned = (_trained_with(specialist, name, 0.0) for name in ("neighbours", "turned"))
    rng = np.random.default_rng(first)
    return [
        training_tile(
            mixed[i % len(mixed)] if kind == GENERAL else kind,
            robot=specialist.robot,
            difficulty=float(rng.uniform(easiest, 1.0)),
            seed=first + 2 * i,
            neighbours=bool(rng.random() < between) and kind in mixed,
            angle=float(rng.uniform(-180.0, 180.0)) if rng.random() < turned else None,
            square=turned > 0,
        )
        for i in range(count)
    ]


def speeds_trained_with(specialist: Specialist) -> tuple[float, float]:
    """Return the range of forward speeds that a specialist was told in training, m/s.

    Raises `ConfigError` if its provenance gives something else.
    """
    usual = env_class(specialist.robot).episodes
    told = _trained_with(specialist, "speed", [*usual.speed])
    return replace(usual, speed=tuple(told)).speed


def _trained_with(specialist: Specialist, setting: str, default: T) -> T:
    """Return what a specialist was trained with; the default if its provenance does not say."""
    training = specialist.provenance.get("config")
    value = training.get(setting) if isinstance(training, dict) else None
    return value if isinstance(value, type(default)) else default


@torch.no_grad()
def quantiles_on(
    net: FeasibilityNet, patch: Float[Tensor, "n points"]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the quantiles `LEVELS` of L_recon and of the strangeness over patches."""
    each = zip(*(net.losses(net.relief(part)) for part in patch.split(8192)), strict=True)
    loss, strangeness = map(torch.cat, each)

    def quantiles(values: Float[Tensor, " n"]) -> dict[str, float]:
        found = torch.quantile(values, torch.tensor(LEVELS)).tolist()
        return {str(level): value for level, value in zip(LEVELS, found, strict=True)}

    return quantiles(loss), quantiles(strangeness)


def met_in_training(specialist: Specialist, config: CalibrateConfig) -> Rollout:
    """Return what the finished policy meets, with its action noise, on worlds like its own."""
    met = []
    for world in range(config.worlds):
        first = 2 * (2**39 + 1000 * (config.seed * config.worlds + world))
        tiles = own_terrain(specialist, config.envs, first, easiest=config.easiest)
        met.append(
            roll_out(specialist, tiles, config.envs, config.seconds, seed=world + 1, noise=True)
        )
    fields = ("patch", "command", "label")
    return Rollout(*(torch.cat([getattr(one, name) for one in met]) for name in fields))


def calibrated(specialist: Specialist, config: CalibrateConfig) -> Specialist:
    """Return the specialist with quantiles measured on held-out terrain of full difficulty.

    With `config.updates`, its Feasibility-Net is fitted anew before; with `config.agree_under`, its
    f is scaled. Raises `ConfigError` if it was never trained at `config.planning_speed`, or its
    robot cannot be disturbed.
    """
    presets = [condition_of(specialist.robot, name).options for name in config.agree_under]
    if config.planning_speed:
        slowest, fastest = speeds_trained_with(specialist)
        if not slowest <= config.planning_speed <= fastest:
            raise ConfigError(
                f"{specialist.name} was trained with {slowest:g} to {fastest:g} m/s: choose a "
                f"planning speed between them, got {config.planning_speed:g}"
            )
        specialist = replace(specialist, command=(config.planning_speed, *specialist.command[1:]))
    if config.updates:
        specialist = replace(
            specialist,
            feasibility=refitted(specialist, met_in_training(specialist, config), config),
        )
    tiles = own_terrain(specialist, config.envs, 2 * (config.seed * 10_000 + HELD_OUT) + 1)
    held_out, *drives = (
        roll_out(specialist, tiles, config.envs, config.seconds, seed=config.seed, options=options)
        for options in (None, *presets)
    )
    if drives:
        specialist = replace(specialist, feasibility=scaled(specialist.feasibility, drives))
    quantiles, strangeness = quantiles_on(specialist.feasibility, held_out.distinctive)
    note = {
        "calibration": {
            "patches": len(held_out.distinctive),
            **{name: getattr(config, name) for name in ("envs", "seconds", "seed", "agree_under")},
        }
    }
    if config.updates:
        note["refit"] = {"updates": config.updates, "seed": config.seed}
    return replace(
        specialist,
        quantiles=quantiles,
        strangeness=strangeness,
        provenance={**specialist.provenance, **note},
    )


def run(config: CalibrateConfig) -> None:
    """Calibrate from the command line and say what was found."""
    specialist = calibrated(load_specialist(config.folder), config)
    out = save_specialist(specialist, config.out or config.folder)
    print(f"{specialist.name}: strangeness of its own terrain", file=sys.stderr)
    for level, score in specialist.strangeness.items():
        print(f"  {float(level):.1%} of its patches lie below {score:.4f}")
    print(f"-> {out}")
