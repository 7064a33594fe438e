"""The explorer behind the tau sliders: its numbers are the pipeline's; its pictures."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb

from fgtutor import directions
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.panels import on_picture, unknown_boxes, upright
from fgtutor.course.widgets.scene_figure import scene_figure
from fgtutor.course.widgets.tau_pictures import TAU_CHOICES, TauPictures, tau_figure
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, OffMapError, ThresholdError
from fgtutor.feasibility import ood_weight
from fgtutor.figures import maps, panels, style
from fgtutor.planning import plan_on_map
from fgtutor.settings import PAPER, PlanSettings
from fgtutor.tensorization import Assessment

NAMES = ("steps", "gaps", "slopes")


def made(f: np.ndarray, loss: np.ndarray, grid: ElevationMap) -> Assessment:
    return Assessment(torch.tensor(f).float(), torch.tensor(loss).float(), grid)


def random_world(seed: int, shape=(9, 7), unknown: int = 3) -> tuple[ElevationMap, dict]:
    """A map with some cells never observed, and what three specialists say of it."""
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, 0.1, shape)
    heights.flat[rng.choice(heights.size, unknown, replace=False)] = np.nan
    grid = ElevationMap(heights, resolution=0.5, origin=(-1.0, 2.0))
    layers = (*shape, 8)
    said = {name: made(rng.uniform(0, 1, layers), rng.gamma(1, 1, layers), grid) for name in NAMES}
    return grid, said


def corners(grid: ElevationMap) -> tuple[tuple[float, float], tuple[float, float]]:
    known = np.argwhere(grid.known)
    return grid.centre_of(*known[0].tolist()), grid.centre_of(*known[-1].tolist())


# Numbers and routes -----------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    low=st.floats(0, 2),
    width=st.floats(0.05, 5),
    policies=st.sets(st.sampled_from(NAMES), min_size=1),
    f_min=st.floats(0.01, 0.5),
    switch_cost=st.sampled_from([0.0, 0.2, 5.0]),
)
def test_policies_that_may_not_drive_change_no_number_of_the_others(
    seed, low, width, policies, f_min, switch_cost
):
    """The route is that of a map which only the chosen policies were asked about."""
    grid, said = random_world(seed)
    single = {"taus": (low, low + width), "f_min": f_min, "switch_cost": switch_cost}
    explorer = Explorer(grid, said, *corners(grid), policies=tuple(policies), **single)
    team = {name: said[name] for name in NAMES if name in policies}
    alone = Explorer(grid, team, *corners(grid), **single)
    np.testing.assert_array_equal(explorer.plan.fused, alone.plan.fused)
    assert explorer.status == alone.status
    for i, name in enumerate(NAMES):
        f = said[name].weighted(low, low + width)
        np.testing.assert_array_equal(explorer.plan.tensors[i], f if name in policies else 0 * f)
        np.testing.assert_array_equal(explorer.plan.weights[name], said[name].ood(low, low + width))


@pytest.mark.parametrize("settings", [PlanSettings(), PAPER])
def test_the_route_is_that_of_plan_on_map(make_rolling, settings):
    zoo = {"sure": make_rolling("sure", f=0.9), "unsure": make_rolling("unsure", f=0.3)}
    grid = ElevationMap(np.random.default_rng(0).normal(0, 0.02, (30, 20)))
    start, goal = (0.5, 1.0), (2.5, 1.0)
    explorer = Explorer(grid, zoo, start, goal, settings)
    plan = plan_on_map(grid, zoo, start, goal, settings=settings)
    assert explorer.route is not None
    assert explorer.route.to_json() == plan.route.to_json()
    for name, weight in plan.weights.items():
        np.testing.assert_array_equal(explorer.plan.weights[name], weight)


def test_a_switch_in_the_middle_is_paid_once():
    """Two policies, each at home on one half of 40 x 30 cells."""
    grid = ElevationMap(np.zeros((40, 30)))
    f = np.full((2, 40, 30, 8), 0.3, dtype=np.float32)
    f[0, :20], f[1, 20:] = 0.9, 0.9
    said = {name: made(own, 0 * own, grid) for name, own in zip(NAMES, f, strict=False)}
    explorer = Explorer(grid, said, grid.centre_of(2, 15), grid.centre_of(37, 15), switch_cost=2.0)
    # 35 steps of 0.1 m at 1 / 0.9 per m, one switch: 3.889 + 2.
    assert explorer.status == (
        "tau calibrated: cost 5.89, 3.50 m, policy switches: 1 (steps 1.8 m, gaps 1.7 m)"
    )


def test_every_update_is_as_if_new():
    grid, said = random_world(7, unknown=0)
    moved = Explorer(grid, said, *corners(grid))
    for changes in (
        {"taus": (0.2, 3.0)},
        {"start": grid.centre_of(4, 3)},
        {"policies": NAMES[1:]},
        {"goal": grid.centre_of(8, 0), "f_min": 0.05},
        {"switch_cost": 2.0},
        {"policies": NAMES, "switch_cost": 0.0, "taus": "paper"},
        {"start": grid.centre_of(0, 6)},
    ):
        moved.update(**changes)
        fresh = Explorer(
            grid, said, moved.start, moved.goal, moved.settings, policies=moved.policies
        )
        assert moved.status == fresh.status
        np.testing.assert_array_equal(moved.plan.fused, fresh.plan.fused)
        np.testing.assert_array_equal(moved.plan.policy_map, fresh.plan.policy_map)


def test_no_route_is_said_not_raised():
    grid, said = random_world(1)
    explorer = Explorer(grid, said, *corners(grid), taus="paper")
    explorer.update(goal=grid.centre_of(*np.argwhere(~grid.known)[0].tolist()))
    assert explorer.route is None and "never observed" in explorer.status
    explorer.update(policies=())
    assert explorer.status == "tau paper: No policy may drive: tick at least one"
    explorer.update(policies=NAMES, goal=corners(grid)[1])
    assert explorer.route is not None


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"taus": (2.0, 1.0)}, ThresholdError, "tau_low < tau_high, got 2.0 and 1.0"),
        ({"taus": (0.0, float("nan"))}, ConfigError, "taus"),
        ({"policies": ("skates",)}, ConfigError, "no policy skates; there are steps, gaps, slopes"),
        ({"f_min": 0.0}, ConfigError, "f_min"),
        ({"switch_cost": -1.0}, ConfigError, "switch_cost"),
        ({"goal": (99.0, 99.0)}, OffMapError, "is off the map"),
    ],
)
def test_settings_without_meaning_are_refused_and_change_nothing(changes, error, words):
    grid, said = random_world(2)
    explorer = Explorer(grid, said, *corners(grid))
    before = explorer.settings, explorer.policies, explorer.goal, explorer.status
    fused = explorer.plan.fused.clone()
    with pytest.raises(error, match=words):
        explorer.update(**changes)
    now = explorer.settings, explorer.policies, explorer.goal, explorer.status
    assert now == before
    np.testing.assert_array_equal(explorer.plan.fused, fused)


def test_an_explorer_needs_a_zoo_of_its_map():
    grid, said = random_world(3)
    with pytest.raises(ConfigError, match="at least one specialist"):
        Explorer(grid, {}, (0, 3), (1, 3))
    with pytest.raises(ConfigError, match=r"'steps' has shape \(9, 7, 8\).*\(7, 9, 8\)"):
        Explorer(grid.rotated90(), said, (0, 3), (1, 3))


def test_hovering_reads_a_cells_numbers():
    grid, said = random_world(5, unknown=0)
    explorer = Explorer(grid, said, *corners(grid))
    lines = explorer.read((3, 2)).splitlines()
    # Resolution 0.5 from (-1, 2): the centre is (-1 + 3.5 / 2, 2 + 2.5 / 2).
    assert lines[0].startswith("cell (3, 2)   x 0.75 m, y 3.25 m, height")
    assert lines[1].split() == ["heading", *directions.NAMES]
    table = {line[:11].strip(): line[11:].split() for line in lines[1:]}
    assert table["L gaps"] == [f"{v:.2f}" for v in said["gaps"].reconstruction[3, 2].tolist()]
    assert table["F_max"] == [f"{v:.2f}" for v in explorer.plan.fused[3, 2].tolist()]
    assert table["P"] == [NAMES[i] for i in explorer.plan.policy_map[3, 2]]
    with pytest.raises(ConfigError, match=r"no cell \(9, 0\) on a map of 9 x 7"):
        explorer.read((9, 0))


# Scenes -------------------------------------------------------------------------------------------


def test_a_scene_has_the_figures_colours():
    grid, said = random_world(6)
    explorer = Explorer(grid, said, *corners(grid), taus=(0.1, 3.0), f_min=0.95)
    scene = TauPictures(explorer).scene()
    unknown = upright(~grid.known)

    def compare(key: str, figure) -> None:
        drawn = np.asarray(figure.axes[0].images[0].get_array())[::-1] * 255
        np.testing.assert_allclose(scene.pictures[key][~unknown], drawn[~unknown], atol=2.1)

    compare("M", maps.draw_elevation(grid))
    compare("P", maps.draw_policy_map(explorer.plan.policy_map, explorer.plan.fused, grid, NAMES,
                                         f_min=0.95))  # fmt: skip
    for name in NAMES:
        compare(f"w {name}", maps.draw_weight(explorer.plan.weights[name], grid, name))
    for picture in scene.pictures.values():
        assert picture.shape == (7, 9, 3) and picture.dtype == np.uint8
        assert np.abs(picture[unknown] / 255 - to_rgb(panels.UNKNOWN)).max() < 0.01
    blocked = upright(explorer.best[0] < 0.95) & ~unknown
    assert 0 < blocked.sum() < blocked.size
    assert np.abs(scene.pictures["F"][blocked] / 255 - to_rgb(maps.BLOCKED)).max() < 0.01


def test_pictures_have_x_to_the_right_and_y_up():
    cells = np.zeros((3, 2))
    cells[2, 0] = 1  # x large, y small: lower right
    assert np.argwhere(upright(cells)).tolist() == [[1, 2]]
    assert on_picture(np.array([[2, 0]]), 2) == [(2.5, 1.5)]


def test_a_route_is_cut_where_the_policy_changes():
    grid = ElevationMap(np.zeros((4, 2)))
    f = np.zeros((2, 4, 2, 8), dtype=np.float32)
    f[0, :2, 0, 0], f[1, 2:, 0, 0] = 0.9, 0.8
    said = {name: made(own, 0 * own, grid) for name, own in zip(NAMES, f, strict=False)}
    explorer = Explorer(grid, said, (0.05, 0.05), (0.35, 0.05), switch_cost=0.0)
    scene = TauPictures(explorer).scene()
    assert list(scene.lines) == [
        (style.POLICY_COLOURS["steps"], [(0.5, 1.5), (1.5, 1.5), (2.5, 1.5)]),
        (style.POLICY_COLOURS["gaps"], [(2.5, 1.5), (3.5, 1.5)]),
    ]
    assert scene.marks == {"start": (0.5, 1.5), "goal": (3.5, 1.5)}
    explorer.update(goal=explorer.start)
    assert not TauPictures(explorer).scene().lines
    assert explorer.status.endswith("cost 0.00, 0.00 m, policy switches: 0")


def test_a_policy_taken_away_loses_its_colour():
    grid, said = random_world(6)
    explorer = Explorer(grid, said, *corners(grid), taus=(0.1, 9.0), policies=("steps", "slopes"))
    scene = TauPictures(explorer).scene()
    grey = scene.pictures["w gaps"].astype(int)
    assert (grey.max(axis=-1) == grey.min(axis=-1)).all()
    colourful = scene.pictures["w steps"].astype(int)
    assert (colourful.max(axis=-1) - colourful.min(axis=-1)).max() > 50
    titles = [panel.title for panel in scene.rows[1]]
    assert titles == ["w_ood of steps", "w_ood of gaps, taken away", "w_ood of slopes"]
    assert scene.charts[1].colour == "#999999" != scene.charts[0].colour


@pytest.mark.parametrize("taus", [(0.3, 1.0), "paper"])
def test_a_chart_counts_the_losses_and_weighs_them(taus):
    grid, said = random_world(6, shape=(30, 20))
    explorer = Explorer(grid, said, *corners(grid), taus=taus)
    chart = TauPictures(explorer).scene().charts[0]
    assert sum(chart.shares) == pytest.approx(1)
    low, high = chart.span
    losses = said["steps"].reconstruction.numpy()[grid.known]
    half = 10 ** ((low + high) / 2)
    below = sum(chart.shares[: len(chart.shares) // 2])
    assert below == pytest.approx((losses < half).mean(), abs=0.002)
    at = np.logspace(low, high, len(chart.weights))
    pair = (0.1, 2.0) if taus == "paper" else taus
    np.testing.assert_allclose(chart.weights, ood_weight(at, *pair), atol=1e-4)
    assert chart.home == []  # numbers made by hand have no ground of their own


def test_a_calibrated_chart_knows_the_policys_own_ground(make_specialist):
    grid = ElevationMap(np.random.default_rng(0).normal(0, 0.05, (30, 20)))
    specialist = make_specialist("steps")
    explorer = Explorer(grid, {"steps": specialist}, *corners(grid), taus="calibrated")
    chart = TauPictures(explorer).scene().charts[0]
    own = specialist.quantiles
    assert chart.home == [
        pytest.approx(np.log10(own[p])) for p in ("0.5", "0.9", "0.99") if p in own
    ]
    assert chart.weights[0] == 1 and chart.weights == sorted(chart.weights, reverse=True)


def test_unknown_cells_are_hatched_where_they_lie():
    heights = np.zeros((5, 4))
    heights[1:3, 3] = heights[4, 0] = np.nan
    grid = ElevationMap(heights)
    # The last y is the upper row of the picture, the first y the lowest of its four.
    assert unknown_boxes(grid) == [(1.0, 0.0, 3.0, 1.0), (4.0, 3.0, 5.0, 4.0)]


def test_the_scene_on_a_page_has_its_panels_and_metres():
    grid, said = random_world(6)
    explorer = Explorer(grid, said, *corners(grid), taus=(0.1, 3.0))
    scene = TauPictures(explorer).scene()
    figure = scene_figure(scene)
    panels = [panel for row in scene.rows for panel in row]
    assert len(figure.axes) == len(panels) + len(scene.charts)
    for axes, panel in zip(figure.axes, panels, strict=False):
        assert axes.get_title(loc="left") == panel.title
        assert axes.get_xlim() == (-1.0, 3.5) and axes.get_ylim() == (2.0, 5.5)
        assert "(m)" in axes.get_xlabel() and axes.get_ylabel() == "y (m)"
    assert scene.status in figure.alt


def test_the_still_picture_leaves_the_explorer_alone():
    grid, said = random_world(8, unknown=0)
    explorer = Explorer(grid, said, *corners(grid), taus=(0.3, 1.0))
    before = explorer.settings, explorer.status
    figure = tau_figure(explorer)
    assert (explorer.settings, explorer.status) == before
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:3] == [
        "loose: tau 0.5 to 10", "paper: tau 0.1 to 2", "strict: tau 0.02 to 0.4"
    ]  # fmt: skip
    assert len(figure.legends) == 1
    weights = [np.asarray(axes.images[0].get_array()).mean() for axes in figure.axes[:3]]
    assert weights == sorted(weights)  # the stricter, the whiter
    for axes, taus in zip(figure.axes[3:], TAU_CHOICES.values(), strict=True):
        explorer.update(taus=taus)
        if explorer.route is None:
            assert "no route" in axes.get_xlabel()
        else:
            assert f"cost {explorer.route.cost:.2f}, " in axes.get_xlabel()
