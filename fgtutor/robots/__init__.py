"""The table of robots: all that is known of a robot before its simulator is loaded.

A robot is a file with a `LocomotionEnv` (`base` is all that its author reads) and an entry here.
Its module is imported only when that robot is asked for, so the toy never loads MuJoCo and the A1
never loads pymunk.
"""

import importlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from fgtutor.errors import ConfigError
from fgtutor.robots.conditions import Condition, Conditions
from fgtutor.world.obstacles import TerrainScale

if TYPE_CHECKING:
    from fgtutor.robots.base import LocomotionEnv

GL_BACKENDS = {"linux": ("egl", "osmesa"), "darwin": ("cgl",), "win32": ("wgl",)}
"""Values of MUJOCO_GL that can draw without a window, in the order of trying, by sys.platform."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """One robot's entry."""

    env: str
    """Module and class of its environment, "module:Class"."""
    scale: TerrainScale = field(default_factory=TerrainScale)
    """Sizes of the terrains made for it, and which of them its mixed terrain holds."""
    order: tuple[str, ...] = ()
    """What follows what on the course of `evaluate switching`; default: as in `scale.mixed`."""
    film: str | None = None
    """Module and class of its film, a `figures.episode_film.EpisodeFilm`, if it has one."""
    conditions: str | None = None
    """Module and name of its `Conditions`, if it can be disturbed."""

    @property
    def course(self) -> tuple[str, ...]:
        """What follows what on the course of `evaluate switching`."""
        return self.order or self.scale.mixed


ROBOTS = {
    "toy": Robot(
        env="fgtutor.robots.toy:ToyEnv",
        scale=TerrainScale(
            resolution=0.1,
            length=9.0,
            chasm_depth=(0.05, 0.5, 1.0),
            step_height=(0.06, 0.15),
            # A toy drives in a slice: what differs beside it would only blur what its terrains are.
            block_share=0.0,
            lane_share=0.0,
            bank_share=0.0,
            step_tread=(0.75, 1.1),
            gap_width=(0.1, 0.4),
            bridge_width=(1.6, 0.6),
            slope_angle=(8.0, 40.0),
            slope_height=0.7,
            stair_rise=0.16,
            stair_run=0.4,
            rubble_height=0.1,
            rubble_size=(0.1, 0.2),
            rubble_density=0.3,
            mixed=("steps", "gaps", "slopes", "rubble"),
        ),
        order=("steps", "slopes", "steps", "gaps", "rubble", "steps"),
        film="fgtutor.figures.toy_film:ToyFilm",
        conditions="fgtutor.robots.toy_conditions:CONDITIONS",
    ),
    "a1": Robot(
        env="fgtutor.robots.a1.env:A1Env",
        # The paper's steps of 5-15 cm, gaps of 15 cm, beam of 35 cm, walls of 50 degrees.
        scale=TerrainScale(),
        order=("steps", "valley", "steps", "gaps", "bridge", "steps"),  # the paper's
        film="fgtutor.figures.a1_film:A1Film",
        conditions="fgtutor.robots.a1.conditions:CONDITIONS",
    ),
}
"""The robots by name."""


def env_class(robot: str) -> "type[LocomotionEnv]":
    """Return a robot's environment class; raises `ConfigError` for an unknown robot."""
    if robot not in ROBOTS:
        raise ConfigError(f"unknown robot {robot!r}; choose one of {', '.join(sorted(ROBOTS))}")
    return load(ROBOTS[robot].env)


def conditions_of(robot: str) -> Conditions:
    """Return what is known of a robot's disturbances; raises `ConfigError` for an unknown robot."""
    env_class(robot)
    place = ROBOTS[robot].conditions
    return load(place) if place else Conditions()


def condition_of(robot: str, name: Literal["undisturbed", "disturbed"]) -> Condition:
    """Return one of a robot's two presets; raises `ConfigError` if it cannot be disturbed."""
    known = getattr(conditions_of(robot), name)
    if known is None:
        raise never_disturbed(robot)
    return known


def never_disturbed(robot: str) -> ConfigError:
    """Return the error of a robot that cannot be disturbed: it says which ones can."""
    able = [name for name, entry in ROBOTS.items() if entry.conditions]
    return ConfigError(
        f"nothing is known of disturbances of {robot}; choose a robot of {', '.join(able)}, or "
        "give its entry `conditions`"
    )


def load(place: str) -> Any:
    """Return what a "module:name" of an entry names."""
    module, name = place.split(":")
    return getattr(importlib.import_module(module), name)
