"""The units of a file's coordinates, by the reference system that it names.

Reads WKT, EPSG numbers and GeoTIFF keys; gives the metres in a unit of x and y, and of z if told.
Sources: OGC 12-063r5 (WKT), OGC 19-008 (GeoTIFF keys), EPSG's units of measure.
"""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fgtutor.errors import FgtutorError

if TYPE_CHECKING:
    from rasterio.crs import CRS

Length = tuple[float, str]
"""Metres in a unit of length, and its name."""

METRE: Length = 1.0, "metre"
_LENGTHS: dict[int, Length] = {
    9001: METRE,
    9002: (0.3048, "foot"),
    9003: (1200 / 3937, "US survey foot"),
    9005: (0.3047972654, "Clarke's foot"),
    9036: (1000.0, "kilometre"),
    1033: (0.01, "centimetre"),
    1025: (0.001, "millimetre"),
}
"""EPSG's units of length."""
_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\["([^"]*)", *([0-9.eE+-]+)')
_OWN = 32767
"""What a GeoTIFF key holds if the file defines the thing itself; 0 means undefined."""


@dataclass(frozen=True)
class Units:
    """The units of a file's coordinates."""

    plane: Length = METRE
    """That of x and y."""
    up: Length | None = None
    """That of z, if it is told."""


def units_of_crs(crs: "CRS", error: type[FgtutorError]) -> Units:
    """Return the units of a reference system; raises `error` if they are no lengths on a plane."""
    wkt = crs.to_wkt()
    name = (re.search(r'"([^"]*)"', wkt) or [""])[0][:60]
    if crs.is_geographic:
        raise error(f"the coordinates are in degrees ({name}): project them to metres")
    if wkt.startswith(("GEOCCS", "GEODCRS")):
        raise error(f"the coordinates are geocentric ({name}), z is not up: project them to metres")
    if "Pseudo-Mercator" in wkt or "Mercator_Auxiliary_Sphere" in wkt:
        raise error(f"{name} stretches lengths: project the coordinates to UTM or the like")
    plane, *vertical = re.split(r"VERT_CS\[|VERTCRS\[", wkt)
    if vertical and re.search(r", *DOWN\]", vertical[0], re.IGNORECASE):
        raise error(f"z is a depth ({name}), not a height: turn its sign")
    # The last unit of the plane's part is its own; those before it belong to what it rests on.
    return Units(_units(plane)[-1], _units(vertical[0])[0] if vertical else None)


def units_of_wkt(text: str, error: type[FgtutorError]) -> Units:
    """Return the units of a reference system in WKT, as `units_of_crs`."""
    return units_of_crs(_crs("from_wkt", text, error), error)


def units_of_geokeys(
    keys: dict[int, int], own: dict[int, float], error: type[FgtutorError]
) -> Units:
    """Return the units that GeoTIFF keys name.

    Args:
        keys: Keys and their numbers.
        own: The metres in the units that the file defines itself, by the key of the unit.
        error: What to raise if the coordinates are no lengths, or their unit is not known.
    """
    if keys.get(1024) == 2 or (2048 in keys and not {3072, 3076} & keys.keys()):
        raise error("the coordinates are in degrees: project them to metres")
    if keys.get(1024) == 3:
        raise error("the coordinates are geocentric, z is not up: project them to metres")

    def stated(key: int) -> Length | None:
        code = keys.get(key, 0)
        length = (own.get(key, 0.0), "unit of its own") if code == _OWN else _LENGTHS.get(code)
        if code and not (length and 0 < length[0] < math.inf):
            raise error(f"the unit {code} of GeoTIFF key {key} is not known: convert to metres")
        return length

    units = Units()
    if keys.get(3072, 0) not in (0, _OWN):
        units = units_of_crs(_crs("from_epsg", keys[3072], error), error)
    plane, up = stated(3076) or units.plane, stated(4099) or units.up
    if up is None and keys.get(4096, 0) not in (0, _OWN):
        try:
            vertical = _crs("from_epsg", keys[4096], error)
        except error:
            pass  # writers also put numbers of datums here, which say nothing of the unit
        else:
            up = units_of_crs(vertical, error).up
    return Units(plane, up)


def _units(wkt: str) -> list[Length]:
    return [(float(factor), name) for name, factor in _UNIT.findall(wkt)] or [METRE]


def _crs(kind: str, what: str | int, error: type[FgtutorError]) -> "CRS":
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        with rasterio.Env():  # or GDAL prints
            return getattr(CRS, kind)(what)
    except CRSError as problem:
        raise error(
            f"the reference system {str(what)[:60]!r} is not known ({problem}), so its unit is "
            "not: convert to metres and leave it out"
        ) from problem
