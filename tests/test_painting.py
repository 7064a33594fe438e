"""Painting: what a stroke computes is what the whole map would give, and only where it must."""

import numpy as np
import pytest
import torch

from fgtutor.course.widgets.painting import Painting
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError, OffMapError, PlanningError
from fgtutor.routes import Route
from fgtutor.specialist import load_zoo
from fgtutor.tensorization import assess


@pytest.mark.parametrize("resolution", [0.1, 0.05])
def test_a_stroke_computes_what_the_whole_map_would(make_specialist, resolution):
    rng = np.random.default_rng(0)
    heights = np.round(rng.normal(0, 0.1, (90, 70)), 2)
    heights[20:24, 10:60] = -2.0  # a gap, which the levelling changes from a distance
    heights[3, 3] = np.nan
    specialist = make_specialist("gaps")
    painting = Painting(ElevationMap(heights, resolution, (3.0, -1.0)), specialist, taus="paper")
    for cells, height, radius in [
        ([(45, 35)], 0.4, 0.0),
        ([(22, 40), (23, 41)], 0.0, 0.15),  # bridges the gap
        ([(0, 0), (89, 69)], -1.0, 0.1),
    ]:
        before = painting.assessment.f.clone(), painting.assessment.reconstruction.clone()
        window = painting.stroke(cells, height, radius)
        assert window is not None
        whole = assess(painting.elevation, specialist)
        for part, was, full in zip(
            (painting.assessment.f, painting.assessment.reconstruction),
            before, (whole.f, whole.reconstruction), strict=True,
        ):  # fmt: skip
            assert torch.equal(part, full)
            outside = torch.ones_like(part, dtype=torch.bool)
            outside[window] = False
            torch.testing.assert_close(part[outside], was[outside], atol=1e-4, rtol=1e-4)
            assert not torch.equal(part[window], was[window])
        assert all(painting.elevation.heights[cell] == np.float32(height) for cell in cells)


def test_a_stroke_reaches_as_far_as_a_patch(make_specialist):
    """Patch 0.3 m ahead and 0.2 m aside: 0.36 m, and a cell for interpolation, is 5 cells."""
    painting = Painting(ElevationMap(np.zeros((40, 30))), make_specialist())
    assert painting.stroke([(20, 15)], 0.2, 0.0) == (slice(15, 26), slice(10, 21))
    scene = painting.scene()
    assert scene.box == (15.0, 9.0, 26.0, 20.0)  # 30 rows: y = 10..21 lie 9..20 below the top
    assert "121 of 1200 cells see the last stroke" in scene.status
    brown = scene.pictures["M"][30 - 1 - 15, 20].astype(int)
    assert brown[0] > brown[2] + 20  # above the usual ground


def test_a_stroke_that_changes_nothing_computes_nothing(make_specialist):
    painting = Painting(ElevationMap(np.zeros((8, 6))), make_specialist())
    assert painting.stroke([(3, 3)], 0.0, 0.2) is None
    assert painting.scene().box is None
    painting.stroke([(3, 3)], 0.3, 0.1)
    painting.clear()
    assert painting.window is None and not painting.elevation.heights.any()


def test_a_painting_shows_one_heading_or_the_best(make_specialist):
    rng = np.random.default_rng(1)
    specialist = make_specialist("steps")
    painting = Painting(ElevationMap(rng.normal(0, 0.05, (9, 8))), specialist, taus=(0.0, 50.0))
    F = painting.assessment.weighted(0.0, 50.0).numpy()
    np.testing.assert_array_equal(painting.shown, F.max(axis=-1))
    painting.heading = 2
    np.testing.assert_array_equal(painting.shown, F[..., 2])
    assert painting.scene().rows[0][1].title == "F of steps, +y"
    row = painting.read((4, 3)).splitlines()[-1]
    assert row.split() == ["F", *(f"{value:.2f}" for value in F[4, 3])]


@pytest.mark.parametrize(
    ("cells", "height", "radius"),
    [([(9, 0)], 0.0, 0.1), ([(-1, 0)], 0.0, 0.1), ([(0, 0)], np.nan, 0.1), ([(0, 0)], 0.0, -1.0)],
)
def test_a_stroke_beyond_sense_is_refused(make_specialist, cells, height, radius):
    painting = Painting(ElevationMap(np.zeros((9, 8))), make_specialist())
    with pytest.raises(ConfigError, match=r"no cell|needs a finite height"):
        painting.stroke(cells, height, radius)
    assert not painting.elevation.heights.any()


def test_a_route_goes_round_what_is_painted():
    """The shipped steps specialist of the toy, and a wall of 60 cm across its way."""
    painting = Painting(ElevationMap(np.zeros((50, 40))), load_zoo("toy")["steps"],
                        start=(0.65, 2.05), goal=(4.45, 2.05))  # fmt: skip
    before = painting.answer
    assert isinstance(before, Route) and before.length == pytest.approx(3.8)
    painting.stroke([(25, y) for y in range(12, 29)], 0.6, 0.0)
    after = painting.answer
    assert isinstance(after, Route) and after.length > before.length + 0.3
    crossing = after.xy[np.abs(after.xy[:, 0] - 2.55) < 0.06, 1]
    assert ((crossing < 1.2) | (crossing > 2.9)).all()  # beside the wall, not over it
    assert f"route: {after.length:.2f} m" in painting.status
    painting.clear()
    assert isinstance(painting.answer, Route)
    assert painting.answer.length == pytest.approx(before.length)


def test_a_painted_route_is_driven(make_rolling):
    painting = Painting(ElevationMap(np.zeros((40, 20))), make_rolling("steps", f=0.9),
                        taus=(50, 100), start=(0.65, 1.05), goal=(3.05, 1.05))  # fmt: skip
    with pytest.raises(ConfigError, match="nothing was driven"):
        painting.strip()
    episode = painting.drive()
    assert episode.success and "driven: reached" in painting.status
    driven = painting.scene().lines[-1][1]
    u, v = driven[0]
    np.testing.assert_allclose(episode.poses[0, :2], (u * 0.1, 2.0 - v * 0.1), atol=1e-9)
    assert painting.strip().alt.startswith("Film strip of 4 moments")
    painting.stroke([(20, 10)], 0.1, 0.0)
    assert painting.episode is None


def test_a_painting_without_ends_or_without_a_way_says_so(make_rolling):
    ground = ElevationMap(np.zeros((12, 10)))
    with pytest.raises(ConfigError, match="give both of them, or neither"):
        Painting(ground, make_rolling(), start=(0.5, 0.5))
    with pytest.raises(OffMapError):
        Painting(ground, make_rolling(), start=(0.5, 0.5), goal=(9.0, 0.5))
    with pytest.raises(ConfigError, match="needs a route"):
        Painting(ground, make_rolling()).drive()
    closed = Painting(
        ground, make_rolling(f=0.05), taus=(50, 100), start=(0.5, 0.5), goal=(0.9, 0.5)
    )
    assert "no route: " in closed.status
    with pytest.raises(PlanningError):
        closed.drive()


def test_a_small_map_is_called_small(make_specialist):
    painting = Painting(ElevationMap(np.zeros((8, 6))), make_specialist())
    painting.stroke([(4, 3)], 0.3, 0.0)
    assert painting.status.endswith("(this map is hardly larger than what a patch sees)")
    painting = Painting(ElevationMap(np.zeros((40, 30))), make_specialist())
    painting.stroke([(4, 3)], 0.3, 0.0)
    assert "hardly larger" not in painting.status
