"""Fuse the feasibility tensors of all specialists: the highest feasibility, and its policy.

Reads F_i [nx, ny, d], one per specialist; gives F_max and the policy map P, both [nx, ny, d].
Source: paper, Sec. III-C (Eqs. 6-7).
"""

from collections.abc import Sequence
from typing import TypeVar, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fgtutor.directions import HeadingCount
from fgtutor.errors import PlanningError
from fgtutor.io.validation import numbers

Array = TypeVar("Array", Tensor, np.ndarray)


def fuse(
    tensors: Sequence[Float[Array, "nx ny d"]],
) -> tuple[Float[Array, "nx ny d"], Int[Array, "nx ny d"]]:
    """Return F_max = max_i F_i and P = argmax_i F_i; on a tie the first specialist is taken.

    The answer is of the kind of the first tensor, torch or numpy; P is int64. Raises
    `PlanningError` if there is no tensor, if shapes differ or are no maps of headings, or if a
    value is no feasibility from 0 to 1.
    """
    if len(tensors) == 0:
        raise PlanningError(
            "fuse needs at least one feasibility tensor, got none: add a specialist"
        )
    arrays = [numbers(f"tensor {i}", one, PlanningError) for i, one in enumerate(tensors)]
    shape = arrays[0].shape
    if len(shape) != 3 or shape[-1] not in get_args(HeadingCount) or not arrays[0].size:
        raise PlanningError(
            f"tensor 0 has shape {shape}, expected (nx, ny, 8), or 16, 32 or 48 headings: pass "
            "what tensorize gave"
        )
    for index, array in enumerate(arrays):
        if array.shape != arrays[0].shape:
            raise PlanningError(
                f"tensor {index} has shape {array.shape}, the first has {arrays[0].shape}: "
                "tensorize every specialist on the same map"
            )
        if array.min() < 0 or array.max() > 1:
            raise PlanningError(
                f"tensor {index} holds {array.min()} to {array.max()}, a feasibility lies between "
                "0 and 1: check what was multiplied into it"
            )
    stacked = np.stack(arrays)
    policy_map = stacked.argmax(axis=0)
    fused = np.take_along_axis(stacked, policy_map[None], axis=0)[0]
    policy_map = policy_map.astype(np.int64, copy=False)
    if isinstance(tensors[0], Tensor):
        return torch.from_numpy(fused), torch.from_numpy(policy_map)
    return fused, policy_map
