"""`fgtutor walk`: plan a route over a map file and drive it in simulation.

Reads a map and a zoo; writes route.json, plan.png, episode.json, a film of the drive and a film
strip into a folder, and says what each shows. Where no route exists, plan.png shows the map without
one, and the command says why. Source: paper, Sec. III, start to end.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from fgtutor.cli.plan import MapOptions
from fgtutor.errors import RenderingError
from fgtutor.execution import Episode, FollowConfig, execute
from fgtutor.figures.maps import plan_figure
from fgtutor.figures.style import save_figure
from fgtutor.figures.videos import film_strip, save_video
from fgtutor.io.progress import waiting
from fgtutor.io.storage import atomic_write, make_folder, write_json
from fgtutor.io.validation import Seed
from fgtutor.planning import plan_on_map
from fgtutor.routes import Route
from fgtutor.settings import PlanSettings
from fgtutor.specialist import Specialist
from fgtutor.world.terrain import Terrain

Video = Literal["mp4", "gif"]


@dataclass(frozen=True, kw_only=True)
class WalkConfig(MapOptions):
    """Plan over an elevation map with the shipped specialists, drive the route, and draw both."""

    robot: str = "a1"
    """Whose specialists plan and drive: the A1 in MuJoCo, or the toy."""
    out: Path = Path("walk")
    """Folder that everything is written to."""
    seed: Seed = 0
    """Seed of the robot's start position and yaw."""
    video: Video = "mp4"
    """Format of the film."""


def run(config: WalkConfig) -> int:
    """Plan and drive; return 0 if the robot reached its goal, else 1 (the film shows why)."""
    elevation, zoo = config.load()
    terrain = Terrain.from_elevation(elevation, config.start, config.goal, robot=config.robot)
    return plan_and_drive(
        terrain, zoo, config.planning, out=config.out, seed=config.seed, video=config.video
    )


def plan_and_drive(
    terrain: Terrain,
    zoo: Mapping[str, Specialist],
    settings: PlanSettings,
    *,
    out: Path,
    seed: int = 0,
    video: Video = "mp4",
) -> int:
    """Plan over a terrain, drive the route, and write both into the folder `out`.

    Returns 0 if the goal was reached, else 1. Raises the `PlanningError` of a refusal, after the
    map was drawn.
    """
    began = time.monotonic()
    torch.set_num_threads(1)  # small networks: on a busy machine more threads mostly wait
    make_folder(out)

    def announce(file: str, what: str) -> None:
        print(f"{time.monotonic() - began:5.1f} s  {out / file}: {what}", flush=True)

    elevation = terrain.elevation
    print(f"{elevation}\nspecialists: {', '.join(zoo)}", flush=True)
    ends = terrain.start, terrain.goal
    with torch.inference_mode():
        plan = plan_on_map(elevation, zoo, *ends, settings=settings, progress=True)
    if isinstance(plan.answer, Route):
        write_json(out / "route.json", plan.answer.to_json())
        announce("route.json", str(plan.answer))
    if plan.tensors:
        save_figure(plan_figure(elevation, plan, f_min=settings.f_min), out / "plan.png")
        announce("plan.png", "the map and route, w_ood, F_max and the policy map")
    for reason in plan.why_not(elevation):
        print(reason)
    route = plan.route

    with waiting("driving the route"):
        follow = FollowConfig(hold_steps=settings.hold_steps)
        episode = execute(route, terrain, zoo, seed=seed, config=follow)
    write_json(out / "episode.json", _summary(episode, route))
    announce("episode.json", str(episode))
    try:
        with waiting("drawing the film"):
            film = save_video(episode, terrain, route, out / f"drive.{video}")
        announce(film.name, "the drive as a film")
        with atomic_write(out / "drive.png") as path:
            film_strip(episode, terrain, route).save(path)
        announce("drive.png", "the same as a film strip")
    except RenderingError as error:
        print(f"no film of it: {error}")
    return int(not episode.success)


def _summary(episode: Episode, route: Route) -> dict[str, object]:
    """Return what became of a drive, with the seconds that each policy was active."""
    seconds = episode.seconds / max(len(episode.policies), 1)
    return {
        "robot": episode.robot,
        "outcome": episode.reason,
        "length": round(episode.length, 3),
        "seconds": round(episode.seconds, 3),
        "switches": episode.switches,
        "end": [round(value, 3) for value in episode.poses[-1].tolist()],
        "seconds_per_policy": {
            name: round(seconds * int((episode.policies == i).sum()), 3)
            for i, name in enumerate(route.names)
        },
    }
