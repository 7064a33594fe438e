"""Files that hold a point cloud: PLY, PCD, LAS and LAZ, XYZ text, and .npz.

Reads a path and gives a `Cloud`, in metres, which remembers what was left out; writes .npz. All
fields but x, y, z and what says that a point is none are passed over.
"""

import io
import math
import zipfile
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, Points, check_claim, cloud_of
from fgtutor.io.las import read_las
from fgtutor.io.pcd import read_pcd
from fgtutor.io.ply import read_ply
from fgtutor.io.storage import atomic_write
from fgtutor.io.xyz import read_xyz


def read_cloud(path: str | Path) -> Cloud:
    """Return the points of a file, and what was left out of them or converted.

    Sensors and organised PCD files write NaN where no echo came back; such points are left out.

    Raises:
        CloudError: The file is missing, of another kind, corrupt, shorter or longer than it says,
            in degrees or an unknown unit, or holds no finite point.
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
        return reader(path)
    except CloudError as error:
        raise CloudError(f"{path}: {error}") from error
    except OSError as error:
        reason = error.strerror or error
        raise CloudError(f"cannot read {path}: {reason}; check the path and the disk") from error
    except Exception as error:  # libraries raise whatever they like on damaged files
        reason = f"{type(error).__name__}: {ascii(str(error))[1:-1][:200]}"
        raise CloudError(
            f"cannot read {path} as a {path.suffix} point cloud ({reason}); the file is corrupt or "
            "of another kind: copy or export it again"
        ) from error


def read_points(path: str | Path) -> Points:
    """Return the points of a file alone; raises `CloudError` as `read_cloud`."""
    return read_cloud(path).points


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
        np.savez_compressed(temporary, points=cloud_of(points).points)


def _read_npz(path: Path) -> Cloud:
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    # From memory, where a damaged archive cannot look like a disk that fails.
    data = path.read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        if "points.npy" not in file.namelist():
            found = ", ".join(name.removesuffix(".npy") for name in file.namelist())
            raise CloudError(f"expected an array named 'points', found {found[:100]!r}")
        # Before numpy takes memory for whatever the header says.
        size = file.getinfo("points.npy").file_size
        check_claim(size, len(data))
        with file.open("points.npy") as member:
            read = headers.get(npy.read_magic(member))
            if read is None:
                raise CloudError("the array's format is unknown: save it with numpy.savez")
            shape, fortran, kind = read(member)
            if kind.hasobject:
                raise CloudError("the points are pickled objects: save them as numbers")
            if math.prod(shape) * kind.itemsize != size - member.tell():
                raise CloudError(f"an array of shape {shape} is promised, it was cut off")
            points = np.frombuffer(member.read(), kind)
    return cloud_of(points.reshape(shape, order="F" if fortran else "C"))


_READERS = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": read_las,
    ".laz": read_las,
    ".xyz": read_xyz,
    ".npz": _read_npz,
}
