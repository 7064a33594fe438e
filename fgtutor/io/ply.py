"""Point clouds in PLY files: the vertices, in ascii or binary; faces and all else are passed over.

Reads .ply; gives coordinates. Source: Turk, "The PLY Polygon File Format" (1994).
"""

import io
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, check_count, cloud_of, note, whole_number
from fgtutor.io.xyz import read_table

_LONGEST_HEADER = 2**20
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{
        "float": "f4",
        "double": "f8",
        "float32": "f4",
        "float64": "f8",
        "int8": "i1",
        "uint8": "u1",
    },
    **{"int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
}
_CODES = {
    **{"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"},
    **{"f4": "f", "f8": "d"},
}


@dataclass
class _Element:
    """What the header says of one kind of thing: how many, and what each has."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)
    """Name, type, and the type of the length of a list or ""."""

    @property
    def size(self) -> int | None:
        """Bytes of one; None if lists make it vary."""
        if any(length for _, _, length in self.properties):
            return None
        return sum(int(kind[1]) for _, kind, _ in self.properties)


def read_ply(path: Path) -> Cloud:
    """Return the vertices of a PLY file.

    Raises:
        CloudError: The header makes no sense, names no x, y and z, or promises more than there is.
    """
    data = path.read_bytes()
    form, elements, start = _header(data)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise CloudError("the PLY file has no vertices: it holds no points")
    names = [name for name, _, _ in vertex.properties]
    where = [names.index(axis) for axis in "xyz" if names.count(axis) == 1]
    if len(where) != 3 or any(vertex.properties[i][2] for i in where):
        shown = ", ".join(names)[:60]
        raise CloudError(f"the vertices have {shown!r}, expected each of x, y and z once")
    before = elements[: elements.index(vertex)]
    last = vertex is elements[-1]
    read = _read_ascii if form == "ascii" else _read_binary
    points, left = read(data, start, before, vertex, where, form)
    return cloud_of(points, notes=note(left, "byte", " after the last vertex") if last else ())


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Return the format, what the file holds, and where it begins."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not first:
        raise CloudError("it does not begin with 'ply': the file is corrupt or of another kind")
    end = re.search(rb"(?<=[\r\n])end_header[ \t]*" + first[1], data[:_LONGEST_HEADER])
    if not end:
        raise CloudError("the header has no end_header: the file was cut off, or is no PLY file")
    form, elements = "", []
    for line in data[: end.start()].decode("latin-1").split(first[1].decode()):
        match line.split():
            case [] | ["ply" | "comment" | "obj_info", *_]:
                pass
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as form, _]:
                pass
            case ["element", name, count]:
                elements.append(_Element(name, whole_number(count, f"the number of {name[:40]!r}")))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name.lower(), _TYPES[kind], ""))
            case ["property", "list", length, kind, name] if (
                elements and kind in _TYPES and length in _TYPES
            ):
                elements[-1].properties.append((name.lower(), _TYPES[kind], _TYPES[length]))
            case _:
                raise CloudError(f"a line of the header makes no sense: {line[:60]!r}")
    if not form:
        raise CloudError("the header names no format: the file is damaged")
    return form, elements, end.end()


def _read_binary(
    data: bytes, at: int, before: list[_Element], vertex: _Element, where: list[int], form: str
) -> tuple[np.ndarray, int]:
    """Return the vertices, and how many bytes follow them."""
    order = "<" if form == "binary_little_endian" else ">"

    def take(kind: str) -> float:
        nonlocal at
        (value,) = struct.unpack_from(order + _CODES[kind], data, at)
        at += int(kind[1])
        return value

    for element in before:
        if element.size is None:
            _walk(element, take)
        else:
            at += element.count * element.size
    if vertex.size is None:
        return _walk(vertex, take)[:, where], len(data) - at
    room = max(len(data) - at, 0) // vertex.size
    check_count(min(room, vertex.count), vertex.count)
    starts = np.cumsum([0, *(int(kind[1]) for _, kind, _ in vertex.properties)])
    row = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + vertex.properties[i][1] for i in where],
            "offsets": [int(starts[i]) for i in where],
            "itemsize": vertex.size,
        }
    )
    table = np.frombuffer(data, row, vertex.count, min(at, len(data)))
    return table, len(data) - at - table.nbytes


def _read_ascii(
    data: bytes, at: int, before: list[_Element], vertex: _Element, where: list[int], _form: str
) -> tuple[np.ndarray, int]:
    """Return the vertices, and how many letters follow them."""
    lines = io.TextIOWrapper(io.BytesIO(data[at:]), "latin-1")
    passed = sum(element.count for element in before if element.properties)
    for _ in islice(lines, passed):
        pass
    if vertex.size is None:
        words = (word for line in lines for word in line.split())
        points = _walk(vertex, lambda _: float(next(words)))[:, where]
    else:
        number = len(data[:at].splitlines()) + passed + 1
        points = read_table(islice(lines, vertex.count), number, where, len(vertex.properties))
        check_count(len(points), vertex.count)
    return points, len(lines.read().strip())


def _walk(element: _Element, take: Callable[[str], float]) -> np.ndarray:
    """Take one after the other, since lists make their size vary; return the single values."""
    rows = []
    try:
        for _ in range(element.count):
            row = []
            for _, kind, length in element.properties:
                if length:
                    for _ in range(int(take(length))):
                        take(kind)
                row.append(0.0 if length else take(kind))
            rows.append(row)
    except (struct.error, StopIteration, ValueError, OverflowError) as error:
        raise CloudError(
            f"{element.name[:40]!r} {len(rows) + 1} of {element.count} is cut off or no number: "
            "copy the file again"
        ) from error
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(element.properties))
