"""Pictures and videos: what they show, what they refuse, and that nothing partial is left."""

import errno
import io
import itertools
import subprocess
import sys
import threading
from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from PIL import Image

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, StorageError
from fgtutor.execution import Episode
from fgtutor.figures import charts, maps, relief, style, toy_film, videos
from fgtutor.fusion import fuse
from fgtutor.planning import Plan, plan
from fgtutor.statistics import Share, calibration
from fgtutor.world.terrain import Section, Terrain

NAMES = ("steps", "gaps")
START, GOAL = (0.25, 0.45), (3.75, 0.55)
PLACE = Section(name="ledge", x0=3.2, y0=0.2, x1=3.8, y1=0.8)


def make_map() -> ElevationMap:
    """4 x 1 m: a gap at x = 2, a ledge of 0.2 m from x = 3, two cells never observed."""
    heights = np.zeros((40, 10))
    heights[20:22] = -1.0
    heights[30:] = 0.2
    heights[5:7, 0] = np.nan
    return ElevationMap(heights)


@pytest.fixture
def ground() -> ElevationMap:
    return make_map()


@pytest.fixture
def planned(ground) -> Plan:
    """Steps is better in the left half of the map, gaps in the right."""
    x = np.arange(40)[:, None, None]
    left = np.where(x < 20, 0.9, 0.6) * np.ones((40, 10, 8))
    tensors = [torch.tensor(left), torch.tensor(left[::-1].copy())]
    fused, policy_map = fuse(tensors)
    route = plan(
        fused, policy_map, grid=ground, start=START, goal=GOAL, tensors=tensors, names=NAMES,
        switch_cost=0.0,
    )  # fmt: skip
    return Plan(NAMES, tensors, {}, fused, policy_map, route)


@pytest.fixture
def terrain(ground) -> Terrain:
    return Terrain.from_elevation(ground, START, GOAL)


@pytest.fixture
def episode() -> Episode:
    """A drive along y = 0.5 at 1 m/s for 2 s, upright, the policy changing half-way."""
    steps = 50
    s = 0.04 * np.arange(steps)
    poses = np.stack((0.3 + s, np.full(steps, 0.5), np.full(steps, 0.3), np.zeros(steps)), axis=1)
    body = np.tile((0.0, 0.3, 0.0, -0.25, 0.09, 0.0, 0.25, 0.09, 0.0), (steps, 1))
    policies = (np.arange(steps) >= 25).astype(int)
    return Episode(
        success=True, reason="reached", poses=poses, policies=policies, length=1.96, seconds=2.0,
        robot="toy", body=body,
    )  # fmt: skip


def pixels(figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


# Figures ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_picture_shows_itself_without_pyplot():
    code = (
        "import sys, numpy as np\n"
        "from fgtutor.elevation import ElevationMap\n"
        "from fgtutor.figures.maps import draw_elevation\n"
        "picture = draw_elevation(ElevationMap(np.eye(4)))\n"
        "print(picture._repr_png_()[:4] == b'\\x89PNG', 'matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]


def test_elevation_puts_x_to_the_right_and_y_up(ground):
    heights = np.zeros((4, 3))
    heights[3, 0] = 1.0  # x large, y small: the lower right corner
    figure = maps.draw_elevation(ElevationMap(heights))
    image = figure.axes[0].images[0].get_array()
    assert image.shape == (3, 4, 3)
    darkest = np.unravel_index(image.sum(axis=-1).argmin(), (3, 4))
    assert darkest == (0, 3) and figure.axes[0].images[0].origin == "lower"
    assert figure.axes[0].images[0].get_extent() == pytest.approx([0, 0.4, 0, 0.3])


def test_the_commonest_height_is_white_and_the_bar_names_both_ends():
    heights = np.zeros((10, 10))
    heights[2:5], heights[5:8] = 0.1, 0.25  # of the cells 40 % lie at 0: the median is 0.1
    elevation = ElevationMap(heights + 3.0)
    assert relief.usual_height(elevation) == pytest.approx(3.0)
    picture = maps.draw_elevation(elevation)
    axes = picture.axes[0]
    white = np.asarray(relief.GROUND(0.5))[:3]
    np.testing.assert_allclose(np.asarray(axes.images[0].get_array())[5, 0], white, atol=0.01)
    picture.canvas.draw()
    (bar,) = axes.child_axes
    named = [float(text.get_text()) for text in bar.get_yticklabels()]
    assert bar.get_ylim() == pytest.approx((3.0, 3.25))
    assert named[0] == 3.0 and named[-1] == 3.25 and named == sorted(set(named))


def test_a_map_says_what_it_is_told_and_what_is_hatched(ground):
    axes = maps.draw_elevation(ground, title="A ledge", caption="Look", label="error (m)").axes[0]
    assert axes.get_title(loc="left") == "A ledge"
    assert axes.get_xlabel() == "x (m)\nLook. Hatched: never observed"
    assert axes.child_axes[0].get_ylabel() == "error (m)"
    known = ElevationMap(np.eye(4))
    assert "never observed" not in maps.draw_elevation(known).axes[0].get_xlabel()


@pytest.mark.parametrize("heights", [np.zeros((4, 4)), np.pad([[9.0]], 2)])
def test_ticks_of_heights_do_not_touch(heights):
    picture = maps.draw_elevation(ElevationMap(heights))
    picture.canvas.draw()
    boxes = [
        text.get_window_extent()
        for text in picture.axes[0].child_axes[0].get_yticklabels()
        if text.get_text()
    ]
    assert len(boxes) >= 2
    assert all(low.y1 <= high.y0 for low, high in itertools.pairwise(boxes))


def test_a_picture_brings_alt_text_and_cuts_no_word_off():
    long = "A title that is far too long for so narrow a picture, and yet must be read"
    picture = style.Picture(4.0, 2.0)
    picture.subplots().set_title(long, loc="left")
    data, words = picture._repr_mimebundle_()
    assert words["image/png"]["alt"] == long
    with Image.open(io.BytesIO(data["image/png"])) as image:
        assert image.width > 1.2 * 4.0 * style.DPI
    picture.alt = "Better words"
    assert picture._repr_mimebundle_()[1] == {"image/png": {"alt": "Better words"}}


def test_alt_text_names_every_panel_and_legend(ground, planned):
    weights = {name: torch.ones(40, 10, 8) for name in NAMES}
    alt = maps.plan_figure(ground, replace(planned, weights=weights)).described()
    for part in (
        "1 The route",
        "w_ood of each policy",
        "3 F as petals",
        "4 Policy map",
        "steps",
    ):
        assert part in alt
    assert len(alt) <= style.LONGEST and "\n" not in alt and "$" not in alt


def test_unknown_cells_are_hatched(ground):
    (hatched,) = (
        c for c in maps.draw_elevation(ground).axes[0].collections if c.get_hatch() is not None
    )
    corners = np.concatenate([path.vertices for path in hatched.get_paths()])
    assert corners.min(axis=0) == pytest.approx((0.5, 0.0))
    assert corners.max(axis=0) == pytest.approx((0.7, 0.1))
    known = ElevationMap(np.zeros((3, 3)))
    assert not maps.draw_elevation(known).axes[0].collections


@given(
    heights=st.lists(
        st.floats(-20, 20, width=32) | st.just(float("nan")), min_size=12, max_size=12
    ).filter(lambda values: not all(np.isnan(values)))
)
@settings(max_examples=5, deadline=None)
def test_any_map_can_be_drawn(heights):
    figure = maps.draw_elevation(ElevationMap(np.reshape(heights, (4, 3)), origin=(-5.0, 2.0)))
    assert pixels(figure).std() > 0


def test_a_route_has_the_colours_of_its_policies(ground, planned):
    figure = maps.draw_route(planned.route, ground)
    _, line = (c for c in figure.axes[0].collections if isinstance(c, LineCollection))
    expected = [to_rgb(style.POLICY_COLOURS[NAMES[p]]) for p in planned.route.policies]
    np.testing.assert_allclose(line.get_colors()[:, :3], expected)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["steps", "gaps", "start", "goal"]


def test_a_route_of_one_cell_can_be_drawn(ground, planned):
    route = plan(planned.fused, planned.policy_map, grid=ground, start=START, goal=START)
    assert pixels(maps.draw_route(route, ground)).std() > 0


def test_strangers_keep_apart_from_the_known():
    colours = style.policy_colours(["ice", "steps", "sand"])
    assert colours["steps"] == style.POLICY_COLOURS["steps"]
    assert len({*colours.values(), *style.POLICY_COLOURS.values()}) == len(style.POLICY_COLOURS) + 2


@pytest.mark.parametrize("kind", [np.asarray, torch.tensor])
def test_weight_is_white_where_a_policy_is_lost(ground, kind):
    w = np.zeros((40, 10, 8))
    w[7, 3] = 1.0
    figure = maps.draw_weight(kind(w), ground, "gaps")
    image = figure.axes[0].images[0].get_array()
    np.testing.assert_allclose(image[3, 7], to_rgb(style.POLICY_COLOURS["gaps"]))
    np.testing.assert_allclose(image[3, 8], 1.0)


def test_a_petal_points_along_its_heading_and_is_as_long_as_f():
    grid = ElevationMap(np.zeros((3, 3)), resolution=1.0)
    f = np.zeros((3, 3, 8))
    f[1, 1, 2] = 0.5  # +y
    figure = maps.draw_petals(f, grid, every=1)
    (petals,) = (c for c in figure.axes[0].collections if isinstance(c, PolyCollection))
    (petal,) = petals.get_paths()
    tip = petal.vertices[petal.vertices[:, 1].argmax()]
    # Centre (1.5, 1.5), and a petal of F = 1 reaches 0.56 cells far.
    assert tip == pytest.approx((1.5, 1.5 + 0.5 * 0.56))
    np.testing.assert_allclose(petals.get_facecolor()[0, :3], to_rgb(maps.FEASIBLE))


def test_petals_turn_with_the_map():
    rng = np.random.default_rng(0)
    f, grid = rng.uniform(0.2, 1, (5, 5, 8)), ElevationMap(np.zeros((5, 5)))
    turned = np.roll(np.rot90(f), 2, axis=-1)

    def points(tensor, elevation):
        (petals,) = maps.draw_petals(tensor, elevation, every=1).axes[0].collections
        return np.concatenate([path.vertices for path in petals.get_paths()])

    before, after = points(f, grid), points(turned, grid.rotated90())
    rotated = before @ np.array([[0, 1], [-1, 0]])  # (x, y) -> (-y, x)
    assert {tuple(p) for p in rotated.round(6) + 0.0} == {tuple(p) for p in after.round(6) + 0.0}


def test_a_large_map_gets_few_glyphs():
    grid = ElevationMap(np.zeros((200, 100)))
    petals = maps.draw_petals(np.ones((200, 100, 8)), grid).axes[0].collections[0]
    assert len(petals.get_paths()) <= 8 * maps.GLYPHS**2


def test_the_policy_map_shows_who_is_best_and_what_is_closed(ground, planned):
    fused = planned.fused.clone()
    fused[2, 4] = 0.05
    figure = maps.draw_policy_map(planned.policy_map, fused, ground, NAMES)
    image = figure.axes[0].images[0].get_array()
    np.testing.assert_allclose(image[4, 2], to_rgb(maps.BLOCKED))
    # F = 0.9 gives the strength 0.2 + 0.8 * 0.9 = 0.92 between white and the policy's colour.
    for ix, name in ((10, "steps"), (30, "gaps")):
        colour = np.array(to_rgb(style.POLICY_COLOURS[name]))
        np.testing.assert_allclose(image[4, ix], 1 - 0.92 * (1 - colour))


def test_the_plan_figure_has_every_panel(ground, planned, tmp_path):
    weights = {name: torch.ones(40, 10, 8) for name in NAMES}
    figure = maps.plan_figure(ground, replace(planned, weights=weights))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [t for t in titles if t and t[0] in "134"] and {"steps", "gaps"} <= set(titles)
    path = style.save_figure(figure, tmp_path / "plan.png", dpi=50)
    with Image.open(path) as image:
        assert image.width > 500
    with pytest.raises(ConfigError, match="gaps"):
        maps.plan_figure(ground, replace(planned, weights={"steps": weights["steps"]}))


def test_figures_draw_in_threads(ground, planned):
    drawn = []
    threads = [
        threading.Thread(
            target=lambda: drawn.append(pixels(maps.draw_route(planned.route, ground)))
        )
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(drawn) == 3
    assert all((picture == drawn[0]).all() for picture in drawn)


def test_plans_lie_side_by_side_the_right_way_up(ground, planned):
    tensor = planned.fused.clone()
    tensor[30:] = 0.0
    figure = maps.draw_plans(
        ground,
        {"early <1>": (tensor, None), "late": (tensor, planned.route)},
        title="A & B",
        f_min=0.25,
        walls=np.arange(10) >= np.where(np.arange(40) == 3, 8, 10)[:, None],
        places=[PLACE],
    )
    early, late = figure.axes
    assert figure.get_suptitle() == "A & B"
    assert early.get_title(loc="left") == "early <1>: no route"
    assert late.get_title(loc="left") == f"late: {planned.route.length:.1f} m"
    assert [len(axes.collections) for axes in (early, late)] == [0, 2]  # edges on a white border
    assert [text.get_text() for text in early.texts] == ["20 cm high"]
    image = np.asarray(early.images[0].get_array())  # [row = y from below, column = x]
    assert image.shape == (10, 40, 3)
    share = float(tensor[0, 0].mean())
    np.testing.assert_allclose(image[0, 0], 1 - share * (1 - np.array(to_rgb(maps.FEASIBLE))))
    np.testing.assert_allclose(image[0, 35], to_rgb(maps.CLOSED))
    np.testing.assert_allclose(image[9, 3], to_rgb(maps.BLOCKED))


def test_shares_lie_under_the_heading_of_their_group(tmp_path):
    groups = {
        "steps": {"ours": Share(successes=5, trials=10)},
        "gaps <wide>": {"ours": Share(successes=0, trials=10), "b": Share(successes=9, trials=9)},
    }
    figure = charts.draw_shares(groups, title="Success")
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(groups)
    bars = [[bar.get_width() for bar in axes.patches] for axes in figure.axes]
    assert bars == [[0.5], [0.0, 1.0]]
    names = [[label.get_text() for label in axes.get_yticklabels()] for axes in figure.axes]
    assert names == [["ours"], ["ours", "b"]]
    figure.savefig(tmp_path / "shares.svg")
    assert (tmp_path / "shares.svg").read_text().count("of 10 -->") == 2


@pytest.mark.parametrize("count", [1, 20])
def test_the_training_curve_draws_what_it_is_given(count):
    rows = [{"samples": 100.0 * i, "r_v": i / 20, "row": 1.0} for i in range(count)]
    curves = [line for axes in charts.training_curve(rows).axes for line in axes.lines]
    assert [len(line.get_xdata()) for line in curves] == [count, count]
    with pytest.raises(ConfigError, match="at least one row"):
        charts.training_curve([])


def test_the_calibration_plot_skips_empty_bins():
    table, error = calibration(np.array([0.05, 0.06, 0.95]), np.array([0.1, 0.0, 0.9]))
    figure = charts.calibration_plot(table, error)
    _, dots = figure.axes[0].lines
    np.testing.assert_allclose(dots.get_xydata(), [(0.055, 0.05), (0.95, 0.9)])
    assert f"{error:.3f}" in figure.axes[0].get_title(loc="left")


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda grid: maps.draw_weight(np.ones((10, 40, 8)), grid), r"\(10, 40, 8\)"),
        (lambda grid: maps.draw_petals(np.ones((40, 10)), grid), r"\(40, 10\)"),
        (
            lambda grid: maps.draw_policy_map(
                np.full((40, 10, 8), 3), np.ones((40, 10, 8)), grid, NAMES
            ),
            "up to 3, names has 2",
        ),
    ],
)
def test_tensors_of_another_map_are_refused(ground, draw, message):
    with pytest.raises(ConfigError, match=message):
        draw(ground)


# Videos -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_lasts_as_long_as_the_drive(tmp_path, episode, terrain, planned, suffix):
    path = videos.save_video(episode, terrain, planned.route, tmp_path / f"drive{suffix}")
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    # 2 s at 12.5 frames a second, the last step, and that one held for 1.2 s.
    expected = 2.0 + videos.HOLD
    if suffix == ".mp4":
        frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert frames == pytest.approx(expected * 12.5, abs=2)
    else:
        with Image.open(path) as image:
            total = 0
            for frame in range(image.n_frames):
                image.seek(frame)
                total += image.info["duration"]
        seconds = total / 1000
    assert seconds == pytest.approx(expected, abs=0.2)


def test_the_side_view_shows_the_robot_in_its_policys_colour(episode, terrain, planned):
    film = toy_film.ToyFilm(episode, terrain, planned.route)
    for t, name in ((10, "steps"), (40, "gaps")):
        image = np.asarray(film.side(t)).astype(float)
        # The chassis' centre lies above s = 0, at the camera's height: z = 0.3 everywhere.
        u, v = round(toy_film.BEHIND * toy_film.SCALE), round(0.5 * toy_film.SIDE[1])
        colour = 255 * np.array(to_rgb(style.POLICY_COLOURS[name]))
        assert np.abs(image[v, u] - colour).max() < 2


def test_ground_along_keeps_cliffs_and_mirrors(ground):
    s, h = toy_film.ground_along(ground.filled(), 1.5, 0.5, 0.0, -0.5, 1.2)
    assert set(h[(s > 0.52) & (s < 0.68)]) == {-1.0}
    assert set(h[(s < 0.48) | (s > 0.72)]) == {0.0}
    back, mirrored = toy_film.ground_along(ground.filled(), 2.0, 0.5, np.pi, -0.55, 0.55)
    s, h = toy_film.ground_along(ground.filled(), 2.0, 0.5, 0.0, -0.55, 0.55)
    inside = np.abs(np.abs(s) % 0.1 - 0.05) < 0.03  # away from the borders of cells
    np.testing.assert_allclose(np.interp(-s, back, mirrored)[inside], h[inside], atol=1e-6)


def test_frames_are_the_same_each_time(episode, terrain, planned):
    first, second = (
        toy_film.ToyFilm(episode, terrain, planned.route).frame(20).tobytes() for _ in range(2)
    )
    assert first == second


@pytest.mark.parametrize("count", [1, 5])
def test_the_film_strip_holds_every_view(episode, terrain, planned, count):
    strip = np.asarray(videos.film_strip(episode, terrain, planned.route, count=count).image)
    rows = -(-count // 2)
    assert strip.shape[0] == pytest.approx(rows * 181 + (rows - 1) * 6, abs=rows)


@pytest.mark.parametrize(
    "change",
    [
        {"body": None},
        {"body": np.zeros((50, 7))},
        {"poses": np.zeros((0, 4)), "body": np.zeros((0, 9))},
    ],
)
def test_an_episode_without_a_toy_is_refused(episode, terrain, planned, change):
    with pytest.raises(ConfigError, match="record the episode"):
        toy_film.ToyFilm(replace(episode, **change), terrain, planned.route)


def test_an_episode_of_one_step_is_a_film(episode, terrain, planned):
    single = replace(
        episode,
        poses=episode.poses[:1],
        policies=episode.policies[:1],
        body=episode.body[:1],
        seconds=0.04,
    )
    film = toy_film.ToyFilm(single, terrain, planned.route)
    assert film.times() == [0, 0]
    assert film.frame(0).width == toy_film.WIDTH


# Faults -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["plan.docx", "plan"])
def test_an_unknown_suffix_is_refused(ground, tmp_path, name):
    with pytest.raises(ConfigError, match="png"):
        style.save_figure(maps.draw_elevation(ground), tmp_path / name)


def test_a_video_of_another_format_is_refused(episode, terrain, planned, tmp_path):
    with pytest.raises(ConfigError, match=r"\.mp4, \.gif"):
        videos.save_video(episode, terrain, planned.route, tmp_path / "drive.avi")


@pytest.mark.parametrize("suffix", ["png", "gif", "mp4"])
def test_a_full_disk_leaves_nothing(
    monkeypatch, tmp_path, ground, episode, terrain, planned, suffix
):
    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.replace", refuse)
    path = tmp_path / f"picture.{suffix}"
    with pytest.raises(StorageError, match="free some disk space"):
        if suffix == "png":
            style.save_figure(maps.draw_elevation(ground), path)
        else:
            videos.save_video(episode, terrain, planned.route, path)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process's files are POSIX")
def test_a_video_cut_short_leaves_nothing(tmp_path, episode, terrain, planned):
    import resource
    import signal

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Python must survive a write past 4 kB; ffmpeg, a process of its own, need not.
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(StorageError, match=r"ffmpeg|File too large"):
            videos.save_video(episode, terrain, planned.route, tmp_path / "drive.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_a_missing_ffmpeg_suggests_a_gif(monkeypatch, tmp_path, episode, terrain, planned):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "no-such-ffmpeg"))
    with pytest.raises(ConfigError, match=r"\.gif instead"):
        videos.save_video(episode, terrain, planned.route, tmp_path / "drive.mp4")
    assert not list(tmp_path.iterdir())
