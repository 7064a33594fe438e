"""Compose the toy's demo map, fgtutor/zoo/maps/toy_mixed.npz: four routes round a ridge.

Reads nothing; gives a 12 x 8 m map at 0.1 m on which start (1, 4) and goal (11, 4) are joined by a
short route over rubble and slopes, a route over gaps, one over steps, and a long detour on the
flat. One block was never observed. Run it again after a change to the obstacles:
`python benchmarks/make_demo_map.py`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import fgtutor
from fgtutor.elevation import ElevationMap
from fgtutor.robots import ROBOTS
from fgtutor.world.terrain import make_terrain

RESOLUTION = 0.1
WALL = 0.45  # m; more than twice the highest riser, less than what counts as a hole below it
TARGET = Path(fgtutor.__file__).parent / "zoo" / "maps" / "toy_mixed.npz"


def obstacle(name: str, length: float, *, difficulty: float, seed: int) -> np.ndarray:
    """Return the heights of one obstacle, `length` metres long, over a terrain's full width."""
    scale = ROBOTS["toy"].scale
    scale = replace(scale, resolution=RESOLUTION, length=length + 2 * scale.apron)
    terrain = make_terrain(name, difficulty=difficulty, seed=seed, scale=scale)
    section = terrain.sections[0]
    return terrain.elevation.crop(section.x0, section.y0, section.x1, section.y1).heights


def compose() -> ElevationMap:
    """Return the map: lanes along x between x = 2 and x = 10, flat ground at both ends."""
    heights = np.zeros((120, 80), dtype=np.float32)

    def cells(x0: float, x1: float, y0: float, y1: float) -> tuple[slice, slice]:
        near, far, right, left = (round(metres / RESOLUTION) for metres in (x0, x1, y0, y1))
        return slice(near, far), slice(right, left)

    def lay(name: str, x0: float, x1: float, y0: float, y1: float, difficulty: float, seed: int):
        window = cells(x0, x1, y0, y1)
        whole = obstacle(name, x1 - x0, difficulty=difficulty, seed=seed)
        heights[window] = whole[:, : heights[window].shape[1]]

    heights[cells(2.0, 10.0, 2.2, 2.4)] = WALL  # between the detour and the rubble
    heights[cells(2.0, 10.0, 4.2, 4.8)] = WALL  # the ridge between start and goal
    heights[cells(4.2, 4.4, 0.0, 1.2)] = WALL  # two baffles make the detour long
    heights[cells(7.2, 7.4, 1.0, 2.2)] = WALL
    lay("rubble", 2.6, 5.6, 2.4, 4.2, difficulty=1.0, seed=3)
    lay("slopes", 6.4, 9.4, 2.4, 4.2, difficulty=0.8, seed=2)
    lay("gaps", 2.6, 9.0, 4.8, 6.4, difficulty=0.8, seed=1)
    lay("steps", 2.8, 9.2, 6.4, 8.0, difficulty=0.8, seed=4)
    heights[cells(5.2, 6.2, 6.0, 6.8)] = np.nan  # never observed
    return ElevationMap(heights, resolution=RESOLUTION)


def main() -> int:
    elevation = compose()
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    elevation.save(TARGET)
    print(f"{TARGET.name}: {elevation}, {TARGET.stat().st_size / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
