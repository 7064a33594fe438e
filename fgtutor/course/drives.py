"""What the notebooks drive: functions as policies, a route straight ahead, many walks at once.

Reads terrains, environments and zoos; gives routes, episodes and observations over time. Each
function keeps one cell of a notebook short.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from fgtutor import directions
from fgtutor.errors import ConfigError
from fgtutor.execution import Episode, FollowConfig, execute_batch
from fgtutor.io.rsl import TensorDict
from fgtutor.io.validation import Positive, check_arguments
from fgtutor.planning import plan
from fgtutor.robots.base import LocomotionEnv
from fgtutor.routes import Route
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import Terrain


@dataclass(frozen=True)
class Scripted:
    """A driver that is a plain function: it can stand where `execute` wants a specialist."""

    act: Callable[[TensorDict], Float[Tensor, "robots actions"]]
    """Observations to actions."""
    robot: str = "toy"
    """What it drives."""
    command: tuple[float, float, float] = (0.85, 0.0, 0.0)
    """Commanded velocity (vx, vy, wz); m/s, m/s, rad/s."""
    history: int = 0
    """Frames of the past that it asks for."""


def straight_route(terrain: Terrain, name: str) -> Route:
    """Return the route from start to goal along x, driven by one policy.

    Raises `PlanningError` if the goal does not lie straight ahead.
    """
    grid, start, goal = terrain.elevation, terrain.start, terrain.goal
    ahead = np.zeros((*grid.shape, directions.NUM_HEADINGS))
    ahead[..., 0] = 1.0
    return plan(ahead, 0 * ahead, grid=grid, start=start, goal=goal, names=(name,)).raise_for()


def collect(
    env: LocomotionEnv,
    act: Callable[[TensorDict], Tensor],
    seconds: Positive,
    *,
    progress: bool = True,
) -> dict[str, Float[Tensor, "time envs _"]]:
    """Let the robots of `env` act for a while; return every observation group over time.

    `progress` shows a bar.
    """
    check_arguments(collect, locals(), ConfigError)
    steps = round(seconds / env.control_dt)
    observations = [env.get_observations()]
    for _ in tqdm(range(steps - 1), unit="step", disable=not progress):
        observations.append(env.step(act(observations[-1]))[0])
    groups = list(observations[0].keys())  # a TensorDict iterates over its batch, not its names
    return {name: torch.stack([step[name] for step in observations]) for name in groups}


def drive_together(
    jobs: Sequence[tuple[Route, Terrain, int]],
    zoo: Mapping[str, Specialist],
    *,
    config: FollowConfig | None = None,
) -> list[Episode]:
    """Drive (route, terrain, seed) side by side, whatever policies each route was planned with.

    A batch costs hardly more than one walk. Each episode counts policies as its own route does.
    Terrains must have one size. Raises `ConfigError` if a route names a policy that the zoo lacks.
    """
    routes, terrains, seeds = zip(*jobs, strict=True) if jobs else ((), (), ())
    return execute_batch(routes, terrains, zoo, seeds=seeds, config=config)
