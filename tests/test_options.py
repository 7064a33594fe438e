"""Every numeric option of every command: nonsense is refused in one line, before anything runs."""

import importlib
import math
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

from fgtutor import __main__ as cli
from fgtutor.baselines import OccupancyConfig, TraversabilityConfig
from fgtutor.errors import ConfigError, TerrainError
from fgtutor.execution import FollowConfig
from fgtutor.robots.a1.model import A1Config
from fgtutor.robots.a1.randomise import A1EnvConfig
from fgtutor.robots.a1.rewards import RewardWeights
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.lidar import LidarConfig
from fgtutor.robots.toy import ToyModel, ToySpread
from fgtutor.world.obstacles import TerrainScale
from fgtutor.world.scanning import ScanConfig

NEEDED: dict[str, Any] = {
    "map": Path("map.npz"),
    "folder": Path("specialist"),
    "cloud": Path("cloud.las"),
    "paths": (Path("ex01.ipynb"),),
    "start": (0.0, 0.0),
    "goal": (1.0, 1.0),
}
"""What has to be given for the fields that have no default."""
NEVER = (math.nan, -math.inf, math.inf, 10**400, "1", True)
"""What no option takes."""
ZERO, BELOW, HUGE = (0,), (-1, -0.5), (10**10, 1e300)
SENSE = {
    **dict.fromkeys(("start", "goal", "area"), ZERO + BELOW + HUGE),
    **dict.fromkeys(("hours", "outlier_ratio", "relief", "switch_cost"), ZERO + HUGE),
    "clearance": (*HUGE, math.inf),
    **dict.fromkeys(("critic_warmup", "difficulty"), ZERO),
    **dict.fromkeys(("easiest", "easiest_at_last", "entropy", "f_min", "gamma", "heights"), ZERO),
    **dict.fromkeys(("fusing_seconds", "label_seconds", "least_promise", "levels"), ZERO),
    **dict.fromkeys(("neighbours", "seed", "seeds", "workers", "turned", "updates"), ZERO),
    "angles": ZERO + BELOW,
}
"""Which unusual values make sense, by the field's name; all others are refused."""


def configs() -> list[type]:
    """Return the config class of every command, those that a robot chooses included."""
    found = []
    for module_name, name, _ in cli.COMMANDS.values():
        chosen = getattr(importlib.import_module(f"fgtutor.{module_name}"), name)
        if isinstance(chosen, type):
            found.append(chosen)
        else:
            found += [chosen([]), chosen(["--robot", "a1"])]
    return found


def with_value(hint: Any, value: Any) -> Any:
    """Return `value` in the shape of a type; None if the type holds no number."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return with_value(parts[0], value)
    if hint in (int, float):
        return value
    if origin is tuple:
        inside = with_value(parts[0], value)
        return inside if inside is None else (inside,) * (1 if ... in parts else len(parts))
    for part in parts:
        if get_origin(part) is not dict and (inside := with_value(part, value)) is not None:
            return inside
    return None


def numeric() -> list[tuple[type, str, Any]]:
    """Return every field of every config that holds numbers, with its type."""
    found, waiting, seen = [], configs(), set()
    while waiting:
        kind = waiting.pop(0)
        if kind in seen:
            continue
        seen.add(kind)
        for name, hint in get_type_hints(kind, include_extras=True).items():
            if is_dataclass(hint):
                waiting.append(hint)
            elif with_value(hint, 1) is not None:
                found.append((kind, name, hint))
    return found


def build(kind: type, name: str, value: Any) -> Any:
    given = {
        field.name: NEEDED[field.name]
        for field in fields(kind)
        if (field.default is MISSING and field.default_factory is MISSING)
    }
    return kind(**given | {name: value})


FIELDS = numeric()


INNER = [
    (kind, name, hint)
    for kind in (
        *(A1Config, A1EnvConfig, EnvConfig, FollowConfig, LidarConfig, OccupancyConfig),
        *(RewardWeights, ScanConfig, TerrainScale, ToyModel, ToySpread, TraversabilityConfig),
    )
    for name, hint in get_type_hints(kind, include_extras=True).items()
    if with_value(hint, 1) is not None
]


@pytest.mark.parametrize(
    ("kind", "name", "hint"), INNER, ids=[f"{kind.__name__}.{name}" for kind, name, _ in INNER]
)
def test_the_numbers_of_robots_terrains_and_planners_are_checked_too(kind, name, hint):
    for value in (*NEVER, *ZERO, *BELOW, *HUGE):
        try:
            build(kind, name, with_value(hint, value))
        except (ConfigError, TerrainError) as error:
            assert name in str(error) or value in ZERO + BELOW + HUGE
        else:
            assert value in (*ZERO, *BELOW, *HUGE, math.inf), f"{name}={value!r}"


def test_all_commands_are_looked_at():
    names = {kind.__name__ for kind, *_ in FIELDS}
    assert {kind.__name__ for kind in configs()} - names <= {"ExportConfig", "ExercisesConfig"}


@pytest.mark.parametrize(
    ("kind", "name", "hint"), FIELDS, ids=[f"{kind.__name__}.{name}" for kind, name, _ in FIELDS]
)
def test_a_value_makes_sense_or_is_refused_by_name_in_one_line(kind, name, hint):
    for value in (*NEVER, *ZERO, *BELOW, *HUGE):
        try:
            build(kind, name, with_value(hint, value))
        except ConfigError as error:
            assert name in str(error) and "\n" not in str(error)
        else:
            assert value in SENSE.get(name, ()), f"{name}={value!r}"


@pytest.mark.parametrize(
    "words",
    [
        "demo --switch-cost nan",
        "train --gamma 2",
        "train --seed -1",
        "train --hidden",
        "train --threads 100000",
        "train --device tpu",
        "sweep --train.learning-rate -1",
        "sweep --seeds 1 -1",
        "sweep --robot a1 --train.gamma inf",
        "plan --map m.npz --start 0 0 --goal 1 nan",
        "evaluate matrix --difficulty nan",
        "evaluate calibration --seconds inf",
        "evaluate baselines --trials 0",
        "evaluate adaptation --heights 1 1 nan",
        "evaluate switching --levels 0 nan",
        "evaluate newcomer --f-min -1",
        "map c.xyz --resolution nan",
        "notebooks --timeout -1",
        "grade x.ipynb --seconds inf",
        "doctor --gl-seconds nan",
    ],
)
def test_the_command_line_says_so_in_one_line(capsys, monkeypatch, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words.split()) == cli.USAGE
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and said.err.startswith(f"fgtutor {words.split()[0]}")
    assert not said.out and not list(tmp_path.iterdir())
