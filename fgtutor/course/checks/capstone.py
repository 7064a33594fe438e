"""The capstone's cases, harnesses, right answers and faults: a newcomer on maps nobody has seen.

Draws rollouts and maps of the toy from the seed of an instructor; gives what a submission is told,
and judges its nets and routes by what it is not told: the labels on held-out ground, and the cost
of the cheapest route (Secs. III-A to III-C).
"""

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from fgtutor.directions import STEPS
from fgtutor.io.machine import one_thread

if TYPE_CHECKING:
    import torch
    from torch import nn

    from fgtutor.learning.calibrate import Rollout

BUDGET = 300
"""Updates that a training may take."""
LEARNED, HELD, FOREIGN = 500, 400, 300
"""Samples to learn from, held-out samples, and patches of foreign ground."""
ROBOTS = 24
"""Robots of a rollout, each on a slope of its own."""
GROUND, OTHERS = "slopes", ("gaps", "steps")
"""What the newcomer drives on, and what it has never met."""
MAPS = 3
"""Mixed maps that foreign patches are from."""
RELIEF = 0.03
"""Heights of a patch that is not flat differ by this much, m."""
CALIBRATED, EXPLAINED, TOLD_APART = 0.1, 0.85, 0.8
"""Demands: largest calibration error, largest squared error as a share of the labels' variance,
and least AUROC of L_recon."""


# A net of one's own -------------------------------------------------------------------------------


def training_case(rng: np.random.Generator) -> tuple:
    """Drive the newcomer on two grounds, to learn from and held out, and cut foreign patches."""
    seed = int(rng.integers(2**31))
    learned, held, foreign = _drives(seed)
    return (*map(np.array, (*learned, *held[:2], foreign)), BUDGET, seed)


@lru_cache(maxsize=8)
@one_thread()
def _drives(seed: int) -> tuple[tuple, tuple, np.ndarray]:
    """Return (patch, command, label) to learn from, the same held out, and foreign patches."""
    rng = np.random.default_rng(seed)
    first = int(rng.integers(10**6))
    learned = _samples(_rolled(first), LEARNED, rng)
    held = _samples(_rolled(first + 1000), HELD, rng)
    return learned, held, _foreign(first + 2000, rng)


def _rolled(first: int) -> "Rollout":
    """Let wheels roll over slopes of all heights, at commands from a walk to a run."""
    import torch

    from fgtutor.course.drives import collect
    from fgtutor.feasibility import feasibility_labels
    from fgtutor.learning.calibrate import Rollout
    from fgtutor.robots.crossings import EnvConfig
    from fgtutor.robots.toy import ToyEnv
    from fgtutor.world.terrain import World, make_terrain

    tiles = [
        make_terrain(GROUND, robot="toy", difficulty=(i + 1) / ROBOTS, seed=first + i)
        for i in range(ROBOTS)
    ]
    env = ToyEnv(World([tiles]), ROBOTS, seed=first, config=EnvConfig(speed=(0.3, 1.5)))
    rollout = collect(env, lambda seen: torch.zeros(len(seen), 4), 6.0, progress=False)
    label, trusted = feasibility_labels(rollout["tracking"], round(1.0 / env.control_dt))
    return Rollout(rollout["patch"][trusted], rollout["command"][trusted], label[trusted])


def _samples(rollout: "Rollout", count: int, rng: np.random.Generator) -> tuple:
    """Draw samples of a rollout, at most a quarter of them on flat ground if there are enough."""
    relief = np.ptp(rollout.patch.numpy(), axis=-1) > RELIEF
    rough, flat = np.flatnonzero(relief), np.flatnonzero(~relief)
    share = max(min(len(rough), 3 * count // 4), count - len(flat))
    chosen = np.concatenate(
        (rng.choice(rough, share, replace=False), rng.choice(flat, count - share, replace=False))
    )
    rng.shuffle(chosen)
    arrays = rollout.patch, rollout.command, rollout.label
    return tuple(values.numpy()[chosen].astype(np.float32) for values in arrays)


def _foreign(first: int, rng: np.random.Generator) -> np.ndarray:
    """Cut patches at the obstacles that the newcomer has not met, from unseen mixed maps."""
    import torch

    from fgtutor.robots.toy import ToyEnv
    from fgtutor.world.terrain import World, make_terrain

    patches, share = [], FOREIGN // (MAPS * len(OTHERS))
    for seed in range(first, first + MAPS):
        terrain = make_terrain("mixed", robot="toy", seed=seed)
        env = ToyEnv(World([[terrain]]), 1)
        corner = env.offsets[0, 0].numpy()
        for name in OTHERS:
            section = next(section for section in terrain.sections if section.name == name)
            x = rng.uniform(section.x0 - 0.6, section.x1 - 0.2, 8 * share)
            y = rng.uniform(section.y0 + 0.7, section.y1 - 0.7, 8 * share)
            poses = np.stack((x + corner[0], y + corner[1], 0 * x), axis=-1)
            patch = env.patches_at(torch.tensor(poses, dtype=torch.float32)).numpy()
            patches.append(patch[np.ptp(patch, axis=-1) > RELIEF][:share])
    return np.concatenate(patches).astype(np.float32)


def training_answers(
    target: "Any",
    patch: "np.ndarray",
    command: "np.ndarray",
    label: "np.ndarray",
    held_patch: "np.ndarray",
    held_command: "np.ndarray",
    foreign: "np.ndarray",
    budget: int,
    seed: int,
) -> tuple:
    """Train the learner's net; return what it says, what it took, and if the seed decides all.

    That is: updates, f and L_recon on the held-out ground, L_recon on foreign ground, and the
    largest difference of f between two short trainings from one seed.
    """
    import numpy as np
    import torch

    given = [torch.tensor(array) for array in (patch, command, label)]
    held, told, strange = (torch.tensor(a) for a in (held_patch, held_command, foreign))
    spent, count = [0], torch.autograd.backward

    def backward(*values: "Any", **options: "Any") -> None:
        spent[0] += 1
        count(*values, **options)

    def trained(updates: int) -> tuple:
        spent[0] = 0
        net = target(*(values.clone() for values in given), updates, seed)
        used = spent[0]
        with torch.no_grad():
            says = (
                net.feasibility(held, told),
                net.reconstruction(held),
                net.reconstruction(strange),
            )
        return used, *(values.float().numpy().reshape(-1) for values in says)

    threads = torch.get_num_threads()
    torch.autograd.backward = backward
    torch.set_num_threads(1)  # on a busy machine more of them mostly wait, and that counts as time
    try:
        short = [trained(3)[1] for _ in range(2)]
        answer = trained(budget)
    finally:
        torch.autograd.backward = count
        torch.set_num_threads(threads)
    return *answer, float(np.abs(short[0] - short[1]).max())


def training_faults(answer: Any, *case: Any) -> dict[str, str]:
    """Return what is wrong with a trained net, judged by labels that it was not given."""
    from fgtutor.statistics import auroc, calibration

    updates, f, familiar, strange, apart = answer
    *_, budget, seed = case
    label = _drives(seed)[1][2].astype(float)
    f = np.asarray(f, dtype=float)
    if len(f) != HELD or len(familiar) != HELD or len(strange) != FOREIGN:
        return {"form": "feasibility and reconstruction give one number for each patch: [n]."}
    losses = np.concatenate((familiar, strange))
    if not (np.isfinite(f).all() and np.isfinite(losses).all()):
        return {"finite": "Some f or L_recon is not a finite number: the training diverged."}
    found = {}
    if f.min() < 0 or f.max() > 1:
        found["range"] = f"f reaches from {f.min():.2f} to {f.max():.2f}: it must lie in [0, 1]."
    if updates > budget:
        found["budget"] = f"{updates} calls of backward(): the budget is {budget} updates."
    if apart > 1e-5:
        found["repeat"] = (
            f"Two trainings with the same seed give nets that differ by {apart:.2g}: nobody can "
            "repeat your result."
        )
    _, error = calibration(np.clip(f, 0, 1), label, 5)
    if error > CALIBRATED:
        found["calibration"] = (
            f"On held-out ground the calibration error is {error:.3f}: at most {CALIBRATED} is "
            "asked for."
        )
    share = float(np.mean((f - label) ** 2) / label.var())
    if share > EXPLAINED:
        found["useless"] = (
            f"On held-out ground the squared error is {share:.2f} times the labels' variance: at "
            f"most {EXPLAINED} is asked for, and a net that always says the mean has 1."
        )
    area = auroc(losses, np.arange(len(losses)) >= HELD) or 0.0
    if area < TOLD_APART:
        found["blind"] = (
            f"L_recon tells foreign ground from its own with an AUROC of {area:.2f}: at least "
            f"{TOLD_APART} is asked for, and guessing has 0.5."
        )
    return found


def train_net(
    patch: "torch.Tensor",
    command: "torch.Tensor",
    label: "torch.Tensor",
    budget: int,
    seed: int,
    flaw: str = "",
) -> "nn.Module":
    """Train the library's net, or with a flaw."""
    import torch

    from fgtutor.feasibility import FeasibilityNet

    class Scores(FeasibilityNet):
        def feasibility(self, patch: "torch.Tensor", command: "torch.Tensor") -> "torch.Tensor":
            return torch.logit(super().feasibility(patch, command))

    with one_thread(), torch.random.fork_rng(devices=[]):
        if flaw == "unseeded":
            torch.seed()
        else:
            torch.manual_seed(seed)
        kind = Scores if flaw == "score" else FeasibilityNet
        net = kind(patch.shape[1], hidden=(64, 32), vae_hidden=(128, 64), latent=8)
        if flaw == "blind":
            for part in (net.encoder, net.decoder):
                part.requires_grad_(False)
        if flaw == "mean":
            label = label.mean().expand(len(label))
        updates = {"untrained": 0, "over budget": budget + 1}.get(flaw, budget)
        weights = [p for p in net.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(weights, lr=3e-3, fused=True)
        for _ in range(updates):
            rows = torch.randint(len(patch), (128,))
            f_error = (
                FeasibilityNet.feasibility(net, patch[rows], command[rows]) - label[rows]
            ) ** 2
            loss = f_error.mean() + net.autoencoder_loss(patch[rows], beta=1e-3)[0]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return net.eval()


def flawed_net(flaw: str) -> Any:
    """Return a training with a flaw."""
    return lambda *given: train_net(*given, flaw=flaw)


# Into the zoo -------------------------------------------------------------------------------------


def zoo_case(rng: np.random.Generator) -> tuple:
    """Draw the zoo's tensors, a newcomer's f and L_recon, its own losses, and what is known."""
    shape = 6, 5, 8
    known = np.ones(shape[:2], dtype=bool)
    known[2, 3] = known[4, 1] = False
    own, alpha = rng.exponential(0.1, 60), float(rng.uniform(0.2, 0.5))
    loss = rng.uniform(0, 2 * np.quantile(own, 1 - alpha), shape)
    return rng.uniform(0, 0.7, (3, *shape)), rng.uniform(0.2, 1, shape), loss, own, alpha, known


def join_zoo(
    tensors: np.ndarray,
    f: np.ndarray,
    loss: np.ndarray,
    own: np.ndarray,
    alpha: float,
    known: np.ndarray,
    flaw: str = "",
) -> tuple[np.ndarray, np.ndarray]:
    """Add the newcomer, a cell and a heading at a time, or with a flaw."""
    joined = np.zeros(f.shape)
    for ix, iy, k in np.ndindex(f.shape):
        there = ix + int(STEPS[k][0]), iy + int(STEPS[k][1])
        inside = all(0 <= i < n for i, n in zip(there, known.shape, strict=True))
        known_there = flaw == "unknown" or (known[there] if inside else flaw == "edge")
        weight = min(np.mean(own >= loss[ix, iy, k]) / alpha, 1.0)
        if flaw == "unweighted":
            weight = 1.0
        if flaw == "uncalibrated":
            weight = np.mean(own >= loss[ix, iy, k])
        open_here = known[ix, iy] and (inside or flaw == "edge") and known_there
        joined[ix, iy, k] = weight * f[ix, iy, k] if open_here else 0.0
    before = tensors.max(axis=0)
    gain = joined - before if flaw == "signed" else np.maximum(joined - before, 0)
    if flaw == "first":
        return np.concatenate((joined[None], tensors)), gain
    if flaw == "shared":
        tensors = tensors * (1 - joined / 2)
    return np.concatenate((tensors, joined[None])), gain


def flawed_zoo(flaw: str) -> Any:
    """Return a newcomer's entry with a flaw."""
    return lambda *given: join_zoo(*given, flaw=flaw)
