"""What the pages' exporters share: specialists and JSON, as small as a page needs them."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from fgtutor.specialist import DESCRIPTION, TENSORS

PACKED = ".gz"
"""What ends the names of compressed files."""
TRAINING = ("context.decoder.", "distribution.")
"""How the names of tensors begin that only training needs."""
DROPPED = 9
"""Bits of a policy's weights that are rounded away, of 24: it acts the same within 1e-4."""


def copy_specialist(source: Path, folder: Path) -> None:
    """Copy a specialist without its provenance and what only training needs, compressed."""
    folder.mkdir(parents=True, exist_ok=True)
    description = json.loads((source / DESCRIPTION).read_bytes())
    description.pop("provenance")
    (folder / DESCRIPTION).write_bytes(as_json(description | {"packed": PACKED}))
    for file in TENSORS:
        tensors = safetensors.numpy.load_file(source / file)
        if file.startswith("policy"):
            tensors = {
                name: rounded(values)
                for name, values in tensors.items()
                if not name.startswith(TRAINING)
            }
        pack(safetensors.numpy.save(tensors), folder / file)


def rounded(values: np.ndarray) -> np.ndarray:
    """Return 32-bit floats without their last bits, which do not compress; others as they are."""
    if values.dtype != np.float32:
        return values
    bits = values.view(np.uint32).astype(np.uint64) + (1 << (DROPPED - 1))
    return (bits >> DROPPED << DROPPED).astype(np.uint32).view(np.float32)


def pack(content: bytes, file: Path) -> None:
    """Write a file compressed, the same from the same content."""
    packed = gzip.compress(content, mtime=0)
    file.with_name(file.name + PACKED).write_bytes(packed)


def as_json(value: Any) -> bytes:
    """Return a value as JSON without a space; raises `ValueError` for what is no number."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
