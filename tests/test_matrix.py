import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from fgtutor.__main__ import main
from fgtutor.baselines import ours
from fgtutor.errors import ConfigError, ReportError, StorageError, TerrainError
from fgtutor.evaluation import ablation, success
from fgtutor.evaluation.ablation import AblationConfig
from fgtutor.evaluation.cost import Cost
from fgtutor.evaluation.matrix import MatrixConfig, evaluate, policies, run, table
from fgtutor.evaluation.shards import collect
from fgtutor.evaluation.success import (
    make_ground,
    make_tasks,
    summarise,
    terrain_seed,
    with_random_ends,
)
from fgtutor.evaluation.trials import Ground, Trial, drive
from fgtutor.execution import FollowConfig
from fgtutor.world.terrain import make_terrain


@pytest.fixture
def config(zoo):
    return MatrixConfig(
        trials=3, terrains=("flat", "gaps"), zoo=zoo, workers=1, json=zoo.parent / "rows.json"
    )


@pytest.mark.slow
def test_rows_name_every_outcome(config):
    rows = {(row["terrain"], row["policy"]): row for row in evaluate(config)}
    assert list(rows) == [
        (terrain, policy)
        for terrain in ("flat", "gaps")
        for policy in ("gaps", "steps", "ours", "general")
    ]
    for row in rows.values():
        assert list(row) == ["terrain", "policy", "trials", "successes", "ci95", "failures"]
        assert row["trials"] == 3 == row["successes"] + sum(row["failures"].values())
        assert set(row["failures"]) == {"no_route", "fell", "timeout"}
        assert 0 <= row["ci95"][0] <= row["successes"] / 3 <= row["ci95"][1] <= 1
    # On flat ground rolling is enough; a policy that predicts f = 0.05 refuses everywhere (f_min).
    assert rows["flat", "steps"]["successes"] == rows["flat", "ours"]["successes"] == 3
    assert rows["flat", "gaps"]["failures"]["no_route"] == 3
    # A rolling toy that believes in itself drops an axle into the first gap, and hangs there.
    assert rows["gaps", "steps"]["successes"] == 0
    assert rows["gaps", "steps"]["failures"]["no_route"] == 0
    # A part of the table is that part of the whole.
    part = evaluate(replace(config, terrains=("flat",), policies=("ours",)))
    assert part == [rows["flat", "ours"]]


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(config, monkeypatch):
    monkeypatch.setattr(success, "GROUNDS", 2)
    tasks = make_tasks(config, ("flat",), ("ours",))
    alone, together = (
        collect(tasks, {}, replace(config, workers=workers)).rows for workers in (1, 2)
    )
    assert len(alone) == 3 and alone == together  # every length, to the millimetre


@pytest.mark.slow
def test_another_zoo_and_other_settings_are_another_run(config):
    config = replace(config, trials=1, terrains=("flat",), policies=("steps",))
    config = replace(config, out=config.zoo.parent / "out")
    evaluate(config)
    with pytest.raises(ReportError, match=r"f_min was .* and is 0\.2"):
        evaluate(replace(config, f_min=0.2))
    description = config.zoo / "steps" / "specialist.json"
    description.write_text(description.read_text() + "\n")
    with pytest.raises(ReportError, match="zoo was"):
        evaluate(config)


@pytest.mark.slow
def test_more_trials_in_the_same_folder_drive_only_the_new_ones(config, monkeypatch):
    monkeypatch.setattr(success, "GROUNDS", 2)
    few = replace(config, terrains=("flat",), policies=("steps",), out=config.zoo.parent / "few")
    evaluate(few)
    more = replace(few, trials=5)
    whole = evaluate(replace(more, out=None))
    drawn, make = [], success.make_ground
    monkeypatch.setattr(success, "make_ground", lambda *w: drawn.append(w[-1]) or make(*w))
    assert evaluate(more) == whole and whole[0]["trials"] == 5
    assert drawn == [2, 3, 4]  # of the second task only one ground was there
    assert evaluate(few)[0]["trials"] == 3 and drawn == [2, 3, 4]
    # By the paper's protocol, a ground stands for every 40th of the trials.
    evaluate(replace(few, protocol="paper", out=config.zoo.parent / "paper"))
    with pytest.raises(ReportError, match="trials was 3 and is 5"):
        evaluate(replace(more, protocol="paper", out=config.zoo.parent / "paper"))


@pytest.mark.slow
def test_the_command_writes_rows_and_a_report_and_prints_a_table(config, capsys):
    folder = config.zoo.parent / "report"
    config = replace(config, terrains=("flat",), out=folder)
    assert run(config) == 0
    rows = json.loads(config.json.read_text())
    assert [row["policy"] for row in rows] == ["gaps", "steps", "ours", "general"]
    printed = capsys.readouterr().out
    line = "| flat | 0 (0-56) | 100 (44-100) | 100 (44-100) | 100 (44-100) |"
    assert line in printed and "3 trials a cell" in printed
    # Three maps for each of three policies of the zoo, three episodes for each of four columns.
    assert "1 of 1 tasks to do" in printed and "9 maps" in printed and "12 episodes" in printed
    assert "on 1 core like this one" in printed

    trials = json.loads((folder / "rows.json").read_text())
    assert len(trials) == 12 and trials[0].keys() == asdict(Trial(**trials[0])).keys()
    reached = [trial for trial in trials if trial["outcome"] == "reached"]
    assert len(reached) == 9 and all(trial["length"] > 5 for trial in reached)
    assert (
        line in (folder / "table.md").read_text()
        and "12 trials in all" in (folder / "table.md").read_text()
    )
    assert (folder / "figures" / "success.svg").read_text().count(" of 3 -->") == 4
    # The second time everything is there: nothing to estimate, the same table.
    assert run(config) == 0
    again = capsys.readouterr().out
    assert line in again and "tasks to do" not in again


def test_evaluation_never_draws_a_training_seed():
    seeds = {terrain_seed(seed, trial) for seed in range(3) for trial in range(500)}
    assert len(seeds) == 1500 and all(seed % 2 == 1 for seed in seeds)


def test_the_papers_protocol_is_300_000_trials(config):
    config = MatrixConfig(protocol="paper", robot="a1")
    assert config.count == 10_000 and config.grounds == 40
    six = ("bridge", "gaps", "steps", "valley", "ours", "general")
    terrains = ("steps", "gaps", "bridge", "valley", "mixed")
    tasks = make_tasks(config, terrains, six)
    assert len(tasks) == len({task.name for task in tasks}) == 200
    # Task k of a terrain is ground k; trial t is driven on ground t mod 40.
    *_, grounds = tasks[41].arguments
    assert list(grounds) == [1]
    ground = make_ground(config, "gaps", 1)
    assert len(ground.seeds) == 250 and ground.seeds[:2] == (
        terrain_seed(0, 1),
        terrain_seed(0, 41),
    )
    assert 250 * len(six) * len(tasks) == 300_000
    few = make_ground(replace(config, trials=90), "gaps", 1)
    assert few.seeds == ground.seeds[:3] and few.terrain.start == ground.terrain.start
    assert replace(config, trials=7).grounds == 7


@pytest.mark.parametrize("robot", ["toy", "a1"])
def test_random_tasks_cross_the_obstacle_from_flat_ground_to_flat_ground(robot):
    terrain = make_terrain("bridge" if robot == "a1" else "gaps", robot=robot, seed=5)
    part, (_, _, length, width) = terrain.sections[0], terrain.elevation.extent
    drawn = [with_random_ends(terrain, seed) for seed in range(40)]
    assert len({task.start for task in drawn}) == 40
    forwards = [task.start[0] < task.goal[0] for task in drawn]
    assert 8 < sum(forwards) < 32
    for task in drawn:
        (left, a), (right, b) = sorted((task.start, task.goal))
        assert 0.3 < left < part.x0 - 0.3 and part.x1 + 0.3 < right < length - 0.3
        for x, y in ((left, a), (right, b)):
            assert 0.5 <= y <= width - 0.5
            around = terrain.elevation.crop(x - 0.3, y - 0.3, x + 0.3, y + 0.3).heights
            assert np.ptp(around) < 1e-3
    assert with_random_ends(terrain, 3).start == drawn[3].start


def test_the_mixed_terrain_keeps_its_start_and_goal():
    config = MatrixConfig(protocol="paper")
    ground = make_ground(config, "mixed", 2).terrain
    made = make_terrain("mixed", robot="toy", seed=ground.seed)
    assert (ground.start, ground.goal) == (made.start, made.goal)


def test_planning_may_see_another_map_than_the_truth(make_rolling):
    truth, other = (make_terrain(name, robot="toy", seed=1) for name in ("flat", "gaps"))
    zoo = {"steps": make_rolling("steps")}
    misled = Ground(terrain=other, seeds=(1, 2), seen=truth.elevation)
    trials = drive([misled], {"ours": ours}, zoo, follow=FollowConfig(patience=0.0, grace=1.0))
    assert [trial.outcome for trial in trials] == ["timeout", "timeout"]  # after one second
    assert [trial.seed for trial in trials] == [1, 2] and trials[0].seconds == pytest.approx(1.0)


def test_summary_by_hand():
    outcomes = ("reached", "reached", "fell", "no_route")
    trials = [
        asdict(Trial(terrain="t", policy="p", ground=1, seed=i, outcome=outcome))
        for i, outcome in enumerate(outcomes)
    ]
    row = summarise(trials)
    assert row["successes"] == 2 and row["failures"] == {"no_route": 1, "fell": 1, "timeout": 0}
    assert row["ci95"] == pytest.approx([0.15, 0.85], abs=0.005)  # Wilson's interval for 2 of 4
    assert table(trials) == "| terrain | p |\n| --- | --- |\n| t | 50 (15-85) |"


def test_cost_by_hand():
    cost = Cost(maps=1000, episodes=300_000, seconds=36_000)
    assert "1,000 maps" in cost.on(4) and "2.5 h on 4 cores" in cost.on(4)
    assert "37.5 min on 16 cores" in cost.on(16)


def test_wrong_names_are_refused_before_anything_runs(config):
    with pytest.raises(TerrainError, match="moon"):
        evaluate(replace(config, terrains=("flat", "moon")))
    with pytest.raises(ConfigError, match="wings"):
        evaluate(replace(config, policies=("wings",)))
    with pytest.raises(ConfigError, match="trials"):
        MatrixConfig(trials=0)
    with pytest.raises(ConfigError, match="planner named wings"):
        ablation.evaluate(AblationConfig(planners=("wings",), zoo=config.zoo))


def test_policies_come_in_the_tables_order(config, make_rolling):
    zoo = {name: make_rolling(name) for name in ("general", "steps", "gaps")}
    assert policies(config, zoo) == ("steps", "gaps", "ours", "general")
    assert policies(replace(config, policies=("ours", "gaps")), zoo) == ("gaps", "ours")


def test_rows_that_cannot_be_written_are_reported_before_the_work(config):
    (config.zoo.parent / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        run(replace(config, json=config.zoo.parent / "file" / "rows.json"))


@pytest.mark.slow
def test_the_ablation_has_a_line_a_planner(zoo, capsys):
    config = AblationConfig(trials=2, terrain="flat", zoo=zoo, workers=1, out=zoo.parent / "report")
    assert ablation.run(config) == 0
    printed = capsys.readouterr().out
    lines = [line.split(" | ")[0][2:] for line in printed.splitlines() if line.startswith("| ")]
    assert lines == [
        "planner", "---", "gaps", "steps", "ours", "general", "no-ood", "no-heading", "no-fusion",
        "traversability", "traversability+P", "occupancy", "occupancy+P",
    ]  # fmt: skip
    # gaps refuses (f = 0.05 < f_min); all others find flat ground easy, with nothing to switch to.
    assert "| gaps | 0 (0-66) | 2 | 0 | 0 | - | - |" in printed
    rows = {row["policy"]: row for row in ablation.evaluate(config)}  # from the folder
    assert [rows[name]["successes"] for name in ("ours", "no-fusion", "occupancy+P")] == [2, 2, 2]
    assert "22 trials in all" in (config.out / "table.md").read_text()


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"terrains": ("steps", "gaps", "steps")}, "terrains: give each only once"),
        ({"policies": ("ours", "ours")}, "policies: give each only once"),
        ({"trials": 0}, "trials: "),
        ({"trials": 10**9}, "trials: "),
        ({"difficulty": float("nan")}, "difficulty: "),
        ({"difficulty": 1.5}, "difficulty: "),
        ({"switch_cost": -1.0}, "switch_cost: "),
        ({"switch_cost": float("inf")}, "switch_cost: "),
        ({"f_min": 0.0}, "f_min: "),
        ({"f_min": 2.0}, "f_min: "),
        ({"seed": -1}, "seed: "),
        ({"taus": "mine"}, "taus: "),
        ({"workers": -1}, "workers: "),
    ],
)
def test_settings_that_cannot_work_are_refused(fields, says):
    with pytest.raises(ConfigError, match=f"^{says}"):
        MatrixConfig(**fields)


def test_a_terrain_given_twice_is_one_line_on_the_command_line(capsys):
    words = "evaluate matrix --terrains steps steps --trials 1"
    assert main(words.split()) == 2
    assert "terrains: give each only once, 'steps' is there twice" in capsys.readouterr().err
