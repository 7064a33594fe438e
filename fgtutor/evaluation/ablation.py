"""What each part of the planner buys: ours, ours with a part left out, and classical costs.

Reads a robot, a number of trials and a seed; gives a row a planner of `baselines`, on the mixed
terrain. All plan through the same search and drive through the same execution; the classical maps
know of no policies, so the generalist drives them, or (+P) our policy map chooses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Annotated

from fgtutor.baselines import planners
from fgtutor.errors import ConfigError
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.success import TrialsConfig, by_cell, summarise
from fgtutor.evaluation.tasks import Row
from fgtutor.io.validation import Unique
from fgtutor.statistics import Share

COMMAND = "evaluate baselines"


@dataclass(frozen=True, kw_only=True)
class AblationConfig(TrialsConfig):
    """Evaluate baselines, and our planner with parts left out."""

    terrain: str = "mixed"
    """The terrain to cross."""
    planners: Annotated[tuple[str, ...], Unique] = ()
    """Only these planners; default: all."""


def names(config: AblationConfig) -> tuple[str, ...]:
    """Return the planners to evaluate, in the table's order; raises `ConfigError` for others."""
    everyone = tuple(planners(config.load_zoo()))
    unknown = [name for name in config.planners if name not in everyone]
    if unknown:
        raise ConfigError(f"no planner named {', '.join(unknown)}; choose of {', '.join(everyone)}")
    return tuple(name for name in everyone if not config.planners or name in config.planners)


def evaluate(config: AblationConfig) -> list[Row]:
    """Return a row a planner, as `matrix.evaluate` returns them."""
    return success.evaluate(config, COMMAND, (config.terrain,), names(config))


def table(trials: Sequence[Row]) -> str:
    """Return the trials as a Markdown table, a line a planner; lengths and switches of successes.

    A dash stands where nothing was reached.
    """
    lines = []
    for (_, planner), cell in by_cell(trials).items():
        row, reached = summarise(cell), [t for t in cell if t["outcome"] == "reached"]
        means = [
            f"{fmean(t[key] for t in reached):.1f}" if reached else "-"
            for key in ("length", "switches")
        ]
        share = Share(successes=row["successes"], trials=row["trials"])
        lines.append([planner, share, *row["failures"].values(), *means])
    columns = ["planner", "success, %", "no route", "fell", "timeout", "length, m", "switches"]
    return markdown(columns, lines)


def run(config: AblationConfig) -> int:
    """Evaluate from the command line, print the table and write rows and report."""
    return success.run_and_report(
        config,
        COMMAND,
        title=f"What each part buys ({config.robot}, {config.terrain})",
        terrains=(config.terrain,),
        policies=names(config),
        table=table,
    )
