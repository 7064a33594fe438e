"""Values that cross from a submission: unchanged, plain, and never more than what they are."""

import json
import tracemalloc

import numpy as np
import pytest

from fgtutor.course.checks import find
from fgtutor.course.checks.question import CRASHED, WRONG, Judge
from fgtutor.course.grading.answers import decode, difference, encode
from fgtutor.errors import ConfigError

Q1, Q3 = "ex10.q1", "ex10.q3"


@pytest.mark.parametrize(
    "reply",
    [
        {},
        {"answers": "passed"},
        {"answers": [{"array": ["object", [1], "AAAA"]}]},
        {"answers": [{"array": ["float64", [-1, 10**30], "AAAA"]}]},
        {"answers": [{"array": ["float64", [1], "AAAAAAAA8D8="]}] * 3},
        {"answers": [10**400]},
        {"answers": [[1]]},
        {"answers": [{"list": [{"list": [[]]}]}]},
        {"outcome": ["passed"]},
        {"outcome": "passed"},
        {"changed": [1]},
        {"changed": -1},
        {"changed": 0.0},
        {"changed": 10**30},
        {"changed": 0, "answers": None, "points": 100},
        {"answers": None, "detail": None},
        {"answers": [float("nan")]},
        {"answers": [[]] * 10**5},
        {"answers": [{"list": [{"list": []}] * 10**5}]},
        {"answers": [{"array": ["float64", [0, 10**18], ""]}]},
        {"answers": [{"array": ["float64", "1", "AAAAAAAA8D8="]}]},
        {"answers": [{"array": [["float64"], [1], "AAAAAAAA8D8="]}]},
        {"answers": [{"array": None}]},
        {"answers": [{"list": "passed"}]},
        {"answers": [{"tuple": ["x"]}] * 3, "question": 7},
    ],
)
def test_a_forged_reply_never_passes(reply):
    for question in (find(Q1), find(Q3)):
        verdict = Judge(question, question.cases(0)).judge(reply)
        assert verdict.outcome in (CRASHED, WRONG)


def test_a_text_among_numbers_takes_no_more_memory_than_it_has():
    """Numpy would make every number as wide as the text: 400 MB here."""
    bomb = {"answers": [{"list": ["x" * 10_000, *[1] * 10_000]}]}
    tracemalloc.start()
    try:
        verdict = Judge(find(Q3), None).judge(bomb)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert verdict.outcome == WRONG


@pytest.mark.parametrize(
    "answer", ["x", {"list": [1.0, 2.0]}, {"list": ["x", 1]}, {"list": []}, 1.5]
)
def test_no_wrong_answer_is_told_the_number_to_find(answer):
    detail = Judge(find(Q3), None).judge({"answers": [answer]}).detail
    assert "5.0" not in detail


def test_a_deep_reply_is_unreadable_not_an_end():
    deep = "x"
    for _ in range(5000):
        deep = {"list": [deep]}
    assert Judge(find(Q3), None).judge({"answers": [deep]}).outcome == CRASHED


@pytest.mark.parametrize(
    "value",
    [None, True, 3, 0.5, float("nan"), "text", (1, [2.0, "a"]), np.arange(6).reshape(2, 3)],
)
def test_values_cross_unchanged(value):
    back = decode(json.loads(json.dumps(encode(value))))
    assert type(back) is type(value)
    np.testing.assert_equal(back, value)


@pytest.mark.parametrize("value", [print, {"a": 1}, np.array([None]), 1j, np.zeros(10**5)])
def test_values_that_are_not_plain_numbers_do_not_cross(value):
    with pytest.raises(ConfigError):
        encode(value)


def test_differences_are_shown_where_they_are():
    expected = np.zeros((4, 3))
    got = expected.copy()
    got[3, 0] = 1
    text = difference(expected, got)
    assert "1 of 12 values differ" in text and "[3, 0]  0         1" in text
    assert text.endswith("....\n....\n...x")  # x to the right, y up: cell (3, 0) is lower right
    assert "two axes swapped" in difference(expected, got.T)
    assert difference(np.array([1.0, np.nan]), np.array([1, np.nan])) == ""
    assert "value 2 of the 2" in difference((1.0, 2.0), [1.0, 3.0])
    assert "Expected 2 values" in difference((1.0, 2.0), np.array(1.0))
    # Numbers that agree in four digits are shown with more.
    assert "1.00001" in difference(np.array([1.0]), np.array([1.00001]), rtol=1e-8)
