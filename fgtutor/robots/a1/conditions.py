"""What can be amiss with an A1, one axis at a time and together, in named degrees.

Gives `CONDITIONS`. The ranges are those that public training code draws from (unitree_rl_gym,
walk-these-ways, extreme-parkour, mjlab; legged_gym for noise), the presets those of `randomise`.
Every level but those under "together" changes `UNDISTURBED` in one thing.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from fgtutor.robots.a1.menagerie import MenagerieConfig
from fgtutor.robots.a1.model import A1Config
from fgtutor.robots.a1.randomise import DISTURBED, UNDISTURBED, WIDE, A1EnvConfig
from fgtutor.robots.conditions import Axis, Condition, Conditions

PHRASES = {
    "friction": "friction {}",
    "payload": "payload {} kg",
    "centre_shift": "centre of mass off by up to {} m",
    "gain_share": "gains off by up to {} of theirs",
    "delayed_share": "{} of the robots 20 ms late",
    "delay": "delay {} s",
    "strength": "motors {} times as strong",
    "rate_gain": "D gain times {}",
    "joint_damping": "joint damping + {} N m s/rad",
    "dry_friction": "dry friction + {} N m",
    "push_speed": "pushes of up to {} m/s",
    "noise": "sensor noise",
    "scan_offset": "scan off by up to {} m in height",
    "scan_shift": "scan off by up to {} m along x and y",
    "scan_drift": "scan drifting {} m per root second",
    "encoder_offset": "joint zeros off by up to {} rad",
    "tilt_offset": "gravity off by up to {} rad",
    "gyro_offset": "rotation rates off by up to {} rad/s",
    "calm_share": "but {} of the robots meet none of this",
}
"""How a caption says that a field of `A1EnvConfig` is not as in `UNDISTURBED`."""
VELOCITY = {
    "true": "its exact velocity",
    "none": "no velocity",
    "error": "its velocity with an error of {:g} m/s (correlated over {:g} s)",
    "odometry": "its velocity by leg odometry",
}
"""What the policy is told of the trunk's velocity."""


def describe(settings: A1EnvConfig) -> str:
    """Say in which fields settings differ from `UNDISTURBED`."""

    def write(value: Any) -> str:
        if isinstance(value, tuple):
            low, high = value
            return f"{low:g}" if low == high else f"{low:g} to {high:g}"
        return f"{value:g}"

    changed = [
        PHRASES[one.name].format(write(getattr(settings, one.name)))
        for one in fields(A1EnvConfig)
        if one.name in PHRASES and getattr(settings, one.name) != getattr(UNDISTURBED, one.name)
    ]
    return ", ".join(changed)


def condition(
    settings: A1EnvConfig = UNDISTURBED, model: A1Config | None = None, words: str = ""
) -> Condition:
    """Return a condition that says what is amiss by itself, `words` for the model ahead of it."""
    told = VELOCITY[settings.velocity]
    if settings.velocity == "true" and settings.noise:
        told = "its velocity with white noise"
    if not (settings.noise or settings.scan_offset or settings.scan_shift or settings.scan_drift):
        told += " and the true heights around it"
    said = ", ".join(part for part in (words, describe(settings)) if part)
    return Condition(
        words=said or "undisturbed",
        told=told.format(settings.velocity_error, settings.velocity_seconds),
        options={"settings": settings, "model": model or A1Config()},
    )


def of(**changes: Any) -> Condition:
    """Return `UNDISTURBED` with changes."""
    return condition(replace(UNDISTURBED, **changes))


def simulated(words: str, substeps: int = 4, **changes: Any) -> Condition:
    """Return the undisturbed robot in a simulation with changes."""
    model = replace(A1Config(), **changes)
    return condition(replace(UNDISTURBED, substeps=substeps), model, words)


def levels(name: str, unit: str, values: tuple[float, ...], factor: float = 1.0) -> Axis:
    """Return an axis over a range of `A1EnvConfig`, each level one number of it in its unit."""
    made = {f"{v:g}{unit}": of(**{name: (factor * v, factor * v)}) for v in values}
    return Axis(levels=made)


def largest(name: str, unit: str, values: tuple[float, ...], factor: float = 1.0, **more: Any):
    """Return an axis over a field of `A1EnvConfig` that is a largest value."""
    return Axis(levels={f"{v:g}{unit}": of(**{name: factor * v}, **more) for v in values})


AS_SHIPPED = replace(UNDISTURBED, substeps=10)
"""Menagerie's time step is 0.002 s."""
FREE_JOINTS = MenagerieConfig(damping=0.01, abduction_damping=0.01)
"""Menagerie's A1 with the passive joint damping that the maker publishes."""
ROUGH = {"noise": True, "delay": (0.02, 0.02), "push_speed": 0.5, "push_seconds": 3.0}
"""Noise, 20 ms and pushes."""

ONE_AT_A_TIME: Mapping[str, Axis] = {
    "low-friction": levels("friction", "", (0.6, 0.4, 0.3, 0.2)),
    "high-friction": levels("friction", "", (1.0, 1.25)),
    "payload": levels("payload", " kg", (1, 2, 3)),
    "unloading": levels("payload", " kg", (-1,)),
    "delay": levels("delay", " ms", (10, 20, 30, 40), 1e-3),
    "weak-motors": levels("strength", "", (0.9, 0.8)),
    "strong-motors": levels("strength", "", (1.1, 1.2)),
    "joint-damping": levels("joint_damping", "", (0.5, 1, 2)),
    "dry-friction": levels("dry_friction", "", (0.1, 0.2, 0.3)),
    "low-d-gain": levels("rate_gain", "", (0.75, 0.5)),
    "high-d-gain": levels("rate_gain", "", (1.5, 2)),
    "noise": Axis(
        levels={
            "half": of(noise=True, noise_share=0.5, scan_noise=0.01),
            "legged_gym's, scan 2 cm": of(noise=True),
            "legged_gym's, scan 10 cm": of(noise=True, scan_noise=0.1),
        }
    ),
    "velocity-error": Axis(
        levels={
            f"{value:g} m/s": of(velocity="error", velocity_error=value)
            for value in (0.1, 0.2, 0.3)
        }
    ),
    "velocity": Axis(
        levels={
            "odometry": of(velocity="odometry"),
            "noisy odometry": of(velocity="odometry", noise=True),
            "none": of(velocity="none"),
        }
    ),
    "scan-height": largest("scan_offset", " cm", (3, 5), 0.01),
    "scan-shift": largest("scan_shift", " cm", (3, 5, 10), 0.01),
    "scan-drift": largest("scan_drift", " cm per root second", (1, 2), 0.01),
    "pushes": largest("push_speed", " m/s", (0.25, 0.5, 1), push_seconds=5.0),
    "encoders": largest("encoder_offset", " rad", (0.02, 0.05)),
    "tilt": largest("tilt_offset", " rad", (0.03, 0.05)),
    "gyroscope": largest("gyro_offset", " rad/s", (0.05, 0.1)),
    "simulation": Axis(
        ordered=False,
        levels={
            "step 2 ms": simulated("time step of 2 ms", 10, timestep=0.002),
            "step 1 ms": simulated("time step of 1 ms", 20, timestep=0.001),
            "elliptic": simulated("elliptic cone", cone="elliptic"),
            "elliptic, impratio 100": simulated(
                "elliptic cone, impratio 100, 100 iterations",
                cone="elliptic",
                impratio=100.0,
                iterations=100,
            ),
            "CG": simulated("CG solver, 100 iterations", solver="cg", iterations=100),
            "PGS": simulated("PGS solver, 100 iterations", solver="pgs", iterations=100),
            "Euler": simulated("Euler's integrator, 2 ms", 10, timestep=0.002, integrator="euler"),
        },
    ),
    "model": Axis(
        ordered=False,
        levels={
            "Menagerie, joint damping 0.01": condition(
                AS_SHIPPED, FREE_JOINTS, "Menagerie's A1 with joint damping 0.01"
            ),
            "Menagerie as it ships": condition(
                AS_SHIPPED, MenagerieConfig(), "Menagerie's A1 as it ships"
            ),
        },
    ),
}
"""One thing is amiss."""
TOGETHER = Axis(
    ordered=False,
    levels={
        "noise, 20 ms, pushes": of(**ROUGH),
        "as in training": condition(A1EnvConfig()),
        "disturbed": condition(DISTURBED),
        "wide": condition(replace(WIDE, calm_share=0.0)),
        "Menagerie, joint damping 0.01, noise, 20 ms, pushes": condition(
            replace(AS_SHIPPED, **ROUGH), FREE_JOINTS, "Menagerie's A1 with joint damping 0.01"
        ),
        "Menagerie, joint damping 0.01, disturbed": condition(
            replace(DISTURBED, substeps=AS_SHIPPED.substeps),
            FREE_JOINTS,
            "Menagerie's A1 with joint damping 0.01",
        ),
        "Menagerie, joint damping 0.01, odometry": condition(
            replace(AS_SHIPPED, velocity="odometry"),
            FREE_JOINTS,
            "Menagerie's A1 with joint damping 0.01",
        ),
    },
)
"""Several things are amiss; "as in training" is what `fgtutor train` draws by default."""
CONDITIONS = Conditions(
    undisturbed=condition(replace(UNDISTURBED, randomise=False)),
    disturbed=condition(DISTURBED),
    axes={**ONE_AT_A_TIME, "together": TOGETHER},
)
"""What is known of the A1's disturbances."""
