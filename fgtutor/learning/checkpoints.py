"""A training's checkpoint on disk: a sha256, then what torch saves.

Reads and gives a dict of plain values, networks, optimisers and the robots' state; nothing but
tensors and plain values is ever unpickled.
"""

import hashlib
import io
import json
import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge

from fgtutor.errors import CheckpointError
from fgtutor.io.storage import atomic_write
from fgtutor.io.validation import CountOrZero, NonNegative, Share, parse_record

CHECKPOINT = "checkpoint.pt"
"""Its name, in a run's folder."""
DIGEST = hashlib.sha256().digest_size
"""Bytes of the sha256."""
_JSON = "config", "history"
"""Parts that are kept as JSON."""


@dataclass(frozen=True, kw_only=True)
class _Plain:
    """The parts of a checkpoint that are plain values."""

    config: dict[str, Any]
    history: list[dict[str, float]]
    iteration: CountOrZero
    samples_before: Annotated[int, Ge(0)]
    critic_warmup: CountOrZero
    easiest: Share
    seconds: NonNegative


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically, behind its checksum; raises `StorageError`."""
    # Through memory: torch's own writer reports a full disk as something else than an OSError.
    buffer = io.BytesIO()
    torch.save(state | {name: json.dumps(state[name]) for name in _JSON}, buffer)
    payload = buffer.getvalue()
    with atomic_write(path) as temporary:
        temporary.write_bytes(hashlib.sha256(payload).digest() + payload)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return what a checkpoint holds; raises `CheckpointError` unless each byte is as written."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"cannot read {path}: {error.strerror or error}") from error
    payload = data[DIGEST:]
    if hashlib.sha256(payload).digest() != data[:DIGEST]:
        raise CheckpointError(
            f"{path} is damaged, or no checkpoint of this version: begin anew in another "
            f"--out, --from the newest folder in {path.parent / 'snapshots'} if there is one"
        )
    try:
        with warnings.catch_warnings(action="ignore"):  # torch warns of what it then refuses
            state = torch.load(io.BytesIO(payload), weights_only=True, map_location="cpu")
        state |= {name: json.loads(state[name]) for name in _JSON}
        plain = {field.name: state[field.name] for field in fields(_Plain)}
        state["others"] = list(state["others"])
    except Exception as error:  # of torch's reader, whatever the bytes are
        raise foreign(path, error) from error
    return state | vars(parse_record(_Plain, plain, CheckpointError, str(path)))


def foreign(path: Path, error: Exception) -> CheckpointError:
    """Return an error that says why a checkpoint, whole as it is, is of no use here."""
    reason = f"{type(error).__name__}: {ascii(str(error))[1:-1][:200]}"
    return CheckpointError(
        f"{path} does not hold what this version keeps ({reason}): begin anew in another --out"
    )
