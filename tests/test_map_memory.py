"""Files of maps that are small on the disk and large in memory."""

import io
import math
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from test_elevation import hilly
from test_mapfiles import SUFFIXES

from fgtutor.elevation import ElevationMap


def npy_bomb(path: Path, cells: tuple[int, int], **others: np.ndarray) -> None:
    """Write a map whose heights are a small file of many zeros."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"shape": cells, "fortran_order": False, "descr": "<f4"}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in others.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array)
        with archive.open("heights.npy", "w", force_zip64=True) as file:
            file.write(head.getvalue())
            for _ in range(math.prod(cells) * 4 // 2**20):
                file.write(bytes(2**20))


_LOADING = """
import resource, sys
from fgtutor.elevation import ElevationMap
import PIL.PngImagePlugin, rasterio
try:
    ElevationMap.load(sys.argv[2])  # what a loader imports late
except ValueError:
    pass
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    print(ElevationMap.load(sys.argv[1]), file=sys.stderr)
except ValueError as error:
    print(type(error).__name__, error, file=sys.stderr)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def loaded_elsewhere(path: Path) -> tuple[str, int]:
    """Load a map in another process; return what it says, and how many MB it took."""
    small = path.with_name(f"small{path.suffix}")
    hilly().save(small)
    command = [sys.executable, "-c", _LOADING, str(path), str(small)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stderr, int(done.stdout) // 1024


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["npz", "png", "png twice", "tif", "tif tile", "tif floats"])
def test_a_small_file_of_many_cells_is_refused_before_memory_is_taken(tmp_path, kind) -> None:
    path = tmp_path / f"bomb.{kind[:3]}"
    if kind == "npz":
        known = {"known": np.ones((2, 2), bool), "resolution": np.array(0.1), "origin": np.zeros(2)}
        npy_bomb(path, (12000, 12000), **known)
    elif kind.startswith("png"):
        Image.new("L", (13300, 13300) if kind == "png" else (3, 3)).save(path)
        if kind == "png twice":
            content = path.read_bytes()
            head = struct.pack(">II", 30000, 30000) + content[24:29]
            second = struct.pack(">I", 13) + b"IHDR" + head
            second += struct.pack(">I", zlib.crc32(b"IHDR" + head))
            path.write_bytes(content[:33] + second + content[33:])
        notes = {"scale": 1.0, "offset": 0.0, "resolution": 0.1, "origin": [0.0, 0.0]}
        path.with_name(path.name + ".yaml").write_text(yaml.safe_dump(notes))
    else:
        import rasterio

        side = {
            "tif": (60000, "uint8"),
            "tif tile": (100, "uint8"),
            "tif floats": (40000, "float32"),
        }
        change = {"blockxsize": 20000, "blockysize": 20000, "tiled": True}
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=side[kind][0],
            height=side[kind][0],
            count=1,
            dtype=side[kind][1],
            sparse_ok=True,
            transform=rasterio.Affine(2, 0, 0, 0, -2, 0),
            **(change if kind == "tif tile" else {"blockysize": 6000}),
        ):
            pass
    assert path.stat().st_size < 4e6
    said, megabytes = loaded_elsewhere(path)
    assert "MapError" in said and megabytes < 100
    assert ("corrupt" if kind == "png twice" else "more than 50000000") in said


@pytest.mark.slow
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_honest_large_map_loads(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"large{suffix}"
    wide = np.zeros((7000, 7100), np.float32)
    wide[3, 4] = 1.0
    ElevationMap(wide, 0.05, (500000, 4649776)).save(path)
    said, megabytes = loaded_elsewhere(path)
    assert "7000 x 7100 cells of 0.05 m from (500000.0, 4649776.0), heights 0.00..1.00 m" in said
    assert megabytes < 1000


def test_a_chunk_that_claims_two_gigabytes_takes_none(tmp_path: Path) -> None:
    path = tmp_path / "m.png"
    Image.fromarray(np.arange(30, dtype=np.uint16).reshape(5, 6)).save(path)
    content = path.read_bytes()
    at = content.index(b"IDAT") - 4
    path.write_bytes(content[:at] + b"\x80" + content[at + 1 :])
    notes = {"scale": 1.0, "offset": 0.0, "resolution": 0.1, "origin": [0.0, 0.0]}
    path.with_name(path.name + ".yaml").write_text(yaml.safe_dump(notes))
    tracemalloc.start()
    ElevationMap.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10**8
