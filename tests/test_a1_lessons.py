"""What the A1's notebooks draw and drive: limbs where MuJoCo has them, with or without graphics."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from fgtutor.baselines import View, find_route, ours
from fgtutor.course import a1_lessons
from fgtutor.course.lessons import straight_route
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, PlanningError, RenderingError
from fgtutor.execution import Episode, FollowConfig
from fgtutor.figures.a1_film import VIEW
from fgtutor.robots.a1.env import A1_EPISODES, A1Env
from fgtutor.robots.a1.model import LEGS, STANCE, STANCE_HEIGHT, build_spec
from fgtutor.robots.offscreen import Renderer
from fgtutor.world.terrain import Terrain, World, make_terrain

SHORT = FollowConfig(patience=1.0, grace=1.0)


@pytest.fixture
def stance() -> np.ndarray:
    return np.array((0.0, 0.0, STANCE_HEIGHT, 1.0, 0.0, 0.0, 0.0, *STANCE))


@pytest.fixture
def flat() -> Terrain:
    ground = ElevationMap(np.zeros((80, 40)), resolution=0.05)
    return Terrain.from_elevation(ground, (1.0, 1.0), (3.0, 1.0), robot="a1")


@pytest.fixture
def walk(stance) -> Episode:
    """One second at 0.5 m/s, without moving a limb."""
    steps = 50
    x = 1.0 + 0.01 * np.arange(steps)
    poses = np.stack((x, *np.array((1.0, STANCE_HEIGHT, 0.0))[:, None] * np.ones(steps)), axis=1)
    return Episode(
        success=True,
        reason="reached",
        poses=poses,
        policies=np.zeros(steps, dtype=int),
        length=0.49,
        seconds=1.0,
        robot="a1",
        body=np.hstack((poses[:, :3], np.tile(stance[3:], (steps, 1)))),
    )


@pytest.fixture
def no_graphics(monkeypatch) -> None:
    """Name a graphics library that does not exist: nothing can draw."""
    monkeypatch.setenv("MUJOCO_GL", "crayon")


@pytest.fixture(scope="module")
def graphics() -> None:
    ball = '<mujoco><worldbody><geom size="0.1"/></worldbody></mujoco>'
    try:
        Renderer(mujoco.MjModel.from_xml_string(ball), 16, 16).close()
    except RenderingError as error:
        pytest.skip(str(error))


# Stick figures ------------------------------------------------------------------------------------


def test_limbs_are_where_mujoco_has_them():
    model = build_spec().compile()
    data, dice = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = dice.uniform(-1, 1, model.nq)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_kinematics(model, data)
        for leg, found in zip(LEGS, a1_lessons.leg_points(data.qpos), strict=True):
            bodies = [data.body(f"{leg}_{link}").xpos for link in ("hip", "thigh", "calf")]
            np.testing.assert_allclose(found, [*bodies, data.site(f"{leg}_foot").xpos], atol=1e-9)


def feet(figure: Figure, row: int, column: int = 0) -> dict[str, tuple[float, float]]:
    """Return where a panel of `draw_postures` shows each foot."""
    axes = [a for a in figure.axes if a.get_label() != "<colorbar>"]
    columns = len(axes) // 2
    dots = [line for line in axes[row * columns + column].lines if line.get_marker() == "o"]
    return {
        leg: tuple(np.ravel(dot.get_data()).tolist())
        for leg, dot in zip(LEGS, dots, strict=True)
    }  # fmt: skip


def test_a_stick_figure_looks_ahead_to_the_right_and_at_the_reader_below(stance):
    figure = a1_lessons.draw_postures({"standing": stance})
    aside, front = feet(figure, 0), feet(figure, 1)
    assert aside["FR"][0] > 0.1 > -0.1 > aside["RR"][0]
    assert front["FL"][0] > 0.1 > -0.1 > front["FR"][0]  # its left is the reader's right
    assert all(-0.3 < height < -0.2 for _, height in (*aside.values(), *front.values()))


def test_a_stick_figure_shows_tilt_and_forgets_place_and_yaw(stance):
    turned = stance.copy()
    turned[:2], turned[3:7] = (5.0, -3.0), (np.cos(0.6), 0.0, 0.0, np.sin(0.6))
    uphill = stance.copy()
    uphill[3:7] = (np.cos(0.2), 0.0, -np.sin(0.2), 0.0)  # the nose up by 0.4 rad
    figure = a1_lessons.draw_postures({"": stance, " ": turned, "  ": uphill}, title="three")
    for leg in LEGS:
        assert feet(figure, 0, 1)[leg] == pytest.approx(feet(figure, 0, 0)[leg], abs=1e-9)
    assert feet(figure, 0, 2)["FR"][1] > feet(figure, 0, 0)["FR"][1] + 0.05
    assert len(figure.legends[0].get_texts()) == 4


# Walks and views ----------------------------------------------------------------------------------


def test_without_graphics_a_walk_is_shown_as_sticks(walk, flat, no_graphics, capsys):
    route = straight_route(flat, "steps")
    shown = a1_lessons.show_walk(walk, flat, route)
    assert isinstance(shown, Figure)
    titles = [axes.get_title(loc="left") for axes in shown.axes[:4]]
    assert titles == ["0.0 s", "0.3 s", "0.7 s", "1.0 s"]
    assert "stick figures instead" in capsys.readouterr().out


def test_with_graphics_a_walk_is_a_film_strip_no_wider_than_a_page(walk, flat, graphics):
    shown = a1_lessons.show_walk(walk, flat, straight_route(flat, "steps"), count=3)
    assert isinstance(shown, Image.Image) and shown.width == a1_lessons.PAGE
    assert np.ptp(np.asarray(shown)) > 150


def test_sticks_need_a_recorded_body(walk):
    with pytest.raises(ConfigError, match="drive it with execute"):
        a1_lessons.walk_sticks(replace(walk, body=None))


@pytest.fixture
def env(flat) -> A1Env:
    return A1Env(World([[flat]]), 1, config=replace(A1_EPISODES, train=False), threads=1)


def test_the_view_draws_without_graphics_too(env, flat, no_graphics):
    view = a1_lessons.A1View(flat)
    first, second = view(env), view(env)
    assert first.dtype == np.uint8 and first.shape[2] == 3 and np.ptp(first) == 255
    np.testing.assert_array_equal(first, second)
    view.close()


def test_the_view_follows_the_robot(env, flat, graphics):
    view = a1_lessons.A1View(flat, colour="#D55E00")
    here = view(env)
    env.physics.qpos[:, 0] += 0.5
    env.physics.forward()
    env._read()
    there = view(env)
    view.close()
    view.close()  # twice is no fault
    assert here.shape == there.shape == (VIEW[1], VIEW[0], 3)
    middle = np.s_[140:220, 260:380]  # the robot fills it, wherever the robot is
    assert np.abs(here[middle].mean((0, 1)) - there[middle].mean((0, 1))).max() < 15
    assert np.abs(here.astype(int) - there).max() > 30  # and the ground has moved


# What it feels and is paid for --------------------------------------------------------------------


def test_the_gait_shows_when_a_foot_is_loaded():
    loads = np.zeros((10, 4))
    loads[2:5, 1] = loads[7:10, 1] = 60.0
    loads[:, 3] = a1_lessons.LOADED  # not more than that
    figure = a1_lessons.draw_gait(loads, 0.1)
    bars = [collection.get_paths() for collection in figure.axes[0].collections]
    assert [len(paths) for paths in bars] == [0, 2, 0, 0]
    spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in bars[1]]
    np.testing.assert_allclose(spans, [(0.2, 0.5), (0.7, 1.0)])


def test_the_terms_end_in_their_sum():
    figure = a1_lessons.draw_terms(
        {"walks": {"tracking": 1.0, "jerk": -0.25}, "stands": {"tracking": 0.2, "jerk": 0.0}}
    )
    widths = [[bar.get_width() for bar in bars] for bars in figure.axes[0].containers]
    assert widths == [[1.0, -0.25, 0.75], [0.2, 0.0, 0.2]]


# Routes -------------------------------------------------------------------------------------------


def test_walks_are_driven_together_and_count_as_their_routes_do(make_rolling):
    ground = make_terrain("flat", robot="toy")
    zoo = {name: make_rolling(name) for name in ("gaps", "slopes", "steps")}
    jobs = [(straight_route(ground, name), ground, 3) for name in ("steps", "gaps")]
    first, second = a1_lessons.drive_together(jobs, zoo, config=SHORT)
    assert first.success and second.success
    assert set(first.policies) == set(second.policies) == {0}
    (alone,) = a1_lessons.drive_together(jobs[:1], zoo, config=SHORT)
    np.testing.assert_allclose(first.poses, alone.poses, atol=1e-6)


def test_a_route_of_strangers_is_refused(make_rolling):
    ground = make_terrain("flat", robot="toy")
    with pytest.raises(ConfigError, match="routes name gaps; the zoo has steps"):
        a1_lessons.drive_together(
            [(straight_route(ground, "gaps"), ground, 0)], {"steps": make_rolling()}
        )


def test_the_daring_route_goes_where_ours_refuses(make_rolling):
    """A net that promises little and knows nothing: L_recon is far above its taus everywhere."""
    heights = np.zeros((30, 10))
    heights[14:16] = 0.4
    wall = ElevationMap(heights)
    shy = make_rolling(f=0.02, quantiles={"0.5": 1e-9, "0.9": 2e-9, "0.95": 3e-9, "0.99": 4e-9})
    view, ends = View(wall, {"steps": shy}), ((0.55, 0.55), (2.45, 0.55))
    with pytest.raises(PlanningError):
        find_route(ours, view, *ends)
    route = a1_lessons.daring_route(view, *ends)
    assert len(route.headings) == 19 and route.names == ("steps",)
    assert route.feasibility == pytest.approx(0.02, abs=1e-6)


# Clouds -------------------------------------------------------------------------------------------


def test_a_cloud_is_thinned_and_its_sensors_are_marked():
    points = np.random.default_rng(0).uniform(0, 4, (2 * a1_lessons.DOTS + 1, 3))
    figure = a1_lessons.draw_cloud(points, sensors=[(1.0, 2.0, 3.0, 0.0, 0.0, 0.0)], title="all")
    above, side = figure.axes[:2]
    assert len(above.collections[0].get_offsets()) <= a1_lessons.DOTS
    np.testing.assert_array_equal(np.ravel(above.lines[0].get_data()), (1.0, 2.0))
    np.testing.assert_array_equal(np.ravel(side.lines[0].get_data()), (1.0, 3.0))
    assert f"{len(points):,} points" in side.get_xlabel()


def test_the_difference_of_maps_is_unknown_where_the_scan_is():
    truth = ElevationMap(np.array([[0.0, 0.1], [0.2, 0.3]]))
    scan = ElevationMap(np.array([[0.05, np.nan], [0.1, 0.3]]))
    found = a1_lessons.difference(scan, truth)
    np.testing.assert_allclose(found.heights, [[0.05, np.nan], [-0.1, 0.0]], atol=1e-7)
    with pytest.raises(ConfigError, match="maps of one area"):
        a1_lessons.difference(scan, ElevationMap(np.zeros((3, 2))))
