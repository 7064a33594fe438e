import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import tyro

from fgtutor.errors import ConfigError, SpecialistError, TerrainError
from fgtutor.evaluation import adaptation, trials
from fgtutor.evaluation.adaptation import (
    WALL,
    AdaptationConfig,
    find_plans,
    geodesic,
    make_map,
    run,
    summarise,
    table,
    way_of,
)
from fgtutor.feasibility import FeasibilityNet
from fgtutor.robots import ROBOTS
from fgtutor.robots.a1.env import A1_GRID
from fgtutor.robots.toy import TOY_GRID
from fgtutor.specialist import ZOO, load_specialist, save_specialist

GRIDS = {"toy": TOY_GRID, "a1": A1_GRID}


def climber_net(grid, limit):
    """Return a Feasibility-Net that says 0.8 where no point rises by `limit` (m) or more, else 0.

    One unit a point, elu(200 (h - limit)), is -1 while h is well below the limit and grows beyond
    it; their sum, brought to 0 for level ground, is taken from the logit.
    """
    n, k = grid.num_points, 50.0
    net = FeasibilityNet(n, hidden=(n, 1), vae_hidden=(4, 4), latent=2)  # scales heights by 4
    first, second, last = (net.head[i] for i in (0, 2, 4))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        first.weight[:, :n] = k * torch.eye(n)
        first.bias.fill_(-4 * k * limit)
        second.weight.fill_(1.0)
        second.bias.fill_(n)
        last.weight.fill_(-5.0)
        last.bias.fill_(np.log(0.8 / 0.2))
    return net


@pytest.fixture
def make_climber(make_specialist):
    """Return a maker of specialists that know their limit: the highest platform they will climb."""

    def make(name, limit, robot="toy", **fields):
        grid = GRIDS[robot]
        values = {
            "robot": robot,
            "grid": grid,
            "feasibility": climber_net(grid, limit),
            "quantiles": {"0.5": 1.0, "0.9": 9e5, "0.95": 9.5e5, "0.99": 9.9e5},
        }
        return make_specialist(name, **(values | fields))

    return make


@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_three_gates_in_a_wall_with_steps_of_three_heights(robot):
    terrain, scale = make_map(robot, 1), ROBOTS[robot].scale
    ground = terrain.elevation
    assert ground.resolution == scale.resolution and ground.known.all()
    (x, y), (u, v) = terrain.start, terrain.goal
    assert y == v and u - x == 5.0
    assert ground.height_at(x, y) == ground.height_at(u, v) == 0
    # Straight ahead is wall, from border to border but for the three gates.
    middle = ground.heights[ground.cell_of((x + u) / 2, 0)[0]]
    gates = [ground.cell_of(0, gate.y0)[1] for gate in terrain.sections]
    wide = round(1.8 / scale.resolution)
    wall = np.ones(ground.shape[1], dtype=bool)
    for first in gates:
        wall[first : first + wide] = False
    assert (middle[wall] == np.float32(WALL)).all() and (middle[~wall] < WALL).all()
    assert wall[: gates[0]].all() and not wall[-wide:].any()
    # Up two steps and down two: on top of the middle tread lie both risers.
    for gate, share in zip(terrain.sections, (0.87, 0.67, 0.2), strict=True):
        inside = ground.crop(gate.x0, gate.y0, gate.x1, gate.y1).heights
        assert np.ptp(inside, axis=1).max() == 0
        levels = [inside[0, 0], inside[len(inside) // 2, 0], inside[-1, 0]]
        highest = share * 0.15
        assert 0.9 * highest <= min(levels) and max(levels[0], levels[2]) <= highest + 1e-6
        assert levels[1] == pytest.approx(levels[0] + levels[2])
        assert len(np.unique(inside)) == 3


@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_edges_of_boxes_lie_on_cell_borders_and_seeds_move_the_treads_only(robot):
    one, same, other = make_map(robot, 1), make_map(robot, 1), make_map(robot, 3)
    for box in one.boxes:
        for centre, size in zip(box.centre[:2], box.size[:2], strict=True):
            cells = np.array((centre - size / 2, centre + size / 2)) / one.elevation.resolution
            assert cells == pytest.approx(np.round(cells), abs=1e-6)
    np.testing.assert_array_equal(one.elevation.heights, same.elevation.heights)
    changed = one.elevation.heights != other.elevation.heights
    x, y = np.nonzero(changed)
    assert changed.any()
    gates = one.sections
    assert one.elevation.centres[0][x].min() > gates[0].x0
    for at in one.elevation.centres[1][y]:
        assert any(gate.y0 < at < gate.y1 for gate in gates)


def test_the_geodesic_by_hand():
    # Toy cells of 0.1 m. From cell (15, 10) up 25 rows to the gate's edge, 11 columns of them
    # diagonally; 27 columns across; and down 25 rows, 12 columns of them diagonally.
    expected = 0.1 * ((11 + 12) * np.sqrt(2) + (14 + 27 + 13))
    assert geodesic(make_map("toy", 1)) == pytest.approx(expected)


def test_a_way_is_named_after_its_gate():
    terrain = make_map("toy", 1)

    def via(y):
        return np.array([[1.5, 1.0], [4.0, y], [6.5, 1.0]])

    assert [way_of(via(y), terrain) for y in (4.0, 6.5, 13.0)] == ["short", "middle", "long"]
    assert way_of(via(9.0), terrain) is None  # over the wall


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_the_limit_decides_the_way(make_climber, robot):
    # Platforms of both risers: 25 cm, 19 cm and 6 cm at most; a wall of 60 cm.
    limits = {"early": 0.1, "mid": 0.21, "late": 0.35, "never": 0.01}
    if robot == "a1":  # four times the cells
        limits = {"mid": 0.21}
    zoo = {name: make_climber(name, limit, robot) for name, limit in limits.items()}
    terrain = make_map(robot, 1)
    plans = find_plans(terrain, zoo, AdaptationConfig(robot=robot))
    ways = {"early": ("long", 26), "mid": ("middle", 14), "late": ("short", 9.5)}
    for name in limits.keys() - {"never"}:
        tensor, route = plans[name]
        way, length = ways[name]
        assert way_of(route.xy, terrain) == way and route.length == pytest.approx(length, abs=1)
        assert route.length >= geodesic(terrain)
        assert route.feasibility.min() >= 0.25
        assert tensor.shape == (*terrain.elevation.shape, 8)
    if robot == "toy":
        assert plans["never"][1] is None


def test_a_climber_says_what_it_should(make_climber):
    grid = GRIDS["toy"]
    net = make_climber("late", 0.2).feasibility
    patch = torch.zeros(3, grid.num_points)
    patch[1, 7], patch[2, 7] = 0.15, 0.25
    f = net.feasibility(patch, torch.zeros(3, 3)).detach()
    assert f[:2] == pytest.approx([0.8, 0.8], abs=0.01) and f[2] < 1e-6


@pytest.fixture
def config(make_climber, tmp_path):
    """Two checkpoints that drive alike: the first trusts itself nowhere, the second everywhere."""
    steps = load_specialist(ZOO / "toy" / "steps")
    for name, limit, samples in (("novice", 0.001, 10), ("able", 0.4, 2000)):
        checkpoint = make_climber(
            name,
            limit,
            policy=steps.policy,
            command=steps.command,
            provenance={"samples": samples},
        )
        save_specialist(checkpoint, tmp_path / "zoo" / name)
    return AdaptationConfig(
        trials=2,
        maps=2,
        heights=(0.3, 0.2, 0.1),
        zoo=tmp_path / "zoo",
        workers=1,
        out=tmp_path / "report",
    )


@pytest.mark.slow
def test_the_command_drives_reports_and_resumes(config, capsys, monkeypatch):
    assert list(config.load_checkpoints()) == ["novice", "able"]  # by samples, not by name
    assert run(config) == 0
    printed = capsys.readouterr().out
    assert "2 of 2 tasks to do" in printed
    rows = json.loads((config.out / "rows.json").read_text())
    assert len(rows) == 4
    for row in rows:
        assert row["ground"] % 2 == row["seed"] % 2 == 1 and row["straight"] == 5.0
        assert row["geodesic"] == pytest.approx(8.653)
        if row["policy"] == "novice":
            # A tenth of a step is more than it would climb anywhere, so there is no way at all.
            assert (row["outcome"], row["way"], row["length"]) == ("no_route", None, 0.0)
        else:
            assert (row["outcome"], row["way"]) == ("reached", "short")
            # It stops within 0.35 m of the goal, and cuts the corners of the cells.
            assert row["planned"] - 1.5 < row["length"] < row["planned"]
    lines = (config.out / "table.md").read_text().splitlines()
    assert any(line.startswith("| novice | 10 | none | - | 0 (0-66) | 0.000") for line in lines)
    mean = np.mean([row["length"] for row in rows if row["policy"] == "able"])
    assert any(line.startswith(f"| able | 2,000 | short | {mean:.2f} (") for line in lines)
    assert "straight line of 5 m" in lines[-1] and "4 trials in all" in lines[-1]
    assert json.loads((config.out / "figures" / "routes.json").read_text())["novice"] is None
    ElementTree.parse(config.out / "figures" / "maps.svg")

    monkeypatch.setattr(trials, "execute_batch", lambda *_, **__: pytest.fail("driven again"))
    assert run(config) == 0
    again = capsys.readouterr().out
    assert again == printed[printed.index("| checkpoint") :]  # the same, and nothing to do


def test_trials_are_spread_over_the_maps():
    config = AdaptationConfig(trials=5, maps=2, seed=1)
    first = 2 * 1_000_000 + 1
    assert config.seeds(0) == (first, first + 4, first + 8)
    assert config.seeds(1) == (first + 2, first + 6)
    assert len(adaptation.make_tasks(config)) == 2
    assert len(adaptation.make_tasks(replace(config, trials=1))) == 1


def trial(length, outcome="reached", ground=1, **fields):
    return {
        "policy": "late",
        "ground": ground,
        "outcome": outcome,
        "length": length,
        "way": "short",
        "straight": 5.0,
        "geodesic": 8.0,
        **fields,
    }


def test_spl_by_hand_and_as_in_the_paper():
    # 5 / 10 = 0.5 once, a fall counts 0: mean 0.25. Against 8 m: 8 / 10 = 0.8, mean 0.4.
    means = summarise([trial(10.0), trial(3.0, "fell")])
    assert means["straight"][0] == 0.25 and means["geodesic"][0] == pytest.approx(0.4)
    assert means["length"] == (10.0, 10.0, 10.0)
    # A walk shorter than its reference counts 1, not more.
    assert summarise([trial(7.5)])["geodesic"][0] == 1.0
    # Table I: the straight line of 5 m gives the paper's SPL.
    paper = [summarise([trial(length)])["straight"][0] for length in (26.75, 14.84, 9.73)]
    assert paper == pytest.approx([0.19, 0.34, 0.51], abs=0.005)


def test_intervals_come_from_the_maps():
    # Two maps of two trials: their means are 10 and 20; a quarter of all resamples has one of
    # them only, so the interval reaches from one to the other.
    drives = [
        trial(length, ground=ground) for ground, length in ((1, 9), (1, 11), (3, 20), (3, 20))
    ]
    assert summarise(drives)["length"] == (15.0, 10.0, 20.0)
    # One map says nothing of others.
    assert summarise(drives[:2])["length"] == (10.0, 10.0, 10.0)
    # A map without a success has no length.
    assert summarise([*drives[:2], trial(1.0, "fell", 5)])["length"] == (10.0, 10.0, 10.0)


def test_the_table_says_where_nothing_was_reached(make_climber):
    zoo = {"late": make_climber("late", 0.2, provenance={"samples": 1234567})}
    assert table([trial(0.0, "no_route", way=None)], zoo).splitlines()[2] == (
        "| late | 1,234,567 | none | - | 0 (0-79) | 0.000 (0.000-0.000) | 0.000 (0.000-0.000) |"
    )


def test_what_cannot_work_is_refused(tmp_path):
    with pytest.raises(TerrainError, match="wheelbarrow"):
        make_map("wheelbarrow", 1)
    with pytest.raises(ConfigError, match=r"^maps: "):
        AdaptationConfig(maps=0)
    with pytest.raises(ConfigError, match=r"^heights: 1: .*got -0\.2"):
        AdaptationConfig(heights=(0.1, -0.2, 0.3))
    with pytest.raises(SpecialistError, match="nowhere"):
        run(AdaptationConfig(zoo=tmp_path / "nowhere"))


def test_the_command_line_reads_its_options():
    words = ["--heights", "0.9", "0.6", "0.1", "--robot", "a1", "--cost", "inverse"]
    config = tyro.cli(AdaptationConfig, args=words)
    assert config.heights == (0.9, 0.6, 0.1) and config.cost == "inverse"
    assert config.home == ZOO / "a1" / "_checkpoints"
