"""Feasibility-Net: how well a policy would track a command here, and how familiar the terrain is.

Reads a patch H_xy (`patches.sample_patches`) and a velocity command; gives the feasibility f in
[0, 1] and the reconstruction loss L_recon from which the weight w_ood follows. The labels that f
is trained on come from a rollout's velocities (`tracking_reward`, `feasibility_labels`).
Source: paper, Sec. III-A (Eqs. 1-3) and Sec. III-B (Eq. 4).
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, overload

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from torch import Tensor, nn

from fgtutor.errors import ThresholdError
from fgtutor.io.validation import Width

HeightScale = Annotated[float, Interval(gt=0, le=1000)]
"""Units of height per metre."""
TAU_LOW, TAU_HIGH = 0.1, 2.0
"""The paper's thresholds on L_recon, summed over the patch (Eq. 4)."""
SIGMA = 0.25
"""Scale of the tracking reward, m/s (Eq. 1)."""


def tracking_reward(
    velocity: Float[Tensor, "*batch 2"], command: Float[Tensor, "*batch 2"], sigma: float = SIGMA
) -> Float[Tensor, "*batch"]:
    """Return r_v = exp(-||v - v_cmd||_2 / sigma), in (0, 1] (Eq. 1: the norm, unsquared)."""
    return torch.exp(-(velocity - command).norm(dim=-1) / sigma)


def feasibility_labels(
    tracking: Float[Tensor, "time envs 3"], window: int
) -> tuple[Float[Tensor, "time envs"], Bool[Tensor, "time envs"]]:
    """Return the mean r_v over the next `window` steps, and where that mean is trustworthy.

    `tracking[t]` holds (r_v, failed, ended) of the step that led to time t. A failure makes
    the rest of its window zero; a time-out cuts it short; no label reaches into the next episode.
    A label counts if at least half of its window was seen. `window` 0 means 1, the paper's label.

    `failed` between 0 and 1 is a failure that reaches back over that share of the window only;
    labels from further back treat it as a time-out.
    """
    window = max(window, 1)
    steps = tracking.shape[0]
    total = torch.zeros_like(tracking[..., 0])
    seen = torch.zeros_like(total)
    running = torch.ones_like(total, dtype=torch.bool)
    reach = torch.zeros_like(total)
    for ahead in range(1, min(window, steps - 1) + 1):
        r_v, failed, ended = tracking[ahead:].unbind(-1)
        now = running[:-ahead]
        total[:-ahead] += r_v * now
        seen[:-ahead] += now
        reach[:-ahead] += window * failed * now
        running[:-ahead] = now & (ended == 0)
        running[-ahead:] = False
    # Steps of a failed episode that never happened still count, as zeros.
    return total / seen.maximum(reach).clamp(min=1), (seen >= (window + 1) // 2) | (reach > 0)


class FeasibilityNet(nn.Module):
    """An MLP head for feasibility beside a variational autoencoder of patches (paper, Fig. 2).

    Patches enter times a fixed `height_scale`, never clipped or normalised one by one: what a layer
    sees stays a linear function of the map, which `tensorization` relies on.
    """

    def __init__(
        self,
        num_points: Width,
        *,
        command_dim: Width = 3,
        hidden: tuple[Width, Width] = (128, 64),
        vae_hidden: tuple[Width, Width] = (256, 128),
        latent: Width = 16,
        height_scale: HeightScale = 4.0,
    ) -> None:
        """Build the head and the two halves of the autoencoder.

        Args:
            num_points: Points of a patch.
            command_dim: Numbers in a command.
            hidden: Widths of the head.
            vae_hidden: Widths of the encoder; the decoder mirrors them.
            latent: Width of the latent.
            height_scale: Units of height per metre. At 4 a unit is 0.25 m, a tall step for these
                robots; then the paper's tau = 0.1 and 2.0 lie between known and unknown terrain.
        """
        super().__init__()
        self.num_points, self.command_dim = num_points, command_dim
        self.hidden, self.vae_hidden = tuple(hidden), tuple(vae_hidden)
        self.latent, self.height_scale = latent, height_scale
        self.head = _mlp(nn.ELU, num_points + command_dim, *hidden, 1)
        # tanh saturates: unlike ELU it cannot extrapolate to terrain steeper than any it has seen.
        self.encoder = _mlp(nn.Tanh, num_points, *vae_hidden, 2 * latent)
        self.decoder = _mlp(nn.Tanh, latent, *vae_hidden[::-1], num_points)

    def feasibility(
        self, patch: Float[Tensor, "*batch points"], command: Float[Tensor, "*batch command"]
    ) -> Float[Tensor, "*batch"]:
        """Predict the tracking reward r_v, in [0, 1], of this command on this patch."""
        inputs = torch.cat((self.height_scale * patch, command), dim=-1)
        return torch.sigmoid(self.head(inputs)).squeeze(-1)

    def reconstruction(self, patch: Float[Tensor, "*batch points"]) -> Float[Tensor, "*batch"]:
        """Return L_recon: the squared height error SUMMED over the patch, in scaled units.

        It decodes the latent mean, so the same patch always gets the same answer.
        """
        heights = self.height_scale * patch
        mean, _ = self.encoder(heights).chunk(2, dim=-1)
        return (self.decoder(mean) - heights).square().sum(dim=-1)

    def loss(
        self,
        patch: Float[Tensor, "batch points"],
        command: Float[Tensor, "batch command"],
        r_v: Float[Tensor, "batch"],
        *,
        alpha: float = 1.0,
        beta: float = 5e-4,
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
        """Return (f - r_v)^2 + alpha (L_recon + beta L_KL) and its three parts, batch means.

        Eqs. 2-3 with the paper's alpha and beta. In training mode the latent is sampled (and
        reparameterised, with `generator` if given); in evaluation mode it is the mean.
        """
        heights = self.height_scale * patch
        mean, log_variance = self.encoder(heights).chunk(2, dim=-1)
        latent = mean
        if self.training:
            noise = torch.empty_like(mean).normal_(generator=generator)
            latent = mean + noise * torch.exp(0.5 * log_variance)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        parts = {
            "feasibility": (self.feasibility(patch, command) - r_v).square().mean(),
            "reconstruction": (self.decoder(latent) - heights).square().sum(dim=-1).mean(),
            "kl": divergence.mean(),
        }
        total = parts["feasibility"] + alpha * (parts["reconstruction"] + beta * parts["kl"])
        return total, parts


@overload
def ood_weight(loss: Tensor, tau_low: float = ..., tau_high: float = ...) -> Tensor: ...
@overload
def ood_weight(loss: np.ndarray, tau_low: float = ..., tau_high: float = ...) -> np.ndarray: ...
@overload
def ood_weight(loss: float, tau_low: float = ..., tau_high: float = ...) -> float: ...
def ood_weight(
    loss: Tensor | np.ndarray | float, tau_low: float = TAU_LOW, tau_high: float = TAU_HIGH
) -> Tensor | np.ndarray | float:
    """Return w_ood = clip(1 - (L_recon - tau_low) / (tau_high - tau_low), 0, 1) (Eq. 4).

    1 where the terrain looks like the training terrain, 0 where it does not. Raises
    `ThresholdError` unless tau_low < tau_high, both finite.
    """
    if not (math.isfinite(tau_low) and math.isfinite(tau_high) and tau_low < tau_high):
        raise ThresholdError(
            f"w_ood needs finite tau_low < tau_high, got {tau_low} and {tau_high}: "
            "raise tau_high or lower tau_low"
        )
    weight = 1 - (loss - tau_low) / (tau_high - tau_low)
    if isinstance(weight, Tensor | np.ndarray):
        return weight.clip(0, 1)
    return min(max(float(weight), 0.0), 1.0)


def calibrated_taus(quantiles: Mapping[str, float]) -> tuple[float, float]:
    """Return (tau_low, tau_high): the 90 % quantile of L_recon on the own terrain, twice the 99 %.

    So nine tenths of the own terrain keep full weight. Why not stop at the 99 % quantile? A route
    has a hundred places and needs every one of them: with one odd place in a hundred closed, a
    fifth of all crossings of the own terrain found no route at all. Twice as badly reconstructed
    counts as never seen. Raises `ThresholdError` if "0.9" or "0.99" is missing or the two are not
    positive and increasing.
    """
    try:
        low, high = float(quantiles["0.9"]), float(quantiles["0.99"])
    except (KeyError, TypeError, ValueError, OverflowError):
        low = high = math.nan
    if not (0 < low < high and 2 * high < math.inf):
        raise ThresholdError(
            'calibrated taus need positive, increasing quantiles "0.9" and "0.99" of L_recon, got '
            f'{dict(quantiles)}: train the specialist again, or use taus="paper"'
        )
    return low, 2 * high


def _mlp(activation: type[nn.Module], *widths: int) -> nn.Sequential:
    """Build linear layers between the given widths, with an activation after all but the last."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])
