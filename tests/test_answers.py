"""Values that cross from a submission: unchanged, plain, and never more than what they are."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from fgtutor.course.checks import EXERCISES, find, questions_of
from fgtutor.course.checks.question import CRASHED, PASSED, WRONG, Judge
from fgtutor.course.grading.answers import decode, difference, encode
from fgtutor.course.grading.replies import reply_of
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


NUMBERS = [q for exercise in EXERCISES for q in questions_of(exercise) if q.draw is None]
KINDS = [
    "x", "", b"x", [1.0, 2.0], (1, 2), ["x", 1], [], [[1.0], [2.0]], [[1.0, 2.0], [3.0]], 1.5, -1,
    True, float("nan"), float("inf"), 1j, 2**70, {}, {"a": 1}, {1}, object(), print, None, ...,
    np.zeros(3), np.zeros((2, 2)), np.array([]), np.array("x"), np.array([None]), np.float32(1.5),
    np.array([1j]), [[[[[[1]]]]]], [None], "1.0", range(3), Exception("x"), np.datetime64("2020"),
]  # fmt: skip
"""Answers of every kind to a question for a number."""


@pytest.mark.parametrize("question", NUMBERS, ids=lambda question: question.id)
def test_no_wrong_answer_is_told_the_number_to_find(question):
    """Whatever differs, type or size or shape, nothing is said that follows from the number.

    The same is said when the number to find is another one: so it cannot tell anything about it.
    """
    truth = question.truth()
    others = [replace(question, truth=lambda k=k: truth * k, mistakes=()) for k in (1, 3.7, -11.3)]
    for answer in KINDS:
        reply = reply_of(answer, None, 5.0)
        said = {Judge(other, None, tell=False).judge(reply).detail for other in others}
        assert len(said) == 1, answer
        assert Judge(question, None).judge(reply).outcome != PASSED


def test_nothing_of_a_secret_array_is_told():
    secret = np.array([[12.5, 13.5]])
    for got in (None, "x", [1, 2], np.zeros((2, 1)), np.zeros((1, 2)), 1j, 3.0, [[1], [2, 3]]):
        for expected in (secret, (secret, 14.5)):
            text = difference(expected, got, show=False)
            assert text and not {"12.5", "13.5", "14.5", "(1, 2)"} & {*text.split()}
            assert "axes" not in text


def test_tensors_cross_as_arrays_and_cases_as_tensors():
    torch = pytest.importorskip("torch")
    tensor = torch.tensor([1.0, 2.0], requires_grad=True)
    np.testing.assert_equal(decode(encode(tensor)), np.array([1, 2], dtype=np.float32))
    back = decode(json.loads(json.dumps(encode((tensor, 3), tensors=True))), tensors=True)
    assert isinstance(back[0], torch.Tensor) and back[0].tolist() == [1.0, 2.0] and back[1] == 3
    with pytest.raises(ConfigError):  # what a submission sends is never a tensor
        decode(encode(tensor, tensors=True))


def test_the_heading_that_is_drawn_is_named():
    expected = np.zeros((3, 3, 8))
    got = expected.copy()
    got[0, 0, 3] = got[1, 1, 3] = got[2, 2, 5] = 1.0
    text = difference(expected, got)
    assert "heading 3 (-x+y), [:, :, 3], which has the most of all 8" in text
    assert text.endswith("...\n.x.\nx..")


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
