"""The simulated MID-360: its pattern, its noise, what it cannot see, and the maps it gives."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from fgtutor.cli import map
from fgtutor.elevation import ElevationMap
from fgtutor.errors import CloudError, ConfigError
from fgtutor.robots.a1.model import STANCE_HEIGHT, TRUNK_SIZE
from fgtutor.robots.lidar import LidarConfig, carried, pattern, scan_terrain, survey
from fgtutor.world.boxes import Box
from fgtutor.world.scanning import ScanConfig, map_points
from fgtutor.world.terrain import Terrain, make_terrain

SILENT = {"range_noise": 0.0, "angle_noise": 0.0, "position_noise": 0.0, "attitude_noise": 0.0}
ABOVE = np.array([[4.0, 2.0, 1.5, np.pi, 0.0, 0.0]])
"""Upside down over the middle of a terrain."""


def quick(**fields: object) -> LidarConfig:
    return LidarConfig(**{"seconds": 0.02, **fields})  # pyright: ignore[reportArgumentType]


def level(height: float = 0.0) -> Terrain:
    box = Box(centre=(4.0, 2.0, height - 0.5), size=(8.0, 4.0, 1.0))
    elevation = ElevationMap(np.full((80, 40), height), resolution=0.1)
    return Terrain("flat", "a1", 1.0, 0, elevation, (box,), (1.0, 2.0), (7.0, 2.0))


def away_from_edges(heights: np.ndarray) -> np.ndarray:
    """Tell which cells have no kink of more than 2 cm in them or beside them."""
    kink = np.zeros(heights.shape, dtype=bool)
    for axis in (0, 1):
        bend = ndimage.correlate1d(heights.astype(float), [1, -2, 1], axis=axis, mode="nearest")
        kink |= np.abs(bend) > 0.02
    return ~ndimage.binary_dilation(kink, np.ones((3, 3)))


# -- the pattern -----------------------------------------------------------------------------------


def test_the_pattern_fills_its_field_of_view_evenly() -> None:
    rays = pattern(np.arange(200_000) / 200_000)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    elevation = np.degrees(np.arcsin(rays[:, 2]))
    assert -7 <= elevation.min() < -6.9 and 51.9 < elevation.max() < 52 + 1e-9
    # A fifth of the angle gets a fifth of the rays, and so does every eighth of the circle.
    assert np.mean(elevation < -7 + 59 / 5) == pytest.approx(0.2, abs=0.01)
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    shares = np.histogram(azimuth, bins=8, range=(-np.pi, np.pi))[0] / len(rays)
    np.testing.assert_allclose(shares, 1 / 8, atol=0.01)


def test_the_pattern_does_not_repeat_and_covers_more_the_longer_it_looks() -> None:
    def covered(frames: int) -> float:
        rays = pattern(np.arange(20_000 * frames) / 200_000)
        azimuth = np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) % 360
        elevation = np.degrees(np.arcsin(rays[:, 2])) + 7
        bins = azimuth.astype(int) * 60 + elevation.astype(int)
        return len(np.unique(bins)) / (360 * 59)

    shares = [covered(frames) for frames in (1, 2, 4, 8)]
    # As many rays as degrees; one frame drawn at random would hit 1 - 1/e of these, or 63 %.
    assert 0.5 < shares[0] < shares[1] < shares[2] < shares[3] and shares[3] > 0.99
    first, second = (pattern((i + np.arange(2_000) / 20_000) / 10) for i in (0, 1))
    assert (np.linalg.norm(first - second, axis=1) > 1e-3).mean() > 0.99


# -- points and noise ------------------------------------------------------------------------------


def test_without_noise_every_point_lies_on_the_terrain() -> None:
    terrain = make_terrain("valley", robot="a1", seed=3)
    points = scan_terrain(terrain, config=quick(**SILENT), poses=survey(terrain, spacing=0.8))
    # On the slope itself, away from its kinks, the height is that of the tilted box.
    cells = tuple(np.floor(points[:, :2].T / 0.05).astype(int))
    x0, y0, x1, y1 = terrain.elevation.extent
    assert (points[:, :2] >= (x0 - 1e-6, y0 - 1e-6)).all()
    assert (points[:, :2] <= (x1 + 1e-6, y1 + 1e-6)).all()
    inside = ((points[:, :2] > 0.05) & (points[:, :2] < (x1 - 0.05, y1 - 0.05))).all(axis=1)
    smooth = np.zeros(len(points), dtype=bool)
    smooth[inside] = away_from_edges(terrain.elevation.heights)[tuple(c[inside] for c in cells)]
    assert smooth.mean() > 0.5
    truth = terrain.elevation.height_at(points[smooth, 0], points[smooth, 1])
    np.testing.assert_allclose(points[smooth, 2], truth, atol=1e-5)


def test_rays_reach_the_ground_where_geometry_says() -> None:
    # Upside down at 1.5 m: the steepest ray, 52 degrees down, meets the ground 1.17 m away.
    points = scan_terrain(level(), poses=ABOVE, config=quick(**SILENT))
    away = np.hypot(*(points[:, :2] - (4.0, 2.0)).T)
    assert away.min() == pytest.approx(1.5 / np.tan(np.radians(52)), abs=0.01)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-9)


def test_a_tilted_sensor_looks_the_way_it_is_turned() -> None:
    # Facing -x, nose down by 40 degrees: ahead it sees from straight down (52 + 40 degrees) to 33
    # degrees down (40 - 7), behind nothing lower than 12 degrees down (52 - 40).
    pose = np.array([[4.0, 2.0, 0.5, np.pi, np.radians(40), np.pi]])
    x, y, _ = scan_terrain(level(), poses=pose, config=quick(seconds=0.1, **SILENT)).T
    ahead = (4.0 - x)[np.abs(y - 2) < 0.05]
    assert np.abs(ahead).min() < 0.02
    assert ahead.max() == pytest.approx(0.5 / np.tan(np.radians(33)), abs=0.05)
    assert 0.5 / np.tan(np.radians(12)) < -ahead[ahead < -0.1].max() < 0.5 / np.tan(np.radians(9))


def test_range_noise_goes_along_the_ray() -> None:
    still = scan_terrain(level(), poses=ABOVE, config=quick(**SILENT))
    noisy = scan_terrain(level(), poses=ABOVE, config=quick(**SILENT | {"range_noise": 0.02}))
    step = noisy - still
    ray = still - ABOVE[0, :3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = (step * ray).sum(axis=1)
    assert along.std() == pytest.approx(0.02, rel=0.1) and abs(along.mean()) < 0.002
    np.testing.assert_allclose(step, along[:, None] * ray, atol=1e-9)


def test_pose_noise_moves_each_frame_as_one_piece() -> None:
    poses = np.repeat(ABOVE, 30, axis=0)
    noise = {"position_noise": 0.05, "attitude_noise": 0.5}
    means, tilts = [], []
    for seed in range(30):
        config = quick(seconds=0.005, **SILENT | noise)
        x, y, z = scan_terrain(level(), poses=poses[:1], seed=seed, config=config).T
        # A rigid motion of flat ground is a plane.
        plane, residual, *_ = np.linalg.lstsq(np.stack((x - 4, y - 2, x**0), -1), z)
        assert residual / len(z) < 1e-12
        means.append(plane[2])
        tilts += list(np.degrees(np.arctan(plane[:2])))
    assert np.std(means) == pytest.approx(0.05, rel=0.4)
    assert np.std(tilts) == pytest.approx(0.5, rel=0.4)


def test_angle_noise_grows_with_the_distance() -> None:
    points = scan_terrain(level(), poses=ABOVE, config=quick(**SILENT | {"angle_noise": 0.15}))
    away = np.linalg.norm(points - ABOVE[0, :3], axis=1)
    depression = np.arcsin(1.5 / away)
    # Turned by e about a horizontal axis, a ray that meets the ground at a distance r is off by
    # r e cot(depression) in range, and so its point by r e cos(depression) in height.
    expected = away * np.radians(0.15) * np.cos(depression)
    assert (points[:, 2] / expected).std() == pytest.approx(1.0, rel=0.1)


def test_the_seed_decides_the_cloud() -> None:
    terrain, poses = level(), np.repeat(ABOVE, 2, axis=0)
    first, again = (scan_terrain(terrain, poses=poses, seed=4, config=quick()) for _ in range(2))
    other = scan_terrain(terrain, poses=poses, seed=5, config=quick())
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or np.abs(first - other).max() > 1e-3


# -- the carrier -----------------------------------------------------------------------------------


def test_the_robot_shades_the_ground_but_is_not_in_the_cloud() -> None:
    poses = carried(level(), np.array([(4.0, 2.0, np.pi / 2)]))
    # Upright, facing +y: the sensor is 0.28 m ahead of the trunk and 0.1 m above its centre.
    np.testing.assert_allclose(poses[0, :3], (4.0, 2.28, STANCE_HEIGHT + 0.1), atol=1e-12)
    free = scan_terrain(level(), poses=poses, config=quick(**SILENT))
    shaded = scan_terrain(level(), poses=poses, config=quick(**SILENT, carrier="a1"))
    np.testing.assert_allclose(shaded[:, 2], 0, atol=1e-9)  # nothing but ground
    seen = {tuple(point) for point in free.round(6)}
    assert {tuple(point) for point in shaded.round(6)} < seen
    # What is missing lies behind the sensor, in the sector that the trunk takes.
    lost = np.array(list(seen - {tuple(point) for point in shaded.round(6)}))
    bearing = np.degrees(np.arctan2(lost[:, 0] - 4.0, -(lost[:, 1] - 2.28)))
    assert len(lost) > 50 and np.abs(bearing).max() < 90
    straight = (np.abs(free[:, 0] - 4.0) < TRUNK_SIZE[1] / 4) & (free[:, 1] < 1.8)
    assert straight.any()
    assert not ((np.abs(shaded[:, 0] - 4.0) < TRUNK_SIZE[1] / 4) & (shaded[:, 1] < 1.8)).any()


# -- maps ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "name"),
    [
        *(("a1", name) for name in ("flat", "steps", "gaps", "bridge", "valley", "rubble")),
        *(("toy", name) for name in ("steps", "slopes")),
    ],
)
def test_a_scan_gives_the_terrain_back(robot: str, name: str) -> None:
    terrain = make_terrain(name, robot=robot, seed=3)
    truth = terrain.elevation
    points = scan_terrain(terrain, poses=survey(terrain, spacing=0.4), seed=1)
    scanned = map_points(
        points, config=ScanConfig(resolution=truth.resolution), area=truth.extent
    ).elevation
    assert scanned.shape == truth.shape and scanned.origin == truth.origin
    assert scanned.known.mean() > 0.95
    smooth = away_from_edges(truth.heights) & scanned.known
    error = np.abs(scanned.heights - truth.heights)[smooth]
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.05


def test_a_gap_stays_a_gap_of_its_width() -> None:
    terrain = make_terrain("gaps", robot="toy", seed=3)
    truth = terrain.elevation
    config = ScanConfig(resolution=truth.resolution)
    points = scan_terrain(terrain, poses=survey(terrain, spacing=0.4), seed=1)
    scanned = map_points(points, config=config, area=truth.extent)
    gap = truth.heights < -0.3
    low = scanned.elevation.filled().heights < -0.1
    assert gap.any()
    assert low.sum() == pytest.approx(gap.sum(), rel=0.05)
    assert (low & gap).sum() > 0.95 * gap.sum()


@pytest.mark.parametrize("name", ["gaps", "bridge"])
def test_beside_a_chasm_the_edge_keeps_its_height_and_the_floor_its_depth(name: str) -> None:
    terrain = make_terrain(name, robot="a1", seed=3)
    truth = terrain.elevation
    config = ScanConfig(resolution=truth.resolution)
    points = scan_terrain(terrain, poses=survey(terrain, spacing=0.2), seed=1)
    scanned = map_points(points, config=config, area=truth.extent).elevation
    error = np.abs(scanned.heights - truth.heights)
    lowest, highest = (
        f(truth.heights, 3) for f in (ndimage.minimum_filter, ndimage.maximum_filter)
    )
    beside = scanned.known & (highest - lowest > 0.3)
    floor = beside & (truth.heights < -0.3)
    assert min(floor.sum(), (beside & ~floor).sum()) > 100
    assert (error[beside & ~floor] < 0.03).mean() > 0.95
    assert (error[floor] < 0.1).mean() > 0.9


def test_what_lies_in_the_shadow_of_a_wall_stays_unknown() -> None:
    heights = np.zeros((60, 40))
    heights[30:33] = 0.6
    elevation = ElevationMap(heights, resolution=0.1)
    terrain = Terrain.from_elevation(elevation, (1.0, 2.0), (5.0, 2.0))  # has no boxes of its own
    pose = np.array([[2.0, 2.0, 1.0, np.pi, 0.0, 0.0]])
    points = scan_terrain(terrain, poses=pose, config=LidarConfig(seconds=0.2))
    scanned = map_points(points, config=ScanConfig(resolution=0.1), area=elevation.extent).elevation
    # Seen from 1 m high and 1.3 m before its far edge, a wall of 0.6 m hides the next 1.95 m.
    assert scanned.known[30:33, 20].all()
    assert not scanned.known[34:52, 15:25].any()
    assert scanned.known[54:58, 15:25].mean() > 0.2
    assert not scanned.filled().known[34:52, 15:25].any()


def test_a_cloud_goes_through_the_map_command(tmp_path: Path) -> None:
    terrain = make_terrain("steps", robot="toy", seed=1)
    np.savez_compressed(tmp_path / "cloud.npz", points=scan_terrain(terrain, config=quick()))
    out = tmp_path / "map.npz"
    config = map.MapConfig(
        cloud=tmp_path / "cloud.npz", out=out, resolution=0.1, area=terrain.elevation.extent
    )
    assert map.run(config) == 0
    scanned = ElevationMap.load(out)
    error = np.abs(scanned.heights - terrain.elevation.heights)
    assert np.nanmedian(error) < 0.02


# -- errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields",
    [
        {"point_rate": 0.0},
        {"seconds": 0.0},
        {"seconds": 1e-6},
        {"elevation": (52.0, -7.0)},
        {"elevation": (-7.0, 120.0)},
        {"reach": (5.0, 1.0)},
        {"range_noise": -0.1},
        {"attitude_noise": float("nan")},
    ],
)
def test_sensors_that_cannot_be_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(fields)).split("_")[-1]):
        LidarConfig(**fields)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((0, 6)), r"\(0, 6\)"),
        (np.zeros((2, 3)), r"\(2, 3\)"),
        (np.full((1, 6), np.nan), "finite"),
        ([[4.0, 2.0, 1.0, 0, 0, 0], [4.0, 2.0, -0.1, 0, 0, 0]], r"pose 1 .* below the ground"),
    ],
)
def test_poses_that_cannot_be_are_refused(poses: np.ndarray, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scan_terrain(level(), poses=poses, config=quick())


def test_a_sensor_that_looks_at_the_sky_is_told_so() -> None:
    upright = ABOVE * (1, 1, 20, 0, 0, 0)
    with pytest.raises(CloudError, match="roll by pi"):
        scan_terrain(level(), poses=upright, config=quick())
