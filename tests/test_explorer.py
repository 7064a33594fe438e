"""The explorer behind the tau sliders: its fast numbers, its narrowed search, its pictures."""

import io

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from PIL import Image

from fgtutor import directions
from fgtutor.course.widgets.explorer import Explorer
from fgtutor.course.widgets.scene import Panel, Scene, on_picture, to_png, upright
from fgtutor.course.widgets.tau_views import TAU_CHOICES, TauView, tau_figure
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, PlanningError, ThresholdError
from fgtutor.figures import maps
from fgtutor.fusion import fuse
from fgtutor.planning import plan
from fgtutor.routes import Route
from fgtutor.tensorization import Assessment, assess, steps_on_known

NAMES = ("steps", "gaps", "slopes")


def random_world(seed: int, shape=(9, 7), unknown: int = 3) -> tuple[ElevationMap, dict]:
    """A map with some cells never observed, and what three specialists say of it."""
    rng = np.random.default_rng(seed)
    heights = rng.normal(0, 0.1, shape)
    heights.flat[rng.choice(heights.size, unknown, replace=False)] = np.nan
    said = {
        name: Assessment(
            torch.tensor(rng.uniform(0, 1, (*shape, 8)), dtype=torch.float32),
            torch.tensor(rng.gamma(1.0, 1.0, (*shape, 8)), dtype=torch.float32),
        )
        for name in NAMES
    }
    return ElevationMap(heights, resolution=0.5, origin=(-1.0, 2.0)), said


def corners(grid: ElevationMap) -> tuple[tuple[float, float], tuple[float, float]]:
    known = np.argwhere(grid.known)
    return grid.centre_of(*known[0].tolist()), grid.centre_of(*known[-1].tolist())


def slow_plan(explorer: Explorer, said: dict) -> Route | PlanningError:
    """The same settings through the pipeline's own stages, none of the explorer's."""
    now, grid = explorer.settings, explorer.elevation
    tensors = []
    for name, assessment in said.items():
        tensor = assessment.weighted(*now.taus) * (name in now.policies)
        tensor[~torch.from_numpy(steps_on_known(grid.known))] = 0
        tensors.append(tensor)
    fused, policy_map = fuse(tensors)
    try:
        return plan(
            fused, policy_map, grid=grid, start=now.start, goal=now.goal, f_min=now.f_min,
            switch_cost=now.switch_cost, tensors=tensors, names=tuple(said),
        )  # fmt: skip
    except PlanningError as error:
        return error


def assert_same(explorer: Explorer, said: dict) -> None:
    expected = slow_plan(explorer, said)
    if isinstance(expected, PlanningError):
        assert explorer.route is None
        # The message quotes float32 numbers, which may differ in the last digit: not compared.
        assert explorer.trouble.startswith(f"No route: {str(expected)[:12]}")
        return
    route = explorer.route
    assert route is not None
    assert route.cost == pytest.approx(expected.cost, rel=1e-5)
    np.testing.assert_array_equal(route.cells[[0, -1]], expected.cells[[0, -1]])
    centres = [explorer.elevation.centre_of(*cell) for cell in route.cells.tolist()]
    np.testing.assert_allclose(route.xy, centres, atol=1e-9)
    switching = explorer.settings.switch_cost * route.switches
    f = explorer.tensors[route.policies, *route.cells[:-1].T, route.headings]
    assert route.cost == pytest.approx((1 / f).sum() + switching, rel=1e-5)


# Numbers and routes -----------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    low=st.floats(0, 2),
    width=st.floats(0.05, 5),
    policies=st.sets(st.sampled_from(NAMES), min_size=1),
)
def test_fast_numbers_are_the_pipelines(seed, low, width, policies):
    grid, said = random_world(seed)
    explorer = Explorer(grid, said, *corners(grid))
    explorer.update(taus=(low, low + width), policies=tuple(policies))
    closed = ~torch.from_numpy(steps_on_known(grid.known))
    tensors = []
    for name, assessment in said.items():
        weight = assessment.ood(low, low + width)
        np.testing.assert_allclose(explorer.weights[name], weight, atol=1e-5)
        tensor = weight * assessment.f * (name in policies)
        tensor[closed] = 0
        tensors.append(tensor)
    np.testing.assert_allclose(explorer.tensors, np.stack(tensors), atol=1e-5)
    fused, policy_map = fuse(list(explorer.tensors))
    np.testing.assert_array_equal(explorer.fused, fused)
    np.testing.assert_array_equal(explorer.policy_map, policy_map)


@given(
    seed=st.integers(0, 10**6),
    high=st.floats(0.3, 6),
    f_min=st.floats(0.01, 0.5),
    switch_cost=st.sampled_from([0.0, 0.2, 1.0, 5.0]),
)
def test_the_route_costs_what_the_whole_search_finds(seed, high, f_min, switch_cost):
    grid, said = random_world(seed)
    explorer = Explorer(
        grid, said, *corners(grid), taus=(0.1, high), f_min=f_min, switch_cost=switch_cost
    )
    assert_same(explorer, said)


def test_a_corridor_leaves_out_most_of_a_plain_map_and_keeps_the_route():
    """Two policies, each at home on one half of 40 x 30 cells; one switch in the middle is best."""
    grid = ElevationMap(np.zeros((40, 30)))
    f = np.full((2, 40, 30, 8), 0.3, dtype=np.float32)
    f[0, :20], f[1, 20:] = 0.9, 0.9
    f[..., 1::2] /= 2  # a diagonal step would cost no more than a straight one
    said = {
        name: Assessment(torch.tensor(own), torch.zeros(40, 30, 8))
        for name, own in zip(("steps", "gaps"), f, strict=True)
    }
    start, goal = grid.centre_of(2, 15), grid.centre_of(37, 15)
    explorer = Explorer(grid, said, start, goal, switch_cost=2.0)
    keep = explorer._corridor.promising(
        explorer.tensors, explorer.fused, (2, 15), (37, 15), f_min=0.1, switch_cost=2.0
    )
    assert keep is not None and 0 < keep.mean() < 0.1
    # 35 steps at 1 / 0.9, one switch: 38.889 + 2.
    assert explorer.route is not None
    assert explorer.route.cost == pytest.approx(35 / 0.9 + 2, rel=1e-5)
    assert explorer.status == (
        "tau 0.10 to 2.00: cost 40.89, 3.50 m, policy switches: 1 (steps 1.8 m, gaps 1.7 m)"
    )
    assert_same(explorer, said)


def test_policies_that_cannot_hand_over_are_searched_on_the_whole_map():
    """Where the free route changes policy, no step suits both; the way round has one that does."""
    grid = ElevationMap(np.zeros((6, 3)))
    f = np.zeros((2, 6, 3, 8), dtype=np.float32)
    f[0, :3], f[1, 3:] = 0.9, 0.9
    f[1, 2, 2] = 0.2  # in the upper row, gaps can take the step that leaves the left half
    said = {
        name: Assessment(torch.tensor(own), torch.zeros(6, 3, 8))
        for name, own in zip(("steps", "gaps"), f, strict=True)
    }
    explorer = Explorer(grid, said, grid.centre_of(0, 0), grid.centre_of(5, 0), switch_cost=1.0)
    assert explorer.route is not None and [2, 2] in explorer.route.cells.tolist()
    assert_same(explorer, said)


def test_every_update_is_as_if_new():
    grid, said = random_world(7, unknown=0)
    moved = Explorer(grid, said, *corners(grid))
    for changes in (
        {"taus": (0.2, 3.0)},
        {"start": grid.centre_of(4, 3)},  # the tree of the search before is walked again
        {"policies": NAMES[1:]},
        {"goal": grid.centre_of(8, 0), "f_min": 0.05},
        {"switch_cost": 2.0},
        {"policies": NAMES, "switch_cost": 0.0},
        {"start": (-5.0, 0.0)},
        {"start": grid.centre_of(0, 6)},
    ):
        moved.update(**changes)
        now = moved.settings
        fresh = Explorer(grid, said, now.start, now.goal, taus=now.taus, policies=now.policies,
                         f_min=now.f_min, switch_cost=now.switch_cost)  # fmt: skip
        assert moved.status == fresh.status
        np.testing.assert_array_equal(moved.fused, fresh.fused)
        np.testing.assert_array_equal(moved.policy_map, fresh.policy_map)
    assert moved.milliseconds > 0


def test_what_goes_wrong_is_said_not_raised():
    grid, said = random_world(1)
    explorer = Explorer(grid, said, *corners(grid))
    explorer.update(goal=(99.0, 99.0))
    assert explorer.route is None and "the goal (99.00, 99.00) m is off the map" in explorer.status
    explorer.update(goal=grid.centre_of(*np.argwhere(~grid.known)[0].tolist()))
    assert "never observed" in explorer.status
    explorer.update(policies=())
    assert explorer.status == "tau 0.10 to 2.00: No policy may drive: tick at least one"
    explorer.update(policies=NAMES, goal=corners(grid)[1], switch_cost=1.0)
    assert explorer.route is not None


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"taus": (2.0, 1.0)}, ThresholdError, "tau_low <= tau_high, got 2.0 and 1.0"),
        ({"taus": (0.0, float("nan"))}, ThresholdError, "finite"),
        ({"policies": ("skates",)}, ConfigError, "no policy skates; there are steps, gaps, slopes"),
        ({"f_min": 0.0}, ConfigError, "f_min must be above 0"),
        ({"switch_cost": -1.0}, ConfigError, "switch_cost"),
    ],
)
def test_settings_without_meaning_are_refused_and_change_nothing(changes, error, words):
    grid, said = random_world(2)
    explorer = Explorer(grid, said, *corners(grid))
    before = explorer.settings, explorer.status, explorer.fused.copy()
    with pytest.raises(error, match=words):
        explorer.update(**changes)
    assert (explorer.settings, explorer.status) == before[:2]
    np.testing.assert_array_equal(explorer.fused, before[2])


def test_an_explorer_needs_a_zoo_of_its_map():
    grid, said = random_world(3)
    with pytest.raises(ConfigError, match="at least one specialist"):
        Explorer(grid, {}, (0, 3), (1, 3))
    with pytest.raises(ConfigError, match=r"'steps' has shape \(9, 7, 8\).*\(7, 9, 8\)"):
        Explorer(grid.rotated90(), said, (0, 3), (1, 3))


def test_taus_that_meet_are_a_step():
    grid, said = random_world(4, unknown=0)
    explorer = Explorer(grid, said, *corners(grid), taus=(1.0, 1.0))
    loss = said["gaps"].reconstruction.numpy()
    clear = np.abs(loss - 1) > 1e-3
    np.testing.assert_array_equal(explorer.weights["gaps"][clear], (loss < 1)[clear])


def test_a_specialist_is_assessed(make_specialist):
    grid = ElevationMap(np.zeros((5, 4)))
    specialist = make_specialist("gaps")
    explorer = Explorer(grid, {"gaps": specialist}, (0.05, 0.05), (0.45, 0.35), taus=(0.0, 1e3))
    np.testing.assert_allclose(
        explorer.fused,
        assess(grid, specialist).weighted(0.0, 1e3).numpy() * steps_on_known(grid.known),
        atol=1e-5,
    )


def test_hovering_reads_a_cells_numbers():
    grid, said = random_world(5, unknown=0)
    explorer = Explorer(grid, said, *corners(grid))
    lines = explorer.read((3, 2)).splitlines()
    # Resolution 0.5 from (-1, 2): the centre is (-1 + 3.5 / 2, 2 + 2.5 / 2).
    assert lines[0].startswith("cell (3, 2)   x 0.75 m, y 3.25 m, height")
    assert lines[1].split() == ["heading", *directions.NAMES]
    table = {line[:11].strip(): line[11:].split() for line in lines[1:]}
    assert table["L gaps"] == [f"{v:.2f}" for v in said["gaps"].reconstruction[3, 2].tolist()]
    assert table["F_max"] == [f"{v:.2f}" for v in explorer.fused[3, 2].tolist()]
    assert table["P"] == [NAMES[i] for i in explorer.policy_map[3, 2]]
    with pytest.raises(ConfigError, match=r"no cell \(9, 0\) on a map of 9 x 7"):
        explorer.read((9, 0))


# Scenes -------------------------------------------------------------------------------------------


def test_a_scene_has_the_figures_colours():
    grid, said = random_world(6)
    explorer = Explorer(grid, said, *corners(grid), taus=(0.1, 3.0), f_min=0.95)
    scene = TauView(explorer).scene()
    unknown = upright(~grid.known)

    def compare(key: str, figure) -> None:
        drawn = np.asarray(figure.axes[0].images[0].get_array())[::-1] * 255
        np.testing.assert_allclose(scene.pictures[key][~unknown], drawn[~unknown], atol=2.1)

    compare("M", maps.draw_elevation(grid))
    compare("P", maps.draw_policy_map(explorer.policy_map, explorer.fused, grid, NAMES,
                                         f_min=0.95))  # fmt: skip
    for name in NAMES:
        compare(f"w {name}", maps.draw_weight(explorer.weights[name], grid, name))
    for picture in scene.pictures.values():
        assert picture.shape == (7, 9, 3) and picture.dtype == np.uint8
        assert np.abs(picture[unknown] / 255 - to_rgb(maps.UNKNOWN)).max() < 0.01
    blocked = upright(explorer.fused.max(axis=-1) < 0.95) & ~unknown
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
    said = {
        name: Assessment(torch.tensor(own), torch.zeros(4, 2, 8))
        for name, own in zip(("steps", "gaps"), f, strict=True)
    }
    explorer = Explorer(grid, said, (0.05, 0.05), (0.35, 0.05))
    scene = TauView(explorer).scene()
    assert list(scene.lines) == [
        (maps.POLICY_COLOURS["steps"], [(0.5, 1.5), (1.5, 1.5), (2.5, 1.5)]),
        (maps.POLICY_COLOURS["gaps"], [(2.5, 1.5), (3.5, 1.5)]),
    ]
    assert scene.marks == {"start": (0.5, 1.5), "goal": (3.5, 1.5)}
    explorer.update(goal=explorer.settings.start)
    assert not TauView(explorer).scene().lines
    assert explorer.status.endswith("cost 0.00, 0.00 m, policy switches: 0")


def test_a_png_shows_the_scene():
    red = np.zeros((4, 8, 3), dtype=np.uint8)
    red[..., 0] = 255
    red[0, 7] = (0, 0, 255)
    scene = Scene(
        rows=[[Panel(key="a", title="A"), Panel(key="a", title="B")]],
        pictures={"a": red},
        lines=[("#009E73", [(0.5, 2.0), (6.0, 2.0)])],
        marks={"goal": (2.0, 1.0)},
        box=(1.0, 0.5, 7.0, 3.5),
        status="so it is",
    )
    image = np.asarray(Image.open(io.BytesIO(to_png(scene, width=412))).convert("RGB"))
    assert image.shape[1] == 412
    # Two panels of 200 pixels, 12 apart, 25 pixels a cell, 22 below the top.
    for left in (0, 212):
        assert image[22 + 12, left + 188].tolist() == [0, 0, 255]
        assert image[22 + 90, left + 100].tolist() == [255, 0, 0]
        assert image[22 + 50, left + 100].tolist() == [0, 158, 115]
        assert image[22 + 25, left + 50].tolist() == [255, 255, 255]
        assert image[22 + 87, left + 100].tolist() == [0, 0, 0]


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
