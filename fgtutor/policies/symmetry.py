"""Left-right symmetry of a robot, and a policy that is symmetric by construction.

Reads a robot's `Mirror`; gives an rsl_rl policy whose answer to a mirrored observation is exactly
the mirrored answer. Source: network symmetry in Abdolhosseini et al., "On Learning Symmetric
Locomotion", MIG 2019.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from fgtutor.errors import ConfigError
from fgtutor.io.rsl import MLP, MLPModel


@dataclass(frozen=True)
class Mirror:
    """Reflection in the robot's plane y = 0: component i of the image is sign[i] * x[index[i]].

    Raises `ConfigError` unless reflecting twice changes nothing.
    """

    observation_index: tuple[int, ...]
    """For each number the policy reads, where its mirror image stands."""
    observation_sign: tuple[float, ...]
    """Factor +1 or -1 of each number the policy reads."""
    action_index: tuple[int, ...]
    """For each action, which action is its mirror image."""
    action_sign: tuple[float, ...]
    """Factor +1 or -1 of each action."""

    def __post_init__(self) -> None:
        for what in ("observation", "action"):
            index, sign = getattr(self, f"{what}_index"), getattr(self, f"{what}_sign")
            twice = len(index) == len(sign) and all(
                0 <= j < len(index) and index[j] == i and sign[i] == sign[j] and abs(sign[i]) == 1
                for i, j in enumerate(index)
            )
            if not twice:
                got = f"{index} and {sign}"
                raise ConfigError(
                    f"the mirrored {what} mirrored again must be the {what} itself: pair every "
                    f"index with the one it names and use signs +1 or -1, got {got:.200}"
                )

    def part(self, keep: Sequence[int]) -> Self:
        """Return the mirror of observations that hold only the numbers `keep`, in that order.

        Raises `ConfigError` if a number is kept without its mirror image.
        """
        place = {old: new for new, old in enumerate(keep)}
        alone = [i for i in keep if self.observation_index[i] not in place]
        if alone:
            raise ConfigError(f"numbers {alone} are kept without their mirror images: keep both")
        return replace(
            self,
            observation_index=tuple(place[self.observation_index[i]] for i in keep),
            observation_sign=tuple(self.observation_sign[i] for i in keep),
        )


def join(
    parts: Iterable[tuple[Sequence[int], Sequence[float]]],
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return index and sign of vectors that stand one after another, from those of each."""
    index: list[int] = []
    sign: list[float] = []
    for part, signs in parts:
        index += [len(sign) + i for i in part]
        sign += [float(s) for s in signs]
    return tuple(index), tuple(sign)


class SymmetricMLP(MLP):
    """A network n made symmetric: f(x) = (n(x) + mirror(n(mirror(x)))) / 2."""

    observation_index: Tensor
    observation_sign: Tensor
    action_index: Tensor
    action_sign: Tensor

    def __init__(self, inputs: int, outputs: int, mirror: Mirror | None, **options: Any) -> None:
        """Build the layers; the mirror is part of the state, so a saved network brings its own.

        Without a mirror nothing is exchanged until a state is loaded.
        """
        super().__init__(inputs, outputs, **options)
        mirror = mirror or Mirror(
            tuple(range(inputs)), (1.0,) * inputs, tuple(range(outputs)), (1.0,) * outputs
        )
        if (len(mirror.observation_index), len(mirror.action_index)) != (inputs, outputs):
            raise ConfigError(
                f"the mirror is for {len(mirror.observation_index)} observations and "
                f"{len(mirror.action_index)} actions, the policy has {inputs} and {outputs}: take "
                "the mirror of this robot"
            )
        for name, values in vars(mirror).items():
            dtype = torch.long if name.endswith("index") else torch.float32
            self.register_buffer(name, torch.tensor(values, dtype=dtype))

    def forward(self, x: Float[Tensor, "*batch inputs"]) -> Float[Tensor, "*batch outputs"]:
        """Average the answer and the mirrored answer to the mirrored input."""
        # Two passes of one shape, not one of twice the rows: matrix kernels may round a row
        # differently at another place of the batch, and the symmetry is meant to be exact.
        answer = super().forward(x)
        twin = super().forward(x.index_select(-1, self.observation_index) * self.observation_sign)
        return 0.5 * (answer + twin.index_select(-1, self.action_index) * self.action_sign)

    def find_mirror(self) -> Mirror:
        """Return the mirror; raises `ConfigError` if the state that was loaded holds none."""
        return Mirror(**{f.name: tuple(getattr(self, f.name).tolist()) for f in fields(Mirror)})


class SymmetricMLPModel(MLPModel):
    """rsl_rl's MLP policy with a `SymmetricMLP` inside; exports as any other.

    `mirror` is needed to train; a policy built to be filled with saved weights finds it there.
    """

    def __init__(self, *args: Any, mirror: Mirror | None = None, **kwargs: Any) -> None:
        """Build rsl_rl's model around a symmetric network.

        Raises:
            ConfigError: The mirror does not fit, or observations are to be normalised.
        """
        super().__init__(*args, **kwargs)
        if self.obs_normalization:
            raise ConfigError(
                "running statistics are not symmetric and would break the mirror: use fixed scales "
                "and obs_normalization=False"
            )
        linear = [layer for layer in self.mlp if isinstance(layer, torch.nn.Linear)]
        self.mlp = SymmetricMLP(
            linear[0].in_features,
            linear[-1].out_features,
            mirror,
            hidden_dims=[layer.out_features for layer in linear[:-1]],
            activation=kwargs.get("activation", "elu"),
        )
