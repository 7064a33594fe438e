"""Policies as ONNX: the same answers, and a description from which an observation can be built."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from fgtutor.cli import export
from fgtutor.errors import ConfigError, ExportError, SpecialistError, StorageError
from fgtutor.patches import prepare
from fgtutor.policies.dreamwaq import DreamWaQModel, EstimatingModel
from fgtutor.policies.symmetry import SymmetricMLPModel
from fgtutor.robots.a1.env import A1_GRID, A1Env
from fgtutor.specialist import Specialist, save_specialist
from fgtutor.world.terrain import World, make_terrain


def walk(history: int = 0) -> A1Env:
    """Return one A1 that has stumbled over steps for half a second, without noise."""
    world = World([[make_terrain("steps", robot="a1", seed=3)]])
    config = replace(A1Env.episodes, train=False, history=history)
    env = A1Env(world, 1, config=config)
    rng = torch.Generator().manual_seed(0)
    env.command[0] = torch.tensor((0.6, 0.0, -0.4))
    for _ in range(25):
        env.step(torch.randn(1, 12, generator=rng))
    return env


def options(env: A1Env) -> dict:
    noise = {"class_name": GaussianDistribution, "std_type": "log"}
    return {"hidden_dims": [16, 8], "activation": "elu", "distribution_cfg": noise}


@pytest.fixture
def seeing(make_specialist) -> Specialist:
    """An untrained A1 policy that sees."""
    env = walk()
    torch.manual_seed(1)
    policy = SymmetricMLPModel(
        env.get_observations(), {"actor": ["policy"]}, "actor", 12, mirror=env.mirror,
        **options(env),
    )  # fmt: skip
    net = make_specialist(grid=A1_GRID).feasibility
    return make_specialist(robot="a1", policy=policy, grid=A1_GRID, feasibility=net)


@pytest.mark.slow
def test_the_exported_policy_answers_as_the_specialist_does(seeing, tmp_path):
    path = tmp_path / "policy.onnx"
    assert export.export_policy(seeing, path) < 1e-5
    assert {file.name for file in tmp_path.iterdir()} == {"policy.onnx", "policy.json"}
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    text = str(model.graph)
    assert "metadata" not in text and "/fgtutor/" not in text, "nothing of this machine is written"
    description = json.loads((tmp_path / "policy.json").read_text())
    assert {p.key: json.loads(p.value) for p in model.metadata_props} == {
        export.METADATA: description
    }
    observations = walk().get_observations()
    evaluator = ReferenceEvaluator(model)
    for rows in (1, 7):
        batch = observations["policy"].expand(rows, -1).numpy()
        (action,) = evaluator.run(None, {"observation": batch})
        np.testing.assert_allclose(
            action, seeing.act(observations).expand(rows, -1).numpy(), atol=1e-5
        )


@pytest.mark.slow
def test_a_blind_policy_reads_frames_without_velocity_and_scan(make_specialist, tmp_path):
    env = walk(history=5)
    mirror = env.mirror.part((*env.unfelt, *env.felt))
    policy = DreamWaQModel(
        env.get_observations(), {"actor": ["history"]}, "actor", 12, mirror=mirror, **options(env)
    )
    net = make_specialist(grid=A1_GRID).feasibility
    blind = make_specialist(robot="a1", policy=policy, grid=A1_GRID, feasibility=net)
    assert export.export_policy(blind, tmp_path / "blind.onnx") < 1e-5
    told = json.loads((tmp_path / "blind.json").read_text())["observation"]
    names = [part["name"] for part in told["parts"]]
    assert names == ["gyroscope", "gravity", "joints", "joint rates", "last action", "clock",
                     "command"]  # fmt: skip
    # 3 + 3 + 12 + 12 + 12 + 2 + 3 = 47 numbers, five times.
    assert (told["frames"], told["size"]) == (5, 235)
    (action,) = ReferenceEvaluator(str(tmp_path / "blind.onnx")).run(
        None, {"observation": env.get_observations()["history"].numpy()}
    )
    np.testing.assert_allclose(action, blind.act(env.get_observations()).numpy(), atol=1e-5)


@pytest.mark.slow
def test_an_estimating_policy_reads_frames_and_then_the_scan(make_specialist, tmp_path):
    env = walk(history=4)
    observations = env.get_observations()
    policy = EstimatingModel(
        observations, {"actor": ["history", "scan"]}, "actor", 12, mirror=env.mirror.part(
            (*env.unfelt, *env.felt, *range(50, 185))), history=4, seen=135, **options(env)
    )  # fmt: skip
    net = make_specialist(grid=A1_GRID).feasibility
    mine = make_specialist(robot="a1", policy=policy, grid=A1_GRID, feasibility=net)
    assert export.export_policy(mine, tmp_path / "mine.onnx") < 1e-5
    told = json.loads((tmp_path / "mine.json").read_text())["observation"]
    assert "velocity" not in {part["name"] for part in told["parts"]}
    assert [part["name"] for part in told["after the frames"]] == ["scan"]
    assert (told["frames"], told["size"]) == (4, 4 * 47 + 135)
    read = torch.cat((observations["history"], observations["scan"]), dim=-1)
    (action,) = ReferenceEvaluator(str(tmp_path / "mine.onnx")).run(
        None, {"observation": read.numpy()}
    )
    np.testing.assert_allclose(action, mine.act(observations).numpy(), atol=1e-5)


def test_an_observation_can_be_built_from_the_description_alone(seeing):
    """Measure everything anew with MuJoCo and the map, and follow the description's words."""
    env, told = walk(), export.describe(seeing)
    data = mujoco.MjData(env.physics.model)
    data.qpos, data.qvel = env.physics.qpos[0], env.physics.qvel[0]
    to_trunk = np.zeros(9)
    mujoco.mju_quat2Mat(to_trunk, data.qpos[3:7])
    to_trunk = to_trunk.reshape(3, 3).T
    ahead = to_trunk[0]  # the trunk's x axis in the world
    yaw = np.arctan2(ahead[1], ahead[0])
    parts = {part["name"]: part for part in told["observation"]["parts"]}
    points = np.array(parts["scan"]["points"])
    turn = np.array(((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))))
    x, y = (data.qpos[:2] + points @ turn.T).T
    ground = env.world.lay(prepare)
    angle = 2 * np.pi * 2.0 * 25 * told["seconds per action"]
    measured = {
        "velocity": to_trunk @ data.qvel[:3],
        "gyroscope": data.qvel[3:6],
        "gravity": to_trunk @ (0.0, 0.0, -1.0),
        "joints": data.qpos[7:],
        "joint rates": data.qvel[6:],
        "last action": env.last_action[0].numpy(),
        "clock": np.array((np.sin(angle), np.cos(angle))),
        "command": np.array((0.6, 0.0, -0.4)),
        "scan": ground.height_at(x, y) - data.qpos[2],
    }
    numbers = []
    for name, part in parts.items():
        raw = measured[name]
        assert len(raw) == part["size"]
        raw = np.clip(raw, *part["limits"]) if part["limits"] else raw
        numbers.append(np.clip(part["scale"] * (raw - np.array(part["offset"])), -20, 20))
    wanted = env.get_observations()["policy"][0].numpy()
    np.testing.assert_allclose(np.concatenate(numbers), wanted, atol=2e-4)
    assert told["observation"]["size"] == len(wanted)


def test_an_action_means_what_the_description_says(seeing):
    env, told = walk(), export.describe(seeing)["action"]
    action = torch.linspace(-1, 1, 12)[None]
    env.step(action)
    names = [env.physics.model.actuator(i).name for i in range(12)]
    assert told["joints"] == names
    targets = np.array(told["offset"]) + told["scale"] * action[0].numpy()
    np.testing.assert_allclose(env.physics.ctrl[0], targets, atol=1e-6)
    kp = env.physics.model.actuator_gainprm[:, 0]
    assert set(kp) == {told["stiffness"]}


def test_another_robots_parts_have_the_right_sizes(make_rolling):
    told = export.describe(make_rolling())
    sizes = [part["size"] for part in told["observation"]["parts"]]
    assert sum(sizes) == told["observation"]["size"] == make_rolling().policy.obs_dim
    assert "ToyEnv" in told["action"]["meaning"]


def test_a_policy_for_other_observations_is_refused(make_specialist, tmp_path):
    with pytest.raises(SpecialistError, match=r"reads 6 numbers and answers 3.*train it again"):
        export.export_policy(make_specialist(), tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_network_that_answers_otherwise_is_an_error(make_specialist):
    policy = make_specialist().policy
    model = export.to_onnx(policy)
    assert export.compare(model, policy) < 1e-5
    other = make_specialist(seed=2).policy
    with pytest.raises(ExportError, match=r"differs from torch by .*constraints\.txt"):
        export.compare(model, other)


def test_a_folder_that_is_missing_is_named_before_any_work(make_rolling, tmp_path):
    with pytest.raises(StorageError, match="create the folder first"):
        export.export_policy(make_rolling(), tmp_path / "nowhere" / "policy.onnx")


@pytest.mark.parametrize("name", ["policy.json", "policy", "policy.onnx.json", ".onnx"])
def test_a_path_that_the_description_would_overwrite_is_refused(make_rolling, tmp_path, name):
    with pytest.raises(ConfigError, match=r"ends in \.onnx, got"):
        export.export_policy(make_rolling(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_description_that_cannot_be_written_is_named_before_any_work(make_rolling, tmp_path):
    (tmp_path / "policy.json").mkdir()
    with pytest.raises(StorageError, match=r"policy\.json"):
        export.export_policy(make_rolling(), tmp_path / "policy.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.json"]


class Reading(MLPModel):
    """A policy that does what no graph can hold: it looks at its own answer."""

    def as_onnx(self, verbose):
        class Graph(torch.nn.Module):
            def forward(self, x):
                return x * len(open("/proc/self/status").read()) if x.sum().item() > 0 else x

        return Graph()


@pytest.mark.slow
def test_a_network_that_onnx_cannot_express_is_named():
    groups = TensorDict({"policy": torch.zeros(1, 6)}, batch_size=[1])
    policy = Reading(groups, {"actor": ["policy"]}, "actor", 3, [8])
    with pytest.raises(ExportError, match="a Reading cannot be written as ONNX"):
        export.to_onnx(policy)


@pytest.mark.slow
def test_the_command_says_what_it_wrote(make_rolling, tmp_path, capsys):
    folder = save_specialist(make_rolling(), tmp_path / "steps")
    out = tmp_path / "steps.onnx"
    assert export.run(export.ExportConfig(specialist=folder, out=out)) == 0
    said = capsys.readouterr().out
    assert str(out) in said and str(tmp_path / "steps.json") in said and "from torch" in said
    assert out.exists() and (tmp_path / "steps.json").exists()
