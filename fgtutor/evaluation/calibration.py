"""How well Feasibility-Nets predict r_v on new terrain, and how w_ood tells own ground from other.

Reads a robot's zoo; drives every specialist over terrain it was never trained on, with
deterministic actions, and compares: predicted feasibility with the r_v that followed (calibration),
and how familiar what it met is to itself and to the others. Ground that none of them was trained on
is asked about too: rubble, natural ground, maps from files.
Source: paper, Sec. III-A (feasibility is predicted r_v) and Eq. 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, TypedDict

import numpy as np
import torch
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.evaluation.report import Findings, markdown, run_and_report
from fgtutor.evaluation.shards import settings_of
from fgtutor.evaluation.tasks import Task
from fgtutor.evaluation.trials import ZooConfig
from fgtutor.io.validation import NonNegative
from fgtutor.learning.calibrate import RELIEF, Rollout, roll_out
from fgtutor.learning.refit import cut_anywhere, natural_ground
from fgtutor.patches import PatchGrid
from fgtutor.robots import condition_of
from fgtutor.robots.conditions import Condition
from fgtutor.settings import SETTINGS, Taus
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.statistics import auroc, calibration
from fgtutor.tensorization import ood_score
from fgtutor.world.terrain import Terrain, make_terrain

COMMAND = "evaluate calibration"
NATURAL = "natural"
STRANGE = ("rubble", NATURAL)
"""Grounds to ask about, unless a specialist was trained on them."""
PATCHES = 20_000
"""Patches of such ground."""


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
    maps: tuple[Path, ...] = ()
    """Elevation maps that the specialists are asked about too."""

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
    """What a report keeps of one ground."""

    ground: str
    """The specialist that was driven at home, or ground that is no specialist's home."""
    samples: int
    """Patches: labelled ones of a drive."""
    calibration_error: float | None
    """Of the driven specialist; None where none was."""
    calibration: list[list[float | None]]
    """Mean predicted, mean measured and count of each bin; empty where nothing was driven."""
    w_ood: dict[str, float | None]
    """What every Feasibility-Net of the zoo makes of the patches: the driver's own of all of them,
    the others of the distinctive ones, of which flat ground has none."""
    auroc: dict[str, float | None]
    """How well each other net's score tells distinctive patches from its own: the probability that
    one drawn here is stranger than one drawn at home."""


@lru_cache(maxsize=16)
def at_home(config: CalibrationConfig, name: str) -> Rollout:
    """Return what a specialist meets on its own terrain, driven once per process."""
    specialist = config.load_zoo()[name]
    return drive(specialist, specialist.provenance.get("terrain", name), config)


def drive(specialist: Specialist, terrain: str, config: CalibrationConfig) -> Rollout:
    """Drive a specialist over held-out terrains of full difficulty, with deterministic actions.

    Places, headings and commands are drawn as in training; terrain seeds are odd, as never there.
    """
    tiles = terrains(terrain, config)
    options = config.condition.options if config.condition else {}
    return roll_out(
        specialist, tiles, config.envs, config.seconds, seed=config.seed + 1, options=options
    )


def terrains(kind: str, config: CalibrationConfig) -> list[Terrain]:
    """Return terrains of one kind and full difficulty, whose maps equal none of a training."""
    return [
        make_terrain(kind, robot=config.robot, seed=2 * (config.seed * 10_000 + i) + 1, unlike=True)
        for i in range(config.envs)
    ]


@torch.no_grad()
def promised(
    specialist: Specialist, driven: Rollout
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return f of every patch that was met, and the mean r_v that followed."""
    f = specialist.feasibility.feasibility(driven.patch, driven.command)
    return f.numpy(), driven.label.numpy()


def strange_grounds(config: CalibrationConfig) -> list[str]:
    """Return the names of grounds that no specialist of the zoo was trained on.

    Raises `ConfigError` if a map is called as another one, or as a specialist.
    """
    zoo = config.load_zoo()
    homes = {str(one.provenance.get("terrain", name)) for name, one in zoo.items()}
    names = [
        *(kind for kind in STRANGE if kind not in homes),
        *(path.stem for path in config.maps),
    ]
    if len({*names, *zoo}) < len(names) + len(zoo):
        raise ConfigError(
            f"each ground needs a name of its own, got {', '.join([*zoo, *names])}: rename a map"
        )
    return names


@lru_cache(maxsize=4)
def patches_of(config: CalibrationConfig, ground: str, grid: PatchGrid) -> Rollout:
    """Return patches cut anywhere on ground that nothing was trained on, once per process."""
    rng = np.random.default_rng(config.seed)
    files = {path.stem: path for path in config.maps}
    if ground in files:
        elevations = [ElevationMap.load(files[ground])]
    else:
        kind = "rubble" if ground == NATURAL else ground
        tiles = terrains(kind, config)
        elevations = [tile.elevation for tile in tiles]
        if ground == NATURAL:
            elevations = [natural_ground(one, rng) for one in elevations]
    count = -(-PATCHES // len(elevations))
    patch = torch.cat([cut_anywhere(one, grid, count, rng) for one in elevations])
    nothing = torch.empty(0)
    return Rollout(patch, nothing, nothing)


@torch.no_grad()
def run_task(config: CalibrationConfig, name: str) -> list[CalibrationRow]:
    """Do one task: ask the Feasibility-Nets of all about one ground, driven if it is a home."""
    zoo = config.load_zoo()

    def strange(other: str, patch: Tensor) -> tuple[Tensor, Tensor]:
        """Return w_ood, and the score that it falls with."""
        net, score = zoo[other].feasibility, ood_score(config.thresholds, zoo[other])
        losses = net.losses(net.relief(patch))
        return score.weight(*losses), losses[0] if score.taus else -score.p_value(*losses)

    def distinctive(met: Rollout) -> Tensor:
        relief = met.patch.amax(dim=-1) - met.patch.amin(dim=-1)
        return met.patch[relief >= config.relief]

    def asked(other: str) -> tuple[float | None, float | None]:
        met = at_home(config, name) if name in zoo else patches_of(config, name, zoo[other].grid)
        patch = met.patch if other == name else distinctive(met)
        if not len(patch):
            return None, None
        w_ood, stranger = strange(other, patch)
        _, own = strange(other, distinctive(at_home(config, other)))
        is_stranger = np.arange(len(patch) + len(own)) < len(patch)
        found = auroc(torch.cat((stranger, own)).numpy(), is_stranger)
        told = None if found is None or other == name else round(found, 4)
        return round(w_ood.mean().item(), 4), told

    said = {other: asked(other) for other in zoo}
    bins, error, samples = [], None, PATCHES
    if name in zoo:
        driven = at_home(config, name)
        bins, error = calibration(*promised(zoo[name], driven))
        samples = len(driven.label)
    return [
        {
            "ground": name,
            "samples": samples,
            "calibration_error": None if error is None else round(error, 4),
            "calibration": [[None if np.isnan(v) else round(float(v), 4) for v in b] for b in bins],
            "w_ood": {other: w_ood for other, (w_ood, _) in said.items()},
            "auroc": {other: found for other, (_, found) in said.items()},
        }
    ]


def table(rows: Sequence[CalibrationRow]) -> str:
    """Return the rows as a Markdown table: a line per Feasibility-Net, a column per ground.

    A cell holds w_ood and, after a slash, the AUROC.
    """

    def write(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    lines = []
    for row in rows:
        net = row["ground"]
        if net not in row["w_ood"]:
            continue
        cells = [
            "-" if other is row else f"{write(other['w_ood'][net])} / {write(other['auroc'][net])}"
            for other in rows
        ]
        lines.append([net, f"{row['calibration_error']:.3f}", write(row["w_ood"][net]), *cells])
    columns = ["specialist", "calibration error", "w_ood own", *(row["ground"] for row in rows)]
    return markdown(columns, lines)


def run(config: CalibrationConfig) -> int:
    """Check from the command line, print the table and write the report."""
    names = list(config.load_zoo())
    if not names:
        raise ConfigError("there is no specialist to check: the zoo is empty")

    def find(rows: list[CalibrationRow]) -> Findings:
        samples = min(row["samples"] for row in rows if row["calibration"])
        usual = "under the usual disturbances of training"
        amiss = config.told(config.condition) if config.condition else usual
        caption = (
            f"w_ood, and after a slash the AUROC of strangers against own patches. At least "
            f"{samples:,} labelled patches each; robot {config.robot}, tau "
            f"{config.thresholds}, seed {config.seed}; {amiss}."
        )
        return Findings(table=table(rows), caption=caption, rows="grounds")

    return run_and_report(
        config,
        title=f"What Feasibility-Nets know ({config.robot})",
        tasks=[
            Task(name=name, function=run_task, arguments=(config, name))
            for name in (*names, *strange_grounds(config))
        ],
        settings=settings_of(
            config,
            COMMAND,
            without=("settings",),
            taus=config.thresholds,
            unlike=True,
            condition=config.condition.ranges if config.condition else None,
            zoo=config.zoo_digests(),
        ),
        find=find,
    )
