"""`fgtutor demo`: plan a route over a mixed terrain with the shipped specialists, and drive it.

Reads the shipped zoo and a terrain; writes plan.png, route.json, a film of the drive and a film
strip into a folder, and says what each shows. Source: paper, Sec. III, start to end.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from fgtutor.elevation import ElevationMap
from fgtutor.errors import RenderingError
from fgtutor.execution import FollowConfig, execute
from fgtutor.figures.maps import plan_figure
from fgtutor.figures.style import save_figure
from fgtutor.figures.videos import film_strip, save_video
from fgtutor.io.progress import waiting
from fgtutor.io.storage import atomic_write, make_folder, write_json
from fgtutor.io.validation import Seed, check_fields
from fgtutor.planning import plan_on_map
from fgtutor.settings import PlanOptions
from fgtutor.specialist import load_zoo
from fgtutor.world.terrain import Terrain, make_terrain

ROBOT = "a1"
"""The robot that the demo shows unless told otherwise."""
MAP = Path(__file__).parents[1] / "zoo" / "maps" / "toy_mixed.npz"
"""The toy's: four ways round a ridge; benchmarks/make_demo_map.py composes it."""
START, GOAL = (1.0, 4.0), (11.0, 4.0)
"""On either side of the ridge, m."""
COURSE = 1
"""The A1's: the seed of a mixed terrain, all four obstacles in a row from wall to wall."""


@dataclass(frozen=True, kw_only=True)
class DemoConfig(PlanOptions):
    """Plan over a mixed terrain with the shipped specialists, drive the route, and draw both."""

    robot: Literal["a1", "toy"] = ROBOT
    """The A1 in MuJoCo, or the toy, which needs no graphics library."""
    out: Path = Path("demo")
    """Folder that the pictures are written to."""
    seed: Seed = 0
    """Seed of the robot's start position and yaw."""
    zoo: Path | None = None
    """Folder of specialist folders; default: the shipped ones."""
    video: Literal["mp4", "gif"] = "mp4"
    """Format of the film."""

    def __post_init__(self) -> None:
        check_fields(self)


def run(config: DemoConfig) -> int:
    """Run the demo; return 0 if the robot reached its goal, else 1 (the pictures show why)."""
    began = time.monotonic()
    torch.set_num_threads(1)  # small networks: on a busy machine more threads mostly wait
    make_folder(config.out)

    def announce(file: str, what: str) -> None:
        print(f"{time.monotonic() - began:5.1f} s  {config.out / file}: {what}", flush=True)

    zoo = load_zoo(config.robot, config.zoo)
    terrain = a1_terrain() if config.robot == "a1" else toy_terrain()
    elevation = terrain.elevation
    print(f"{elevation}\nspecialists: {', '.join(zoo)}", flush=True)

    with torch.inference_mode():
        plan = plan_on_map(
            elevation, zoo, terrain.start, terrain.goal, settings=config.planning, progress=True
        )
    write_json(config.out / "route.json", plan.route.to_json())
    announce("route.json", str(plan.route))
    save_figure(plan_figure(elevation, plan), config.out / "plan.png")
    announce("plan.png", "the map and route, w_ood, F_max and the policy map")

    with waiting("driving the route"):
        follow = FollowConfig(hold_steps=config.planning.hold_steps)
        episode = execute(plan.route, terrain, zoo, seed=config.seed, config=follow)
    try:
        with waiting("drawing the film"):
            film = save_video(episode, terrain, plan.route, config.out / f"drive.{config.video}")
        announce(film.name, str(episode))
        with atomic_write(config.out / "drive.png") as path:
            film_strip(episode, terrain, plan.route).save(path)
        announce("drive.png", "the same as a film strip")
    except RenderingError as error:
        print(f"{episode}\nno film of it: {error}")
    return int(not episode.success)


def toy_terrain() -> Terrain:
    """Return the toy's terrain: a map from a file, as a robot that has scanned it would have."""
    return Terrain.from_elevation(ElevationMap.load(MAP), START, GOAL)


def a1_terrain() -> Terrain:
    """Return the A1's terrain."""
    return make_terrain("mixed", robot="a1", seed=COURSE)
