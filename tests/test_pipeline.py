"""The planner with the learner's functions: each takes the library's place, or is named."""

import numpy as np
import pytest
import torch
from cells import cell, solved

from fgtutor import patches
from fgtutor.course import checks, mine, own_net, stages
from fgtutor.course.checks import check, with_mine
from fgtutor.course.crossing import glided
from fgtutor.course.pipeline import PICTURES
from fgtutor.course.planner_pictures import draw_capstone, renewed
from fgtutor.course.stages import corridor, planned
from fgtutor.course.substitutes import Stages
from fgtutor.execution import FollowConfig
from fgtutor.feasibility import ALPHA

OOD_WEIGHT = """import numpy as np

def ood_weight(loss, tau_low, tau_high):
    return np.clip((tau_high - loss) / (tau_high - tau_low), 0, 1)
"""

pytestmark = pytest.mark.usefixtures("new_learner")


@pytest.mark.slow
@pytest.mark.parametrize("exercise", checks.EXERCISES)
def test_every_solution_is_kept_and_runs_in_the_planner(request, exercise, capsys):
    solved(request.config.rootpath, exercise)
    assert [*mine.read()] == [question.id for question in checks.questions_of(exercise)]
    figure = with_mine(exercise)
    said = capsys.readouterr().out
    assert figure is not None and "fails on the real data" not in said, said
    own = {question.name for question in checks.questions_of(exercise)} & {*PICTURES[exercise][1]}
    yours = next(line for line in said.splitlines() if line.startswith("Yours:"))
    assert own and own <= {*yours[6:].strip(" .").split(", ")}


def test_every_function_in_a_picture_is_asked_for():
    questions = [one for exercise in checks.EXERCISES for one in checks.questions_of(exercise)]
    names = {question.name for question in questions}
    assert len(names) == len(questions)  # mine.py is one module
    for exercise, (_, used) in PICTURES.items():
        assert {*used} <= names, exercise
    assert {*checks.EXERCISES} <= {*PICTURES}


def test_without_a_pass_it_is_said_what_to_do_first(capsys):
    assert with_mine("ex04") is None
    assert "write reconstruction_loss, and run its check" in capsys.readouterr().out


@pytest.mark.slow
def test_a_learner_s_function_takes_the_library_s_place(capsys):
    check("ex04.q2", cell(OOD_WEIGHT).ood_weight)
    figure = with_mine("ex04")
    assert figure is not None and figure.axes
    said = capsys.readouterr().out
    assert "Yours: ood_weight." in said
    ours = "tensorize, cut_patch, reconstruction_loss, FeasibilityNet, conformal_weight"
    assert f"The library's: {ours}." in said


@pytest.mark.slow
def test_a_function_that_fails_on_the_real_data_is_named_and_replaced():
    def broken(loss, low, high):
        raise RuntimeError("only for arrays of shape (4, 5)")

    own = Stages({"ood_weight": broken, "fuse": lambda tensors: (0.0, 0.0)}, [])
    theirs = planned(Stages({}, []))
    route = planned(own)
    np.testing.assert_array_equal(route.cells, theirs.cells)
    assert "ood_weight" in own.ours and "fuse" in own.ours and not own.hers
    assert "Your `ood_weight` fails" in own.report() and "shape (4, 5)" in own.report()
    assert "Your `fuse` fails" in own.report()


@pytest.mark.slow
def test_a_learner_s_patches_are_those_of_the_library(request):
    surface, ours = patches.prepare(corridor().elevation), stages.library_patches()
    tensorize = solved(request.config.rootpath, "ex05")["tensorize"]
    np.testing.assert_allclose(stages.windows_of(tensorize, surface), ours[:, :, ::2], atol=2e-5)
    cut_patch = solved(request.config.rootpath, "ex01")["cut_patch"]
    cut = stages.diagonals_of(cut_patch, surface)
    np.testing.assert_allclose(cut, ours[:, :, stages.AHEAD], atol=2e-5)


@pytest.mark.slow
def test_a_learner_s_net_is_asked_in_place_of_the_specialist_s(request):
    own = Stages({own_net.NET: solved(request.config.rootpath, "ex03")[own_net.NET]}, [])
    hers, ours = stages.asked(own), stages.asked(Stages({}, []))
    assert own_net.NET in own.hers and not own.faults
    for name, (f, loss) in hers.items():
        assert np.array_equal(f, ours[name][0]) == (name != stages.TRAINED), name
        np.testing.assert_array_equal(loss, ours[name][1])
    f, theirs = hers[stages.TRAINED][0], ours[stages.TRAINED][0]
    assert f.shape == theirs.shape and f.min() >= 0 and f.max() <= 1
    assert np.corrcoef(f.ravel(), theirs.ravel())[0, 1] > 0.3  # both have seen steps
    assert np.allclose(planned(own).xy[-1], corridor().goal, atol=0.1)


@pytest.mark.slow
def test_a_net_that_answers_something_else_is_named_and_replaced():
    class Mute(torch.nn.Linear):
        def __init__(self, *sizes):
            super().__init__(2, 2)

        def feasibility(self, patch, command):
            return patch

    own = Stages({own_net.NET: Mute}, [])
    np.testing.assert_array_equal(planned(own).cells, stages.library_route().cells)
    assert f"Your `{own_net.NET}` fails" in own.report() and "instead of" in own.report()


@pytest.mark.slow
def test_a_learner_s_drive_glides_as_the_library_s(request):
    route = stages.library_route()
    ours = glided(Stages({}, []), route, 0.04)
    own = Stages({"drive": solved(request.config.rootpath, "ex07")["drive"]}, [])
    np.testing.assert_allclose(glided(own, route, 0.04), ours, atol=1e-4)
    assert [*own.hers] == ["drive"]
    assert np.hypot(*(ours[-1, :2] - route.xy[-1])) <= FollowConfig().goal_radius


def test_the_p_value_s_weight_is_a_count_over_a_count():
    known, losses = np.array([1.0, 2.0, 2.0, 5.0]), np.array([0.0, 1.0, 1.5, 2.0, 5.0, 5.1])
    share = (known >= losses[:, None]).mean(axis=1)
    expected = np.minimum(share / ALPHA, 1)
    np.testing.assert_array_equal(stages.p_weight(losses, known), expected)


@pytest.mark.parametrize(
    ("name", "function", "reason"),
    [
        ("tensorize", lambda heights, *_: np.zeros((*heights.shape, 4)), "lacks windows"),
        ("tensorize", lambda heights, *_: heights, "instead of"),
        ("cut_patch", lambda *_: np.zeros(3), "reshape"),
        ("reconstruction_loss", lambda patch, *_: patch, "instead of"),
        ("conformal_weight", lambda losses, *_: 1.0, "instead of"),
    ],
)
@pytest.mark.slow
def test_what_does_not_fit_the_next_stage_is_named_and_replaced(name, function, reason):
    own = Stages({name: function}, [])
    np.testing.assert_array_equal(planned(own).cells, stages.library_route().cells)
    assert f"Your `{name}` fails" in own.report() and reason in own.report()
    assert name in own.ours and not own.hers


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ((np.zeros((0, 2), dtype=int), np.zeros(0, dtype=int)), "from the start to the goal"),
        (None, "a policy for each step"),
    ],
)
@pytest.mark.slow
def test_a_planner_without_a_route_is_named(answer, reason):
    if answer is None:
        answer = stages.library_route().cells, np.array([0])
    own = Stages({"face_map": lambda *_: answer}, [])
    draw_capstone(own)
    assert "Your `face_map` fails" in own.report() and reason in own.report()


def test_a_tensor_that_is_not_updated_is_named():
    own = Stages({"reassess": lambda answers, *_: answers}, [])
    again, windows = renewed(own, corridor().elevation.crop(3.0, 0.0, 9.0, 4.0))
    assert 0 < again < windows / 4
    assert "not those of the network for the map after the change" in own.report()


@pytest.mark.slow
def test_a_route_that_is_none_is_named():
    own = Stages({"cheapest_route": lambda costs, start, goal: np.array([start, goal])}, [])
    assert planned(own).length > 0
    assert "not all neighbours" in own.report()


def test_the_corridor_has_a_route_of_several_policies():
    route = planned(Stages({}, []))
    assert len(set(route.policies.tolist())) >= 3
    assert np.allclose(route.xy[-1], corridor().goal, atol=0.1)
