import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtutor.errors import ConfigError
from fgtutor.statistics import calibration, spl, wilson_interval


def test_wilson_interval_of_a_known_case():
    # Wilson (1927) for 15 of 20: centre (0.75 + 3.8415/40) / (1 + 3.8415/20) = 0.7097, half 0.1783.
    low, high = wilson_interval(15, 20)
    assert low == pytest.approx(0.5313, abs=1e-4)
    assert high == pytest.approx(0.8881, abs=1e-4)


def test_wilson_interval_is_open_to_failure_when_every_trial_succeeds():
    assert wilson_interval(200, 200) == (pytest.approx(0.98115, abs=1e-4), 1.0)
    assert wilson_interval(0, 10)[0] == 0.0


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_contains_the_share_and_mirrors(case):
    successes, trials = case
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    mirrored = wilson_interval(trials - successes, trials)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=1e-12)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (3, 2), (-1, 2)])
def test_wilson_interval_refuses_impossible_counts(successes, trials):
    with pytest.raises(ConfigError, match="successes"):
        wilson_interval(successes, trials)


def test_spl_by_hand():
    # Success at twice the reference: 1/2; shorter than the reference: capped at 1; failure: 0.
    value = spl(np.array([1, 1, 0]), np.array([10.0, 4.0, 5.0]), 5.0)
    assert value == pytest.approx((0.5 + 1.0 + 0.0) / 3)


def test_spl_needs_a_positive_reference():
    with pytest.raises(ConfigError, match="reference"):
        spl(np.ones(1), np.ones(1), 0.0)


def test_calibration_by_hand():
    # Bin 0: predicted 0.05 twice, measured 0.0 and 0.2: means 0.05, 0.1. Bin 9: 0.95 against 1.
    table, error = calibration(np.array([0.05, 0.05, 0.95]), np.array([0.0, 0.2, 1.0]))
    assert table[0].tolist() == pytest.approx([0.05, 0.1, 2])
    assert table[9].tolist() == pytest.approx([0.95, 1.0, 1])
    assert math.isnan(table[5, 0]) and table[5, 2] == 0
    assert error == pytest.approx((0.05 * 2 + 0.05 * 1) / 3)


def test_a_prediction_of_one_falls_into_the_last_bin():
    table, error = calibration(np.ones(4), np.ones(4))
    assert table[9, 2] == 4 and error == 0


def test_calibration_needs_matching_values():
    with pytest.raises(ConfigError, match="as many"):
        calibration(np.ones(3), np.ones(2))
