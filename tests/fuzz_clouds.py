"""The fuzzer's point clouds, what is done to their files, and what is right of them."""

import io
import random
import struct
from pathlib import Path

import numpy as np
from fuzz_damage import damage_bytes, damage_text, poke, zipped
from fuzz_maps import NPZ, Payload, bombed, claim, npy
from fuzzing import Case, Target

POINTS = np.random.default_rng(0).random((40, 3)) * (2.0, 1.5, 0.3)


def use_cloud(folder: Path) -> None:
    from fgtutor.io.clouds import read_cloud
    from fgtutor.world.scanning import map_points

    (path,) = list(folder.glob("*")) or [folder / "cloud.ply"]
    points = read_cloud(path).points
    assert points.dtype == np.float64 and points.ndim == 2 and points.shape[1] == 3 and len(points)
    assert np.isfinite(points).all()
    assert map_points(points).count.sum() <= len(points)


def damage_header(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Damage the text before the numbers."""
    ends = [at for mark in (b"end_header", b"DATA") if (at := data.find(mark)) > 0]
    end = min(ends, default=len(data))
    return damage_text(rng, data[:end], other) + data[end:]


def plys() -> list[Case]:
    names = {"<f4": "float", ">f4": "float", "<f8": "double", "u1": "uchar"}
    rich = [*((axis, "<f8") for axis in "xyz"), ("red", "u1"), ("intensity", "<f4")]
    made = []
    for fields, form in (
        ([(axis, "<f4") for axis in "xyz"], "binary_little_endian"),
        ([(axis, ">f4") for axis in "xyz"], "binary_big_endian"),
        (rich, "binary_little_endian"),
        ([(axis, "<f8") for axis in "xyz"], "ascii"),
    ):
        vertices = np.zeros(len(POINTS), fields)
        for axis, values in zip("xyz", POINTS.T, strict=True):
            vertices[axis] = values
        body, faces = vertices.tobytes(), struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
        if form == "ascii":
            body = "".join(" ".join(map(str, row)) + "\n" for row in vertices.tolist()).encode()
            faces = b"3 0 1 2\n4 0 1 2 3\n"
        head = f"ply\nformat {form} 1.0\ncomment TextureFile /etc/passwd\nelement vertex 40\n"
        head += "".join(f"property {names[kind]} {name}\n" for name, kind in fields)
        made.append(f"{head}end_header\n".encode() + body)
        head += "element face 2\nproperty list uchar int vertex_indices\n"
        made.append(f"{head}end_header\n".encode() + body + faces)
    return [{"cloud.ply": file} for file in made]


def pcds() -> list[Case]:
    table = POINTS.astype("<f4")
    rows = np.zeros(40, [("p", "<f8", 3), ("rgb", "<u4"), ("n", "<i2", 3)])
    rows["p"] = POINTS
    text = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    planes = table.T.tobytes()
    # LZF with nothing but literal runs of up to 32 bytes.
    runs = [planes[at : at + 32] for at in range(0, len(planes), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    packed = struct.pack("<II", len(packed), len(planes)) + packed
    plain, rich = ("x y z", "4 4 4", "F F F"), ("x y z rgb n", "8 8 8 4 2", "F F F U I")
    made = []
    for version, (fields, sizes, types), counts, data, body in (
        ("0.7", plain, "1 1 1", "ascii", text),
        ("0.7", plain, "1 1 1", "binary", table.tobytes()),
        ("0.7", plain, "1 1 1", "binary_compressed", packed),
        (".7", rich, "1 1 1 1 3", "binary", rows.tobytes()),
        (".5", plain, "1 1 1", "ascii", text.replace(b"0.", b"nan 0.", 1)),
        ("0.7", plain, "1 1 1000000000", "binary", table.tobytes()),
    ):
        head = f"# .PCD\nVERSION {version}\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        head += f"COUNT {counts}\nWIDTH 40\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\n"
        made.append({"cloud.pcd": f"{head}DATA {data}\n".encode() + body})
    return made


def las(suffix: str) -> list[Case]:
    import laspy
    from laspy.vlrs.vlr import VLR
    from laspy.vlrs.vlrlist import VLRList

    feet = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 2263, 3076, 0, 1, 9003)
    made = []
    for form, version in ((0, "1.2"), (3, "1.2"), (6, "1.4"), (7, "1.4")):
        header = laspy.LasHeader(point_format=form, version=version)
        header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
        if form in (0, 7):
            header.vlrs.append(VLR("LASF_Projection", 34735, "", feet))
            header.vlrs.append(VLR("LASF_Projection", 34737, "", b"NAD83 / New York|"))
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = POINTS.T
        cloud.classification = np.r_[np.full(35, 2), np.full(5, 7)].astype("u1")
        if form == 6:
            cloud.evlrs = VLRList([VLR("LASF_Spec", 7, "x", b"abc")])
        buffer = io.BytesIO()
        cloud.write(buffer, do_compress=suffix == ".laz")
        made.append({f"cloud{suffix}": buffer.getvalue()})
    lying = bytearray(made[-1][f"cloud{suffix}"])
    struct.pack_into("<Q", lying, 247, 150_000_000)
    return [*made, {f"cloud{suffix}": bytes(lying)}]


_LAS_FIELDS = (
    *((6, 2), (24, 1), (25, 1), (94, 2), (96, 4), (100, 4), (104, 1), (105, 2), (107, 4), (111, 4)),
    *((131 + 8 * k, 8) for k in range(12)),
    *((227, 8), (235, 8), (243, 4), (247, 8), (255, 8)),
)
_RECORD_FIELDS = ((18, 2), (20, 2), (54, 2), (56, 2), (58, 2), (60, 2), (62, 2), (66, 4))


def damage_las(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Change a field of the header, or one of a record that follows it."""
    if rng.random() < 0.7:
        return poke(rng, data, *rng.choice(_LAS_FIELDS))
    at, size = rng.choice(_RECORD_FIELDS)
    return poke(rng, data, int.from_bytes(data[94:96], "little") + at, size)


def xyzs() -> list[Case]:
    rows = [" ".join(f"{v:.3f}" for v in row) for row in POINTS]
    forms = (
        "\n".join(rows) + "\n",
        "# a comment\nx y z\n" + "\n".join(rows),
        "red,x,y,z\n" + "\n".join("7," + row.replace(" ", ",") for row in rows),
        "\ufeffx;y;z\n" + "\n".join(row.replace(" ", ";").replace(".", ",") for row in rows),
        "40\n" + "\n".join(row + " 12 nan" for row in rows),
        "//X Y Z Intensity\r\n" + "\r\n".join(row + " 7" for row in rows),
    )
    return [{"cloud.xyz": form.encode()} for form in forms]


def npz_clouds() -> list[Case]:
    forms = (POINTS, POINTS.astype("f4"), np.asfortranarray(POINTS))
    pickled = np.array([[Payload()] * 3] * 4, object)
    bomb = bombed({}, "points.npy", claim("(130000000, 3)", "'<f8'")[:-120], 2976)
    files = [*(zipped({"points.npy": npy(form)}, 8) for form in (*forms, pickled)), bomb]
    return [{"cloud.npz": file} for file in files]


_HEADED = (damage_bytes, damage_text, damage_header)
_LAS = (damage_bytes, damage_las)
TARGETS = {
    "ply": Target(plys, use_cloud, {".ply": _HEADED}),
    "pcd": Target(pcds, use_cloud, {".pcd": _HEADED}),
    "las": Target(lambda: las(".las"), use_cloud, {".las": _LAS}),
    "laz": Target(lambda: las(".laz"), use_cloud, {".laz": _LAS}),
    "xyz": Target(xyzs, use_cloud, {".xyz": (damage_bytes, damage_text)}),
    "cloud": Target(npz_clouds, use_cloud, {".npz": NPZ}),
}
