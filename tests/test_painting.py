"""Painting: what a stroke computes is what the whole map would give, and only where it must."""

import numpy as np
import pytest
import torch

from fgtutor.course.widgets.painting import Painting
from fgtutor.elevation import ElevationMap
from fgtutor.errors import ConfigError
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
