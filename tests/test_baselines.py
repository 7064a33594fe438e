import math
from functools import partial

import numpy as np
import pytest
import torch

from fgtutor.baselines import (
    AssessedMap,
    Classical,
    OccupancyConfig,
    Switched,
    TraversabilityConfig,
    find_route,
    occupancy,
    ours,
    planners,
    single,
    traversability,
    without_fusion,
    without_heading,
    without_ood,
)
from fgtutor.directions import Headings
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, DoubtfulRouteError
from fgtutor.feasibility import OodScore
from fgtutor.planning import PAPER, SURE, Refusal
from fgtutor.routes import HAZARD, RELIEF
from fgtutor.tensorization import Assessment, assess_all, tensorize

RADIUS = 0.1
TAUS = (1.0, 3.0)


def ground(heights, resolution=0.1):
    return ElevationMap(np.asarray(heights, dtype=float), resolution=resolution)


def ramp(slope, shape=(12, 9), resolution=0.1):
    x = (np.arange(shape[0]) + 0.5) * resolution
    return ground(np.repeat(slope * x[:, None], shape[1], axis=1), resolution)


def wall(height, n=15):
    """A low place and a high one, the edge between cells 7 and 8 along x."""
    return ground(np.repeat(np.where(np.arange(n) < 8, 0.0, height)[:, None], 11, axis=1))


def test_flat_ground_is_wholly_traversable_and_free():
    flat = ground(np.full((9, 7), 3.0))
    assert traversability(flat, RADIUS) == pytest.approx(np.ones((9, 7)))
    assert occupancy(flat, RADIUS).tolist() == np.ones((9, 7)).tolist()


def test_a_ramp_costs_its_slope_only():
    # A rise of 0.5 m a metre is atan 0.5 = 0.4636 rad of the critical 1.0; a plane is not rough,
    # and its steps of 0.1 m over a window of three cells are not critical: (0.5364 + 1 + 1) / 3.
    inner = traversability(ramp(0.5), RADIUS)[3:-3, 3:-3]
    assert inner == pytest.approx(np.full(inner.shape, (1 - math.atan(0.5) + 2) / 3))


def test_a_slope_beyond_the_critical_one_is_closed():
    assert traversability(ramp(2.0), RADIUS)[3:-3, 3:-3].max() == 0  # atan 2 = 1.107 rad


def test_roughness_by_hand():
    # One cell 0.03 m above eight others: the mean is 0.03 / 9 and the sum of squared deviations
    # 0.03^2 - 9 (0.03 / 9)^2 = 0.0008. The plane there is level, so the standard deviation is
    # sqrt(0.0008 / 8) = 0.01 m, a fifth of the critical 0.05.
    heights = np.zeros((9, 9))
    heights[4, 4] = 0.03
    alone = traversability(ground(heights), radius=0.0)
    assert alone[4, 4] == pytest.approx((1 + 1 + 0.8) / 3)
    # For its neighbour along x the plane leans by 0.03 * 0.1 / 0.06 = 0.05, and explains 0.05^2 *
    # 0.06 = 0.00015 of the 0.0008; distances along the normal are shorter by cos atan 0.05.
    deviation = math.sqrt(0.00065 / 8 / (1 + 0.05**2))
    assert alone[5, 4] == pytest.approx((1 - math.atan(0.05) + 1 + 1 - deviation / 0.05) / 3)


def test_a_high_step_closes_the_cells_beside_it_and_a_low_one_does_not():
    high = traversability(wall(0.20), radius=0.0)
    # Cells 7 and 8 have the edge in their window. Cells 6 and 9 have three such neighbours, one
    # less than the critical four: 3/4 * 0.20 = 0.15 m, which still exceeds the critical 0.12.
    assert (high[:, 5] == 0).nonzero()[0].tolist() == [6, 7, 8, 9]
    low = traversability(wall(0.10), radius=0.0)
    assert (low > 0.5).all()


def test_a_wider_robot_keeps_further_away():
    assert (traversability(wall(0.20), radius=0.2)[:, 5] == 0).nonzero()[0].tolist() == [
        *range(4, 12)
    ]


def test_classical_costs_rotate_with_the_map():
    rng = np.random.default_rng(0)
    rough = ground(rng.random((12, 9)) * 0.1)
    for cells in (traversability, occupancy):
        turned = cells(rough.rotated90(), 0.15)
        assert turned == pytest.approx(np.rot90(cells(rough, 0.15)))


def test_inflation_by_hand():
    # Cells 7 and 8 are lethal. Cell 6 is 0.1 m away, at the inscribed radius: closed. Cell 5 at
    # 0.2 m: 252 exp(-10 * 0.1) = 92.7, F = 50 / (50 + 0.8 * 92.7); cell 1 at 0.6 m: beyond 0.55.
    inflated = occupancy(wall(0.16), radius=0.1)[:, 5]
    assert inflated[6:10].tolist() == [0, 0, 0, 0]
    assert inflated[5] == inflated[10] == pytest.approx(50 / (50 + 0.8 * 252 * math.exp(-1)))
    assert inflated[2] == pytest.approx(50 / (50 + 0.8 * 252 * math.exp(-4)))
    assert inflated[1] == 1
    assert occupancy(wall(0.10), radius=0.1).min() == 1  # no obstacle at all


def test_thresholds_are_settings():
    strict = TraversabilityConfig(step=0.05)
    assert traversability(wall(0.10), RADIUS, strict).min() == 0
    assert occupancy(wall(0.10), RADIUS, OccupancyConfig(step=0.05)).min() == 0


@pytest.fixture
def assessed(make_specialist):
    """Three untrained policies on bumpy ground with one unknown cell."""
    rng = np.random.default_rng(1)
    heights = rng.random((10, 8)) * 0.05
    heights[2, 3] = np.nan
    zoo = {name: make_specialist(name, seed=i) for i, name in enumerate(("gaps", "steps"))}
    zoo["general"] = make_specialist("general", seed=7)
    return AssessedMap(ground(heights), zoo, "calibrated")


def test_the_generalist_is_assessed_only_where_it_is_asked_for(assessed, monkeypatch):
    asked = []

    def noted(elevation, zoo, **options):
        asked.append(sorted(zoo))
        return assess_all(elevation, zoo, **options)

    monkeypatch.setattr("fgtutor.baselines.assess_all", noted)
    assessed.tensors("steps"), assessed.tensors("gaps")
    assert asked == [["gaps", "steps"]]
    assessed.tensors("general")
    assert asked == [["gaps", "steps"], ["general"]]


def test_an_assessed_map_gives_what_tensorize_gives_and_computes_it_once(assessed, monkeypatch):
    for name, specialist in assessed.zoo.items():
        expected = tensorize(assessed.elevation, specialist, taus="calibrated")
        assert torch.equal(assessed.tensors(name)[name], expected)
    monkeypatch.setattr("fgtutor.baselines.assess_all", None)  # a second call would fail
    assert list(assessed.tensors()) == ["gaps", "steps"]
    assert assessed.specialists == ["gaps", "steps"]
    assert assessed.radius == 0.1


def by_hand(elevation, f, reconstruction):
    """Return an assessment by `TAUS` of constants, or of one number per heading."""
    shape = (*elevation.shape, 8)
    return Assessment(f.expand(shape), reconstruction.expand(shape), elevation, OodScore(TAUS))


@pytest.fixture
def known(assessed):
    """gaps: f 0.9 but unfamiliar (w_ood = 0.5); steps: f 0.8 along +x only, else 0.4; familiar."""
    flat = ground(np.zeros((10, 8)))
    along_x = torch.full((8,), 0.4)
    along_x[0] = 0.8
    f = {"gaps": torch.tensor(0.9), "steps": along_x, "general": torch.tensor(0.6)}
    # Eq. 4 with tau 1 and 3: a loss of 2 lies half way.
    loss = {"gaps": torch.tensor(2.0), "steps": torch.tensor(0.0), "general": torch.tensor(0.0)}
    numbers = {name: by_hand(flat, f[name], loss[name]) for name in f}
    return AssessedMap(flat, assessed.zoo, TAUS, 8, numbers)


def inner(layers, name):
    """One cell in the middle of a layer, over the headings."""
    return layers[name][5, 4].tolist()


def test_parts_left_out_by_hand(known):
    (fused,) = ours(known)
    assert inner(fused, "gaps") == pytest.approx([0.45] * 8)
    assert inner(fused, "steps") == pytest.approx([0.8] + [0.4] * 7)
    (believed,) = without_ood(known)
    assert inner(believed, "gaps") == pytest.approx([0.9] * 8)
    (blind,) = without_heading(known)
    # On the border headings that leave the map count as 0; in the middle (0.8 + 7 * 0.4) / 8.
    assert inner(blind, "steps") == pytest.approx([0.45] * 8)
    assert [list(layers) for layers in without_fusion(known)] == [["gaps"], ["steps"]]
    (alone,) = single("general", known)
    assert inner(alone, "general") == pytest.approx([0.6] * 8)


def test_each_planner_drives_with_its_policies(known):
    def drivers(planner, start=(0.15, 0.45), goal=(0.85, 0.45)):
        route = find_route(planner, known, start, goal, PAPER)
        return [route.names[i] for i in route.policies], route.cost

    # Along +x: steps at 0.8; without w_ood gaps believes 0.9.
    assert drivers(ours) == (["steps"] * 7, pytest.approx(7 / 0.8))
    assert drivers(without_ood) == (["gaps"] * 7, pytest.approx(7 / 0.9))
    assert drivers(without_fusion) == (["steps"] * 7, pytest.approx(7 / 0.8))
    # Back along -x: gaps at 0.45 beats 0.4; without fusion it is one policy, the cheaper one.
    assert drivers(ours, (0.85, 0.45), (0.15, 0.45)) == (["gaps"] * 7, pytest.approx(7 / 0.45))
    flat = Classical(traversability)
    assert drivers(flat) == (["general"] * 7, pytest.approx(7.0))
    # On a flat classical map a diagonal step costs as much as a straight one: any way will do, and
    # P says who drives it.
    switched = find_route(Switched(traversability), known, (0.15, 0.45), (0.85, 0.45), PAPER)
    wanted = ["gaps" if heading else "steps" for heading in switched.headings]
    assert [switched.names[i] for i in switched.policies] == wanted
    assert switched.cost == pytest.approx(7.0)
    # By our own settings, too, where a change costs something: the classical map knows of none.
    ends = (0.15, 0.25), (0.85, 0.55)
    dear, alone = (find_route(p, known, *ends) for p in (Switched(traversability), flat))
    assert {dear.names[i] for i in dear.policies} == {"steps", "gaps"}
    assert dear.length == pytest.approx(alone.length)


def test_a_classical_map_refuses_what_a_specialist_crosses(known):
    elevation = wall(0.16, n=10)
    numbers = {"steps": by_hand(elevation, torch.tensor(0.8), torch.tensor(0.0))}
    high = AssessedMap(elevation, known.zoo, TAUS, 8, numbers)
    steps = partial(single, "steps")
    assert find_route(steps, high, (0.15, 0.5), (0.95, 0.5)).names == ("steps",)
    for cells in (traversability, occupancy):
        answer = find_route(Classical(cells), high, (0.15, 0.5), (0.95, 0.5))
        assert isinstance(answer, Refusal) and "no policy can" in answer.reason


def test_routes_of_a_classical_map_need_promise_nothing(known):
    """Its F is a cost in disguise: near a wall it is low, and the robot is none the worse. A mean
    over the headings is no step's F either."""

    def near_walls(elevation, radius):
        return np.full(elevation.shape, 0.12)

    ends = (0.15, 0.45), (0.85, 0.45)
    route = find_route(Classical(near_walls), known, *ends)
    assert route.promise < 0.1 and route.length == pytest.approx(0.7)
    known._known["steps"] = by_hand(known.elevation, torch.tensor(0.12), torch.tensor(0.0))
    known._known["gaps"] = by_hand(known.elevation, torch.tensor(0.12), torch.tensor(0.0))
    assert find_route(without_heading, known, *ends).promise < 0.1
    low = [{"steps": torch.full((*known.elevation.shape, 8), 0.12)}]
    answer = find_route(lambda ground: low, known, *ends, finer_headings=8)
    assert isinstance(answer.error, DoubtfulRouteError)


def test_finer_headings_are_tried_where_the_others_find_no_route(known):
    """A ground that is feasible along +2x+y and back only."""

    def askew(ground):
        headings = Headings(ground.headings)
        tensor = torch.zeros(*ground.elevation.shape, headings.count)
        for step in ((2, 1), (-2, -1)):
            tensor[..., (headings.steps == step).all(axis=-1)] = 0.9
        return [{"steps": torch.from_numpy(headings.least(tensor.numpy()))}]

    ends = (0.15, 0.25), (0.75, 0.55)
    route = find_route(askew, known, *ends)
    assert route.num_headings == 48 and route.length == pytest.approx(0.3 * math.sqrt(5))
    assert find_route(askew, known, *ends, finer_headings=16).num_headings == 16
    assert not find_route(askew, known, *ends, finer_headings=8)
    assert not find_route(askew, known.along(16), (0.15, 0.25), (0.15, 0.75))

    def doubtful(ground):
        """The same, and a chance along the axes."""
        tensor = askew(ground)[0]["steps"]
        along = (Headings(ground.headings).steps == 0).any(axis=-1)
        tensor[..., along] = 0.2
        return [{"steps": tensor}]

    # Along the eight a route promises 0.4; along the 48 nearly 1, and that one is taken.
    coarse = find_route(doubtful, known, *ends, finer_headings=8)
    assert coarse.promise == pytest.approx(math.exp(-0.9 * math.exp(HAZARD - RELIEF * 0.2)))
    assert 0.25 < coarse.promise < SURE
    assert find_route(doubtful, known, *ends).num_headings == 48
    # Where none is surer, or any will do, the first one stands.
    brave = {"least_promise": 0.0}
    assert find_route(doubtful, known, *ends, **brave).num_headings == 8

    def level(ground):
        return [{"steps": torch.full((*ground.elevation.shape, ground.headings), 0.2)}]

    level_route = find_route(level, known, (0.15, 0.25), (0.95, 0.25))
    assert 0.25 < level_route.promise < SURE and level_route.num_headings == 8
    assert known.along(48) is known.along(48)


def test_planners_are_those_that_the_zoo_allows(assessed):
    everyone = list(planners(assessed.zoo))
    assert everyone[:4] == ["gaps", "steps", "ours", "general"]
    specialists = {name: assessed.zoo[name] for name in assessed.specialists}
    assert set(everyone) - set(planners(specialists)) == {"general", "traversability", "occupancy"}
    with pytest.raises(ConfigError, match="zoo is empty"):
        find_route(without_fusion, AssessedMap(assessed.elevation, {}), (0.1, 0.1), (0.5, 0.5))


def test_a_diagonal_step_costs_its_length_if_asked_to(assessed):
    flat = AssessedMap(ground(np.zeros((12, 12))), assessed.zoo, "calibrated")

    def uniform(ground):
        return [{"steps": torch.full((12, 12, 8), 0.5)}]

    ends = (0.25, 0.25), (0.75, 0.75)  # five cells along each axis
    counted = find_route(uniform, flat, *ends, cost="inverse")
    measured = find_route(uniform, flat, *ends)
    assert counted.cost == pytest.approx(5 / 0.5)
    assert measured.cost == pytest.approx(5 * 0.1 * np.sqrt(2) / 0.5)
