"""The fuzzer's elevation maps, what is done to their files, and what is right of them."""

import io
import itertools
import os
import random
import struct
import zipfile
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from fuzz_damage import (
    MARKER,
    RAW,
    damage_bytes,
    damage_members,
    damage_text,
    damage_tree,
    damage_zip,
    number,
    poke,
    zipped,
)
from fuzzing import Case, Target

HEIGHTS = np.linspace(-1, 2, 30, dtype=np.float32).reshape(6, 5)
HOLED = np.where(np.arange(30).reshape(6, 5) % 7, HEIGHTS, np.float32(np.nan))


class Payload:
    """Makes the marker's folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (MARKER,)


def use_map(folder: Path) -> None:
    from fgtutor.elevation import ElevationMap

    (path,) = [p for p in folder.glob("*") if p.suffix != ".yaml"] or [folder / "map.npz"]
    m = ElevationMap.load(path)
    assert m.heights.dtype == np.float32 and m.heights.ndim == 2 and min(m.shape) >= 2
    assert m.known.dtype == bool and m.known.shape == m.shape and m.known.any()
    assert np.isfinite(m.heights[m.known]).all() and not np.isinf(m.heights).any()
    assert 0 < m.resolution < np.inf and np.isfinite(m.extent).all() and repr(m)
    for cell in ((0, 0), (1, 1), (m.shape[0] - 1, m.shape[1] - 1)):
        assert m.cell_of(*m.centre_of(*cell)) == cell


# numpy's files ------------------------------------------------------------------------------------


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def claim(shape: str, descr: str = "'<f4'", order: str = "False") -> bytes:
    """Return a .npy file whose header says whatever it likes, before little data."""
    header = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(120)


@cache
def odd_arrays() -> list[bytes]:
    """Return .npy files of every kind that no map and no cloud is, or hardly."""
    g, whole = np.arange(30.0).reshape(6, 5), np.arange(30).reshape(6, 5)
    kinds = ("f2", ">f4", ">f8", "i1", "u8", "?", "c8", "c16", "U5", "S5", "g")
    arrays: list[Any] = [
        *(g.astype(kind) for kind in kinds),
        *(whole.astype("M8[s]"), whole.astype("m8[s]"), whole + 2**62, np.zeros((6, 5), "V8")),
        *(np.asfortranarray(g), g + np.nan, g + np.inf, g + 1e308, g + 1e38, g - 1e30, g > -1),
        *(g[0], g[None], g[:0], g[:1], g[:, :3], np.array([]), np.zeros(30, [("x", "f4")])),
        *map(np.array, (0.1, np.nan, 0, -1, 1e-300, [1e308, -1e308], [0.1, 0.2, 0.3], [[1, 2.0]])),
        *(np.array(["a", "b"]), np.full((40, 3), 1.7e308), np.array([Payload()], object)),
    ]
    shapes = "(-1,5) (6,-5) (20000,20000) (2147483648,2) (4,9999999999999999999) () (True,5)"
    shapes += " (6.5,5) ('a',) (6,5 [6,5] None (0,3) (130000000,3) (1000000000,3) (10**9,3)"
    kinds = ("'O'", "'<f99'", "'|V2147483647'", "[('a', '<f4')]", "'<U1000000000'", "None")
    return [
        *map(npy, arrays),
        *(claim(shape) for shape in (*shapes.split(), f"({'9' * 400}, 3)")),
        *(claim("(6, 5)", kind) for kind in (*kinds, f"__import__('os').mkdir('{MARKER}')")),
        *(claim("(6, 5)", order=order) for order in ("True", "None", "(" * 3000)),
    ]


def damage_npy(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Put an odd array in place of one, or damage its header or its numbers."""
    if rng.random() < 0.5:
        return rng.choice(odd_arrays())
    return rng.choice((damage_text, damage_bytes))(rng, data, other)


def bombed(others: dict[str, bytes], name: str, header: bytes, megabytes: int) -> bytes:
    """Return an archive in which a small member stands for so many megabytes, nearly all zeros."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
    # After a full flush nothing before is referred to, so the same bytes may stand there again.
    zeros = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    data = bytearray(zipped({**others, name: packed + zeros * megabytes + packer.flush()}))
    for signature, at in ((b"PK\3\4", 8), (b"PK\1\2", 10)):  # stored until now: say deflated
        block = data.rindex(signature)
        struct.pack_into("<H", data, block + at, zipfile.ZIP_DEFLATED)
        struct.pack_into("<I", data, block + at + 14, len(header) + megabytes * 2**20)
    return bytes(data)


def npz_maps() -> list[Case]:
    parts = {"known": ~np.isnan(HEIGHTS), "resolution": np.array(0.1), "origin": np.zeros(2)}
    others = {f"{name}.npy": npy(array) for name, array in parts.items()}
    whole = others | {"heights.npy": npy(HEIGHTS)}
    far = whole | {"origin.npy": npy(np.array([500000.35, 5648298.15]))}
    holed = whole | {"heights.npy": npy(HOLED), "known.npy": npy(~np.isnan(HOLED))}
    pickled = whole | {"heights.npy": npy(np.array([[Payload()] * 2] * 2, object))}
    bomb = bombed(others, "heights.npy", claim("(28000, 28000)")[:-120], 2991)
    files = [*(zipped(m, method) for m in (whole, far, holed, pickled) for method in (0, 8)), bomb]
    return [{"map.npz": file} for file in (*files, npy(HEIGHTS))]


# Pictures -----------------------------------------------------------------------------------------


def tiffs() -> list[Case]:
    import rasterio
    from rasterio.io import MemoryFile

    place = rasterio.Affine(0.5, 0, 500000, 0, -0.5, 4649776)
    plain = {"width": 5, "height": 6, "count": 1, "dtype": "float32", "transform": place}
    utm, made = "EPSG:32631", []
    for change in (
        {},
        {"compress": "deflate", "nodata": np.nan, "crs": utm},
        {"compress": "lzw", "dtype": "int16", "nodata": -1, "predictor": 2, "crs": utm},
        {"tiled": True, "blockxsize": 16, "blockysize": 16, "bigtiff": "YES"},
        {"dtype": "uint8", "count": 3, "photometric": "RGB", "compress": "jpeg"},
        {"dtype": "float64", "crs": "EPSG:2263", "endianness": "BIG"},
        {"crs": "EPSG:4326"},
        {"dtype": "complex64"},
        {"width": 60000, "height": 60000, "dtype": "uint8", "sparse_ok": True, "blockysize": 6000},
    ):
        with MemoryFile() as memory:
            with memory.open(driver="GTiff", **(plain | change)) as file:
                kind = file.dtypes[0]
                for band in range(1, file.count + 1 if file.width == 5 else 0):
                    heights = HEIGHTS * 50 if kind in ("int16", "uint8") else HOLED
                    file.write(np.abs(heights).astype(kind), band)
                if kind == "int16":
                    file.scales, file.offsets, file.units = (0.01,), (100.0,), ("cm",)
            made.append({"map.tif": bytes(memory.getbuffer())})
    return made


def damage_tiff(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Change tag, type, count or value of a directory entry."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    start = struct.unpack_from(f"{order}I", data.ljust(8), 4)[0] if order else len(data)
    if start + 2 > len(data):
        return damage_bytes(rng, data, other)
    entry = start + 2 + 12 * rng.randrange(max(struct.unpack_from(f"{order}H", data, start)[0], 1))
    if rng.random() < 0.3:  # another, but usual, value
        value = rng.choice((0, 1, 2, 3, 4, 5, 8, 16, 32, 64, 100, 32773, 34712, 50000))
        return data[: entry + 8] + struct.pack(f"{order}I", value) + data[entry + 12 :]
    offset, size = rng.choice(((0, 2), (2, 2), (4, 4), (8, 4), (8, 2), (8, 4)))
    return poke(rng, data, entry + offset, size)


def pngs() -> list[Case]:
    from PIL import Image

    grid = np.arange(30).reshape(5, 6)
    notes = {"scale": 0.001, "offset": -1.0, "resolution": 0.1, "origin": [0.0, 0.0]}
    sidecar = yaml.safe_dump(notes | {"unknown": 65535}).encode()
    made = []
    for image in (
        *(Image.fromarray(grid.astype(kind)) for kind in (np.uint16, np.uint8)),
        *(Image.new(mode, (6, 5)) for mode in ("1", "RGB", "P", "LA")),
        *(Image.new("L", (1, 1)), Image.fromarray(np.full((5, 6), 65535, np.uint16))),
    ):
        buffer = io.BytesIO()
        image.save(buffer, format="PNG")
        made.append({"map.png": buffer.getvalue(), "map.png.yaml": sidecar})
    wide = bytearray(made[0]["map.png"])
    struct.pack_into(">II", wide, 16, 20000, 20000)
    struct.pack_into(">I", wide, 29, zlib.crc32(wide[12:29]))
    laughs = "a: &a [x]\n" + "".join(
        f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in itertools.pairwise("abcdefghi")
    )
    laughing = made[0] | {"map.png.yaml": laughs.encode() + sidecar}
    return [*made, made[0] | {"map.png": bytes(wide)}, laughing]


_CHUNKS = b"IHDR PLTE IDAT tRNS gAMA iCCP zTXt iTXt eXIf pHYs acTL fdAT abcd IEND".split()


def damage_png(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Change a chunk and correct its checksum."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + length]])
        at += 12 + length
    if not chunks:
        return damage_bytes(rng, data, other)
    i = rng.randrange(len(chunks))
    kind, content = chunks[i]
    match rng.randrange(7):
        case 0:
            del chunks[i]
        case 1:
            chunks.insert(i, list(rng.choice(chunks)))
        case 2:
            chunks[i][0] = rng.choice(_CHUNKS)
        case 3 | 4 if kind == b"IHDR" and len(content) == 13:
            at, size = rng.choice(((0, 4), (4, 4), (8, 1), (9, 1), (10, 1), (11, 1), (12, 1)))
            small = bytes(size - 1) + bytes([rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 200))])
            value = rng.choice((small, number(rng, size)))
            chunks[i][1] = content[:at] + value + content[at + size :]
        case 3 if kind == b"IDAT":
            chunks[i][1] = zlib.compress(rng.randbytes(rng.choice((0, 10, 65, 66, 1000))))
        case _:
            chunks[i][1] = damage_bytes(rng, content, other)
    return data[:8] + b"".join(
        struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c))
        for kind, c in chunks
    )


_YAML_RAW = (
    *(raw for raw in RAW if len(raw) < 35_000),  # YAML reads a long list in seconds
    "[" * 18_000,
    *(f"!!python/object/apply:os.mkdir [{MARKER}]", "!!python/name:os.system", "*a", "&a [*a]"),
    *("!!binary aGVsbG8=", "!!set {a}", "2001-01-01", "0o17", "1:30:00", ".inf", ".nan", "~"),
    *("!!float x", "{? [a] : b}"),
)


def damage_yaml(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Damage the tree, unless it refers to its own parts, which may have no end."""
    if b"&" in data:
        return damage_text(rng, data, other)
    try:
        text = damage_tree(rng, data.decode(), _YAML_RAW, yaml.safe_load)
        return text.encode("utf-8", "surrogatepass")
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        return damage_text(rng, data, other)


NPZ = (damage_bytes, damage_zip, *[damage_members(damage_npy)] * 3)
_SIDECAR = (damage_yaml, damage_yaml, damage_text)
TARGETS = {
    "npz": Target(npz_maps, use_map, {".npz": NPZ}),
    "tif": Target(tiffs, use_map, {".tif": (damage_bytes, damage_tiff, damage_tiff)}),
    "png": Target(pngs, use_map, {".png": (damage_bytes, damage_png), ".yaml": _SIDECAR}),
}
