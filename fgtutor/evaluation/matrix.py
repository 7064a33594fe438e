"""Table II: success of every policy, of ours and of the generalist on every terrain.

Reads a robot, a number of trials and a seed; gives rows with confidence intervals and the reason of
every failure. Source: paper, Sec. IV-B (Table II); `--protocol paper` is its 40 tasks per terrain
with 250 trials each, 300,000 trials with four specialists.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

from fgtutor.baselines import OURS
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.success import TrialsConfig
from fgtutor.evaluation.trials import TrialRow, by_cell, choose
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS
from fgtutor.specialist import GENERAL
from fgtutor.statistics import Share

COMMAND = "evaluate matrix"


@dataclass(frozen=True, kw_only=True)
class MatrixConfig(TrialsConfig):
    """Evaluate policies x terrains, the paper's Table II."""

    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Only these terrains; default: the robot's own and mixed."""
    policies: Annotated[tuple[str, ...], Unique] = ()
    """Only these policies; default: each specialist, ours, general."""


def policies(config: MatrixConfig, zoo: Iterable[str]) -> tuple[str, ...]:
    """Return the policies to evaluate, in the table's order; raises `ConfigError` for others."""
    known = [*(name for name in zoo if name != GENERAL), OURS]
    return choose("policy", config.policies, [*known, GENERAL] if GENERAL in zoo else known)


def table(trials: Sequence[TrialRow]) -> str:
    """Return the trials as a Markdown table: a line per terrain, a column per policy."""
    cells = by_cell(trials)
    terrains, columns = (list(dict.fromkeys(names)) for names in zip(*cells, strict=True))
    return markdown(
        ["terrain", *columns],
        ([name, *(Share.reached(cells[name, policy]) for policy in columns)] for name in terrains),
    )


def run(config: MatrixConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    columns = policies(config, config.load_zoo())  # an unknown robot fails here
    return success.run_and_report(
        config,
        COMMAND,
        title=f"Success of policies on terrains ({config.robot})",
        terrains=config.terrains or (*ROBOTS[config.robot].scale.mixed, "mixed"),
        policies=columns,
        table=table,
    )
