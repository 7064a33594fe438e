"""What a specialist's folder holds, and how it is read without trusting it.

Reads a folder's bytes; gives a `Description` whose every value is in range, and tensors that fit
the networks it describes. Sizes are compared before memory is taken, checksums before anything is
parsed, and nothing is ever unpickled, imported or called by a name from a file.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import safetensors.torch
import torch
from annotated_types import Interval
from rsl_rl.models import MLPModel
from safetensors import SafetensorError
from torch import Tensor, nn

from fgtutor.errors import SpecialistError
from fgtutor.feasibility import FeasibilityNet
from fgtutor.io.validation import LARGEST_RECORD, CountOrZero, Name, arguments, parse_record
from fgtutor.patches import PatchGrid
from fgtutor.policies.description import PolicyConfig

SCHEMA = 1
"""Version of `specialist.json`; a reader refuses any other."""
DESCRIPTION = "specialist.json"
"""The file that describes the other two and holds their checksums."""
CURE = "restore the folder from where it came, or train the specialist again"
TENSORS = ("policy.safetensors", "feasibility.safetensors")
MOST_WEIGHTS = 30_000_000
"""Weights of the largest network that is built; the A1's have two hundred thousand."""
MOST_HEADER = 100_000
"""Bytes of the largest list of tensors at a file's begin; the A1's have a thousand."""
LARGEST_WEIGHT = 1e8
"""A larger one overflows within a few layers."""
Speed = Annotated[float, Interval(ge=-100, le=100)]


@dataclass(frozen=True, kw_only=True)
class File:
    """What a description says of a file of tensors."""

    bytes: CountOrZero
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Known:
    """What is read of a provenance, which otherwise holds what its writer liked."""

    terrain: Name = ""
    samples: Annotated[int, Interval(ge=0, le=10**15)] = 0


@dataclass(frozen=True, kw_only=True)
class Description:
    """What `specialist.json` holds."""

    schema: Literal[1]
    name: Name
    robot: Name
    policy: PolicyConfig
    feasibility: dict[str, Any]
    grid: PatchGrid
    command: tuple[Speed, Speed, Speed]
    label_seconds: float
    quantiles: dict[str, float]
    provenance: dict[str, Any]
    files: dict[Literal["policy.safetensors", "feasibility.safetensors"], File]
    checksum: str


def check_quantiles(quantiles: Mapping[str, float]) -> None:
    """Raise `SpecialistError` unless they are quantiles: by probability, and growing with it."""
    read = parse_record(dict[str, float], dict(quantiles), SpecialistError, "quantiles")
    try:
        pairs = [(0.0, 0.0), *sorted((float(share), value) for share, value in read.items())]
    except ValueError as error:
        raise SpecialistError(f"quantiles: need probabilities, {error}") from error
    if not all(a < b < 1 and low <= high for (a, low), (b, high) in pairwise(pairs)):
        raise SpecialistError(
            f"quantiles: need numbers from 0 that grow with a probability below 1, got {read}"
        )


def sizes_of(net: FeasibilityNet) -> dict[str, Any]:
    """Return the arguments that build a Feasibility-Net of this size."""
    return {name: getattr(net, name) for name in arguments(FeasibilityNet).__annotations__}


def build_networks(
    config: PolicyConfig, sizes: Mapping[str, Any], device: str, where: str
) -> tuple[MLPModel, FeasibilityNet]:
    """Build both networks; torch's random state stays, so that a save changes no training."""
    numbers = parse_record(
        arguments(FeasibilityNet), sizes, SpecialistError, f"{where}: feasibility"
    )
    try:
        with torch.random.fork_rng(devices=[]), torch.device(device):
            return config.build(), FeasibilityNet(**vars(numbers))
    except Exception as error:  # the class of a policy may be anybody's
        raise SpecialistError(
            f"{where}: no policy can be built of this description ({str(error)!r:.300}): {CURE}"
        ) from error


def checksum(description: Mapping[str, Any]) -> str:
    """Return the sha256 of a description without its own checksum, independent of its layout."""
    content = {key: value for key, value in description.items() if key != "checksum"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def read_description(path: Path) -> Description:
    """Read `specialist.json`, verifying its schema version, its own checksum and every value."""
    payload = _read(path, LARGEST_RECORD)
    try:
        description = json.loads(payload)
        if not isinstance(description, dict):
            raise TypeError(f"expected an object, got a {type(description).__name__}")
        schema, stored = description.get("schema"), description.get("checksum")
        computed = checksum(description)
    except (ValueError, TypeError, RecursionError) as error:
        raise SpecialistError(f"cannot read {path} ({error}): {CURE}") from error
    if schema != SCHEMA:
        raise SpecialistError(
            f"{path} has schema {schema!r:.60}, this fgtutor reads {SCHEMA}: install the fgtutor "
            "that wrote it, or train the specialist again"
        )
    if stored != computed:
        raise SpecialistError(f"{path} was altered, its checksum does not match: {CURE}")
    return parse_record(Description, payload, SpecialistError, str(path))


def _read(path: Path, most: int) -> bytes:
    """Return a file's bytes; raises `SpecialistError` if it is none, or holds more than `most`."""
    try:
        if not path.is_file():  # a pipe or a device would never end
            raise SpecialistError(f"there is no file {path}: {CURE}")
        with path.open("rb") as file:
            payload = file.read(most + 1)
    except OSError as error:
        raise SpecialistError(f"cannot read {path} ({error.strerror}): {CURE}") from error
    if len(payload) > most:
        raise SpecialistError(f"{path} has more than {most} bytes, which it should have: {CURE}")
    return payload


def read_tensors(path: Path, told: Description, twin: nn.Module) -> dict[str, Tensor]:
    """Read the tensors of a network, verifying size and sha256 before they are parsed."""
    expected = told.files.get(path.name)  # type: ignore[call-overload]
    if expected is None:
        raise SpecialistError(f"{path.parent / DESCRIPTION} lists no {path.name}: {CURE}")
    state = twin.state_dict().values()
    weights = sum(tensor.numel() for tensor in state)
    most = sum(tensor.nbytes for tensor in state) + MOST_HEADER
    if weights > MOST_WEIGHTS or expected.bytes > most:
        raise SpecialistError(
            f"{path}: the description asks for {weights} weights (at most {MOST_WEIGHTS} are "
            f"read) in {expected.bytes} bytes (here at most {most}): {CURE}"
        )
    payload = _read(path, expected.bytes)
    if len(payload) != expected.bytes:
        raise SpecialistError(f"{path} has {len(payload)} bytes, expected {expected.bytes}: {CURE}")
    if hashlib.sha256(payload).hexdigest() != expected.sha256:
        raise SpecialistError(f"{path} was altered, its sha256 does not match: {CURE}")
    try:
        tensors = safetensors.torch.load(payload)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SpecialistError(
            f"{path} is not a safetensors file ({str(error)!r:.300}): {CURE}"
        ) from error
    compare(twin, tensors, str(path))
    return tensors


def compare(twin: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise `SpecialistError` unless tensors fit a module in names, shapes, types, and are sane."""
    expected = {k: (tuple(v.shape), v.dtype) for k, v in twin.state_dict().items()}
    got = {k: (tuple(v.shape), v.dtype) for k, v in tensors.items()}
    wrong = sorted(k for k in expected.keys() | got.keys() if expected.get(k) != got.get(k))
    if wrong:
        raise SpecialistError(
            f"{where}: tensor {wrong[0]!r:.60} should be {expected.get(wrong[0], 'absent')}, is "
            f"{got.get(wrong[0], 'absent')}: the description is of another network"
        )
    for name, value in tensors.items():
        if value.is_floating_point() and not (value.abs() <= LARGEST_WEIGHT).all():
            raise SpecialistError(
                f"{where}: tensor {name!r} holds a NaN, an infinity or a number beyond "
                f"{LARGEST_WEIGHT:g}: the training diverged, train again with a lower learning rate"
            )
