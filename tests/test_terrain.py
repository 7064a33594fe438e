"""Terrains: the map is what the boxes look like from above, and every draw is what it says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtutor.elevation import ElevationMap
from fgtutor.errors import OffMapError, TerrainError
from fgtutor.patches import PatchGrid, prepare, sample_patches
from fgtutor.robots import ROBOTS
from fgtutor.world.boxes import Box, boxes_from_elevation, rasterise
from fgtutor.world.terrain import TERRAINS, Terrain, World, make_terrain

OBSTACLES = tuple(name for name in TERRAINS if name not in ("flat", "mixed"))
angles = st.floats(-1.2, 1.2)
lengths = st.floats(0.2, 1.5)


def height_by_search(boxes: tuple[Box, ...], x: float, y: float) -> float:
    """Return the highest z, on a fine ladder, whose point lies in some box: the naive oracle."""
    z = np.linspace(-2.0, 2.0, 4001)
    points = np.stack((np.full_like(z, x), np.full_like(z, y), z), axis=-1)
    inside = np.zeros(len(z), dtype=bool)
    for box in boxes:
        local = (points - box.centre) @ box.rotation  # R^T (p - c), one point a row
        inside |= (np.abs(local) <= 0.5 * np.array(box.size)).all(axis=1)
    return float(z[inside].max()) if inside.any() else math.nan


# -- boxes -----------------------------------------------------------------------------------------


def test_rpy_turns_about_x_then_y_then_z() -> None:
    turned = Box(centre=(0, 0, 0), size=(1, 1, 1), rpy=(0.0, 0.0, math.pi / 2)).rotation
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    lowered = Box(centre=(0, 0, 0), size=(1, 1, 1), rpy=(0.0, math.pi / 6, 0.0)).rotation
    assert (lowered @ [1, 0, 0])[2] == pytest.approx(-0.5)  # a positive pitch lowers the front
    raised = Box(centre=(0, 0, 0), size=(1, 1, 1), rpy=(math.pi / 6, 0.0, 0.0)).rotation
    assert (raised @ [0, 1, 0])[2] == pytest.approx(0.5)  # a positive roll raises the left


@given(st.tuples(angles, angles, angles))
def test_quaternion_is_the_same_rotation(rpy: tuple[float, float, float]) -> None:
    box = Box(centre=(0, 0, 0), size=(1, 1, 1), rpy=rpy)
    w, *v = box.quaternion
    vector = np.array([0.3, -0.5, 0.8])
    turned = vector + 2 * np.cross(v, np.cross(v, vector) + w * vector)
    np.testing.assert_allclose(turned, box.rotation @ vector, atol=1e-9)


@given(
    st.tuples(st.floats(0, 2), st.floats(0, 2), st.floats(-0.5, 0.5)),
    st.tuples(lengths, lengths, lengths),
    st.tuples(angles, angles, angles),
)
@settings(max_examples=30)
def test_rasterise_a_tilted_box_against_the_search(
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    rpy: tuple[float, float, float],
) -> None:
    boxes = (
        Box(centre=(1, 1, -2), size=(2, 2, 0.1)),
        Box(centre=centre, size=size, rpy=rpy),
    )
    elevation = rasterise(boxes, (2.0, 2.0), 0.5)
    for ix, iy in np.ndindex(elevation.shape):
        expected = height_by_search(boxes, *elevation.centre_of(ix, iy))
        height = elevation.heights[ix, iy]
        # A corner thinner than a rung of the ladder is the one thing the search may miss.
        close = abs(height - expected) < 2e-3
        assert close or _is_thin(boxes[1], *elevation.centre_of(ix, iy))


def _is_thin(box: Box, x: float, y: float) -> bool:
    """Return whether a hair's breadth decides if the box is hit at all."""
    grown = replace(box, size=tuple(s + 0.01 for s in box.size))
    shrunk = replace(box, size=tuple(s - 0.01 for s in box.size))
    return math.isnan(height_by_search((shrunk,), x, y)) != math.isnan(
        height_by_search((grown,), x, y)
    )


@pytest.mark.slow
@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("name", TERRAINS)
def test_terrain_maps_against_the_search(name: str, robot: str) -> None:
    terrain = make_terrain(name, robot=robot, seed=3)
    dice = np.random.default_rng(0)
    for _ in range(12):
        ix, iy = (int(dice.integers(n)) for n in terrain.elevation.shape)
        expected = height_by_search(terrain.boxes, *terrain.elevation.centre_of(ix, iy))
        assert terrain.elevation.heights[ix, iy] == pytest.approx(expected, abs=2e-3)


def test_ground_without_a_box_is_unknown() -> None:
    elevation = rasterise([Box(centre=(0.5, 0.5, 0), size=(1, 1, 1))], (2.0, 1.0), 0.5)
    assert elevation.heights[:2].tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert not elevation.known[2:].any()


@given(st.integers(0, 1000), st.integers(2, 9), st.integers(2, 9))
def test_boxes_from_elevation_rasterise_to_the_same_map(seed: int, nx: int, ny: int) -> None:
    heights = np.random.default_rng(seed).integers(-1, 2, (nx, ny)) * 0.25
    elevation = ElevationMap(heights, resolution=0.1)
    boxes = boxes_from_elevation(elevation)
    np.testing.assert_allclose(
        rasterise(boxes, elevation.size, 0.1).heights, elevation.heights, atol=1e-6
    )
    assert sum(box.size[0] * box.size[1] for box in boxes) == pytest.approx(nx * ny * 0.01)


def test_boxes_from_elevation_merges_and_respects_the_origin() -> None:
    heights = np.zeros((4, 6))
    heights[1:3, 2:4] = 1.0
    boxes = boxes_from_elevation(ElevationMap(heights, resolution=0.5, origin=(10.0, 20.0)))
    assert len(boxes) == 5
    (high,) = (box for box in boxes if box.size[2] == 1.5)
    assert high.centre[:2] == (11.0, 21.5) and high.size[:2] == (1.0, 1.0)


# -- terrains --------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("name", TERRAINS)
@pytest.mark.parametrize("difficulty", [0.0, 0.5, 1.0])
def test_every_terrain_is_a_corridor_between_flat_aprons(
    name: str, robot: str, difficulty: float
) -> None:
    terrain = make_terrain(name, robot=robot, difficulty=difficulty, seed=1)
    scale, elevation = ROBOTS[robot].scale, terrain.elevation
    assert elevation.known.all()
    apron = round(scale.apron / elevation.resolution)
    assert not elevation.heights[:apron].any() and not elevation.heights[-apron:].any()
    length, width = elevation.size
    assert width == pytest.approx(scale.width)
    assert terrain.start == pytest.approx((scale.apron / 2, width / 2))
    assert terrain.goal == pytest.approx((length - scale.apron / 2, width / 2))
    assert terrain.lane[0] == terrain.start and terrain.lane[-1] == terrain.goal
    along = [x for x, _ in terrain.lane]
    assert along == sorted(along) and all(elevation.contains(*point) for point in terrain.lane)


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("seed", range(5))
def test_every_section_holds_its_obstacle_over_the_full_width(robot: str, seed: int) -> None:
    terrains = [make_terrain(name, robot=robot, seed=seed) for name in (*OBSTACLES, "mixed")]
    for terrain in terrains:
        for section in terrain.sections:
            region = terrain.elevation.crop(section.x0, section.y0, section.x1, section.y1)
            assert np.ptp(region.heights) > 0.05, f"{section} of {terrain.name} is flat"
            if section.name != "bridge":  # whose beam is the way over
                assert region.heights.any(axis=0).all(), f"there is a way around {section}"
    mixed = terrains[-1]
    assert sorted(section.name for section in mixed.sections) == sorted(ROBOTS[robot].scale.mixed)
    for left, right in zip(mixed.sections, mixed.sections[1:], strict=False):
        landing = mixed.elevation.crop(left.x1, 0.0, right.x0, left.y1)
        assert landing.size[0] == pytest.approx(ROBOTS[robot].scale.mixed_landing)
        assert not landing.heights.any()


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("seed", range(4))
def test_neighbours_are_other_obstacles_a_landing_away(robot: str, seed: int) -> None:
    scale = ROBOTS[robot].scale
    for name in scale.mixed:
        terrain = make_terrain(name, robot=robot, seed=seed, neighbours=True)
        alone = make_terrain(name, robot=robot, seed=seed)
        assert terrain.elevation.shape == alone.elevation.shape, "they share a World"
        assert terrain.spread == alone.spread, "the neighbours do not narrow the way"
        before, own, after = terrain.sections
        assert terrain.span == (own.x0, own.x1)
        assert own.name == name and name not in (before.name, after.name)
        assert (before.x0, after.x1) == (0.0, terrain.elevation.size[0])
        for left, right in ((before, own), (own, after)):
            landing = terrain.elevation.crop(left.x1, 0.0, right.x0, left.y1)
            assert landing.size[0] == pytest.approx(scale.mixed_landing)
            assert not landing.heights.any()
        limits = terrain.limits
        assert limits is not None
        assert before.x1 < limits[0] < terrain.start[0] < own.x0
        assert own.x1 < terrain.goal[0] < limits[1] < after.x0
        assert terrain.lane[0] == terrain.start and terrain.lane[-1] == terrain.goal


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("name", (*OBSTACLES, "mixed"))
def test_the_seed_fixes_the_terrain(name: str, robot: str) -> None:
    first, again, other = (make_terrain(name, robot=robot, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.elevation.heights, again.elevation.heights)
    assert first.boxes == again.boxes and first.lane == again.lane
    assert first.elevation.shape == other.elevation.shape, "a World needs equal sizes"
    assert (first.elevation.heights != other.elevation.heights).any()


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("name", OBSTACLES)
@pytest.mark.parametrize("seed", range(3))
def test_higher_difficulty_is_rougher(name: str, robot: str, seed: int) -> None:
    spread = [
        float(
            np.abs(
                make_terrain(name, robot=robot, difficulty=level, seed=seed).elevation.heights
            ).mean()
        )
        for level in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    # A valley's plateaus keep their height, but grow; its mean height still rises.
    assert spread == sorted(spread) and spread[0] < spread[-1]


@pytest.mark.parametrize("name", ["steps", "gaps", "bridge", "rubble", "stairs"])
@pytest.mark.parametrize("robot", tuple(ROBOTS))
def test_upright_edges_lie_on_cell_borders(name: str, robot: str) -> None:
    resolution = ROBOTS[robot].scale.resolution
    for box in make_terrain(name, robot=robot, difficulty=0.6, seed=2).boxes:
        for centre, size in zip(box.centre[:2], box.size[:2], strict=True):
            for edge in (centre - size / 2, centre + size / 2):
                assert edge / resolution == pytest.approx(round(edge / resolution), abs=1e-6)


@pytest.mark.parametrize("robot", tuple(ROBOTS))
def test_risers_by_measurement(robot: str) -> None:
    lowest, highest = ROBOTS[robot].scale.step_height
    for seed in range(5):
        heights = make_terrain("steps", robot=robot, seed=seed).elevation.heights
        risers = np.abs(np.diff(heights[:, heights.shape[1] // 2]))
        assert risers.max() <= highest + 1e-5, "along the way no riser is higher than the highest"
        assert risers.max() >= lowest - 1e-5


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize(("difficulty", "depth"), [(0.0, 0), (0.7, 1), (1.0, 2)])
def test_gaps_by_measurement(robot: str, difficulty: float, depth: int) -> None:
    scale = ROBOTS[robot].scale
    for seed in range(5):
        terrain = make_terrain("gaps", robot=robot, difficulty=difficulty, seed=seed)
        heights = terrain.elevation.heights
        assert (heights == heights[:, :1]).all(), "gaps go over the full width"
        assert heights.min() == pytest.approx(-scale.chasm_depth[depth])
        edges = np.flatnonzero(np.diff((heights[:, 0] < 0).astype(int)))
        widths = np.diff(edges)[::2] * scale.resolution
        assert 3 <= len(widths) <= 5
        if difficulty == 1.0:
            np.testing.assert_allclose(widths, scale.gap_width[1], atol=1e-6)
        assert (np.diff(edges)[1::2] * scale.resolution >= scale.platform[0] - 1e-6).all()


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("seed", range(4))
def test_bridge_by_measurement(robot: str, seed: int) -> None:
    terrain = make_terrain("bridge", robot=robot, seed=seed)
    (section,), scale = terrain.sections, ROBOTS[robot].scale
    region = terrain.elevation.crop(section.x0, section.y0, section.x1, section.y1)
    assert region.size[0] == pytest.approx(scale.bridge_length)
    beam = region.heights[0] == 0
    floor = np.float32(-scale.chasm_depth[-1])
    assert (region.heights == np.where(beam, np.float32(0), floor)).all()
    assert beam.sum() * scale.resolution == pytest.approx(scale.bridge_width[1])
    (y,) = {point[1] for point in terrain.lane[1:-1]}
    assert y == pytest.approx(region.centres[1][beam].mean())


@pytest.mark.parametrize("robot", tuple(ROBOTS))
@pytest.mark.parametrize("difficulty", [0.2, 1.0])
def test_valley_walls_have_the_angle_and_height(robot: str, difficulty: float) -> None:
    terrain = make_terrain("valley", robot=robot, difficulty=difficulty, seed=1)
    (section,), scale = terrain.sections, ROBOTS[robot].scale
    profile = terrain.elevation.heights[round((section.x0 + 1) / scale.resolution)]
    bottom = round(terrain.lane[1][1] / scale.resolution)
    angle = scale.valley_angle[0] + difficulty * np.subtract(*scale.valley_angle[::-1])
    slope = math.tan(math.radians(angle))
    assert profile[bottom] == pytest.approx(slope * scale.resolution / 2, abs=1e-5)
    np.testing.assert_allclose(
        np.diff(profile[bottom : bottom + 5]) / scale.resolution, slope, 1e-4
    )
    np.testing.assert_allclose(profile[bottom + np.arange(5)], profile[bottom - 1 - np.arange(5)])
    assert profile[0] >= 0.5 and profile[-1] >= 0.5


@pytest.mark.parametrize("robot", tuple(ROBOTS))
def test_ramps_are_never_steeper_than_the_scale_says(robot: str) -> None:
    scale = ROBOTS[robot].scale
    limit = math.tan(math.radians(scale.slope_angle[1])) * scale.resolution
    for seed in range(8):
        boxes = make_terrain("slopes", robot=robot, seed=seed).boxes
        steepest = max(abs(math.tan(box.rpy[1])) for box in boxes) * scale.resolution
        assert 0.3 * limit < steepest <= limit + 1e-6


def test_resolution_and_scale_can_be_given() -> None:
    fine = make_terrain("steps", resolution=0.05, seed=1)
    assert fine.elevation.resolution == 0.05
    wide = make_terrain("gaps", scale=replace(ROBOTS["toy"].scale, gap_width=(0.1, 0.6)), seed=1)
    row = wide.elevation.heights[:, 0]
    assert np.diff(np.flatnonzero(np.diff(row)))[0] == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "lava"}, "flat, gentle, steps"),
        ({"robot": "spot"}, "toy, a1"),
        ({"difficulty": 1.1}, "difficulty: should be less than or equal to 1, got 1.1"),
        ({"difficulty": -0.1}, "difficulty: should be greater than or equal to 0"),
        ({"difficulty": math.nan}, "difficulty: should be a finite number"),
        ({"seed": -1}, "seed: should be greater than or equal to 0"),
        ({"seed": math.nan}, "seed: should be a valid integer"),
        ({"resolution": 0.0}, "resolution: "),
        ({"resolution": 1e-4}, "resolution: should be greater than or equal to 0.005"),
        ({"resolution": math.nan}, "resolution: should be a finite number"),
        (
            {"resolution": 0.005, "scale": replace(ROBOTS["toy"].scale, length=50.0, width=50.0)},
            "10000 x 10000 cells are more than 50000000",
        ),
        ({"scale": replace(ROBOTS["toy"].scale, length=3.0)}, "no room"),
        ({"neighbours": True, "name": "stairs"}, "no neighbours for 'stairs'"),
        ({"neighbours": True, "scale": replace(ROBOTS["toy"].scale, length=4.5)}, "4 landings"),
    ],
)
def test_out_of_range(arguments: dict, message: str) -> None:
    with pytest.raises(TerrainError, match=message):
        make_terrain(**{"name": "steps", **arguments})


def test_from_elevation() -> None:
    elevation = ElevationMap(np.zeros((20, 10)))
    terrain = Terrain.from_elevation(elevation, (0.5, 0.5), (1.5, 0.5))
    assert terrain.name == "map" and terrain.boxes == () and terrain.elevation is elevation
    with pytest.raises(OffMapError):
        Terrain.from_elevation(elevation, (0.5, 0.5), (2.5, 0.5))


# -- worlds ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world() -> World:
    names = (("steps", "gaps", "bridge"), ("slopes", "rubble", "valley"))
    return World(
        [[make_terrain(name, seed=seed) for seed, name in enumerate(row)] for row in names]
    )


def test_world_lays_columns_along_x_and_rows_along_y(world: World) -> None:
    # A toy terrain is 9 x 4 m; a margin of 1.5 m on either side makes the pitch 12 x 7 m.
    assert world.offset.shape == (2, 3, 2)
    np.testing.assert_allclose(world.offset[0, 0], (1.5, 1.5))
    np.testing.assert_allclose(world.offset[1, 2], (1.5 + 2 * 12, 1.5 + 7))
    assert world.elevation.size == pytest.approx((36, 14))
    for row, tiles in enumerate(world.tiles):
        for column, tile in enumerate(tiles):
            dx, dy = world.offset[row, column]
            length, width = tile.elevation.size
            inside = world.elevation.crop(dx, dy, dx + length, dy + width)
            np.testing.assert_array_equal(inside.heights, tile.elevation.heights)


def test_patches_in_the_world_equal_patches_on_the_single_maps(world: World) -> None:
    grid, dice = PatchGrid(), np.random.default_rng(0)
    whole = torch.tensor(world.lay(prepare).heights)
    for row, tiles in enumerate(world.tiles):
        for column, tile in enumerate(tiles):
            length, width = tile.elevation.size
            border = [(x, y) for x in (0.0, 4.0, length) for y in (0.0, 2.0, width)]
            poses = [(x, y, yaw) for x, y in border for yaw in dice.uniform(-3, 3, 4)]
            here = torch.tensor(poses, dtype=torch.float32)
            there = here.clone()
            there[:, :2] += torch.tensor(world.offset[row, column], dtype=torch.float32)
            single = sample_patches(
                torch.tensor(prepare(tile.elevation).heights), here, grid, resolution=0.1
            )
            together = sample_patches(whole, there, grid, resolution=0.1)
            # At 36 m, float32 places a point to 4 um; a 1 m edge over a 0.1 m cell makes it 40.
            torch.testing.assert_close(together, single, rtol=0, atol=2e-4)


def test_world_boxes_rasterise_to_its_map(world: World) -> None:
    heights = rasterise(world.boxes, world.elevation.size, 0.1).heights
    np.testing.assert_allclose(heights, world.elevation.heights, atol=1e-5)


def test_world_of_maps_without_boxes() -> None:
    heights = np.zeros((20, 10))
    heights[5:9, 3:6] = 0.4
    tile = Terrain.from_elevation(ElevationMap(heights), (0.2, 0.5), (1.8, 0.5))
    world = World([[tile, tile]], margin=0.3)
    rasterised = rasterise(world.boxes, world.elevation.size, 0.1).heights
    np.testing.assert_allclose(rasterised, world.elevation.heights, atol=1e-6)


@pytest.mark.parametrize(
    ("tiles", "message"),
    [
        ([], "at least one"),
        ([[]], "at least one"),
        ([["toy"], ["toy", "toy"]], "equally long"),
        ([["toy", "a1"]], "share shape"),
    ],
)
def test_worlds_that_do_not_fit(tiles: list[list[str]], message: str) -> None:
    with pytest.raises(TerrainError, match=message):
        World([[make_terrain("flat", robot=robot) for robot in row] for row in tiles])
    flat = make_terrain("flat")
    with pytest.raises(TerrainError, match="margin"):
        World([[flat]], margin=-1.0)


@given(
    name=st.sampled_from(TERRAINS),
    robot=st.sampled_from(tuple(ROBOTS)),
    difficulty=st.floats(0, 1),
    seed=st.integers(0, 2**31),
    resolution=st.sampled_from((None, 0.03, 0.07, 0.1, 0.15, 0.2)),
)
@settings(max_examples=60)
def test_any_draw_is_sound(
    name: str, robot: str, difficulty: float, seed: int, resolution: float | None
) -> None:
    terrain = make_terrain(
        name, robot=robot, difficulty=difficulty, seed=seed, resolution=resolution
    )
    assert terrain.elevation.known.all()
    assert terrain.elevation.height_at(*terrain.start) == 0
    assert terrain.elevation.height_at(*terrain.goal) == 0
    assert np.abs(terrain.elevation.heights).max() <= 1.5
    assert all(min(box.size) > 0 for box in terrain.boxes)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steps", "gaps", "bridge", "valley"])
def test_no_evaluation_map_equals_one_of_training(kind):
    def levelled(**how):
        # A hole is a hole: what policies and nets see of a chasm ends 0.5 m below the ground.
        return make_terrain(kind, robot="a1", **how).elevation.heights.clip(-0.5).tobytes()

    # Most beams and valleys of training are laid at nearly its last difficulty; all at the last
    # one is the hardest case.
    trained = {levelled(seed=2 * seed) for seed in range(400)}
    alike = sum(levelled(seed=2 * seed + 1) in trained for seed in range(400))
    assert sum(levelled(seed=2 * seed + 1, unlike=True) in trained for seed in range(400)) == 0
    if kind in ("bridge", "valley"):
        assert alike > 40  # they have two numbers, drawn in whole cells: seeds alone do not differ


@pytest.mark.parametrize("robot", ["toy", "a1"])
@pytest.mark.parametrize("kind", ["bridge", "valley"])
def test_what_is_unlike_training_is_longer_than_any_of_it(robot, kind):
    scale = ROBOTS[robot].scale
    for seed in range(20):
        part = make_terrain(kind, robot=robot, seed=seed, unlike=True).sections[0]
        longer = (part.x1 - part.x0 - scale.longest(kind)) / scale.resolution
        assert round(longer) in range(1, 7) and longer == pytest.approx(round(longer), abs=1e-6)
        start = make_terrain(kind, robot=robot, seed=seed).sections[0].x0
        assert part.x0 == start  # nothing else moves


def test_slots_unlike_training_step_aside_by_a_cell():
    for seed in range(10):
        one, other = (
            make_terrain("gaps", robot="a1", seed=seed, unlike=how) for how in (False, True)
        )
        straight, bent = one.elevation.heights, other.elevation.heights
        assert (straight == straight[:, :1]).all()
        # On the right it is as it was, on the left a cell further; nowhere else.
        assert (bent[:, 0] == straight[:, 0]).all()
        assert (bent[1:, -1] == straight[:-1, -1]).all()
        assert (np.diff(bent, axis=1) != 0).any(axis=0).sum() == 1
