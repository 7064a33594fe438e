"""Planning: costs against networkx, routes known by hand, errors that say what to change."""

import json
import pickle
import re

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fgtutor import directions, planning
from fgtutor.elevation import ElevationMap
from fgtutor.errors import (
    ConfigError,
    InfeasibleCellError,
    OffMapError,
    PlanningError,
    TooLargeError,
    UnknownCellError,
    UnreachableError,
)
from fgtutor.fusion import fuse
from fgtutor.graphs import Search, reversed_graph
from fgtutor.grid import point_text
from fgtutor.io import machine
from fgtutor.planning import PAPER, PlanSettings, Refusal, Route, as_networkx, as_switching_networkx

BACKENDS = ("networkx", "scipy")
RESOLUTION = 0.2
EIGHT = directions.Headings(8)


def flat(nx: int, ny: int, known: np.ndarray | None = None) -> ElevationMap:
    return ElevationMap(np.zeros((nx, ny)), resolution=RESOLUTION, origin=(-1.0, 3.0), known=known)


def plan(*arguments, **options) -> Route:
    """Plan by the paper's settings, but for the options; raise what is refused."""
    return planning.plan(*arguments, **{"settings": PAPER} | options).raise_for()


def random_problem(seed: int, policies: int = 3):
    """Return tensors without any symmetry, with closed edges and unknown cells, and two points."""
    rng = np.random.default_rng(seed)
    nx, ny = rng.integers(3, 11, 2)
    tensors = list(rng.random((policies, nx, ny, 8)) * (rng.random((policies, nx, ny, 8)) < 0.6))
    known = rng.random((nx, ny)) < 0.9
    ends = np.argwhere(np.ones((nx, ny)))[rng.choice(nx * ny, 2, replace=False)]
    known[tuple(ends.T)] = True
    grid = flat(nx, ny, known)
    start, goal = (grid.centre_of(*cell) for cell in ends.tolist())
    return tensors, grid, start, goal


def step_cost(value: float, heading: int, cost: str) -> float:
    return 1 / value * (directions.STEP_LENGTHS[heading] * RESOLUTION if cost == "length" else 1)


def oracle(tensor, grid: ElevationMap, start, goal, *, f_min: float, cost: str) -> float | None:
    """Return the cheapest cost, by the definition and edge by edge."""
    graph = networkx.DiGraph()
    for ix, iy, heading in np.ndindex(tensor.shape):
        x, y = (np.array((ix, iy)) + directions.STEPS[heading]).tolist()
        inside = 0 <= x < grid.shape[0] and 0 <= y < grid.shape[1]
        if tensor[ix, iy, heading] < f_min or not inside:
            continue
        if grid.known[ix, iy] and grid.known[x, y]:
            weight = step_cost(tensor[ix, iy, heading], heading, cost)
            graph.add_edge((ix, iy), (x, y), weight=weight)
    try:
        ends = grid.cell_of(*start), grid.cell_of(*goal)
        return networkx.shortest_path_length(graph, *ends, weight="weight")
    except (networkx.NetworkXNoPath, networkx.NodeNotFound):
        return None


def check_route(route: Route, fused, policy_map, grid: ElevationMap, start, goal, cost: str):
    """Walk the route again: it joins start and goal, and its numbers are those of its edges."""
    assert tuple(route.cells[0]) == grid.cell_of(*start)
    assert tuple(route.cells[-1]) == grid.cell_of(*goal)
    total = 0.0
    for i, heading in enumerate(route.headings):
        assert (route.cells[i] + directions.STEPS[heading] == route.cells[i + 1]).all()
        edge = (*route.cells[i], heading)
        assert route.feasibility[i] == fused[edge] and route.policies[i] == policy_map[edge]
        total += step_cost(fused[edge], heading, cost)
    assert route.cost == pytest.approx(total, abs=1e-9)
    assert grid.known[tuple(route.cells.T)].all()
    assert route.length == pytest.approx(np.linalg.norm(np.diff(route.xy, axis=0), axis=1).sum())


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["inverse", "length"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_two_hundred_random_maps_cost_what_networkx_says(backend, cost):
    found = 0
    for seed in range(200):
        tensors, grid, start, goal = random_problem(seed)
        fused, policy_map = fuse(tensors)
        settings = {"grid": grid, "start": start, "goal": goal, "cost": cost, "f_min": 0.3}
        expected = oracle(fused, grid, start, goal, cost=cost, f_min=0.3)
        if expected is None:
            with pytest.raises((InfeasibleCellError, UnreachableError)):
                plan(fused, policy_map, backend=backend, **settings)
            continue
        route = plan(fused, policy_map, backend=backend, **settings)
        assert route.cost == pytest.approx(expected, abs=1e-9)
        check_route(route, fused, policy_map, grid, start, goal, cost)
        found += 1
    assert found > 150


@given(st.integers(0, 10**6), st.integers(1, 3))
def test_turning_the_map_keeps_the_cost(seed, quarter_turns):
    tensors, grid, start, goal = random_problem(seed)
    fused, policy_map = fuse(tensors)
    turned = [
        np.roll(np.rot90(array, quarter_turns), 2 * quarter_turns, axis=2)
        for array in (fused, policy_map)
    ]

    def turn(point):
        z = complex(*point) * 1j**quarter_turns
        return z.real, z.imag

    costs = []
    for (f, p), g, ends in (
        ((fused, policy_map), grid, (start, goal)),
        (turned, grid.rotated90(quarter_turns), (turn(start), turn(goal))),
    ):
        try:
            costs.append(plan(f, p, grid=g, start=ends[0], goal=ends[1], backend="scipy").cost)
        except PlanningError:
            costs.append(None)
    assert costs[0] == pytest.approx(costs[1], abs=1e-9)


def two_specialists():
    """Return a corridor of 7 x 3 cells: `walker` stops at a wall in column 3, `climber` does not.

    The walker tracks perfectly (1.0) but cannot enter the wall; the climber manages 0.5 anywhere.
    """
    walker, climber = np.ones((7, 3, 8)), np.full((7, 3, 8), 0.5)
    for ix, iy, heading in np.ndindex(walker.shape):
        if ix == 3 or ix + directions.STEPS[heading][0] == 3:
            walker[ix, iy, heading] = 0.0
    return walker, climber


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_right_specialist_crosses_the_wall(backend):
    grid = flat(7, 3)
    walker, climber = two_specialists()
    fused, policy_map = fuse([walker, climber])
    route = plan(
        fused,
        policy_map,
        grid=grid,
        start=grid.centre_of(0, 1),
        goal=grid.centre_of(6, 1),
        backend=backend,
        tensors=[walker, climber],
        names=["walker", "climber"],
    )
    # Two steps up to the wall, two over it at 1 / 0.5, two after it.
    assert route.cost == pytest.approx(2 + 2 * 2 + 2)
    assert route.policies.tolist() == [0, 0, 1, 1, 0, 0]
    assert route.switches == 2
    assert "walker -> climber -> walker" in repr(route)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("slow", "rows"),
    # Through the middle: 2 + 2 / slow. Round it: down to row 0 at 1, two steps at 1 / 0.8, and 1.
    [(0.9, {1}), (0.2, {0, 1})],
)
def test_a_detour_is_taken_when_it_pays(backend, slow, rows):
    grid = flat(5, 3)
    tensor = np.ones((5, 3, 8))
    tensor[:, 2] = 0.0  # row 2 is closed, so that the detour is row 0
    tensor[:, 0] = 0.8
    tensor[2, 1] = slow
    tensor[1, 1, 0] = slow
    tensor[1, :, [1, 7]] = 0.0  # no way leads diagonally into column 2
    ends = {"start": grid.centre_of(0, 1), "goal": grid.centre_of(4, 1)}
    route = plan(tensor, np.zeros(tensor.shape), grid=grid, backend=backend, **ends)
    assert set(route.cells[:, 1]) == rows
    assert route.cost == pytest.approx(min(2 + 2 / slow, 4.5))


@pytest.mark.parametrize("backend", BACKENDS)
def test_up_a_step_and_down_a_step_are_two_different_edges(backend):
    grid = flat(4, 2)
    tensor = np.ones((4, 2, 8))
    tensor[1, :, [0, 1, 7]] = 0.0  # the ledge between columns 1 and 2 is too high to climb
    left, right = grid.centre_of(0, 0), grid.centre_of(3, 0)
    policy_map = np.zeros(tensor.shape)
    assert plan(tensor, policy_map, grid=grid, start=right, goal=left, backend=backend).cost == 3
    with pytest.raises(UnreachableError):
        plan(tensor, policy_map, grid=grid, start=left, goal=right, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_cost_by_length_prefers_the_shorter_way(backend):
    grid = flat(3, 3)
    tensor = np.full((3, 3, 8), 0.5)
    ends = {"start": grid.centre_of(0, 0), "goal": grid.centre_of(2, 1)}
    route = plan(tensor, np.zeros(tensor.shape), grid=grid, cost="length", backend=backend, **ends)
    # One step along x and one diagonal, 0.2 m cells, twice the length at F = 0.5.
    assert route.cost == pytest.approx(2 * 0.2 * (1 + 2**0.5))
    assert route.length == pytest.approx(0.2 * (1 + 2**0.5))


def switching_oracle(tensors, grid, start, goal, *, f_min, switch_cost) -> float | None:
    """Return the cheapest cost by Bellman-Ford over (cell, policy), from the definition."""
    best = np.full((len(tensors), *grid.shape), np.inf)
    best[(slice(None), *grid.cell_of(*start))] = 0
    for _ in range(best.size):
        before = best.copy()
        for new, ix, iy, heading in np.ndindex(len(tensors), *grid.shape, 8):
            x, y = (np.array((ix, iy)) + directions.STEPS[heading]).tolist()
            value = tensors[new][ix, iy, heading]
            inside = 0 <= x < grid.shape[0] and 0 <= y < grid.shape[1]
            if value < f_min or not inside or not (grid.known[ix, iy] and grid.known[x, y]):
                continue
            for old in range(len(tensors)):
                if tensors[old][ix, iy, heading] >= f_min:
                    offer = best[old, ix, iy] + 1 / value + switch_cost * (old != new)
                    best[new, x, y] = min(best[new, x, y], offer)
        if np.array_equal(before, best):
            break
    cost = best[(slice(None), *grid.cell_of(*goal))].min()
    return cost if np.isfinite(cost) else None


@pytest.mark.parametrize("seed", range(8))
def test_switching_costs_what_bellman_ford_says(seed):
    tensors, grid, start, goal = random_problem(seed + 1000, policies=2)
    fused, policy_map = fuse(tensors)
    settings = {"f_min": 0.3, "switch_cost": 1.5}
    expected = switching_oracle(tensors, grid, start, goal, **settings)
    for backend in BACKENDS:
        common = {"grid": grid, "start": start, "goal": goal, "tensors": tensors, **settings}
        if expected is None:
            with pytest.raises((InfeasibleCellError, UnreachableError)):
                plan(fused, policy_map, backend=backend, **common)
            continue
        route = plan(fused, policy_map, backend=backend, **common)
        assert route.cost == pytest.approx(expected, abs=1e-9)
        steps = zip(route.cells, route.headings, route.policies, strict=False)
        driven = sum(1 / tensors[p][(*cell, k)] for cell, k, p in steps)
        assert route.cost == pytest.approx(driven + 1.5 * route.switches)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_switch_must_be_worth_its_cost(backend):
    grid = flat(7, 2)
    even, odd = np.full((7, 2, 8), 0.8), np.full((7, 2, 8), 0.8)
    even[::2], odd[1::2] = 1.0, 1.0
    fused, policy_map = fuse([even, odd])
    settings = {"grid": grid, "start": grid.centre_of(0, 0), "goal": grid.centre_of(6, 0)}
    settings |= {"backend": backend, "tensors": [even, odd]}
    free = plan(fused, policy_map, **settings)
    assert free.cost == pytest.approx(6.0) and free.switches == 5
    # Keeping one policy: three steps at 1 and three at 1 / 0.8.
    paid = plan(fused, policy_map, switch_cost=1.0, **settings)
    assert paid.cost == pytest.approx(3 + 3 * 1.25) and paid.switches == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_switch_happens_where_both_policies_are_feasible(backend):
    grid = flat(9, 2)
    before, after = np.ones((9, 2, 8)), np.ones((9, 2, 8))
    before[6:], after[:3] = 0.0, 0.0  # both can leave columns 3, 4 and 5
    fused, policy_map = fuse([before, after])
    route = plan(
        fused,
        policy_map,
        grid=grid,
        start=grid.centre_of(0, 0),
        goal=grid.centre_of(8, 0),
        backend=backend,
        switch_cost=0.5,
        tensors=[before, after],
    )
    assert route.cost == pytest.approx(8.5) and route.switches == 1
    column = route.cells[np.argmax(route.policies == 1), 0]
    assert column in (3, 4, 5)


@pytest.mark.parametrize(
    ("cell", "error"),
    [((4, 4), UnknownCellError), ((0, 4), InfeasibleCellError), ((4, 0), UnreachableError)],
)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_refusal_is_a_value_with_its_reason(backend, cell, error):
    tensor, grid = one_island()
    ends = {"start": grid.centre_of(2, 2), "goal": grid.centre_of(*cell)}
    answer = planning.plan(tensor, np.zeros(tensor.shape), grid=grid, backend=backend, **ends)
    assert isinstance(answer, Refusal) and not answer and isinstance(answer.error, error)
    assert answer.reason == str(answer.error) and answer.reason in repr(answer)
    with pytest.raises(error):
        answer.raise_for()
    with pytest.raises(AttributeError, match="no route, so no 'xy': "):
        answer.xy  # noqa: B018
    again = pickle.loads(pickle.dumps(answer))
    assert again.reason == answer.reason and type(again.error) is error


@pytest.mark.parametrize("switch_cost", [0.0, 1.0])
def test_a_refusal_names_the_place_nearest_to_the_goal(switch_cost):
    tensor, grid = np.ones((2, 9, 5, 8)), flat(9, 5)
    tensor[:, 3] = 0.05  # column 3 can be entered, and not left
    tensor[1, :, 4] = 0.05  # the second policy never goes up there
    ends = {"start": grid.centre_of(0, 0), "goal": grid.centre_of(8, 4)}
    options = {"tensors": tensor, "switch_cost": switch_cost, "settings": PAPER}
    refusal = planning.plan(*fuse(tensor), grid=grid, **ends, **options)
    assert isinstance(refusal.error, UnreachableError)
    assert refusal.nearest == pytest.approx(grid.centre_of(3, 4))
    assert directions.NAMES[refusal.heading] == "+x"
    assert point_text(refusal.nearest, RESOLUTION) in refusal.reason


def test_our_settings_are_the_default_and_the_papers_have_a_name():
    walker, climber = two_specialists()
    fused, policy_map = fuse([walker, climber])
    grid = flat(7, 3)
    ends = {"grid": grid, "start": grid.centre_of(0, 1), "goal": grid.centre_of(6, 1)}
    known = ends | {"tensors": [walker, climber]}
    for settings, cost in ((None, 8 * RESOLUTION + 2), (PlanSettings(), 8 * RESOLUTION + 2)):
        # A switch before the wall and one after it, where both can walk: 1 each. From there on the
        # climber would cost no less.
        route = planning.plan(fused, policy_map, settings=settings, **known)
        assert route.cost <= cost + 1e-9
        assert route.cost == pytest.approx(min(cost, 12 * RESOLUTION))
    assert planning.plan(fused, policy_map, settings=PAPER, **known).cost == pytest.approx(8)
    # Without the tensors nothing is known of the other policies: switching is free.
    assert planning.plan(fused, policy_map, **ends).cost == pytest.approx(8 * RESOLUTION)
    with pytest.raises(ConfigError, match="tensors"):
        planning.plan(fused, policy_map, settings=PlanSettings(), **ends)
    with pytest.raises(TypeError, match="f_mn"):
        planning.plan(fused, policy_map, f_mn=0.2, **ends)


@pytest.mark.parametrize("cost", ["inverse", "length"])
@pytest.mark.parametrize("switch_cost", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("seed", range(6))
def test_the_narrowed_search_finds_what_the_whole_one_does(seed, switch_cost, cost):
    """Smooth tensors narrow much, rough ones little, and far ends leave room for detours."""
    rng = np.random.default_rng(seed)
    tensors = rng.random((3, 30, 22, 8))
    for _ in range(seed % 3):
        tensors = (tensors + np.roll(tensors, 1, axis=1) + np.roll(tensors, 1, axis=2)) / 3
    grid = flat(30, 22)
    layers = np.where(EIGHT.steps_within(grid.known) & (tensors >= 0.2), tensors, 0)
    search = Search(layers, switch_cost, cost, RESOLUTION)
    for start, goal in (((0, 0), (29, 21)), ((5, 15), (20, 3)), ((9, 9), (10, 9))):
        whole, distance = search._backwards(search._reversed(), start, goal)
        assert whole is not None
        first = np.ravel_multi_index((np.arange(3), *start), layers.shape[:3])
        ends = {"start": grid.centre_of(*start), "goal": grid.centre_of(*goal)}
        options = {"f_min": 0.2, "cost": cost, "switch_cost": switch_cost, "grid": grid}
        route = plan(*fuse(tensors), tensors=tensors, **ends, **options)
        assert route.cost == pytest.approx(distance[first].min(), abs=1e-9)


@pytest.mark.parametrize("switch_cost", [0.0, 1.0])
@pytest.mark.parametrize("backend", BACKENDS)
def test_start_in_the_goals_cell_is_a_route_without_steps(backend, switch_cost):
    grid = flat(3, 3)
    closed = np.zeros((3, 3, 8))
    route = plan(
        closed,
        closed,
        grid=grid,
        start=(-0.95, 3.05),
        goal=(-0.85, 3.15),
        backend=backend,
        switch_cost=switch_cost,
        tensors=[closed, closed],
    )
    assert route.cells.tolist() == [[0, 0]] and len(route.headings) == 0
    assert route.cost == route.length == 0 and route.switches == 0
    assert "one cell" in repr(route)
    assert Route.from_json(route.to_json()).cells.shape == (1, 2)


def one_island():
    """Return a 5 x 5 map: (4, 4) unknown, (0, 4) closed both ways, (4, 0) an island."""
    tensor = np.ones((5, 5, 8))
    known = np.ones((5, 5), dtype=bool)
    known[4, 4] = False
    island = {(4, 0), (4, 1)}
    for ix, iy, heading in np.ndindex(tensor.shape):
        there = tuple((np.array((ix, iy)) + directions.STEPS[heading]).tolist())
        if (0, 4) in ((ix, iy), there) or (((ix, iy) in island) != (there in island)):
            tensor[ix, iy, heading] = 0.05
    return tensor, flat(5, 5, known)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("cell", "error", "words"),
    [
        ((7, 0), OffMapError, "off the map"),
        ((np.nan, 0), OffMapError, "off the map"),
        ((4, 4), UnknownCellError, "never observed"),
        ((0, 4), InfeasibleCellError, "no policy can"),
        ((4, 0), UnreachableError, "no chain of steps"),
    ],
)
@pytest.mark.parametrize("role", ["start", "goal"])
def test_errors_say_which_end_where_and_what_to_change(backend, cell, error, words, role):
    tensor, grid = one_island()
    ends = {"start": grid.centre_of(2, 2), "goal": grid.centre_of(1, 1)}
    ends[role] = grid.centre_of(*cell)
    with pytest.raises(error, match=words) as caught:
        plan(tensor, np.zeros(tensor.shape), grid=grid, backend=backend, **ends)
    message = str(caught.value)
    assert role in message and point_text(ends[role], RESOLUTION) in message
    assert "move" in message


@pytest.mark.parametrize("backend", BACKENDS)
def test_unknown_cells_are_never_silently_free(backend):
    known = np.ones((5, 2), dtype=bool)
    known[2] = False
    grid, tensor = flat(5, 2, known), np.ones((5, 2, 8))
    settings = {"grid": grid, "start": grid.centre_of(0, 0), "goal": grid.centre_of(4, 0)}
    with pytest.raises(UnreachableError):
        plan(tensor, np.zeros(tensor.shape), backend=backend, **settings)
    route = plan(tensor, np.zeros(tensor.shape), backend=backend, unknown="fill", **settings)
    assert route.cost == 4


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"f_min": 0.0}, ConfigError, "f_min: should be greater than 0"),
        ({"f_min": np.nan}, ConfigError, "f_min: should be a finite number"),
        ({"f_min": np.inf}, ConfigError, "f_min: should be a finite number"),
        ({"f_min": "0.1"}, ConfigError, "f_min: should be a valid number"),
        ({"cost": "time"}, ConfigError, "'inverse' or 'length'"),
        ({"backend": "astar"}, ConfigError, "'auto', 'networkx' or 'scipy'"),
        ({"unknown": "free"}, ConfigError, "'block' or 'fill'"),
        ({"switch_cost": -1.0}, ConfigError, "switch_cost: should be greater than or equal to 0"),
        ({"switch_cost": np.nan}, ConfigError, "switch_cost: should be a finite number"),
        ({"switch_cost": np.inf}, ConfigError, "switch_cost: should be a finite number"),
        ({"switch_cost": 1.0}, ConfigError, "tensors"),
        ({"start": (0.0,)}, ConfigError, "the start must be a point"),
        ({"goal": ("here", 1)}, ConfigError, "the goal must be a point"),
        ({"goal": (0.0, np.inf)}, OffMapError, "the goal .* is off the map"),
        ({"names": ["a"]}, PlanningError, "0 to 1, with 1 names"),
        ({"names": ["a", "b", "c"], "tensors": [np.ones((3, 3, 8))] * 2}, PlanningError, "3 names"),
        ({"ood": [np.ones((3, 3, 8))], "names": ["a", "b"]}, PlanningError, "1 ood, 2 names"),
        ({"names": ["a", "a"]}, ConfigError, "a name of its own"),
        ({"names": "ab"}, ConfigError, "a name of its own"),
        ({"names": [1, 2]}, ConfigError, "a name of its own"),
        ({"tensors": []}, PlanningError, "tensors is empty"),
        ({"policy_map": np.full((3, 3, 8), 0.5)}, ConfigError, "fractions"),
        ({"fused": np.full((3, 3, 8), 1j)}, PlanningError, "complex"),
        ({"fused": np.full((3, 3, 8), "1")}, PlanningError, "expected real numbers"),
        ({"fused": [[1.0], [1.0, 2.0]]}, PlanningError, "no array of numbers"),
        (
            {"fused": np.ma.masked_less(np.arange(72.0).reshape(3, 3, 8), 1)},
            PlanningError,
            "masked values",
        ),
        ({"fused": np.ones((3, 4, 8))}, PlanningError, "expected shape"),
        ({"fused": np.full((3, 3, 8), np.nan)}, PlanningError, "NaN"),
        ({"fused": np.ones((3, 3, 9))}, PlanningError, "8, 16, 32 or 48"),
        ({"fused": np.ones((3, 3, 16))}, PlanningError, r"policy_map: expected shape \(3, 3, 16"),
        ({"headings": 12}, ConfigError, "headings: should be 8, 16, 32 or 48"),
        ({"policy_map": np.full((3, 3, 8), 2), "names": ["a"]}, PlanningError, "names"),
        ({"policy_map": np.full((3, 3, 8), -1)}, PlanningError, "policies -1"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, error, words):
    grid = flat(3, 3)
    usual = {
        "fused": np.ones((3, 3, 8)),
        "policy_map": np.eye(3)[..., None].repeat(8, axis=-1),
        "grid": grid,
        "start": grid.centre_of(0, 0),
        "goal": grid.centre_of(2, 2),
    }
    with pytest.raises(error, match=words):
        plan(**usual | settings)


@pytest.mark.parametrize("origin", [(500000, 4649776), (500000.35, 5648298.15)])
@pytest.mark.parametrize("backend", BACKENDS)
def test_messages_show_coordinates_to_the_cell_far_from_the_origin(backend, origin):
    near, moved = one_island()[1], np.add(origin, (1.0, -3.0))
    far = ElevationMap(near.heights, RESOLUTION, origin=origin, known=near.known)
    tensor = one_island()[0]

    def message(grid, cell):
        ends = {"start": grid.centre_of(*cell), "goal": grid.centre_of(1, 1)}
        with pytest.raises(PlanningError) as caught:
            plan(tensor, np.zeros(tensor.shape), grid=grid, backend=backend, **ends)
        return str(caught.value)

    for cell in ((7, 0), (4, 4), (0, 4), (4, 0)):
        numbers = re.findall(r"\d+\.\d\d", message(far, cell))
        place = np.add(near.centre_of(*cell), moved)
        assert numbers[:2] == [f"{value:.2f}" for value in place]
        assert len(numbers) == len(re.findall(r"\d+\.\d\d", message(near, cell)))


def test_tensors_that_carry_a_gradient_plan_as_any_other():
    grid = flat(7, 3)
    plain = [torch.from_numpy(tensor).float() for tensor in two_specialists()]
    carrying = [tensor.clone().requires_grad_() for tensor in plain]
    routes = []
    for tensors in (plain, carrying):
        fused, policy_map = fuse(tensors)
        routes.append(
            plan(
                (fused + 0 * tensors[0]),
                policy_map,
                grid=grid,
                start=grid.centre_of(0, 1),
                goal=grid.centre_of(6, 1),
                tensors=tensors,
                switch_cost=0.5,
            )
        )
    assert routes[0].to_json() == routes[1].to_json()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("cost", ["inverse", "length"])
def test_both_switching_graphs_cost_the_same_from_every_cell(seed, cost):
    """Policies of one kind of ground are nested, others overlap: both ways of changing are met."""
    tensors, grid, _, goal = random_problem(seed, policies=4)
    if seed % 2:
        tensors[1][tensors[0] > 0] = 0.6  # whatever 0 can, 1 can too
    layers = np.where(EIGHT.steps_within(grid.known) & (np.stack(tensors) >= 0.1), tensors, 0)
    search = Search(layers, 0.7, cost, RESOLUTION)
    end = grid.cell_of(*goal)
    _, distance = search._backwards(search._reversed(), end, end)
    graph = as_switching_networkx(layers, 0.7, cost=cost, resolution=RESOLUTION)
    cheapest = networkx.multi_source_dijkstra_path_length(
        graph.reverse(), [(*end, policy) for policy in range(4)]
    )
    for policy, ix, iy in np.ndindex(layers.shape[:3]):
        expected = cheapest.get((ix, iy, policy), np.inf)
        found = distance[np.ravel_multi_index((policy, ix, iy), layers.shape[:3])]
        assert found == pytest.approx(expected, abs=1e-9)


def test_a_change_of_policy_takes_one_edge_where_the_old_one_can_take_every_step():
    layers = np.ones((4, 30, 30, 8)) * EIGHT.steps_within(flat(30, 30).known)
    count = reversed_graph(layers, 1.0, "inverse", 0.1).nnz
    steps = np.count_nonzero(layers[0])
    assert count == 4 * steps + 4 * 3 * 900 and count < 0.4 * 4 * 4 * steps


@pytest.mark.parametrize(
    ("backend", "rooms", "what"),
    [
        ("scipy", [200_000], "planning over 40 x 40 cells"),
        ("scipy", [10**6, 200_000], "searching 40 x 40 cells with 12324 edges"),
        ("networkx", [10**6, 200_000], "a networkx graph of 40 x 40 cells"),
    ],
)
def test_a_map_too_large_for_the_memory_left_is_refused(monkeypatch, backend, rooms, what):
    monkeypatch.setattr(machine, "ALWAYS_LEFT", 0)
    monkeypatch.setattr(machine, "available_memory", iter(rooms).__next__)
    grid, tensor = flat(40, 40), np.ones((40, 40, 8))
    ends = {"start": grid.centre_of(0, 0), "goal": grid.centre_of(9, 9)}
    with pytest.raises(TooLargeError, match=rf"{what}.* 0.0002 GB are left: .*crop"):
        plan(tensor, np.zeros(tensor.shape), grid=grid, backend=backend, **ends)


def test_a_route_explains_itself():
    grid = flat(7, 3)
    tensors = [torch.from_numpy(tensor).float() for tensor in two_specialists()]
    fused, policy_map = fuse(tensors)
    route = plan(
        fused,
        policy_map,
        grid=grid,
        start=grid.centre_of(0, 1),
        goal=grid.centre_of(6, 1),
        tensors=tensors,
        ood=[torch.ones(7, 3, 8), torch.full((7, 3, 8), 0.25)],
        names=["walker", "climber"],
    )
    steps = route.explain()
    assert len(steps) == 6 and sum(step["share"] for step in steps) == pytest.approx(1)
    wall = steps[2]
    assert wall["policy"] == "climber" and wall["cost"] == 2 and wall["F_max"] == 0.5
    assert wall["F"] == {"walker": 0.0, "climber": 0.5}
    assert wall["w_ood"] == {"walker": 1.0, "climber": 0.25}
    assert directions.NAMES.index(wall["heading"]) in (7, 0, 1)
    assert json.loads(json.dumps(steps))[2]["policy"] == "climber"


def test_a_route_survives_json():
    tensors, grid, start, goal = random_problem(3)
    fused, policy_map = fuse(tensors)
    route = plan(fused, policy_map, grid=grid, start=start, goal=goal, tensors=tensors)
    again = Route.from_json(json.loads(json.dumps(route.to_json())))
    assert again.explain() == route.explain() and repr(again) == repr(route)
    assert (again.xy == route.xy).all() and again.length == route.length


@pytest.mark.parametrize(
    "damage", [{"cells": None}, {"headings": [0]}, {"costs": "many"}, {"length": None}]
)
def test_a_damaged_route_is_refused(damage):
    tensors, grid, start, goal = random_problem(3)
    fused, policy_map = fuse(tensors)
    data = plan(fused, policy_map, grid=grid, start=start, goal=goal).to_json()
    with pytest.raises(PlanningError, match="not a route"):
        Route.from_json(data | damage)


def test_the_readable_graph_holds_what_the_tensor_says():
    tensor = np.zeros((2, 2, 8))
    tensor[0, 0, 0], tensor[1, 0, 3], tensor[1, 1, 0] = 0.5, 0.2, 0.9  # the last leaves the map
    graph = as_networkx(tensor, np.full(tensor.shape, 4))
    assert sorted(graph.nodes) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert sorted(graph.edges) == [((0, 0), (1, 0)), ((1, 0), (0, 1))]
    assert graph.edges[(0, 0), (1, 0)] == {
        "weight": 2.0,
        "heading": 0,
        "policy": 4,
        "feasibility": 0.5,
    }
    diagonal = as_networkx(tensor, tensor, cost="length", resolution=0.1).edges[(1, 0), (0, 1)]
    assert diagonal["weight"] == pytest.approx(5 * 0.1 * 2**0.5)


def test_the_switching_graph_needs_both_policies():
    one, other = np.zeros((2, 2, 8)), np.zeros((2, 2, 8))
    one[0, 0, 0], other[0, 0, 0], other[0, 1, 0] = 0.5, 1.0, 1.0
    graph = as_switching_networkx(np.stack((one, other)), 3.0)
    assert {(tail, head): weight for tail, head, weight in graph.edges(data="weight")} == {
        ((0, 0, 0), (1, 0, 0)): 2.0,
        ((0, 0, 1), (1, 0, 0)): 5.0,
        ((0, 0, 1), (1, 0, 1)): 1.0,
        ((0, 0, 0), (1, 0, 1)): 4.0,
        ((0, 1, 1), (1, 1, 1)): 1.0,
    }
