import dataclasses
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
import weakref

import pytest
import torch

from fgtutor.errors import CheckpointError, ConfigError, StorageError
from fgtutor.feasibility import FeasibilityNet, feasibility_labels
from fgtutor.learning.checkpoints import read_checkpoint, write_checkpoint
from fgtutor.learning.config import (
    A1TrainConfig,
    TrainConfig,
    config_of,
    make_training_env,
    training_world,
)
from fgtutor.learning.trainer import Trainer
from fgtutor.learning.training import train
from fgtutor.robots.toy import ToyEnv
from fgtutor.specialist import load_specialist, save_specialist

TINY = {
    "num_envs": 4,
    "steps": 8,
    "rows": 2,
    "columns": 2,
    "label_seconds": 0.12,
    "save_every": 2,
    "iterations": 6,
}


def tracking(*steps):
    """One robot's (r_v, failed, ended) per step."""
    return torch.tensor(steps, dtype=torch.float32)[:, None]


def test_labels_average_the_steps_ahead():
    label, valid = feasibility_labels(
        tracking((9, 0, 0), (0.2, 0, 0), (0.4, 0, 0), (0.9, 0, 0), (0.1, 0, 0)), 2
    )
    # At t = 0 the next two steps gave 0.2 and 0.4; at t = 3 one of two was seen, at t = 4 none.
    assert label[:4, 0].tolist() == pytest.approx([0.3, 0.65, 0.5, 0.1])
    assert valid[:, 0].tolist() == [True, True, True, True, False]


def test_a_failure_makes_the_rest_of_its_window_zero_and_hides_the_next_episode():
    label, valid = feasibility_labels(
        tracking((9, 0, 0), (0.8, 0, 0), (0, 1, 1), (1, 0, 0), (1, 0, 0), (1, 0, 0)), 4
    )
    # From t = 0: 0.8, then the fall, then nothing: 0.8 / 4. From t = 1: 0. From t = 2 all is new.
    assert label[:3, 0].tolist() == pytest.approx([0.2, 0.0, 1.0])
    assert valid[:3].all()


def test_a_failure_counts_even_if_the_rollout_ends_soon_after():
    label, valid = feasibility_labels(tracking((9, 0, 0), (0.8, 0, 0), (0, 1, 1)), 10)
    assert label[0, 0] == pytest.approx(0.08) and valid[0, 0]


def test_a_partial_failure_reaches_back_over_its_share_of_the_window_only():
    label, valid = feasibility_labels(
        tracking((9, 0, 0), *[(0.8, 0, 0)] * 4, (0.8, 0.25, 1), (1, 0, 0)), 8
    )
    # Five steps away it cuts the window short, and still does two away; there, with one left of
    # the two that it reaches back over, the other one is zero.
    assert label[:5, 0].tolist() == pytest.approx([0.8, 0.8, 0.8, 0.8, 0.4])
    assert valid[:5].all()


def test_a_time_out_cuts_the_window_without_zeros():
    label, valid = feasibility_labels(
        tracking((9, 0, 0), (0.6, 0, 0), (0.8, 0, 1), (0.1, 0, 0), (0.1, 0, 0)), 4
    )
    assert label[0, 0] == pytest.approx(0.7) and valid[0, 0]
    # One step of four was left before the time-out: too little to count.
    assert label[1, 0] == pytest.approx(0.8) and not valid[1, 0]


@pytest.mark.parametrize("window", [0, 1])
def test_the_instantaneous_label_is_the_next_step(window):
    label, valid = feasibility_labels(tracking((9, 0, 0), (0.3, 0, 0), (0.5, 0, 0)), window)
    assert label[:2, 0].tolist() == pytest.approx([0.3, 0.5])
    assert valid[:, 0].tolist() == [True, True, False]


def test_labels_agree_with_a_naive_loop():
    generator = torch.Generator().manual_seed(0)
    steps, envs, window = 40, 20, 7
    ended = torch.rand(steps, envs, generator=generator) < 0.08
    failed = ended & (torch.rand(steps, envs, generator=generator) < 0.5)
    r_v = torch.rand(steps, envs, generator=generator) * ~failed
    label, valid = feasibility_labels(torch.stack((r_v, failed, ended), -1).float(), window)
    for t in range(steps):
        for env in range(envs):
            seen = []
            for k in range(t + 1, min(t + window, steps - 1) + 1):
                seen.append(r_v[k, env].item())
                if failed[k, env]:
                    seen += [0.0] * (window - len(seen))
                if ended[k, env]:
                    break
            assert valid[t, env] == (len(seen) >= 4)
            if seen:
                assert label[t, env] == pytest.approx(sum(seen) / len(seen), abs=1e-6)


def run_in_subprocess(folder, resume, until=None):
    """Train in a process of its own; kill it (SIGKILL) once the checkpoint holds `until`."""
    settings = TINY | {"terrain": "steps", "resume": resume}
    code = (
        "import sys, json, pathlib; from fgtutor.learning.training import TrainConfig, train\n"
        f"train(TrainConfig(out=pathlib.Path({str(folder)!r}), **{settings!r}))"
    )
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code], stderr=subprocess.DEVNULL
    )
    checkpoint = folder / "checkpoint.pt"
    while until and process.poll() is None:
        if checkpoint.exists() and read_checkpoint(checkpoint)["iteration"] >= until:
            process.send_signal(signal.SIGKILL)
        time.sleep(0.01)
    return process.wait()


@pytest.mark.slow
def test_kill_and_resume_equals_an_unbroken_run_bit_for_bit(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert run_in_subprocess(whole, resume=False) == 0
    assert run_in_subprocess(broken, resume=False, until=2) == -signal.SIGKILL
    assert not (broken / "specialist").exists()
    assert run_in_subprocess(broken, resume=True) == 0
    for name in ("policy.safetensors", "feasibility.safetensors"):
        assert (whole / "specialist" / name).read_bytes() == (
            broken / "specialist" / name
        ).read_bytes()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    rows = []
    config = TrainConfig(out=folder, **TINY)
    return config, train(config, on_iteration=rows.append), rows


def test_training_writes_a_specialist_that_loads(trained):
    config, specialist, rows = trained
    loaded = load_specialist(config.folder / "specialist")
    assert loaded.name == "steps" and loaded.robot == "toy"
    assert loaded.provenance["samples"] == 6 * 4 * 8
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5, 6]
    for name, value in specialist.feasibility.state_dict().items():
        assert torch.equal(value, loaded.feasibility.state_dict()[name])


def test_training_moves_both_networks(trained):
    config, specialist, _ = trained
    fresh = Trainer(config)
    before = fresh.algorithm.get_policy().state_dict()
    assert any(not torch.equal(v, before[k]) for k, v in specialist.policy.state_dict().items())
    before = fresh.algorithm.feasibility.state_dict()
    after = specialist.feasibility.state_dict()
    assert all(not torch.equal(after[k], before[k]) for k in after)


def test_resuming_a_finished_run_changes_nothing(trained):
    config, specialist, _ = trained
    again = train(TrainConfig(out=config.folder, resume=True, **TINY))
    for name, value in specialist.policy.state_dict().items():
        assert torch.equal(value, again.policy.state_dict()[name])


def test_the_ppo_loss_never_reaches_the_feasibility_net(trained):
    config, _, _ = trained
    trainer = Trainer(config)
    ppo = {id(p) for group in trainer.algorithm.optimizer.param_groups for p in group["params"]}
    assert ppo.isdisjoint(id(p) for p in trainer.algorithm.feasibility.parameters())


@pytest.mark.parametrize(
    ("change", "message"),
    [({"terrain": "gaps"}, "terrain was 'steps', now 'gaps'"), ({"seed": 5}, "seed was 1, now 5")],
)
def test_a_checkpoint_of_another_run_is_refused(trained, change, message):
    config, _, _ = trained
    with pytest.raises(CheckpointError, match=message):
        train(TrainConfig(out=config.folder, resume=True, **TINY | change))


def test_a_run_starts_from_a_trained_policy_with_a_critic_of_its_own(trained, tmp_path):
    config, specialist, _ = trained
    start = config.folder / "specialist"
    settings = TINY | {"iterations": 3, "critic_warmup": 2, "warm_std": 0.125}
    trainer = Trainer(TrainConfig(out=tmp_path / "run", start_from=start, **settings))
    policy = trainer.algorithm.get_policy()

    def weights():
        return {k: v.clone() for k, v in policy.state_dict().items() if "distribution" not in k}

    first = weights()
    assert all(torch.equal(v, specialist.policy.state_dict()[k].cpu()) for k, v in first.items())
    assert policy.distribution.log_std_param.exp().mean().item() == pytest.approx(0.125)
    value = next(trainer.algorithm.critic.parameters()).clone()
    trainer.iterate()
    trainer.iterate()
    assert all(torch.equal(v, first[k]) for k, v in weights().items())
    assert not torch.equal(value, next(trainer.algorithm.critic.parameters()))
    row = trainer.iterate()
    assert any(not torch.equal(v, first[k]) for k, v in weights().items())
    assert row["samples"] == specialist.provenance["samples"] + 3 * 4 * 8


def test_a_trained_policy_learns_on_gently(trained, tmp_path):
    """In its first update it changes no more than in later ones: what it can do is not lost."""
    start = trained[0].folder / "specialist"
    settings = TINY | {"num_envs": 64, "critic_warmup": 1, "warm_std": 0.06}
    trainer = Trainer(TrainConfig(out=tmp_path / "run", start_from=start, **settings))
    policy = trainer.algorithm.get_policy()
    trainer.iterate()
    seen = trainer.env.get_observations()
    before, std = policy(seen).detach(), policy.distribution.log_std_param.exp().detach()
    trainer.iterate()
    kl = ((policy(seen).detach() - before) / std).square().sum(-1).mean() / 2
    assert kl < 0.05


def test_from_a_run_its_critic_and_net_come_along_and_nothing_warms_up(trained, tmp_path):
    config, specialist, _ = trained
    killed = shutil.copytree(config.folder, tmp_path / "killed")
    shutil.rmtree(killed / "specialist")  # which a run writes when it ends
    settings = TINY | {"iterations": 3, "start_from": killed, "easiest": 0.5}
    trainer = Trainer(TrainConfig(out=tmp_path / "run", **settings))
    critic = read_checkpoint(config.folder / "checkpoint.pt")["algorithm"]["critic_state_dict"]
    policy, mine = trainer.algorithm.get_policy(), trainer.algorithm.critic.state_dict()
    assert critic and all(torch.equal(value, mine[name]) for name, value in critic.items())
    net, theirs = trainer.algorithm.feasibility.state_dict(), specialist.feasibility.state_dict()
    assert all(torch.equal(value.cpu(), net[name]) for name, value in theirs.items())
    other = Trainer(TrainConfig(out=tmp_path / "other", **settings | {"terrain": "rubble"}))
    net = other.algorithm.feasibility.state_dict()
    assert any(not torch.equal(value.cpu(), net[name]) for name, value in theirs.items())
    first = {k: v.clone() for k, v in policy.state_dict().items() if "distribution" not in k}
    assert all(torch.equal(v, specialist.policy.state_dict()[k].cpu()) for k, v in first.items())
    trainer.iterate()
    assert any(not torch.equal(v, policy.state_dict()[k]) for k, v in first.items())


@pytest.mark.slow
def test_a_resumed_run_knows_what_it_started_from_and_goes_on_beyond_its_end(trained, tmp_path):
    start = shutil.copytree(trained[0].folder / "specialist", tmp_path / "start")
    settings = TINY | {"iterations": 1, "critic_warmup": 2, "warm_std": 0.125}
    first = train(TrainConfig(out=tmp_path / "run", start_from=start, **settings))
    shutil.rmtree(start)
    settings |= {"iterations": 3, "out": tmp_path / "run", "resume": True}
    trainer = Trainer(TrainConfig(**settings))
    trainer.resume()
    policy = trainer.algorithm.get_policy()
    assert trainer.config.start_from == start and not next(policy.parameters()).requires_grad
    assert trainer.samples == first.provenance["samples"]
    assert trainer.iterate()["samples"] == first.provenance["samples"] + 4 * 8
    went_on = train(TrainConfig(**settings))
    assert went_on.provenance["samples"] == first.provenance["samples"] + 2 * 4 * 8
    assert went_on.provenance["config"]["start_from"] == str(start)
    with pytest.raises(CheckpointError, match=r"start_from was '.*start', now '.*other'"):
        other = shutil.copytree(trained[0].folder / "specialist", tmp_path / "other")
        train(TrainConfig(**settings, start_from=other))


@pytest.mark.parametrize("changed", [{}, {"hidden": (16, 8)}, {"height_scale": 6.0}])
def test_a_refitted_feasibility_net_does_not_come_along(trained, tmp_path, changed):
    start = load_specialist(trained[0].folder / "specialist")
    net = FeasibilityNet(start.grid.num_points, **changed)
    save_specialist(dataclasses.replace(start, feasibility=net), tmp_path / start.name)
    trainer = Trainer(TrainConfig(out=tmp_path / "run", start_from=tmp_path / start.name, **TINY))
    mine = trainer.algorithm.feasibility.state_dict()["decoder.4.bias"].cpu()
    assert torch.equal(mine, net.state_dict()["decoder.4.bias"]) == (not changed)


@pytest.mark.parametrize("part", ["", "specialist", "snapshots/25"])
def test_a_run_does_not_overwrite_what_it_starts_from(tmp_path, part):
    with pytest.raises(ConfigError, match=r"would be overwritten .* give another --out"):
        Trainer(TrainConfig(out=tmp_path, start_from=tmp_path / part))


def test_starting_from_another_robots_policy_is_refused(trained, tmp_path):
    start = trained[0].folder / "specialist"
    with pytest.raises(CheckpointError, match="drives toy"):
        Trainer(A1TrainConfig(out=tmp_path, start_from=start, num_envs=2, rows=1, columns=1))


def test_a_time_budget_stops_a_run_that_can_be_resumed(tmp_path):
    config = TrainConfig(out=tmp_path / "run", hours=1e-6, **TINY)
    train(config)
    trainer = Trainer(config)
    trainer.resume()
    assert 1 <= trainer.iteration < TINY["iterations"]


def test_each_checkpoint_moves_to_new_ground_and_leaves_a_snapshot(trained):
    config = trained[0]
    worlds = [training_world(config, iteration) for iteration in (0, 0, 2)]
    first, again, later = ([t.seed for row in world.tiles for t in row] for world in worlds)
    assert first == again and not set(first) & set(later)
    assert all(seed % 2 == 0 for seed in first + later)  # evaluation draws odd ones
    snapshots = sorted(int(p.name) for p in (config.folder / "snapshots").iterdir())
    assert snapshots == [2, 4, 6]
    early = load_specialist(config.folder / "snapshots" / "2")
    assert early.provenance["samples"] == 2 * 4 * 8


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], TrainConfig),
        (["--terrain", "steps"], TrainConfig),
        (["--robot", "a1"], A1TrainConfig),
        (["--robot=a1", "--hours", "1"], A1TrainConfig),
    ],
)
def test_the_command_line_takes_the_robots_own_sizes(words, expected):
    assert config_of(words) is expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "a1"}, "robot was 'a1', now 'toy'"),
        ({"iterations": 6}, r"does not hold what this version keeps \(KeyError: 'algorithm'\)"),
    ],
)
def test_a_checkpoint_that_is_whole_but_does_not_fit_is_refused(trained, tmp_path, change, message):
    state = read_checkpoint(trained[0].folder / "checkpoint.pt")
    del state["algorithm"]
    state["config"] |= change
    write_checkpoint(tmp_path / "checkpoint.pt", state)
    with pytest.raises(CheckpointError, match=message):
        train(TrainConfig(out=tmp_path, resume=True, **TINY))


@pytest.mark.parametrize("damage", ["truncate", "garbage", "missing"])
def test_an_unreadable_checkpoint_says_what_to_do(trained, tmp_path, damage):
    config, _, _ = trained
    payload = (config.folder / "checkpoint.pt").read_bytes()
    if damage != "missing":
        (tmp_path / "checkpoint.pt").write_bytes(
            payload[: len(payload) // 2] if damage == "truncate" else b"no checkpoint"
        )
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt|--resume"):
        train(TrainConfig(out=tmp_path, resume=True, **TINY))


def test_a_disk_that_is_full_for_the_curves_is_a_storage_error(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("torch.utils.tensorboard.SummaryWriter.add_scalar", full)
    with pytest.raises(StorageError, match="No space left on device; free some disk space"):
        train(TrainConfig(out=tmp_path / "run", **TINY))


def test_a_run_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="file"):
        train(TrainConfig(out=tmp_path / "file" / "run", **TINY))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows delivers Ctrl-C to the whole console")
def test_ctrl_c_saves_and_returns_what_was_learned(tmp_path):
    def interrupt(row):
        if row["iteration"] == 3:
            os.kill(os.getpid(), signal.SIGINT)

    specialist = train(TrainConfig(out=tmp_path, **TINY), on_iteration=interrupt)
    assert specialist.provenance["samples"] == 3 * 4 * 8
    assert read_checkpoint(tmp_path / "checkpoint.pt")["iteration"] == 3
    resumed = train(TrainConfig(out=tmp_path, resume=True, **TINY))
    assert resumed.provenance["samples"] == 6 * 4 * 8


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"iterations": 0}, "iterations: should be greater than or equal to 1, got 0"),
        ({"seed": -1}, "seed: should be greater than or equal to 0, got -1"),
        ({"learning_rate": float("nan")}, "learning_rate: should be a finite number, got nan"),
        ({"learning_rate": -1.0}, "learning_rate: should be greater than 0"),
        ({"gamma": 2.0}, "gamma: should be less than or equal to 1"),
        ({"initial_std": -1.0}, "initial_std: should be greater than 0"),
        ({"hidden": ()}, "hidden: .* at least 1 item"),
        ({"hidden": (8, 0)}, "hidden: 1: should be greater than or equal to 1"),
        ({"label_seconds": float("inf")}, "label_seconds: should be a finite number"),
        ({"planning_speed": 0.0}, "planning_speed: should be greater than 0"),
        ({"speed": (0.9, 0.5)}, "speed: .*got"),
        (
            {"speed": (0.3, 0.6)},
            r"planning_speed should lie between .* 0\.3 and 0\.6 m/s, got 0\.85",
        ),
        ({"threads": 100_000}, "threads: should be less than or equal to 256"),
        ({"hours": float("nan")}, "hours: should be a finite number"),
        ({"easiest": 1.5}, r"easiest: should be less than or equal to 1, got 1\.5"),
        ({"neighbours": -0.1}, r"neighbours: .*got -0\.1"),
        ({"easiest_at_last": 1.0}, "easiest_at_last: should be less than 1, got 1"),
        ({"easiest_at_last": 0.5, "std_at_last": 0.0}, "std_at_last: should be greater than 0"),
        ({"std_at_last": 0.1}, "std_at_last needs easiest_at_last"),
        ({"num_envs": 1, "steps": 3}, "1 robots with 3 steps make no 4 mini-batches"),
        ({"device": "tpu"}, "device should be cpu, cuda or cuda:NUMBER, got 'tpu'"),
    ],
)
def test_a_setting_without_sense_is_refused(fields, message):
    with pytest.raises(ConfigError, match=message):
        TrainConfig(**fields)


def test_a_device_that_is_not_there_is_named_with_those_that_are(tmp_path):
    gpus = torch.cuda.device_count()
    with pytest.raises(ConfigError, match=rf"no device cuda:{gpus} here: choose of cpu"):
        train(TrainConfig(out=tmp_path / "run", device=f"cuda:{gpus}", **TINY))
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


def test_a_rollout_too_short_for_its_label_is_refused():
    with pytest.raises(ConfigError, match="steps to 14 or more"):
        Trainer(TrainConfig(**TINY | {"label_seconds": 1.0}))


def test_robots_train_at_the_speeds_asked_for():
    config = TrainConfig(**TINY | {"num_envs": 100}, speed=(0.2, 0.5), planning_speed=0.4)
    speeds = make_training_env(config).cruise
    assert 0.2 <= speeds.min() < 0.25 and 0.45 < speeds.max() <= 0.5
    usual = make_training_env(TrainConfig(**TINY)).cruise
    assert usual.min() >= ToyEnv.episodes.speed[0]


def test_the_generalist_trains_on_every_specialty():
    world = training_world(TrainConfig(terrain="general", rows=1, columns=8))
    assert [tile.name for tile in world.tiles[0]] == ["steps", "gaps", "slopes", "rubble"] * 2
    assert all(tile.seed % 2 == 0 for tile in world.tiles[0])


def test_rows_rise_from_the_easiest_difficulty_to_the_whole():
    world = training_world(TrainConfig(terrain="gaps", rows=3, columns=2, easiest=0.5))
    assert [[tile.difficulty for tile in row] for row in world.tiles] == [
        [0.5] * 2,
        [0.75] * 2,
        [1.0] * 2,
    ]


RISING = TINY | {"rows": 5, "easiest": 0.2, "easiest_at_last": 0.8, "std_at_last": 0.1}


@pytest.mark.slow
def test_the_first_row_rises_where_robots_have_outgrown_it_and_they_keep_their_difficulty(tmp_path):
    config = TrainConfig(out=tmp_path, **RISING)
    trainer = Trainer(config)
    trainer.iterate()
    trainer.save()
    assert trainer.easiest == 0.2  # they stand on the first row
    trainer.iterate()
    trainer.history[-1]["row"] = 2.0
    trainer.env.crossings.row[:] = torch.tensor([0, 2, 3, 4])
    trainer.save()
    # A quarter of what was missing: rows of 0.2, 0.4 .. 1 become 0.4, 0.55, 0.7, 0.85, 1.
    assert trainer.easiest == pytest.approx(0.4)
    assert trainer.env.crossings.row.tolist() == [0, 1, 3, 4]
    first, *_, last = training_world(dataclasses.replace(config, easiest=0.4)).tiles
    assert (first[0].difficulty, last[0].difficulty) == (0.4, 1.0)
    again = Trainer(dataclasses.replace(config, resume=True))
    again.resume()
    assert again.easiest == trainer.easiest and torch.equal(
        again.env.crossings.row, trainer.env.crossings.row
    )
    for mine, theirs in zip(again.env.world.tiles, trainer.env.world.tiles, strict=True):
        assert [(t.seed, t.difficulty) for t in mine] == [(t.seed, t.difficulty) for t in theirs]
    for _ in range(9):
        trainer.history[-1]["row"] = 4.0
        trainer.save()
    assert trainer.easiest == 0.8
    hard = Trainer(dataclasses.replace(config, easiest=0.9))  # above where it would rise to
    hard.iterate()
    hard.history[-1]["row"] = 4.0
    hard.save()
    assert hard.easiest == 0.9


def test_the_noise_falls_as_the_first_row_rises(tmp_path):
    trainer = Trainer(TrainConfig(out=tmp_path, **RISING))
    assert trainer.iterate()["std"] == pytest.approx(0.6, abs=0.05)
    trainer.easiest = 0.5
    noise = trainer.algorithm.get_policy().get_parameter("distribution.log_std_param")
    trainer.iterate()
    assert noise.exp().max().item() <= (0.6 * 0.1) ** 0.5 + 1e-6  # half way, geometrically
    trainer.easiest = 0.8
    trainer.iterate()
    assert noise.exp().max().item() <= 0.1 + 1e-6


def test_a_share_of_the_terrains_has_neighbours_where_there_can_be_any():
    config = TrainConfig(terrain="gaps", rows=5, columns=20, neighbours=0.5)
    tiles = [tile for row in training_world(config).tiles for tile in row]
    assert 30 < sum(tile.limits is not None for tile in tiles) < 70
    without = training_world(dataclasses.replace(config, neighbours=0.0)).tiles
    assert [tile.seed for row in without for tile in row] == [tile.seed for tile in tiles]
    gentle = training_world(TrainConfig(terrain="gentle", rows=1, columns=4, neighbours=1.0))
    assert all(tile.limits is None for tile in gentle.tiles[0])


def test_a_new_world_takes_the_place_of_the_last(tmp_path, monkeypatch):
    trainer = Trainer(TrainConfig(terrain="flat", out=tmp_path, num_envs=4, steps=26))
    last, make = weakref.ref(trainer.env), trainer._make_env

    def made():
        assert last() is None  # never two worlds in memory at a time
        return make()

    monkeypatch.setattr(trainer, "_make_env", made)
    trainer._renew(trainer.env.state_dict())
    assert trainer.runner.env is trainer.env
