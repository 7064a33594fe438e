"""What a Feasibility-Net says of its own terrain, measured with the finished policy on new ground.

Reads a specialist; gives quantiles of L_recon and of the strangeness on held-out terrain, driven
with deterministic actions, and, if asked for, an autoencoder fitted anew to what the finished
policy meets where it was trained. The policy and f are never changed.
Source: paper, Sec. III-A (Eqs. 1-3); the calibration is ours (`feasibility.OodScore`).
"""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.feasibility import (
    LEVELS,
    FeasibilityNet,
    HeightScale,
    Saturation,
    feasibility_labels,
)
from fgtutor.io.progress import watch
from fgtutor.io.validation import Count, CountOrZero, Seed, Width, check_fields
from fgtutor.robots import ROBOTS, env_class
from fgtutor.specialist import GENERAL, Specialist, load_specialist, save_specialist
from fgtutor.world.terrain import Terrain, World, make_terrain

HELD_OUT = 2**40
"""Where the seeds of calibration terrain begin: odd, so never trained on, and beyond the seeds of
every evaluation."""
EASIEST = 0.85
"""Difficulty of the easiest terrain that a Feasibility-Net is fitted to: easy ground is not what a
specialist is for, and ground that all of them know."""
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
    vae_hidden: tuple[Width, Width] = (128, 64)
    """Widths of the new encoder; the decoder mirrors them."""
    latent: Width = 24
    """Width of the new latent."""
    height_scale: HeightScale = 6.0
    """Units of height per metre of the new autoencoder."""
    saturation: Saturation | None = None
    """Difference of heights beyond which it hardly tells more from less, m; None: there is none."""
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
    episodes = replace(make.episodes, history=specialist.history)
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

    As many of them have neighbours as in its training.
    """
    kind = str(specialist.provenance.get("terrain", specialist.name))
    mixed = ROBOTS[specialist.robot].scale.mixed
    training = specialist.provenance.get("config")
    between = training.get("neighbours", 0.0) if isinstance(training, dict) else 0.0
    if kind not in mixed or not isinstance(between, float):
        between = 0.0
    rng = np.random.default_rng(first)
    return [
        make_terrain(
            mixed[i % len(mixed)] if kind == GENERAL else kind,
            robot=specialist.robot,
            difficulty=float(rng.uniform(easiest, 1.0)),
            seed=first + 2 * i,
            neighbours=bool(rng.random() < between),
        )
        for i in range(count)
    ]


@torch.no_grad()
def quantiles_on(
    net: FeasibilityNet, patch: Float[Tensor, "n points"]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the quantiles `LEVELS` of L_recon and of the strangeness over patches."""
    each = zip(*(net.losses(part) for part in patch.split(8192)), strict=True)
    loss, strangeness = map(torch.cat, each)

    def quantiles(values: Float[Tensor, " n"]) -> dict[str, float]:
        found = torch.quantile(values, torch.tensor(LEVELS)).tolist()
        return {str(level): value for level, value in zip(LEVELS, found, strict=True)}

    return quantiles(loss), quantiles(strangeness)


def fit_autoencoder(
    net: FeasibilityNet,
    patch: Float[Tensor, "n points"],
    updates: int,
    *,
    batch: int = 512,
    learning_rate: float = 3e-3,
    seed: int = 0,
    progress: bool = False,
) -> None:
    """Fit the autoencoder of a Feasibility-Net to patches (Eq. 3); its head stays as it is.

    The learning rate rises over the first 200 updates, and falls as a cosine.
    """
    rng = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam([*net.encoder.parameters(), *net.decoder.parameters()], fused=True)
    net.train().requires_grad_(True)
    for update in watch(range(updates), updates, "fitting", show=progress, unit="update"):
        rate = min(1.0, (update + 1) / 200) * (1 + math.cos(math.pi * update / updates)) / 2
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (rate + 1e-3)
        chosen = torch.randint(len(patch), (batch,), generator=rng)
        loss, _ = net.autoencoder_loss(patch[chosen], generator=rng)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    net.eval().requires_grad_(False)


def with_new_autoencoder(specialist: Specialist, config: CalibrateConfig) -> FeasibilityNet:
    """Return a Feasibility-Net that finds the same feasible, with an autoencoder fitted anew."""
    old = specialist.feasibility
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        net = FeasibilityNet(
            old.num_points,
            command_dim=old.command_dim,
            hidden=(old.hidden[0], old.hidden[1]),
            vae_hidden=config.vae_hidden,
            latent=config.latent,
            height_scale=config.height_scale,
            saturation=config.saturation,
        )
    net.head.load_state_dict(old.head.state_dict())
    with torch.no_grad():  # the head reads heights in the new units
        first = net.head.get_parameter("0.weight")
        first[:, : old.num_points] *= old.height_scale / config.height_scale
    met = []
    for world in range(config.worlds):
        first_seed = 2 * (2**39 + 1000 * (config.seed * config.worlds + world))
        tiles = own_terrain(specialist, config.envs, first_seed, easiest=EASIEST)
        met.append(
            roll_out(
                specialist, tiles, config.envs, config.seconds, seed=world + 1, noise=True
            ).patch
        )
    patch = torch.cat(met)
    if env_class(specialist.robot).mirror:  # its mirror image would have met theirs
        mirrored = patch.reshape(-1, *specialist.grid.shape).flip(-1).flatten(1)
        patch = torch.cat((patch, mirrored))
    fit_autoencoder(net, patch, config.updates, seed=config.seed, progress=True)
    return net


def calibrated(specialist: Specialist, config: CalibrateConfig) -> Specialist:
    """Return the specialist with quantiles measured on held-out terrain of full difficulty.

    With `config.updates`, its Feasibility-Net has a new autoencoder.
    """
    if config.updates:
        specialist = replace(specialist, feasibility=with_new_autoencoder(specialist, config))
    tiles = own_terrain(specialist, config.envs, 2 * (config.seed * 10_000 + HELD_OUT) + 1)
    held_out = roll_out(specialist, tiles, config.envs, config.seconds, seed=config.seed)
    quantiles, strangeness = quantiles_on(specialist.feasibility, held_out.distinctive)
    note = {
        "calibration": {
            "patches": len(held_out.distinctive),
            **{name: getattr(config, name) for name in ("updates", "envs", "seconds", "seed")},
        }
    }
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
