"""Fusion: maximum and argmax over policies (Eqs. 6-7)."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fgtutor.errors import PlanningError
from fgtutor.fusion import fuse


def constant(value: float) -> np.ndarray:
    return np.full((2, 3, 8), value)


def test_the_best_policy_wins_cell_by_cell():
    first, second = constant(0.5), constant(0.2)
    second[1, 2, 7] = 0.9
    fused, policy_map = fuse([first, second])
    assert fused[1, 2, 7] == 0.9 and policy_map[1, 2, 7] == 1
    assert fused.sum() == pytest.approx(0.5 * 47 + 0.9) and policy_map.sum() == 1


def test_a_tie_goes_to_the_first():
    assert not fuse([constant(0.4), constant(0.4), constant(0.4)])[1].any()


def test_the_answer_is_of_the_kind_of_the_question():
    fused, policy_map = fuse([torch.rand(2, 2, 8), torch.rand(2, 2, 8)])
    assert fused.dtype == torch.float32 and policy_map.dtype == torch.int64
    fused, policy_map = fuse([np.random.default_rng(0).random((2, 2, 8))])
    assert isinstance(fused, np.ndarray) and policy_map.dtype == np.int64


def test_tensors_on_their_way_through_a_training_are_fused_as_numbers():
    tensor = torch.full((2, 3, 8), 0.5, requires_grad=True)
    fused, policy_map = fuse([tensor, 2 * tensor])
    assert not fused.requires_grad and (fused == 1).all() and (policy_map == 1).all()


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ([], "at least one"),
        ([constant(0.1), constant(0.1)[:1]], "tensor 1 has shape"),
        ([constant(0.1), constant(np.nan)], "tensor 1 holds NaN"),
        ([constant(np.inf)], "tensor 0 holds NaN or infinity"),
        ([constant(0.5), constant(1.5)], "tensor 1 holds 1.5 to 1.5"),
        ([constant(-0.1)], "tensor 0 holds -0.1 to -0.1"),
        ([constant(0.5)[..., :7]], r"tensor 0 has shape \(2, 3, 7\), expected \(nx, ny, 8\)"),
        ([np.zeros((2, 8))], "tensor 0 has shape"),
        ([np.zeros((0, 3, 8))], "tensor 0 has shape"),
        ([np.float64(0.5)], "tensor 0 has shape"),
        ([constant(0.5).astype(complex)], "tensor 0 holds complex128"),
        ([np.ma.masked_greater(constant(0.5), 0.4)], "tensor 0 has masked values"),
        ([constant(0.5).astype(str)], "tensor 0 holds <U"),
    ],
)
def test_errors_name_the_tensor(tensors, message):
    with pytest.raises(PlanningError, match=message):
        fuse(tensors)


@given(hnp.arrays(np.float32, (3, 2, 3, 8), elements=st.floats(0, 1, width=32)))
def test_fused_is_the_value_of_the_chosen_policy_and_no_other_is_larger(stack):
    fused, policy_map = fuse(list(stack))
    assert (fused >= stack).all()
    for index in np.ndindex(fused.shape):
        assert stack[(policy_map[index], *index)] == fused[index]
        assert (stack[(slice(0, policy_map[index]), *index)] < fused[index]).all()
