"""Point clouds in PCD files, versions .5 to .7: ascii, binary, and compressed binary.

Reads .pcd; gives coordinates. Source: the Point Cloud Library's "The PCD file format"; what its own
reader takes is taken here.
"""

import io
import re
import struct
from contextlib import suppress
from pathlib import Path

import lzf
import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import (
    Cloud,
    axes_of,
    check_claim,
    check_count,
    cloud_of,
    note,
    read_rows,
    whole_number,
)
from fgtutor.io.xyz import read_table

_LONGEST_HEADER = 2**20
_KEYS = {
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"),
    *("COLUMNS", "DATA"),
}
_TYPES = {f"{t}{n}" for t, sizes in (("F", "248"), ("I", "1248"), ("U", "1248")) for n in sizes}


def read_pcd(path: Path) -> Cloud:
    """Return the points of a PCD file.

    Raises:
        CloudError: The header makes no sense, names no x, y and z, or promises another number of
            points than there are.
    """
    data = path.read_bytes()
    header, start = _header(data)
    fields = [name.lower() for name in header.get("FIELDS", header.get("COLUMNS", []))]
    types, sizes = header.get("TYPE", []), header.get("SIZE", [])
    counts = header.get("COUNT", ["1"] * len(fields))
    if not len(fields) == len(types) == len(sizes) == len(counts):
        raise CloudError(
            f"the header has {len(fields)} FIELDS, but {len(sizes)} SIZE, {len(types)} TYPE and "
            f"{len(counts)} COUNT"
        )
    repeats = [whole_number(text, "COUNT") for text in counts]
    where = dict(zip(axes_of(fields), "xyz", strict=True))
    kinds = {i: f"{types[i].upper()}{sizes[i]}" for i in where}
    if any(repeats[i] != 1 for i in where) or not {*kinds.values()} <= _TYPES:
        several = ", ".join(str(repeats[i]) for i in where)
        raise CloudError(
            f"x, y and z should be one number each, the header gives them TYPE and SIZE "
            f"{', '.join(kinds.values())[:40]!r} and COUNT {several}"
        )
    points, notes = _points(header), _viewpoint(header)
    form = "".join(header["DATA"]).lower()
    if form == "ascii":
        lines = io.TextIOWrapper(io.BytesIO(data[start:]), "latin-1")
        number = len(data[:start].splitlines()) + 1
        table = read_table(lines, number, [sum(repeats[:i]) for i in where], sum(repeats))
        check_count(len(table), points)
        return cloud_of(table, notes=notes)
    # Other fields are so many bytes, whatever their type.
    widths = [f"V{whole_number(s, 'SIZE') * n}" for s, n in zip(sizes, repeats, strict=True)]
    row = np.dtype(
        [
            (where[i], f"<{kinds[i].lower()}") if i in where else ("", width)
            for i, width in enumerate(widths)
        ]
    )
    if form == "binary":
        table, rest = read_rows(data, start, points, row)
        return cloud_of(table, notes=notes + note(rest, "byte", " after the last point"))
    if form != "binary_compressed":
        raise CloudError(f"DATA is {form[:40]!r}, expected ascii, binary or binary_compressed")
    raw = _unpacked(data, start, row.itemsize * points)
    # Here all values of a field come before those of the next.
    table = np.empty(points, [(axis, row[axis]) for axis in "xyz"])
    for axis in "xyz":
        offset: int = row.fields[axis][1]  # pyright: ignore[reportOptionalSubscript]
        table[axis] = np.frombuffer(raw, row[axis], points, points * offset)
    return cloud_of(table, notes=notes)


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the words of each line of the header, and where the points begin."""
    header, start = {}, 0
    while "DATA" not in header:
        end = data.find(b"\n", start, _LONGEST_HEADER)
        words = data[start : max(end, start)].decode("latin-1").split()
        start = end + 1
        if end < 0:
            raise CloudError("the header has no line DATA: the file was cut off, or is no PCD file")
        if words and not words[0].startswith("#"):
            key = words[0].upper()
            if key not in _KEYS or key in header:
                raise CloudError(f"a line of the header makes no sense: {' '.join(words)[:60]!r}")
            header[key] = words[1:]
    version = "".join(header.get("VERSION", [".7"]))
    if not re.fullmatch(r"0?\.[567]0*", version):
        raise CloudError(f"the PCD version is {version[:40]!r}, expected .5, .6 or .7")
    return header, start


def _points(header: dict[str, list[str]]) -> int:
    """Return how many points the header promises."""
    said = {
        key: whole_number("".join(header[key]), key)
        for key in ("WIDTH", "HEIGHT", "POINTS")
        if key in header
    }
    area = said["WIDTH"] * said.get("HEIGHT", 1) if "WIDTH" in said else said.get("POINTS")
    if area is None:
        raise CloudError("the header says neither POINTS nor WIDTH and HEIGHT")
    if said.get("POINTS", area) != area:
        raise CloudError(
            f"the header contradicts itself: WIDTH x HEIGHT is {area}, POINTS is {said['POINTS']}"
        )
    return area


def _viewpoint(header: dict[str, list[str]]) -> tuple[str, ...]:
    """Return a note if the sensor stood elsewhere than in the origin: PCL does not move points."""
    pose = header.get("VIEWPOINT", [])
    moved = pose not in ([], ["0", "0", "0", "1", "0", "0", "0"])
    return (f"VIEWPOINT {' '.join(pose)[:60]!r} was not applied",) if moved else ()


def _unpacked(data: bytes, start: int, size: int) -> bytes:
    """Return decompressed bytes (LZF), which must be that many."""
    if len(data) < start + 8:
        raise CloudError("the file was cut off: copy it again")
    packed, promised = struct.unpack_from("<II", data, start)
    if promised != size:
        raise CloudError(f"{size} bytes of points are expected, the file says {promised}")
    if packed > len(data) - start - 8:
        raise CloudError(f"{packed} bytes are promised, the file was cut off: copy it again")
    check_claim(size, len(data))
    with suppress(ValueError):
        raw = lzf.decompress(data[start + 8 : start + 8 + packed], size) if size else b""
        if raw is not None and len(raw) == size:
            return raw
    raise CloudError("the compressed points are damaged: copy or export the file again")
