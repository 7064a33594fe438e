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
from typing import Any

import numpy as np
import onnx
import torch
import tyro
from onnx.reference import ReferenceEvaluator
from torch import Tensor

from fgtutor.errors import ConfigError, ExportError, SpecialistError
from fgtutor.io.progress import waiting
from fgtutor.io.rsl import MLPModel, TensorDict
from fgtutor.io.storage import atomic_write, check_writable, write_json
from fgtutor.robots import env_class
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
"""How a part of the observation is made of what was measured (see `robots.base.part`)."""


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
    except Exception as error:  # a policy class from elsewhere may do what ONNX cannot
        raise ExportError(
            f"a {type(policy).__name__} cannot be written as ONNX: {error!s:.300}"
        ) from error
    if program is None:
        raise ExportError("torch exported no program: install the torch of constraints.txt")
    model = program.model_proto
    # What the exporter notes down for its developers names files of this machine.
    graph = model.graph
    values = (*graph.input, *graph.output, *graph.value_info, *graph.initializer)
    for part in (graph, *graph.node, *values):
        part.ClearField("metadata_props")
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
    parts, action = env.layout()
    seen, frames = [], max(1, specialist.history)
    if specialist.history:
        seen = parts[-1:] if "scan" in specialist.policy.obs_groups else []
        parts = _felt(parts, env.felt)
    size = frames * sum(part["size"] for part in parts) + sum(part["size"] for part in seen)
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
            "after the frames": seen,
        },
        "action": {"name": "action", **action},
    }


def _felt(parts: list[dict[str, Any]], felt: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the parts of which every number is felt, and which policies that estimate remember."""
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
    groups = {first: observations} | {name: observations[:, :0] for name in others}
    with torch.no_grad():
        return policy(TensorDict(groups, batch_size=[len(observations)]))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what torch's exporter says about old APIs and libraries that it did not find."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)
