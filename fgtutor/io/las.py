"""Point clouds in LAS and LAZ files, in metres, without noise and withheld points.

Reads .las and .laz; gives coordinates. LAZ is decompressed by lazrs, in a process of its own.
Source: ASPRS, LAS 1.4 R15; the units are those of the file's projection records, which are
GeoTIFF's keys (OGC 19-008) or WKT (OGC 12-063r5).
"""

import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, check_claim, check_count, cloud_of, note
from fgtutor.io.units import Units, units_of_geokeys, units_of_wkt

_HEAD = struct.Struct("<4sHH16xBB68xHIIBHI20x6d48x")
"""Table 3 up to byte 227, where LAS 1.2 ends."""
_MORE = struct.Struct("<8xQIQ120x")
"""What LAS 1.4 adds: where extended records begin, how many there are, and how many points."""
_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Bytes of a point record at least, by format (tables 7 to 17)."""
_NOISE = (7, 18)
"""Classes of low and high noise (table 17). Overlap (12) is ground seen twice, and kept."""
_GEOKEYS, _GEODOUBLES, _WKT, _LASZIP = 34735, 34736, 2112, 22204
_BLOCK = 2**16
_LONGEST_RECORD = 2**20


@dataclass
class _Header:
    """What the header says of the points, and the records that matter."""

    start: int
    form: int
    size: int
    count: int
    scales: np.ndarray
    offsets: np.ndarray
    packed: bool
    wkt: bool
    records: dict[int, bytes] = field(default_factory=dict)


def read_las(path: Path) -> Cloud:
    """Return the points that are neither noise nor withheld, in metres.

    Raises:
        CloudError: The header makes no sense or promises more than there is, the coordinates are
            degrees or of an unknown unit, or the compressed points are damaged.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header = _header(file, size)
        units = _units(header)
        if header.packed:
            check_claim(24 * header.count, size)
            points, left = _unpacked(file, header, size)
        else:
            room = (size - header.start) // header.size
            check_count(min(room, header.count), header.count)
            file.seek(header.start)
            points, left = _points(file, header)
    check_count(len(points) + sum(left), header.count)
    noise, withheld = left
    notes = note(noise, "point", f" of the noise classes {_NOISE[0]} and {_NOISE[1]}")
    notes += note(withheld, "withheld point")
    if header.count and not len(points):
        raise CloudError(f"no point is left: {', '.join(notes)}")
    up, name = units.up or units.plane
    metres = np.array([units.plane[0], units.plane[0], up])
    if not np.allclose(metres, 1, rtol=0, atol=1e-9):
        points *= metres
        notes += (f"x and y in {units.plane[1]!r} and z in {name!r} converted to metres",)
    return cloud_of(points, step=float(np.abs(header.scales * metres).max()), notes=notes)


def _header(file: BinaryIO, size: int) -> _Header:
    """Return a header all of whose numbers fit each other and the file."""
    raw = file.read(_HEAD.size + _MORE.size)
    if raw[:4] != b"LASF" or len(raw) < _HEAD.size:
        raise CloudError("it is no LAS file, or was cut off: copy or export it again")
    (_, _, encoding, major, minor, length, start, number, form, width, count, *grid) = (
        _HEAD.unpack_from(raw)
    )
    form, packed = form & 0x3F, bool(form & 0xC0)
    if major != 1 or minor > 4:
        raise CloudError(f"the LAS version is {major}.{minor}, expected 1.0 to 1.4")
    if form >= len(_SIZES) or width < _SIZES[form]:
        raise CloudError(f"point format {form} with records of {width} bytes is not in LAS 1.4")
    extended = 0, 0
    if minor == 4:
        if length < len(raw) or len(raw) < _HEAD.size + _MORE.size:
            raise CloudError("the header is shorter than that of LAS 1.4: the file is damaged")
        *extended, many = _MORE.unpack_from(raw, _HEAD.size)
        count = many or count
    if not _HEAD.size <= length <= start <= size:
        raise CloudError(
            f"a header of {length} bytes and points from byte {start} do not fit into the file of "
            f"{size} bytes: it was cut off or is damaged"
        )
    grid = np.array(grid).reshape(2, 3)
    with np.errstate(over="ignore"):
        if not (grid[0] != 0).all() or not np.isfinite(grid * 2.0**32).all():
            raise CloudError(
                f"scales {grid[0].tolist()} and offsets {grid[1].tolist()} cannot be: the file is "
                "damaged"
            )
    header = _Header(start, form, width, count, grid[0], grid[1], packed, bool(encoding & 16))
    header.records = dict(_records(file, length, start, number, "<2x16sHH32x"))
    if extended[1]:
        header.records |= dict(_records(file, extended[0], size, extended[1], "<2x16sHQ32x"))
    return header


def _records(
    file: BinaryIO, at: int, end: int, number: int, layout: str
) -> Iterator[tuple[int, bytes]]:
    """Yield the records between two places that tell of the projection or of LASzip."""
    head = struct.Struct(layout)
    misfit = f"the header promises {number} records, which do not fit into the file"
    if at + number * head.size > end:
        raise CloudError(misfit)
    for _ in range(number):
        file.seek(at)
        raw = file.read(head.size)
        at += head.size
        if at > end:
            raise CloudError(misfit)
        user, kind, length = head.unpack(raw)
        if at + length > end:
            raise CloudError(f"{misfit}: number {kind} has {length} bytes")
        owner = b"laszip encoded" if kind == _LASZIP else b"LASF_Projection"
        if user.rstrip(b"\0") == owner:
            yield kind, file.read(min(length, _LONGEST_RECORD))
        at += length


def _points(stream: BinaryIO, header: _Header) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the points that count, and how many are noise or withheld."""
    late = header.form >= 6  # the formats of LAS 1.4 have other bytes for class and flags
    layout = np.dtype(
        {
            "names": ["place", "flags", "class"],
            "formats": ["<3i4", "u1", "u1"],
            "offsets": [0, 15, 16 if late else 15],
            "itemsize": header.size,
        }
    )
    points = np.empty((header.count, 3))
    kept, left = 0, np.zeros(2, dtype=int)
    while raw := stream.read(min(_BLOCK, header.count - kept - left.sum()) * header.size):
        table = np.frombuffer(raw, layout, len(raw) // header.size)
        withheld = table["flags"] & (4 if late else 128) != 0
        noise = np.isin(table["class"] if late else table["class"] & 31, _NOISE) & ~withheld
        block = table["place"][~(withheld | noise)] * header.scales + header.offsets
        points[kept : kept + len(block)] = block
        kept += len(block)
        left += noise.sum(), withheld.sum()
    return points[:kept], (int(left[0]), int(left[1]))


def _unpacked(file: BinaryIO, header: _Header, size: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Return what `_points` does, of compressed points.

    On some damaged files lazrs ends the process that it runs in, so it gets one of its own.
    """
    record = header.records.get(_LASZIP, b"")
    items = record[34 : 34 + 6 * int.from_bytes(record[32:34], "little")]
    if len(items) % 6 or sum(w for _, w, _ in struct.iter_unpack("<3H", items)) != header.size:
        raise CloudError("the LASzip record does not describe the points: the file is damaged")
    spec = find_spec("lazrs")
    if spec is None or spec.origin is None:
        raise CloudError("LAZ files need the package lazrs: install it")
    memory, seconds = 2**29 + 2 * size, 10 + header.count // 100_000
    words = (Path(spec.origin).parents[1], header.start, header.count, header.size, record.hex())
    script = Path(__file__).with_name("lazchild.py")
    # -I: neither the working folder nor the environment chooses what is imported; -S: fast.
    command = [sys.executable, "-I", "-S", *map(str, (script, *words, memory, seconds))]
    with subprocess.Popen(
        command, stdin=file, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        points, left = _points(child.stdout, header)  # pyright: ignore[reportArgumentType]
        _, errors = child.communicate()
    if child.returncode:
        said = errors.decode(errors="replace").splitlines()[-1:] if child.returncode > 0 else []
        raise CloudError(
            f"lazrs could not decompress it ({ascii(said[0])[1:-1][:100] if said else 'it died'}): "
            "the file is corrupt, copy or export it again"
        )
    return points, left


def _units(header: _Header) -> Units:
    """Return what the projection records say."""
    records = header.records
    text = records.get(_WKT, b"").rstrip(b"\0").decode("utf-8", "replace").strip()
    raw = records.get(_GEOKEYS, b"")
    if text and (header.wkt or not raw):
        return units_of_wkt(text, CloudError)
    if len(raw) < 8:
        return Units()
    entries = list(struct.iter_unpack("<4H", raw[8 : len(raw) // 8 * 8]))[: raw[6] + 256 * raw[7]]
    keys = {key: value for key, location, _, value in entries if location == 0}
    doubles = records.get(_GEODOUBLES, b"")
    numbers = struct.unpack(f"<{len(doubles) // 8}d", doubles[: len(doubles) // 8 * 8])
    # A unit of one's own stands under the key that follows, except that of z, which has none.
    own = {
        key - 1: numbers[value]
        for key, location, _, value in entries
        if location == _GEODOUBLES and value < len(numbers)
    }
    return units_of_geokeys(keys, own, CloudError)
