"""Questions to the learner: the prediction stands beside the answer, and nobody is waited for."""

import pytest

from fgtutor.course import ask
from fgtutor.errors import ConfigError


@pytest.fixture(autouse=True)
def nothing_asked(monkeypatch):
    monkeypatch.setattr(ask, "_asked", [])


def test_without_a_reader_the_question_and_the_answer_are_text(capsys):
    ask.predict("Which way is harder?", ["up", "down"])
    assert capsys.readouterr().out == (
        "Predict first: Which way is harder?\n  a) up\n  b) down\n"
    )  # fmt: skip
    assert repr(ask.reveal("up")) == "The answer:    up"


@pytest.mark.parametrize(
    ("said", "verdict"), [("up", "as you predicted"), ("down", "not as you predicted")]
)
def test_a_prediction_stands_beside_the_answer(said, verdict):
    ask.predict("Which way is harder?", ["up", "down"])
    ask._asked[-1].said = said
    shown = ask.reveal("up")
    assert repr(shown) == f"You predicted: {said}\nThe answer:    up ({verdict})"
    table = shown._repr_html_()
    assert table.index("Which way") < table.index(said) < table.index("<b>up</b>")
    assert f"({verdict})" in table


def test_own_words_get_no_verdict():
    ask.predict("How far?")
    ask._asked[-1].said = "2 m"
    shown = ask.reveal("2.1 m")
    assert repr(shown) == "You predicted: 2 m\nThe answer:    2.1 m"


def test_what_is_shown_cannot_break_the_page():
    ask.predict("Is a < b?", ["<b>", "no"])
    ask._asked[-1].said = "<script>"
    assert "<script>" not in ask.reveal("no")._repr_html_()


def test_a_field_keeps_what_is_chosen(monkeypatch):
    widgets = pytest.importorskip("ipywidgets", reason="the lab extra is not installed")
    display = pytest.importorskip("IPython.display")
    shown = []
    monkeypatch.setattr("IPython.get_ipython", object)
    monkeypatch.setattr(display, "display", shown.append)
    ask.predict("Which way is harder?", ["up", "down"])
    ask.predict("How far?")
    radio, line = shown
    assert isinstance(radio, widgets.RadioButtons) and radio.value is None
    radio.value, line.value = "down", "2 m"
    assert [one.said for one in ask._asked] == ["down", "2 m"]


def test_questions_without_meaning_are_refused():
    with pytest.raises(ConfigError, match=r"run the cell with predict"):
        ask.reveal("up")
    with pytest.raises(ConfigError, match="needs a question"):
        ask.predict("  ")
    for choices in (["only"], [], "ab"):
        with pytest.raises(ConfigError, match="at least two choices"):
            ask.predict("Which?", choices)
