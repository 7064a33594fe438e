"""Files that hold an elevation map: .npz, GeoTIFF, and 16-bit PNG with a YAML sidecar.

Reads a path and gives the fields of an `ElevationMap`, or the other way round. Images run row by
row from north to south, maps [ix, iy] from south to north; only this file turns one into the other.
GeoTIFF (OGC 19-008): heights as float32, NaN for unknown cells.
"""

import math
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from PIL import Image

from fgtutor.errors import MapError
from fgtutor.storage import atomic_write

if TYPE_CHECKING:
    from fgtutor.elevation import ElevationMap

_READ_ERRORS = (
    *(OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, MemoryError),
    *(SyntaxError, zipfile.BadZipFile, zlib.error, yaml.YAMLError, NotImplementedError),
)
"""What numpy, Pillow (SyntaxError), rasterio and YAML raise on damaged files."""


def write(elevation: "ElevationMap", path: Path) -> None:
    """Write a map to a file of the kind its suffix names.

    Raises:
        MapError: The suffix names no kind of map file.
        StorageError: The system refused to write; nothing partial is left.
    """
    _codec(path)[0](elevation, path)


def read(path: Path) -> dict[str, Any]:
    """Return the arguments of the `ElevationMap` that a file holds.

    Raises:
        MapError: The file is missing, of another kind, corrupt, or says too little.
    """
    load = _codec(path)[1]
    if not path.is_file():
        raise MapError(f"there is no map file {path}: check the path")
    try:
        return load(path)
    except MapError as error:
        raise MapError(f"{path}: {error}") from error
    except _READ_ERRORS as error:
        raise MapError(
            f"cannot read {path} as a {path.suffix} map ({type(error).__name__}: {error}); the "
            "file is corrupt or of another kind: write it again with ElevationMap.save"
        ) from error


def _save_npz(elevation: "ElevationMap", path: Path) -> None:
    with atomic_write(path) as temporary:
        np.savez_compressed(
            temporary,
            heights=elevation.heights,
            known=elevation.known,
            resolution=elevation.resolution,
            origin=elevation.origin,
        )


def _load_npz(path: Path) -> dict[str, Any]:
    # Opened here, because np.load leaves a file open that turns out not to be an archive.
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        return {
            "heights": file["heights"],
            "known": file["known"],
            "resolution": float(file["resolution"]),
            "origin": tuple(file["origin"].tolist()),
        }


def _observed(elevation: "ElevationMap") -> np.ndarray:
    return np.where(elevation.known, elevation.heights, np.float32(np.nan))


def _save_geotiff(elevation: "ElevationMap", path: Path) -> None:
    import rasterio
    from rasterio.io import MemoryFile

    x0, _, _, y1 = elevation.extent
    step = elevation.resolution
    # GDAL reports a full disk late or not at all, so it writes to memory and Python to the disk.
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=elevation.shape[0],
            height=elevation.shape[1],
            count=1,
            dtype="float32",
            nodata=math.nan,
            compress="deflate",
            transform=rasterio.Affine(step, 0.0, x0, 0.0, -step, y1),
        ) as file:
            # A raster's rows go from north to south: transpose [ix, iy], then turn upside down.
            file.write(_observed(elevation).T[::-1], 1)
        with atomic_write(path) as temporary:
            temporary.write_bytes(memory.getbuffer())


def _load_geotiff(path: Path) -> dict[str, Any]:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # an error of ours, just below
        with rasterio.open(path, driver="GTiff") as file:
            place = file.transform
            if place.is_identity:
                raise MapError("the TIFF has no georeference, so its resolution is unknown")
            if file.crs is not None and file.crs.is_geographic:
                raise MapError(f"the raster is in degrees ({file.crs}): reproject it to metres")
            if place.b or place.d or place.a <= 0 or not math.isclose(place.a, -place.e):
                raise MapError(f"the raster must be north-up with square cells, got {tuple(place)}")
            rows = file.read(1, masked=True).astype(np.float32).filled(np.nan)
            # To the nanometre: the lower edge is a difference of rounded numbers.
            origin = place.c, round(place.f + file.height * place.e, 9)
    # Rows go from north to south: turn them over, then transpose to [ix, iy].
    return {"heights": rows[::-1].T, "resolution": place.a, "origin": origin}


_UNKNOWN = 65535
"""The PNG value of an unknown cell; heights use 0..65534."""


def _save_png(elevation: "ElevationMap", path: Path) -> None:
    heights = _observed(elevation).astype(float)
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
    # Both files are complete on the disk before either takes its name.
    with atomic_write(_sidecar(path)) as sidecar, atomic_write(path) as temporary:
        sidecar.write_text("# height = offset + scale * value, metres\n" + yaml.safe_dump(notes))
        # An image's rows go from north to south: transpose [ix, iy], then turn upside down.
        rows = np.ascontiguousarray(values.T[::-1])
        Image.fromarray(rows).save(temporary, format="PNG")


def _load_png(path: Path) -> dict[str, Any]:
    sidecar = _sidecar(path)
    if not sidecar.is_file():
        raise MapError(
            f"a PNG holds no metres: put scale, offset, resolution, origin and unknown in {sidecar}"
        )
    notes = yaml.safe_load(sidecar.read_text())
    missing = {"scale", "offset", "resolution", "origin"} - set(notes or ())
    if missing:
        raise MapError(f"{sidecar.name} lacks {', '.join(sorted(missing))}")
    with Image.open(path, formats=["PNG"]) as image:
        if image.mode not in ("I;16", "I;16B", "I", "L"):
            raise MapError(f"a height image has one channel of grey, this one is {image.mode}")
        values = np.asarray(image)
    heights = float(notes["offset"]) + float(notes["scale"]) * values.astype(float)
    heights[values == notes.get("unknown", _UNKNOWN)] = np.nan
    # Rows go from north to south: turn them over, then transpose to [ix, iy].
    return {
        "heights": heights[::-1].T,
        "resolution": float(notes["resolution"]),
        "origin": tuple(notes["origin"]),
    }


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".yaml")


_CODECS = {
    ".npz": (_save_npz, _load_npz),
    ".tif": (_save_geotiff, _load_geotiff),
    ".tiff": (_save_geotiff, _load_geotiff),
    ".png": (_save_png, _load_png),
}


def _codec(path: Path) -> tuple[Callable, Callable]:
    """Return the functions that save and load files of this suffix."""
    try:
        return _CODECS[path.suffix.lower()]
    except KeyError:
        raise MapError(
            f"{path} has the suffix {path.suffix!r}; maps are {', '.join(_CODECS)} files"
        ) from None
