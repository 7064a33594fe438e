"""Drawing by a child process: what the pictures show, and that no fault of it reaches this one."""

import time
from itertools import islice

import mujoco
import numpy as np
import pytest

from fgtutor.errors import RenderingError
from fgtutor.robots import offscreen
from fgtutor.robots.offscreen import Renderer, Shot

SIZE = (64, 48)
BALL = """
<mujoco>
  <visual><headlight ambient="{light} {light} {light}" diffuse="0 0 0" specular="0 0 0"/></visual>
  <asset><material name="coat"/></asset>
  <worldbody>
    <body><freejoint/><geom size="0.1" mass="1" material="coat"/></body>
  </worldbody>
</mujoco>
"""


def ball(light: float = 1.0) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(BALL.format(light=light))


def shot(x: float = 0.0, y: float = 0.0, z: float = 0.0, **changes) -> Shot:
    """Look along +x at the origin from 1 m before it: +y is on the left, +z is up."""
    values = {"target": (0.0, 0.0, 0.0), "distance": 1.0, "azimuth": 0.0, "elevation": 0.0}
    qpos = np.array((x, y, z, 1.0, 0.0, 0.0, 0.0))
    return Shot(qpos=qpos, coat=(1.0, 0.0, 0.0), **(values | changes))


def centroid(picture: np.ndarray) -> tuple[float, float]:
    """Return where the drawn ball lies, in shares of the picture right and down of its middle."""
    rows, columns = np.nonzero(picture.max(axis=-1) > 60)
    height, width = picture.shape[:2]
    return (columns.mean() + 0.5) / width - 0.5, (rows.mean() + 0.5) / height - 0.5


@pytest.fixture(scope="module")
def renderer():
    try:
        with Renderer(ball(), *SIZE) as one:
            yield one
    except RenderingError as error:
        pytest.skip(str(error))


def test_a_picture_has_its_size_and_the_coats_colour(renderer):
    picture = renderer.draw(shot())
    assert picture.shape == (48, 64, 3) and picture.dtype == np.uint8
    red, green, blue = picture[24, 32].tolist()
    assert red > 200 and green == blue == 0
    assert picture[2, 2].max() == 0


@pytest.mark.parametrize(
    ("place", "right", "down"),
    [((0, 0.2, 0), -1, 0), ((0, -0.2, 0), 1, 0), ((0, 0, 0.2), 0, -1), ((0, 0, -0.2), 0, 1)],
)
def test_left_is_left_and_up_is_up(renderer, place, right, down):
    u, v = centroid(renderer.draw(shot(*place)))
    assert np.sign(np.round((u, v), 1)).tolist() == [right, down]


def test_the_camera_goes_where_it_is_told(renderer):
    # Looking along +y, a ball at +x lies on the right; looking down along +x, further is higher.
    assert centroid(renderer.draw(shot(0.2, azimuth=90.0)))[0] > 0.1
    assert centroid(renderer.draw(shot(0.2, elevation=-60.0)))[1] < -0.1
    # At half the distance the ball covers four times the area, a little more as it is round.
    near, far = ((renderer.draw(shot(distance=d)).max(-1) > 60).sum() for d in (0.6, 1.2))
    assert near / far == pytest.approx(4.0, rel=0.15)


def test_a_film_has_its_pictures_in_order(renderer):
    places = np.linspace(-0.3, 0.3, 7)
    seen = [centroid(picture)[0] for picture in renderer.film(shot(0, y) for y in places)]
    assert len(seen) == 7 and (np.diff(seen) < 0).all()
    assert list(renderer.film([])) == []


@pytest.mark.parametrize("watched", [1, 2, 3])
def test_a_film_left_early_leaves_nothing_for_the_next(renderer, watched):
    film = renderer.film(shot(0, y) for y in (0.3, 0.2, 0.1))
    list(islice(film, watched))
    film.close()
    u, _ = centroid(renderer.draw(shot(0, -0.3)))
    assert u > 0.1


@pytest.mark.slow
def test_closing_ends_the_process(renderer):
    with Renderer(ball(), *SIZE) as another:
        process = another._process
        assert process.poll() is None
    assert process.poll() is not None


@pytest.mark.slow
def test_a_process_that_dies_is_an_error_not_a_crash(renderer):
    with Renderer(ball(), *SIZE) as another:
        another.draw(shot())
        another._process.kill()
        for shots in ([shot()], [shot()] * 3):
            with pytest.raises(RenderingError, match=f"{another.backend} stopped"):
                list(another.film(shots))


@pytest.mark.slow
def test_a_process_that_hangs_is_ended(renderer):
    began = time.monotonic()
    with Renderer(ball(), *SIZE) as another:
        another.patience = 0.2
        with pytest.raises(RenderingError, match=r"within 0\.2 s"):
            another._picture()  # not asked for, so it never comes
    assert time.monotonic() - began < 60


@pytest.mark.slow
def test_a_black_picture_does_not_count(renderer, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", renderer.backend)
    with pytest.raises(RenderingError, match="came out black"):
        Renderer(ball(light=0.0), *SIZE)


@pytest.mark.slow
def test_without_a_library_the_message_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(RenderingError, match=r"\(off: .+\): on Debian.*unset it"):
        Renderer(ball(), *SIZE)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_system_without_any_library_is_named(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(offscreen, "GL_BACKENDS", {})
    with pytest.raises(RenderingError, match="none is known for"):
        Renderer(ball(), *SIZE)
