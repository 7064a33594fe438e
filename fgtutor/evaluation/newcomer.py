"""A specialist dropped into the zoo: what our planner gains by it, and that nothing else changes.

Reads a zoo that holds the newcomer, and the terrain that it is for; gives our success there and on
the other terrains without and with the newcomer's folder, on the same grounds. Nothing is trained.
On every ground the tensors of the other specialists are compared, bit for bit.
Source: paper, Sec. III-C: F_max is a maximum over specialists, so one more only adds to it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from fgtutor.baselines import AssessedMap, ours
from fgtutor.errors import ConfigError, EvaluationError
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.shards import digest
from fgtutor.evaluation.success import TrialsConfig, make_ground
from fgtutor.evaluation.trials import TrialRow, by_cell, drive, failures
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS
from fgtutor.specialist import DESCRIPTION, GENERAL, Specialist, load_specialist, load_zoo
from fgtutor.statistics import Share

COMMAND = "evaluate newcomer"
STAGES = ("without", "with")
"""The zoo before the newcomer's folder is dropped in, and after."""


@dataclass(frozen=True, kw_only=True)
class NewcomerConfig(TrialsConfig):
    """Evaluate our planner without and with one of the specialists."""

    newcomer: str = "rubble"
    """Name of the specialist of the zoo to leave out and to add; or the folder of one that is not
    in the zoo, to add."""
    terrain: str | None = None
    """The terrain that it is for; default: the one that it was trained on."""
    others: Annotated[tuple[str, ...], Unique] = ()
    """Terrains that must not suffer; default: the robot's own and mixed."""

    @property
    def folder(self) -> Path:
        """Where the newcomer's folder lies."""
        inside = self.home / self.newcomer
        return inside if (inside / DESCRIPTION).is_file() else Path(self.newcomer)

    @property
    def name(self) -> str:
        """What the newcomer is called; in the zoo, as its folder."""
        inside = self.folder in super().folders
        return self.folder.name if inside else load_specialist(self.folder).name

    @property
    def folders(self) -> list[Path]:
        """The folders of the zoo and the newcomer's."""
        return sorted({*super().folders, self.folder})

    def load_zoo(self) -> dict[str, Specialist]:
        """Return the zoo with the newcomer."""
        *_, zoo = zoos(self)
        return zoo


class NewcomerRow(TrialRow):
    """A trial, with what was planned on."""

    tensors: dict[str, str]
    """A digest of each specialist's tensor."""


def terrains(config: NewcomerConfig) -> tuple[str, ...]:
    """Return the terrains to evaluate on, the newcomer's first.

    Raises `ConfigError` if the zoo holds no such specialist, or no other.
    """
    zoo = load_zoo(config.robot, config.zoo)
    inside = config.newcomer in zoo
    outside = config.newcomer != GENERAL and (config.folder / DESCRIPTION).is_file()
    if not (inside or outside) or not zoo.keys() - {config.newcomer}:
        raise ConfigError(
            f"need a newcomer and others in {config.home}, asked for "
            f"{config.newcomer!r} of {', '.join(zoo)}: give another name, or a specialist's folder"
        )
    if not inside and config.name in zoo:
        raise ConfigError(
            f"{config.name} is in the zoo already: leave it out by its name, not {config.newcomer}"
        )
    provenance = load_specialist(config.folder).provenance
    its_own = config.terrain or provenance.get("terrain", config.name)
    return tuple(
        dict.fromkeys((its_own, *(config.others or (*ROBOTS[config.robot].scale.mixed, "mixed"))))
    )


def zoos(config: NewcomerConfig) -> Iterator[dict[str, Specialist]]:
    """Give the zoo without the newcomer's folder and then with it, both read from disk."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        for path in config.folders:
            if path != config.folder:
                (folder / path.name).symlink_to(path.resolve())
        yield load_zoo(config.robot, folder)
        (folder / config.name).symlink_to(config.folder.resolve())
        yield load_zoo(config.robot, folder)


def run_task(
    config: NewcomerConfig, terrain: str, stages: Sequence[str], indices: Sequence[int]
) -> list[NewcomerRow]:
    """Do one task: some grounds of one terrain, without and with the newcomer."""
    grounds = [make_ground(config, terrain, index) for index in indices]
    rows: list[NewcomerRow] = []
    for stage, zoo in zip(stages, zoos(config), strict=True):
        digests: dict[int, dict[str, str]] = {}
        for trial in drive(
            grounds, {stage: ours}, zoo, settings=config.planning, condition=config.condition
        ):
            row = trial.row
            if row["ground"] not in digests:
                digests[row["ground"]] = digests_of(trial.planned.known)
            rows.append({**row, "tensors": digests[row["ground"]]})
    return rows


def digests_of(known: AssessedMap) -> dict[str, str]:
    """Return a digest of each tensor that our planner plans on."""
    (layers,) = ours(known)
    return {name: digest(tensor.contiguous().numpy().tobytes()) for name, tensor in layers.items()}


def compare_tensors(trials: Sequence[NewcomerRow], newcomer: str) -> str:
    """Say how many tensors of the other specialists were compared, on how many maps.

    Raises `EvaluationError` if one of them is not the same, bit for bit, with the newcomer there.
    """
    before, after = (
        {(t["terrain"], t["ground"]): t["tensors"] for t in trials if t["policy"] == stage}
        for stage in STAGES
    )
    for (terrain, ground), tensors in before.items():
        then = after[terrain, ground]
        if changed := [name for name, digest in tensors.items() if then.get(name) != digest]:
            raise EvaluationError(
                f"on ground {ground} of {terrain}, {newcomer} changed the tensor of "
                f"{', '.join(changed)}, which may depend on its own folder alone: look for what "
                "else it reads; the rows are kept"
            )
    names = dict.fromkeys(name for tensors in before.values() for name in tensors)
    compared = sum(len(tensors) for tensors in before.values())
    return (
        f"The tensors of {', '.join(names)} are bit-identical without and with {newcomer} on all "
        f"{len(before):,} maps ({compared:,} pairs compared by sha256)."
    )


def table(trials: Sequence[TrialRow], newcomer: str) -> str:
    """Return the trials as a Markdown table, a line per terrain, with failures by reason."""
    cells = by_cell(trials)
    lines = []
    for terrain in dict.fromkeys(terrain for terrain, _ in cells):
        line: list[object] = [terrain]
        for stage in STAGES:
            cell = cells[terrain, stage]
            line += [Share.reached(cell), " / ".join(map(str, failures(cell)))]
        lines.append(line)
    reasons = "no route / fell / timeout"
    return markdown(
        ["terrain", f"without {newcomer}, %", reasons, f"with {newcomer}, %", reasons], lines
    )


def run(config: NewcomerConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    grounds = terrains(config)
    return success.run_and_report(
        config,
        COMMAND,
        title=f"Ours without and with {config.name} ({config.robot})",
        terrains=grounds,
        policies=STAGES,
        table=partial(table, newcomer=config.name),
        work=run_task,
        remark=partial(compare_tensors, newcomer=config.name),
    )
