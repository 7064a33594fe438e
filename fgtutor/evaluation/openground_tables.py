"""What the trials on open ground come to: the table, and where our planner failed.

Reads the rows that `openground` keeps; gives Markdown and words. Source: SPL, Anderson et al.
(2018); the Brier score (1950) for the promises of routes.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from statistics import median

import numpy as np

from fgtutor.baselines import OURS
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.trials import TrialRow, by_cell, failures, mean_if_reached
from fgtutor.statistics import Share, brier, spl

COLUMNS = (
    "maps, noise + drift, planner, success (%), no route, fell, timeout, SPL, recall (%), "
    "precision (%), Brier, switches, assess (s), plan (s)"
)


class OpenRow(TrialRow):
    """A task, planned and driven, as a report keeps it."""

    map: int
    """The number of its map."""
    task: int
    """Its number on the map."""
    feasible: bool
    """Whether there is a way, by construction."""
    noise: float
    """Standard deviation of a fix, m."""
    drift: float
    """Growth of the error, m per square root of a second."""
    shortest: float | None
    """Length of the shortest way to where the goal counts as reached, m."""
    planned: float | None
    """The route's length, m."""
    assessing: float
    """Time on one core to assess the map for this planner, shared by all its tasks, s."""
    planning: float
    """Time on one core from there to the route, s. These two alone depend on the machine."""
    near: str | None
    """The crossing nearest to where it failed, or to where the refusal says no way leads on."""


def table(trials: Sequence[OpenRow]) -> str:
    """Return the trials as a Markdown table, a line per kind of map, localisation and planner."""
    lines = []
    for (group, noise, drift, name), own in by_cell(
        trials, ("terrain", "noise", "drift", "policy")
    ).items():
        able = [row for row in own if row["feasible"]]
        unable = [row for row in own if not row["feasible"]]
        driven = [row for row in own if row["promise"] is not None]
        refused = [row for row in own if row["outcome"] == "no_route"]
        lines.append(
            [
                group,
                f"{100 * noise:g} + {100 * drift:g}",
                name,
                Share.reached(able),
                *failures(able),
                _spl(able),
                _share(row["outcome"] == "no_route" for row in unable),
                _share(not row["feasible"] for row in refused),
                _brier(driven),
                mean_if_reached(able, "switches"),
                f"{median(row['assessing'] for row in own):.1f}",
                f"{median(row['planning'] for row in own):.2f}",
            ]
        )
    return markdown(COLUMNS.split(", "), lines)


def _share(answers: Iterable[bool]) -> str:
    """Write a share; a dash if there is nothing to count."""
    share = Share.of(answers)
    return str(share) if share.trials else "-"


def _spl(rows: Sequence[OpenRow]) -> str:
    """Write the SPL of feasible tasks."""
    reached = np.array([row["outcome"] == "reached" for row in rows])
    lengths, shortest = np.array([(row["length"], row["shortest"]) for row in rows]).T
    return f"{spl(reached, lengths, shortest):.3f}"


def _brier(rows: Sequence[OpenRow]) -> str:
    """Write the Brier score of promises; a dash if no route was found."""
    if not rows:
        return "-"
    promised = np.array([row["promise"] for row in rows])
    return f"{brier(promised, np.array([row['outcome'] == 'reached' for row in rows])):.3f}"


def failed_where(trials: Sequence[OpenRow]) -> str:
    """Say near which crossings our planner's feasible tasks failed, and how, without errors."""
    first = min((row["noise"], row["drift"]) for row in trials)
    count = Counter(
        (row["near"], row["outcome"])
        for row in trials
        if row["policy"] == OURS and row["feasible"] and (row["noise"], row["drift"]) == first
    )
    words = [f"{kind} {how} {n}" for (kind, how), n in count.most_common() if kind]
    return ", ".join(words) or "none"
