"""What each part of the planner buys: ours, ours with a part left out, and classical costs.

Reads a robot, a number of trials and a seed; gives a row per planner of `baselines`, on the mixed
terrain. All plan through the same search and drive through the same execution; the classical maps
know of no policies, so the generalist drives them, or (+P) our policy map chooses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fgtutor.baselines import planners
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.success import TrialsConfig
from fgtutor.evaluation.trials import TrialRow, by_cell, choose, failures, mean_if_reached
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


def table(trials: Sequence[TrialRow]) -> str:
    """Return the trials as a Markdown table, a line per planner; lengths and switches of successes.

    A dash stands where nothing was reached.
    """
    lines = [
        [
            planner,
            Share.reached(cell),
            *failures(cell),
            mean_if_reached(cell, "length"),
            mean_if_reached(cell, "switches"),
        ]
        for (planner,), cell in by_cell(trials, ("policy",)).items()
    ]
    columns = ["planner", "success, %", "no route", "fell", "timeout", "length, m", "switches"]
    return markdown(columns, lines)


def run(config: AblationConfig) -> int:
    """Evaluate from the command line, print the table and write the report."""
    return success.run_and_report(
        config,
        COMMAND,
        title=f"What each part buys ({config.robot}, {config.terrain})",
        terrains=(config.terrain,),
        policies=choose("planner", config.planners, planners(config.load_zoo())),
        table=table,
    )
