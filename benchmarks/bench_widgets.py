"""A drag of the tau sliders: everything from the slider's message to the picture's.

Weights, fusion, planning and colours, at 128 x 128 cells and 8 headings with four policies. The
drag is compared with assessing the map, which it need not do again; its milliseconds of CPU are
told too, for a person waits for them (50 are felt as at once).
"""

from collections.abc import Iterator

import numpy as np
import torch
from harness import Row, Size, in_turns, ratios, row
from worlds import built

from fgtutor.cli.demo import GOAL, START
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.elevation import ElevationMap
from fgtutor.specialist import load_zoo
from fgtutor.tensorization import Assessment, assess_all

DRAGS = 8


def noisy(cells: int) -> Explorer:
    """Return the worst case: policies that take turns at every cell, so little can be left out."""
    rng = torch.Generator().manual_seed(0)
    shape = (cells, cells, 8)
    grid = ElevationMap(np.zeros((cells, cells)))
    said = {
        f"policy {i}": Assessment(
            0.3 + 0.7 * torch.rand(shape, generator=rng), 2 * torch.rand(shape, generator=rng), grid
        )
        for i in range(4)
    }
    return Explorer(grid, said, grid.centre_of(2, 2), grid.centre_of(cells - 3, cells - 3))


def drag(explorer: Explorer, view: TauPictures, switch_cost: float) -> None:
    """Move tau_high through its range."""
    for high in np.linspace(0.4, 5.0, DRAGS).tolist():
        explorer.update(taus=(0.1, high), switch_cost=switch_cost)
        view.scene()


def rows(size: Size) -> Iterator[Row]:
    """Drag over the demo's map and over noise, with free and with paid switching."""
    cells, rounds = {"full": (128, 5), "quick": (128, 2), "tiny": (12, 1)}[size]
    grid, zoo = built(cells), dict(list(load_zoo("toy").items())[:4])
    ends = (START, GOAL) if size != "tiny" else (grid.centre_of(2, 2), grid.centre_of(9, 9))
    for kind, explorer in (("demo", Explorer(grid, zoo, *ends)), ("noise", noisy(cells))):
        view = TauPictures(explorer)
        for switch_cost in (0.0, 1.0):
            ways = {
                "drag": lambda e=explorer, v=view, cost=switch_cost: drag(e, v, cost),
                "assess": lambda: assess_all(grid, zoo),
            }
            times = in_turns(ways, rounds)
            place = f"{kind}, {cells} x {cells}, switch cost {switch_cost:g}"
            if kind == "demo":
                shares = [DRAGS * share for share in ratios(times, "assess", "drag")]
                yield row("tau drag", f"assessing the map / one drag, {place}", shares)
            each = [1000 * seconds / DRAGS for seconds in times["drag"]]
            yield row("tau drag", f"one drag, {place}", each, "ms")
