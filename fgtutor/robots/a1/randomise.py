"""How an A1 is set up and disturbed, and how the robots of a batch are made to differ.

Reads `A1EnvConfig`; writes masses, frictions and gains into the simulations of a `Physics`. What a
robot measures amiss is drawn per episode (`sensing`). The presets' ranges are those usual in public
training code: unitree_rl_gym, walk-these-ways, extreme-parkour and mjlab.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

import mujoco
import torch
from annotated_types import Interval
from jaxtyping import Bool, Float
from torch import Tensor

from fgtutor.io.validation import Ascending, NonNegative, Share, check_fields
from fgtutor.robots.a1.model import LEGS, A1Config
from fgtutor.robots.a1.observation import SCAN_NOISE
from fgtutor.robots.a1.physics import Physics
from fgtutor.robots.a1.rewards import RewardWeights

Friction = Annotated[float, Interval(gt=0, le=5)]
"""A coefficient of friction."""
Load = Annotated[float, Interval(ge=-4, le=50)]
"""Mass added to the trunk, which weighs 6 kg itself, kg."""
Factor = Annotated[float, Interval(gt=0, le=10)]
"""What a property of the model is multiplied by."""
Damping = Annotated[float, Interval(ge=0, le=20)]
"""Passive damping, N m s / rad, or dry friction, N m, of a joint."""
Delay = Annotated[float, Interval(ge=0, le=1)]
"""Time from an action to its effect, s."""
Angle = Annotated[float, Interval(ge=0, le=1)]
"""Greatest error of an angle, rad."""


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
    calm_share: Share = 0.0
    """Share of robots that meet none of this: the model itself, without noise, errors or pushes."""
    strength: Annotated[tuple[Factor, Factor], Ascending] = (1.0, 1.0)
    """Range of the motors' strength: a factor on stiffness, damping and greatest torque."""
    rate_gain: Annotated[tuple[Factor, Factor], Ascending] = (1.0, 1.0)
    """Range of a factor on the joint controllers' damping (D gain) alone."""
    joint_damping: Annotated[tuple[Damping, Damping], Ascending] = (0.0, 0.0)
    """Range of the passive joint damping added to the model's own, N m s / rad."""
    dry_friction: Annotated[tuple[Damping, Damping], Ascending] = (0.0, 0.0)
    """Range of the joints' dry friction added to the model's own, N m."""
    delay: Annotated[tuple[Delay, Delay], Ascending] = (0.0, 0.0)
    """Range of the time after which a robot's actions take effect, s; whole simulation steps."""
    noise_share: NonNegative = 1.0
    """Sensor noise as a multiple of legged_gym's, if there is `noise`; not that of the scan."""
    scan_noise: NonNegative = SCAN_NOISE
    """Largest noise of each scanned height, m, if there is `noise`."""
    velocity: Literal["true", "none", "error", "odometry"] = "true"
    """What the `policy` group knows of the trunk's velocity: the truth and `noise`; zeros; the
    truth and a correlated error; or what stance legs and gyroscope say, noisy as they are. A policy
    that estimates its velocity (group `history`) never sees this."""
    velocity_error: NonNegative = 0.2
    """Standard deviation of the correlated error along each axis, m/s."""
    velocity_seconds: Annotated[float, Interval(gt=0, le=3600)] = 0.5
    """Time over which the correlated error forgets itself, s."""
    scan_offset: NonNegative = 0.0
    """Greatest error of an episode's scan in height, m."""
    scan_shift: NonNegative = 0.0
    """Greatest error of an episode's scan along x and along y of the world, m."""
    scan_drift: NonNegative = 0.0
    """Growth of the scan's error along each axis, m per square root of a second (random walk)."""
    encoder_offset: Angle = 0.0
    """Greatest error of a joint's zero in an episode, rad; the joint is controlled by it, too."""
    tilt_offset: Angle = 0.0
    """Greatest error of an episode's direction of gravity, in roll and in pitch, rad."""
    gyro_offset: Angle = 0.0
    """Greatest error of an episode's rotation rates, rad/s."""

    def __post_init__(self) -> None:
        check_fields(self)


UNDISTURBED = A1EnvConfig(
    noise=False,
    friction=(0.8, 0.8),
    payload=(0.0, 0.0),
    centre_shift=0.0,
    gain_share=0.0,
    delayed_share=0.0,
    push_speed=0.0,
)
"""No disturbance on any axis: `replace` one of them to see what it alone does."""
DISTURBED = A1EnvConfig(
    friction=(0.4, 1.1),
    payload=(0.0, 2.0),
    centre_shift=0.0,
    gain_share=0.0,
    delayed_share=0.0,
    delay=(0.0, 0.03),
    push_speed=0.5,
    push_seconds=5.0,
    velocity="odometry",
    scan_offset=0.03,
    scan_shift=0.03,
)
"""What evaluation calls disturbed."""
WIDE = A1EnvConfig(
    calm_share=0.3,
    friction=(0.3, 1.25),
    payload=(-1.0, 3.0),
    centre_shift=0.04,
    gain_share=0.1,
    delayed_share=0.0,
    strength=(0.8, 1.2),
    rate_gain=(0.5, 2.0),
    joint_damping=(0.0, 2.0),
    dry_friction=(0.0, 0.3),
    delay=(0.0, 0.04),
    push_speed=0.7,
    push_seconds=6.0,
    velocity="none",
    scan_noise=0.03,
    scan_offset=0.05,
    scan_shift=0.05,
    scan_drift=0.01,
    encoder_offset=0.02,
    tilt_offset=0.03,
    gyro_offset=0.05,
)
"""What policies that shall hold under `DISTURBED`, and on other models, are trained under. Calm
robots keep them good at what is ideal, and what is promised there true."""


class Bodies(NamedTuple):
    """How the robots of a batch differ."""

    late: Bool[Tensor, "sims 1"]
    """Which act one control step late."""
    calm: Bool[Tensor, "sims 1"]
    """Which nothing disturbs."""
    traits: Float[Tensor, "sims 7"]
    """What only a critic may know, about -1 to 1 each, 0 for the model itself: friction, payload,
    strength, D gain, joint damping, dry friction and delay."""

    @classmethod
    def alike(cls, n: int) -> "Bodies":
        """Return `n` robots that do not differ."""
        late = torch.zeros(n, 1, dtype=torch.bool)
        return cls(late, ~late, torch.zeros(n, 7))


def delayable(spec: Any, longest: float) -> None:
    """Give the actuators of an `MjSpec` a memory, so that controls may be late by up to `longest`.

    MuJoCo then delays them itself, in the midst of a control step if need be.
    """
    for actuator in spec.actuators:
        actuator.delay = longest
        actuator.nsample = math.ceil(longest / spec.option.timestep) + 1


def randomise(physics: Physics, settings: A1EnvConfig, seed: int) -> Bodies:
    """Make every simulation another robot on another ground; return how they differ."""
    s, n = settings, physics.num_sims
    rng = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(n, *shape, generator=rng, dtype=torch.float64)

    trunk, own = physics.model.body("trunk"), physics.model
    friction, payload = draw(*s.friction, 1), draw(*s.payload, 1)
    shift = draw(-s.centre_shift, s.centre_shift, 3)
    stiffness, damping = (draw(1 - s.gain_share, 1 + s.gain_share, 1) for _ in range(2))
    late = draw(0.0, 1.0, 1) < s.delayed_share
    strength, rate_gain, delay = draw(*s.strength, 1), draw(*s.rate_gain, 1), draw(*s.delay, 1)
    passive, dry = draw(*s.joint_damping, 1), draw(*s.dry_friction, 1)
    calm = draw(0.0, 1.0, 1) < s.calm_share
    for value in (payload, shift, late, delay, passive, dry):
        value.masked_fill_(calm, 0)
    for value in (stiffness, damping, strength, rate_gain):
        value.masked_fill_(calm, 1)
    friction.masked_fill_(calm, A1Config.friction)
    _set_friction(physics, friction)
    load = payload + trunk.mass.item()
    physics.parameter("body_mass")[:, trunk.id] = load[:, 0]
    inertia = torch.tensor(trunk.inertia) / trunk.mass.item()
    physics.parameter("body_inertia")[:, trunk.id] = inertia * load
    physics.parameter("body_ipos")[:, trunk.id] = torch.tensor(trunk.ipos) + shift
    # MuJoCo writes a position controller as gain[0] * ctrl + bias[1] * q + bias[2] * dq/dt.
    gain, bias = physics.parameter("actuator_gainprm"), physics.parameter("actuator_biasprm")
    gain[:, :, 0] = torch.tensor(own.actuator_gainprm[:, 0]) * stiffness * strength
    bias[:, :, 1] = torch.tensor(own.actuator_biasprm[:, 1]) * stiffness * strength
    bias[:, :, 2] = torch.tensor(own.actuator_biasprm[:, 2]) * damping * rate_gain * strength
    if s.strength != (1.0, 1.0):
        limits = torch.tensor(own.actuator_forcerange) * strength[..., None]
        physics.parameter("actuator_forcerange")[:] = limits
    for name, added in (("dof_damping", passive), ("dof_frictionloss", dry)):
        if added.any():
            physics.parameter(name)[:, 6:] = torch.tensor(getattr(own, name)[6:]) + added
    if own.nhistory:
        step = own.opt.timestep
        physics.parameter("actuator_delay")[:] = step * (delay / step).round()
    physics.set_const()
    differs = (friction - A1Config.friction, payload, strength - 1, rate_gain - 1, passive)
    scales = (2.0, 0.3, 5.0, 1.0, 0.5)
    traits = [value * scale for value, scale in zip(differs, scales, strict=True)]
    traits = torch.cat((*traits, 3.0 * dry, 25.0 * delay), dim=-1).float()
    return Bodies(late, calm, traits)


def _set_friction(physics: Physics, friction: Float[Tensor, "sims 1"]) -> None:
    """Set the sliding friction of all contacts, or of the feet where each shape has its own."""
    model = physics.model
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        physics.parameter("opt.o_friction")[:, :2] = friction
    else:
        feet = [model.geom(f"{leg}_foot").id for leg in LEGS]
        physics.parameter("geom_friction")[:, feet, 0] = friction
