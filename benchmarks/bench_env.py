"""The robots' environments against their bare physics: what a control step costs beside MuJoCo.

Shipped specialists walk their own training world. The time inside the physics is measured apart, so
both stand on the same states; the ratio is a whole step over the physics in it, 1 at best.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from harness import Row, Size, row

from fgtutor.learning.config import CONFIGS, make_training_env
from fgtutor.specialist import load_zoo


class Stopwatch:
    """A function that keeps count of the CPU seconds spent in it."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments: object, **options: object) -> object:
        """Call the function."""
        began = time.process_time()
        answer = self.function(*arguments, **options)
        self.seconds += time.process_time() - began
        return answer


def shares(robot: str, terrain: str, num_envs: int, steps: int, rounds: int) -> list[float]:
    """Return, for each round of control steps, the time of whole steps over that of physics."""
    config: Any = CONFIGS[robot](terrain=terrain, num_envs=num_envs, rows=2, columns=2)
    env: Any = make_training_env(config)
    policy = load_zoo(robot)[terrain].policy
    env.reset_all()
    physics = env.physics if robot == "a1" else env.space
    physics.step = inside = Stopwatch(physics.step)
    observation, found = env.get_observations(), []
    with torch.inference_mode():
        for number in range(rounds + 1):
            inside.seconds = whole = 0.0
            for _ in range(steps):
                actions = policy(observation)
                began = time.process_time()
                observation, *_ = env.step(actions)
                whole += time.process_time() - began
            if number:  # by then the robots walk
                found.append(whole / inside.seconds)
    return found


def rows(size: Size) -> Iterator[Row]:
    """Let both robots walk."""
    toys, robots, steps, rounds = {
        "full": (256, 640, 20, 3), "quick": (64, 256, 10, 3), "tiny": (2, 2, 2, 1)
    }[size]  # fmt: skip
    terrains = ("steps",) if size == "tiny" else ("steps", "gaps")
    for robot, count in (("toy", toys), ("a1", robots)):
        for terrain in terrains:
            found = shares(robot, terrain, count, steps, rounds)
            what = f"a control step / its bare physics, {robot} on {terrain}, {count} robots"
            yield row("environment", what, found)
