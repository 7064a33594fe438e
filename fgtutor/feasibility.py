"""Feasibility-Net: how well a policy would track its command here, and whether it knows the place.

Reads a patch H_xy (`patches.sample_patches`) and a velocity command; gives the feasibility f in
[0, 1] and the reconstruction loss L_recon from which the weight w_ood follows.
Source: paper, Sec. III-A (Eqs. 1-3) and Sec. III-B (Eq. 4).
"""

import math
from collections.abc import Mapping
from typing import overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from fgtutor.errors import ThresholdError

TAU_LOW, TAU_HIGH = 0.1, 2.0
"""The paper's thresholds on L_recon, m^2 summed over the patch (Eq. 4)."""
SIGMA = 0.25
"""The paper's scale of the velocity error, m/s (Eq. 1)."""


class FeasibilityNet(nn.Module):
    """An MLP head for feasibility beside a variational autoencoder of patches (paper, Fig. 2).

    Every layer that touches the patch is plain and linear first (no clipping, no normalisation) and
    the decoder ends in a linear layer: `tensorization` relies on both.
    """

    def __init__(
        self,
        num_points: int,
        *,
        command_dim: int = 3,
        hidden: tuple[int, int] = (128, 64),
        latent: int = 16,
    ) -> None:
        """Build the three networks; widths other than the patch's are TRAINING defaults."""
        super().__init__()
        self.num_points, self.command_dim = num_points, command_dim
        self.hidden, self.latent = tuple(hidden), latent
        wide, narrow = self.hidden
        self.head = _mlp(num_points + command_dim, wide, narrow, 1)
        self.encoder = _mlp(num_points, wide, narrow, 2 * latent)
        self.decoder = _mlp(latent, narrow, wide, num_points)

    def feasibility(
        self, patch: Float[Tensor, "*batch points"], command: Float[Tensor, "*batch command"]
    ) -> Float[Tensor, "*batch"]:
        """Predict the tracking reward r_v, in [0, 1], of this command on this patch."""
        return torch.sigmoid(self.head(torch.cat((patch, command), dim=-1))).squeeze(-1)

    def reconstruction(self, patch: Float[Tensor, "*batch points"]) -> Float[Tensor, "*batch"]:
        """Return L_recon, m^2: the squared height error SUMMED over the patch.

        It decodes the latent mean, so the same patch always gets the same answer.
        """
        mean, _ = self.encoder(patch).chunk(2, dim=-1)
        return (self.decoder(mean) - patch).square().sum(dim=-1)

    def loss(
        self,
        patch: Float[Tensor, "batch points"],
        command: Float[Tensor, "batch command"],
        r_v: Float[Tensor, "batch"],
        alpha: float = 1.0,
        beta: float = 5e-4,
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
        """Return (f - r_v)^2 + alpha (L_recon + beta L_KL) and its three parts, batch means.

        Eqs. 2-3 with the paper's alpha and beta. In training mode the latent is sampled (and
        reparameterised, with `generator` if given); in evaluation mode it is the mean.
        """
        mean, log_variance = self.encoder(patch).chunk(2, dim=-1)
        latent = mean
        if self.training:
            noise = torch.empty_like(mean).normal_(generator=generator)
            latent = mean + noise * torch.exp(0.5 * log_variance)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        parts = {
            "feasibility": (self.feasibility(patch, command) - r_v).square().mean(),
            "reconstruction": (self.decoder(latent) - patch).square().sum(dim=-1).mean(),
            "kl": divergence.mean(),
        }
        total = parts["feasibility"] + alpha * (parts["reconstruction"] + beta * parts["kl"])
        return total, parts


def tracking_reward(
    velocity: Float[Tensor, "*batch axes"],
    command: Float[Tensor, "*batch axes"],
    sigma: float = SIGMA,
) -> Float[Tensor, "*batch"]:
    """Return r_v = exp(-||v - v_cmd||_2 / sigma), in (0, 1] (Eq. 1: the norm, not its square)."""
    return torch.exp(-torch.linalg.vector_norm(velocity - command, dim=-1) / sigma)


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
    if isinstance(weight, Tensor):
        return weight.clamp(0, 1)
    if isinstance(weight, np.ndarray):
        return weight.clip(0, 1)
    return min(max(float(weight), 0.0), 1.0)


def calibrated_taus(quantiles: Mapping[str, float]) -> tuple[float, float]:
    """Return (tau_low, tau_high) from quantiles of L_recon on the specialist's own terrain.

    tau_low is the 95 % quantile: nearly all of the own terrain keeps full weight. tau_high is twice
    the 99 % quantile, and at least twice tau_low: a patch reconstructed worse than that is as good
    as unseen. Raises `ThresholdError` if "0.95" or "0.99" is missing or is not a positive number.
    """
    try:
        q95, q99 = float(quantiles["0.95"]), float(quantiles["0.99"])
    except (KeyError, TypeError, ValueError) as error:
        raise ThresholdError(
            f'calibrated taus need the quantiles "0.95" and "0.99" of L_recon, got '
            f'{dict(quantiles)}: train the specialist again, or use taus="paper"'
        ) from error
    if not (0 < q95 <= q99 < math.inf):
        raise ThresholdError(
            f"quantiles of L_recon must be positive and increasing, got q95 = {q95}, q99 = {q99}: "
            'train the specialist again, or use taus="paper"'
        )
    return q95, 2 * max(q95, q99)


def _mlp(inputs: int, first: int, second: int, outputs: int) -> nn.Sequential:
    """Build linear - ELU - linear - ELU - linear."""
    return nn.Sequential(
        nn.Linear(inputs, first), nn.ELU(), nn.Linear(first, second), nn.ELU(),
        nn.Linear(second, outputs),
    )  # fmt: skip
