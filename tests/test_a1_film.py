"""The A1's film: where its camera stands, what its pictures show, what happens without graphics."""

from dataclasses import replace

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, RenderingError
from fgtutor.execution import Episode
from fgtutor.figures import toy_film, videos
from fgtutor.figures.a1_film import ABOVE, BESIDE, DISTANCE, TITLE, VIEW, A1Film, steepness
from fgtutor.figures.style import POLICY_COLOURS
from fgtutor.robots.a1.model import STANCE, STANCE_HEIGHT
from fgtutor.robots.offscreen import Renderer
from fgtutor.routes import Route
from fgtutor.world.terrain import Terrain

NAMES = ("steps", "gaps")


@pytest.fixture
def terrain() -> Terrain:
    """6 x 4 m of flat ground."""
    ground = ElevationMap(np.zeros((120, 80)), resolution=0.05)
    return Terrain.from_elevation(ground, (1.0, 2.0), (5.0, 2.0), robot="a1")


@pytest.fixture
def route() -> Route:
    """Straight along y = 2.025 from x = 1 to 5, the policy changing half-way."""
    x = np.arange(81)
    return Route(
        cells=np.stack((x + 20, np.full(81, 40)), axis=-1),
        xy=np.stack((1.025 + 0.05 * x, np.full(81, 2.025)), axis=-1),
        headings=np.zeros(80, dtype=int),
        policies=(np.arange(80) >= 40).astype(int),
        feasibility=np.ones(80),
        costs=np.ones(80),
        length=4.0,
        names=NAMES,
    )


@pytest.fixture
def episode() -> Episode:
    """A walk along the route at 0.5 m/s for 2 s, on the tile of another world 10 m further on."""
    steps = 100
    x = 2.5 + 0.01 * np.arange(steps)
    poses = np.stack((x, *np.array((2.0, STANCE_HEIGHT, 0.0))[:, None] * np.ones(steps)), axis=1)
    joints = np.tile((1.0, 0.0, 0.0, 0.0, *STANCE), (steps, 1))
    return Episode(
        success=True,
        reason="reached",
        poses=poses,
        policies=(np.arange(steps) >= 50).astype(int),
        length=0.99,
        seconds=2.0,
        robot="a1",
        body=np.hstack((poses[:, :3] + (10.0, 0.0, 0.0), joints)),
    )


@pytest.fixture(scope="module")
def graphics() -> None:
    """Skip a test where no graphics library works: it is optional."""
    ball = '<mujoco><worldbody><geom size="0.1"/></worldbody></mujoco>'
    try:
        Renderer(mujoco.MjModel.from_xml_string(ball), 16, 16).close()
    except RenderingError as error:
        pytest.skip(str(error))


def share(picture: Image.Image, colour: str, box: tuple[int, int, int, int]) -> float:
    """Return the share of a part of the picture that has a colour, in sun or shade."""
    pixels = np.asarray(picture.crop(box), dtype=float).reshape(-1, 3)
    length = np.linalg.norm(pixels, axis=1)
    target = np.array(to_rgb(colour)) / np.linalg.norm(to_rgb(colour))
    return float(((pixels @ target > 0.985 * length) & (length > 60)).mean())


def test_the_camera_rises_to_see_over_a_wall():
    heights = np.zeros((120, 80))
    heights[:, :30] = 0.9  # a wall on the right, y < 1.5
    ground = ElevationMap(heights, resolution=0.05)
    x = np.linspace(1.5, 4.5, 7)
    targets = np.stack((x, np.full(7, 2.0), np.full(7, 0.25)), axis=-1)
    # Looking along +y, from the right: the wall is 0.9 m high from 0.525 m beside the target on.
    # At 50 degrees the line of sight is 0.25 + 0.525 tan(50) = 0.88 m high there, at 55 it is 1.0.
    assert set(steepness(ground, targets, np.full(7, 90.0))) == {55.0}
    assert set(steepness(ground, targets, np.full(7, -90.0))) == {ABOVE[0]}
    walled = ElevationMap(np.full((120, 80), 3.0), resolution=0.05)
    assert set(steepness(walled, targets, np.full(7, 0.0))) == {ABOVE[1]}


def test_a_shot_shows_the_robot_in_the_terrains_frame(episode, terrain, route):
    film = A1Film(episode, terrain, route)
    for t, name in ((20, "steps"), (60, "gaps")):
        shot = film.shot(t)
        np.testing.assert_allclose(shot.qpos[:3], episode.poses[t, :3])
        np.testing.assert_allclose(shot.qpos[3:], episode.body[t, 3:])
        np.testing.assert_allclose(shot.coat, to_rgb(POLICY_COLOURS[name]))
        np.testing.assert_allclose(shot.target[:2], episode.poses[t, :2], atol=0.1)
        assert (shot.azimuth, shot.elevation) == pytest.approx((BESIDE, -ABOVE[0]))
        assert shot.distance == DISTANCE


def test_the_camera_turns_with_the_robot_the_short_way(episode, terrain, route):
    poses = episode.poses.copy()
    poses[:, 3] = np.linspace(3.0, 3.5, 100) % (2 * np.pi)
    poses[poses[:, 3] > np.pi, 3] -= 2 * np.pi
    film = A1Film(replace(episode, poses=poses), terrain, route)
    assert film.azimuths.min() > np.degrees(3.0) + BESIDE - 1
    assert film.azimuths.max() < np.degrees(3.5) + BESIDE + 1


@pytest.mark.slow
def test_a_frame_shows_robot_words_and_map(episode, terrain, route, graphics):
    film = A1Film(episode, terrain, route)
    early, late, last = film.frames([30, 70, 99])
    assert early.size == (640, 400) and all(side % 16 == 0 for side in early.size)
    middle = (VIEW[0] // 2 - 60, TITLE + VIEW[1] // 2 - 60, VIEW[0] // 2 + 60, TITLE + VIEW[1] // 2)
    words, bar = (0, 0, 160, TITLE), (0, 400 - 6, 640, 400)
    for frame, colour, other in ((early, "steps", "gaps"), (late, "gaps", "steps")):
        mine, others = POLICY_COLOURS[colour], POLICY_COLOURS[other]
        assert share(frame, mine, middle) > 0.02 and share(frame, others, words) == 0
        assert share(frame, mine, words) > 0.02
    # 31 of 100 steps have passed at step 30; the second half belongs to the other policy.
    assert share(early, POLICY_COLOURS["steps"], bar) == pytest.approx(0.31, abs=0.01)
    assert share(last, POLICY_COLOURS["gaps"], bar) == pytest.approx(0.5, abs=0.01)
    inset = (430, TITLE + 12, 626, TITLE + 135)
    assert np.asarray(early.crop(inset)).std() > np.asarray(early.crop((10, 50, 206, 173))).std()


@pytest.mark.slow
def test_the_video_lasts_as_long_as_the_walk(episode, terrain, route, graphics, tmp_path):
    path = videos.save_video(episode, terrain, route, tmp_path / "walk.mp4")
    assert [file.name for file in tmp_path.iterdir()] == ["walk.mp4"]
    _, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert seconds == pytest.approx(2.0 + videos.HOLD, abs=0.2)
    strip = videos.film_strip(episode, terrain, route, count=3)
    assert strip.image.size == (2 * 426 + 6, 2 * 266 + 6)


@pytest.mark.slow
def test_without_graphics_nothing_is_left(episode, terrain, route, monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(RenderingError, match="fgtutor doctor"):
        videos.save_video(episode, terrain, route, tmp_path / "walk.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("change", [{"poses": np.zeros((0, 4)), "body": np.zeros((0, 19))}, {}])
def test_the_robot_decides_which_film_it_is(episode, terrain, route, change):
    if change:
        with pytest.raises(ConfigError, match="the a1's body at each of 0 steps"):
            videos.film_of(replace(episode, **change), terrain, route)
    else:
        assert type(videos.film_of(episode, terrain, route)) is A1Film
        toy = replace(episode, robot="toy", body=episode.body[:, :9])
        assert type(videos.film_of(toy, terrain, route)) is toy_film.ToyFilm
