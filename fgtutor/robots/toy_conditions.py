"""What can be amiss with a toy: its body and its ground, in named degrees.

Gives `CONDITIONS`. A toy has no sensors to err and no delay; what it is made of can be another.
"""

from dataclasses import replace

from fgtutor.robots.conditions import Axis, Condition, Conditions
from fgtutor.robots.toy import ToyModel

OWN = ToyModel()
"""The toy that policies are trained on."""


def of(words: str, **changes: float) -> Condition:
    """Return the condition of a toy with changes to its model."""
    told = "its exact velocity and the true heights around it"
    return Condition(words=words, told=told, options={"model": replace(OWN, **changes)})


def times(name: str, words: str, factors: tuple[float, ...]) -> Axis:
    """Return an axis over factors on one number of the model."""
    made = {
        f"x {f:g}": of(f"{words} times {f:g}", **{name: f * getattr(OWN, name)}) for f in factors
    }
    return Axis(levels=made)


CONDITIONS = Conditions(
    undisturbed=of("undisturbed"),
    disturbed=of(
        "friction 0.8, 2 kg more, motors and springs a tenth weaker",
        friction=0.8,
        chassis_mass=OWN.chassis_mass + 2.0,
        wheel_torque=0.9 * OWN.wheel_torque,
        leg_stiffness=0.9 * OWN.leg_stiffness,
    ),
    axes={
        "low-friction": times("friction", "friction", (0.8, 0.6, 0.4)),
        "payload": times("chassis_mass", "mass of the chassis", (1.25, 1.5)),
        "weak-motors": times("wheel_torque", "torque", (0.8, 0.6)),
        "weak-springs": times("leg_stiffness", "stiffness", (0.8, 0.6)),
        "low-damping": times("leg_damping", "damping", (0.5,)),
        "simulation": Axis(
            ordered=False,
            levels={"half the step": of("time step of 2.5 ms", dt=0.0025, substeps=16)},
        ),
    },
)
"""What is known of the toy's disturbances."""
