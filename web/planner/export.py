"""Write what the planner's page needs: the toy's specialists, maps, and two WebAssembly files.

Gives, in a folder: `specialists/NAME/` (see `exports`), `maps.json` (heights and
where to start and go), `page.json` (names and colours of the policies), `munk.wasm` and
`nets.wasm` (see `build`). Nothing of it is computed ahead: the page assesses maps and plans itself.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from exports import as_json, copy_specialist
from planner.build import build_wasm

from fgtutor.elevation import ElevationMap
from fgtutor.figures.style import policy_colours
from fgtutor.specialist import GENERAL, ZOO, load_zoo

SIDE = 64
"""Cells along each side of the maps made here; they are 0.1 m wide."""
Point = tuple[float, float]


def export(folder: Path) -> None:
    """Write everything into `folder`."""
    names = list(load_zoo("toy", include_general=True))
    for name in names:
        copy_specialist(ZOO / "toy" / name, folder / "specialists" / name)
    colours = policy_colours(names)
    policies = [
        {"name": name, "colour": colours[name], "specialist": name != GENERAL} for name in names
    ]
    (folder / "page.json").write_bytes(as_json({"policies": policies}))
    (folder / "maps.json").write_bytes(as_json([plain_map(*one) for one in maps()]))
    build_wasm(folder)


def maps() -> Iterator[tuple[str, ElevationMap, Point, Point]]:
    """Give the maps to choose from: what each is called, its heights, a start and a goal, m."""
    yield "A step, then a gap", ElevationMap(_corner()), (0.75, 1.25), (5.25, 5.65)
    yield "Three lanes: steps, gaps, rubble", ElevationMap(_lanes()), (0.75, 3.25), (5.65, 3.25)
    yield "A wall with a ramp, and a detour", ElevationMap(_ramp()), (0.75, 3.25), (5.65, 3.25)
    flat = np.zeros((SIDE, SIDE))
    yield "Flat ground, to paint on", ElevationMap(flat), (0.75, 3.25), (5.65, 3.25)
    mixed = ElevationMap.load(ZOO / "maps" / "toy_mixed.npz")
    yield "The course's map of mixed terrain (12 m x 8 m)", mixed, (1.0, 4.0), (11.0, 4.0)


def _corner() -> np.ndarray:
    """Lay a step with a wall beside it, then a gap across the way on."""
    heights = np.zeros((SIDE, SIDE))
    heights[18:28, :34] = 0.12
    heights[18:28, 34:] = 0.6
    heights[28:, 38:41] = -1.0
    return heights


def _lanes() -> np.ndarray:
    """Lay steps, gaps and rubble side by side, with walls between them."""
    heights = np.zeros((SIDE, SIDE))
    heights[18:46, 44:] = 0.12
    heights[26:38, 44:] = 0.24
    heights[22:25, 20:42] = heights[37:40, 20:42] = -1.0
    rubble = np.random.default_rng(4).random((13, 9)) < 0.45
    blocks = rubble * np.random.default_rng(5).uniform(0.03, 0.09, rubble.shape)
    heights[18:44, :18] = np.kron(blocks, np.ones((2, 2)))
    heights[14:50, 18:20] = heights[14:50, 42:44] = 0.6
    return heights


def _ramp() -> np.ndarray:
    """Lay a plateau 0.45 m high over most of the width, with slopes in the middle."""
    heights = np.zeros((SIDE, SIDE))
    heights[26:38, 10:] = 0.45
    slope = np.linspace(0.0, 0.45, 11)[1:-1]
    heights[17:26, 24:40], heights[38:47, 24:40] = slope[:, None], slope[::-1, None]
    return heights


def plain_map(label: str, elevation: ElevationMap, start: Point, goal: Point) -> dict[str, Any]:
    """Return a map as plain numbers: unknown heights are filled, `known` says which were not."""
    nx, ny = elevation.shape
    return {
        "label": label,
        "nx": nx,
        "ny": ny,
        "resolution": elevation.resolution,
        "origin": list(elevation.origin),
        "heights": np.round(elevation.filled().heights, 4).ravel().tolist(),
        "known": elevation.known.astype(int).ravel().tolist(),
        "start": list(start),
        "goal": list(goal),
    }
