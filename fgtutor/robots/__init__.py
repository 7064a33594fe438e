"""The robots: one seam (`base`), one file each (`toy`, `a1`), found by name.

A robot's module is imported only when that robot is asked for, so the toy never loads MuJoCo and
the A1 never loads pymunk.
"""

import importlib
from typing import TYPE_CHECKING

from fgtutor.errors import ConfigError

if TYPE_CHECKING:
    from fgtutor.robots.base import LocomotionEnv

ROBOTS = {"toy": ("fgtutor.robots.toy", "ToyEnv"), "a1": ("fgtutor.robots.a1.env", "A1Env")}
"""Robot name -> module and environment class. A third robot is one file and one entry here."""

GL_BACKENDS = {"linux": ("egl", "osmesa"), "darwin": ("cgl",), "win32": ("wgl",)}
"""Values of MUJOCO_GL that can draw without a window, in the order of trying, by sys.platform."""


def env_class(robot: str) -> "type[LocomotionEnv]":
    """Return a robot's environment class; raises `ConfigError` for an unknown robot."""
    if robot not in ROBOTS:
        raise ConfigError(f"unknown robot {robot!r}; choose one of {', '.join(sorted(ROBOTS))}")
    module, name = ROBOTS[robot]
    return getattr(importlib.import_module(module), name)
