"""Pictures of the A1: limbs where MuJoCo has them, with or without graphics."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure

from fgtutor.course import a1_pictures
from fgtutor.course.drives import straight_route
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, RenderingError
from fgtutor.execution import Episode, FollowConfig
from fgtutor.figures.a1_film import VIEW
from fgtutor.figures.style import Photo
from fgtutor.robots.a1.env import A1_EPISODES, A1Env
from fgtutor.robots.a1.model import LEGS, STANCE, STANCE_HEIGHT, build_spec
from fgtutor.robots.offscreen import Renderer
from fgtutor.world.terrain import Terrain, World

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
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-1, 1, model.nq)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_kinematics(model, data)
        for leg, found in zip(LEGS, a1_pictures.leg_points(data.qpos), strict=True):
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
    figure = a1_pictures.draw_postures({"standing": stance})
    aside, front = feet(figure, 0), feet(figure, 1)
    assert aside["FR"][0] > 0.1 > -0.1 > aside["RR"][0]
    assert front["FL"][0] > 0.1 > -0.1 > front["FR"][0]  # its left is the reader's right
    assert all(-0.3 < height < -0.2 for _, height in (*aside.values(), *front.values()))


def test_a_stick_figure_shows_tilt_and_forgets_place_and_yaw(stance):
    turned = stance.copy()
    turned[:2], turned[3:7] = (5.0, -3.0), (np.cos(0.6), 0.0, 0.0, np.sin(0.6))
    uphill = stance.copy()
    uphill[3:7] = (np.cos(0.2), 0.0, -np.sin(0.2), 0.0)  # the nose up by 0.4 rad
    figure = a1_pictures.draw_postures({"": stance, " ": turned, "  ": uphill}, title="three")
    for leg in LEGS:
        assert feet(figure, 0, 1)[leg] == pytest.approx(feet(figure, 0, 0)[leg], abs=1e-9)
    assert feet(figure, 0, 2)["FR"][1] > feet(figure, 0, 0)["FR"][1] + 0.05
    assert len(figure.legends[0].get_texts()) == 4


def test_nearer_legs_hide_farther_ones(stance):
    figure = a1_pictures.draw_postures({"standing": stance})
    for row, near in ((0, {"FR", "RR"}), (1, {"FR", "FL"})):
        lines = [line for line in figure.axes[row].lines if line.get_marker() == "."]
        order = {leg: line.get_zorder() for leg, line in zip(LEGS, lines, strict=True)}
        assert {leg for leg, z in order.items() if z == max(order.values())} == near
        (trunk,) = (line for line in figure.axes[row].lines if line.get_marker() == "None")
        assert min(order.values()) < trunk.get_zorder() < max(order.values())


def test_the_plane_of_the_feet_tilts_with_the_robot(stance):
    uphill = stance.copy()
    uphill[3:7] = (np.cos(0.2), 0.0, -np.sin(0.2), 0.0)  # the nose up by 0.4 rad
    figure = a1_pictures.draw_postures({"": uphill}, plane=True)
    aside, front = (axes.lines[0].get_xydata() for axes in figure.axes[:2])
    slopes = [(end[1] - start[1]) / (end[0] - start[0]) for start, end in (aside, front)]
    assert slopes == pytest.approx([np.tan(0.4), 0.0], abs=0.02)


# Walks and views ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_graphics_a_walk_is_shown_as_sticks(walk, flat, no_graphics, capsys):
    route = straight_route(flat, "steps")
    shown = a1_pictures.show_walk(walk, flat, route)
    assert isinstance(shown, Figure)
    titles = [axes.get_title(loc="left") for axes in shown.axes[:4]]
    assert titles == ["0.0 s", "0.3 s", "0.7 s", "1.0 s"]
    assert "stick figures instead" in capsys.readouterr().out


@pytest.mark.slow
def test_with_graphics_a_walk_is_a_film_strip_no_wider_than_a_page(walk, flat, graphics):
    shown = a1_pictures.show_walk(walk, flat, straight_route(flat, "steps"), count=3)
    assert isinstance(shown, Photo) and shown.image.width == a1_pictures.PAGE
    assert np.ptp(np.asarray(shown.image)) > 150 and "reached" in shown.alt


def test_sticks_need_a_recorded_body(walk):
    with pytest.raises(ConfigError, match="drive it with execute"):
        a1_pictures.walk_sticks(replace(walk, body=None))


@pytest.fixture
def env(flat) -> A1Env:
    return A1Env(World([[flat]]), 1, config=replace(A1_EPISODES, train=False), threads=1)


@pytest.mark.slow
def test_the_view_draws_without_graphics_too(env, flat, no_graphics):
    view = a1_pictures.A1View(flat)
    first, second = view(env), view(env)
    assert first.dtype == np.uint8 and first.shape[2] == 3 and np.ptp(first) == 255
    np.testing.assert_array_equal(first, second)
    view.close()


@pytest.mark.slow
def test_the_view_follows_the_robot(env, flat, graphics):
    view = a1_pictures.A1View(flat, colour="#D55E00")
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


# Gait and reward ----------------------------------------------------------------------------------


def test_the_gait_shows_when_a_foot_is_loaded():
    loads = np.zeros((10, 4))
    loads[2:5, 1] = loads[7:10, 1] = 60.0
    loads[:, 3] = a1_pictures.LOADED  # not more than that
    figure = a1_pictures.draw_gait(loads, 0.1)
    bars = [collection.get_paths() for collection in figure.axes[0].collections]
    assert [len(paths) for paths in bars] == [0, 2, 0, 0]
    spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in bars[1]]
    np.testing.assert_allclose(spans, [(0.2, 0.5), (0.7, 1.0)])


def test_the_terms_end_in_their_sum():
    figure = a1_pictures.draw_terms(
        {"walks": {"tracking": 1.0, "jerk": -0.25}, "stands": {"tracking": 0.2, "jerk": 0.0}}
    )
    widths = [[bar.get_width() for bar in bars] for bars in figure.axes[0].containers]
    assert widths == [[1.0, -0.25, 0.75], [0.2, 0.0, 0.2]]
