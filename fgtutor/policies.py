"""How a policy's network is written down and built again, without unpickling anything.

Reads an rsl_rl policy and gives a `PolicyConfig` of plain values, or the other way round; the
weights travel apart (`specialist`). `register_policy` opens the list of classes.
"""

from dataclasses import dataclass
from typing import Any, Self

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.utils import resolve_nn_activation
from tensordict import TensorDict
from torch import nn

from fgtutor.dreamwaq import DreamWaQModel
from fgtutor.errors import SpecialistError
from fgtutor.symmetry import SymmetricMLPModel

POLICIES: dict[str, type[MLPModel]] = {
    "mlp": MLPModel,
    "symmetric": SymmetricMLPModel,
    "dreamwaq": DreamWaQModel,
}
"""Policy classes that a folder may name; `register_policy` adds one."""
_DISTRIBUTION_OPTIONS = ("std_type", "std_range")
_ACTIVATIONS = ("elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu")


def register_policy(name: str, cls: type[MLPModel]) -> None:
    """Let specialist folders name `cls`, a subclass of MLPModel that takes its arguments.

    If it takes more, its instances must offer them as an attribute `options`, a dict of plain
    values. Raises `SpecialistError` if another class already has this name.
    """
    if POLICIES.setdefault(name, cls) is not cls:
        raise SpecialistError(f"policy class {name!r} is {POLICIES[name]}: choose another name")


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """What it takes to build a policy again before its weights are filled in."""

    kind: str
    """Class of the policy: a key of `POLICIES`."""
    groups: tuple[str, ...]
    """Observation groups the policy reads, in the order it joins them."""
    obs_dim: int
    """Width of these groups together."""
    num_actions: int
    """Number of actions."""
    hidden_dims: tuple[int, ...]
    """Widths of the hidden layers."""
    activation: str
    """Activation function, by rsl_rl's name."""
    obs_normalization: bool
    """Whether observations are normalised by statistics gathered in training."""
    distribution: dict[str, Any] | None
    """Options of the Gaussian that actions are drawn from in training; None for no noise at all."""
    options: dict[str, Any]
    """Further arguments of the policy's class."""

    @classmethod
    def of(cls, policy: MLPModel) -> Self:
        """Read off a policy how it was built.

        Raises:
            SpecialistError: Its class, activation or action distribution cannot be named in a file.
        """
        noise = policy.distribution
        kinds = [name for name, known in POLICIES.items() if type(policy) is known]
        if not kinds or not (noise is None or type(noise) is GaussianDistribution):
            raise SpecialistError(
                f"a {type(policy).__name__} with {type(noise).__name__} cannot be described: use a "
                f"GaussianDistribution and one of {sorted(POLICIES)}, or call register_policy"
            )
        layers = [layer for layer in policy.mlp if isinstance(layer, nn.Linear)]
        used = type(policy.mlp[1])
        names = [name for name in _ACTIVATIONS if type(resolve_nn_activation(name)) is used]
        if not names:
            raise SpecialistError(f"activation {used.__name__} is not one of {_ACTIVATIONS}")
        return cls(
            kind=kinds[0],
            groups=tuple(policy.obs_groups),
            obs_dim=policy.obs_dim,
            num_actions=layers[-1].out_features,
            hidden_dims=tuple(layer.out_features for layer in layers[:-1]),
            activation=names[0],
            obs_normalization=policy.obs_normalization,
            distribution=noise and {key: getattr(noise, key) for key in _DISTRIBUTION_OPTIONS},
            options=dict(getattr(policy, "options", {})),
        )

    def build(self) -> MLPModel:
        """Build the policy with fresh weights.

        Raises:
            SpecialistError: Its class is not registered.
        """
        if self.kind not in POLICIES:
            raise SpecialistError(
                f"unknown policy class {self.kind!r}, expected one of {sorted(POLICIES)}: import "
                "the module that registers it first"
            )
        # MLPModel only sums the groups' widths, so the first may stand for all.
        widths = [self.obs_dim] + [0] * (len(self.groups) - 1)
        observations = {k: torch.zeros(1, n) for k, n in zip(self.groups, widths, strict=True)}
        noise = self.distribution
        return POLICIES[self.kind](
            TensorDict(observations, batch_size=[1]),
            {"actor": list(self.groups)},
            "actor",
            self.num_actions,
            hidden_dims=self.hidden_dims,
            activation=self.activation,
            obs_normalization=self.obs_normalization,
            # The class itself: a class name read from a file could import anything.
            distribution_cfg=noise and {"class_name": GaussianDistribution, **noise},
            **self.options,
        )
