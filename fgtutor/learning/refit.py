"""A new Feasibility-Net for a finished policy: another autoencoder, and a head that says the same.

Reads what the policy met in training; gives a net whose autoencoder is fitted to it (Eq. 3), and
whose head is the old one, or a smaller one that repeats the old one's f anywhere (distillation).
Or one whose f is scaled until it agrees with the r_v that the finished policy reached.
Source: paper, Sec. III-A; the refit is ours; the scaling is Platt's (1999).
"""

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage, optimize, special
from torch import Tensor, nn

from fgtutor import patches
from fgtutor.elevation import ElevationMap
from fgtutor.feasibility import FeasibilityNet
from fgtutor.io.progress import watch
from fgtutor.robots import ROBOTS, env_class
from fgtutor.settings import PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import make_terrain

if TYPE_CHECKING:
    from fgtutor.learning.calibrate import CalibrateConfig, Rollout

GROUNDS = 150
"""Maps that a smaller head is fitted to, besides what the policy met."""
POSES = 1200
"""Patches of each of them."""
BATCH = 512
"""Patches per update."""


def refitted(specialist: Specialist, met: "Rollout", config: "CalibrateConfig") -> FeasibilityNet:
    """Return a Feasibility-Net that finds the same feasible, with an autoencoder fitted anew."""
    old = specialist.feasibility
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        net = FeasibilityNet(
            old.num_points,
            command_dim=old.command_dim,
            hidden=config.hidden or (old.hidden[0], old.hidden[1]),
            vae_hidden=config.vae_hidden,
            latent=config.latent,
            height_scale=config.height_scale,
            saturation=config.saturation,
        )
    if config.hidden:
        fit_head(net, specialist, met, config.updates // 4, config.easiest, seed=config.seed)
    else:
        net.head.load_state_dict(old.head.state_dict())
        with torch.no_grad():  # the head reads heights in the new units
            first = net.head.get_parameter("0.weight")
            first[:, : old.num_points] *= old.height_scale / config.height_scale
    patch = met.patch
    if env_class(specialist.robot).mirror:  # its mirror image would have met theirs
        mirrored = patch.reshape(-1, *specialist.grid.shape).flip(-1).flatten(1)
        patch = torch.cat((patch, mirrored))
    fit_autoencoder(net, patch, config.updates, seed=config.seed)
    return net


def fit_autoencoder(
    net: FeasibilityNet, patch: Float[Tensor, "n points"], updates: int, *, seed: int = 0
) -> None:
    """Fit the autoencoder of a Feasibility-Net to patches (Eq. 3); its head stays as it is."""

    def loss(rng: torch.Generator) -> Float[Tensor, ""]:
        chosen = torch.randint(len(patch), (min(BATCH, len(patch)),), generator=rng)
        return net.autoencoder_loss(patch[chosen], generator=rng)[0]

    weights = [*net.encoder.parameters(), *net.decoder.parameters()]
    _fit(net, weights, updates, loss, "fitting L_recon", seed)


def fit_head(
    net: FeasibilityNet,
    specialist: Specialist,
    met: "Rollout",
    updates: int,
    easiest: float,
    *,
    seed: int = 0,
) -> None:
    """Fit the head of a net to what a specialist's says of patches met and of any ground.

    Planning asks about any ground, so the two must agree also where the policy never was.
    """
    anywhere = any_ground(specialist, easiest, seed)
    command = torch.tensor(specialist.command, dtype=torch.float32).expand(len(anywhere), -1)
    both = [(met.patch, met.command), (anywhere, command)]
    with torch.no_grad():
        said = [specialist.feasibility.feasibility(*inputs) for inputs in both]

    def loss(rng: torch.Generator) -> Float[Tensor, ""]:
        errors = []
        for (patch, command), f in zip(both, said, strict=True):
            chosen = torch.randint(len(patch), (BATCH,), generator=rng)
            errors.append(net.feasibility(patch[chosen], command[chosen]) - f[chosen])
        return torch.cat(errors).square().mean()

    _fit(net, net.head.parameters(), updates, loss, "fitting f", seed)


@torch.no_grad()
def scaled(net: FeasibilityNet, drives: Sequence["Rollout"]) -> FeasibilityNet:
    """Return the net with an f that agrees with the r_v that followed.

    The logit of f is stretched about that of `f_min`, by a factor fitted to all labels of the
    drives in squared error: a step is feasible to the new net if it was to the old one, and what is
    more feasible stays so. Source: Platt (1999), who shifts the logit as well.
    """
    f = torch.cat([net.feasibility(one.patch, one.command) for one in drives])
    pivot = special.logit(PlanSettings().f_min)
    (factor,), _ = optimize.curve_fit(
        lambda beyond, factor: special.expit(pivot + factor * beyond),
        f.logit(eps=1e-6).numpy() - pivot,
        torch.cat([one.label for one in drives]).numpy(),
        p0=1.0,
        bounds=(0.0, np.inf),
    )
    net = copy.deepcopy(net)
    weight, bias = list(net.head.parameters())[-2:]
    weight *= factor
    bias *= factor
    bias += (1 - factor) * pivot
    return net


def any_ground(specialist: Specialist, easiest: float, seed: int = 0) -> Float[Tensor, "n points"]:
    """Return patches of whatever a map may hold: obstacles of every kind, and natural ground.

    Difficulties of the obstacles are drawn between `easiest` and 1.
    """
    rng = np.random.default_rng(seed)
    kinds = ("mixed", *ROBOTS[specialist.robot].scale.mixed, "rubble", "slopes")
    cut = []
    for i in range(GROUNDS):
        elevation = make_terrain(
            kinds[i % len(kinds)],
            robot=specialist.robot,
            difficulty=float(rng.uniform(easiest, 1.0)),
            seed=2 * (2**38 + 1000 * seed + i),
        ).elevation
        if i % 3 == 0:
            elevation = natural_ground(elevation, rng)
        cut.append(cut_anywhere(elevation, specialist.grid, POSES, rng))
    return torch.cat(cut)


def natural_ground(like: ElevationMap, rng: np.random.Generator) -> ElevationMap:
    """Return hills, stones and roughness: noise of three wavelengths, on as many cells."""
    widths = rng.uniform((0.3, 0.08, 0.0), (1.2, 0.25, 0.0)) / like.resolution
    heights = rng.uniform((0.02, 0.0, 0.0), (0.25, 0.06, 0.01))
    noise = rng.normal(size=(3, *like.shape))
    layers = [ndimage.gaussian_filter(*one) for one in zip(noise, widths, strict=True)]
    hills = [h * one / one.std() for h, one in zip(heights, layers, strict=True)]
    return ElevationMap(np.sum(hills, axis=0), like.resolution)


def cut_anywhere(
    elevation: ElevationMap, grid: patches.PatchGrid, count: int, rng: np.random.Generator
) -> Float[Tensor, "count points"]:
    """Cut patches anywhere on a map, along any heading."""
    prepared = patches.prepare(elevation)
    extent = (*(n * prepared.resolution for n in prepared.shape), 2 * math.pi)
    poses = torch.tensor(rng.uniform(0, extent, (count, 3)), dtype=torch.float32)
    heights = torch.tensor(prepared.heights)
    return patches.sample_patches(heights, poses, grid, resolution=prepared.resolution)


def _fit(
    net: FeasibilityNet,
    weights: Iterable[nn.Parameter],
    updates: int,
    loss: Callable[[torch.Generator], Float[Tensor, ""]],
    name: str,
    seed: int,
) -> None:
    """Fit some weights of a net to a loss of randomly chosen patches; `name` is on the bar.

    The learning rate rises over the first 200 updates, and falls as a cosine.
    """
    rng = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(list(weights), fused=True)
    net.train().requires_grad_(True)
    for update in watch(range(updates), updates, name, show=True, unit="update"):
        rate = min(1.0, (update + 1) / 200) * (1 + math.cos(math.pi * update / updates)) / 2
        for group in optimizer.param_groups:
            group["lr"] = 3e-3 * (rate + 1e-3)
        optimizer.zero_grad()
        loss(rng).backward()
        optimizer.step()
    net.eval().requires_grad_(False)
