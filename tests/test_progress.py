"""What is shown of work in progress: a bar, an expected time, a line while one waits."""

import threading

import pytest

from fgtutor.io import progress
from fgtutor.io.progress import duration, waiting, watch


def test_the_parts_pass_through_unchanged_and_unseen(capsys):
    assert list(watch(iter("abc"), 3, "spelling", show=True)) == ["a", "b", "c"]
    assert list(watch("abc", 3, "spelling", show=False)) == ["a", "b", "c"]
    assert capsys.readouterr() == ("", "")


def test_work_that_lasts_shows_a_bar_and_the_expected_time(monkeypatch, capsys):
    for name in ("QUICK", "TRIED", "LONG"):
        monkeypatch.setattr(progress, name, 0.0)
    list(watch("abc", 3, "spelling", show=True, unit="letter"))
    shown = capsys.readouterr().err
    assert "spelling: about 0 s\n" in shown and "3/3" in shown and "letter" in shown
    list(watch("abc", 3, "spelling", show=False))
    assert not capsys.readouterr().err


def test_a_line_is_said_while_one_waits_and_not_after(monkeypatch, capsys):
    monkeypatch.setattr(progress, "QUICK", 0.0)
    with waiting("boiling") as timer:
        timer.join()
    assert capsys.readouterr().err == "boiling ...\n"
    monkeypatch.setattr(progress, "QUICK", 3600.0)
    with waiting("boiling") as timer:
        pass
    timer.join()
    assert not capsys.readouterr().err
    assert timer not in threading.enumerate()


@pytest.mark.parametrize(
    ("seconds", "words"), [(12.4, "12 s"), (89, "89 s"), (600, "10 min"), (9000, "2.5 h")]
)
def test_an_expected_time_is_round(seconds, words):
    assert duration(seconds) == words
