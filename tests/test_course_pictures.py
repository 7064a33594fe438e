"""What the notebooks draw: patches where they belong, honest charts, routes and clouds."""

import math

import networkx
import numpy as np
import pytest
import torch
from matplotlib.image import AxesImage

from fgtutor.course import (
    a1_pictures,
    cloud_pictures,
    drives,
    notebooks,
    patch_pictures,
    route_pictures,
)
from fgtutor.course.widgets.live_curve import LiveCurve
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, UnreachableError
from fgtutor.execution import FollowConfig
from fgtutor.figures import charts, maps, relief, style, videos
from fgtutor.patches import PatchGrid
from fgtutor.planning import as_networkx
from fgtutor.routes import Refusal
from fgtutor.world.terrain import make_terrain

GRID = PatchGrid(ahead=0.4, behind=0.2, half_width=0.2)
SHORT = FollowConfig(patience=1.0, grace=1.0)


@pytest.fixture
def ledge() -> ElevationMap:
    """2 x 2 m, 0.2 m higher from x = 1 m on."""
    heights = np.zeros((20, 20))
    heights[10:] = 0.2
    return ElevationMap(heights)


def roll(observations) -> torch.Tensor:
    return torch.zeros(len(observations), 4)


def images(figure) -> list[np.ndarray]:
    """Return every image in a figure, by axes from left to right and top to bottom."""
    found = [(axes, image) for axes in figure.axes for image in axes.get_images()]
    return [np.asarray(image.get_array()) for _, image in found if isinstance(image, AxesImage)]


def png(figure) -> bytes:
    return figure._repr_png_()


# Patches ------------------------------------------------------------------------------------------


def test_a_patch_looks_ahead_whichever_way_the_robot_faces(ledge):
    up = patch_pictures.patch_at(ledge, (0.75, 1.0, 0.0), GRID).reshape(GRID.shape)
    down = patch_pictures.patch_at(ledge, (1.25, 1.0, math.pi), GRID).reshape(GRID.shape)
    # Rows run from 0.2 m behind to 0.4 m ahead; the ledge is 0.25 m ahead of both robots.
    assert up[:, 2].tolist() == pytest.approx([0, 0, 0, 0, 0, 0.2, 0.2], abs=1e-6)
    assert down[:, 2].tolist() == pytest.approx([0, 0, 0, 0, 0, -0.2, -0.2], abs=1e-6)


def test_the_gallery_shows_ahead_on_the_right_and_left_above(ledge):
    aside = patch_pictures.patch_at(
        ledge, (0.85, 1.0, -math.pi / 2), GRID
    )  # the ledge is to its left
    ahead = patch_pictures.patch_at(ledge, (0.75, 1.0, 0.0), GRID)
    left, right = images(patch_pictures.patch_gallery([aside, ahead], GRID, ["a", "b"]))
    assert left[-1].max() == pytest.approx(0.2, abs=1e-6) and abs(left[0]).max() < 1e-6
    assert right[:, -1].max() == pytest.approx(0.2, abs=1e-6) and abs(right[:, 0]).max() < 1e-6


def test_the_rose_puts_each_heading_at_its_side(ledge):
    figure = patch_pictures.patch_rose(ledge, 0.75, 1.0, GRID)
    places = {axes.get_title(loc="left"): axes.get_position() for axes in figure.axes}
    middle = places["the place on the map"]
    assert places["heading 0: +x"].x0 > middle.x0 > places["heading 4: -x"].x0
    assert places["heading 2: +y"].y0 > middle.y0 > places["heading 6: -y"].y0


def test_heading_maps_are_upright_and_in_their_places(ledge):
    tensor = np.zeros((20, 20, 8))
    tensor[19, :, 0] = 1.0  # the last column of cells along x, heading +x
    figure = patch_pictures.heading_maps(tensor, ledge)
    by_title = {axes.get_title(loc="left"): axes for axes in figure.axes}
    shown = np.asarray(by_title["heading 0: +x"].get_images()[0].get_array())
    assert shown[:, -1].min() == 1.0 and shown[:, :-1].max() == 0.0


def test_tensors_lie_side_by_side_in_one_scale(ledge):
    left, right = np.zeros((20, 20, 8)), np.ones((20, 20, 8))
    left[19, :, :4] = 1.0  # half of the headings, in the last column of cells along x
    figure = patch_pictures.feasibility_maps({"early": left, "late": right}, ledge)
    early, late = images(figure)[:2]
    assert early[:, -1].min() == 0.5 and early[:, :-1].max() == 0.0 and late.min() == 1.0
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["early", "late"]


# Graphs and routes --------------------------------------------------------------------------------


def test_the_graph_has_an_arrow_for_every_edge_and_costs_on_the_path():
    grid = ElevationMap(np.zeros((3, 2)))
    fused = np.full((3, 2, 8), 0.5)
    graph = as_networkx(fused, np.zeros((3, 2, 8), dtype=int))
    path = networkx.dijkstra_path(graph, (0, 0), (2, 0))
    figure = route_pictures.draw_graph(graph, grid, path, ("steps",))
    axes = figure.axes[0]
    arrows = [artist for artist in axes.collections if hasattr(artist, "U")]
    assert len(arrows) == 1 and len(arrows[0].U) == graph.number_of_edges()
    assert [text.get_text() for text in axes.texts] == ["2.00", "2.00"]  # 1 / 0.5, twice


def test_routes_are_compared_and_a_missing_one_says_why():
    terrain = make_terrain("flat", robot="toy")
    closed = Refusal(UnreachableError("no chain of steps joins them: lower f_min"))
    one = drives.straight_route(terrain, "steps")
    routes = {"one": one, "none": "no route: the ridge", "refused": closed}
    figure = route_pictures.compare_routes(terrain.elevation, routes)
    captions = {axes.get_title(loc="left"): axes.get_xlabel() for axes in figure.axes}
    assert {words.partition("\n")[0] for words in captions.values()} == {"x (m)"}
    captions = {title: words.partition("\n")[2] for title, words in captions.items()}
    assert captions["none"] == "no route: the ridge" and "m, policy" in captions["one"]
    assert captions["refused"] == "no chain of steps joins them"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["steps"]


# Clouds -------------------------------------------------------------------------------------------


def test_a_cloud_is_thinned_and_its_sensors_are_marked():
    points = np.random.default_rng(0).uniform(0, 4, (2 * cloud_pictures.DOTS + 1, 3))
    figure = cloud_pictures.draw_cloud(
        points, sensors=[(1.0, 2.0, 3.0, 0.0, 0.0, 0.0)], title="all"
    )
    above, side = figure.axes[:2]
    assert len(above.collections[0].get_offsets()) <= cloud_pictures.DOTS
    np.testing.assert_array_equal(np.ravel(above.lines[0].get_data()), (1.0, 2.0))
    np.testing.assert_array_equal(np.ravel(side.lines[0].get_data()), (1.0, 3.0))
    assert f"{len(points):,} points" in side.get_xlabel()


def test_the_difference_of_maps_is_unknown_where_the_scan_is():
    truth = ElevationMap(np.array([[0.0, 0.1], [0.2, 0.3]]))
    scan = ElevationMap(np.array([[0.05, np.nan], [0.1, 0.3]]))
    found = cloud_pictures.difference(scan, truth)
    np.testing.assert_allclose(found.heights, [[0.05, np.nan], [-0.1, 0.0]], atol=1e-7)
    with pytest.raises(ConfigError, match="maps of one area"):
        cloud_pictures.difference(scan, ElevationMap(np.zeros((3, 2))))


# Charts -------------------------------------------------------------------------------------------


def test_the_error_of_a_scan_is_white_where_there_is_none():
    truth = ElevationMap(np.full((4, 3), 0.3))
    scan = ElevationMap(np.where(np.arange(12).reshape(4, 3) < 8, 0.35, 0.3))
    axes = cloud_pictures.draw_error(scan, truth).axes[0]
    shown = np.asarray(axes.images[0].get_array())
    np.testing.assert_allclose(shown[0, 3], relief.GROUND(0.5)[:3], atol=0.06)
    assert "minus the truth" in axes.get_title(loc="left")


def test_curves_differ_in_dashes_and_may_jump_over_a_logarithmic_axis():
    curves = {"a": [1, 2], "b": [2, 3]}
    figure = charts.draw_curves(
        [1, 10], curves, title="t", xlabel="x", ylabel="y", log_x=True, steps=True
    )
    first, second = figure.axes[0].lines
    assert first.get_linestyle() != second.get_linestyle()
    assert first.get_drawstyle() == "steps-mid"
    assert figure.axes[0].get_xscale() == "log" and figure.axes[0].get_yscale() == "linear"


def test_a_policy_keeps_its_colour_and_strangers_take_turns():
    assert style.colours_of(["mine", "gaps"]) == [style.LINES[0], style.POLICY_COLOURS["gaps"]]


def test_rates_show_wilson_intervals():
    axes = charts.draw_rates({"steps": (9, 10)}, title="t").axes[0]
    assert axes.patches[0].get_width() == pytest.approx(0.9)
    # Wilson (1927), 9 of 10: 0.596 to 0.982
    interval = axes.collections[0].get_segments()[0]
    assert interval[:, 0].tolist() == pytest.approx([0.596, 0.982], abs=1e-3)
    assert "9 of 10" in [text.get_text() for text in axes.texts]


def test_losses_are_shares_and_the_ramp_is_w_ood():
    figure = charts.draw_losses(
        {"steps": torch.logspace(-3, 1, 400)}, {"paper": (0.1, 2.0), "own": (0.05, 0.5)}
    )
    ramp = figure.axes[1].lines[0]
    x, y = np.asarray(ramp.get_xdata()), np.asarray(ramp.get_ydata())
    assert y[x < 0.1].min() == 1.0 and y[x > 2.0].max() == 0.0
    assert np.interp(1.05, x, y) == pytest.approx(0.5, abs=0.02)  # half-way between the taus


def test_a_table_shows_its_numbers_or_the_texts_given():
    values = [[0.25, 1.0]]
    words = {"title": "t", "caption": "c"}
    plain = charts.draw_table(values, ["row"], ["a", "b"], **words)
    assert [text.get_text() for text in plain.axes[0].texts] == ["0.25", "1.00"]
    counted = charts.draw_table(values, ["row"], ["a", "b"], texts=[["1 of 4", "4 of 4"]], **words)
    assert [text.get_text() for text in counted.axes[0].texts] == ["1 of 4", "4 of 4"]


def test_the_live_curve_draws_at_once_then_now_and_then(monkeypatch):
    shown = []

    class Handle:
        def update(self, figure):
            shown.append(figure)

    monkeypatch.setattr(
        "fgtutor.course.widgets.live_curve.display",
        lambda figure, **_: shown.append(figure) or Handle(),
    )
    live = LiveCurve(seconds=1000)
    for iteration in (1, 2, 3):
        live({"samples": iteration, "r_v": 0.5, "failed": 0.0, "row": 0.0})
    assert len(shown) == 1  # the first row at once, the next after 1000 s
    live.draw(live.rows[:2])
    assert len(shown) == 2 and len(live.rows) == 3


# Numbers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "places", "name"),
    [
        (patch_pictures.patch_gallery, 3, "columns"),
        (route_pictures.compare_routes, 2, "columns"),
        (drives.collect, 2, "seconds"),
        (charts.draw_labels, 3, "dt"),
        (maps.draw_petals, 2, "every"),
        (style.save_figure, 2, "dpi"),
        (a1_pictures.show_walk, 3, "count"),
        (a1_pictures.show_walk, 3, "columns"),
        (a1_pictures.walk_sticks, 1, "count"),
        (a1_pictures.draw_gait, 1, "dt"),
        (videos.film_strip, 3, "count"),
        (videos.film_strip, 3, "columns"),
        (notebooks.budget, 2, "each"),
    ],
)
@pytest.mark.parametrize("number", [-1, math.nan, math.inf, "3"])
def test_a_number_without_sense_is_refused_before_anything_is_drawn(function, places, name, number):
    others = [1] * places if function is notebooks.budget else [None] * places
    with pytest.raises(ConfigError, match=f"^{name}: "):
        function(*others, **{name: number})
