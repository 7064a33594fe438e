"""Point clouds in PLY files: the vertices, in ascii or binary; faces and all else are passed over.

Reads .ply; gives coordinates. Source: Turk, "The PLY Polygon File Format" (1994).
"""

import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, axes_of, check_count, cloud_of, note, read_rows, whole_number
from fgtutor.io.xyz import read_table

_LONGEST_HEADER = 2**20
_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES: dict[str, str] = dict(zip(_NAMES, _KINDS, strict=True))
_TYPES |= {np.dtype(kind).name: kind for kind in (*_KINDS, "i8", "u8")}
"""What a PLY file calls a type, and what numpy does."""


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
    order = [element.name for element in elements]
    if "vertex" not in order:
        raise CloudError("the PLY file has no vertices: it holds no points")
    *before, vertex = elements[: order.index("vertex") + 1]
    where = axes_of(["list" if length else name for name, _, length in vertex.properties])
    read = _read_ascii if form == "ascii" else _read_binary
    points, left = read(data, start, before, vertex, where, form)
    last = vertex is elements[-1]
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
        (value,) = np.frombuffer(data, order + kind, 1, at).tolist()
        at += int(kind[1])
        return value

    for element in before:
        if element.size is None:
            _walk(element, take)
        else:
            at += element.count * element.size
    if vertex.size is None:
        return _walk(vertex, take)[:, where], len(data) - at
    kinds = [order + kind for _, kind, _ in vertex.properties]
    names = ["xyz"[where.index(i)] if i in where else "" for i in range(len(kinds))]
    return read_rows(data, at, vertex.count, np.dtype(list(zip(names, kinds, strict=True))))


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
    except (StopIteration, ValueError, OverflowError) as error:
        raise CloudError(
            f"{element.name[:40]!r} {len(rows) + 1} of {element.count} is cut off or no number: "
            "copy the file again"
        ) from error
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(element.properties))
