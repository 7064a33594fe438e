import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from fgtutor.elevation import ElevationMap
from fgtutor.errors import CheckpointError, ConfigError, SpecialistError
from fgtutor.execution import FollowConfig, execute
from fgtutor.learning.config import A1TrainConfig, TrainConfig
from fgtutor.learning.training import Trainer, train
from fgtutor.planning import plan
from fgtutor.policies.dreamwaq import (
    HISTORY,
    ContextNet,
    DreamWaQModel,
    EstimatingModel,
    History,
    mirrors,
)
from fgtutor.policies.symmetry import Mirror, SymmetricMLPModel
from fgtutor.robots import ROBOTS, env_class
from fgtutor.robots.a1.env import A1Env, A1EnvConfig
from fgtutor.robots.a1.model import MIRROR, MIRROR_SIGNS
from fgtutor.robots.a1.randomise import WIDE
from fgtutor.robots.crossings import EnvConfig
from fgtutor.robots.toy import ToyEnv
from fgtutor.specialist import ZOO, load_specialist, save_specialist
from fgtutor.world.terrain import Terrain, World, make_terrain

robots = pytest.mark.parametrize("robot", sorted(ROBOTS))
TINY = {
    "actor": "dreamwaq",
    "num_envs": 4,
    "steps": 8,
    "rows": 1,
    "columns": 2,
    "label_seconds": 0.12,
    "save_every": 2,
    "iterations": 4,
}


def make_env(robot, name="steps", num_envs=3, **config):
    tiles = [make_terrain(name, robot=robot, difficulty=0.6, seed=3)]
    return env_class(robot)(World([tiles]), num_envs, config=EnvConfig(history=HISTORY, **config))


def make_policy(env, **options):
    mirror = env.mirror and env.mirror.part((*env.unfelt, *env.felt))
    return DreamWaQModel(
        env.get_observations(),
        {"actor": ["history"]},
        "actor",
        env.num_actions,
        hidden_dims=[16],
        distribution_cfg={"class_name": GaussianDistribution, "std_type": "log"},
        mirror=mirror,
        **options,
    )


def act(policy, history, **seen):
    with torch.no_grad():
        return policy(TensorDict({"history": history, **seen}, batch_size=[len(history)]))


def seeing(robot="a1", history=HISTORY, **options):
    """Return a policy that sees, and its environment."""
    env = make_env(robot, "flat", num_envs=1)
    observations = env.get_observations()
    scan, size = (observations[name].shape[-1] for name in ("scan", "policy"))
    keep = (*env.unfelt, *env.felt, *range(size - scan, size))
    policy = EstimatingModel(
        observations,
        {"actor": ["history", "scan"]},
        "actor",
        env.num_actions,
        hidden_dims=[16, 8],
        distribution_cfg={"class_name": GaussianDistribution, "std_type": "log"},
        mirror=env.mirror and env.mirror.part(keep),
        history=history,
        seen=scan,
        **options,
    )
    return policy, env


# The history --------------------------------------------------------------------------------------


def test_a_history_by_hand():
    history = History(3, 2, 2)
    seen = history.see(torch.tensor([[1.0, 2.0], [5.0, 6.0]]))
    assert seen.tolist() == [[0, 0, 0, 0, 1, 2], [0, 0, 0, 0, 5, 6]]
    # Looking again in the same step replaces what was seen, and changes no earlier answer.
    again = history.see(torch.tensor([[1.5, 2.5], [5.0, 6.0]]))
    assert again[0].tolist() == [0, 0, 0, 0, 1.5, 2.5] and seen[0, -1] == 2
    history.advance()
    history.forget(torch.tensor([1]))
    assert history.see(torch.tensor([[3.0, 4.0], [7.0, 8.0]])).tolist() == [
        [0, 0, 1.5, 2.5, 3, 4],
        [0, 0, 0, 0, 7, 8],
    ]
    for k in range(3):
        history.advance()
        last = history.see(torch.full((2, 2), 10.0 + k))
    assert last[0].tolist() == [10, 10, 11, 11, 12, 12]


@robots
def test_blind_groups_exist_only_if_asked_for(robot):
    env = make_env(robot)
    plain = env_class(robot)(env.world, 3, config=replace(env.config, history=0))
    blind, usual = env.get_observations(), plain.get_observations()
    assert set(blind.keys()) - set(usual.keys()) == {"history", "scan", "critic"}
    for name in usual.keys():  # noqa: SIM118, a TensorDict iterates over its batch
        assert torch.equal(usual[name], blind[name])
    assert blind["history"].shape == (3, HISTORY * len(env.felt))
    traits = env.traits.shape[-1]
    assert blind["critic"].shape == (3, 3 + traits + blind["policy"].shape[-1])
    assert torch.equal(blind["scan"], blind["policy"][:, -blind["scan"].shape[-1] :])


@robots
def test_the_history_holds_the_last_frames_of_this_episode(robot):
    env = make_env(robot, episode_seconds=0.3, traverse_share=0.0)
    felt, ages = list(env.felt), torch.zeros(3, dtype=torch.long)
    env.episode_length_buf[1] = 2  # so that the episodes do not all end together
    observations = env.get_observations()
    frames = [observations["policy"][:, felt]]
    ended = 0
    for _ in range(round(1.0 / env.control_dt)):
        observations, _, done, _ = env.step(0.2 * torch.randn(3, env.num_actions))
        ages = torch.where(done > 0, 0, ages + 1)
        ended += int(done.sum())
        frames.append(observations["policy"][:, felt])
        history = observations["history"].unflatten(-1, (HISTORY, -1))
        for i in range(3):
            for back in range(HISTORY):
                frame = frames[-1 - back][i] if back <= ages[i] else torch.zeros(len(felt))
                assert torch.equal(history[i, -1 - back], frame)
    assert ended >= 6
    env.reset_all()
    assert not env.get_observations()["history"][:, : -len(felt)].any()


@robots
def test_a_blind_robot_does_not_see_the_ground(robot):
    seen = {}
    for name in ("flat", "steps"):
        env = make_env(robot, name, num_envs=1, train=False)
        # On level ground; the obstacle begins at 1.5 m, within sight.
        pose = torch.tensor([[1.0, 2.0, 0.0]])
        pose[:, :2] += env.crossings.corner(torch.arange(1))
        env.start(torch.arange(1), pose, 0.5)
        seen[name] = env.get_observations()
    assert not torch.allclose(seen["flat"]["patch"], seen["steps"]["patch"], atol=1e-3)
    assert torch.allclose(seen["flat"]["history"], seen["steps"]["history"], atol=1e-5)
    assert not torch.allclose(seen["flat"]["critic"], seen["steps"]["critic"], atol=1e-3)


def test_the_a1_feels_its_joints_and_its_command_but_not_its_velocity():
    # A frame: gyroscope 3, gravity 3, joints 12, rates 12, last action 12, clock 2, command 3.
    assert A1Env.felt == tuple(range(3, 50)) and A1Env.unfelt == (0, 1, 2)
    env = make_env("a1", "flat", num_envs=1, train=False)
    env.command[0] = torch.tensor([0.5, 0.0, -0.25])
    before = env.get_observations()
    frame = before["history"][0, -47:]
    assert frame[3:6].tolist() == pytest.approx([0, 0, -1], abs=1e-4)
    assert frame[-3:].tolist() == [0.5, 0.0, -0.25]
    env.physics.qvel[0, :3] = torch.tensor([0.5, 0.0, 0.1])
    env.physics.forward()
    env._read()
    after = env.get_observations()
    assert torch.equal(after["history"], before["history"])
    yaw = env.pose[0, 3].item()
    expected = [2 * 0.5 * math.cos(yaw), -2 * 0.5 * math.sin(yaw), 0.2]
    assert after["critic"][0, :3].tolist() == pytest.approx(expected, abs=1e-3)
    assert torch.equal(after["critic"][:, 10:], after["policy"])
    assert not after["critic"][:, 3:10].any()  # this body is the model itself


def test_the_critic_knows_the_velocity_without_noise():
    noisy = A1EnvConfig(randomise=False, noise=True)
    tiles = World([[make_terrain("flat", robot="a1")]])
    env = A1Env(tiles, 8, config=EnvConfig(history=HISTORY, train=False), settings=noisy)
    observations = env.get_observations()
    assert torch.equal(observations["critic"][:, :3], 2 * env.body_velocity)
    assert (observations["policy"][:, :3] - 2 * env.body_velocity).abs().max() > 0.05


def test_the_toy_feels_its_pitch_legs_and_wheels_but_neither_speed_nor_height():
    env = make_env("toy", num_envs=2, train=False)
    env.step(torch.ones(2, 4))
    observations = env.get_observations()
    felt = env.proprioception()
    frame = observations["history"][:, -len(env.felt) :]
    assert torch.equal(frame[:, 3:-3], felt[:, 6:]) and torch.equal(frame[:, :3], felt[:, :3])
    assert torch.equal(frame[:, -3:], env.command)
    speed = env.motion()[1][:, 0]
    assert torch.allclose(observations["critic"][:, 0], speed) and speed.abs().min() > 0


def test_a_robot_that_does_not_say_what_it_feels_is_refused():
    class Numb(ToyEnv):
        unfelt = ()

    with pytest.raises(ConfigError, match="Numb does not say what a blind policy feels"):
        Numb(World([[make_terrain("flat")]]), 1, config=EnvConfig(history=HISTORY))


# The encoder --------------------------------------------------------------------------------------


def test_samples_stop_where_an_episode_ended():
    net = ContextNet(2, history=2, latent=2, hidden=(4,))
    # history[t, env] = (older frame, newer frame); frames count up: 10 env + t, and 0.5 more.
    time, env = torch.meshgrid(torch.arange(3.0), torch.arange(2.0), indexing="ij")
    frame = torch.stack((10 * env + time, 10 * env + time + 0.5), dim=-1)
    tracking = torch.zeros(3, 2, 3)
    tracking[2, 0, 2] = 1.0  # the step from t = 1 to t = 2 ended robot 0's episode
    critic = torch.stack((time, env, -time, 9 + time, 9 + env), dim=-1)
    rollout = {"history": torch.cat((frame - 1, frame), -1), "critic": critic, "tracking": tracking}
    history, velocity, following = net.samples(rollout)
    assert history.tolist() == [[-1, -0.5, 0, 0.5], [9, 9.5, 10, 10.5], [10, 10.5, 11, 11.5]]
    assert velocity.tolist() == [[0, 0, 0], [0, 1, 0], [1, 1, -1]]
    assert following.tolist() == [[1, 1.5], [11, 11.5], [12, 12.5]]


def test_the_loss_by_hand():
    net = ContextNet(2, history=2, latent=4, hidden=(3,)).eval()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        net.encoder[-1].bias.copy_(torch.tensor([1.0, 0, 0, 2, 0, 0, 0, 0, 0, 0, math.log(3)]))
        net.decoder[-1].bias.copy_(torch.tensor([0.5, 0.0]))
    assert net(torch.arange(4.0)[None]).tolist() == [[2, 3, 1, 0, 0, 2, 0, 0, 0]]
    total, parts = net.loss(
        torch.zeros(2, 4),
        torch.tensor([[1.0, 0, 3], [0, 0, 0]]),
        torch.tensor([[0.5, 2.0], [1.5, 0]]),
        beta=0.1,
    )
    # Velocity (1, 0, 0): errors 9 and 1, of six numbers. Prediction (0.5, 0): 4 and 1, of four.
    assert parts["velocity"].item() == pytest.approx(10 / 6)
    assert parts["prediction"].item() == pytest.approx(5 / 4)
    # 0.5 (2^2) for the mean, 0.5 (3 - 1 - ln 3) for the variance 3.
    kl = 2 + 1 - math.log(3) / 2
    assert parts["kl"].item() == pytest.approx(kl)
    assert total.item() == pytest.approx(10 / 6 + 5 / 4 + 0.1 * kl)


def test_the_latent_is_sampled_in_training_only():
    net, x = ContextNet(2, history=2, latent=4, hidden=(8,)), torch.randn(6, 4)
    batch = (x, torch.zeros(6, 3), torch.zeros(6, 2))
    one, two = (net.loss(*batch)[1]["prediction"].item() for _ in range(2))
    assert one != two
    net.eval()
    assert net.loss(*batch)[0] == net.loss(*batch)[0]


# Symmetry -----------------------------------------------------------------------------------------


def test_the_mirrors_by_hand():
    # Velocity (x forward, y left, z up); a frame of a left and a right joint; two actions.
    mirror = Mirror(
        observation_index=(0, 1, 2, 4, 3),
        observation_sign=(1, -1, 1, 1, 1),
        action_index=(1, 0),
        action_sign=(-1, -1),
    )
    encoder, policy = mirrors(mirror, history=2, latent=2)
    assert encoder.observation_index == (1, 0, 3, 2)
    assert encoder.observation_sign == (1, 1, 1, 1)
    assert encoder.action_index == (0, 1, 2, 4, 3, 6, 5)  # velocity, mean's and variance's halves
    assert encoder.action_sign == (1, -1, 1, 1, 1, 1, 1)
    assert policy.observation_index == (1, 0, 2, 3, 4, 6, 5)
    assert policy.observation_sign == (1, 1, 1, -1, 1, 1, 1)
    assert (policy.action_index, policy.action_sign) == ((1, 0), (-1, -1))


def test_a_mirrored_history_gets_the_mirrored_estimate_and_action():
    env = make_env("a1", "flat", num_envs=1)
    policy = make_policy(env)
    order, sign = list(env.mirror.observation_index), torch.tensor(env.mirror.observation_sign)
    seen = torch.randn(HISTORY, 9, 185)
    image = seen[..., order] * sign
    x, twin = (s[..., list(env.felt)].transpose(0, 1).flatten(1) for s in (seen, image))
    assert not torch.equal(x, twin)
    one, two = act(policy, x), act(policy, twin)
    assert torch.equal(two, one[:, list(MIRROR)] * torch.tensor(MIRROR_SIGNS, dtype=torch.float))
    assert one.abs().max() > 1e-3
    with torch.no_grad():
        estimate, mirrored = policy.context(x)[:, 47:], policy.context(twin)[:, 47:]
    assert torch.equal(mirrored[:, :3], estimate[:, :3] * torch.tensor([1.0, -1.0, 1.0]))
    assert torch.equal(mirrored[:, 3:], estimate[:, 3:].roll(8, dims=-1))


def test_a_seeing_policy_is_as_symmetric():
    policy, env = seeing()
    order, sign = list(env.mirror.observation_index), torch.tensor(env.mirror.observation_sign)
    seen = torch.randn(HISTORY, 9, 185)
    image = seen[..., order] * sign
    x, twin = (s[..., list(env.felt)].transpose(0, 1).flatten(1) for s in (seen, image))
    one, two = act(policy, x, scan=seen[-1, :, -135:]), act(policy, twin, scan=image[-1, :, -135:])
    assert torch.equal(two, one[:, list(MIRROR)] * torch.tensor(MIRROR_SIGNS, dtype=torch.float))
    assert not torch.equal(one, act(policy, x, scan=image[-1, :, -135:]))


def test_a_policy_that_was_told_its_velocity_is_adopted():
    policy, env = seeing()
    told = SymmetricMLPModel(
        env.get_observations(),
        {"actor": ["policy"]},
        "actor",
        12,
        hidden_dims=[16, 8],
        mirror=env.mirror,
        distribution_cfg={"class_name": GaussianDistribution, "std_type": "log"},
    )
    policy.adopt(told, env.felt, env.unfelt)
    history, scan = torch.randn(7, HISTORY * 47), torch.randn(7, 135)
    with torch.no_grad():
        estimate = policy.context(torch.cat((history, scan), dim=-1))[:, 47:50]
        full = torch.cat((estimate, history[:, -47:], scan), dim=-1)
        wanted = told(TensorDict({"policy": full}, batch_size=[7]))
    assert torch.allclose(act(policy, history, scan=scan), wanted, atol=1e-5)
    assert wanted.abs().max() > 1e-3


def test_what_cannot_be_built_is_refused():
    env = make_env("a1", "flat", num_envs=1)
    with pytest.raises(ConfigError, match="make it even"):
        make_policy(env, latent=5)
    with pytest.raises(ConfigError, match="235 observations are no 4 frames"):
        make_policy(env, history=4)


# The policy as a specialist -----------------------------------------------------------------------


def test_a_seeing_policy_comes_back_and_exports(make_specialist, tmp_path):
    policy, _ = seeing()
    folder = save_specialist(make_specialist(policy=policy, robot="a1"), tmp_path / "seeing")
    loaded = load_specialist(folder)
    described = json.loads((folder / "specialist.json").read_text())["policy"]
    assert described["groups"] == ["history", "scan"] and described["options"]["seen"] == 135
    assert loaded.history == HISTORY
    history, scan = torch.randn(4, HISTORY * 47), torch.randn(4, 135)
    answer = act(policy, history, scan=scan)
    assert torch.equal(act(loaded.policy, history, scan=scan), answer)
    with torch.no_grad():
        assert torch.equal(policy.as_onnx(False)(torch.cat((history, scan), dim=-1)), answer)


@robots
def test_a_saved_policy_comes_back(robot, make_specialist, tmp_path):
    env = make_env(robot)
    policy = make_policy(env, latent=6, context_hidden=(20, 10))
    mine = make_specialist(policy=policy, robot=robot)
    folder = save_specialist(mine, tmp_path / "blind")
    loaded = load_specialist(folder)
    described = json.loads((folder / "specialist.json").read_text())["policy"]
    assert described["kind"] == "dreamwaq" and described["groups"] == ["history"]
    assert described["options"] == {"history": 5, "latent": 6, "context_hidden": [20, 10]}
    assert loaded.history == HISTORY and make_specialist().history == 0
    for action in torch.randn(6, 3, env.num_actions):
        observations, *_ = env.step(action)
    assert torch.equal(loaded.act(observations), mine.act(observations))
    assert save_specialist(loaded, tmp_path / "again").is_dir()


def test_exported_modules_answer_as_the_policy_does():
    env = make_env("a1", "flat", num_envs=1)
    policy, x = make_policy(env), torch.randn(4, 235)
    with torch.no_grad():
        assert torch.equal(policy.as_onnx(False)(x), act(policy, x))
        assert torch.equal(policy.as_jit()(x), act(policy, x))
    assert policy.as_onnx(False).get_dummy_inputs()[0].shape == (1, 235)


# Training -----------------------------------------------------------------------------------------


def test_the_command_line_takes_an_actor():
    assert TrainConfig().actor == "perceptive" and TrainConfig().disturbances == "usual"
    assert A1TrainConfig().actor == "estimating" and A1TrainConfig().disturbances == "wide"
    assert tyro.cli(A1TrainConfig, args=["--actor", "dreamwaq"]).actor == "dreamwaq"


def tiny(folder, robot="toy", **changes):
    make = A1TrainConfig if robot == "a1" else TrainConfig
    return make(out=Path(folder), terrain="steps", **TINY | changes)


@pytest.mark.slow
def test_training_gives_a_blind_specialist_with_a_critic_that_sees(tmp_path):
    rows = []
    specialist = train(tiny(tmp_path), on_iteration=rows.append)
    assert isinstance(specialist.policy, DreamWaQModel)
    assert load_specialist(tmp_path / "specialist").history == HISTORY
    assert specialist.provenance["config"]["actor"] == "dreamwaq"
    for name in ("context_velocity", "context_prediction", "context_kl"):
        assert all(math.isfinite(row[name]) for row in rows)
    critic = Trainer(tiny(tmp_path)).algorithm.critic
    assert critic.obs_groups == ["critic"]


@pytest.mark.slow
def test_the_ppo_loss_never_reaches_the_encoder(tmp_path):
    trainer = Trainer(tiny(tmp_path))
    trainer.algorithm.context_updates = 0
    policy = trainer.algorithm.get_policy()
    before = {k: v.clone() for k, v in policy.state_dict().items()}
    trainer.iterate()
    trainer.iterate()
    moved = {k for k, v in policy.state_dict().items() if not torch.equal(v, before[k])}
    assert "mlp.0.weight" in moved and not any(k.startswith("context.") for k in moved)
    trainer = Trainer(tiny(tmp_path))
    trainer.iterate()
    after = trainer.algorithm.get_policy().context.state_dict()
    assert all(
        not torch.equal(v, before[f"context.{k}"]) for k, v in after.items() if "weight" in k
    )


@robots
def test_the_encoder_learns_from_a_rollout(robot, tmp_path):
    trainer = Trainer(tiny(tmp_path, robot, num_envs=8))
    algorithm = trainer.algorithm
    algorithm.context_updates, algorithm.context_batch = 0, 64
    trainer.iterate()
    context = algorithm.context
    samples = context.samples(algorithm.storage.observations)
    assert len(samples[0]) > 40

    def losses():
        with torch.no_grad():
            return {k: v.item() for k, v in context.eval().loss(*samples)[1].items()}

    before = losses()
    algorithm.context_updates = 150
    context.train()
    algorithm.fit_context(context, *samples)
    after = losses()
    assert after["velocity"] < 0.3 * before["velocity"]
    # The next frame holds an action drawn at random, which nothing can predict.
    assert after["prediction"] < 0.7 * before["prediction"]


@pytest.mark.slow
@robots
def test_a_resumed_run_equals_an_unbroken_one_bit_for_bit(robot, tmp_path):
    def state(trainer):
        algorithm = trainer.algorithm
        nets = (algorithm.get_policy(), algorithm.critic, algorithm.feasibility)
        return [value for net in nets for value in net.state_dict().values()]

    whole = Trainer(tiny(tmp_path, robot))
    whole.iterate()
    whole.iterate()
    whole.save()
    saved = [value.clone() for value in state(whole)]
    first = whole.iterate()
    again = Trainer(tiny(tmp_path, robot))
    again.resume()
    assert all(torch.equal(a, b) for a, b in zip(saved, state(again), strict=True))
    second = again.iterate()
    assert all(torch.equal(a, b) for a, b in zip(state(whole), state(again), strict=True))
    assert first["context_velocity"] == second["context_velocity"]
    assert not torch.equal(saved[-1], state(again)[-1])


@pytest.mark.slow
def test_an_estimating_run_starts_from_a_shipped_policy_and_resumes_exactly(tmp_path):
    options = {"actor": "estimating", "hidden": (256, 128), "critic_warmup": 1, "terrain": "steps"}
    start = ZOO / "a1" / "_checkpoints" / "late"  # whose Feasibility-Net is of its training
    config = A1TrainConfig(out=tmp_path / "a", start_from=start, **TINY | options)
    run, told = Trainer(config), load_specialist(start)
    own, theirs = (policy.mlp.state_dict() for policy in (run.algorithm.get_policy(), told.policy))
    assert torch.equal(own["2.weight"], theirs["2.weight"])
    assert torch.equal(own["0.weight"][:, 47:50], theirs["0.weight"][:, :3])
    nets = (run.algorithm.feasibility.state_dict(), told.feasibility.state_dict())
    assert all(torch.equal(nets[0][name], value) for name, value in nets[1].items())
    run.iterate()
    run.iterate()
    run.save()
    first = run.iterate()
    again = Trainer(config)
    again.resume()
    second = again.iterate()
    assert all(second[name] == value for name, value in first.items() if name != "seconds")
    conditions = run.specialist().provenance["conditions"]["settings"]
    assert conditions["friction"] == WIDE.friction and conditions["delay"] == WIDE.delay


@pytest.mark.slow
def test_a_warm_start_keeps_the_policy_while_critic_and_encoder_learn(tmp_path):
    train(tiny(tmp_path / "walk", iterations=1))
    start = tmp_path / "walk" / "specialist"
    trainer = Trainer(tiny(tmp_path / "run", start_from=start, critic_warmup=1))
    policy = trainer.algorithm.get_policy()
    first = {k: v.clone() for k, v in policy.state_dict().items() if "distribution" not in k}
    loaded = load_specialist(start).policy.state_dict()
    assert all(torch.equal(v, loaded[k]) for k, v in first.items())
    trainer.iterate()
    held = {k: v for k, v in first.items() if not k.startswith("context.")}
    assert all(torch.equal(v, policy.state_dict()[k]) for k, v in held.items())
    assert not torch.equal(policy.context.encoder[0].weight, first["context.encoder.0.weight"])
    trainer.iterate()
    assert not torch.equal(policy.state_dict()["mlp.0.weight"], first["mlp.0.weight"])
    with pytest.raises(CheckpointError, match=r"90 numbers of \['history'\], toy with the percep"):
        Trainer(tiny(tmp_path / "other", start_from=start, actor="perceptive"))


# Driving ------------------------------------------------------------------------------------------


def drive(robot, zoo, columns, **config):
    """Drive 3 m of flat ground; policy 1 has the columns from `columns` on, 0.1 m each."""
    elevation = ElevationMap(np.zeros((60, 40)))
    start, goal = (1.5, 2.0), (4.5, 2.0)
    policies = np.zeros((60, 40, 8), dtype=int)
    policies[columns:] = 1
    route = plan(
        np.ones(policies.shape), policies, grid=elevation, start=start, goal=goal, cost="length"
    )
    terrain = Terrain.from_elevation(elevation, start, goal, robot=robot)
    return execute(route, terrain, zoo, config=FollowConfig(**config))


def watched(specialist):
    """Return the list that will hold every history that the policy is asked about."""
    seen = []
    specialist.policy.register_forward_pre_hook(
        lambda _, arguments: seen.append(arguments[0]["history"].clone())
    )
    return seen


def follow_each_other(histories, width):
    """Whether each history is the one before it, one frame on, and the first one is empty."""
    return not histories[0][:, :-width].any() and all(
        torch.equal(b[:, :-width], a[:, width:]) for a, b in itertools.pairwise(histories)
    )


def test_a_blind_toy_reaches_the_end_of_its_route(make_rolling):
    env = make_env("toy", "flat", num_envs=1)
    policy = make_policy(env)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
    blind = make_rolling(policy=policy)
    seen = watched(blind)
    alone = drive("toy", {"blind": blind}, 60)
    assert alone.success and len(seen) == len(alone.poses)
    assert follow_each_other(seen, len(env.felt))
    # Half of the way with one that sees: when the blind one takes over, it knows what came before.
    seen.clear()
    mixed = drive("toy", {"seeing": make_rolling(), "blind": blind}, 30)
    assert mixed.success and mixed.switches == 1
    assert 0 < len(seen) < len(mixed.poses)
    assert seen[0].unflatten(-1, (HISTORY, -1)).any(dim=-1).all()


def test_a_blind_a1_is_driven(make_specialist):
    env = make_env("a1", "flat", num_envs=1)
    blind = make_specialist(policy=make_policy(env), robot="a1")
    seen = watched(blind)
    episode = drive("a1", {"blind": blind}, 60, patience=0.0, grace=0.3)
    assert len(seen) == len(episode.poses) == 15 and np.isfinite(episode.poses).all()
    assert follow_each_other(seen, 47)


def test_a_history_of_another_length_is_refused(make_rolling):
    short = make_rolling("short", policy=make_policy(make_env("toy", "flat", num_envs=1)))
    two = EnvConfig(history=2)
    env = ToyEnv(World([[make_terrain("flat")]]), 1, config=two)
    with pytest.raises(SpecialistError, match=r"reads 90 numbers .*'history': \(1, 36\)"):
        short.act(env.get_observations())
