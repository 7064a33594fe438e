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


def test_a_field_keeps_what_is_chosen(monkeypatch, capsys):
    widgets = pytest.importorskip("ipywidgets", reason="the lab extra is not installed")
    display = pytest.importorskip("IPython.display")
    shown, columns = [], []
    monkeypatch.setattr("IPython.get_ipython", object)
    monkeypatch.setattr(display, "display", lambda data, **options: shown.append((data, options)))

    class Column(widgets.VBox):
        def __init__(self, children):
            super().__init__(children)
            columns.append(self)

    monkeypatch.setattr(widgets, "VBox", Column)
    ask.predict("Is 1 < 2?", ["yes", "no"])
    ask.predict("How far?")
    assert capsys.readouterr().out == ""  # what is shown live is not printed too
    data, options = shown[0]
    assert data["text/plain"] == "Predict first: Is 1 < 2?\n  a) yes\n  b) no"
    assert options["metadata"] == ask.ALONE and len(data) > 1
    heading, radio = columns[0].children
    assert "Is 1 &lt; 2?" in heading.value
    line = columns[1].children[1]
    assert isinstance(radio, widgets.RadioButtons) and radio.value is None
    radio.value, line.value = "no", "2 m"
    assert [one.said for one in ask._asked] == ["no", "2 m"]


def test_questions_without_meaning_are_refused():
    with pytest.raises(ConfigError, match=r"run the cell with predict"):
        ask.reveal("up")
    with pytest.raises(ConfigError, match="needs a question"):
        ask.predict("  ")
    for choices in (["only"], [], "ab"):
        with pytest.raises(ConfigError, match="at least two choices"):
            ask.predict("Which?", choices)
