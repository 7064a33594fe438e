"""Feasibility-Net: how well a policy would track a command here, and how familiar the terrain is.

Reads a patch H_xy (`patches.sample_patches`) and a velocity command; gives the feasibility f in
[0, 1] and the reconstruction loss L_recon from which the weight w_ood follows (`OodScore`). The
labels that f is trained on come from a rollout's velocities (`tracking_reward`,
`feasibility_labels`).
Source: paper, Sec. III-A (Eqs. 1-3) and Sec. III-B (Eq. 4). The saturation of heights, strangeness
and its p-value are ours.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
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
Saturation = Annotated[float, Interval(ge=1e-3, le=100)]
"""Difference of heights beyond which the autoencoder hardly tells more from less, m."""
TAU_LOW, TAU_HIGH = 0.1, 2.0
"""The paper's thresholds on L_recon, summed over the patch (Eq. 4)."""
ALPHA = 0.03
"""Share of its own terrain that a policy may call less than fully familiar."""
LEVELS = (0.5, 0.9, 0.95, 0.99, 0.995, 0.999)
"""Quantiles of L_recon and of the strangeness on its own terrain that a specialist stores."""
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


def tanh(x: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Return tanh x as 2 sigmoid(2 x) - 1, which takes torch a quarter of the time on a CPU."""
    return 2 * torch.sigmoid(2 * x) - 1


class Tanh(nn.Module):
    """`tanh` as a layer."""

    def forward(self, x: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
        """Return tanh of each number."""
        return tanh(x)


class FeasibilityNet(nn.Module):
    """An MLP head for feasibility beside a variational autoencoder of patches (paper, Fig. 2).

    Patches enter times a fixed `height_scale`, never normalised one by one. For the autoencoder
    they may saturate before: else the depth of a chasm or the top of a wall, far beyond any step,
    makes most of the loss, and the shape of the ground under the robot little of it.
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
        saturation: Saturation | None = None,
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
            saturation: The autoencoder sees heights h as s tanh(h / s), s in m; None is h itself.
        """
        super().__init__()
        self.num_points, self.command_dim = num_points, command_dim
        self.hidden, self.vae_hidden = tuple(hidden), tuple(vae_hidden)
        self.latent, self.height_scale, self.saturation = latent, height_scale, saturation
        self.head = _mlp(nn.ELU, num_points + command_dim, *hidden, 1)
        # tanh saturates: unlike ELU it cannot extrapolate to terrain steeper than any it has seen.
        self.encoder = _mlp(Tanh, num_points, *vae_hidden, 2 * latent)
        self.decoder = _mlp(Tanh, latent, *vae_hidden[::-1], num_points)

    def feasibility(
        self, patch: Float[Tensor, "*batch points"], command: Float[Tensor, "*batch command"]
    ) -> Float[Tensor, "*batch"]:
        """Predict the tracking reward r_v, in [0, 1], of this command on this patch."""
        inputs = torch.cat((self.height_scale * patch, command), dim=-1)
        return torch.sigmoid(self.head(inputs)).squeeze(-1)

    def relief(self, patch: Float[Tensor, "*batch points"]) -> Float[Tensor, "*batch points"]:
        """Return the heights that the autoencoder sees, in its units."""
        if self.saturation is not None:
            return (self.height_scale * self.saturation) * tanh(patch / self.saturation)
        return self.height_scale * patch

    def reconstruction(self, patch: Float[Tensor, "*batch points"]) -> Float[Tensor, "*batch"]:
        """Return L_recon: the squared height error SUMMED over the patch, in scaled units.

        It decodes the latent mean, so the same patch always gets the same answer.
        """
        return self.losses(self.relief(patch))[0]

    def losses(
        self, heights: Float[Tensor, "*batch points"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return L_recon and the strangeness L_recon / (1 + sum h^2) of a patch's `relief` h.

        The share of a patch's relief that is not understood: low rubble, badly reconstructed, is
        as strange as a high wall.
        """
        mean, _ = self.encoder(heights).chunk(2, dim=-1)
        loss = (self.decoder(mean) - heights).square().sum(dim=-1)
        return loss, loss / (1 + heights.square().sum(dim=-1))

    @torch.no_grad()
    def folded(self, command: Float[Tensor, "command"]) -> "FoldedNet":
        """Return the same net for one command and many patches, in about two thirds of the time."""
        points, mean = self.num_points, slice(0, self.latent)
        (weight, bias), *rest = _linear(self.head)
        first = self.height_scale * weight[:, :points], bias + weight[:, points:] @ command
        head = [first, *((w, b - w.sum(dim=1)) for w, b in rest)]  # see `FoldedNet.feasibility`
        # The latent mean is linear in the encoder's last layer, and so is what the decoder makes
        # of it first: one layer. tanh x = 2 sigmoid(2 x) - 1: the constants go into the layers.
        *encoder, (to_mean, at) = _linear(self.encoder)
        (wide, shift), *decoder = _linear(self.decoder)
        layers = [*encoder, (wide @ to_mean[mean], wide @ at[mean] + shift), *decoder]
        inner = [(2 * w, b - w.sum(dim=1)) for w, b in layers[1:]]
        outer = [(2 * w, 2 * b) for w, b in (layers[0], *inner[:-1])]
        return FoldedNet(head, [*outer, inner[-1]])

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
        reconstruction, parts = self.autoencoder_loss(patch, beta=beta, generator=generator)
        error = (self.feasibility(patch, command) - r_v).square().mean()
        return error + alpha * reconstruction, {"feasibility": error, **parts}

    def autoencoder_loss(
        self,
        patch: Float[Tensor, "batch points"],
        *,
        beta: float = 5e-4,
        generator: torch.Generator | None = None,
    ) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
        """Return L_recon + beta L_KL and its two parts, batch means (Eq. 3); sampled as `loss`."""
        heights = self.relief(patch)
        mean, log_variance = self.encoder(heights).chunk(2, dim=-1)
        latent = mean
        if self.training:
            noise = torch.empty_like(mean).normal_(generator=generator)
            latent = mean + noise * torch.exp(0.5 * log_variance)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        parts = {
            "reconstruction": (self.decoder(latent) - heights).square().sum(dim=-1).mean(),
            "kl": divergence.mean(),
        }
        return parts["reconstruction"] + beta * parts["kl"], parts


class FoldedNet:
    """A `FeasibilityNet` with its command and all constants multiplied into its layers.

    It gives the same numbers but for rounding: f within 1e-6, L_recon within a few millionths of
    the patch's relief sum h^2.
    """

    def __init__(
        self, head: list[tuple[Tensor, Tensor]], autoencoder: list[tuple[Tensor, Tensor]]
    ) -> None:
        """Take weights and biases of the head, and those of the autoencoder between sigmoids."""
        self.head, self.autoencoder = (
            [(weight.T.contiguous(), bias) for weight, bias in layers]
            for layers in (head, autoencoder)
        )

    def feasibility(self, patch: Float[Tensor, "n points"]) -> Float[Tensor, " n"]:
        """Predict f of each patch (`FeasibilityNet.feasibility`)."""
        inner = patch
        *hidden, (weight, bias) = self.head
        for layer, shift in hidden:
            inner = torch.addmm(shift, inner, layer)
            # ELU, and 1: torch's own takes twice as long.
            inner = inner.clamp(max=0).exp_().add_(inner.clamp_(min=0))
        return torch.addmm(bias, inner, weight).sigmoid_().squeeze(-1)

    def reconstruction(self, heights: Float[Tensor, "n points"]) -> Float[Tensor, " n"]:
        """Return L_recon of each patch's `relief` (`FeasibilityNet.losses`)."""
        inner = heights
        *hidden, (weight, bias) = self.autoencoder
        for layer, shift in hidden:
            inner = torch.addmm(shift, inner, layer).sigmoid_()
        missed = torch.addmm(heights, inner, weight, alpha=-1).sub_(bias)
        return torch.linalg.vector_norm(missed, dim=-1).square()


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


@dataclass(frozen=True, eq=False)
class OodScore:
    """By what a patch is called strange, and the weight w_ood that follows.

    The paper's is L_recon between two thresholds (Eq. 4). Ours is a p-value: the share of patches
    of the policy's own held-out terrain that are at least as strange (a conformal test). A patch is
    strange if either L_recon or the strangeness (`FeasibilityNet.losses`) is: p is twice the
    smaller one of their two p-values (Bonferroni). So one number, `alpha`, means the same for every
    policy: of its own terrain, a share of at most alpha loses weight.
    """

    taus: tuple[float, float] | None = (TAU_LOW, TAU_HIGH)
    """Thresholds on L_recon; None: ours."""
    own: tuple[Mapping[str, float], Mapping[str, float]] | None = None
    """Quantiles of L_recon and of the strangeness on the own terrain, by probability ("0.99": ...);
    ours only."""
    alpha: float = ALPHA
    """p-value from which a patch has full weight; ours only."""

    def __post_init__(self) -> None:
        if self.taus is not None:
            ood_weight(0.0, *self.taus)
        elif not 0 < self.alpha < 1:
            raise ThresholdError(f"alpha must lie between 0 and 1, got {self.alpha!r}")
        else:
            self._tails()

    def weight(
        self, loss: Float[Tensor, "*batch"], strangeness: Float[Tensor, "*batch"] | None = None
    ) -> Float[Tensor, "*batch"]:
        """Return w_ood in [0, 1]: Eq. 4 of L_recon, or clip(p / alpha).

        Raises `ThresholdError` if ours is asked for without the strangeness.
        """
        if self.taus is not None:
            return ood_weight(loss, *self.taus)
        if strangeness is None:
            raise ThresholdError(
                "calibrated weights need the strangeness of each patch: assess the map, or give "
                "thresholds on L_recon"
            )
        return (self.p_value(loss, strangeness) / self.alpha).clip(0, 1)

    def p_value(
        self, loss: Float[Tensor, "*batch"], strangeness: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return p in [0, 1], ours only."""
        each = zip(self._tails(), (loss, strangeness), strict=True)
        first, second = (_share_beyond(*tail, score) for tail, score in each)
        return (2 * first.minimum(second)).clip(0, 1)

    def _tails(self) -> list[tuple[Tensor, Tensor]]:
        """Return for both scores the shares of own patches beyond each quantile, and the latter."""
        tails = []
        for quantiles in self.own or ({}, {}):
            try:
                pairs = sorted((float(level), float(score)) for level, score in quantiles.items())
            except (TypeError, ValueError, OverflowError):
                pairs = []
            levels, scores = [level for level, _ in pairs], [score for _, score in pairs]
            growing = all(0 < a < b < math.inf for a, b in pairwise(scores))
            if len(pairs) < 2 or not growing or levels[0] <= 0 or levels[-1] >= 1:
                raise ThresholdError(
                    "calibrated weights need two or more positive, increasing quantiles of L_recon "
                    f"and of the strangeness, got {dict(quantiles)}: run `fgtutor calibrate` on "
                    'the folder, or use taus="paper"'
                )
            tails.append((1 - torch.tensor(levels), torch.tensor(scores)))
        return tails


def _share_beyond(
    shares: Float[Tensor, "levels"],
    scores: Float[Tensor, "levels"],
    score: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Return the share of own patches with at least this score.

    Between the quantiles its logarithm is linear in that of the score, and beyond the last one it
    falls on as steeply (a Pareto tail).
    """
    x, p = torch.log(scores), torch.log(shares)
    at = torch.log(score.clamp(min=1e-12)).contiguous()
    i = torch.searchsorted(x, at).clamp(1, len(x) - 1)
    slope = (p[i] - p[i - 1]) / (x[i] - x[i - 1])
    return torch.exp(p[i - 1] + slope * (at - x[i - 1])).clip(0, 1)


def _linear(layers: nn.Sequential) -> list[tuple[Tensor, Tensor]]:
    """Return weight and bias of each linear layer."""
    return [(layer.weight, layer.bias) for layer in layers if isinstance(layer, nn.Linear)]


def _mlp(activation: type[nn.Module], *widths: int) -> nn.Sequential:
    """Build linear layers between the given widths, with an activation after all but the last."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])
