"""Table II: success of every policy, of ours and of the generalist on every terrain.

Reads a robot, a number of trials and a seed; gives rows with confidence intervals and the reason of
every failure. Trial k of a terrain is the same ground for all policies.
Source: paper, Sec. IV-B (Table II): a trial fails if no route is found or the goal is not reached.
"""

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from fgtutor.errors import ConfigError, PlanningError
from fgtutor.evaluation.metrics import wilson_interval
from fgtutor.execution import execute_batch
from fgtutor.pipeline import plan_on_map
from fgtutor.planning import Route
from fgtutor.specialist import Specialist, load_zoo
from fgtutor.storage import check_writable, write_json
from fgtutor.tensorization import tensorize
from fgtutor.terrain import SCALES, make_terrain

OURS, GENERAL = "ours", "general"
BATCH = 50
"""Trials simulated side by side by one worker."""


@dataclass(frozen=True, kw_only=True)
class MatrixConfig:
    """Evaluate policies x terrains, the paper's Table II."""

    robot: str = "toy"
    """Which robot."""
    trials: int = 50
    """Trials per pair of policy and terrain."""
    seed: int = 0
    """What the terrains and the starts are drawn from."""
    terrains: tuple[str, ...] = ()
    """Only these terrains; default: the robot's own and mixed."""
    policies: tuple[str, ...] = ()
    """Only these policies; default: each specialist, ours, general."""
    difficulty: float = 1.0
    """Difficulty of all terrains."""
    taus: Literal["paper", "calibrated"] = "calibrated"
    """Thresholds of w_ood."""
    f_min: float = 0.1
    """Edges less feasible than this do not exist."""
    switch_cost: float = 0.0
    """Extra cost of changing the policy; 0 is the paper's."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped zoo."""
    workers: int = 0
    """Processes; 0 takes one per core."""
    json: Path | None = None
    """Write the rows here."""

    def __post_init__(self) -> None:
        if self.trials < 1 or self.workers < 0:
            raise ConfigError(
                f"need trials >= 1 and workers >= 0, got {self.trials} and {self.workers}"
            )


@dataclass(frozen=True, kw_only=True)
class Trial:
    """The outcome of one trial."""

    terrain: str
    policy: str
    seed: int
    outcome: str
    """reached | no_route | fell | timeout"""
    length: float = 0.0
    """Distance driven, m."""
    switches: int = 0
    """Policy changes on the way."""


def terrain_seed(seed: int, trial: int) -> int:
    """Return the terrain seed of a trial: odd, since training draws even ones."""
    return 2 * (seed * 1_000_000 + trial) + 1


def evaluate_batch(config: MatrixConfig, terrain: str, trials: Sequence[int]) -> list[Trial]:
    """Plan and drive some trials on one terrain with every policy asked for."""
    torch.set_num_threads(1)
    zoo = _load(config)
    specialists = {name: s for name, s in zoo.items() if name != GENERAL}
    grounds = [
        make_terrain(
            terrain,
            robot=config.robot,
            difficulty=config.difficulty,
            seed=terrain_seed(config.seed, trial),
        )
        for trial in trials
    ]
    with torch.inference_mode():
        tensors = [
            {name: tensorize(g.elevation, s, taus=config.taus) for name, s in zoo.items()}
            for g in grounds
        ]
    outcomes: list[Trial] = []
    for policy in policies(config, zoo):
        team = specialists if policy == OURS else {policy: zoo[policy]}
        routes: dict[int, Route] = {}
        for i, ground in enumerate(grounds):
            try:
                routes[i] = plan_on_map(
                    ground.elevation,
                    team,
                    ground.start,
                    ground.goal,
                    taus=config.taus,
                    f_min=config.f_min,
                    switch_cost=config.switch_cost,
                    tensors=tensors[i],
                ).route
            except PlanningError:
                outcomes.append(
                    Trial(terrain=terrain, policy=policy, seed=trials[i], outcome="no_route")
                )
        episodes = execute_batch(
            list(routes.values()),
            [grounds[i] for i in routes],
            team,
            seeds=[terrain_seed(config.seed, trials[i]) for i in routes],
        )
        outcomes += [
            Trial(
                terrain=terrain,
                policy=policy,
                seed=trials[i],
                outcome=episode.reason,
                length=round(episode.length, 3),
                switches=episode.switches,
            )
            for i, episode in zip(routes, episodes, strict=True)
        ]
    return outcomes


def evaluate(config: MatrixConfig, *, progress: bool = False) -> list[dict[str, Any]]:
    """Return the rows of the matrix; the same for any number of workers."""
    zoo = _load(config)
    names = config.terrains or (*SCALES[config.robot].mixed, "mixed")
    for name in names:  # an unknown name fails here, not in a worker an hour later
        make_terrain(name, robot=config.robot)
    policies(config, zoo)
    jobs = [
        (config, terrain, range(first, min(first + BATCH, config.trials)))
        for terrain in names
        for first in range(0, config.trials, BATCH)
    ]
    workers = min(config.workers or os.cpu_count() or 1, len(jobs))
    results: list[Trial] = []
    with tqdm(total=len(jobs), unit="batch", disable=not progress) as bar:
        if workers == 1:
            for job in jobs:
                results += evaluate_batch(*job)
                bar.update()
        else:
            # Spawned, not forked: torch's threads do not survive a fork.
            with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
                for outcome in pool.map(_evaluate_job, jobs):
                    results += outcome
                    bar.update()
    return [
        summarise([r for r in results if (r.terrain, r.policy) == (terrain, policy)])
        for terrain in names
        for policy in policies(config, zoo)
    ]


def summarise(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return one row of the matrix."""
    count = Counter(trial.outcome for trial in trials)
    low, high = wilson_interval(count["reached"], len(trials))
    return {
        "terrain": trials[0].terrain,
        "policy": trials[0].policy,
        "trials": len(trials),
        "successes": count["reached"],
        "ci95": [round(low, 4), round(high, 4)],
        "failures": {reason: count[reason] for reason in ("no_route", "fell", "timeout")},
    }


def policies(config: MatrixConfig, zoo: dict[str, Specialist]) -> tuple[str, ...]:
    """Return the policies to evaluate, in the table's order; raises `ConfigError` for others."""
    everyone = (*(name for name in zoo if name != GENERAL), OURS, *([GENERAL] * (GENERAL in zoo)))
    unknown = [name for name in config.policies if name not in everyone]
    if unknown:
        raise ConfigError(f"no policy named {', '.join(unknown)}; choose of {', '.join(everyone)}")
    return tuple(name for name in everyone if not config.policies or name in config.policies)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table of success rates in percent."""
    names = list(dict.fromkeys(row["policy"] for row in rows))
    lines = ["| terrain | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for terrain in dict.fromkeys(row["terrain"] for row in rows):
        cells = {row["policy"]: row for row in rows if row["terrain"] == terrain}
        shares = [f"{100 * cells[n]['successes'] / cells[n]['trials']:.1f}" for n in names]
        lines.append(f"| {terrain} | " + " | ".join(shares) + " |")
    return "\n".join(lines)


def run(config: MatrixConfig) -> int:
    """Evaluate from the command line, print the table and write the rows."""
    if config.json:
        check_writable(config.json)
    rows = evaluate(config, progress=True)
    print(table(rows))
    print(
        f"success in %, {config.trials} trials a cell, tau {config.taus}, seed {config.seed}, "
        f"switch cost {config.switch_cost:g}"
    )
    if config.json:
        write_json(config.json, rows)
        print(f"rows -> {config.json}")
    return 0


def _load(config: MatrixConfig) -> dict[str, Specialist]:
    return load_zoo(config.robot, config.zoo, include_general=True)


def _evaluate_job(job: tuple[MatrixConfig, str, range]) -> list[Trial]:
    return evaluate_batch(*job)
