"""A specialist's policy as ONNX, with a description of every number that goes in and comes out.

Reads a specialist's folder; gives policy.onnx, which any ONNX runtime executes without fgtutor or
torch, and the same description as policy.json. What was written is run by the reference evaluator
of the `onnx` package and must answer as torch does.
"""

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import torch
import tyro
from onnx.reference import ReferenceEvaluator
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor

from fgtutor.errors import ConfigError, ExportError, SpecialistError
from fgtutor.io.progress import waiting
from fgtutor.io.storage import atomic_write, check_writable, write_json
from fgtutor.patches import HOLE_DEPTH, SPACING
from fgtutor.robots import env_class
from fgtutor.robots.base import LocomotionEnv
from fgtutor.specialist import Specialist, load_specialist
from fgtutor.world.terrain import World, make_terrain

SCHEMA = 1
"""Version of the description."""
OPSET = 18
"""Version of the ONNX operators, as rsl_rl exports them."""
METADATA = "fgtutor"
"""Name of the description in the ONNX file's metadata."""
TOLERANCE = 1e-4
"""Largest difference to torch, in action units; float32 sums differ by about a millionth."""
FORMULA = "clip(scale * (clip(raw, *limits) - offset), -20, 20)"
"""How a part of the observation is made from what was measured."""


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Write a specialist's policy as ONNX, with the description of its observation."""

    specialist: tyro.conf.Positional[Path]
    """Folder of the specialist."""
    out: Path = Path("policy.onnx")
    """The ONNX file; the description lies beside it as .json."""


def run(config: ExportConfig) -> int:
    """Export from the command line and say what was written."""
    specialist = load_specialist(config.specialist)
    with waiting(f"exporting {specialist.name}"):
        difference = export_policy(specialist, config.out)
    print(f"{specialist}: {specialist.policy.obs_dim} numbers in, {difference:.1e} from torch")
    print(f"policy -> {config.out}\ndescription -> {config.out.with_suffix('.json')}")
    return 0


def export_policy(specialist: Specialist, path: str | Path) -> float:
    """Write the policy to `path` and its description beside it; return the difference to torch.

    Raises:
        ConfigError: The path does not end in .onnx.
        SpecialistError: The policy does not read what its robot observes.
        ExportError: The network cannot be exported, or answers differently.
        StorageError: The system refused to write; nothing partial is left.
    """
    path = Path(path)
    if path.suffix != ".onnx":  # .json, for one, would be overwritten by the description
        raise ConfigError(f"the file for the policy ends in .onnx, got {path.name!r}")
    check_writable(path)
    check_writable(path.with_suffix(".json"))
    description = describe(specialist)
    model = to_onnx(specialist.policy)
    model.metadata_props.add(key=METADATA, value=json.dumps(description))
    difference = compare(model, specialist.policy)
    with atomic_write(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
    write_json(path.with_suffix(".json"), description)
    return difference


def to_onnx(policy: MLPModel) -> onnx.ModelProto:
    """Return the policy's deterministic answer as an ONNX graph: observation -> action.

    Raises:
        ExportError: The network does something that ONNX cannot express.
    """
    module = policy.as_onnx(verbose=False).eval()
    example = torch.zeros(2, policy.obs_dim)  # one row would make the batch a constant
    try:
        with _quiet():
            program = torch.onnx.export(
                module,
                (example,),
                dynamo=True,
                verbose=False,
                opset_version=OPSET,
                input_names=["observation"],
                output_names=["action"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
            )
    except Exception as error:  # a policy class of somebody else's may do what ONNX cannot
        raise ExportError(
            f"a {type(policy).__name__} cannot be written as ONNX: {error!s:.300}"
        ) from error
    if program is None:
        raise ExportError("torch exported no program: install the torch of constraints.txt")
    model = program.model_proto
    # What the exporter notes down for its developers names files of this machine.
    graph = model.graph
    for part in (graph, *graph.node, *graph.input, *graph.output, *graph.value_info):
        part.ClearField("metadata_props")
    for tensor in graph.initializer:
        tensor.ClearField("metadata_props")
    return model


def compare(model: onnx.ModelProto, policy: MLPModel, *, samples: int = 256) -> float:
    """Return by how much the two answers to random observations differ at most.

    Raises:
        ExportError: By more than `TOLERANCE`, or one is not a number.
    """
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((samples, policy.obs_dim)).astype(np.float32)
    (answers,) = ReferenceEvaluator(model).run(None, {"observation": observations})
    wanted = _answer(policy, torch.from_numpy(observations)).numpy()
    difference = float(np.abs(np.asarray(answers) - wanted).max())
    if not difference <= TOLERANCE:
        raise ExportError(
            f"the exported network differs from torch by {difference:g}, more than {TOLERANCE:g}: "
            "install the versions of torch and onnx in constraints.txt"
        )
    return difference


def describe(specialist: Specialist) -> dict[str, Any]:
    """Return what every number of the observation and the action means, as plain values.

    Raises:
        SpecialistError: The policy does not read what its robot observes.
    """
    ground = make_terrain("flat", robot=specialist.robot)
    env = env_class(specialist.robot)(World([[ground]]), 1)
    parts, action = _a1(env) if specialist.robot == "a1" else _any(env)
    frames = max(1, specialist.history)
    if specialist.history:
        parts = _felt(parts, env.felt)
    size = frames * sum(part["size"] for part in parts)
    reads = specialist.policy.obs_dim
    answers = _answer(specialist.policy, torch.zeros(1, reads)).shape[-1]
    if (size, action["size"]) != (reads, answers):
        raise SpecialistError(
            f"{specialist.name} reads {reads} numbers and answers {answers}, its robot "
            f"{specialist.robot} observes {size} and acts by {action['size']}: train it again with "
            "this fgtutor"
        )
    return {
        "schema": SCHEMA,
        "name": specialist.name,
        "robot": specialist.robot,
        "terrain": specialist.provenance.get("terrain"),
        "seconds per action": env.control_dt,
        "planning command": list(specialist.command),
        "observation": {
            "name": "observation",
            "size": size,
            "frames": frames,
            "order of frames": "oldest first, zeros before the start",
            "formula": FORMULA,
            "parts": parts,
        },
        "action": {"name": "action", **action},
    }


def _a1(env: LocomotionEnv) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Describe the A1's observation, in order, and its actions."""
    from fgtutor.robots.a1.env import A1Env  # here, because the toy needs no MuJoCo
    from fgtutor.robots.a1.model import JOINTS, STANCE, STANCE_HEIGHT
    from fgtutor.robots.a1.observation import NOISE, SCAN_GRID, SCAN_LIMIT, SCAN_SCALE

    settings, gains = cast(A1Env, env).settings, cast(A1Env, env).model
    meaning = {
        "velocity": "the trunk's velocity in its own frame (x ahead, y left, z up), m/s",
        "gyroscope": "the trunk's rotation rate in its own frame, rad/s",
        "gravity": "the direction of gravity in the trunk's frame, a unit vector",
        "joints": "angles, rad, in the order of action.joints",
        "joint rates": "the same joints' speeds, rad/s",
        "last action": "the policy's previous answer; zeros at the start",
        "clock": f"sin and cos of 2 pi {settings.gait_frequency:g} Hz t, from t = 0 at the start",
    }
    parts = [
        _part(name, size, meaning[name], scale=scale, offset=STANCE if name == "joints" else 0.0)
        for name, (size, _, scale) in NOISE.items()
    ]
    parts.append(_part("command", 3, "wanted vx, vy (m/s, yaw frame) and turn rate (rad/s)"))
    scan = _part(
        "scan",
        SCAN_GRID.num_points,
        "height of the ground minus that of the trunk's centre at `points`: ahead and left of the "
        f"trunk's centre in the yaw frame, m; on a map in which holes end {HOLE_DEPTH:g} m below "
        f"the ground around them, smoothed by a triangle reaching {SPACING:g} m to each side",
        scale=SCAN_SCALE,
        offset=-STANCE_HEIGHT,
        limits=(-SCAN_LIMIT, SCAN_LIMIT),
    )
    parts.append(scan | {"points": np.round(SCAN_GRID.points.numpy(), 4).tolist()})
    action = {
        "size": len(JOINTS),
        "meaning": "joint targets, rad: offset + scale * action",
        "joints": list(JOINTS),
        "offset": list(STANCE),
        "scale": settings.action_scale,
        "stiffness": gains.kp,
        "damping": gains.kd,
        "torque limit": gains.torque_limit,
    }
    return parts, action


def _any(env: LocomotionEnv) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Describe another robot's observation by its sizes; its own file says what they mean."""
    here = f"see {type(env).__name__} in {type(env).__module__}"
    felt, scan = env.proprioception().shape[-1], env.scan(env.patches()).shape[-1]
    parts = [_part("proprioception", felt, here), _part("command", 3, "wanted vx, vy, turn rate")]
    return [*parts, _part("scan", scan, here)], {"size": env.num_actions, "meaning": here}


def _part(
    name: str,
    size: int,
    meaning: str,
    *,
    scale: float = 1.0,
    offset: float | tuple[float, ...] = 0.0,
    limits: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Describe one part of the observation; see `FORMULA`."""
    each = list(offset) if isinstance(offset, tuple) else offset
    return {
        "name": name,
        "size": size,
        "meaning": meaning,
        "limits": limits and list(limits),
        "offset": each,
        "scale": scale,
    }


def _felt(parts: list[dict[str, Any]], felt: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the parts that a blind policy reads: those of which it feels every number."""
    ends = np.cumsum([part["size"] for part in parts])
    return [
        part
        for part, end in zip(parts, ends.tolist(), strict=True)
        if set(range(end - part["size"], end)) <= set(felt)
    ]


def _answer(policy: MLPModel, observations: Tensor) -> Tensor:
    """Return the deterministic actions for observations [n, obs_dim], its groups joined."""
    # The policy joins its groups anyway, so the first may stand for all.
    first, *others = policy.obs_groups
    groups = {name: observations[:, :0] for name in others} | {first: observations}
    groups = {name: groups[name] for name in policy.obs_groups}
    with torch.no_grad():
        return policy(TensorDict(groups, batch_size=[len(observations)]))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep torch's exporter from reporting its own affairs: old APIs, libraries it did not find."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
