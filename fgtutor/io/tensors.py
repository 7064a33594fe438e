"""Weights of a network on disk, read without trusting the file.

Reads a safetensors file; gives tensors that fit the network they are meant for. Sizes are compared
before memory is taken, checksums before anything is parsed, and nothing is ever unpickled.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor, nn

from fgtutor.errors import SpecialistError
from fgtutor.io.validation import CountOrZero

MOST_WEIGHTS = 30_000_000
"""Weights of the largest network that is built; the A1's have two hundred thousand."""
MOST_HEADER = 100_000
"""Bytes of the largest list of tensors at a file's begin; the A1's have a thousand."""
LARGEST_WEIGHT = 1e8
"""A larger one overflows within a few layers."""
CURE = "restore the folder from where it came, or train the specialist again"


@dataclass(frozen=True, kw_only=True)
class Digest:
    """What a description says of a file of tensors."""

    bytes: CountOrZero
    sha256: str


def digest(payload: bytes) -> Digest:
    """Return what a description says of a file with this content."""
    return Digest(bytes=len(payload), sha256=hashlib.sha256(payload).hexdigest())


def read_bytes(path: Path, most: int) -> bytes:
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


def read_tensors(path: Path, expected: Digest, twin: nn.Module) -> dict[str, Tensor]:
    """Read the weights of a network like `twin`; raises `SpecialistError` unless all is right."""
    state = twin.state_dict().values()
    weights = sum(tensor.numel() for tensor in state)
    most = sum(tensor.nbytes for tensor in state) + MOST_HEADER
    if weights > MOST_WEIGHTS or expected.bytes > most:
        raise SpecialistError(
            f"{path}: the description asks for {weights} weights (at most {MOST_WEIGHTS} are "
            f"read) in {expected.bytes} bytes (here at most {most}): {CURE}"
        )
    payload = read_bytes(path, expected.bytes)
    if digest(payload) != expected:
        raise SpecialistError(
            f"{path} was altered or cut short: {len(payload)} bytes, where {expected.bytes} with "
            f"another sha256 are described: {CURE}"
        )
    try:
        tensors = safetensors.torch.load(payload)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise SpecialistError(
            f"{path} is not a safetensors file ({str(error)!r:.300}): {CURE}"
        ) from error
    check_tensors(twin, tensors, str(path))
    return tensors


def check_tensors(twin: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
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
