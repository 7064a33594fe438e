"""What every test starts from: one thread, one seed, no window, and a small specialist."""

import gc
import math
import os
from collections.abc import Callable
from pathlib import Path

# Before anything imports matplotlib or GitPython: neither may look for a screen or for git.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
# Nor may the kernels and the processes that tests start each take every core at once.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
from browser import chromium, node, page  # noqa: F401  (fixtures for all)
from hypothesis import settings

from fgtutor.course import checks
from fgtutor.feasibility import FeasibilityNet
from fgtutor.io.rsl import GaussianDistribution, MLPModel, TensorDict
from fgtutor.patches import PatchGrid
from fgtutor.robots.toy import ToyEnv
from fgtutor.specialist import Specialist, save_specialist
from fgtutor.world.terrain import World, make_terrain

# Two cores are shared with whatever else runs; small networks are fastest on one thread anyway.
torch.set_num_threads(1)
settings.register_profile("house", deadline=None, max_examples=25)
settings.load_profile("house")


def pytest_collection_finish() -> None:
    """Let no garbage collection look at what was imported: trainings collect at each checkpoint."""
    gc.freeze()


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Draw the same numbers in each test, whatever ran before it on the same worker."""
    torch.manual_seed(1)


@pytest.fixture(scope="session")
def make_specialist() -> Callable[..., Specialist]:
    """Return a maker of real, untrained specialists: `make_specialist(name, seed=0, **fields)`."""

    def make(
        name: str = "steps", *, seed: int = 0, normalise: bool = False, **fields
    ) -> Specialist:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            grid = fields.pop("grid", PatchGrid(ahead=0.3, behind=0.2, half_width=0.2))
            policy = MLPModel(
                TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1]),
                {"actor": ["policy"]},
                "actor",
                3,
                hidden_dims=[8, 4],
                activation="elu",
                obs_normalization=normalise,
                distribution_cfg={
                    "class_name": GaussianDistribution,
                    "init_std": 0.5,
                    "std_type": "log",
                },
            )
            net = FeasibilityNet(grid.num_points, hidden=(16, 8), vae_hidden=(16, 8), latent=4)
        values = {
            "name": name,
            "robot": "toy",
            "policy": policy,
            "feasibility": net,
            "grid": grid,
            "command": (0.6, 0.0, 0.0),
            "label_seconds": 1.0,
            "quantiles": {"0.5": 0.05, "0.9": 0.1, "0.95": 0.2, "0.99": 0.4},
            "provenance": {"terrain": name, "samples": 1000, "seed": seed},
        }
        values |= fields
        return Specialist(**({"strangeness": values["quantiles"]} | values))

    return make


@pytest.fixture(scope="session")
def make_rolling(make_specialist) -> Callable[..., Specialist]:
    """Return a maker of toys that only roll: a policy of zero weights leaves the legs alone.

    Its Feasibility-Net is untrained; `f` sets what it answers everywhere (its last bias).
    """

    def make(name: str = "steps", *, f: float = 0.8, **fields) -> Specialist:
        probe = ToyEnv(World([[make_terrain("flat", robot="toy")]]), 1)
        observations = probe.get_observations()
        policy = MLPModel(
            observations,
            {"actor": ["policy"]},
            "actor",
            probe.num_actions,
            hidden_dims=[4],
            activation="elu",
            distribution_cfg={"class_name": GaussianDistribution, "std_type": "log"},
        )
        net = FeasibilityNet(probe.grid.num_points, hidden=(8, 8), vae_hidden=(8, 8), latent=2)
        with torch.no_grad():
            for parameter in (*policy.parameters(), *net.parameters()):
                parameter.zero_()
            net.head[-1].bias.fill_(math.log(f / (1 - f)))
        values = {
            "grid": probe.grid,
            "policy": policy,
            "feasibility": net,
            "command": (0.85, 0.0, 0.0),
            "quantiles": {"0.5": 1.0, "0.9": 9e3, "0.95": 9.5e3, "0.99": 9.9e3},
        }
        return make_specialist(name, **(values | fields))

    return make


@pytest.fixture
def zoo(make_rolling, tmp_path) -> Path:
    """Three policies that only roll: two say they can, one (gaps) says it can do nothing."""
    for name, f in (("steps", 0.8), ("gaps", 0.05), ("general", 0.6)):
        save_specialist(make_rolling(name, f=f), tmp_path / "zoo" / name)
    return tmp_path / "zoo"


@pytest.fixture
def new_learner(tmp_path, monkeypatch):
    """Work in a folder of its own, in a kernel that has passed nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checks, "_passed", set())
    monkeypatch.setattr(checks, "_tried", set())
    monkeypatch.setattr(checks, "_hints", {})
    return tmp_path
