"""Diagrams: every notebook's place in the pipeline, the sizes of the net, labels of the library."""

import itertools

import numpy as np
import pytest
import torch
from matplotlib.patches import Rectangle

from fgtutor.course import diagrams
from fgtutor.errors import ConfigError
from fgtutor.feasibility import feasibility_labels

EVERY = [
    lambda: diagrams.draw_pipeline(5),
    diagrams.draw_net,
    diagrams.draw_frames,
    diagrams.draw_label_timeline,
]


def words(figure) -> list[str]:
    return [text.get_text() for axes in figure.axes for text in axes.texts]


@pytest.mark.parametrize("draw", EVERY)
def test_a_diagram_has_alt_text_of_its_own_and_is_as_wide_as_a_page(draw):
    figure = draw()
    assert 20 < len(figure.alt.split()) < 100
    assert figure.get_size_inches()[0] <= 7.7
    assert figure._repr_mimebundle_()[1]["image/png"]["alt"] == figure.alt


@pytest.mark.parametrize("here", range(1, diagrams.NOTEBOOKS + 1))
def test_every_notebook_has_its_place_in_the_pipeline(here):
    figure = diagrams.draw_pipeline(here)
    marked = [stage for stage in diagrams.STAGES.values() if here in stage.taught]
    assert words(figure).count("you are here") == len(marked) >= 1
    assert all(stage.name in figure.alt.partition("You are here")[2] for stage in marked)


@pytest.mark.parametrize("here", [0, 14, "5", 2.5])
def test_a_notebook_that_does_not_exist_is_refused(here):
    with pytest.raises(ConfigError, match=r"^here: "):
        diagrams.draw_pipeline(here)


def test_no_words_of_the_pipeline_lie_on_others():
    figure = diagrams.draw_pipeline(11)
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in figure.axes[0].texts if text.get_text()]
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)


def test_the_net_has_the_sizes_of_the_one_that_is_trained():
    said = words(diagrams.draw_net())
    assert [said.count(width) for width in ("93", "90", "256", "32", "16", "1")] == [
        1,
        2,
        2,
        1,
        1,
        1,
    ]


def test_the_timeline_shows_the_labels_of_the_library():
    figure = diagrams.draw_label_timeline(window=4)
    above, below = figure.axes
    r_v = np.zeros(26)
    for bar in (one for one in above.patches if isinstance(one, Rectangle)):
        r_v[round(bar.get_x() + max(bar.get_width(), 0))] = bar.get_height()
    ended = (np.arange(26) == 14).astype(float)
    tracking = torch.tensor(np.stack((r_v, ended, ended), axis=-1))[:, None]
    labels, valid = feasibility_labels(tracking, 4)
    dots, crosses = below.lines[1:]
    np.testing.assert_allclose(np.asarray(dots.get_ydata()), labels[valid])
    np.testing.assert_array_equal(crosses.get_xdata(), np.flatnonzero(~valid[:, 0].numpy()))


@pytest.mark.parametrize("window", [0, 7, -1])
def test_a_window_that_does_not_fit_is_refused(window):
    with pytest.raises(ConfigError, match=r"^window: "):
        diagrams.draw_label_timeline(window)
