"""Tensorization against the batched gather, and against bare sgemm of the same multiplications.

The gather is the reference method: every patch is sampled by itself. sgemm multiplies as many rows
by matrices of the same shapes, and does nothing else: what is above 1 over it is not arithmetic.
"""

from collections.abc import Iterator

import torch
from harness import Row, Size, in_turns, ratios, row
from torch import nn
from worlds import a1, built, natural

from fgtutor.elevation import ElevationMap
from fgtutor.specialist import Specialist
from fgtutor.tensorization import assess_all, reassess

HEADINGS = 8
ROWS = 512
"""Rows of one multiplication: those of a tile."""


def sgemm(zoo: dict[str, Specialist], patches: int) -> None:
    """Multiply as assessing that many different patches does."""
    matrices = [
        layer.weight.detach().T.contiguous()
        for one in zoo.values()
        for layer in one.feasibility.modules()
        if isinstance(layer, nn.Linear)
    ]
    inputs = [torch.ones(ROWS, len(matrix)) for matrix in matrices]
    for _ in range(patches // ROWS or 1):
        for rows, matrix in zip(inputs, matrices, strict=True):
            torch.mm(rows, matrix)


def rows(size: Size) -> Iterator[Row]:
    """Measure on ground where no two patches are alike, and on ground that was built."""
    cells, rounds = {"full": (128, 3), "quick": (48, 3), "tiny": (10, 1)}[size]
    zoo = a1()
    for kind, elevation in (("natural", natural(cells)), ("built", built(cells))):
        ways = {
            "fast": lambda here=elevation: assess_all(here, zoo),
            "gather": lambda here=elevation: assess_all(here, zoo, "reference"),
            "sgemm": lambda: sgemm(zoo, cells * cells * HEADINGS),
        }
        times = in_turns(ways, rounds)
        place = f"{kind} ground, {cells} x {cells}, {len(zoo)} A1 policies"
        yield row("tensorize", f"gather / ours, {place}", ratios(times, "gather", "fast"))
        yield row("tensorize", f"ours / sgemm, {place}", ratios(times, "fast", "sgemm"))
    yield from painted(size)


def painted(size: Size) -> Iterator[Row]:
    """Measure a dot painted on a map against assessing the whole map anew."""
    cells, rounds = {"full": (400, 2), "quick": (200, 1), "tiny": (30, 1)}[size]
    name, specialist = next(iter(a1().items()))
    before = natural(cells, 0.1)
    heights = before.heights.copy()
    heights[cells // 2, cells // 2] += 0.1
    after, said = ElevationMap(heights, 0.1), assess_all(before, {name: specialist})
    times = in_turns(
        {
            "whole": lambda: assess_all(after, {name: specialist}),
            "stroke": lambda: reassess(said, after),
        },
        rounds,
    )
    what = f"whole map / painted dot, {cells} x {cells} of 0.1 m, 1 policy"
    yield row("painted", what, ratios(times, "whole", "stroke"))
