"""Table II: success of every policy, of ours and of the generalist on every terrain.

Reads a robot, a number of trials and a seed; gives rows with confidence intervals and the reason of
every failure. Source: paper, Sec. IV-B (Table II); `--protocol paper` is its 40 tasks a terrain
with 250 trials each, 300,000 trials with four specialists.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from fgtutor.baselines import OURS
from fgtutor.errors import ConfigError
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.success import TrialsConfig, by_cell
from fgtutor.evaluation.tasks import Row
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS
from fgtutor.specialist import GENERAL, Specialist
from fgtutor.statistics import Share

COMMAND = "evaluate matrix"


@dataclass(frozen=True, kw_only=True)
class MatrixConfig(TrialsConfig):
    """Evaluate policies x terrains, the paper's Table II."""

    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Only these terrains; default: the robot's own and mixed."""
    policies: Annotated[tuple[str, ...], Unique] = ()
    """Only these policies; default: each specialist, ours, general."""


def policies(config: MatrixConfig, zoo: Mapping[str, Specialist]) -> tuple[str, ...]:
    """Return the policies to evaluate, in the table's order; raises `ConfigError` for others."""
    everyone = (*(name for name in zoo if name != GENERAL), OURS, *([GENERAL] * (GENERAL in zoo)))
    unknown = [name for name in config.policies if name not in everyone]
    if unknown:
        raise ConfigError(f"no policy named {', '.join(unknown)}; choose of {', '.join(everyone)}")
    return tuple(name for name in everyone if not config.policies or name in config.policies)


def terrains(config: MatrixConfig) -> tuple[str, ...]:
    """Return the terrains to evaluate on."""
    return config.terrains or (*ROBOTS[config.robot].scale.mixed, "mixed")


def evaluate(config: MatrixConfig) -> list[Row]:
    """Return the rows of the matrix; the same for any number of workers."""
    return success.evaluate(config, COMMAND, terrains(config), policies(config, config.load_zoo()))


def table(trials: Sequence[Row]) -> str:
    """Return the trials as a Markdown table: a line a terrain, a column a policy."""
    cells = by_cell(trials)
    columns = dict.fromkeys(policy for _, policy in cells)
    return markdown(
        ["terrain", *columns],
        (
            [terrain, *(Share.reached(cells[terrain, policy]) for policy in columns)]
            for terrain in dict.fromkeys(terrain for terrain, _ in cells)
        ),
    )


def run(config: MatrixConfig) -> int:
    """Evaluate from the command line, print the table and write rows and report."""
    return success.run_and_report(
        config,
        COMMAND,
        title=f"Success of policies on terrains ({config.robot})",
        terrains=terrains(config),
        policies=policies(config, config.load_zoo()),
        table=table,
    )
