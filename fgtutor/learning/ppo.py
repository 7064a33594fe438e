"""PPO that fits the Feasibility-Net to the same rollouts: two losses, no shared weight.

Reads rsl_rl's rollout storage, whose `tracking` group tells what happened after every step; gives
an algorithm that trains policy and Feasibility-Net side by side, and the context encoder of a
policy that estimates its velocity.
Source: paper, Sec. III-A (Eqs. 1-3) and Fig. 2; PPO from rsl_rl.
"""

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.utils import reduce_gradients_in_buckets
from torch import Tensor, nn

from fgtutor.feasibility import FeasibilityNet, feasibility_labels
from fgtutor.policies.dreamwaq import ContextNet, DreamWaQModel


class FeasibilityPPO(PPO):
    """rsl_rl's PPO that also fits the Feasibility-Net to each rollout before it learns from it.

    The two share data and nothing else: separate networks, optimisers and losses. A context encoder
    is fitted in the same way, to its own loss.
    """

    feasibility_updates, feasibility_batch = 24, 512
    """Updates of the Feasibility-Net per rollout, and patches per update."""
    context_updates, context_batch = 32, 2048
    """Updates of the context encoder per rollout, and steps per update."""

    def __init__(self, *args: Any, label_steps: int, **kwargs: Any) -> None:
        """Add a Feasibility-Net sized by the `patch` group to what PPO builds."""
        super().__init__(*args, **kwargs)
        self.label_steps = label_steps
        num_points = self.storage.observations["patch"].shape[-1]
        self.feasibility = FeasibilityNet(num_points).to(self.device)
        # The trainer sets its learning rate anew in each iteration.
        self.feasibility_optimizer = torch.optim.Adam(self.feasibility.parameters())
        policy = self.get_policy()
        self.context = policy.context if isinstance(policy, DreamWaQModel) else None
        if self.context:
            self.context_optimizer = torch.optim.Adam(self.context.parameters(), lr=1e-3)
        self.metrics: dict[str, float] = {}
        self.memory: list[tuple[Tensor, Tensor, Tensor]] = []

    def update(self) -> dict[str, float]:
        """Fit the Feasibility-Net, then update the policy (which empties the storage).

        The context encoder comes last: what PPO compares are policies on the same context.
        """
        r_v, failed, ended = self.storage.observations["tracking"].unbind(-1)
        self.metrics = {
            "reward": self.storage.rewards.mean().item(),
            "r_v": r_v.mean().item(),
            "failed": (failed == 1).sum().item() / max(1.0, ended.sum().item()),
        }
        self.metrics |= self.fit_feasibility()
        samples = self.context.samples(self.storage.observations) if self.context else None
        self.metrics |= super().update()
        if self.context and samples:
            self.metrics |= self.fit_context(self.context, *samples)
        return self.metrics

    def fit_context(self, context: ContextNet, *samples: Tensor) -> dict[str, float]:
        """Fit the context encoder to the samples of one rollout; return the mean loss parts."""
        shape = self.context_updates, self.context_batch
        losses = self._fit(context, self.context_optimizer, samples, shape)
        return {f"context_{name}": value for name, value in losses.items()}

    def fit_feasibility(self) -> dict[str, float]:
        """Fit the net to the labelled patches at hand; return the mean of each loss part.

        These are the rollouts since the last checkpoint: neighbours in one rollout are too alike to
        learn from one rollout at a time, and labels of long ago describe another policy.
        """
        observations = self.storage.observations
        label, valid = feasibility_labels(observations["tracking"], self.label_steps)
        self.memory.append(
            (observations["patch"][valid], observations["command"][valid], label[valid])
        )
        samples = tuple(torch.cat(parts) for parts in zip(*self.memory, strict=True))
        shape = self.feasibility_updates, self.feasibility_batch
        losses = self._fit(self.feasibility, self.feasibility_optimizer, samples, shape)
        return {f"feasibility_{name}": value for name, value in losses.items()}

    def _fit(
        self,
        net: FeasibilityNet | ContextNet,
        optimizer: torch.optim.Optimizer,
        samples: Sequence[Tensor],
        shape: tuple[int, int],
    ) -> dict[str, float]:
        """Fit a net to samples drawn at random, `shape` = (updates, batch).

        Return the mean of each part of its loss.
        """
        sums: dict[str, float] = {}
        draws = torch.randint(len(samples[0]), shape, device=samples[0].device)
        for chosen in draws:
            loss, parts = net.loss(*(values[chosen] for values in samples))
            self._descend(loss, net, optimizer)
            for name, value in parts.items():
                sums[name] = sums.get(name, 0.0) + value.item() / len(draws)
        return sums

    def _descend(self, loss: Tensor, net: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Take one step down the loss, along the mean gradient of all processes."""
        optimizer.zero_grad()
        loss.backward()
        if self.is_multi_gpu:
            reduce_gradients_in_buckets(
                net.parameters(), self.gpu_world_size, self.grad_reduce_bucket_mb
            )
        optimizer.step()

    def broadcast_parameters(self) -> None:
        """Copy all networks of the first process to every other one."""
        super().broadcast_parameters()
        for tensor in self.feasibility.state_dict().values():
            torch.distributed.broadcast(tensor, src=0)

    def save(self) -> dict:
        """Return the state of all networks and optimisers."""
        state = super().save() | {
            "feasibility_state_dict": self.feasibility.state_dict(),
            "feasibility_optimizer_state_dict": self.feasibility_optimizer.state_dict(),
        }
        if self.context:
            state["context_optimizer_state_dict"] = self.context_optimizer.state_dict()
        return state

    def load(self, loaded_dict: dict, load_cfg: dict | None = None, strict: bool = True) -> bool:
        """Take over the state that `save` returned."""
        self.feasibility.load_state_dict(loaded_dict["feasibility_state_dict"], strict=strict)
        self.feasibility_optimizer.load_state_dict(loaded_dict["feasibility_optimizer_state_dict"])
        if self.context:
            self.context_optimizer.load_state_dict(loaded_dict["context_optimizer_state_dict"])
        return super().load(loaded_dict, load_cfg, strict)
