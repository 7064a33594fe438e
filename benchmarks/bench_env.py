"""Measure the A1's environment against its bare physics: how much of a control step is MuJoCo?

Run `python benchmarks/bench_env.py`. The shipped specialist walks its own training world. In every
control step the time inside `mujoco.batch` is measured apart, so both stand on the same states: its
share is the environment's control steps per second over those of the bare physics. CPU seconds,
which hardly feel the load of other programs.
"""

import json
import os
import time

import torch

from fgtutor.learning.config import A1TrainConfig, make_training_env
from fgtutor.robots.a1.env import A1Env
from fgtutor.specialist import ZOO, load_specialist


def measure(terrain: str, num_envs: int, control_steps: int) -> dict[str, str | float]:
    """Return what one specialist's environment and its physics alone manage."""
    config = A1TrainConfig(terrain=terrain, num_envs=num_envs, rows=4, columns=4)
    env = make_training_env(config)
    assert isinstance(env, A1Env)
    policy = load_specialist(ZOO / "a1" / terrain).policy
    env.reset_all()
    bare, inside = env.physics.step, 0.0

    def timed(n: int = 1) -> None:
        nonlocal inside
        began = time.process_time()
        bare(n)
        inside += time.process_time() - began

    env.physics.step = timed
    observation, whole = env.get_observations(), 0.0
    with torch.inference_mode():
        for step in range(control_steps + 10):
            if step == 10:  # by then the robots walk
                inside = whole = 0.0
            actions = policy(observation)
            began = time.process_time()
            observation, *_ = env.step(actions)
            whole += time.process_time() - began
    steps = num_envs * control_steps
    return {
        "terrain": terrain,
        "environment_steps_per_cpu_second": round(steps / whole),
        "bare_steps_per_cpu_second": round(steps / inside),
        "share": round(inside / whole, 3),
    }


def main(num_envs: int = 640, control_steps: int = 50) -> None:
    torch.set_num_threads(1)
    for terrain in ("steps", "gaps", "bridge", "valley"):
        print(json.dumps(measure(terrain, num_envs, control_steps)), flush=True)


if __name__ == "__main__":
    print(json.dumps({"cores": os.cpu_count()}))
    main()
