"""How well Feasibility-Nets predict r_v on new terrain, and how w_ood tells own ground from other.

Reads a robot's zoo; drives every specialist over terrain it was never trained on, with
deterministic actions, and compares: predicted feasibility with the r_v that followed (calibration),
and w_ood on what it met at home with w_ood on what the other specialists meet at their obstacles.
Source: paper, Sec. III-A (feasibility is predicted r_v) and Eq. 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, TypedDict

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float

from fgtutor.errors import ConfigError
from fgtutor.evaluation.report import Findings, markdown, run_and_report
from fgtutor.evaluation.shards import settings_of
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import ZooConfig
from fgtutor.io.validation import NonNegative
from fgtutor.learning.calibrate import RELIEF, Rollout, roll_out
from fgtutor.robots import condition_of
from fgtutor.robots.conditions import Condition
from fgtutor.settings import SETTINGS, Taus
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.statistics import calibration
from fgtutor.tensorization import ood_score
from fgtutor.world.terrain import make_terrain

COMMAND = "evaluate calibration"


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig(ZooConfig):
    """Check every Feasibility-Net on terrain that was never trained on."""

    envs: Annotated[int, Interval(ge=1, le=10_000)] = 100
    """Robots, each on a terrain of its own."""
    seconds: Annotated[float, Interval(gt=0, le=3600)] = 16.0
    """How long they drive, s; ended episodes begin anew."""
    settings: Literal["ours", "paper"] = "ours"
    """Whose thresholds of w_ood: ours, or the paper's."""
    taus: Literal["paper", "calibrated"] | None = None
    """Other thresholds than those of the settings."""
    conditions: Literal["training", "undisturbed", "disturbed"] = "training"
    """What is amiss on the drive: what the environment draws in training, nothing, or the robot's
    preset of disturbances."""
    relief: NonNegative = RELIEF
    """A patch with at least this difference of heights is distinctive of its terrain, m."""

    @property
    def condition(self) -> Condition | None:
        """What is amiss; None leaves it to the environment, as in training."""
        return None if self.conditions == "training" else condition_of(self.robot, self.conditions)

    @property
    def thresholds(self) -> Taus:
        """The thresholds that these options choose."""
        return self.taus or SETTINGS[self.settings].taus

    def load_zoo(self) -> dict[str, Specialist]:
        """Return the specialists."""
        return load_zoo(self.robot, self.home)


class CalibrationRow(TypedDict):
    """What a report keeps of one specialist's drive."""

    specialist: str
    samples: int
    """Labelled patches."""
    calibration_error: float
    calibration: list[list[float | None]]
    """Mean predicted, mean measured and count of each bin."""
    w_ood: dict[str, float | None]
    """What every Feasibility-Net of the zoo makes of the patches: the driver's own of all of them,
    the others of the distinctive ones, of which flat ground has none."""


def drive(specialist: Specialist, terrain: str, config: CalibrationConfig) -> Rollout:
    """Drive a specialist over held-out terrains of full difficulty, with deterministic actions.

    Places, headings and commands are drawn as in training; terrain seeds are odd, as never there.
    """
    tiles = [
        make_terrain(terrain, robot=config.robot, seed=2 * (config.seed * 10_000 + i) + 1)
        for i in range(config.envs)
    ]
    options = config.condition.options if config.condition else {}
    return roll_out(
        specialist, tiles, config.envs, config.seconds, seed=config.seed + 1, options=options
    )


@torch.no_grad()
def promised(
    specialist: Specialist, driven: Rollout
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return f of every patch that was met, and the mean r_v that followed."""
    f = specialist.feasibility.feasibility(driven.patch, driven.command)
    return f.numpy(), driven.label.numpy()


@torch.no_grad()
def run_task(config: CalibrationConfig, name: str) -> list[CalibrationRow]:
    """Do one task: drive one specialist, and ask the Feasibility-Nets of all about what it met."""
    zoo = config.load_zoo()
    driven = drive(zoo[name], zoo[name].provenance.get("terrain", name), config)
    relief = driven.patch.amax(dim=-1) - driven.patch.amin(dim=-1)
    distinctive = driven.patch[relief >= config.relief]

    def weight(other: str) -> float | None:
        patch = driven.patch if other == name else distinctive
        if not len(patch):
            return None
        score = ood_score(config.thresholds, zoo[other])
        return round(score.weight(*zoo[other].feasibility.losses(patch)).mean().item(), 4)

    bins, error = calibration(*promised(zoo[name], driven))
    return [
        {
            "specialist": name,
            "samples": len(driven.label),
            "calibration_error": round(error, 4),
            "calibration": [[None if np.isnan(v) else round(float(v), 4) for v in b] for b in bins],
            "w_ood": {other: weight(other) for other in zoo},
        }
    ]


def table(rows: Sequence[CalibrationRow]) -> str:
    """Return the rows as a Markdown table: a line per Feasibility-Net, a column per drive."""

    def write(weight: float | None) -> str:
        return "-" if weight is None else f"{weight:.2f}"

    lines = []
    for row in rows:
        own, asked = row["specialist"], {row["specialist"]: row["w_ood"] for row in rows}
        others = (write(None if own == name else asked[name][own]) for name in asked)
        lines.append([own, f"{row['calibration_error']:.3f}", write(asked[own][own]), *others])
    names = (f"w_ood {row['specialist']}" for row in rows)
    return markdown(["specialist", "calibration error", "w_ood own", *names], lines)


def run(config: CalibrationConfig) -> int:
    """Check from the command line, print the table and write the report."""
    names = list(config.load_zoo())
    if not names:
        raise ConfigError("there is no specialist to check: the zoo is empty")

    def find(rows: list[CalibrationRow]) -> Findings:
        samples = min(row["samples"] for row in rows)
        amiss = config.told(config.condition) if config.condition else "as disturbed as in training"
        caption = (
            f"At least {samples:,} labelled patches each; robot {config.robot}, tau "
            f"{config.thresholds}, seed {config.seed}; {amiss}."
        )
        return Findings(table=table(rows), caption=caption, rows="drives")

    return run_and_report(
        config,
        title=f"What Feasibility-Nets know ({config.robot})",
        tasks=[Task(name=name, function=run_task, arguments=(config, name)) for name in names],
        settings=settings_of(
            config,
            COMMAND,
            without=("settings",),
            taus=config.thresholds,
            condition=config.condition.ranges if config.condition else None,
            zoo=config.zoo_digests(),
        ),
        find=find,
    )
