"""GeoTIFF as an elevation map (OGC 19-008, GDAL's raster data model).

What a raster says about its numbers is obeyed: reference system, units, scale and offset, nodata,
masks, transparency. What cannot be obeyed is refused. Heights are written as float32 in metres,
NaN for unknown cells.
"""

import io
import math
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from fgtutor.errors import MapError
from fgtutor.grid import check_cells
from fgtutor.io.rasters import heights_of, rows_of
from fgtutor.io.storage import atomic_write
from fgtutor.io.units import units_of_crs

if TYPE_CHECKING:
    from rasterio import DatasetReader

    from fgtutor.elevation import ElevationMap

_METRES = {
    name: metres
    for metres, names in (
        (1.0, "m, metre, metres, meter, meters"),
        (1e3, "km, kilometre, kilometer"),
        (0.1, "dm, decimetre, decimeter"),
        (0.01, "cm, centimetre, centimeter, centimetres, centimeters"),
        (1e-3, "mm, millimetre, millimeter, millimetres, millimeters"),
        (0.3048, "ft, foot, feet, international foot, international feet"),
        (1200 / 3937, "us survey foot, us survey feet, ftus, us-ft, sft, foot_us"),
    )
    for name in names.split(", ")
}
"""What a raster may say in place of metres: the names of EPSG, PROJ, UCUM and everyday use."""


def save_geotiff(elevation: "ElevationMap", path: Path) -> None:
    """Write a map as GeoTIFF; raises `StorageError`."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    x0, _, _, y1 = elevation.extent
    step = elevation.resolution
    # GDAL reports a full disk late or not at all, so it writes to memory and Python to the disk.
    with MemoryFile() as memory, warnings.catch_warnings():
        # Cells of 1 m below (0, 0) have a place like any other, whatever rasterio thinks.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
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
            file.write(rows_of(elevation), 1)
            file.units = ("m",)
        with atomic_write(path) as temporary:
            temporary.write_bytes(memory.getbuffer())


def load_geotiff(path: Path) -> dict[str, Any]:
    """Return the arguments of the `ElevationMap` that a GeoTIFF holds.

    Raises:
        MapError: It is damaged or too large, is no map of heights, or says something about its
            numbers that cannot be obeyed.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings(), _quiet(), rasterio.Env(GDAL_CACHEMAX=64):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # an error of ours
        with path.open("rb") as raw, rasterio.open(_source(path, raw), driver="GTiff") as file:
            check_cells(file.shape)
            check_cells(file.block_shapes[0])
            band, alpha = _bands(file)
            plane, up = _units(file, band)
            scale, offset = file.scales[band - 1], file.offsets[band - 1]
            if not (math.isfinite(scale) and scale and math.isfinite(offset)):
                raise MapError(f"its heights have the scale {scale} and the offset {offset}")
            place = _placed(file, plane)
            strip = partial(_strip, file, band, alpha)
            return place | {"heights": heights_of(file.shape, strip, scale * up, offset * up)}


def _source(path: Path, raw: IO[bytes]) -> str | IO[bytes]:
    """Return what GDAL opens: the path, beside which it looks for masks, or a file without name."""
    name = str(path.absolute())  # a relative one could look like a URL
    return raw if os.fsencode(name).decode(errors="replace") != name else name


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep rasterio from printing that it cannot log a message of GDAL that is no UTF-8."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with redirect_stderr(io.StringIO()):
            yield
    finally:
        sys.unraisablehook = hook


def _bands(file: "DatasetReader") -> tuple[int, list[int]]:
    """Return the band of heights and those that say where it is transparent."""
    if file.subdatasets:
        raise MapError(f"it holds {len(file.subdatasets)} rasters: save one of them alone")
    colours = file.colorinterp
    alpha = [i for i, colour in zip(file.indexes, colours, strict=True) if colour.name == "alpha"]
    bands = [i for i in file.indexes if i not in alpha]
    if len(bands) != 1 or len(alpha) > 1:
        names = ", ".join(colour.name for colour in colours[:8])
        raise MapError(
            f"a map of heights has one band, this raster has {file.count} ({names}): save the band "
            "of heights alone, for example with gdal_translate -b 1"
        )
    (band,) = bands
    kind, colour = file.dtypes[band - 1], colours[band - 1]
    if colour.name not in ("gray", "undefined"):
        raise MapError(f"its band is part of a picture ({colour.name}), not heights")
    if np.dtype(kind).kind not in "fiu":
        raise MapError(f"heights are real numbers, this raster holds {kind}")
    return band, alpha


def _strip(
    file: "DatasetReader", band: int, alpha: list[int], rows: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Return some rows of a band, and which of their values are known."""
    from rasterio.windows import Window

    window = Window.from_slices(rows, slice(0, file.width))
    values = file.read(band, window=window)
    # GDAL's mask stands for the first that there is of a mask, nodata and alpha.
    known = file.read_masks(band, window=window) > 0
    nodata = file.nodatavals[band - 1]
    if nodata is not None:
        known &= values != nodata
    for one in alpha:
        known &= file.read(one, window=window) > 0
    return values, known


def _placed(file: "DatasetReader", metre: float) -> dict[str, Any]:
    """Return the resolution and the origin of a raster, m; the file's unit has `metre` metres."""
    place = file.transform
    if place.is_identity:
        raise MapError("the TIFF has no georeference, so its resolution is unknown")
    if place.b or place.d or place.a <= 0 or place.e >= 0:
        raise MapError(f"the raster must be north-up, got {tuple(place)[:6]}: warp it")
    if not abs(place.a + place.e) * max(file.shape) <= 0.01 * place.a:
        raise MapError(
            f"the raster must have square cells, got {place.a:g} x {-place.e:g}: warp it"
        )
    seconds = 3600 * place.a
    if (
        (file.crs is None and not any(file.units) and place.a < 0.01)
        and abs(seconds - round(seconds)) < 1e-4 * seconds
        and abs(1e4 * place.a - round(1e4 * place.a)) > 1e-3
    ):
        raise MapError(
            f"cells of {place.a:g} without a reference system are {seconds:.4g}'' in all "
            "likelihood: reproject the raster to metres, or give it a reference system in metres"
        )
    # Fifteen digits, and at most nanometres: the lower edge is a difference of rounded numbers.
    corner = (metre * place.c, metre * (place.f + file.height * place.e))
    origin = tuple(round(float(f"{value:.15g}"), 9) for value in corner)
    return {"resolution": metre * place.a, "origin": origin}


def _units(file: "DatasetReader", band: int) -> tuple[float, float]:
    """Return how many metres the units of a raster's plane and of its heights have."""
    name = (file.units[band - 1] or "").strip()
    up = _METRES.get(name.lower())
    if name and up is None:
        raise MapError(
            f"its heights are in {name[:40]!r}, which is no unit of length that is known"
        )
    if file.crs is None:
        return 1.0, up or 1.0
    units = units_of_crs(file.crs, MapError)
    plane, called = units.plane
    if up is None and units.up:
        up = units.up[0]
    if up is None and not math.isclose(plane, 1.0):
        raise MapError(
            f"its plane is in {called} of {plane:.7g} m and the unit of its heights is not given: "
            "set it (gdal_edit -units, or `units` in rasterio), or reproject the raster to metres"
        )
    return plane, up or 1.0
