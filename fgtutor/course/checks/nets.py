"""Nets of the exercises: cases, right answers and typical mistakes of the questions in torch.

Gives the harnesses, which call what the learner wrote (their source is sent to the grader's
process, so they import what they need), and the library's own net as the right answer (Eqs. 2-3).
"""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor, nn

POINTS, COMMAND, HIDDEN, LATENT = 6, 3, 5, 2
"""Sizes of the nets that are tried."""
_LAYERS = (
    (POINTS + COMMAND, HIDDEN),
    (HIDDEN, 1),
    (POINTS, HIDDEN),
    (HIDDEN, 2 * LATENT),
    (LATENT, HIDDEN),
    (HIDDEN, POINTS),
)
NUMBERS = sum((inputs + 1) * outputs for inputs, outputs in _LAYERS)
"""Weights and biases of such a net."""


# The network --------------------------------------------------------------------------------------


def net_case(rng: np.random.Generator) -> tuple:
    """Draw a batch of patches and commands, and the weights of a net."""
    patch, command = rng.normal(0, 0.1, (4, POINTS)), rng.uniform(-1, 1, (4, COMMAND))
    return patch, command, rng.normal(0, 0.7, NUMBERS)


def net_answers(
    target: "Any", patch: "np.ndarray", command: "np.ndarray", weights: "np.ndarray"
) -> tuple:
    """Return how many weights a net of the learner's class has, its f and its L_recon."""
    import torch

    net = target(patch.shape[1], command.shape[1], 5, 2).double()
    numbers = sum(parameter.numel() for parameter in net.parameters())
    if numbers != len(weights):
        return numbers, np.zeros(len(patch)), np.zeros(len(patch))
    torch.nn.utils.vector_to_parameters(torch.tensor(weights), net.parameters())
    heights, told = torch.tensor(patch), torch.tensor(command)
    f, loss = net.feasibility(heights, told), net.reconstruction(heights)
    return numbers, f.detach().numpy(), loss.detach().numpy()


def build_net(points: int, command: int, hidden: int, latent: int, flaw: str = "") -> "nn.Module":
    """Return the library's net, or one with a flaw."""
    import torch

    from fgtutor.feasibility import FeasibilityNet

    class Flawed(FeasibilityNet):
        def feasibility(self, patch: "Tensor", command: "Tensor") -> "Tensor":
            scale = 1.0 if flaw == "metres" else self.height_scale
            told = 0 * command if flaw == "deaf" else command
            score = self.head(torch.cat((scale * patch, told), dim=-1)).squeeze(-1)
            return score if flaw == "score" else torch.sigmoid(score)

        def reconstruction(self, patch: "Tensor") -> "Tensor":
            heights = patch if flaw == "metres" else self.height_scale * patch
            mean, log_variance = self.encoder(heights).chunk(2, dim=-1)
            if flaw == "sampled":
                mean = mean + torch.exp(log_variance / 2)
            if flaw == "halves":
                mean = log_variance
            squares = (self.decoder(mean) - heights).square()
            return squares.mean(dim=-1) if flaw == "mean" else squares.sum(dim=-1)

    sizes: Any = {"hidden": (hidden,), "vae_hidden": (hidden,), "latent": latent}
    kind = Flawed if flaw else FeasibilityNet
    return kind(points, command_dim=command, **sizes)


def flawed_net(flaw: str) -> Any:
    """Return what builds a net with a flaw."""
    return lambda points, command, hidden, latent: build_net(points, command, hidden, latent, flaw)


def narrow_net(points: int, command: int, hidden: int, latent: int) -> "nn.Module":
    """Return a net whose encoder gives the mean alone."""
    from torch import nn

    net = build_net(points, command, hidden, latent)
    net.encoder = nn.Sequential(nn.Linear(points, hidden), nn.Tanh(), nn.Linear(hidden, latent))
    return net


# Its loss -----------------------------------------------------------------------------------------


def loss_case(rng: np.random.Generator) -> tuple:
    """Draw a batch with its labels and noise, the loss's factors, and the weights of a net."""
    patch, command, weights = net_case(rng)
    alpha, beta = float(rng.uniform(0.3, 3)), float(rng.uniform(0.1, 0.5))
    return patch, command, rng.uniform(0, 1, 4), rng.normal(0, 1, (4, LATENT)), alpha, beta, weights


def loss_answers(
    target: "Any",
    patch: "np.ndarray",
    command: "np.ndarray",
    r_v: "np.ndarray",
    noise: "np.ndarray",
    alpha: float,
    beta: float,
    weights: "np.ndarray",
) -> tuple:
    """Return the learner's loss of a net, and its gradient by every weight."""
    import torch
    from torch import nn

    class Net(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.head = nn.Sequential(nn.Linear(9, 5), nn.ELU(), nn.Linear(5, 1))
            self.encoder = nn.Sequential(nn.Linear(6, 5), nn.Tanh(), nn.Linear(5, 4))
            self.decoder = nn.Sequential(nn.Linear(2, 5), nn.Tanh(), nn.Linear(5, 6))

        def feasibility(self, patch: torch.Tensor, command: torch.Tensor) -> torch.Tensor:
            inputs = torch.cat((4 * patch, command), dim=-1)
            return torch.sigmoid(self.head(inputs)).squeeze(-1)

    net = Net().double()
    nn.utils.vector_to_parameters(torch.tensor(weights), net.parameters())
    given = [torch.tensor(array) for array in (patch, command, r_v, noise)]
    loss = target(net, *given, alpha, beta)
    loss.backward()
    gradient = [
        torch.zeros(p.numel()) if p.grad is None else p.grad.flatten() for p in net.parameters()
    ]
    return loss.detach().numpy(), torch.cat(gradient).numpy()


def joint_loss(
    net: Any,
    patch: "Tensor",
    command: "Tensor",
    r_v: "Tensor",
    noise: "Tensor",
    alpha: float,
    beta: float,
    flaw: str = "",
) -> "Tensor":
    """Return the joint loss with the divergence that torch works out, or with a flaw."""
    import torch
    from torch.distributions import Normal, kl_divergence

    heights = patch if flaw == "metres" else 4 * patch
    mean, log_variance = net.encoder(heights).chunk(2, dim=-1)
    spread = torch.exp(log_variance if flaw == "variance" else log_variance / 2)
    latent = mean if flaw == "no noise" else mean + spread * noise
    decoded = net.decoder(latent.detach() if flaw == "cut" else latent)
    squares = (decoded - heights).square()
    recon = squares.mean(dim=-1) if flaw == "point mean" else squares.sum(dim=-1)
    prior = Normal(torch.zeros_like(mean), torch.ones_like(mean))
    kl = kl_divergence(Normal(mean, torch.exp(log_variance / 2)), prior).sum(dim=-1)
    error = (net.feasibility(patch, command) - r_v).square()
    vae = alpha * recon + beta * kl if flaw == "bracket" else alpha * (recon + beta * kl)
    if flaw == "no kl":
        vae = alpha * recon
    return (error + vae).sum() if flaw == "batch sum" else (error + vae).mean()


def flawed_loss(flaw: str) -> Any:
    """Return a joint loss with a flaw."""
    return lambda *given: joint_loss(*given, flaw=flaw)


# Training -----------------------------------------------------------------------------------------


def training_case(rng: np.random.Generator) -> tuple:
    """Draw data to train on, data held out, the error to reach, and the budget."""
    true = rng.normal(0, 1, POINTS)
    true *= 2.0 / np.linalg.norm(true)
    patches = rng.normal(0, 1, (2, 100, POINTS))
    r_v = 1 / (1 + np.exp(-(patches @ true + 1.5))) + rng.normal(0, 0.03, (2, 100))
    r_v = np.clip(r_v, 0, 1)
    return patches[0], r_v[0], patches[1], r_v[1], 0.05, 60


def training_answers(
    target: "Any",
    patch: "np.ndarray",
    r_v: "np.ndarray",
    held_patch: "np.ndarray",
    held_r_v: "np.ndarray",
    goal: float,
    most: int,
) -> tuple:
    """Return whether the learner's training kept each of its promises.

    Calibrated, better than a constant, within the budget, held-out data kept out, errors as told.
    """
    import numpy as np
    import torch
    from torch import nn

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = nn.Sequential(
            nn.Linear(patch.shape[1], 16), nn.Tanh(), nn.Linear(16, 1), nn.Sigmoid(), nn.Flatten(0)
        )
        given = [torch.tensor(a, dtype=torch.float32) for a in (patch, r_v, held_patch, held_r_v)]
        passes, leaked = [0], [False]

        def count(module: "Any", inputs: "Any") -> None:
            if torch.is_grad_enabled():
                passes[0] += 1
                leaked[0] |= bool(torch.isin(inputs[0][:, 0], given[2][:, 0]).any())

        net.register_forward_pre_hook(count)
        updates, error = target(net, *given, goal, most)
        with torch.no_grad():
            f = net(given[2]).double().numpy()
    measured = given[3].double().numpy()
    part = np.minimum((f * 5).astype(int), 4)
    gaps = [abs((measured - f)[part == b].sum()) for b in range(5)]
    real = sum(gaps) / len(f)
    return (
        bool(real <= goal),
        bool(np.mean((f - measured) ** 2) <= 0.25 * measured.var()),
        bool(passes[0] <= most),
        not leaked[0],
        bool(abs(float(error) - real) < 1e-3),
        bool(int(updates) == passes[0]),
    )


def train(
    net: Any,
    patch: "Tensor",
    r_v: "Tensor",
    held_patch: "Tensor",
    held_r_v: "Tensor",
    goal: float,
    most: int,
    flaw: str = "",
) -> tuple[int, float]:
    """Train for the whole budget, or with a flaw."""
    import torch

    def error_on(patches: "Tensor", measured: "Tensor") -> float:
        with torch.no_grad():
            f = net(patches)
        gap, part = measured - f, (f * 5).long().clamp(max=4)
        return sum(float(gap[part == b].sum().abs()) for b in range(5)) / len(f)

    if flaw == "held out":
        patch, r_v = held_patch, held_r_v
    optimizer = torch.optim.Adam(net.parameters(), lr=0.05)
    updates = 0 if flaw == "untrained" else most + 1 if flaw == "over budget" else most
    for _ in range(updates):
        f = net(patch)
        aim = r_v.mean() if flaw == "constant" else r_v
        loss = (f - aim).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    told = 0.5 if flaw == "made up" else error_on(held_patch, held_r_v)
    return (0 if flaw == "uncounted" else updates), told


def flawed_training(flaw: str) -> Any:
    """Return a training with a flaw."""
    return lambda *given: train(*given, flaw=flaw)
