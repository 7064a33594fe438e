"""What a robot is like, and what it is told, while it is driven: nothing amiss, or something.

Gives plain values. A robot that can be disturbed has a module with `CONDITIONS`, which its entry in
the table of robots names: evaluations take it from there, and know no robot.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """One state of affairs."""

    words: str
    """What is amiss, as a caption says it."""
    told: str = "what its environment tells it"
    """What the policy knows of its motion, as a caption says it."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the robot's environment, dataclasses each."""

    @property
    def ranges(self) -> dict[str, Any]:
        """Every number of it, as a report keeps it."""
        return {
            name: {"kind": type(value).__name__, **asdict(value)}
            for name, value in self.options.items()
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """One way in which things can be amiss, in several degrees."""

    levels: Mapping[str, Condition]
    """By name, from the mildest to the hardest if they are `ordered`."""
    ordered: bool = True
    """Whether each level is harder than the one before it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Conditions:
    """What is known of a robot's disturbances."""

    undisturbed: Condition = field(default_factory=lambda: Condition(words="undisturbed"))
    """Nothing is amiss."""
    disturbed: Condition | None = None
    """Much is amiss at once: what evaluation calls disturbed; None if nothing can be."""
    axes: Mapping[str, Axis] = field(default_factory=dict)
    """One thing is amiss at a time, or several together, by name."""
