"""Where a number came from: the machine it was computed on, and with which versions.

Reads package metadata and the machine; gives a plain dictionary for reports.
"""

import hashlib
import os
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fgtutor import __version__

PACKAGES = ("torch", "numpy", "scipy", "rsl-rl-lib", "pymunk", "mujoco")
"""Whose versions may change a result."""


def digest(data: bytes) -> str:
    """Return what tells one policy or tensor from another: the first 16 digits of its sha256."""
    return hashlib.sha256(data).hexdigest()[:16]


@cache
def machine() -> dict[str, Any]:
    """Return this machine's processor, cores and system, and the versions of what computes here.

    Not its name: a report may be published.
    """
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {
            "fgtutor": __version__,
            "python": platform.python_version(),
            **{package: version(package) for package in PACKAGES},
        },
    }


def _processor() -> str:
    """Return the processor's name; Linux tells it only in a file."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
