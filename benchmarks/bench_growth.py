"""How cost grows with the map's cells, with policies and with headings: exponents.

1 is proportional; a map of twice the side has four times the cells. Fitted to the medians of sizes
that are measured in turns. Tensorization is on natural ground, planning on four policies' tensors.
"""

from collections.abc import Callable, Iterator, Sequence

from harness import Row, Size, exponent, in_turns, row
from worlds import layers, natural

from fgtutor.elevation import ElevationMap
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.specialist import ZOO, load_specialist
from fgtutor.tensorization import assess_all

Work = dict[str, Callable[[], object]]


def tensorizing(cells: int, policies: int, headings: int) -> Callable[[], object]:
    """Return the assessment of natural ground by so many policies, all of one kind."""
    one, elevation = load_specialist(ZOO / "a1" / "steps"), natural(cells)
    team = {f"policy {i}": one for i in range(policies)}
    return lambda: assess_all(elevation, team, headings=headings)  # pyright: ignore[reportArgumentType]


def planning(cells: int, policies: int, headings: int, paid: float) -> Callable[[], object]:
    """Return the search of a route from corner to corner."""
    tensors = list(layers(cells, headings, policies))
    (fused, policy_map), grid = fuse(tensors), ElevationMap(layers(cells, 8, 1)[0, :, :, 0])
    start, goal = (grid.centre_of(at, at) for at in (1, cells - 2))

    def work() -> object:
        options = {"tensors": tensors, "switch_cost": paid}
        return plan(fused, policy_map, grid=grid, start=start, goal=goal, **options).raise_for()

    return work


def fitted(
    over: str, sizes: Sequence[int], work: Callable[[int], Work], rounds: int
) -> Iterator[Row]:
    """Time each kind of work at each size, in turns; give the exponents, one per round."""
    ways = {(kind, n): way for n in sizes for kind, way in work(n).items()}
    times = in_turns(ways, rounds)
    amounts = [n * n if over == "cells" else n for n in sizes]
    span = f"{sizes[0]} to {sizes[-1]}" + (" a side" if over == "cells" else "")
    for kind in dict.fromkeys(kind for kind, _ in ways):
        fits = [exponent(amounts, [times[kind, n][i] for n in sizes]) for i in range(rounds)]
        yield row("growth", f"{kind} over {over}, {span}", fits, "exponent")


def rows(size: Size) -> Iterator[Row]:
    """Fit the growth with cells, policies and headings."""
    assessed, searched, policies, side, rounds = {
        "full": ((64, 128, 256, 512, 1024), (64, 128, 256, 512, 1024), (1, 2, 4, 8, 16), 128, 2),
        "quick": ((24, 48, 96), (32, 64, 128, 256), (1, 2, 4, 8), 32, 2),
        "tiny": ((6, 12), (6, 12), (1, 2), 8, 1),
    }[size]  # fmt: skip
    once = 1 if size == "full" else rounds

    def both(cells: int, count: int, headings: int) -> Work:
        return {
            "plan, switching free": planning(cells, count, headings, 0.0),
            "plan, switching paid": planning(cells, count, headings, 1.0),
        }

    yield from fitted("cells", assessed, lambda n: {"tensorize": tensorizing(n, 1, 8)}, once)
    yield from fitted("cells", searched, lambda n: both(n, 4, 8), rounds)
    for over, counts, kind in (
        ("policies", policies, lambda n: (side, n, 8)),
        ("headings", (8, 16, 32), lambda n: (side, 4, n)),
    ):
        yield from fitted(
            over,
            counts,
            lambda n, kind=kind: {"tensorize": tensorizing(*kind(n)), **both(*kind(n))},
            once,
        )
