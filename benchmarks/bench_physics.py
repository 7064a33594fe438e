"""Measure bare A1 physics: simulation steps per second at 1024 simulations, by terrain and threads.

Run `python benchmarks/bench_physics.py`. Robots stand at random places of a small world and follow
shaky joint targets. The load of other programs shows in the wall clock, hence steps per CPU second
too, which hardly feel it.
"""

import json
import os
import time

import torch

from fgtutor.robots.a1 import model as a1_model
from fgtutor.robots.a1.physics import Physics
from fgtutor.world.terrain import World, make_terrain

SUBSTEPS = 4


def measure(physics: Physics, size: tuple[float, float], control_steps: int) -> dict[str, float]:
    """Return steps per wall second and per CPU second."""
    random = torch.Generator().manual_seed(0)
    n = physics.num_sims
    physics.reset()
    physics.qpos[:, :2] = torch.rand(n, 2, generator=random) * (torch.tensor(size) - 2.0) + 1.0
    physics.qpos[:, 2] += 0.3
    physics.forward()
    stance = torch.tensor(a1_model.STANCE)
    wall = cpu = 0.0
    for step in range(control_steps + 10):
        physics.ctrl[:] = stance + 0.4 * torch.rand(n, 12, generator=random) - 0.2
        if step == 10:  # by then the robots have landed
            wall, cpu = time.perf_counter(), time.process_time()
        physics.step(SUBSTEPS)
    steps = n * SUBSTEPS * control_steps
    return {
        "steps_per_second": round(steps / (time.perf_counter() - wall)),
        "steps_per_cpu_second": round(steps / (time.process_time() - cpu)),
    }


def main(num_sims: int = 1024, control_steps: int = 10) -> None:
    torch.set_num_threads(1)
    cores = os.cpu_count() or 1
    rows = []
    for name in ("plane", "steps", "gaps", "bridge", "valley"):
        tile = make_terrain("flat" if name == "plane" else name, robot="a1", difficulty=0.7, seed=0)
        world = World([[tile, tile], [tile, tile]])
        specs = {"boxes": a1_model.build_spec(() if name == "plane" else world.boxes)}
        if name != "plane":
            specs["height field"] = a1_model.build_spec(heightfield=world.elevation)
        for kind, spec in specs.items():
            physics = Physics(spec.compile(), num_sims, threads=cores)
            row = {"terrain": name, "as": kind, "geoms": physics.model.ngeom, "threads": cores}
            rows.append(row | measure(physics, world.elevation.size, control_steps))
            print(json.dumps(rows[-1]), flush=True)


if __name__ == "__main__":
    main()
