"""`fgtutor map`: a point cloud from a file becomes an elevation map in another.

Reads PLY, PCD, LAS, LAZ, XYZ or .npz; writes a map that `fgtutor plan` takes, and says what it
rests on.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from fgtutor.io.cloud import note
from fgtutor.io.clouds import read_cloud
from fgtutor.io.storage import check_writable
from fgtutor.world.scanning import Area, ScanConfig, map_points


@dataclass(frozen=True, kw_only=True)
class MapConfig(ScanConfig):
    """Turn a point cloud into an elevation map."""

    cloud: Annotated[Path, tyro.conf.Positional]
    """Point cloud in metres, z up: .ply, .pcd, .las, .laz, .xyz, or .npz with an array `points`."""
    out: Path = Path("map.npz")
    """Map to write: .npz, .tif, or .png (with a .yaml)."""
    area: Area | None = None
    """Map only x0 y0 x1 y1, m; default: all points."""
    fill: bool = False
    """Give unknown cells the nearest known height; they stay marked as unknown."""


def run(config: MapConfig) -> int:
    """Map a cloud from the command line."""
    check_writable(config.out)
    cloud = read_cloud(config.cloud)
    scanned = map_points(cloud, config=config, area=config.area)
    elevation = scanned.elevation
    # Written before anything is printed: a reader of the output that stops must not cost the map.
    (elevation.filled() if config.fill else elevation).save(config.out)
    print(f"{config.cloud}: {len(cloud.points)} points\n{scanned}")
    unknown = 1 - elevation.known.mean()
    median = np.median(scanned.count[elevation.known])
    print(f"{unknown:.1%} of the cells are unknown; the others hold {median:g} points (median)")
    print(f"map -> {config.out}")
    left_out = (
        *cloud.notes,
        *note(scanned.outside, "point", " outside the area"),
        *note(scanned.outliers, "outlier", " far from the others"),
        *note(
            scanned.overhanging, "point", f" hanging {config.clearance:g} m above others or more"
        ),
        *note(scanned.sparse, "point", f" in cells with fewer than {config.min_points}"),
    )
    print(f"left out or converted: {'; '.join(left_out) or 'nothing'}")
    return 0
