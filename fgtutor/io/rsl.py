"""What the library uses of rsl_rl's networks and of tensordict, loaded without torch's compiler.

As tensordict is imported it marks a few functions for `torch.compile`. That alone loads torch's
compiler and sympy, half of the time that a process takes to start. Nothing here compiles, so the
marks are left out: whatever needs these names imports them from here, before rsl_rl itself.
"""

import torch.compiler

_marks = torch.compiler.allow_in_graph, torch.compiler.assume_constant_result
torch.compiler.allow_in_graph = torch.compiler.assume_constant_result = lambda function: function
try:
    from rsl_rl.env import VecEnv
    from rsl_rl.models import MLPModel
    from rsl_rl.modules import MLP
    from rsl_rl.modules.distribution import GaussianDistribution
    from rsl_rl.utils import resolve_nn_activation
    from tensordict import TensorDict
finally:
    torch.compiler.allow_in_graph, torch.compiler.assume_constant_result = _marks

__all__ = [
    "MLP",
    "GaussianDistribution",
    "MLPModel",
    "TensorDict",
    "VecEnv",
    "resolve_nn_activation",
]
