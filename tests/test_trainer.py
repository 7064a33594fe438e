"""Run folders and checkpoints: one run and one process each, whole or refused, always finite."""

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fgtutor import __main__ as cli
from fgtutor.errors import CheckpointError, ConfigError, DivergedError, StorageError
from fgtutor.io.storage import locked_folder
from fgtutor.learning.config import TrainConfig
from fgtutor.learning.trainer import Trainer, read_checkpoint
from fgtutor.learning.training import train

TINY = TrainConfig(
    num_envs=4, steps=8, rows=2, columns=2, label_seconds=0.12, save_every=2, iterations=4
)
WORDS = [
    "train",
    *("--num-envs", "4", "--steps", "8", "--rows", "2", "--columns", "2"),
    *("--label-seconds", "0.12", "--save-every", "2"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a finished run of four iterations; nobody writes in it."""
    config = replace(TINY, out=tmp_path_factory.mktemp("whole") / "run")
    train(config)
    return config.folder


@pytest.fixture
def copy(run, tmp_path):
    """A copy of that folder to change."""
    return shutil.copytree(run, tmp_path / "run")


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file under a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("change", [{}, {"seed": 2}, {"iterations": 2}])
def test_a_folder_that_holds_a_run_is_not_trained_into(copy, change):
    before = contents(copy)
    with pytest.raises(CheckpointError, match=r"holds a run already.*--resume.*--out"):
        train(replace(TINY, out=copy, **change))
    assert contents(copy) == before


def test_the_default_folder_names_the_seed():
    assert TrainConfig(seed=7).folder == Path("runs/toy-steps-seed7")


def test_one_process_trains_in_a_folder_at_a_time(copy):
    with locked_folder(copy), pytest.raises(StorageError, match=r"process \(\d+\) works in"):
        train(replace(TINY, out=copy, resume=True))
    assert train(replace(TINY, out=copy, resume=True)).provenance["iteration"] == 4


def test_an_unknown_name_leaves_no_folder(tmp_path):
    with pytest.raises(ConfigError, match="unknown robot"):
        train(replace(TINY, robot="horse", out=tmp_path / "run"))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="names are text on Windows")
def test_a_folder_whose_name_is_no_text_is_refused():
    with pytest.raises(ConfigError, match=r"'a_\\udcfc' is no name in UTF-8"):
        replace(TINY, out=Path(os.fsdecode(b"a_\xfc")))


@pytest.mark.slow
def test_any_changed_byte_of_a_checkpoint_is_noticed(run, tmp_path):
    whole, file = (run / "checkpoint.pt").read_bytes(), tmp_path / "checkpoint.pt"
    rng = torch.Generator().manual_seed(0)
    places = torch.randint(len(whole), (1000,), generator=rng).tolist()
    for n, place in enumerate([0, 31, 32, len(whole) - 1, *places]):
        changed = bytes([whole[place] ^ (1 << n % 8)])
        file.write_bytes(whole[:place] + changed + whole[place + 1 :])
        with pytest.raises(CheckpointError, match="is damaged"):
            read_checkpoint(file)
    for data in (b"", whole[:31], whole[:-1], whole + b"\0", whole[32:]):
        file.write_bytes(data)
        with pytest.raises(CheckpointError, match="is damaged"):
            read_checkpoint(file)
    file.write_bytes(whole)
    assert read_checkpoint(file)["iteration"] == 4


@pytest.mark.slow
def test_killed_between_snapshot_and_checkpoint_both_ways_on_are_open(copy, tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    trainer = Trainer(replace(TINY, iterations=6, out=copy, resume=True))
    trainer.resume()
    trainer.iterate()
    trainer.iterate()
    monkeypatch.setattr("fgtutor.learning.trainer.write_checkpoint", killed)
    with pytest.raises(KeyboardInterrupt):
        trainer.save()
    monkeypatch.undo()
    assert (copy / "snapshots" / "6").is_dir()
    assert Trainer(replace(TINY, out=tmp_path / "next", start_from=copy)).samples_before == 4 * 32
    went_on = train(replace(TINY, iterations=6, out=copy, resume=True))
    assert went_on.provenance["iteration"] == 6


def test_starting_from_networks_of_another_size_says_which_setting_to_give(run, tmp_path):
    with pytest.raises(CheckpointError, match="--hidden 16 8: give its own --hidden"):
        Trainer(replace(TINY, out=tmp_path / "next", start_from=run, hidden=(16, 8)))


@pytest.mark.parametrize(
    ("of", "value", "message"),  # a critic that is no number makes the policy one that is none too
    [
        (lambda a: a.get_policy(), "nan", "iteration 5 .*begin from --from .*/run.*another --out"),
        (lambda a: a.critic, "inf", "weights of the policy are not finite"),
        (lambda a: a.feasibility, "inf", "weights of the Feasibility-Net are not finite"),
    ],
)
def test_a_run_that_diverges_stops_and_keeps_its_last_good_checkpoint(copy, of, value, message):
    before = contents(copy)
    trainer = Trainer(replace(TINY, iterations=6, out=copy, resume=True))
    trainer.resume()
    with torch.no_grad():
        next(of(trainer.algorithm).parameters()).fill_(float(value))
    with pytest.raises(DivergedError, match=message):
        trainer.iterate()
    assert contents(copy) == before


@pytest.mark.slow
def test_a_learning_rate_that_is_far_too_high_is_told_on_the_command_line(tmp_path, capsys):
    words = [*WORDS, "--out", str(tmp_path), "--initial-std", "2"]
    assert cli.main([*words, "--learning-rate", "1", "--feasibility-learning-rate", "1"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "the training diverged in iteration" in said and "--learning-rate" in said
    assert not (tmp_path / "checkpoint.pt").exists() and not (tmp_path / "specialist").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX")
@pytest.mark.parametrize(
    ("number", "code", "reached"), [(signal.SIGINT, 130, {3}), (signal.SIGTERM, 143, {2})]
)
def test_a_signal_leaves_a_checkpoint_and_says_how_to_go_on(tmp_path, number, code, reached):
    code_of_it = (
        "import os, sys; from fgtutor import __main__ as cli\n"
        "from fgtutor.learning.trainer import Trainer\n"
        "iterate = Trainer.iterate\n"
        "def told(self):\n"
        f"    self.iteration == 2 and os.kill(os.getpid(), {int(number)})\n"
        "    return iterate(self)\n"
        "Trainer.iterate = told\n"
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    words = [*WORDS, "--iterations", "6", "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code_of_it, *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code and "--resume" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    assert read_checkpoint(tmp_path / "checkpoint.pt")["iteration"] in reached
    assert cli.main([*words, "--resume"]) == 0
    assert read_checkpoint(tmp_path / "checkpoint.pt")["iteration"] == 6
