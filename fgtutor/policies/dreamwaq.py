"""DreamWaQ, the paper's training protocol: a policy that infers what it cannot feel from a history.

Reads the last frames of proprioception, and a scan of the ground unless the policy is blind. A
context encoder estimates from the frames the body's velocity and a latent that says enough about
body and ground to predict the next frame; the policy acts on the newest frame, both, and the scan.
The critic, needed in training only, observes everything.
Source: paper, Sec. IV; Nahrendra et al., "DreamWaQ: Learning Robust Quadrupedal Locomotion With
Implicit Terrain Imagination via Deep Reinforcement Learning", ICRA 2023. Left out: its adaptive
bootstrapping, which at times shows the policy the true velocity in training.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from fgtutor.errors import ConfigError
from fgtutor.io.rsl import MLP, MLPModel
from fgtutor.io.validation import Width
from fgtutor.policies.symmetry import Mirror, SymmetricMLP, SymmetricMLPModel, join

HISTORY = 5
"""Frames that a blind policy remembers, the newest included."""
LONGER = 10
"""Frames that a seeing one does: the longer, the better a late or weak body can be told apart."""
VELOCITY = 3
"""How many numbers it estimates of the robot's motion."""
BETA = 1e-3
"""Weight of the latent's divergence against squared errors averaged over a frame; ours."""


class History:
    """The last frames of every robot, the newest last; what came before an episode is zero."""

    def __init__(self, steps: int, width: int, num_envs: int, device: str = "cpu") -> None:
        """Remember nothing yet."""
        self.frames: Float[Tensor, "envs steps width"]
        self.frames = torch.zeros(num_envs, steps, width, device=device)

    def forget(self, ids: Int[Tensor, "n"]) -> None:
        """Begin new episodes for `ids`."""
        self.frames[ids] = 0.0

    def advance(self) -> None:
        """Let one control step pass: the oldest frame makes room for the next one."""
        self.frames = torch.cat((self.frames[:, 1:], self.frames[:, :1]), dim=1)

    def see(self, frame: Float[Tensor, "envs width"]) -> Float[Tensor, "envs flat"]:
        """Take `frame` for the newest, however often in a step; return all, oldest first."""
        self.frames[:, -1] = frame
        return self.frames.flatten(1).clone()


class ContextNet(nn.Module):
    """The context encoder: from a history to (newest frame, estimated velocity, latent)."""

    def __init__(
        self,
        width: int,
        *,
        history: int,
        latent: int,
        hidden: tuple[int, ...],
        mirror: Mirror | None = None,
    ) -> None:
        """Build the encoder of `history` frames of `width` numbers, and its decoder.

        `hidden` are the widths of the encoder, which the decoder mirrors; `mirror` is the encoder's
        symmetry, from `mirrors`.
        """
        super().__init__()
        self.width, self.latent, self.remembered = width, latent, history * width
        self.encoder = SymmetricMLP(
            history * width, VELOCITY + 2 * latent, mirror, hidden_dims=hidden, activation="elu"
        )
        self.decoder = MLP(VELOCITY + latent, width, hidden[::-1], "elu")

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch features"]:
        """Return what the policy acts on; the latent is its mean, so that acting is repeatable.

        What follows the history in `x` is passed on as it is.
        """
        history, seen = x[..., : self.remembered], x[..., self.remembered :]
        estimate = self.encoder(history)[..., : VELOCITY + self.latent]
        return torch.cat((history[..., -self.width :], estimate, seen), dim=-1)

    def samples(self, rollout: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return (history, true velocity, next frame) of each step not followed by a new episode.

        `rollout` holds observation groups [time, envs, width], as rsl_rl's storage keeps them.
        """
        history, velocity = rollout["history"], rollout["critic"][..., :VELOCITY]
        goes_on = rollout["tracking"][1:, :, 2] == 0
        following = history[1:, :, -self.width :]
        return history[:-1][goes_on], velocity[:-1][goes_on], following[goes_on]

    def loss(
        self,
        history: Float[Tensor, "batch flat"],
        velocity: Float[Tensor, "batch 3"],
        following: Float[Tensor, "batch width"],
        *,
        beta: float = BETA,
    ) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
        """Return the loss of a beta-VAE that predicts the next frame, and its three parts.

        L = mean (v - v_hat)^2 + mean (o' - o'_hat)^2 + beta KL(q(z | history) || N(0, 1)). In
        training mode the latent is sampled; in evaluation mode it is the mean.
        """
        estimate, mean, log_variance = self.encoder(history).split(
            (VELOCITY, self.latent, self.latent), dim=-1
        )
        latent = mean
        if self.training:
            latent = mean + torch.randn_like(mean) * torch.exp(0.5 * log_variance)
        predicted = self.decoder(torch.cat((estimate, latent), dim=-1))
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        parts = {
            "velocity": (estimate - velocity).square().mean(),
            "prediction": (predicted - following).square().mean(),
            "kl": divergence.mean(),
        }
        return parts["velocity"] + parts["prediction"] + beta * parts["kl"], parts


class DreamWaQModel(SymmetricMLPModel):
    """rsl_rl's policy on what a `ContextNet` makes of the `history` group; exports as any other.

    The PPO loss stops at the encoder, which has a loss and an optimiser of its own (see `ppo`).
    """

    seen = 0
    """How many of its numbers, after the history, reach the policy's layers as they are."""

    def __init__(
        self,
        *args: Any,
        history: Width = HISTORY,
        latent: Width = 16,
        context_hidden: tuple[Width, ...] = (128, 64),
        mirror: Mirror | None = None,
        **kwargs: Any,
    ) -> None:
        """Build encoder and policy for `history` frames.

        `mirror` is that of (velocity, frame, what is seen) and the actions; a policy built to be
        filled with saved weights finds it there.

        Raises:
            ConfigError: The observations are no `history` frames, or the latent cannot be halved.
        """
        self.history, self.latent = history, latent
        felt, acted = mirrors(mirror, history, latent, self.seen) if mirror else (None, None)
        super().__init__(*args, mirror=acted, **kwargs)
        self.options = {"history": history, "latent": latent, "context_hidden": [*context_hidden]}
        self.context = ContextNet(
            (self.obs_dim - self.seen) // history,
            history=history,
            latent=latent,
            hidden=tuple(context_hidden),
            mirror=felt,
        )

    def _get_latent_dim(self) -> int:
        """Return how many numbers the policy's layers read."""
        felt = self.obs_dim - self.seen
        if self.history < 1 or felt < self.history or felt % self.history:
            raise ConfigError(
                f"{felt} observations are no {self.history} frames of one width: ask the "
                "environment for as many frames as the policy reads"
            )
        return felt // self.history + VELOCITY + self.latent + self.seen

    def get_latent(self, obs: Any, masks: Any = None, hidden_state: Any = None) -> Tensor:
        """Return newest frame, estimate, latent and what is seen; no gradient goes back."""
        with torch.no_grad():
            return self.context(super().get_latent(obs, masks, hidden_state))

    def as_jit(self) -> nn.Module:
        """Return a module for TorchScript: from a history to actions."""
        return self._with_context(super().as_jit())

    def as_onnx(self, verbose: bool) -> nn.Module:
        """Return a module for ONNX: from a history to actions."""
        return self._with_context(super().as_onnx(verbose))

    def _with_context(self, exported: nn.Module) -> nn.Module:
        """Put the encoder where rsl_rl's exported modules treat their input before the layers."""
        exported.obs_normalizer = copy.deepcopy(self.context)
        return exported


class EstimatingModel(DreamWaQModel):
    """The same for a policy that is not blind: after the `history` group it reads the `scan`.

    It estimates its velocity, which no sensor measures, and what its body is like (as in Ji et al.,
    "Concurrent Training of a Control Policy and a State Estimator for Dynamic and Robust Legged
    Locomotion", RA-L 2022).
    """

    def __init__(self, *args: Any, seen: Width, **kwargs: Any) -> None:
        """Build encoder and policy; the last `seen` numbers of what it reads are the scan."""
        self.seen = seen
        super().__init__(*args, **kwargs)
        self.options |= {"seen": seen}

    @torch.no_grad()
    def adopt(self, told: MLPModel, felt: Sequence[int], unfelt: Sequence[int]) -> None:
        """Become a policy that was told its velocity: act as it does, on the estimate instead.

        `felt` and `unfelt` say where the frame and the velocity stand in what it reads, which ends
        in what is seen. The latent is ignored at first. Raises `RuntimeError` if shapes differ.
        """
        state = told.mlp.state_dict()
        first = state["0.weight"]
        scan = range(first.shape[1] - self.seen, first.shape[1])
        frame = first[:, [*felt, *unfelt]], first.new_zeros(len(first), self.latent)
        state["0.weight"] = torch.cat((*frame, first[:, list(scan)]), dim=1)
        own = self.mlp.state_dict()
        mirror = {name: own[name] for name in own if not name[0].isdigit()}
        self.mlp.load_state_dict(state | mirror)


def mirrors(mirror: Mirror, history: int, latent: int, seen: int = 0) -> tuple[Mirror, Mirror]:
    """Return the mirrors of encoder and policy, from that of (velocity, frame, seen) and actions.

    The mirror image of a latent is the latent with its halves exchanged: with that and an encoder
    symmetric in itself, estimates and actions are mirrored exactly.

    Raises:
        ConfigError: The latent cannot be halved.
    """
    if latent % 2:
        raise ConfigError(
            f"a symmetric latent has two halves, got a width of {latent}: make it even"
        )
    index, sign = mirror.observation_index, mirror.observation_sign
    width = len(index) - VELOCITY - seen

    def part(first: int, size: int) -> tuple[list[int], Sequence[float]]:
        return [i - first for i in index[first : first + size]], sign[first : first + size]

    velocity, frame, scan = part(0, VELOCITY), part(VELOCITY, width), part(VELOCITY + width, seen)
    halves = ([*range(latent // 2, latent), *range(latent // 2)], [1.0] * latent)
    return (
        Mirror(*join([frame] * history), *join([velocity, halves, halves])),
        Mirror(*join([frame, velocity, halves, scan]), mirror.action_index, mirror.action_sign),
    )
