"""Cells and coordinates: exact at every origin and in every unit."""

import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtutor.errors import MapError
from fgtutor.grid import MOST_CELLS, cells_of, check_cells, coordinate_text, point_text

RESOLUTIONS = (0.1, 0.05, 0.2, 0.25, 0.3, 0.02, 0.01, 0.125, 1.0, 2.0, 30.0, 1 / 3, 0.3048)
places = st.integers(-(10**12), 10**12).map(lambda n: Decimal(n) / 10**5)  # to 10 000 km, 10 um


def exactly(value: Decimal | Fraction, corner: Decimal, resolution: float) -> int:
    """Return the cell by exact arithmetic on the decimals that were written."""
    step = Fraction(1, 3) if resolution == 1 / 3 else Fraction(str(resolution))
    return math.floor((Fraction(value) - Fraction(corner)) / step)


@given(places, st.integers(-(10**5), 10**5), st.sampled_from(RESOLUTIONS))
@settings(max_examples=500, deadline=None)
def test_borders_belong_to_the_upper_cell_at_any_origin(corner, cell, resolution) -> None:
    step = Fraction(1, 3) if resolution == 1 / 3 else Fraction(str(resolution))
    border = Fraction(corner) + cell * step
    for share, expected in ((0, cell), (Fraction(1, 2), cell), (Fraction(-1, 1000), cell - 1)):
        point = float(border + share * step)
        assert cells_of(point, float(corner), resolution) == expected
    mapped = float(corner) + cell * resolution  # computed, not written
    assert cells_of(mapped, float(corner), resolution) == cell


@given(places, st.integers(0, 10**7), st.sampled_from((0.05, 0.1, 0.2, 0.25, 0.5, 1.0)))
@settings(max_examples=300, deadline=None)
def test_las_coordinates_are_sorted_as_their_whole_numbers(offset, raw, resolution) -> None:
    stored = raw * 0.01 + float(offset)  # what laspy computes
    corner = float(offset // 1)
    expected = exactly(Decimal(raw) / 100 + offset, Decimal(offset // 1), resolution)
    assert cells_of(stored, corner, resolution) == expected


@given(places, places, st.sampled_from(RESOLUTIONS))
@settings(max_examples=300, deadline=None)
def test_any_decimal_lies_where_exact_arithmetic_puts_it(value, corner, resolution) -> None:
    expected = exactly(value, corner, resolution)
    assert cells_of(float(value), float(corner), resolution) == expected


def test_all_borders_of_a_map_in_utm() -> None:
    for x0, y0 in (
        (Decimal(500000), Decimal(4649776)),
        (Decimal("500000.35"), Decimal("5648298.15")),
    ):
        for corner in (x0, y0):
            borders = [float(corner + n * Decimal("0.1")) for n in range(201)]
            assert cells_of(borders, float(corner), 0.1).tolist() == list(range(201))


def test_single_floats_are_sorted_by_their_own_precision() -> None:
    borders = (np.arange(200) * Decimal("0.05")).astype(np.float32)
    assert cells_of(borders, 0.0, 0.05).tolist() == list(range(200))
    far = np.float32([665171.0, 665171.0625])  # a step of the type is more than a cell
    assert cells_of(far, 665171.0, 0.05).tolist() == [0, 1]


def test_absurd_coordinates_are_cut_off_or_refused() -> None:
    with np.errstate(all="raise"):
        cells = cells_of([-1.7e308, 1.7e308, math.inf], 1e308, 0.1)
    assert cells.tolist() == [-(2**61), 2**61, 2**61]
    with pytest.raises(MapError, match="NaN"):
        cells_of([0.0, math.nan], 0.0, 0.1)
    with pytest.raises(MapError, match=f"60000 x 60000 cells are more than {MOST_CELLS}"):
        check_cells((60_000, 60_000))
    check_cells((5000, 5000))


@pytest.mark.parametrize(
    ("value", "resolution", "text"),
    [
        (4649775.0, 0.1, "4649775.00"),
        (4649775.05, 0.05, "4649775.05"),
        (0.0125, 0.0005, "0.0125"),
        (-0.001, 0.1, "0.00"),
        (1e300, 0.1, "1e+300"),
        (math.nan, 0.1, "nan"),
        (12.5, 30.0, "12.50"),
    ],
)
def test_coordinates_are_written_to_the_cell(value: float, resolution: float, text: str) -> None:
    assert coordinate_text(value, resolution) == text


def test_a_point_as_text() -> None:
    assert point_text((500001, 4649775.0), 0.1) == "(500001.00, 4649775.00)"
