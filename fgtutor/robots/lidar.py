"""A simulated Livox MID-360 over a terrain: the point cloud that a scan from known poses gives.

Reads a `Terrain` and sensor poses (x, y, z, roll, pitch, yaw); gives points (x, y, z) in the
terrain's frame, as `scanning.map_points` takes them. Rays are cast by MuJoCo against the terrain's
boxes, and against the A1 if it carries the sensor. Constants: Livox Mid-360 User Manual v1.0 (2023)
and its specifications, "Livox" below.
"""

# MuJoCo's compiled modules carry no type information that pyright could read.
# pyright: reportAttributeAccessIssue=false

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from fgtutor.errors import CloudError, ConfigError
from fgtutor.io.cloud import Points
from fgtutor.io.validation import Ascending, NonNegative, Positive, check_arguments, check_fields
from fgtutor.robots.a1.ground import add_box
from fgtutor.robots.a1.looks import dress
from fgtutor.robots.a1.model import STANCE, STANCE_HEIGHT, build_spec
from fgtutor.world.boxes import boxes_from_elevation
from fgtutor.world.terrain import Terrain

MOST_RAYS = 10_000_000
"""Rays from one pose; each takes some 100 bytes."""
Latitude = Annotated[float, Interval(ge=-90, le=90)]
"""An angle against the horizontal, degrees."""
Noise = Annotated[float, Interval(ge=0, le=100)]
"""A standard deviation, m or degrees."""
Length = Annotated[float, Interval(ge=0.01, le=1000)]
"""A height or a distance of poses, m."""
Poses = Float[np.ndarray, "poses 6"]

SPIN, SWEEP = 397.21, 7.0711
"""Turns and up-down sweeps per second. Livox does not publish how its mirror moves; these draw some
40 lines per frame and have no common period: no frame is like another, and gaps close with time."""
MOUNT, MOUNT_ROLL = (0.28, 0.0, 0.1), math.pi
"""Where the A1 carries the sensor, from the trunk's centre, m and rad: ahead of the head, upside
down, so that its 52 degrees look at the ground. Our choice; the paper does not say."""


@dataclass(frozen=True, kw_only=True)
class LidarConfig:
    """What the sensor measures, how well, and what carries it."""

    point_rate: Annotated[float, Interval(gt=0, le=1e8)] = 200_000.0
    """Rays per second (Livox)."""
    seconds: Annotated[float, Interval(gt=0, le=3600)] = 0.1
    """How long the sensor looks from each pose, s; Livox's usual frame."""
    elevation: Annotated[tuple[Latitude, Latitude], Ascending] = (-7.0, 52.0)
    """Lowest and highest ray against the sensor's own horizon, degrees (Livox); all around it."""
    reach: Annotated[tuple[NonNegative, Positive], Ascending] = (0.1, 40.0)
    """Nearest and farthest echo, m (Livox; at 10 % reflectivity)."""
    range_noise: Noise = 0.02
    """Standard deviation of a distance, m (Livox; at 10 m)."""
    angle_noise: Noise = 0.15
    """Standard deviation of a ray's direction, degrees (Livox)."""
    position_noise: Noise = 0.01
    """Standard deviation of the error of each pose's position, m, as localisation leaves it."""
    attitude_noise: Noise = 0.2
    """Standard deviation of the error of each pose's roll, pitch and yaw, degrees."""
    carrier: Literal["none", "a1"] = "none"
    """Whether an A1 in its stance hangs on the sensor: it shades what is behind it, and the points
    on itself are removed."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not 1 <= self.rays <= MOST_RAYS:
            raise ConfigError(
                f"a point_rate and seconds of {self.point_rate:g} and {self.seconds:g} make "
                f"{self.rays} rays from each pose: choose them so that there are 1 to {MOST_RAYS}"
            )
        if self.elevation[0] == self.elevation[1] or self.reach[0] == self.reach[1]:
            raise ConfigError("the two ends of elevation and of reach should differ")

    @property
    def rays(self) -> int:
        """Rays cast from each pose."""
        return round(self.point_rate * self.seconds)


def pattern(
    times: Float[np.ndarray, " n"], config: LidarConfig | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return the direction of the ray at each time (s) in the sensor's frame, x ahead and z up."""
    low, high = np.radians((config or LidarConfig()).elevation)
    azimuth = 2 * np.pi * SPIN * times
    # A triangle wave: every elevation gets its share of the time.
    elevation = low + (high - low) * np.abs(2 * ((SWEEP * times) % 1.0) - 1)
    flat = np.cos(elevation)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)


def survey(
    terrain: Terrain, *, height: Length = 1.2, spacing: Length = 0.2, lines: Length = 2.0
) -> Poses:
    """Return poses on lines along x over the whole terrain, as if carried on a pole.

    The sensor hangs upside down, tilted by 40 degrees towards +x and -x in turn, so that it sees
    straight down: a narrow gap shows its ground only from above. `height` is above the highest
    ground, `spacing` along a line and `lines` between two of them, m.
    """
    check_arguments(survey, locals(), ConfigError)
    x0, y0, x1, y1 = terrain.elevation.extent
    top = float(np.nanmax(terrain.elevation.heights))
    along = max(math.ceil((x1 - x0) / spacing), 1)
    across = max(math.ceil((y1 - y0) / lines), 1)
    line, step = np.divmod(np.arange(along * across), along)
    # Every other line is shifted by half a step.
    x = x0 + (step + 0.25 + 0.5 * (line % 2)) * (x1 - x0) / along
    y = y0 + (line + 0.5) * (y1 - y0) / across
    z, roll, pitch = (np.full(len(x), value) for value in (top + height, np.pi, np.radians(40)))
    return np.column_stack((x, y, z, roll, pitch, np.pi * (step % 2)))


def carried(terrain: Terrain, spots: Float[np.ndarray, "poses 3"]) -> Poses:
    """Return the sensor's poses on an A1 that stands upright at each (x, y, yaw)."""
    x, y, yaw = np.asarray(spots, dtype=float).T
    z = terrain.elevation.filled().height_at(x, y) + STANCE_HEIGHT
    mount = Rotation.from_euler("z", yaw[:, None]).apply(MOUNT)
    place = np.column_stack((x, y, z)) + mount
    return np.column_stack((place, np.full(len(x), MOUNT_ROLL), np.zeros(len(x)), yaw))


def scan_terrain(
    terrain: Terrain,
    *,
    poses: Poses | None = None,
    seed: int = 0,
    config: LidarConfig | None = None,
) -> Points:
    """Scan a terrain from each pose in turn and return all points in the terrain's frame.

    The sensor stands exactly at `poses` (default: `survey(terrain)`), but its points are laid down
    as if it stood where localisation believes, which is off by the pose noise. Unknown cells of a
    terrain without boxes are filled before they are scanned.

    Raises:
        ConfigError: The poses are no finite [n, 6], or one of them is below the ground.
        CloudError: No ray came back.
    """
    config = config or LidarConfig()
    poses = _checked(survey(terrain) if poses is None else poses, terrain)
    scene = _Scene(terrain, config)
    rng = np.random.default_rng(seed)
    clouds = []
    for i, pose in enumerate(poses):
        rays = pattern((i + np.arange(config.rays) / config.rays) * config.seconds, config)
        true = Rotation.from_euler("xyz", pose[3:])
        # The mirror points a little beside where it says; to first order any small vector serves.
        jitter = math.radians(config.angle_noise) * rng.standard_normal(rays.shape)
        cast = rays + jitter
        cast /= np.linalg.norm(cast, axis=1, keepdims=True)
        distance, own = scene.cast(pose, true.apply(cast))
        distance += config.range_noise * rng.standard_normal(len(distance))
        tilt = Rotation.from_rotvec(math.radians(config.attitude_noise) * rng.standard_normal(3))
        place = pose[:3] + config.position_noise * rng.standard_normal(3)
        echo = ~own & (distance >= config.reach[0]) & (distance <= config.reach[1])
        clouds.append(place + (tilt * true).apply(distance[echo, None] * rays[echo]))
    points = np.concatenate(clouds)
    if not len(points):
        raise CloudError(
            f"none of {len(poses)} x {config.rays} rays came back: turn the sensor towards the "
            "terrain (upright it looks up; roll by pi), or move it nearer"
        )
    return points


def _checked(poses: Poses, terrain: Terrain) -> Poses:
    """Return the poses as an array; raise `ConfigError` if the sensor cannot stand at each."""
    poses = np.asarray(poses, dtype=float)
    if poses.ndim != 2 or poses.shape[1] != 6 or not len(poses) or not np.isfinite(poses).all():
        raise ConfigError(
            "poses must be finite numbers [n, 6] (x, y, z, roll, pitch, yaw; m, rad), got shape "
            f"{poses.shape}"
        )
    x0, y0, x1, y1 = terrain.elevation.extent
    x, y, z = poses.T[:3]
    over = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    under = np.flatnonzero(over & (z <= terrain.elevation.filled().height_at(x, y)))
    if len(under):
        raise ConfigError(
            f"pose {under[0]} at z = {z[under[0]]:g} m lies below the ground: raise the sensor"
        )
    return poses


class _Scene:
    """What rays meet: the terrain, and the A1 if it carries the sensor."""

    def __init__(self, terrain: Terrain, config: LidarConfig) -> None:
        boxes = terrain.boxes or boxes_from_elevation(terrain.elevation)
        self.carried, self.farthest = config.carrier == "a1", config.reach[1]
        if self.carried:
            spec = build_spec(boxes)
            dress(spec)
        else:
            spec = mujoco.MjSpec()
            for box in boxes:
                add_box(spec, box)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)

    def cast(
        self, pose: Float[np.ndarray, "6"], rays: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Return each ray's distance, inf without a hit, and whether it met the carrier."""
        if self.carried:
            trunk = Rotation.from_euler("xyz", pose[3:]) * Rotation.from_euler("x", -MOUNT_ROLL)
            self.data.qpos[:3] = pose[:3] - trunk.apply(MOUNT)
            self.data.qpos[3:7] = trunk.as_quat(scalar_first=True)
            self.data.qpos[7:] = STANCE
            mujoco.mj_kinematics(self.model, self.data)
        distance = np.empty(len(rays))
        geom = np.empty(len(rays), dtype=np.int32)
        mujoco.mj_multiRay(
            self.model,
            self.data,
            pose[:3],
            rays.ravel(),
            None,  # geoms of all groups
            True,  # those that never move, too
            -1,  # and no body left out
            geom,
            distance,
            None,  # normals are not needed
            len(rays),
            self.farthest,
        )
        hit = geom >= 0
        # Terrain belongs to the world, which is body 0.
        own = hit & (self.model.geom_bodyid[geom] != 0)
        return np.where(hit, distance, np.inf), own
