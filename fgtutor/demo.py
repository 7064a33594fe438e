"""The whole idea in a minute: plan over a mixed terrain with the toy's specialists, and drive it.

Reads the shipped demo map and zoo; writes plan.png, route.json, drive.mp4 and drive.png (a film
strip) into a folder, and says what each shows. Source: paper, Sec. III, start to end.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from fgtutor.elevation import ElevationMap
from fgtutor.execution import execute
from fgtutor.pipeline import plan_on_map
from fgtutor.specialist import load_zoo
from fgtutor.storage import atomic_write, make_folder, write_json
from fgtutor.teach.figures import plan_figure, save_figure
from fgtutor.teach.videos import film_strip, save_video
from fgtutor.tensorization import assess, resolve_taus, steps_on_known
from fgtutor.terrain import Terrain

MAP = Path(__file__).parent / "zoo" / "maps" / "toy_mixed.npz"
"""Four ways round a ridge; benchmarks/make_demo_map.py composes it."""
START, GOAL = (1.0, 4.0), (11.0, 4.0)
"""On either side of the ridge, m."""


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Plan over the demo map with the toy's specialists, drive the route, and draw both."""

    out: Path = Path("demo")
    """Folder that the pictures are written to."""
    seed: int = 0
    """Seed of the robot's start position and yaw."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped ones."""
    taus: Literal["paper", "calibrated"] = "calibrated"
    """Thresholds of w_ood: the paper's, or each specialist's own."""
    switch_cost: float = 3.0
    """Extra cost of changing the policy; at the paper's 0 equals take turns from cell to cell."""
    video: Literal["mp4", "gif"] = "mp4"
    """Format of the film."""


def run(config: DemoConfig) -> int:
    """Run the demo; return 0 if the robot reached its goal, else 1 (the pictures show why)."""
    began = time.monotonic()
    torch.set_num_threads(1)  # small networks: on a busy machine more threads mostly wait
    make_folder(config.out)

    def announce(file: str, what: str) -> None:
        print(f"{time.monotonic() - began:5.1f} s  {config.out / file}: {what}", flush=True)

    elevation = ElevationMap.load(MAP)
    zoo = load_zoo("toy", config.zoo)
    print(f"{elevation}\nspecialists: {', '.join(zoo)}", flush=True)

    closed = ~torch.from_numpy(steps_on_known(elevation.known))
    weights, tensors = {}, {}
    for name, specialist in zoo.items():
        assessment = assess(elevation, specialist)
        taus = resolve_taus(config.taus, specialist)
        weights[name], tensors[name] = assessment.ood(*taus), assessment.weighted(*taus)
        tensors[name][closed] = 0
    plan = plan_on_map(elevation, zoo, START, GOAL, tensors=tensors, switch_cost=config.switch_cost)
    write_json(config.out / "route.json", plan.route.to_json())
    announce("route.json", str(plan.route))
    save_figure(plan_figure(elevation, plan, weights), config.out / "plan.png")
    announce("plan.png", "the map and route, w_ood, F_max and the policy map")

    terrain = Terrain.from_elevation(elevation, START, GOAL)
    episode = execute(plan.route, terrain, zoo, seed=config.seed)
    film = save_video(episode, terrain, plan.route, config.out / f"drive.{config.video}")
    announce(film.name, str(episode))
    with atomic_write(config.out / "drive.png") as path:
        film_strip(episode, terrain, plan.route).save(path)
    announce("drive.png", "the same as a film strip")
    return int(not episode.success)
