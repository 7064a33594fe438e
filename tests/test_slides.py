"""The slides: their numbers are the pipeline's, and their pictures say what came out."""

import io

import networkx
import numpy as np
import pytest
import torch
from PIL import Image

from fgtutor.course.widgets.slide_curves import (
    advantages,
    draw_advantage,
    draw_label_window,
    draw_reward,
)
from fgtutor.course.widgets.slide_maps import Frontier, Survey, draw_pose
from fgtutor.course.widgets.slide_routes import SWITCH_COSTS, Familiarity, Gates, SwitchPrices
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
from fgtutor.feasibility import feasibility_labels
from fgtutor.fusion import fuse
from fgtutor.patches import PatchGrid
from fgtutor.planning import Plan, as_networkx, plan
from fgtutor.world.terrain import Terrain

START, GOAL = (0.05, 0.35), (1.15, 0.35)


def random_tensor(seed: int, shape=(12, 8), low=0.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, 1, (*shape, 8))


@pytest.fixture
def flat() -> ElevationMap:
    return ElevationMap(np.zeros((12, 8)))


def planned(tensors: list[np.ndarray], grid: ElevationMap) -> Plan:
    """A plan of policies a, b ..., each with its own tensor."""
    each = [torch.tensor(one, dtype=torch.float32) for one in tensors]
    fused, policy_map = fuse(each)
    names = tuple("abcdefgh"[: len(each)])
    answer = plan(fused, policy_map, grid=grid, start=START, goal=GOAL, tensors=each, names=names)
    return Plan(names, each, {}, fused, policy_map, answer)


# Curves -------------------------------------------------------------------------------------------


def test_the_reward_of_a_slide_is_worked_out():
    """exp(-|0.60 - 0.85| / 0.25) = exp(-1) = 0.37."""
    picture = draw_reward(0.25, 0.85, 0.60)
    assert picture.alt.endswith("r_v = exp(-0.25 / 0.25) = 0.37")
    assert picture.axes[0].get_title(loc="left") == "r_v = 0.37"


def test_the_label_of_a_slide_is_that_of_training():
    """The second moment sees 0.6, then the failure: (0.6 + 0 + 0) / 3."""
    r_v, failed, ended = [0.0, 0.9, 0.6, 0.0, 0.8, 0.8], [0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0]
    rows = np.array([r_v, failed, ended]).T
    labels, valid = feasibility_labels(torch.tensor(rows)[:, None], 3)
    for step in range(len(rows)):
        picture = draw_label_window(rows, 0.04, 3, step)
        told = f"label = {labels[step, 0]:.2f}" if valid[step, 0] else "no label"
        assert told in picture.alt
    assert "label = 0.20; after the failure" in draw_label_window(rows, 0.04, 3, 1).alt
    assert "after the failure" not in draw_label_window(rows, 0.04, 1, 0).alt
    for wrong, step in ((rows[:, :2], 0), (rows, 6), (rows, -1)):
        with pytest.raises(ConfigError, match="and a moment of it, got shape"):
            draw_label_window(wrong, 0.04, 3, step)


@pytest.mark.parametrize("lam", [0.0, 0.5, 0.95, 1.0])
def test_the_advantage_is_the_sum_that_it_is_defined_as(lam):
    rng = np.random.default_rng(2)
    rewards, values, gamma = rng.normal(size=9), rng.normal(size=10), 0.9
    surprise, advantage = advantages(rewards, values, gamma, lam)
    for t in range(9):
        delta = [rewards[k] + gamma * values[k + 1] - values[k] for k in range(t, 9)]
        assert surprise[t] == pytest.approx(delta[0])
        assert advantage[t] == pytest.approx(
            sum((gamma * lam) ** i * d for i, d in enumerate(delta))
        )
    assert "lambda" in draw_advantage(rewards, values, gamma, lam).alt
    with pytest.raises(ConfigError, match="T rewards and T \\+ 1 values"):
        advantages(rewards, values[:-1], gamma, lam)


# Maps ---------------------------------------------------------------------------------------------


def test_a_pose_says_what_stands_out():
    heights = np.zeros((40, 40))
    heights[20:] = 0.15  # from x = 2 m on
    picture = draw_pose(ElevationMap(heights), PatchGrid(), 1.5, 2.0, 0.0)
    assert "-0.00 to +0.15 m" in picture.alt or "+0.00 to +0.15 m" in picture.alt
    assert [axes.get_xlabel() for axes in picture.axes] == ["x (m)", "ahead (m)"]
    behind = draw_pose(ElevationMap(heights), PatchGrid(), 1.5, 2.0, 180.0)
    assert behind.alt != picture.alt


def test_a_search_settles_cells_as_networkx_does(flat):
    F = random_tensor(3, low=0.15)
    frontier = Frontier(flat, F, START, GOAL)
    graph = as_networkx(F, np.zeros(F.shape, dtype=int), cost="length", resolution=0.1)
    cost = networkx.single_source_dijkstra_path_length(graph, flat.cell_of(*START))
    for cell, value in cost.items():
        assert frontier.cost[np.ravel_multi_index(cell, flat.shape)] == pytest.approx(value)
    for search, order in frontier.orders.items():
        assert order[0] == frontier.start and order[-1] == frontier.goal, search
        settled, edge = frontier.stopped(search, len(order) // 2)
        assert settled.sum() == len(order) // 2 and not (settled & edge).any()
        named = {np.unravel_index(i, flat.shape) for i in np.flatnonzero(settled)}
        around = {head for tail in named for head in graph[tail]} - named
        assert around == {np.unravel_index(i, flat.shape) for i in np.flatnonzero(edge)}
        for cell in named:  # a cell is settled after the one that it is reached from
            path = frontier.path_to(int(np.ravel_multi_index(cell, flat.shape)))
            assert all(flat.cell_of(*point) in named for point in path)


def test_a_star_settles_no_more_than_dijkstra_and_ends_at_the_same_cost(flat):
    F = random_tensor(4, low=0.5)
    orders = Frontier(flat, F, START, GOAL).orders
    assert set(orders["A*"]) <= set(orders["Dijkstra"])
    assert len(orders["A*"]) < len(orders["Dijkstra"])


def test_a_search_says_how_far_it_is(flat):
    frontier = Frontier(flat, np.ones((12, 8, 8)), START, GOAL)
    assert "Dijkstra: 1 of 96 reachable cells settled" in frontier.draw("Dijkstra", 0).alt
    done = frontier.draw("A*", 100).alt
    assert "the goal is settled, cost 1.10" in done  # 11 steps of 0.1 m at F = 1
    with pytest.raises(ConfigError, match="no chain of steps"):
        Frontier(flat, np.zeros((12, 8, 8)), START, GOAL)
    with pytest.raises(ConfigError, match="F_max has shape"):
        Frontier(flat, np.ones((8, 12, 8)), START, GOAL)


def test_a_survey_knows_more_with_every_pose():
    rng = np.random.default_rng(0)
    ground = ElevationMap(rng.choice([0.0, 0.1], (30, 20)), resolution=0.1)
    terrain = Terrain.from_elevation(ground, (0.5, 1.0), (2.5, 1.0), robot="a1")
    poses = np.array([(x, 1.0, 1.3, np.pi, 0.7, 0.0) for x in (0.5, 1.5, 2.5)])
    survey = Survey(terrain, poses)
    known = [int(survey.mapped(count).known.sum()) for count in (1, 2, 3)]
    assert known == sorted(known) and known[0] < known[2]
    alt = survey.draw(2).alt
    assert alt.startswith(f"2 poses, {len(survey.clouds[0]) + len(survey.clouds[1]):,} points")


# Routes -------------------------------------------------------------------------------------------


def test_the_dearer_a_switch_the_fewer_of_them(flat):
    tensors = [random_tensor(seed, low=0.3) for seed in (5, 6, 7)]
    given = planned(tensors, flat)
    prices = SwitchPrices(flat, given, START, GOAL)
    switches = [prices.routes[cost].switches for cost in SWITCH_COSTS]
    ground = [prices.ground_cost(cost) for cost in SWITCH_COSTS]
    assert switches == sorted(switches, reverse=True) and switches[0] > switches[-1]
    assert np.all(np.diff(ground) >= -1e-9)  # fewer switches are paid for with harder ground
    picture = prices.draw(0.5)
    assert f"{prices.routes[0.5].switches} switches" in picture.alt
    closed = planned([0 * one for one in tensors], flat)
    with pytest.raises(ConfigError, match="no route at every price"):
        SwitchPrices(flat, closed, START, GOAL)


def test_a_higher_limit_closes_gates(flat):
    F = np.full((12, 8, 8), 0.9)
    F[6] = 0.05
    F[6, 3], F[6, 7] = 0.3, 0.7  # a hard gate on the straight way, an easy one aside
    gates = Gates(flat, {"late": F}, START, GOAL)
    near, far = gates.answer("late", 0.2), gates.answer("late", 0.5)
    assert near.length < far.length and not gates.answer("late", 0.8)
    assert "late no route" in gates.draw(0.8).alt
    assert f"late {far.length:.1f} m" in gates.draw(0.5).alt
    with pytest.raises(ConfigError, match="at least one tensor"):
        Gates(flat, {}, START, GOAL)


def test_along_a_route_the_weights_are_those_of_its_cells(flat):
    given = planned([random_tensor(8, low=0.3)], flat)
    weights = {"a": random_tensor(9), "b": random_tensor(10)}
    familiarity = Familiarity(given.route, flat, weights)
    for i, (cell, heading) in enumerate(
        zip(given.route.cells[:-1], given.route.headings, strict=True)
    ):
        assert familiarity.along["b"][i] == weights["b"][(*cell, heading)]
    last = familiarity.draw(given.route.length).alt
    assert f"a {familiarity.along['a'][-1]:.2f}" in last
    with pytest.raises(ConfigError, match="at least one policy"):
        Familiarity(given.route, flat, {})


# Widgets ------------------------------------------------------------------------------------------


@pytest.fixture
def slides():
    """The module of the widgets, which needs the lab extra."""
    pytest.importorskip("ipywidgets", reason="the lab extra is not installed: make test does")
    pytest.importorskip("anywidget", reason="the lab extra is not installed: make test does")
    from fgtutor.course.widgets import slides

    return slides


def test_a_slide_follows_its_sliders_and_brings_a_picture(slides):
    slide = slides.TrackingSlides()
    before = slide.image.value
    slide.controls["speed"].value = 0.85
    assert slide.image.value != before and slide.status.value.endswith("= 1.00")
    assert slide.status.value == slide.still().alt
    data, words = slide._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in data
    assert words == {"image/png": {"alt": slide.status.value}}
    assert Image.open(io.BytesIO(slide.image.value)).size == (760, 300)


def test_every_slide_opens(slides, flat):
    tensors = [random_tensor(seed, low=0.3) for seed in (5, 6)]
    given = planned(tensors, flat)
    rows = np.stack((np.full(20, 0.8), np.eye(20)[9], np.eye(20)[9]), axis=-1)
    opened = (
        slides.PatchSlides(flat, PatchGrid()),
        slides.LabelSlides(rows, 0.1),
        slides.FrontierSlides(flat, given.fused, START, GOAL),
        slides.SwitchSlides(flat, given, START, GOAL),
        slides.AdvantageSlides([1.0, 0.0], [1.0, 1.0, 0.0]),
        slides.GateSlides(flat, {"late": tensors[0]}, START, GOAL),
        slides.RouteSlides(given.route, flat, {"a": tensors[0]}),
    )
    for slide in opened:
        assert slide.status.value and bytes(slide.image.value[:4]) == b"\x89PNG", type(slide)
        assert all(axes.get_ylabel() or axes.get_xlabel() for axes in slide.still().axes)


def test_what_goes_wrong_while_sliding_is_said(slides):
    def draw(x):
        if x > 0.5:
            raise ConfigError("too far: move it back")
        return slides.draw_reward(0.25, 0.85, x)

    slide = slides.Slides(draw, x=slides.slider(0.0, 0.0, 1.0, 0.1, "x"))
    kept = slide.image.value
    slide.controls["x"].value = 0.9
    assert slide.status.value == "too far: move it back" and slide.image.value == kept
