"""What the pages' exporters share: specialists and JSON, as small as a page needs them."""

import json
import shutil
from pathlib import Path
from typing import Any

from fgtutor.specialist import DESCRIPTION, TENSORS


def copy_specialist(source: Path, folder: Path) -> None:
    """Copy a specialist as it is but for its provenance, which is longer than all the rest."""
    folder.mkdir(parents=True, exist_ok=True)
    description = json.loads((source / DESCRIPTION).read_bytes())
    description.pop("provenance")
    (folder / DESCRIPTION).write_bytes(as_json(description))
    for file in TENSORS:
        shutil.copyfile(source / file, folder / file)


def as_json(value: Any) -> bytes:
    """Return a value as JSON without a space; raises `ValueError` for what is no number."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
