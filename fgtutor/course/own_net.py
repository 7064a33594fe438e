"""The learner's Feasibility-Net: built, trained and used with what of exercise 03 has passed.

Reads drives of many robots on steps; gives a net trained on them by her class, her loss, her labels
and her training, or the library's where she has none, and its f in the planner (Eqs. 1-3).
"""

import copy
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from fgtutor.course.checks import nets
from fgtutor.course.drives import collect
from fgtutor.course.substitutes import Stages, same_shape
from fgtutor.feasibility import feasibility_labels
from fgtutor.io.machine import one_thread
from fgtutor.robots import env_class
from fgtutor.robots.crossings import EnvConfig
from fgtutor.specialist import load_zoo
from fgtutor.world.terrain import World, make_terrain

NET = "FeasibilityNet"
"""The learner's class."""
WINDOW = 25
"""Control steps that a label is the mean of: one second."""
ROBOTS, SECONDS = 24, 12.0
"""Robots of a rollout, and how long each drives, s."""
HIDDEN, LATENT = 64, 8
"""Sizes of the net that is trained on a rollout."""
UPDATES = 80
"""Updates by the joint loss, before the head alone is trained on."""
GOAL, MOST = 0.05, 100
"""Calibration error that its training aims at, and updates that it may take."""


@cache
def rollout(seed: int, driver: str = "") -> dict[str, Tensor]:
    """Return what robots met on steps of all heights, [time, robots, numbers].

    `driver` names a shipped specialist of the toy; without one they only roll.
    """
    tiles = [
        make_terrain("steps", difficulty=(i % 5 + 1) / 5, seed=2 * i + seed) for i in range(20)
    ]
    env = env_class("toy")(World([tiles]), ROBOTS, seed=seed, config=EnvConfig(speed=(0.3, 1.5)))
    act = load_zoo("toy")[driver].act if driver else lambda seen: torch.zeros(len(seen), 4)
    return collect(env, act, SECONDS)


@dataclass(frozen=True)
class Trained:
    """A net after its training, and how that went."""

    net: Any
    """The net."""
    losses: list[float]
    """The joint loss before each update by it."""
    updates: int
    """Updates of the head alone."""
    f: Float[np.ndarray, " n"]
    """What it predicts for the held-out rollout."""
    measured: Float[np.ndarray, " n"]
    """The labels of the held-out rollout."""


@one_thread()
def train(own: Stages, driver: str = "") -> Trained:
    """Train a net on a rollout of a driver; another rollout of the same driver is held out."""
    patch, command, label = samples(own, rollout(0, driver))
    held_patch, held_command, held_label = samples(own, rollout(1, driver))

    def built(make: Any) -> nn.Module:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            net = make(patch.shape[1], command.shape[1], HIDDEN, LATENT)
        with torch.no_grad():
            same_shape(net.feasibility(patch, command), label)
            same_shape(net.reconstruction(patch), label)
        return net

    net = own.run(NET, lambda: built(nets.build_net), built)
    net, losses = own.run(
        "joint_loss",
        lambda: fitted(nets.joint_loss, net, patch, command, label),
        lambda f: fitted(f, net, patch, command, label),
    )

    def trained(function: Any) -> tuple[nn.Module, int]:
        head = Head(copy.deepcopy(net))
        both = [torch.cat(pair, dim=-1) for pair in ((patch, command), (held_patch, held_command))]
        updates, _ = function(head, both[0], label, both[1], held_label, GOAL, MOST)
        return head.net, int(updates)

    net, updates = own.run("train", lambda: trained(nets.train), trained)
    f = predicted(net, held_patch, held_command)
    return Trained(net, losses, updates, f, held_label.double().numpy())


def feasibility(
    own: Stages,
    driver: str,
    patch: Float[Tensor, "*cells points"],
    command: Float[Tensor, "*cells 3"],
    ours: Float[np.ndarray, "*cells"],
) -> Float[np.ndarray, "*cells"]:
    """Return f by the learner's net, trained on the drives of a specialist; `ours` without one."""
    if NET not in own.functions:
        return own.run(NET, lambda: ours, lambda _: ours)
    net = train(own, driver).net
    return predicted(net, patch, command) if NET in own.hers else ours


def predicted(net: Any, patch: Tensor, command: Tensor) -> np.ndarray:
    """Return f of patches [..., points] and commands [..., 3], which the net sees as batches."""
    with torch.no_grad():
        f = net.feasibility(patch.flatten(0, -2).float(), command.flatten(0, -2).float())
    return f.double().numpy().reshape(patch.shape[:-1])


class Head(nn.Module):
    """A Feasibility-Net as `train` expects it: one input, patch and command in a row."""

    def __init__(self, net: Any) -> None:
        super().__init__()
        self.net = net

    def forward(self, both: Tensor) -> Tensor:
        """Return f [n] of patches and commands [n, points + 3]."""
        return self.net.feasibility(both[:, :-3], both[:, -3:])


def samples(own: Stages, seen: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return patches, commands and labels of a rollout, every twelfth that can be trusted."""
    tracking = seen["tracking"]
    r_v, failed, ended = tracking[1:].double().numpy().transpose(2, 0, 1)
    ours = tuple(part[:-1].numpy() for part in feasibility_labels(tracking, WINDOW))
    label, trusted = own.run(
        "rollout_labels",
        lambda: ours,
        lambda f: [same_shape(part, r_v) for part in f(r_v.copy(), failed > 0, ended > 0, WINDOW)],
    )
    chosen = torch.tensor(np.flatnonzero(trusted.ravel())[::12])
    patch, command = (seen[name][:-1].flatten(0, 1)[chosen] for name in ("patch", "command"))
    return patch, command, torch.tensor(label.ravel()).float()[chosen]


def fitted(
    loss_of: Any, net: nn.Module, patch: Tensor, command: Tensor, label: Tensor
) -> tuple[nn.Module, list[float]]:
    """Return a copy of the net after its updates by a joint loss, and the loss at each (Eq. 2)."""
    net, losses = copy.deepcopy(net), []
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    noise = torch.Generator().manual_seed(0)
    for _ in range(UPDATES):
        drawn = torch.randn(len(patch), LATENT, generator=noise)
        loss = loss_of(net, patch, command, label, drawn, 1.0, 5e-4)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return net, losses
