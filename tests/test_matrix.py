import json
from dataclasses import replace

import numpy as np
import pytest

from fgtutor.__main__ import main
from fgtutor.baselines import ours
from fgtutor.errors import ConfigError, ReportError, SpecialistError, TerrainError
from fgtutor.evaluation import ablation, success
from fgtutor.evaluation.ablation import AblationConfig
from fgtutor.evaluation.cost import Cost, estimate
from fgtutor.evaluation.matrix import MatrixConfig, forced, policies, run, table, walk_task
from fgtutor.evaluation.shards import collect
from fgtutor.evaluation.success import (
    make_ground,
    make_tasks,
    run_task,
    terrain_seed,
    with_random_ends,
)
from fgtutor.evaluation.trials import (
    Ground,
    TrialRow,
    by_cell,
    drive,
    drive_plans,
    failures,
    plan_all,
)
from fgtutor.execution import FollowConfig
from fgtutor.settings import PlanSettings
from fgtutor.statistics import Share
from fgtutor.world.terrain import make_terrain

POLICIES = ("gaps", "steps", "ours", "general")
ROW = [
    "terrain", "policy", "ground", "seed", "outcome", "length", "seconds", "switches", "promise"
]  # fmt: skip


@pytest.fixture
def config(zoo):
    return MatrixConfig(trials=3, terrains=("flat", "gaps"), zoo=zoo, workers=1)


def evaluate(config, policies=POLICIES):
    """Return the trials of a table, as the command would drive them."""
    tasks = make_tasks(config, config.terrains, policies, run_task)
    return collect(tasks, {}, config).rows


@pytest.mark.slow
def test_rows_name_every_outcome(config):
    rows = evaluate(config)
    cells = by_cell(rows)
    assert list(cells) == [(terrain, policy) for terrain in ("flat", "gaps") for policy in POLICIES]
    for cell in cells.values():
        assert all(list(row) == ROW for row in cell)
        assert len(cell) == 3 == Share.reached(cell).successes + sum(failures(cell))
    # On flat ground rolling is enough; a policy that predicts f = 0.05 refuses everywhere (f_min).
    for policy in ("steps", "ours"):
        assert [row["outcome"] for row in cells["flat", policy]] == ["reached"] * 3
    assert failures(cells["flat", "gaps"]) == [3, 0, 0]
    # A rolling toy that believes in itself drops an axle into the first gap, and hangs there.
    refused, *failed = failures(cells["gaps", "steps"])
    assert refused == 0 and sum(failed) == 3
    # A part of the table is that part of the whole.
    part = evaluate(replace(config, terrains=("flat",)), ("ours",))
    assert part == cells["flat", "ours"]


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(config, monkeypatch):
    monkeypatch.setattr(success, "GROUNDS", 2)
    config = replace(config, terrains=("flat",))
    alone, together = (evaluate(replace(config, workers=workers), ("ours",)) for workers in (1, 2))
    assert len(alone) == 3 and alone == together  # every length, to the millimetre


@pytest.mark.slow
def test_another_zoo_and_other_settings_are_another_run(config):
    config = replace(config, trials=1, terrains=("flat",), policies=("steps",))
    config = replace(config, out=config.zoo.parent / "out")
    run(config)
    with pytest.raises(ReportError, match=r"f_min was .* and is 0\.2"):
        run(replace(config, f_min=0.2))
    description = config.zoo / "steps" / "specialist.json"
    description.write_text(description.read_text() + "\n")
    with pytest.raises(ReportError, match="zoo was"):
        run(config)


@pytest.mark.slow
def test_more_trials_in_the_same_folder_drive_only_the_new_ones(config, monkeypatch):
    monkeypatch.setattr(success, "GROUNDS", 2)
    few = replace(config, terrains=("flat",), policies=("steps",), out=config.zoo.parent / "few")
    run(few)
    more = replace(few, trials=5)
    run(replace(more, out=config.zoo.parent / "more"))
    drawn, make = [], success.make_ground
    monkeypatch.setattr(success, "make_ground", lambda *w: drawn.append(w[-1]) or make(*w))
    assert rows_in(config.zoo.parent / "more") != rows_in(few.out)
    run(more)
    assert rows_in(more.out) == rows_in(config.zoo.parent / "more")
    # Of the second task only one ground was there; the first one of all is for the estimate.
    assert drawn == [0, 2, 3, 4]
    run(few)
    assert len(rows_in(few.out)) == 3 and drawn == [0, 2, 3, 4]
    # By the paper's protocol, a ground stands for every 40th of the trials.
    run(replace(few, protocol="paper", out=config.zoo.parent / "paper"))
    with pytest.raises(ReportError, match="trials was 3 and is 5"):
        run(replace(more, protocol="paper", out=config.zoo.parent / "paper"))


def rows_in(folder):
    return json.loads((folder / "rows.json").read_text())


@pytest.mark.slow
def test_the_command_writes_rows_and_a_report_and_prints_a_table(config, capsys):
    folder = config.zoo.parent / "report"
    config = replace(config, terrains=("flat",), out=folder)
    assert run(config) == 0
    printed = capsys.readouterr().out
    line = "| flat | 0 (0-56) | 100 (44-100) | 100 (44-100) | 100 (44-100) |"
    assert line in printed and "3 trials per cell" in printed
    # Three maps for each of three policies of the zoo, three episodes for each of four columns.
    assert "1 of 1 tasks to do" in printed and "9 maps" in printed and "12 episodes" in printed
    assert "on 1 core like this one" in printed

    trials = rows_in(folder)
    assert len(trials) == 12 and set(trials[0]) == set(TrialRow.__annotations__)
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


def test_a_run_is_known_by_each_setting_and_not_by_how_it_was_given():
    ours = MatrixConfig().run_settings("evaluate matrix")
    assert MatrixConfig(switch_cost=1.0, taus="calibrated").run_settings("evaluate matrix") == ours
    paper = MatrixConfig(settings="paper").run_settings("evaluate matrix")
    assert {name for name in ours if ours[name] != paper[name]} == {
        "taus", "cost", "switch_cost", "hold_steps", "least_promise",
    }  # fmt: skip


def test_evaluation_never_draws_a_training_seed():
    seeds = {terrain_seed(seed, trial) for seed in range(3) for trial in range(500)}
    assert len(seeds) == 1500 and all(seed % 2 == 1 for seed in seeds)


def test_the_papers_protocol_is_300_000_trials(config):
    config = MatrixConfig(protocol="paper", robot="a1")
    assert config.count == 10_000 and config.grounds == 40
    six = ("bridge", "gaps", "steps", "valley", "ours", "general")
    terrains = ("steps", "gaps", "bridge", "valley", "mixed")
    tasks = make_tasks(config, terrains, six, run_task)
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
    plans = plan_all(ours, [misled], [misled.assess(zoo, PlanSettings())], PlanSettings())
    follow = FollowConfig(patience=0.0, grace=1.0)
    trials = list(drive_plans("ours", plans, zoo, follow))
    assert [trial.outcome for trial in trials] == ["timeout", "timeout"]  # after one second
    assert [trial.seed for trial in trials] == [1, 2]
    assert trials[0].row["seconds"] == pytest.approx(1.0)


def test_a_trial_says_what_was_planned_and_how_it_ended(make_rolling):
    ground = Ground(terrain=make_terrain("flat", robot="toy", seed=1), seeds=(1,))
    zoo = {"steps": make_rolling("steps")}
    (trial,) = drive([ground], {"ours": ours}, zoo, settings=PlanSettings())
    assert trial.terrain == "flat" and trial.route is trial.planned.answer
    assert trial.row == {
        "terrain": "flat", "policy": "ours", "ground": 1, "seed": 1, "outcome": "reached",
        "length": trial.length, "seconds": round(trial.episode.seconds, 3), "switches": 0,
        "promise": round(trial.route.promise, 4),
    }  # fmt: skip
    (refused,) = drive([ground], {"ours": ours}, zoo, settings=PlanSettings(f_min=0.99))
    assert (refused.route, refused.episode, refused.outcome) == (None, None, "no_route")
    assert (refused.length, refused.row["seconds"], refused.row["switches"]) == (0.0, 0.0, 0)


def test_the_table_by_hand():
    outcomes = ("reached", "reached", "fell", "no_route")
    trials = [{"terrain": "t", "policy": "p", "outcome": outcome} for outcome in outcomes]
    assert failures(trials) == [1, 1, 0]
    # Wilson's interval for 2 of 4.
    assert table(trials) == "| terrain | p |\n| --- | --- |\n| t | 50 (15-85) |"


def test_cost_by_hand():
    cost = Cost(work="1,000 maps, at most", seconds=36_000)
    assert cost.on(1) == "1,000 maps, at most about 10.0 h on 1 core like this one"
    assert "2.5 h on 4 cores" in cost.on(4) and "38 min on 16 cores" in cost.on(16)
    # Five parts of an hour each take two cores three hours, and eight cores one.
    cost = Cost(work="5 trainings, at least", seconds=5 * 3600, parts=5)
    assert "about 3.0 h on 2 cores" in cost.on(2) and "about 60 min on 8 cores" in cost.on(8)


def test_wrong_names_are_refused_before_anything_runs(config):
    with pytest.raises(TerrainError, match="moon"):
        run(replace(config, terrains=("flat", "moon")))
    with pytest.raises(SpecialistError, match="no zoo for robot 'wheelbarrow'"):
        run(MatrixConfig(robot="wheelbarrow"))
    with pytest.raises(ConfigError, match="policy named wings"):
        run(replace(config, policies=("wings",)))
    with pytest.raises(ConfigError, match="trials"):
        MatrixConfig(trials=0)
    with pytest.raises(ConfigError, match="planner named wings"):
        ablation.run(AblationConfig(planners=("wings",), zoo=config.zoo))


def test_policies_come_in_the_tables_order(config, make_rolling):
    zoo = {name: make_rolling(name) for name in ("general", "steps", "gaps")}
    assert policies(config, zoo) == ("steps", "gaps", "ours", "general")
    assert policies(replace(config, policies=("ours", "gaps")), zoo) == ("gaps", "ours")


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
    cells = by_cell(rows_in(config.out), ("policy",))
    for name in ("ours", "no-fusion", "occupancy+P"):
        assert Share.reached(cells[name,]) == Share(successes=2, trials=2)
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


@pytest.mark.slow
def test_policies_that_may_not_refuse_walk_straight_or_our_route(config):
    zoo = config.load_zoo()
    assert policies(config, zoo) == ("gaps", "steps", "ours", "general")
    straight, along = (replace(config, walk=walk) for walk in ("straight", "ours"))
    assert policies(straight, zoo) == ("gaps", "steps", "general")
    walked = walk_task(straight, "flat", ("gaps", "steps"), range(2))
    # The policy that says it can do nothing rolls as well as the other: its refusal is not asked.
    assert [row["outcome"] for row in walked] == ["reached"] * 4
    assert [row["policy"] for row in walked] == ["gaps", "gaps", "steps", "steps"]
    assert [row["length"] for row in walked[:2]] == [row["length"] for row in walked[2:]]
    assert {row["outcome"] for row in walk_task(straight, "gaps", ("gaps",), range(2))} == {"fell"}
    led = walk_task(along, "flat", ("gaps",), range(2))
    assert [row["outcome"] for row in led] == ["reached"] * 2


@pytest.mark.slow
def test_our_route_is_walked_by_one_policy_and_a_refusal_stays_one(config):
    terrain = make_terrain("flat", seed=1)
    grounds, zoo = [Ground(terrain=terrain, seeds=(1,))], config.load_zoo()
    maps = [ground.assess(zoo, config.planning) for ground in grounds]
    (plan,) = plan_all(ours, grounds, maps, config.planning)
    alone = forced(plan, "gaps")
    assert alone.answer.names == ("gaps",) and not alone.answer.policies.any()
    assert (alone.answer.cells == plan.answer.cells).all() and alone.ground is plan.ground
    (none,) = plan_all(ours, grounds, maps, PlanSettings(f_min=0.99))
    assert forced(none, "gaps") is none


@pytest.mark.slow
def test_disturbed_tables_say_so_and_are_other_runs(config, capsys):
    config = replace(config, terrains=("flat",), policies=("steps",), trials=2)
    plain, hurt = (
        replace(config, disturbed=flag, out=config.zoo.parent / name)
        for flag, name in ((False, "plain"), (True, "hurt"))
    )
    run(plain)
    said = capsys.readouterr().out
    assert "; undisturbed; gaps, general, steps at 0.85 m/s; told its exact velocity" in said
    run(hurt)
    assert "friction 0.8, 2 kg more" in capsys.readouterr().out
    assert "disturbed" in (hurt.out / "table.md").read_text().splitlines()[0]
    lengths = [[row["length"] for row in rows_in(one.out)] for one in (plain, hurt)]
    assert lengths[0] != lengths[1]
    stored = json.loads((hurt.out / "run.json").read_text())["settings"]["condition"]
    assert stored["model"]["friction"] == 0.8
    with pytest.raises(ReportError, match="condition was"):
        run(replace(hurt, disturbed=False))


def test_the_time_to_drive_is_that_of_the_slowest_policy(make_rolling):
    ground = make_terrain("flat", robot="toy", seed=1)

    def seconds(other: float) -> float:
        zoo = {
            name: make_rolling(name, command=(speed, 0.0, 0.0))
            for name, speed in (("first", 1.0), ("other", other))
        }
        return estimate(zoo, [ground], grounds=0, episodes=100).seconds

    # A second of driving is measured anew each time, and the ratio asked for is 50.
    assert seconds(0.02) > 10 * seconds(1.0)
