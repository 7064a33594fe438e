"""Files that hold an elevation map: .npz, GeoTIFF, and grey PNG with a YAML sidecar.

Reads a path and gives the fields of an `ElevationMap`, or the other way round. What a file says
about its numbers is obeyed, or the file is refused; so it is if it says what is not understood.
"""

import hashlib
import mmap
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from PIL import Image

from fgtutor.errors import MapError
from fgtutor.grid import check_cells
from fgtutor.io.geotiff import load_geotiff, save_geotiff
from fgtutor.io.rasters import heights_of, rows_of
from fgtutor.io.reading import by_suffix, read_file, read_npz
from fgtutor.io.storage import atomic_write, atomic_write_all
from fgtutor.io.validation import parse_record

if TYPE_CHECKING:
    from fgtutor.elevation import ElevationMap

_LARGEST_SIDECAR = 4_000
"""Bytes; ours have three hundred, and YAML takes seconds for nested ones."""
_UNKNOWN = 65535
"""The PNG value of an unknown cell; heights use 0..65534."""
_PARTS = ("heights", "known", "resolution", "origin")
_CURE = "write it again with ElevationMap.save"


def write(elevation: "ElevationMap", path: Path) -> None:
    """Write a map to a file of the kind its suffix names.

    Raises:
        MapError: The suffix names no kind of map file.
        StorageError: The system refused to write; nothing partial is left.
    """
    by_suffix(path, _WRITERS, "map", MapError)(elevation, path)


def read(path: Path) -> dict[str, Any]:
    """Return the arguments of the `ElevationMap` that a file holds.

    Raises:
        MapError: The file is missing, cannot be read, is of another kind, corrupt or too large, or
            says too little, or something about its numbers that cannot be obeyed.
    """
    return read_file(path, _READERS, "map", MapError, _CURE)


def _save_npz(elevation: "ElevationMap", path: Path) -> None:
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **{name: getattr(elevation, name) for name in _PARTS})


def _load_npz(path: Path) -> dict[str, Any]:
    def check(name: str, shape: tuple[int, ...], kind: np.dtype) -> None:
        if kind.kind not in ("b" if name == "known" else "fiu") or kind.itemsize > 8:
            wanted = "truths" if name == "known" else "numbers"
            raise MapError(f"{name}.npy holds {kind}, no {wanted}")
        check_cells(shape)

    parts: dict[str, Any] = read_npz(path, _PARTS, check, MapError)
    if parts["resolution"].ndim or parts["origin"].shape != (2,):
        raise MapError("the resolution must be one number, and the origin two")
    return parts | {name: parts[name].astype(float).tolist() for name in ("resolution", "origin")}


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """What a PNG's numbers mean: height = offset + scale * value, metres."""

    scale: float
    """Height of a step, m."""
    offset: float
    """Height of the value 0, m."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """Lower-left corner, m."""
    unknown: int | None = _UNKNOWN
    """The value of unknown cells, if there is one."""
    picture: str | None = None
    """SHA-256 of the PNG; a sidecar written by hand needs none."""


def _save_png(elevation: "ElevationMap", path: Path) -> None:
    heights = rows_of(elevation).astype(float)
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    scale = (high - low) / (_UNKNOWN - 1) or 1.0
    values = np.round((heights - low) / scale)
    values = np.where(np.isnan(values), _UNKNOWN, values).astype(np.uint16)
    notes = {
        "scale": scale,
        "offset": low,
        "resolution": elevation.resolution,
        "origin": list(elevation.origin),
        "unknown": _UNKNOWN,
    }
    with atomic_write_all(path, _sidecar(path)) as (picture, sidecar):
        Image.fromarray(values).save(picture, format="PNG")
        notes["picture"] = _digest(picture)
        sidecar.write_text(
            f"# height = offset + scale * value, metres\n{yaml.safe_dump(notes)}", encoding="utf-8"
        )


def _load_png(path: Path) -> dict[str, Any]:
    sidecar = _sidecar(path)
    if not sidecar.is_file():
        raise MapError(
            f"a PNG holds no metres: put scale, offset, resolution, origin and unknown in {sidecar}"
        )
    lines = read_file(sidecar, {".yaml": _lines}, "sidecar", MapError, _CURE)
    notes = parse_record(Sidecar, lines, MapError, sidecar.name)
    values, clear = _picture(path)
    if notes.picture not in (None, _digest(path)):
        raise MapError(
            f"it is not the picture that {sidecar.name} describes: {_CURE} (or delete the line "
            "`picture`, if you changed it on purpose)"
        )
    known = np.logical_and(*(values != one for one in (notes.unknown, clear)))
    heights = heights_of(
        values.shape, lambda rows: (values[rows], known[rows]), notes.scale, notes.offset
    )
    return {"heights": heights, "resolution": notes.resolution, "origin": notes.origin}


def _picture(path: Path) -> tuple[np.ndarray, int | None]:
    """Return the values of a grey picture, and which of them is transparent."""
    # Mapped, since a file takes memory for whatever length a chunk claims before it reads it.
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        warnings.catch_warnings(action="ignore"),  # of many pixels, of which we have our own limit
        Image.open(data, formats=["PNG"]) as image,  # pyright: ignore[reportArgumentType]
    ):
        check_cells(image.size)
        # What the file holds, not what Pillow would make of it: 2 and 4 bits are stretched to 8.
        raw = image.tile[0][3] if image.tile else image.mode
        if raw not in ("L", "I;16B") or getattr(image, "is_animated", False):
            raise MapError(
                "a height image is one picture with one channel of grey of 8 or 16 bits, this one "
                f"holds {raw}"
            )
        return np.asarray(image), image.info.get("transparency")


def _lines(path: Path) -> dict[str, Any]:
    """Return what a small YAML file maps to what."""
    with path.open("rb") as file:
        text = file.read(_LARGEST_SIDECAR + 1)
    if len(text) > _LARGEST_SIDECAR:
        raise MapError(f"it has more than {_LARGEST_SIDECAR} bytes")
    loader = yaml.SafeLoader(text)
    tree = loader.get_single_node()
    # Nothing within lists: parts that refer to parts could make a tree of a few lines endless.
    if not isinstance(tree, yaml.MappingNode) or any(
        not isinstance(part, yaml.ScalarNode)
        for _, node in tree.value
        for part in (node.value if isinstance(node, yaml.SequenceNode) else [node])
    ):
        raise MapError("it must hold lines such as `scale: 0.001` and `origin: [0, 0]`")
    lines = loader.construct_document(tree)
    if len(tree.value) != len(lines):  # of two equal keys YAML takes the last
        raise MapError("it gives a key twice")
    return lines


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".yaml")


_WRITERS = {
    ".npz": _save_npz,
    ".tif": save_geotiff,
    ".tiff": save_geotiff,
    ".png": _save_png,
}
_READERS = {
    ".npz": _load_npz,
    ".tif": load_geotiff,
    ".tiff": load_geotiff,
    ".png": _load_png,
}
