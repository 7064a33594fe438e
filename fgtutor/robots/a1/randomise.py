"""How an A1 is set up, and how the robots of a batch are made to differ from one another.

Reads `A1EnvConfig`; writes masses, frictions and gains into the simulations of a `Physics`.
"""

from dataclasses import dataclass, field
from typing import Annotated

import torch
from annotated_types import Interval
from jaxtyping import Bool
from torch import Tensor

from fgtutor.io.validation import Ascending, Share, check_fields
from fgtutor.robots.a1.physics import Physics
from fgtutor.robots.a1.rewards import RewardWeights

Friction = Annotated[float, Interval(gt=0, le=5)]
"""A coefficient of friction."""
Load = Annotated[float, Interval(ge=-4, le=50)]
"""Mass added to the trunk, which weighs 4.7 kg itself, kg."""


@dataclass(frozen=True, kw_only=True)
class A1EnvConfig:
    """How the A1 senses, acts, is rewarded and disturbed."""

    randomise: bool = True
    """Make every robot a little different, delay some and push all of them, by the ranges below."""
    noise: bool = True
    """Add sensor noise to what the policy observes."""
    action_scale: Annotated[float, Interval(gt=0, le=10)] = 0.5
    """Change of a joint's target that an action of 1 asks for, rad."""
    substeps: Annotated[int, Interval(ge=1, le=100)] = 4
    """Simulation steps per control step: 50 Hz control."""
    gait_frequency: Annotated[float, Interval(gt=0, le=20)] = 2.0
    """Gait cycles per second."""
    swing_height: Annotated[tuple[Share, Share], Ascending] = (0.04, 0.1)
    """Lowest and highest clearance of a good swing, m."""
    weights: RewardWeights = field(default_factory=RewardWeights)
    """Weight of each reward term."""
    friction: Annotated[tuple[Friction, Friction], Ascending] = (0.5, 1.1)
    """Range of the friction coefficient."""
    payload: Annotated[tuple[Load, Load], Ascending] = (-0.5, 1.5)
    """Range of the mass added to the trunk, kg."""
    centre_shift: Share = 0.03
    """Largest shift of the trunk's centre of mass along each axis, m."""
    gain_share: Annotated[float, Interval(ge=0, lt=1)] = 0.1
    """Largest relative change of the joint controllers' stiffness and damping."""
    delayed_share: Share = 0.5
    """Share of robots whose actions take effect one control step late."""
    push_speed: Annotated[float, Interval(ge=0, le=20)] = 0.4
    """Largest change of the trunk's velocity by a push, along x and y, m/s."""
    push_seconds: Annotated[float, Interval(gt=0, le=3600)] = 8.0
    """Mean time between two pushes, s."""

    def __post_init__(self) -> None:
        check_fields(self)


def randomise(physics: Physics, settings: A1EnvConfig, seed: int) -> Bool[Tensor, "sims 1"]:
    """Make every simulation another robot on another ground; return which robots act late."""
    s, n = settings, physics.num_sims
    rng = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(n, *shape, generator=rng, dtype=torch.float64)

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
