"""Files that hold a point cloud: PLY, PCD, LAS and LAZ, XYZ text, and .npz.

Reads a path and gives a `Cloud`, in metres, which remembers what was left out. All fields but x, y,
z and what says that a point is none are passed over.
"""

import math
from pathlib import Path

import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, check_claim, cloud_of
from fgtutor.io.las import read_las
from fgtutor.io.pcd import read_pcd
from fgtutor.io.ply import read_ply
from fgtutor.io.reading import read_file, read_npz
from fgtutor.io.xyz import read_xyz


def read_cloud(path: str | Path) -> Cloud:
    """Return the points of a file, and what was left out of them or converted.

    Sensors and organised PCD files write NaN where no echo came back; such points are left out.

    Raises:
        CloudError: The file is missing, of another kind, corrupt, shorter or longer than it says,
            in degrees or an unknown unit, or holds no finite point.
    """
    return read_file(Path(path), _READERS, "point cloud", CloudError, "copy or export it again")


def _read_npz(path: Path) -> Cloud:
    size = path.stat().st_size

    def check(_name: str, shape: tuple[int, ...], kind: np.dtype) -> None:
        check_claim(math.prod(shape) * kind.itemsize, size)

    return cloud_of(read_npz(path, ["points"], check, CloudError, others=True)["points"])


_READERS = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": read_las,
    ".laz": read_las,
    ".xyz": read_xyz,
    ".npz": _read_npz,
}
