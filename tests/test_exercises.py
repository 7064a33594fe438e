"""The content check: what the exercises ask, what their checks say, and whether both are right."""

import itertools
import json
import subprocess
import sys

import numpy as np
import pytest

from fgtutor.course import checks, exercises
from fgtutor.course.checks import EXERCISES, check, find, hint, questions_of, solution
from fgtutor.course.checks.question import CRASHED, NOT_STARTED, PASSED, TOO_SLOW, WRONG, Judge
from fgtutor.course.exercises import ExercisesConfig
from fgtutor.course.grading.grade import GradeConfig, grade
from fgtutor.course.grading.replies import reply_of
from fgtutor.errors import ConfigError, NotebookError

CAPSTONE = "ex13"
QUESTIONS = [question for exercise in EXERCISES for question in questions_of(exercise)]
BY_ID = pytest.mark.parametrize("question", QUESTIONS, ids=lambda question: question.id)


@pytest.fixture(scope="module")
def root(request):
    return request.config.rootpath


# What is asked ------------------------------------------------------------------------------------


POINTS = {CAPSTONE: 30, "the other exercises": 100}
"""What the course asks for; the capstone stands beside it."""


def test_the_course_asks_for_a_hundred_points_and_the_capstone_for_its_own():
    points = dict.fromkeys(POINTS, 0)
    for question in QUESTIONS:
        points[CAPSTONE if question.id.startswith(CAPSTONE) else "the other exercises"] += (
            question.points
        )
    assert points == POINTS
    assert len(QUESTIONS) >= 36


@pytest.mark.parametrize("exercise", EXERCISES)
def test_every_exercise_asks_at_least_three_questions_in_order(exercise):
    questions = questions_of(exercise)
    assert [question.id for question in questions] == [
        f"{exercise}.q{number}" for number in range(1, len(questions) + 1)
    ]
    assert len(questions) >= 3
    assert len({question.name for question in questions}) == len(questions)


@BY_ID
def test_every_question_has_hints_and_typical_mistakes(question):
    assert len(question.hints) >= 2
    assert (
        len({mistake.says.partition(":")[0] for mistake in question.mistakes})
        == len(question.mistakes)
        >= 3
    )
    assert question.expects.endswith(".") and question.points > 0


@BY_ID
def test_every_typical_mistake_fails_and_is_named(question):
    for seed in (0, 1, 2) if question.draw else (0,):
        arguments = question.cases(seed)
        judge = Judge(question, arguments)
        for mistake in question.mistakes:
            wrong = mistake.answer if question.draw else mistake.answer()
            with np.errstate(all="ignore"):
                reply = reply_of(wrong, arguments, 60.0, harness=question.harness)
            verdict = judge.judge(reply)
            assert verdict.outcome == WRONG, mistake.says
            assert f"Looks like {mistake.says}" in verdict.detail
            assert f"Expected: {question.expects}" in verdict.detail


@BY_ID
def test_cases_follow_from_the_seed(question):
    def plain(seed):
        with np.printoptions(threshold=10**7):  # every number, or two maps may look the same
            return repr(question.cases(seed))

    assert plain(3) == plain(3)
    if question.draw:
        assert plain(3) != plain(4)
        assert len(question.cases(0, 2)) == len(question.examples) + min(2, question.most or 2)


def test_a_number_to_find_is_not_told():
    question = find("ex12.q4")
    verdict = check("ex12.q4", 0.5)
    assert verdict.outcome == WRONG and "0.5" in verdict.detail
    assert str(question.truth()) not in repr(verdict)


# From master to exercise --------------------------------------------------------------------------


def test_exercises_and_solutions_are_what_their_masters_give(root, capsys):
    config = ExercisesConfig(solutions=root / "solutions", exercises=root / "exercises", check=True)
    assert exercises.run(config) == 0, capsys.readouterr().out


@pytest.mark.slow
def test_untouched_exercises_score_nothing_and_solutions_everything(root):
    config = GradeConfig(paths=(root / "exercises", root / "solutions"), seed=11, workers=2)
    marks = grade(config)
    untouched, solved = marks[: len(EXERCISES)], marks[len(EXERCISES) :]
    assert [mark.exercise for mark in untouched] == list(EXERCISES)
    for mark in untouched:
        assert {verdict.outcome for verdict in mark.verdicts} == {NOT_STARTED}, mark
    for mark in solved:
        assert (mark.percent, mark.fault) == (100.0, ""), mark
    assert sum(mark.points for mark in untouched) == 0
    assert sum(mark.points for mark in solved) == sum(POINTS.values())


@pytest.mark.parametrize("exercise", EXERCISES)
def test_no_solution_is_left_in_an_exercise(root, exercise):
    text = (root / "exercises" / f"{exercise}.ipynb").read_text(encoding="utf-8")
    left = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    master = (root / "solutions" / "src" / f"{exercise}.py").read_text(encoding="utf-8")
    regions = [match["code"] for match in exercises.REGION.finditer(master)]
    assert len(regions) == len(questions_of(exercise))
    for line in itertools.chain.from_iterable(region.splitlines() for region in regions):
        # Shorter lines, such as `else:`, are nobody's secret.
        assert len(line.strip()) < 12 or line.strip() not in left
    assert "SOLUTION" not in text and 'outputs": []' in text and "image/png" not in text


@BY_ID
def test_worked_solutions_have_the_signature_that_is_asked_for(question):
    worked = json.loads(checks.SOLUTIONS.read_text(encoding="utf-8"))[question.id]
    starts = [f"def {question.call}:", f"class {question.name}", f"def {question.name}("]
    starts = starts[1:] if question.harness else starts[:1] if question.draw else []
    assert any(start in worked for start in starts or [f"{question.name} = "])


MASTER = """# %% [markdown]
# ## ex10.q1

# %%
def path_length(xy):
    # BEGIN SOLUTION
    return 1
    # END SOLUTION

# %% [markdown]
# ## ex10.q2

# %%
def spl(success, length, reference):
    # BEGIN SOLUTION
    return 1
    # END SOLUTION

# %% [markdown]
# ## ex10.q3

# %%
# BEGIN SOLUTION
half = 2.5
reference_length = 2 * half
# END SOLUTION
"""


@pytest.fixture
def three(monkeypatch):
    """Let exercise 10 have the three questions of `MASTER`."""
    monkeypatch.setattr(exercises, "questions_of", lambda name: questions_of(name)[:3])


def test_building_a_master_by_hand(three, tmp_path):
    master = tmp_path / "ex10.py"
    master.write_text(MASTER)
    built = exercises.build(master)
    stripped, solved = ([cell.source for cell in n.cells] for n in (built.exercise, built.solution))
    question = find("ex10.q1")
    assert stripped[0] == f"## ex10.q1 · {question.title} ({question.points} points)"
    assert stripped[1] == "def path_length(xy):\n    raise NotImplementedError  # your code here"
    assert stripped[5] == (
        "half = ...  # your number here\nreference_length = ...  # your number here"
    )
    assert solved[1] == built.worked["ex10.q1"] == "def path_length(xy):\n    return 1"
    assert built.exercise.metadata["fgtutor"] == {"exercise": "ex10"}


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("# END SOLUTION", "", "without END"),
        ("# ## ex10.q2", "# ## Something", "headings are ex10.q1, ex10.q3"),
        ("def spl(", "def slp(", "no solution region defines what ex10.q2"),
    ],
)
def test_a_broken_master_is_refused(three, tmp_path, old, new, complaint):
    master = tmp_path / "ex10.py"
    master.write_text(MASTER.replace(old, new, 1))
    with pytest.raises(NotebookError, match=complaint):
        exercises.build(master)


def test_a_stale_exercise_is_noticed(root, tmp_path, capsys):
    config = ExercisesConfig(solutions=root / "solutions", exercises=tmp_path, check=True)
    (tmp_path / "ex01.ipynb").write_text("{}")
    assert exercises.run(config) == 1
    assert "ex01.ipynb is not what its master gives" in capsys.readouterr().out


# In the learner's kernel --------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Forget what this kernel has passed and which hints it has seen; keep answers elsewhere."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checks, "_passed", set())
    monkeypatch.setattr(checks, "_tried", set())
    monkeypatch.setattr(checks, "_hints", {})


@pytest.mark.parametrize("exercise", EXERCISES)
@pytest.mark.parametrize("folder", ["exercises", "solutions"])
def test_all_cells_run_in_a_learner_s_kernel(root, folder, exercise):
    notebook = json.loads((root / folder / f"{exercise}.ipynb").read_text(encoding="utf-8"))
    namespace = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), namespace)
    everything = {question.id for question in questions_of(exercise)}
    assert checks._passed == (everything if folder == "solutions" else set())


def spin(success, length, reference):
    while True:
        pass


@pytest.mark.parametrize(
    ("function", "outcome", "detail"),
    [
        (lambda s, p, ref: np.mean(s * ref / np.maximum(p, ref)), PASSED, "is open now"),
        (lambda s, p, ref: np.mean(s), WRONG, "Looks like the success rate"),
        (lambda s, p, ref: None, WRONG, "does it end with `return`"),
        (lambda s, p, ref: "1.0", WRONG, "Expected the number"),
        (lambda s, p, ref: np.ones(3), WRONG, "got an array of shape (3,)"),
        (lambda s, p, ref: s.fill(True) or 1.0, WRONG, "changes its argument `success`"),
        (lambda s, p, ref: 1 / 0, CRASHED, "ZeroDivisionError"),
        (lambda s, p, ref: print, CRASHED, "builtin_function_or_method"),
        (lambda s: 1, CRASHED, "takes 1 positional argument but 3 were given"),
        (0.5, CRASHED, "a function is expected"),
        (..., NOT_STARTED, "three dots"),
    ],
)
def test_check_says_at_once_what_became_of_an_answer(function, outcome, detail):
    verdict = check("ex10.q2", function)
    assert verdict.outcome == outcome and detail in verdict.detail
    assert ("hint(" in verdict.detail) == (outcome != PASSED)


def test_a_function_that_does_not_end_is_stopped(monkeypatch):
    monkeypatch.setattr(checks, "SECONDS", 0.2)
    assert check("ex10.q2", spin).outcome == TOO_SLOW


def test_a_wrong_map_is_drawn():
    verdict = check("ex01.q4", lambda heights, heading: np.zeros_like(heights))
    # The first example steps up 0.2 m from ix 1 to 2, and off the map beyond: both columns differ.
    assert "6 of 9 values differ" in verdict.detail and ".xx\n.xx\n.xx" in verdict.detail


def test_hints_come_one_at_a_time():
    hints = find("ex04.q2").hints
    assert "after a first try" in hint("ex04.q2")
    check("ex04.q2", lambda loss, tau_low, tau_high: loss)
    for number, text in enumerate(hints, start=1):
        assert repr(hint("ex04.q2")) == f"Hint {number} of {len(hints)}: {text}"
    assert hints[-1] in hint("ex04.q2")


def test_the_worked_solution_opens_after_a_pass():
    assert "opens once" in solution("ex10.q1")
    assert check("ex10.q1", lambda xy: np.hypot(*np.diff(xy, axis=0).T).sum()).outcome == PASSED
    assert solution("ex10.q1").startswith("def path_length(xy):")


@pytest.mark.parametrize("name", ["ex04.q9", "ex99.q1", "q1"])
def test_an_unknown_question_lists_the_known_ones(name):
    with pytest.raises(ConfigError, match=r"ex04\.q1|ex01, ex02"):
        check(name, 1.0)


def test_importing_the_checks_is_cheap():
    code = (
        "import sys, fgtutor.course.checks as c; c.check('ex06.q1', ...)\n"
        "print(sorted(sys.modules.keys() & {'torch', 'scipy', 'matplotlib', 'mujoco', 'IPython'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
