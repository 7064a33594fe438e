"""Does a Feasibility-Net know what its policy can do, and where it has never been?

Reads a robot's zoo; drives every specialist over terrain it was never trained on, with
deterministic actions, and compares: predicted feasibility with the r_v that followed (calibration),
and w_ood on what it met at home with w_ood on what the other specialists meet at their obstacles.
Source: paper, Sec. III-A (feasibility is predicted r_v) and Eq. 4.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from fgtutor.errors import ConfigError
from fgtutor.feasibility import feasibility_labels, ood_weight
from fgtutor.io.storage import check_writable, write_json
from fgtutor.io.validation import NonNegative, Seed, check_fields
from fgtutor.robots import env_class
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.statistics import calibration
from fgtutor.tensorization import resolve_taus
from fgtutor.world.terrain import World, make_terrain


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """Check every Feasibility-Net on terrain that was never trained on."""

    robot: str = "toy"
    """Which robot."""
    envs: Annotated[int, Interval(ge=1, le=10_000)] = 100
    """Robots, each on a terrain of its own."""
    seconds: Annotated[float, Interval(gt=0, le=3600)] = 16.0
    """How long they drive, s; ended episodes begin anew."""
    seed: Seed = 0
    """What terrains and episodes are drawn from."""
    taus: Literal["paper", "calibrated"] = "calibrated"
    """Thresholds of w_ood."""
    relief: NonNegative = 0.06
    """A patch with at least this difference of heights is distinctive of its terrain, m."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo."""
    json: Path | None = None
    """Write the results here."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class Drive:
    """What one specialist met on held-out terrain of its own kind."""

    patch: Float[Tensor, "n points"]
    """The patches under it, m."""
    predicted: Float[np.ndarray, "n"]
    """Its Feasibility-Net's f there."""
    measured: Float[np.ndarray, "n"]
    """The mean r_v that followed."""


@torch.no_grad()
def drive(specialist: Specialist, terrain: str, config: CalibrationConfig) -> Drive:
    """Drive a specialist over held-out terrains of full difficulty, with deterministic actions.

    Places, headings and commands are drawn as in training; terrain seeds are odd, as never there.
    """
    tiles = [
        make_terrain(terrain, robot=config.robot, seed=2 * (config.seed * 10_000 + i) + 1)
        for i in range(config.envs)
    ]
    robot = env_class(config.robot)
    episodes = replace(robot.episodes, history=specialist.history)
    env = robot(World([tiles]), config.envs, config=episodes, seed=config.seed + 1)
    observations = env.get_observations()
    seen: dict[str, list[Tensor]] = {"tracking": [], "patch": [], "command": []}
    for _ in range(round(config.seconds / env.control_dt)):
        for name, values in seen.items():
            values.append(observations[name])
        observations, *_ = env.step(specialist.act(observations))
    rollout = {name: torch.stack(values) for name, values in seen.items()}
    label, valid = feasibility_labels(
        rollout["tracking"], round(specialist.label_seconds / env.control_dt)
    )
    patch, command = rollout["patch"][valid], rollout["command"][valid]
    predicted = specialist.feasibility.feasibility(patch, command)
    return Drive(patch, predicted.numpy(), label[valid].numpy())


def evaluate(config: CalibrationConfig, *, progress: bool = False) -> dict[str, Any]:
    """Return, by specialist: calibration, w_ood at home and at the others' obstacles."""
    zoo = load_zoo(config.robot, config.zoo)
    if not zoo:
        raise ConfigError("there is no specialist to check: the zoo is empty")
    drives = {
        name: drive(specialist, specialist.provenance.get("terrain", name), config)
        for name, specialist in tqdm(zoo.items(), disable=not progress, unit="specialist")
    }
    return {name: _check(name, zoo, drives, config) for name in zoo}


def _check(
    name: str,
    zoo: Mapping[str, Specialist],
    drives: Mapping[str, Drive],
    config: CalibrationConfig,
) -> dict[str, Any]:
    specialist, own = zoo[name], drives[name]
    table, error = calibration(own.predicted, own.measured)
    taus = resolve_taus(config.taus, specialist)

    def weight(patch: Tensor) -> float | None:
        if not len(patch):  # flat ground has nothing distinctive
            return None
        with torch.inference_mode():
            loss = specialist.feasibility.reconstruction(patch)
        return round(ood_weight(loss, *taus).mean().item(), 4)

    return {
        "samples": len(own.measured),
        "calibration_error": round(error, 4),
        "calibration": [
            [None if np.isnan(v) else round(float(v), 4) for v in row] for row in table
        ],
        "taus": [round(tau, 4) for tau in taus],
        "w_ood_own": weight(own.patch),
        "w_ood_others": {
            other: weight(_distinctive(drive.patch, config.relief))
            for other, drive in drives.items()
            if other != name
        },
    }


def _distinctive(patch: Float[Tensor, "n points"], relief: float) -> Float[Tensor, "m points"]:
    return patch[patch.amax(dim=-1) - patch.amin(dim=-1) >= relief]


def report(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the results as a Markdown table."""
    names = list(results)
    lines = [
        "| specialist | calibration error | w_ood own | "
        + " | ".join(f"w_ood {name}" for name in names)
        + " |",
        "|---" * (len(names) + 3) + "|",
    ]
    for name, row in results.items():
        others = [row["w_ood_others"].get(o) for o in names]
        lines.append(
            f"| {name} | {row['calibration_error']:.3f} | {row['w_ood_own']:.2f} | "
            + " | ".join("-" if w is None else f"{w:.2f}" for w in others)
            + " |"
        )
    return "\n".join(lines)


def run(config: CalibrationConfig) -> int:
    """Check from the command line, print the table and write the results."""
    if config.json:
        check_writable(config.json)
    results = evaluate(config, progress=True)
    print(report(results))
    samples = min(row["samples"] for row in results.values())
    print(f"at least {samples:,} labelled patches each, tau {config.taus}, seed {config.seed}")
    if config.json:
        write_json(config.json, results)
        print(f"results -> {config.json}")
    return 0
