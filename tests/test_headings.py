"""Planning with 8, 16, 32 and 48 headings: oracles, symmetry, steps that ground between closes."""

import io
import json
from dataclasses import replace
from functools import cache

import networkx
import numpy as np
import pytest
import torch

from fgtutor.baselines import AssessedMap, find_route, planners
from fgtutor.course.patch_pictures import heading_maps
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.tau_pictures import TauPictures
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, PlanningError, UnreachableError
from fgtutor.execution import execute
from fgtutor.figures.maps import draw_petals, plan_figure
from fgtutor.fusion import fuse
from fgtutor.patches import PatchGrid
from fgtutor.planning import PAPER, PlanSettings, plan, plan_on_map
from fgtutor.routes import Route
from fgtutor.specialist import load_zoo
from fgtutor.tensorization import assess, assess_all, why_blocked
from fgtutor.world.terrain import Terrain

COUNTS = (8, 16, 32, 48)
counts = pytest.mark.parametrize("count", COUNTS)
ROOM, MIDDLE = (13, 13), (6, 6)
"""A map with room for the longest step from its middle."""
ASYMMETRIC = PatchGrid(ahead=0.4, behind=0.2, half_width=0.2)


def problem(count: int, seed: int, policies: int = 3):
    """Return tensors without any symmetry, a map with unknown cells, and two of its cells."""
    rng = np.random.default_rng(seed)
    nx, ny = rng.integers(5, 11, 2)
    shape = (policies, nx, ny, count)
    tensors = rng.uniform(0.1, 1, shape) * (rng.random(shape) < 0.6)
    known = rng.random((nx, ny)) < 0.93
    ends = np.argwhere(np.ones((nx, ny)))[rng.choice(nx * ny, 2, replace=False)]
    known[tuple(ends.T)] = True
    return list(tensors), ElevationMap(np.zeros((nx, ny)), 0.2, known=known), ends.tolist()


@cache
def passed(count: int, heading: int) -> set:
    """Return the cells that a straight step passes through, its ends included, by sampling it."""
    along = (np.arange(420) + 0.5)[:, None] / 420  # never on the border between two cells
    step = Headings(count).steps[heading]
    return {tuple(cell) for cell in np.rint(along * step).astype(int).tolist()}


def oracle(tensors, grid: ElevationMap, ends, settings: PlanSettings) -> float | None:
    """Return the cheapest cost over (cell, policy), by the definition and edge by edge."""
    graph, steps = networkx.DiGraph(), Headings.of(tensors[0]).steps
    layers = range(len(tensors))
    for ix, iy, k in np.ndindex(tensors[0].shape):
        cells = np.add((ix, iy), sorted(passed(len(steps), k)))
        head = np.add((ix, iy), steps[k])
        inside = ((cells >= 0) & (cells < grid.shape)).all()
        if not inside or not grid.known[tuple(cells.T)].all():
            continue
        able = [i for i in layers if tensors[i][ix, iy, k] >= settings.f_min]
        size = np.hypot(*steps[k]) * 0.2 if settings.cost == "length" else abs(steps[k]).max()
        for old in able:
            for new in able:
                cost = size / tensors[new][ix, iy, k] + settings.switch_cost * (old != new)
                graph.add_edge((ix, iy, old), (*head.tolist(), new), weight=cost)
    for layer in layers:
        graph.add_edge("start", (*ends[0], layer), weight=0)
        graph.add_edge((*ends[1], layer), "goal", weight=0)
    try:
        return networkx.shortest_path_length(graph, "start", "goal", weight="weight")
    except networkx.NetworkXNoPath:
        return None


def cost_of(tensors, grid, ends, settings) -> float | None:
    start, goal = (grid.centre_of(*cell) for cell in ends)
    asked = {"grid": grid, "start": start, "goal": goal, "settings": settings, "tensors": tensors}
    answer = plan(*fuse(tensors), **asked)
    if not answer:
        return None
    assert answer.num_headings == tensors[0].shape[-1]
    metres = np.linalg.norm(np.diff(answer.xy, axis=0), axis=1)
    assert answer.length == pytest.approx(metres.sum())
    return answer.cost


@counts
@pytest.mark.parametrize("cost", ["inverse", "length"])
@pytest.mark.parametrize("switch_cost", [0.0, 0.7])
def test_both_backends_find_the_oracles_cost(count, cost, switch_cost):
    found = 0
    for seed in range(5):
        tensors, grid, ends = problem(count, seed)
        settings = PlanSettings(cost=cost, switch_cost=switch_cost, f_min=0.2, headings=count)
        # With free switching the fused tensor is one layer.
        layers = tensors if switch_cost else [np.maximum.reduce(tensors)]
        expected = oracle(layers, grid, ends, settings)
        for backend in ("networkx", "scipy"):
            found += expected is not None
            got = cost_of(tensors, grid, ends, replace(settings, backend=backend))
            assert got == (None if expected is None else pytest.approx(expected, abs=1e-9))
    assert found >= 6


@counts
@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_turned_or_mirrored_map_has_a_route_of_the_same_cost(count, quarters, mirrored):
    settings, compared = PlanSettings(f_min=0.2), 0
    for seed in range(8):
        tensors, grid, ends = problem(count, seed)
        known, images = grid.known, np.stack(tensors)
        corner = np.zeros(grid.shape, dtype=int)
        corner[tuple(ends[0])], corner[tuple(ends[1])] = 1, 2
        if mirrored:  # y becomes -y, and heading k becomes -k
            known, corner = known[:, ::-1], corner[:, ::-1]
            images = images[:, :, ::-1, -np.arange(count) % count]
        known, corner = np.rot90(known, quarters), np.rot90(corner, quarters)
        images = np.roll(np.rot90(images, quarters, axes=(1, 2)), quarters * count // 4, axis=-1)
        image = ElevationMap(np.zeros(known.shape), 0.2, known=known)
        there = [np.argwhere(corner == mark)[0].tolist() for mark in (1, 2)]
        costs = [
            cost_of(tensors, grid, ends, settings), cost_of(list(images), image, there, settings)
        ]  # fmt: skip
        assert costs[0] == (None if costs[1] is None else pytest.approx(costs[1], abs=1e-9))
        compared += costs[0] is not None
    assert compared >= 4


def straight_up(count: int, heading: int):
    """Return a map of `ROOM` cells with one step of `heading` on it, and where that leads."""
    end = np.array(MIDDLE) + Headings(count).steps[heading]
    tensor = np.zeros((*ROOM, count))
    tensor[(*MIDDLE, heading)] = 1.0
    return tensor, MIDDLE, tuple(end.tolist())


@pytest.mark.parametrize(
    ("count", "heading"), [(16, 1), (16, 11), (32, 1), (32, 3), (32, 22), (48, 1), (48, 5)]
)
def test_one_unknown_cell_under_a_long_step_closes_it(count, heading):
    tensor, start, end = straight_up(count, heading)
    cells = passed(count, heading)
    assert len(cells) > 2
    for ix, iy in np.ndindex(ROOM):
        known = np.ones(ROOM, dtype=bool)
        known[ix, iy] = False
        if (ix, iy) in (start, end):
            continue
        grid = ElevationMap(np.zeros(ROOM), known=known)
        closed = cost_of([tensor], grid, [start, end], PlanSettings(f_min=0.5)) is None
        assert closed == ((ix - 6, iy - 6) in cells)


@pytest.mark.parametrize(
    ("count", "heading"), [(16, 1), (16, 11), (32, 1), (32, 3), (32, 22), (48, 1), (48, 5)]
)
def test_one_infeasible_cell_under_a_long_step_closes_it(make_specialist, count, heading):
    """Of the cells it passes, the last one need not be left."""
    flat = ElevationMap(np.zeros(ROOM))
    one = assess(flat, make_specialist(), taus=(1e3, 1e4), headings=count)
    one.f[:] = 0.8
    step = Headings(count).steps[heading]
    cells = passed(count, heading) - {tuple(step.tolist())}
    assert one.weighted()[(*MIDDLE, heading)] == pytest.approx(0.8)
    for ix, iy in np.ndindex(ROOM):
        one.f[ix, iy, heading] = 0.05
        low = {(ix - 6, iy - 6)} <= cells
        for unknown in ("block", "fill"):
            F = one.weighted(unknown=unknown)
            assert F[(*MIDDLE, heading)] == pytest.approx(0.05 if low else 0.8)
        one.f[ix, iy, heading] = 0.8
    # Other headings of the cell do not matter.
    one.f[6 + step[0] // 2, 6 + step[1] // 2, (heading + 1) % count] = 0.05
    assert one.weighted()[(*MIDDLE, heading)] == pytest.approx(0.8)


def rough(nx: int = 14, ny: int = 9, hole: bool = True) -> ElevationMap:
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    heights = 0.02 * x + 0.01 * y + 0.2 * (x > nx // 2) + 0.05 * rng.random((nx, ny))
    if hole:
        heights[3, 4] = np.nan
    return ElevationMap(heights, 0.1, origin=(-1.3, 40.7))


@pytest.mark.parametrize("count", [16, 32, 48])
@pytest.mark.parametrize("method", ["fast", "reference"])
def test_turning_the_map_shifts_the_headings(make_specialist, count, method):
    # Without a hole: of two known cells as near to it, filling may take another on a turned map.
    specialist, elevation = make_specialist(grid=ASYMMETRIC), rough(hole=False)
    options = {"method": method, "headings": count, "taus": (1e3, 1e4)}
    still = assess(elevation, specialist, **options).weighted()
    turned = assess(elevation.rotated90(), specialist, **options).weighted()
    expected = torch.rot90(still, 1, dims=(0, 1)).roll(count // 4, dims=2)
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("count", [16, 32, 48])
def test_fast_equals_reference_and_more_headings_keep_the_eight(make_specialist, count):
    specialist, elevation = make_specialist(grid=ASYMMETRIC), rough()
    fast, reference = (
        assess(elevation, specialist, method, headings=count) for method in ("fast", "reference")
    )
    for name in ("f", "reconstruction"):
        torch.testing.assert_close(
            getattr(fast, name), getattr(reference, name), atol=1e-5, rtol=1e-5
        )
    eight = assess(elevation, specialist, headings=8, taus=(1e3, 1e4)).weighted()
    more = assess(elevation, specialist, headings=count, taus=(1e3, 1e4)).weighted()
    assert torch.equal(more[..., :: count // 8], eight)


def test_more_headings_are_never_dearer_and_see_a_way_off_the_axes():
    """A lane that climbs one cell in two, its borders unknown: eight headings must zigzag in it."""
    nx, ny = 24, 18
    x, y = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    known = np.abs(y - x / 2 - 3) <= 1.3
    grid = ElevationMap(np.zeros((nx, ny)), known=known)
    ends = [(2, 4), (20, 13)]
    lengths = []
    for count in COUNTS:
        tensor = np.ones((nx, ny, count))
        lengths.append(cost_of([tensor], grid, ends, PlanSettings(switch_cost=0.0)))
    straight = 0.1 * np.hypot(18, 9)
    assert lengths[1:] == pytest.approx([straight] * 3)
    assert lengths[0] == pytest.approx(0.1 * 9 * (1 + 2**0.5))
    # By the paper's cost no step over several cells is a discount.
    paper_s = [cost_of([np.ones((nx, ny, d))], grid, ends, PAPER) for d in COUNTS]
    assert paper_s == pytest.approx([18] * 4)


@pytest.fixture
def zoo(make_specialist):
    return {name: make_specialist(name, seed=i) for i, name in enumerate(("gaps", "steps"))}


@pytest.mark.slow
@pytest.mark.parametrize("count", [16, 32, 48])
def test_every_picture_and_reading_shows_all_headings(zoo, count):
    M = rough()
    ends = M.centre_of(1, 1), M.centre_of(12, 7)
    settings = PlanSettings(headings=count, taus=(1e3, 1e4), f_min=1e-3)
    planned = plan_on_map(M, zoo, *ends, settings=settings)
    assert planned.fused.shape == (14, 9, count)
    plan_figure(M, planned, f_min=1e-3).savefig(io.BytesIO())
    petals = draw_petals(np.ones((14, 9, count)), M).axes[0].collections[0]
    assert len(petals.get_paths()) % count == 0
    maps = heading_maps(planned.fused, M).axes
    assert len([axes for axes in maps if axes.get_title(loc="left").startswith("heading")]) == count
    explorer = Explorer(M, zoo, *ends, settings)
    assert explorer.route is not None and explorer.route.to_json() == planned.route.to_json()
    TauPictures(explorer).scene()
    lines = explorer.read((5, 5)).splitlines()
    heads = [word for line in lines if line.startswith("heading") for word in line.split()[1:]]
    assert tuple(heads) == Headings(count).names
    with pytest.raises(ConfigError, match=f"along {count} headings, not 8"):
        explorer.update(headings=8)
    said = assess_all(M, zoo, headings=count)
    assert Explorer(M, said, *ends).settings.headings == count
    with pytest.raises(ConfigError, match="shape"):
        Explorer(M, {**said, "eight": assess(M, zoo["gaps"], headings=8)}, *ends)


@pytest.mark.parametrize("count", [16, 32, 48])
def test_refusals_and_reasons_name_the_headings_in_use(zoo, count):
    heights = np.zeros((20, 9))
    heights[12] = np.nan
    M = ElevationMap(heights)
    ends = M.centre_of(1, 1), M.centre_of(17, 8)
    settings = PlanSettings(headings=count, taus=(1e3, 1e4), f_min=1e-3)
    planned = plan_on_map(M, zoo, *ends, settings=settings)
    assert isinstance(planned.answer.error, UnreachableError)
    assert planned.answer.nearest == pytest.approx(M.centre_of(11, 8))
    assert Headings(count).names[planned.answer.heading] == "+x"
    assert planned.why_not(M) == [
        "The step on from there leads onto ground that was never observed."
    ]
    said = assess_all(M, zoo, taus=(1e3, 1e4), headings=count)
    for one in said.values():
        one.f[:] = 0.05
        one.f[5, 4, 1] = 0.9  # one long heading, whose cells ahead cannot be left
    assert "would not keep its velocity" in why_blocked(*M.centre_of(5, 4), said)
    for one in said.values():
        one.f[..., 1] = 0.9
    name = Headings(count).names[1]
    assert f"leaves it towards {name} with F = 0.90" in why_blocked(*M.centre_of(5, 4), said)


@counts
def test_every_planner_plans_with_the_headings_of_its_map(zoo, make_specialist, count):
    zoo = zoo | {"general": make_specialist("general", seed=7)}
    M = ElevationMap(np.zeros((12, 9)))
    ground = AssessedMap(M, zoo, (1e3, 1e4), count)
    for name, planner in planners(zoo).items():
        route = find_route(planner, ground, (0.15, 0.15), (1.05, 0.65), f_min=1e-3)
        assert route.raise_for().num_headings == count, name
    with pytest.raises(PlanningError, match="tensor 1 has shape"):
        known = {"gaps": torch.ones(12, 9, 8)}
        settings = PlanSettings(headings=16)
        plan_on_map(M, zoo, (0.15, 0.15), (1.05, 0.65), settings=settings, tensors=known)


def test_a_route_says_how_many_headings_it_counts():
    grid = ElevationMap(np.zeros((9, 9)))
    ends = {"start": grid.centre_of(1, 1), "goal": grid.centre_of(7, 3)}
    route = plan(*fuse([np.ones((9, 9, 32))]), grid=grid, **ends).raise_for()
    assert [step["heading"] for step in route.explain()] == ["+3x+y"] * 2
    data = json.loads(json.dumps(route.to_json()))
    again = Route.from_json(data)
    assert again.to_json() == route.to_json() and again.num_headings == 32
    for count in (8, 12, "32", None, True):
        with pytest.raises(PlanningError, match="not a route"):
            Route.from_json(data | {"num_headings": count})
    # Routes written before there was a choice had eight.
    eight = plan(*fuse([np.ones((9, 9, 8))]), grid=grid, **ends).raise_for().to_json()
    assert (
        Route.from_json({k: v for k, v in eight.items() if k != "num_headings"}).num_headings == 8
    )


@pytest.mark.slow
@pytest.mark.parametrize("count", [16, 32, 48])
def test_a_route_of_long_steps_is_driven(count):
    """Way points lie up to 3.6 cells of 0.1 m apart; the robot keeps to the line between them."""
    M = ElevationMap(np.zeros((50, 40)))
    start, goal = M.centre_of(5, 5), M.centre_of(41, 5 + (18 if count == 16 else 12))
    zoo = {"steps": load_zoo("toy")["steps"]}
    route = plan_on_map(M, zoo, start, goal, headings=count).route
    assert (np.hypot(*np.diff(route.cells, axis=0).T) > 2).sum() >= 10
    episode = execute(route, Terrain.from_elevation(M, start, goal, robot="toy"), zoo)
    assert episode.success
    straight = np.subtract(goal, start) / np.hypot(*np.subtract(goal, start))
    aside = (episode.poses[:, :2] - start) @ (-straight[1], straight[0])
    assert np.abs(aside).max() < 0.25


def test_other_headings_than_the_tensors_have_are_an_error(flat_tensor):
    fused, elevation = flat_tensor
    ends = {"start": (0.15, 0.15), "goal": (0.75, 0.75)}
    policy_map = torch.zeros(fused.shape, dtype=torch.long)
    for asked in ({"headings": 16}, {"settings": PlanSettings(headings=32, switch_cost=0.0)}):
        with pytest.raises(
            ConfigError, match=r"fused holds 8 headings, not (16|32): give headings="
        ):
            plan(fused, policy_map, grid=elevation, **ends, **asked)
    assert plan(fused, policy_map, grid=elevation, **ends, headings=8).raise_for().num_headings == 8


def test_a_refusal_of_few_headings_names_the_more(flat_tensor):
    fused, elevation = flat_tensor
    fused[4] = 0.0  # a wall across the map
    policy_map = torch.zeros(fused.shape, dtype=torch.long)
    refused = plan(fused, policy_map, grid=elevation, start=(0.15, 0.15), goal=(0.85, 0.15))
    with pytest.raises(UnreachableError, match="use headings=48"):
        refused.raise_for()


@pytest.fixture
def flat_tensor():
    elevation = ElevationMap(np.zeros((10, 9)), 0.1)
    within = Headings(8).steps_within(elevation.known)
    return 0.5 * torch.from_numpy(within).float(), elevation
