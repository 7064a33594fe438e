"""Headings: order, yaws and steps, the cells under a step, and their symmetries."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtutor import directions
from fgtutor.directions import Headings
from fgtutor.errors import ConfigError, PlanningError

COUNTS = (8, 16, 32, 48)
counts = pytest.mark.parametrize("count", COUNTS)


def test_eight_are_the_papers():
    eight = Headings()
    assert eight == Headings(8) and eight.names == directions.NAMES
    assert eight.names == ("+x", "+x+y", "+y", "-x+y", "-x", "-x-y", "-y", "+x-y")
    assert eight.steps.tolist() == directions.STEPS.tolist()
    np.testing.assert_array_equal(eight.yaws, np.arange(8) * (math.pi / 4))
    assert not any(eight.between) and (eight.moves == 1).all()


def test_more_headings_by_hand():
    assert Headings(16).steps[:5].tolist() == [[1, 0], [2, 1], [1, 1], [1, 2], [0, 1]]
    first = [[1, 0], [3, 1], [2, 1], [3, 2], [1, 1], [2, 3], [1, 2], [1, 3], [0, 1]]
    assert Headings(32).steps[:9].tolist() == first
    assert Headings(32).names[:4] == ("+x", "+3x+y", "+2x+y", "+3x+2y")
    assert Headings(16).names[7] == "-2x+y" and Headings(16).names[13] == "+x-2y"
    assert Headings(32).moves[:5].tolist() == [1, 3, 2, 3, 1]
    assert Headings(16).lengths[1] == pytest.approx(5**0.5)
    # (3, 1) goes through a corner: the cells (1, 1) and (2, 0) only touch it.
    assert Headings(32).between[1] == ((1, 0), (2, 1))
    assert Headings(32).between[2] == ((1, 0), (1, 1))
    assert Headings(32).between[3] == ((1, 0), (1, 1), (2, 1), (2, 2))
    first = [[1, 0], [6, 1], [3, 1], [2, 1], [3, 2], [5, 4], [1, 1]]
    second = [[4, 5], [2, 3], [1, 2], [1, 3], [1, 6], [0, 1]]
    assert Headings(48).steps[:13].tolist() == first + second
    assert Headings(48).between[1] == ((1, 0), (2, 0), (3, 0), (3, 1), (4, 1), (5, 1))


@pytest.mark.parametrize(("count", "most"), [(8, 22.5), (16, 13.3), (32, 9.3), (48, 4.8)])
def test_no_direction_is_far_from_a_heading(count, most):
    yaws = np.degrees(Headings(count).yaws)
    assert most - 0.1 < np.diff(yaws, append=360).max() / 2 <= most


@counts
def test_they_are_ordered_counter_clockwise_and_turn_and_mirror_into_each_other(count):
    headings = Headings(count)
    assert (np.diff(headings.yaws) > 0).all() and headings.yaws[0] == 0
    assert headings.yaws[-1] < 2 * math.pi and len(set(headings.names)) == count
    (dx, dy), between = headings.steps.T, [set(cells) for cells in headings.between]
    np.testing.assert_array_equal(np.roll(headings.steps, -count // 2, axis=0), -headings.steps)
    for k in range(count):
        turned, mirrored = (k + count // 4) % count, -k % count
        assert headings.steps[turned].tolist() == [-dy[k], dx[k]]
        assert headings.steps[mirrored].tolist() == [dx[k], -dy[k]]
        assert between[turned] == {(-j, i) for i, j in between[k]}
        assert between[mirrored] == {(i, -j) for i, j in between[k]}
        # The way back passes through the same cells.
        back = between[(k + count // 2) % count]
        assert between[k] == {(i + dx[k], j + dy[k]) for i, j in back}


@counts
def test_the_cells_between_are_those_that_the_segment_passes_through(count):
    headings = Headings(count)
    along = (np.arange(420) + 0.5)[:, None] / 420  # never on the border between two cells
    for step, between in zip(headings.steps, headings.between, strict=True):
        passed = {tuple(cell) for cell in np.rint(along * step).astype(int).tolist()}
        assert passed - {(0, 0), tuple(step.tolist())} == set(between)


@counts
def test_a_step_leads_to_its_heading(count):
    headings = Headings(count)
    np.testing.assert_array_equal(headings.index_of(headings.steps), np.arange(count))
    assert [headings.towards(2.5 * step) for step in headings.steps] == list(range(count))


@counts
@given(st.integers(1, 7), st.integers(1, 7), st.integers(0, 2**16))
def test_steps_within_cell_by_cell(count, nx, ny, seed):
    known, headings = np.random.default_rng(seed).random((nx, ny)) < 0.8, Headings(count)
    steps = headings.steps_within(known)
    for ix, iy, k in np.ndindex(nx, ny, count):
        cells = np.add((ix, iy), [(0, 0), *headings.between[k], headings.steps[k]])
        inside = ((cells >= 0) & (cells < (nx, ny))).all()
        assert steps[ix, iy, k] == (inside and known[tuple(cells.T)].all())


@counts
@given(st.integers(1, 7), st.integers(1, 7), st.integers(0, 2**16))
def test_a_step_is_the_least_of_the_cells_that_it_leaves(count, nx, ny, seed):
    values, headings = np.random.default_rng(seed).random((nx, ny, count)), Headings(count)
    least = headings.least(values)
    for ix, iy, k in np.argwhere(headings.steps_within(np.ones((nx, ny), dtype=bool))):
        cells = np.add((ix, iy), [(0, 0), *headings.between[k]])
        assert least[ix, iy, k] == values[(*cells.T, k)].min()
    if count == 8:
        assert least is values


@pytest.mark.parametrize("count", [0, 7, 12, 64, -8, "8", None])
def test_other_numbers_are_refused(count):
    with pytest.raises(ConfigError, match="8, 16, 32 or 48"):
        Headings(count)


def test_the_headings_of_a_tensor():
    for count in COUNTS:
        assert Headings.of(np.zeros((2, 3, 4, count))).count == count
    for shape in ((8,), (3, 8), (3, 3, 9), (3, 3, 0)):
        with pytest.raises(PlanningError, match="8, 16, 32 or 48"):
            Headings.of(np.zeros(shape))
