"""How an A1 is set up, and how every robot of a batch is made a little different from the others.

Reads `A1EnvConfig`; writes masses, frictions and gains into the simulations of a `Physics`.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool
from torch import Tensor

from fgtutor.robots.a1_terms import RewardWeights
from fgtutor.robots.physics import Physics


@dataclass(frozen=True, kw_only=True)
class A1EnvConfig:
    """How the A1 senses, acts, is rewarded and disturbed."""

    randomise: bool = True
    """Make every robot a little different, delay some and push all of them, by the ranges below."""
    noise: bool = True
    """Add sensor noise to what the policy observes."""
    action_scale: float = 0.5
    """Change of a joint's target that an action of 1 asks for, rad."""
    substeps: int = 4
    """Simulation steps per control step: 50 Hz control."""
    gait_frequency: float = 2.0
    """Gait cycles per second."""
    swing_height: tuple[float, float] = (0.04, 0.1)
    """Lowest and highest clearance of a good swing, m."""
    weights: RewardWeights = field(default_factory=RewardWeights)
    """Weight of each reward term."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of the friction coefficient."""
    payload: tuple[float, float] = (-0.5, 1.5)
    """Range of the mass added to the trunk, kg."""
    centre_shift: float = 0.03
    """Largest shift of the trunk's centre of mass along each axis, m."""
    gain_share: float = 0.1
    """Largest relative change of the joint controllers' stiffness and damping."""
    delayed_share: float = 0.5
    """Share of robots whose actions take effect one control step late."""
    push_speed: float = 0.4
    """Largest change of the trunk's velocity by a push, along x and y, m/s."""
    push_seconds: float = 8.0
    """Mean time between two pushes, s."""


def randomise(physics: Physics, settings: A1EnvConfig, seed: int) -> Bool[Tensor, "sims 1"]:
    """Make every simulation another robot on another ground; return which robots act late."""
    s, n = settings, physics.num_sims
    dice = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(n, *shape, generator=dice, dtype=torch.float64)

    trunk, own = physics.model.body("trunk"), physics.model
    physics.parameter("opt.o_friction")[:, :2] = draw(*s.friction, 1)
    load = draw(*s.payload, 1) + trunk.mass.item()
    physics.parameter("body_mass")[:, trunk.id] = load[:, 0]
    inertia = torch.tensor(trunk.inertia) / trunk.mass.item()
    physics.parameter("body_inertia")[:, trunk.id] = inertia * load
    centre = torch.tensor(trunk.ipos) + draw(-s.centre_shift, s.centre_shift, 3)
    physics.parameter("body_ipos")[:, trunk.id] = centre
    # MuJoCo writes a position controller as gain[0] * ctrl + bias[1] * q + bias[2] * dq/dt.
    stiffness, damping = (draw(1 - s.gain_share, 1 + s.gain_share, 1) for _ in range(2))
    gain, bias = physics.parameter("actuator_gainprm"), physics.parameter("actuator_biasprm")
    gain[:, :, 0] = torch.tensor(own.actuator_gainprm[:, 0]) * stiffness
    bias[:, :, 1] = torch.tensor(own.actuator_biasprm[:, 1]) * stiffness
    bias[:, :, 2] = torch.tensor(own.actuator_biasprm[:, 2]) * damping
    physics.set_const()
    return draw(0.0, 1.0, 1) < s.delayed_share
