"""`fgtutor demo`: plan a route over a mixed terrain with the shipped specialists, and drive it.

Reads the shipped zoo and a terrain; does with it what `fgtutor walk` does with a map file.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fgtutor.cli.walk import Video, plan_and_drive
from fgtutor.elevation import ElevationMap
from fgtutor.io.validation import Seed, check_fields
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
    video: Video = "mp4"
    """Format of the film."""

    def __post_init__(self) -> None:
        check_fields(self)


def run(config: DemoConfig) -> int:
    """Run the demo; return 0 if the robot reached its goal, else 1 (the pictures show why)."""
    return plan_and_drive(
        a1_terrain() if config.robot == "a1" else toy_terrain(),
        load_zoo(config.robot, config.zoo),
        config.planning,
        out=config.out,
        seed=config.seed,
        video=config.video,
    )


def toy_terrain() -> Terrain:
    """Return the toy's terrain: a map from a file, as a robot that has scanned it would have."""
    return Terrain.from_elevation(ElevationMap.load(MAP), START, GOAL)


def a1_terrain() -> Terrain:
    """Return the A1's terrain."""
    return make_terrain("mixed", robot="a1", seed=COURSE)
