"""Table II: success of every policy, of ours and of the generalist on every terrain.

Reads a robot, a number of trials and a seed; gives rows with confidence intervals and the reason of
every failure. `--walk` makes policies walk where Table II has
them refuse. Source: paper, Sec. IV-B (Table II); `--protocol paper` is its 40 tasks per terrain
with 250 trials each, 300,000 trials with four specialists.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import numpy as np

from fgtutor.baselines import OURS, ours, straight
from fgtutor.evaluation import success
from fgtutor.evaluation.report import markdown
from fgtutor.evaluation.success import TrialsConfig, make_ground
from fgtutor.evaluation.trials import (
    Planned,
    TrialRow,
    by_cell,
    choose,
    drive,
    drive_plans,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.io.validation import Unique
from fgtutor.robots import ROBOTS
from fgtutor.specialist import GENERAL
from fgtutor.statistics import Share

COMMAND = "evaluate matrix"
WALKS = {
    "planned": "Each policy walks its own plan, or refuses.",
    "straight": "No policy is asked: each policy walks straight from start to goal, unplanned.",
    "ours": "No policy is asked: each policy walks our route, every step of it.",
}
"""Ways to walk, as a caption says them."""


@dataclass(frozen=True, kw_only=True)
class MatrixConfig(TrialsConfig):
    """Evaluate policies x terrains, the paper's Table II."""

    terrains: Annotated[tuple[str, ...], Unique] = ()
    """Only these terrains; default: the robot's own and mixed."""
    policies: Annotated[tuple[str, ...], Unique] = ()
    """Only these policies; default: each specialist, ours, general."""
    walk: Literal["planned", "straight", "ours"] = "planned"
    """Which way a policy goes: its own plan, which it may refuse; or, without being asked, straight
    from start to goal, or along our route with every step forced on it."""


def policies(config: MatrixConfig, zoo: Iterable[str]) -> tuple[str, ...]:
    """Return the policies to evaluate, in the table's order; raises `ConfigError` for others.

    `ours` has a plan or none: it cannot be made to walk.
    """
    known = [name for name in zoo if name != GENERAL]
    if config.walk == "planned":
        known.append(OURS)
    return choose("policy", config.policies, [*known, GENERAL] if GENERAL in zoo else known)


def walk_task(
    config: MatrixConfig, terrain: str, names: Sequence[str], indices: Sequence[int]
) -> list[TrialRow]:
    """Do one task in which no policy may refuse; arguments as of `success.run_task`."""
    zoo, grounds = config.load_zoo(), [make_ground(config, terrain, index) for index in indices]
    how = {"settings": config.planning, "condition": config.condition}
    if config.walk == "straight":
        unasked = {name: partial(straight, name) for name in names}
        return [trial.row for trial in drive(grounds, unasked, zoo, **how)]
    maps = [ground.assess(zoo, config.planning) for ground in grounds]
    plans = plan_all(ours, grounds, maps, config.planning)
    follow = FollowConfig(hold_steps=config.planning.hold_steps)
    return [
        trial.row
        for name in names
        for trial in drive_plans(
            name, [forced(plan, name) for plan in plans], zoo, follow, config.condition
        )
    ]


def forced(planned: Planned, name: str) -> Planned:
    """Return a plan with every step of its route by one policy; a refusal stays one."""
    route = planned.answer
    if not route:
        return planned
    alone = {"names": (name,), "policies": np.zeros_like(route.policies)}
    return replace(planned, answer=replace(route, **alone, choices=None, ood=None))


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
        title=f"Success of policies on terrains ({config.robot}{', disturbed' * config.disturbed})",
        terrains=config.terrains or (*ROBOTS[config.robot].scale.mixed, "mixed"),
        policies=columns,
        table=table,
        work=success.run_task if config.walk == "planned" else walk_task,
        remark=lambda _: WALKS[config.walk],
    )
