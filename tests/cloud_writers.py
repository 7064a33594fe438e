"""Writers of point clouds in every format, by hand or by libraries that fgtutor does not use."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import lzf
import numpy as np
from laspy.vlrs.vlr import VLR

Writer = Callable[[Path, np.ndarray], object]


def cloud(n: int = 200, seed: int = 0) -> np.ndarray:
    """Return random points to the millimetre, which every file format keeps."""
    return np.random.default_rng(seed).uniform((-1, 2, -0.5), (3, 5, 0.5), (n, 3)).round(3)


def sheet(nx: int = 20, ny: int = 12, *, per_cell: int = 4, seed: int = 0) -> np.ndarray:
    """Return an even sheet of points in cells of 5 cm from (0, 0), with asymmetric relief."""
    rng = np.random.default_rng(seed)
    cell = np.indices((nx, ny)).reshape(2, -1).T.repeat(per_cell, axis=0)
    xy = 0.05 * (cell + rng.uniform(0.1, 0.9, cell.shape))
    z = 0.3 * np.sin(3 * xy[:, 0]) + 0.1 * xy[:, 1] + rng.normal(0, 0.005, len(xy))
    return np.column_stack((xy, z))


def ply(form: str, fields: dict[str, str], rows: Any, *, more: str = "", ends: str = "\n") -> bytes:
    """Return a PLY file of vertices; `more` follows them in the header."""
    kinds = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}
    order = ">" if "big" in form else "<"
    table = np.zeros(len(rows), [(name, order + kinds[kind]) for name, kind in fields.items()])
    for name, column in zip(fields, np.asarray(rows, dtype=float).T, strict=True):
        table[name] = column
    head = ["ply", f"format {form} 1.0", f"element vertex {len(rows)}"]
    head += [f"property {kind} {name}" for name, kind in fields.items()]
    text = ends.join([*head, *more.splitlines(), "end_header", ""]).encode()
    if form != "ascii":
        return text + table.tobytes()
    return text + "".join(" ".join(map(str, row)) + ends for row in table.tolist()).encode()


def pcd(data: str, points: np.ndarray, kind: str = "F 8", **header: str) -> bytes:
    """Return a PCD file of x, y, z; `header` replaces its lines, and "" leaves one out."""
    letter, size = kind.split()
    table = points.astype(f"<{letter.lower()}{size}")
    lines = {
        "VERSION": "0.7",
        "FIELDS": "x y z",
        "SIZE": " ".join([size] * 3),
        "TYPE": " ".join([letter] * 3),
        "COUNT": "1 1 1",
        "WIDTH": str(len(points)),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(len(points)),
    } | header
    lines["DATA"] = data
    head = "".join(f"{key} {value}\n" for key, value in lines.items() if value)
    body = table.tobytes()
    if data.lower() == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    if data == "binary_compressed":
        planes = table.T.tobytes()
        packed = lzf.compress(planes, 2 * len(planes))
        body = struct.pack("<II", len(packed), len(planes)) + packed
    return f"# .PCD v0.7\n{head}".encode() + body


def las(
    path: Path,
    points: np.ndarray,
    *,
    form: int = 3,
    version: str = "1.4",
    scale: float = 0.001,
    records: tuple[tuple[int, bytes], ...] = (),
    wkt: bool = False,
    **fields: Any,
) -> None:
    """Write a LAS file, or LAZ if the suffix says so."""
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(axis=0))
    header.global_encoding.wkt = wkt
    header.vlrs.extend(VLR("LASF_Projection", number, "", data) for number, data in records)
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    for name, values in fields.items():
        setattr(file, name, values)
    file.write(path)


def geokeys(*keys: tuple[int, int, int]) -> tuple[int, bytes]:
    """Return the record of GeoTIFF keys, each with its location and value."""
    words = [n for key, location, value in keys for n in (key, location, 1, value)]
    return 34735, struct.pack(f"<{4 + len(words)}H", 1, 1, 0, len(keys), *words)


def xyz(start: str, separator: str) -> Writer:
    def write(path: Path, points: np.ndarray) -> None:
        rows = (separator.join((*map(str, row), "255")) for row in points)
        path.write_text(start + "\n".join(rows) + "\n")

    return write


DOUBLES = dict.fromkeys("xyz", "double")
SPARE = {"intensity": "uchar", **DOUBLES}


def _ply(form: str) -> Writer:
    return lambda path, points: path.write_bytes(
        ply(form, SPARE, np.column_stack((np.full(len(points), 7), points)))
    )


def _pcd(data: str) -> Writer:
    return lambda path, points: path.write_bytes(pcd(data, points))


FORMATS: dict[str, tuple[str, Writer]] = {
    "binary ply": ("cloud.ply", _ply("binary_little_endian")),
    "big-endian ply": ("cloud.ply", _ply("binary_big_endian")),
    "ascii ply": ("cloud.PLY", _ply("ascii")),
    "ascii pcd": ("cloud.pcd", _pcd("ascii")),
    "binary pcd": ("cloud.pcd", _pcd("binary")),
    "compressed pcd": ("cloud.pcd", _pcd("binary_compressed")),
    "las": ("cloud.las", las),
    "laz": ("cloud.laz", las),
    "xyz": ("cloud.xyz", xyz("", " ")),
    "xyz with names": ("cloud.xyz", xyz("# by hand\n\nX;Y;Z;I\n", ";")),
    "xyz with commas": ("cloud.xyz", xyz("//X,Y,Z,I\n", ", ")),
    "npz": ("cloud.npz", lambda path, points: np.savez_compressed(path, points=points)),
}


def written(folder: Path, name: str, points: np.ndarray | None = None) -> Path:
    file, write = FORMATS[name]
    write(folder / file, cloud() if points is None else points)
    return folder / file
