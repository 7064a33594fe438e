import os
import subprocess
import sys

import pytest
import torch

from fgtutor.errors import CheckpointError
from fgtutor.learning import distributed
from fgtutor.learning.training import TrainConfig, Trainer
from fgtutor.specialist import load_specialist

TINY = {
    "num_envs": 4,
    "steps": 8,
    "rows": 2,
    "columns": 2,
    "label_seconds": 0.12,
    "save_every": 1,
    "iterations": 3,
}
OPTIONS = [
    word for name, value in TINY.items() for word in (f"--{name.replace('_', '-')}", str(value))
]

# What each of two processes does: train, write down what it holds, then train without reduction.
WORK = """
import sys
from pathlib import Path

import torch

from fgtutor.learning import distributed
from fgtutor.learning.training import TrainConfig, Trainer

def note(trainer, name):
    algorithm = trainer.algorithm
    state = {
        "policy": algorithm.get_policy().state_dict(),
        "critic": algorithm.critic.state_dict(),
        "feasibility": algorithm.feasibility.state_dict(),
        "ground": torch.tensor([t.seed for row in trainer.env.world.tiles for t in row]),
    }
    torch.save(state, Path(sys.argv[1]) / f"{name}{distributed.rank()}.pt")

def step(algorithm, patch, command, label):
    # Without momentum or noise: the step shows the gradient.
    net = algorithm.feasibility
    net.eval()
    plain = torch.optim.SGD(net.parameters(), lr=0.1)
    algorithm._descend(net.loss(patch, command, label)[0], net, plain)

with distributed.leave_at_end():
    trainer = Trainer(TrainConfig(**eval(sys.argv[2])))
    note(trainer, "made")
    trainer.iterate()
    trainer.iterate()
    note(trainer, "reduced")
    mine = torch.Generator().manual_seed(distributed.rank())
    patch = 0.1 * torch.randn(6, trainer.env.grid.num_points, generator=mine)
    half = patch, torch.rand(6, 3, generator=mine), torch.rand(6, generator=mine)
    halves = distributed.gather(half)
    step(trainer.algorithm, *half)
    note(trainer, "stepped")
    trainer.algorithm.feasibility.load_state_dict(
        torch.load(Path(sys.argv[1]) / f"reduced{distributed.rank()}.pt")["feasibility"]
    )
    trainer.algorithm.is_multi_gpu = False
    step(trainer.algorithm, *(torch.cat(parts) for parts in zip(*halves)))
    note(trainer, "whole")
    trainer.iterate()
    note(trainer, "alone")
"""


def torchrun(*command, ok=True):
    """Run a command as two processes, as one does on a machine with two GPUs; return its output."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "torch.distributed.run", "--standalone",
         "--nproc-per-node", "2", *map(str, command)],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert (done.returncode == 0) == ok, done.stderr
    return done


def train(folder, *options, ok=True):
    return torchrun("-m", "fgtutor", "train", "--out", folder, *OPTIONS, *options, ok=ok)


def equal(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def noted(tmp_path_factory):
    """What two processes held, by name: a pair each."""
    folder = tmp_path_factory.mktemp("noted")
    (folder / "work.py").write_text(WORK)
    torchrun(folder / "work.py", folder, repr(TINY))
    return lambda name: [torch.load(folder / f"{name}{rank}.pt") for rank in (0, 1)]


@pytest.mark.slow
@pytest.mark.parametrize("network", ["policy", "critic", "feasibility"])
def test_two_processes_hold_the_same_networks_because_gradients_are_reduced(noted, network):
    made, reduced, alone = (
        [pair[network] for pair in noted(n)] for n in ("made", "reduced", "alone")
    )
    assert not equal(*made), "each draws its own, before the first one's are broadcast"
    assert equal(*reduced)
    assert not equal(made[0], reduced[0]), "they have learned"
    assert not equal(*alone), "one iteration without reduction, and they part"


@pytest.mark.slow
def test_two_processes_drive_on_different_ground_never_on_that_of_evaluation(noted):
    grounds = [set(pair["ground"].tolist()) for pair in noted("made")]
    assert grounds[0].isdisjoint(grounds[1])
    assert all(seed % 2 == 0 for seed in grounds[0] | grounds[1])


@pytest.mark.slow
def test_a_reduced_step_is_the_step_of_one_process_with_both_batches(noted):
    (stepped, _), (whole, _) = noted("stepped"), noted("whole")
    before = noted("reduced")[0]["feasibility"]
    moved = max((whole["feasibility"][k] - before[k]).abs().max().item() for k in before)
    assert moved > 1e-3
    for name, value in whole["feasibility"].items():
        assert torch.allclose(stepped["feasibility"][name], value, atol=1e-4 * moved)


@pytest.mark.slow
def test_torchrun_trains_one_specialist_and_goes_on_where_it_was_stopped(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    said = train(whole)
    assert said.stdout.count("samples ->") == 1, "one process speaks"
    specialist = load_specialist(whole / "specialist")
    assert specialist.provenance["samples"] == 3 * 2 * 4 * 8
    assert specialist.provenance["processes"] == 2
    assert len(list((whole / "tensorboard").iterdir())) == 1
    assert sorted(path.name for path in (whole / "snapshots").iterdir()) == ["1", "2", "3"]

    train(broken, "--hours", "1e-6")
    assert load_specialist(broken / "specialist").provenance["samples"] == 2 * 4 * 8
    train(broken, "--resume")
    for name in ("policy.safetensors", "feasibility.safetensors"):
        one, other = (folder / "specialist" / name for folder in (whole, broken))
        assert one.read_bytes() == other.read_bytes()
    # A single process cannot know the robots of the second one.
    with pytest.raises(CheckpointError, match="written by 2 processes, these are 1"):
        Trainer(TrainConfig(out=whole, **TINY)).resume()


def test_one_process_is_left_as_it_is(monkeypatch):
    monkeypatch.setenv("RANK", "3")  # a scheduler may set it
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert (distributed.processes(), distributed.rank(), distributed.leads()) == (1, 0, True)
    assert distributed.own_seed(7) == 7 and distributed.own_device("cuda:1") == "cuda:1"
    assert distributed.gather("a") == ["a"] and distributed.mean({"r_v": 0.1}) == {"r_v": 0.1}


def test_every_process_has_its_own_seed_and_gpu(monkeypatch):
    seen = set()
    for rank in range(4):
        for name, value in (("WORLD_SIZE", 4), ("RANK", rank), ("LOCAL_RANK", rank % 2)):
            monkeypatch.setenv(name, str(value))
        assert distributed.leads() == (rank == 0)
        assert distributed.own_device("cuda") == f"cuda:{rank % 2}"
        assert distributed.own_device("cpu") == "cpu"
        seen |= {distributed.own_seed(seed) for seed in range(100)}
    assert len(seen) == 400
