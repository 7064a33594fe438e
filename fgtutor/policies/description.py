"""A policy's architecture as plain values, so that it can be saved and rebuilt without pickle.

Reads an rsl_rl policy and gives a `PolicyConfig`, or the other way round; the weights are saved
apart (`specialist`). A file can only choose among the names listed here, and never names code
itself; `register_policy` adds a class to the list.
"""

from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, Self, get_args

import torch
from annotated_types import Len
from torch import nn

from fgtutor.errors import SpecialistError
from fgtutor.io.rsl import GaussianDistribution, MLPModel, TensorDict, resolve_nn_activation
from fgtutor.io.validation import (
    Ascending,
    Name,
    Positive,
    Unique,
    Width,
    arguments,
    check_fields,
    parse_record,
)
from fgtutor.policies.dreamwaq import DreamWaQModel, EstimatingModel
from fgtutor.policies.symmetry import SymmetricMLPModel

POLICIES: dict[str, type[MLPModel]] = {
    "mlp": MLPModel,
    "symmetric": SymmetricMLPModel,
    "dreamwaq": DreamWaQModel,
    "estimating": EstimatingModel,
}
"""Policy classes that a folder may name; `register_policy` adds one."""
Activation = Literal["elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu"]
"""Activation functions that a folder may name, by rsl_rl's names."""


def register_policy(name: str, cls: type[MLPModel]) -> None:
    """Let specialist folders name `cls`, a subclass of MLPModel that takes its arguments.

    If it takes more, these are annotated as numbers (or `Literal` words), and its instances offer
    their values as an attribute `options`, a dict. It is also built on torch's "meta" device, to
    compare shapes before memory is taken. Raises `SpecialistError` if another class has this name.
    """
    if POLICIES.setdefault(name, cls) is not cls:
        raise SpecialistError(f"policy class {name!r} is {POLICIES[name]}: choose another name")


def _gaussian(*args: Any, **options: Any) -> GaussianDistribution:
    """Build the action noise on the CPU: for a logarithm on "meta" torch loads its compiler."""
    with torch.device("cpu"):
        return GaussianDistribution(*args, **options)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Options of rsl_rl's Gaussian."""

    std_type: Literal["scalar", "log"]
    """Whether its parameter is the standard deviation or the logarithm of it."""
    std_range: Annotated[tuple[Positive, Positive], Ascending]
    """Least and greatest standard deviation, in action units."""

    def __post_init__(self) -> None:
        check_fields(self, SpecialistError)


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """What it takes to build a policy again before its weights are filled in.

    Raises:
        SpecialistError: A value is of another type or out of range, the class is not registered or
            does not take the options.
    """

    kind: str
    """Class of the policy: a key of `POLICIES`."""
    groups: Annotated[tuple[Name, ...], Len(1, 16), Unique]
    """Observation groups the policy reads, in the order it joins them."""
    obs_dim: Width
    """Width of these groups together."""
    num_actions: Width
    """Number of actions."""
    hidden_dims: Annotated[tuple[Width, ...], Len(1, 16)]
    """Widths of the hidden layers."""
    activation: Activation
    """Activation function, by rsl_rl's name."""
    obs_normalization: bool
    """Whether observations are normalised by statistics gathered in training."""
    distribution: Noise | None
    """The Gaussian that actions are drawn from in training; None for no noise at all."""
    options: dict[str, Any]
    """Further arguments of the policy's class."""

    def __post_init__(self) -> None:
        check_fields(self, SpecialistError)
        if self.kind not in POLICIES:
            raise SpecialistError(
                f"unknown policy class {self.kind!r:.60}, expected one of {sorted(POLICIES)}: "
                "import the module that registers it first"
            )
        takes = arguments(POLICIES[self.kind], MLPModel)
        parse_record(takes, self.options, SpecialistError, "options")

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
        known = get_args(Activation)
        names = [name for name in known if type(resolve_nn_activation(name)) is used]
        if not names:
            raise SpecialistError(f"activation {used.__name__} is not one of {known}")
        return cls(
            kind=kinds[0],
            groups=tuple(policy.obs_groups),
            obs_dim=policy.obs_dim,
            num_actions=layers[-1].out_features,
            hidden_dims=tuple(layer.out_features for layer in layers[:-1]),
            activation=names[0],
            obs_normalization=policy.obs_normalization,
            distribution=noise and Noise(std_type=noise.std_type, std_range=tuple(noise.std_range)),  # type: ignore
            options=dict(getattr(policy, "options", {})),
        )

    def build(self) -> MLPModel:
        """Build the policy with fresh weights."""
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
            # A function, and last: rsl_rl imports and calls whatever a text names.
            distribution_cfg=noise and {**asdict(noise), "class_name": _gaussian},
            **self.options,
        )
