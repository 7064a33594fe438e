"""Files that hold a point cloud: PLY, PCD, LAS and LAZ, XYZ text, and .npz.

Reads a path and gives points (x, y, z) in metres, one a row; writes .npz. The formats are read by
the libraries that know them: trimesh (PLY), pypcd4 (PCD), laspy with lazrs (LAS and LAZ, ASPRS LAS
1.4) and numpy (XYZ: three columns and whatever follows). All fields but x, y, z are left out.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fgtutor.errors import CloudError
from fgtutor.storage import atomic_write

Points = Float[np.ndarray, "n 3"]


def read_points(path: str | Path) -> Points:
    """Return the finite points of a file as float64.

    Sensors and organised PCD files write NaN where no echo came back; such points are left out.

    Raises:
        CloudError: The file is missing, of another kind, corrupt, shorter than it says, or holds
            no finite point.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise CloudError(
            f"{path} has the suffix {path.suffix!r}; point clouds are {', '.join(_READERS)} files"
        )
    if not path.is_file():
        raise CloudError(f"there is no point cloud {path}: check the path")
    try:
        points = finite(reader(path))
    except CloudError as error:
        raise CloudError(f"{path}: {error}") from error
    except Exception as error:  # four libraries raise whatever they like on damaged files
        raise CloudError(
            f"cannot read {path} as a {path.suffix} point cloud ({type(error).__name__}: {error}); "
            "the file is corrupt or of another kind: copy or export it again"
        ) from error
    return points


def save_points(points: Points, path: str | Path) -> None:
    """Write points to a .npz file that `read_points` reads, whole or not at all.

    Raises:
        CloudError: The suffix is not .npz, or these are no points.
        StorageError: The system refused to write; nothing partial is left.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise CloudError(f"points are saved as .npz, got {path}: change the suffix")
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, points=finite(points))


def finite(points: object) -> Points:
    """Return the rows without NaN or infinity as float64.

    Raises:
        CloudError: These are not points [n, 3], or no row is finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"points must have shape [n, 3] (x, y, z in metres), got {points.shape}")
    whole = np.isfinite(points).all(axis=1)
    if not whole.any():
        raise CloudError(f"none of the {len(points)} points is finite: scan or export again")
    return points if whole.all() else points[whole]


def _read_npz(path: Path) -> np.ndarray:
    # Opened here, because np.load leaves a file open that turns out not to be an archive.
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        if "points" not in file:
            raise CloudError(f"expected an array named 'points', found {', '.join(file)}")
        return file["points"]


def _read_ply(path: Path) -> np.ndarray:
    import trimesh

    # As they are: by default trimesh merges equal vertices of a mesh and splits textured ones.
    loaded = trimesh.load(
        path, file_type="ply", process=False, fix_texture=False, skip_materials=True
    )
    points = np.asarray(loaded.vertices)  # pyright: ignore[reportAttributeAccessIssue]
    # trimesh takes a text file that ends early and gives what there is; so does pypcd4 below.
    with path.open("rb") as file:
        promised = next(line for line in file if line.startswith(b"element vertex"))
    _check_count(len(points), int(promised.split()[2]))
    return points


def _read_pcd(path: Path) -> np.ndarray:
    from pypcd4.pypcd4 import PointCloud

    cloud = PointCloud.from_path(path)
    missing = {"x", "y", "z"} - set(cloud.fields)
    if missing:
        raise CloudError(f"the fields are {cloud.fields}, without {', '.join(sorted(missing))}")
    _check_count(len(cloud.pc_data), cloud.points)
    return np.stack([cloud.pc_data[axis] for axis in "xyz"], axis=-1, dtype=np.float64)


def _read_las(path: Path) -> np.ndarray:
    # On some damaged files lazrs ends the process that it runs in, so it gets one of its own.
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "points.npy"
        command = [sys.executable, "-m", "fgtutor.cloudfiles", str(path), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.splitlines() or [""])[-1] if done.returncode > 0 else "it crashed"
            raise CloudError(
                f"laspy could not read it ({last}); the file is corrupt or of another kind: copy "
                "or export it again"
            )
        return np.load(out)


def _las_points(path: Path) -> np.ndarray:
    import laspy

    # laspy reads as many records as the header says, if it takes a day. Their number stands at
    # byte 100, and each has a header of 54 bytes (LAS 1.4, tables 3 and 6).
    with path.open("rb") as file:
        records = int.from_bytes(file.read(104)[100:], "little")
    if 54 * records > path.stat().st_size:
        raise CloudError(f"the header promises {records} records, which do not fit into the file")
    with laspy.open(path, read_evlrs=False) as file:  # pyright: ignore[reportCallIssue]
        points = file.read().xyz
        _check_count(len(points), file.header.point_count)
    return points


def _check_count(found: int, promised: int) -> None:
    if found != promised:
        raise CloudError(
            f"the header promises {promised} points and {found} are there: the file was cut off, "
            "copy it again"
        )


def _read_xyz(path: Path) -> np.ndarray:
    skip, first = 0, ""
    with path.open(encoding="utf-8") as file:
        # Programs differ in what they put first: comments (# or //), the names of the columns.
        for line in file:
            first = line.strip()
            if first and not first.startswith(("#", "//")) and not set("xyzXYZ") & set(first):
                break
            skip, first = skip + 1, ""
    if not first:
        raise CloudError("the file holds no line of numbers; expected x y z in metres")
    separator = next((mark for mark in ",;" if mark in first), None)
    return np.loadtxt(
        path, usecols=(0, 1, 2), delimiter=separator, skiprows=skip, ndmin=2, encoding="utf-8"
    )


_READERS = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
    ".xyz": _read_xyz,
    ".npz": _read_npz,
}

if __name__ == "__main__":
    try:
        np.save(sys.argv[2], _las_points(Path(sys.argv[1])))
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
