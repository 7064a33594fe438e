"""Checkpoints that are whole, and hold what no training writes."""

import hashlib
import math

import pytest

from fgtutor.errors import CheckpointError
from fgtutor.learning.checkpoints import read_checkpoint, write_checkpoint
from fgtutor.learning.config import TrainConfig
from fgtutor.learning.trainer import Trainer


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training that has saved its first iteration, and the bytes it saved."""
    sizes = {"num_envs": 2, "steps": 8, "rows": 1, "columns": 1, "hidden": (4,)}
    out = tmp_path_factory.mktemp("training")
    trainer = Trainer(TrainConfig(out=out, label_seconds=0.12, iterations=2, **sizes))
    trainer.iterate()
    trainer.save()
    return trainer, trainer.checkpoint.read_bytes()


@pytest.fixture
def trainer(trained):
    """The same training, its checkpoint as it was saved."""
    trainer, saved = trained
    trainer.checkpoint.write_bytes(saved)
    return trainer


def without_end(state):
    state["algorithm"]["critic_state_dict"]["mlp.0.bias"] *= math.inf


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(iteration=-1), "iteration: should be greater than or equal"),
        (lambda state: state.update(easiest=math.nan), "easiest: should be a finite number"),
        (lambda state: state.update(history=[{"r_v": "x"}]), r"history.0.r_v: .* number, got 'x'"),
        (lambda state: state.update(config=[]), "config: should be an object"),
        (lambda state: state.update(others=None), "does not hold what this version keeps"),
        (lambda state: state["env"].update(row=state["env"]["row"] + 1), "row of each robot"),
        (lambda state: state["env"].update(column=None), "does not hold what this version keeps"),
        (without_end, "weights of the critic are not finite"),
    ],
)
def test_values_that_no_training_writes_are_refused(trainer, change, message):
    state = read_checkpoint(trainer.checkpoint)
    change(state)
    write_checkpoint(trainer.checkpoint, state)
    with pytest.raises(CheckpointError, match=message):
        trainer.resume()


@pytest.mark.parametrize("payload", [b"", b"no archive", b"\x80\x04K\x01.", b"\x80\x02]q\0."])
def test_bytes_that_torch_cannot_read_are_refused(trainer, payload):
    trainer.checkpoint.write_bytes(hashlib.sha256(payload).digest() + payload)
    with pytest.raises(CheckpointError, match="does not hold what this version keeps"):
        trainer.resume()
