"""What passes is kept in mine.py and runs on its own; verdicts say what a learner needs."""

import linecache
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cells import cell

from fgtutor.course import checks, mine
from fgtutor.course.checks import case, check, find, hint, kept, reset, solution, with_mine
from fgtutor.course.checks.question import PASSED, WRONG, Judge
from fgtutor.course.grading.grade import GradeConfig, grade
from fgtutor.course.grading.replies import reply_of
from fgtutor.course.sources import source_of
from fgtutor.errors import ConfigError

OOD_WEIGHT = """import numpy as np

ONE = 1.0

def ramp(loss, low, high):
    return ONE - (loss - low) / (high - low)

def ood_weight(loss, tau_low, tau_high):
    return np.clip(ramp(loss, tau_low, tau_high), 0, ONE)
"""
WRONG_WEIGHT = "def ood_weight(loss, tau_low, tau_high):\n    return loss * 0\n"
SPL = """import numpy as np

def spl(success, length, reference):
    return float(np.mean(success * reference / np.maximum(length, reference)))
"""
QUESTIONS = [
    question for exercise in checks.EXERCISES for question in checks.questions_of(exercise)
]


@pytest.fixture(autouse=True)
def folder(new_learner):
    """Work in a folder of its own, in a kernel that has passed nothing."""
    return new_learner


# Keeping ------------------------------------------------------------------------------------------


def test_a_pass_is_kept_with_all_that_it_needs(folder, monkeypatch):
    verdict = check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    assert verdict.outcome == PASSED and "Kept in mine.py." in verdict.detail
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    import mine as hers  # pyright: ignore[reportMissingImports]

    assert hers.ood_weight(np.array([1.05]), 0.1, 2.0) == pytest.approx([0.5])
    assert "def ramp" in kept("ex04.q2") and repr(kept()) == "ex04.q2 ood_weight"


def test_only_a_pass_is_written():
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    before = Path(mine.FILE).read_bytes()
    assert check("ex04.q2", cell(WRONG_WEIGHT).ood_weight).outcome == WRONG
    for answer in (..., 3, lambda a, b, c: 1 / 0):
        check("ex04.q2", answer)
    assert Path(mine.FILE).read_bytes() == before


def test_a_pass_over_fewer_cases_is_not_kept():
    assert "fewer cases" in check("ex04.q2", cell(OOD_WEIGHT).ood_weight, cases=1).detail
    assert mine.read() == {}


def test_a_second_pass_replaces_the_first_and_sections_keep_the_order_of_the_course():
    check("ex10.q2", cell(SPL).spl)
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    check("ex04.q2", cell(OOD_WEIGHT.replace("ramp", "slope")).ood_weight)
    assert [*mine.read()] == ["ex04.q2", "ex10.q2"]
    assert "slope" in mine.read()["ex04.q2"] and "ramp" not in mine.read()["ex04.q2"]


def test_a_number_is_kept_as_an_assignment():
    verdict = check("ex04.q4", np.float64(find("ex04.q4").truth()))
    assert "Kept" in verdict.detail and mine.read()["ex04.q4"].startswith("largest_loss = 1.78")


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("ood_weight = lambda x, a, b: np.clip(1 - (x - a) / (b - a), 0, 1)", "lambda"),
        (
            "def make(one):\n    def ood_weight(x, a, b):\n"
            "        return np.clip(one - (x - a) / (b - a), 0, 1)\n    return ood_weight\n"
            "ood_weight = make(1)",
            "defined inside a function and uses its one",
        ),
        (
            "state = {'one': object(), 1: 1}\n"
            "def ood_weight(x, a, b):\n    return np.clip(state[1] - (x - a) / (b - a), 0, 1)",
            "`ood_weight` uses `state`, a dict from elsewhere in the notebook",
        ),
        ("def ood_weight(x, a, b):\n    return np.clip(1 - (x - a) / (b - a), 0, 1)", None),
    ],
)
def test_what_cannot_be_kept_passes_all_the_same_and_says_why(source, reason):
    answer = cell(source, np=np).ood_weight
    if reason is None:  # its source is gone
        linecache.cache.clear()
        reason = "the source of `ood_weight` cannot be had"
    verdict = check("ex04.q2", answer)
    assert verdict.outcome == PASSED
    assert "could not be kept in mine.py" in verdict.detail and reason in verdict.detail
    assert not (mine.read())


def test_an_answer_that_depends_on_the_notebook_s_state_is_not_kept():
    source = (
        "import numpy as np\ncount = 0\ndef ood_weight(x, a, b):\n    global count\n"
        "    count += 1\n    return np.clip(1 - (x - a) / (b - a), 0, 1) + (count > 20)\n"
    )
    answer = cell(source).ood_weight
    verdict = check("ex04.q2", answer)
    tried = answer.__globals__["count"]
    assert verdict.outcome == PASSED and tried <= 20 < 2 * tried
    # Taken out, it has the count it had by then, so a second run of the cases no longer passes.
    assert "does not pass" in verdict.detail and mine.read() == {}
    assert "Kept" in check("ex04.q2", cell(source.replace("20", "99")).ood_weight).detail
    assert f"count = {tried}" in mine.read()["ex04.q2"]


def test_names_that_clash_between_questions_are_refused():
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    other = SPL.replace("return float", "return ONE * float").replace("def spl", "ONE = 1\ndef spl")
    verdict = check("ex10.q2", cell(other).spl)
    assert verdict.outcome == PASSED
    assert "`ONE` means something else in what is kept for ex04.q2" in verdict.detail
    reset("ex04.q2")
    assert "Kept" in check("ex10.q2", cell(other).spl).detail


def test_classes_imports_constants_and_decorators_come_along():
    source = (
        "import scipy\nimport torch.nn as nn\nfrom functools import lru_cache\n"
        "from fgtutor.directions import STEPS\nimport numpy as np\n"
        "TABLE = np.array([[1.0, np.inf], [3.0, 4.0]])\nLIMITS = (0, float('nan'))\n"
        "class Base(nn.Module):\n    def forward(self, x):\n        return x + LIMITS[0]\n"
        "class Net(Base):\n    def __init__(self):\n        super().__init__()\n"
        "@lru_cache\ndef factorial(n: int) -> 'int':\n"
        "    return 1 if n < 2 else n * factorial(n - 1)\n"
        "def answer(x):\n    TABLE_ = TABLE + 0\n"
        "    return Net()(x), factorial(5), TABLE_[0], STEPS[2], scipy.sparse.csgraph.dijkstra\n"
    )
    text = source_of("asked", cell(source).answer)
    assert "from fgtutor.directions import STEPS" in text and "import scipy.sparse.csgraph" in text
    total, five, row, step, _ = mine.run(text)["asked"](2)
    assert (total, five, row.tolist(), step.tolist()) == (2, 120, [1.0, np.inf], [0, 1])


# The file -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda text: "x = 1\n", "was not written by `check`"),
        (lambda text: text.replace("ONE = 1.0", "ONE = 2.0"), "ex04.q2 in .* changed by hand"),
        (lambda text: text[:-30], "changed by hand"),
        (lambda text: text.replace("# %%", "x = 1\n# %%", 1), "more than its sections"),
        (lambda text: text.replace("planner", "plans", 1), "does not begin as"),
    ],
)
def test_a_changed_file_is_an_error_and_is_not_lost(folder, change, complaint):
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    path = folder / mine.FILE
    path.write_text(text := change(path.read_text()))
    for doing in (mine.read, mine.load, kept, lambda: with_mine("ex04")):
        with pytest.raises(ConfigError, match=complaint):
            doing()
    verdict = check("ex10.q2", cell(SPL).spl)
    assert verdict.outcome == PASSED and "could not be kept" in verdict.detail
    assert path.read_text() == text


def test_bytes_that_are_no_text_are_an_error(folder):
    (folder / mine.FILE).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="no text"):
        mine.read()


def test_reset_forgets_one_question_or_puts_the_file_aside(folder):
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    check("ex10.q2", cell(SPL).spl)
    path = folder / mine.FILE
    path.write_text(path.read_text().replace("ONE = 1.0", "ONE = 2.0"))
    assert "no longer" in reset("ex04.q2")  # also if it was changed by hand
    assert [*mine.read()] == ["ex10.q2"]
    assert "opens once" in solution("ex04.q2") and "def spl" in solution("ex10.q2")
    assert "nothing is kept" in reset("ex04.q2")
    reset()
    assert mine.read() == {} and "def spl" in (folder / "mine-old.py").read_text()


def test_progress_counts_the_whole_course_over_kernels(monkeypatch):
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    monkeypatch.setattr(checks, "_passed", set())  # a new kernel
    points = find("ex04.q2").points + find("ex10.q2").points
    assert (
        f"2 of {len(QUESTIONS)} questions, {points} of " in check("ex10.q2", cell(SPL).spl).detail
    )


def test_a_disk_that_refuses_costs_no_pass(folder, monkeypatch):
    (folder / mine.FILE).mkdir()
    verdict = check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    assert verdict.outcome == PASSED and "could not be kept" in verdict.detail


@pytest.mark.slow
def test_what_is_kept_is_graded(folder):
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    check("ex10.q2", cell(SPL).spl)
    hand_in = folder / "in" / "ada"
    hand_in.mkdir(parents=True)
    (hand_in / "mine.py").write_text((folder / mine.FILE).read_text())
    marks = grade(GradeConfig(paths=(folder / "in",), seed=9, workers=1))
    assert [(mark.learner, mark.exercise, mark.fault) for mark in marks] == [
        ("ada", "ex04", ""),
        ("ada", "ex10", ""),
    ]
    assert [mark.points for mark in marks] == [find("ex04.q2").points, find("ex10.q2").points]


# What the learner is told -------------------------------------------------------------------------


def test_the_failing_case_is_handed_over():
    verdict = check("ex04.q2", cell(WRONG_WEIGHT).ood_weight, seed=3)
    assert verdict.case == 1
    assert 'case("ex04.q2", 1, seed=3) gives you that case.' in verdict.detail
    loss, low, high = given = case("ex04.q2", 2, seed=3)
    assert given.tau_low == low < high and isinstance(loss, np.ndarray)
    loss[:] = -1.0  # the learner's own copy
    assert (case("ex04.q2", 2, seed=3).loss >= 0).all()
    case("ex04.q2", 1).loss[:] = -1.0  # nor that of an example
    assert (case("ex04.q2", 1).loss >= 0).all()


@pytest.mark.parametrize("number", [0, 999, "1", 1.0, True])
def test_a_case_that_is_none_is_refused(number):
    with pytest.raises(ConfigError, match="has cases 1 to"):
        case("ex04.q2", number)
    with pytest.raises(ConfigError, match="no cases"):
        case("ex04.q4", 1)


def test_the_property_is_told_from_the_second_try():
    expects = find("ex04.q2").expects
    answer = cell(WRONG_WEIGHT).ood_weight
    assert expects not in check("ex04.q2", answer).detail
    assert expects in check("ex04.q2", answer).detail


def test_hints_come_after_a_try():
    assert "after a first try" in hint("ex04.q2")
    check("ex04.q2", ...)
    assert "after a first try" in hint("ex04.q2")
    check("ex04.q2", cell(WRONG_WEIGHT).ood_weight)
    assert hint("ex04.q2").startswith("Hint 1 of")


def test_a_verdict_has_a_sign_a_word_and_a_colour_and_no_foreign_html():
    verdict = check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    assert repr(verdict).startswith("\N{CHECK MARK} ex04.q2") and ": passed" in repr(verdict)
    assert "\N{CHECK MARK}" in verdict._repr_html_() and "passed" in verdict._repr_html_()
    verdict = check(
        "ex04.q2", cell("def ood_weight(*a):\n    raise ValueError('<script>')").ood_weight
    )
    assert repr(verdict).startswith("\N{BALLOT X} ex04.q2")
    assert "<script>" not in verdict._repr_html_() and "&lt;script&gt;" in verdict._repr_html_()


@pytest.mark.parametrize("kind", ["arrays", "tensors"])
def test_single_precision_is_precise_enough_unless_forbidden(kind):
    import torch

    def weight(loss, low, high):
        if kind == "tensors":
            loss = torch.tensor(loss, dtype=torch.float32, requires_grad=True)
            return torch.clip(1 - (loss - low) / (high - low), 0, 1)
        loss, low, high = np.float32(loss), np.float32(low), np.float32(high)
        return np.clip(1 - (loss - low) / (high - low), 0, 1)

    for seed in range(6):
        assert check("ex04.q2", weight, seed=seed).outcome == PASSED
    from dataclasses import replace

    strict = replace(find("ex04.q2"), single=False, rtol=1e-9, atol=0)
    arguments = strict.cases(0)
    assert Judge(strict, arguments).judge(reply_of(weight, arguments, 9.0)).outcome == WRONG


def test_integers_are_asked_for_where_they_matter():
    from dataclasses import replace

    strict = replace(find("ex01.q1"), integers=True)
    arguments = strict.cases(0)
    floats = lambda xy, origin, resolution: np.floor((xy - origin) / resolution)  # noqa: E731
    detail = Judge(strict, arguments).judge(reply_of(floats, arguments, 9.0)).detail
    assert "Expected integers, got numbers of type float64" in detail
    assert Judge(strict, arguments).judge(reply_of(strict.truth, arguments, 9.0)).outcome == PASSED


# In a browser -----------------------------------------------------------------------------------


def test_without_torch_the_planner_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(checks, "find_spec", lambda name: None)
    assert with_mine("ex01") is None
    assert "needs torch, which is not here" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="no exercise 'ex99'"):
        with_mine("ex99")


def test_a_browser_without_storage_is_told(folder, monkeypatch):
    monkeypatch.setattr(sys, "platform", "emscripten")
    told = "Kept in mine.py until this page closes"
    assert told in check("ex10.q2", cell(SPL).spl).detail
    monkeypatch.setattr(mine, "DRIVE", str(folder))
    assert "Kept in mine.py.\n" in check("ex10.q2", cell(SPL).spl).detail


@pytest.mark.parametrize("options", [{"seed": -1}, {"seed": 0.5}, {"cases": 0}, {"cases": True}])
def test_what_cannot_be_drawn_is_refused(options):
    (name,) = options
    with pytest.raises(ConfigError, match=f"^{name}: should be a whole number from "):
        check("ex10.q2", len, **options)


def test_the_checks_load_nothing_that_a_browser_lacks():
    code = """if True:
        import sys
        sys.modules |= dict.fromkeys(["torch", "pydantic", "psutil", "scipy", "matplotlib"])
        from fgtutor.course.checks import check, progress
        print(check("ex10.q2", len).outcome, progress())
    """
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.startswith("crashed The course so far: 0 of 59"), done.stdout
