"""Trainings as tasks: the same rows however they were run, stopped or killed."""

import json
import os
import signal
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from fgtutor import __main__ as cli
from fgtutor.errors import (
    CheckpointError,
    ConfigError,
    EvaluationError,
    ReportError,
    SpecialistError,
    StorageError,
    TerrainError,
)
from fgtutor.evaluation import sweep
from fgtutor.evaluation.cost import Cost
from fgtutor.evaluation.sweep import (
    A1SweepConfig,
    SweepConfig,
    config_of,
    estimate,
    make_tasks,
    table,
    trainings,
)
from fgtutor.evaluation.tasks import run_tasks
from fgtutor.learning import training
from fgtutor.learning.config import A1TrainConfig, TrainConfig
from fgtutor.specialist import load_specialist

TINY = TrainConfig(
    num_envs=4, steps=8, rows=2, columns=2, label_seconds=0.12, save_every=2, iterations=6
)


@pytest.fixture
def config(tmp_path):
    return SweepConfig(
        out=tmp_path / "sweep", terrains=("steps",), seeds=(1, 2), trials=2, train=TINY, workers=1
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of an unbroken sweep of two seeds."""
    out = tmp_path_factory.mktemp("whole") / "sweep"
    config = SweepConfig(
        out=out, terrains=("steps",), seeds=(1, 2), trials=2, train=TINY, workers=1
    )
    assert sweep.run(config) == 0
    return out


def same(one: Path, other: Path) -> bool:
    """Tell whether two sweeps gave the same rows, table and specialists, to the last byte."""
    names = ["rows.json", "table.md"]
    for run in (one / "runs").iterdir():
        names += [
            f"runs/{run.name}/specialist/{net}.safetensors" for net in ("policy", "feasibility")
        ]
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


def test_the_robot_decides_the_sizes():
    assert config_of(["--robot", "a1"])().train == A1TrainConfig()
    assert config_of(["--seeds", "1"])().train == TrainConfig()
    assert A1SweepConfig().robot == "a1"
    # One that has no sizes of its own takes the toy's, as `fgtutor train` does.
    (_, train), *_ = trainings(SweepConfig(robot="a1")).values()
    assert train == TrainConfig(robot="a1", seed=1, out=train.out)


@pytest.mark.parametrize("words", [["--train.terrain", "steps"], ["--train.seed=1"]])
def test_what_the_sweep_sets_is_refused_even_as_the_default(words, capsys):
    assert cli.main(["sweep", *words]) == cli.USAGE
    assert "of its trainings: use --" in capsys.readouterr().err


def test_it_starts_from_where_a_training_would_write_by_default(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start = TrainConfig(start_from=Path("runs/toy-steps-seed1/specialist"))
    (_, train) = trainings(replace(config, train=start))["steps-1"]
    assert train.start_from == tmp_path / "runs/toy-steps-seed1/specialist"


def test_every_terrain_value_and_seed_is_a_training(config, tmp_path):
    config = replace(
        config, terrains=("steps", "gaps"), vary=("learning-rate", "1e-3", "5e-4"), seeds=(3, 4)
    )
    works = trainings(config)
    assert list(works) == [
        f"{terrain}-learning-rate-{value}-{seed}"
        for terrain in ("steps", "gaps")
        for value in ("1e-3", "5e-4")
        for seed in (3, 4)
    ]
    name, (value, last) = works.popitem()
    assert (last.terrain, last.learning_rate, last.seed) == ("gaps", 5e-4, 4)
    assert value == "5e-4" and last.folder == config.folder / "runs" / name
    rest = ("terrain", "seed", "out", "learning_rate")
    theirs, mine = asdict(last), asdict(TINY)
    assert {k: v for k, v in theirs.items() if k not in rest} == {
        k: v for k, v in mine.items() if k not in rest
    }


def test_values_of_several_words_and_paths(config):
    works = trainings(replace(config, seeds=(1,), vary=("hidden", "8 4", "16")))
    assert {name: train.hidden for name, (_, train) in works.items()} == {
        "steps-hidden-8_4-1": (8, 4),
        "steps-hidden-16-1": (16,),
    }
    speeds = trainings(replace(config, seeds=(1,), vary=("speed", "0.5 0.9", "0.6 1.0")))
    assert [train.speed for _, train in speeds.values()] == [(0.5, 0.9), (0.6, 1.0)]
    actors = trainings(replace(config, seeds=(1,), vary=("actor", "perceptive", "dreamwaq")))
    assert [train.actor for _, train in actors.values()] == ["perceptive", "dreamwaq"]


def test_by_default_the_robots_own_terrains(config):
    names = trainings(replace(config, terrains=(), seeds=(1,)))
    assert list(names) == ["steps-1", "gaps-1", "slopes-1", "rubble-1"]


def test_a_task_takes_the_cores_and_the_gpu_of_its_training(config):
    def takes(config):
        return [(task.cores, task.gpus) for task in make_tasks(config)]

    assert takes(config) == [(1, 0)] * 2
    large = replace(TINY, threads=4, device="cuda:0")
    assert takes(replace(config, train=large)) == [(4, 1)] * 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"out": None}, "give --out FOLDER"),
        ({"trials": 0}, "^trials: "),
        ({"seeds": ()}, "^seeds: .* at least 1 item"),
        ({"seeds": (1, 1)}, "give each only once, 1 is there twice"),
        ({"seeds": (-1,)}, "seeds: 0: should be greater than or equal to 0"),
        ({"train": TrainConfig(seed=7)}, "sets seed of its trainings: use --seeds"),
        ({"train": TrainConfig(terrain="gaps")}, "sets terrain .* use --terrains"),
        ({"train": TrainConfig(resume=True)}, "goes on by itself"),
        ({"train": TrainConfig(hours=1.0)}, "train.iterations"),
        ({"train": TrainConfig(out=Path("x"))}, "use --out"),
        ({"train": TrainConfig(robot="a1")}, "sets robot .* use --robot"),
        ({"vary": ("gamma",)}, "nothing to vary gamma by"),
        ({"vary": ("seed", "1", "2")}, "sets seed .* use --seeds"),
        ({"vary": ("from", "a", "b")}, "a sweep for each --train.from"),
    ],
)
def test_settings_that_cannot_work_are_refused(config, changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(config, **changes)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"vary": ("gamma", "0.9", "0.9")}, ConfigError, "asked twice"),
        ({"vary": ("pace", "1")}, ConfigError, "cannot vary pace: `fgtutor train --help`"),
        ({"vary": ("gamma", "much")}, ConfigError, "--gamma much: .* valid number"),
        (
            {"vary": ("iterations", "0")},
            ConfigError,
            "iterations: should be greater than or equal to 1, got 0",
        ),
        ({"terrains": ("moon",)}, TerrainError, "moon"),
        ({"robot": "horse", "train": TrainConfig(robot="horse")}, ConfigError, "horse"),
        ({"train": replace(TINY, start_from=Path("nobody"))}, SpecialistError, "nobody holds no"),
    ],
)
def test_a_mistake_is_told_before_anything_trains(config, changes, error, message, capfd):
    with pytest.raises(error, match=message):
        sweep.run(replace(config, **changes))
    assert not config.folder.exists()
    assert not capfd.readouterr().err  # tyro writes messages of its own


def rows_of(terrain, setting, seed, outcomes, **more):
    known = {"trained_on": terrain, "setting": setting, "training_seed": seed, "samples": 1000}
    return [known | more | {"terrain": terrain, "outcome": outcome} for outcome in outcomes]


def test_table_by_hand():
    rows = [
        *rows_of("gaps", "0.1", 1, ["reached"] * 4, r_v=0.5, calibration_error=0.02),
        *rows_of("gaps", "0.1", 5, ["fell", "reached"] * 2, r_v=0.7, calibration_error=0.04),
        *rows_of("gaps", "0.2", 1, ["fell"] * 4, r_v=0.1, calibration_error=0.0),
        *rows_of("gaps", "0.2", 5, ["timeout"] * 4, r_v=0.3, calibration_error=0.0),
    ]
    assert table(rows, "gamma").splitlines() == [
        "| terrain | gamma | samples | seed 1 | seed 5 | mean | r_v | calibration error |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
        "| gaps | 0.1 | 1,000 | 100 (51-100) | 50 (15-85) | 75.0 | 0.600 | 0.030 |",
        "| gaps | 0.2 | 1,000 | 0 (0-49) | 0 (0-49) | 0.0 | 0.200 | 0.000 |",
    ]


def test_a_value_that_fits_no_training_is_told_before_any(config):
    config = replace(config, vary=("steps", "8", "1"))
    with pytest.raises(ConfigError, match="rollouts of 1 steps never see half"):
        sweep.run(config)
    assert not list(config.folder.rglob("*"))


def test_a_folder_that_cannot_be_written_is_told_at_once(config, monkeypatch):
    monkeypatch.setattr(sweep, "estimate", lambda config: pytest.fail("this takes a while"))
    config.folder.write_text("in the way")
    with pytest.raises(StorageError, match=r"cannot write .*/sweep: "):
        sweep.run(config)


@pytest.mark.slow
def test_cost_is_measured(config):
    cost = estimate(replace(config, vary=("iterations", "4", "6")))
    assert cost.work == f"4 trainings with {2 * (4 + 6) * 4 * 8} samples, at least"
    assert cost.parts == 4 and cost.seconds > 0
    assert not config.folder.exists()  # nothing of it is kept


@pytest.mark.slow
def test_a_sweep_leaves_specialists_and_a_report(whole, capsys):
    rows = json.loads((whole / "rows.json").read_text())
    assert [(row["training"], row["ground"]) for row in rows] == [
        ("steps-1", 1),
        ("steps-1", 3),
        ("steps-2", 1),
        ("steps-2", 3),
    ]
    assert all(row["samples"] == 6 * 4 * 8 and 0 <= row["r_v"] <= 1 for row in rows)
    for seed in (1, 2):
        specialist = load_specialist(whole / f"runs/steps-{seed}/specialist")
        assert specialist.provenance["seed"] == seed and specialist.provenance["iteration"] == 6
    text = (whole / "table.md").read_text()
    assert "| terrain | samples | seed 1 | seed 2 | mean |" in text and "4 trials in all" in text
    assert (whole / "figures" / "success.svg").read_text().count(" of 2 -->") == 2
    assert json.loads((whole / "run.json").read_text())["settings"]["train.iterations"] == 6


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(whole, config, capsys, monkeypatch):
    monkeypatch.setattr(sweep, "WATCH_SECONDS", 0.01)
    assert sweep.run(replace(config, workers=2)) == 0
    assert same(whole, config.folder)
    printed, bars = capsys.readouterr()
    assert "| 12/12 [" in bars  # iterations, as they came
    assert "2 of 2 tasks to do; all of them: 2 trainings with 384 samples" in printed
    assert f"tensorboard --logdir {config.folder / 'runs'}" in printed


# Workers import it, so it lives in a module of its own, on the path.
KILLED = """
import os, signal
from fgtutor.evaluation import sweep
from fgtutor.learning.training import Trainer

def killed_once(name, value, config, trials):
    if not config.folder.exists():
        iterate = Trainer.iterate

        def dying(trainer):
            if trainer.iteration == 3:  # after the checkpoint of iteration 2
                (config.folder / "died").touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return iterate(trainer)

        Trainer.iterate = dying
    return sweep.run_task(name, value, config, trials)
"""


@pytest.fixture
def killed_once(tmp_path, monkeypatch):
    (tmp_path / "fgtutor_killed.py").write_text(KILLED)
    monkeypatch.syspath_prepend(tmp_path)
    # A local Ray cluster's workers find modules through this variable only.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, sys.path)]))
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # or it writes a token into the home folder
    yield __import__("fgtutor_killed").killed_once
    del sys.modules["fgtutor_killed"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
@pytest.mark.parametrize("where", [{"workers": 2}, {"ray": "local"}], ids=["processes", "ray"])
def test_a_killed_worker_costs_no_bit(whole, config, killed_once, where, monkeypatch):
    if "ray" in where:
        pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    monkeypatch.setattr(sweep, "run_task", killed_once)
    assert sweep.run(replace(config, **{"workers": 0} | where)) == 0
    assert all((config.folder / f"runs/steps-{seed}/died").exists() for seed in (1, 2))
    assert same(whole, config.folder)


@pytest.mark.slow
def test_interrupted_and_gone_on_is_the_same(whole, config, monkeypatch):
    iterate = training.Trainer.iterate

    def asked_to_stop(trainer):
        if trainer.iteration == 4:  # the next checkpoint is due after two more
            signal.raise_signal(signal.SIGINT)
        return iterate(trainer)

    # Its iterations would be interrupted first.
    cost = Cost(work="2 trainings", seconds=1.0)
    monkeypatch.setattr(sweep, "estimate", lambda config: cost)
    monkeypatch.setattr(training.Trainer, "iterate", asked_to_stop)
    # A process that a shell has put into the background ignores Ctrl-C, and these tests may be one.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            sweep.run(config)
    finally:
        signal.signal(signal.SIGINT, before)
    monkeypatch.undo()
    assert (config.folder / "runs/steps-1/snapshots/4").exists()
    assert not list((config.folder / "shards").iterdir())  # half a training is no result
    assert sweep.run(config) == 0
    assert same(whole, config.folder)


@pytest.mark.slow
def test_more_seeds_and_values_in_the_same_folder_train_only_the_new(config, monkeypatch):
    trained, train = [], training.train

    def noted(config, **more):
        trained.append(config.out.name)
        return train(config, **more)

    monkeypatch.setattr(training, "train", noted)
    config = replace(config, seeds=(1,), trials=1)
    assert sweep.run(config) == 0
    assert sweep.run(replace(config, seeds=(1, 2))) == 0
    assert trained == ["steps-1", "steps-2"]
    snapshots = sorted(config.folder.glob("runs/*/snapshots/*"))
    assert sweep.run(replace(config, trials=3)) == 0  # crosses again, but trains no more
    assert len(json.loads((config.folder / "rows.json").read_text())) == 3
    assert sorted(config.folder.glob("runs/*/snapshots/*")) == snapshots
    with pytest.raises(ReportError, match=r"other settings \(train.gamma was 0.98 and is 0.9\)"):
        sweep.run(replace(config, train=replace(TINY, gamma=0.9)))


@pytest.mark.slow
def test_a_generalist_crosses_every_kind(config):
    config = replace(config, terrains=("general",), seeds=(1,), trials=5)
    ((_, result),) = run_tasks(make_tasks(config), workers=1)
    # What the plan refuses comes first.
    crossed = sorted(row["terrain"] for row in result.rows)
    assert crossed == ["gaps", "rubble", "slopes", "steps", "steps"]
    assert {row["policy"] for row in result.rows} == {"general"}


@pytest.mark.slow
def test_a_training_that_cannot_go_on_is_named(config):
    (value, train) = trainings(config)["steps-1"]
    training.train(replace(train, gamma=0.5, iterations=2), attended=False)
    with pytest.raises(EvaluationError, match=r"training steps-1: .*gamma was 0.5") as caught:
        sweep.run_task("steps-1", value, train, 1)
    assert isinstance(caught.value.__cause__, CheckpointError)
