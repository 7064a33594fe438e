import pytest
import torch
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from fgtutor.errors import ConfigError
from fgtutor.policies.description import register_policy
from fgtutor.policies.symmetry import Mirror, SymmetricMLP, SymmetricMLPModel, join
from fgtutor.specialist import load_specialist, save_specialist

MIRROR = Mirror(
    observation_index=(1, 0, 2, 3),
    observation_sign=(1.0, 1.0, -1.0, 1.0),
    action_index=(1, 0),
    action_sign=(-1.0, -1.0),
)


def make(mirror=MIRROR, **options):
    return SymmetricMLPModel(
        TensorDict({"policy": torch.zeros(1, 4)}, batch_size=[1]),
        {"actor": ["policy"]},
        "actor",
        2,
        **{"hidden_dims": [16, 8], "activation": "elu", "mirror": mirror} | options,
    )


def act(model, x):
    return model(TensorDict({"policy": x}, batch_size=[len(x)]))


def mirrored(x):
    return torch.stack((x[:, 1], x[:, 0], -x[:, 2], x[:, 3]), dim=-1)


def test_symmetric_network_by_hand():
    net = SymmetricMLP(
        2,
        1,
        Mirror(
            observation_index=(1, 0),
            observation_sign=(1.0, 1.0),
            action_index=(0,),
            action_sign=(-1.0,),
        ),
        hidden_dims=[2],
        activation="relu",
    )
    with torch.no_grad():
        net[0].weight.copy_(torch.eye(2))
        net[0].bias.zero_()
        net[2].weight.copy_(torch.tensor([[3.0, 1.0]]))
        net[2].bias.fill_(5.0)
    # n(2, 1) = 3*2 + 1 + 5 = 12 and n(1, 2) = 3 + 2 + 5 = 10: (12 - 10) / 2 = 1; the bias cancels.
    assert net(torch.tensor([[2.0, 1.0]])).item() == 1.0


def test_mirrored_observation_gives_the_mirrored_action_bit_for_bit():
    model, x = make(), torch.randn(33, 4)
    assert torch.equal(act(model, mirrored(x)), -act(model, x)[:, [1, 0]])
    assert act(model, x).abs().max() > 0.01


def test_gradients_reach_every_weight():
    model = make()
    act(model, torch.randn(8, 4)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.mlp.parameters())


def test_saved_weights_bring_their_mirror():
    model, blank, x = make(), make(mirror=None), torch.randn(5, 4)
    assert not torch.equal(act(model, x), act(blank, x))
    blank.load_state_dict(model.state_dict())
    assert torch.equal(act(model, x), act(blank, x))


def test_exported_modules_keep_the_symmetry():
    noise = {"class_name": GaussianDistribution, "init_std": 0.5, "std_type": "log"}
    model, x = make(distribution_cfg=noise), torch.randn(5, 4)
    with torch.no_grad():
        assert torch.equal(model.as_jit()(x), act(model, x))
        assert torch.equal(model.as_onnx(False)(x), act(model, x))


@pytest.mark.parametrize(
    "wrong",
    [
        {"observation_index": (1, 2, 0, 3)},
        {"observation_index": (1, 0, 2)},
        {"observation_index": (1, 0, 2, 9)},
        {"observation_sign": (1.0, -1.0, -1.0, 1.0)},
        {"action_sign": (2.0, 2.0)},
    ],
)
def test_a_mirror_that_is_none_is_refused(wrong):
    fields = {
        name: getattr(MIRROR, name)
        for name in ("observation_index", "observation_sign", "action_index", "action_sign")
    }
    with pytest.raises(ConfigError, match="mirrored again"):
        Mirror(**(fields | wrong))


def test_vectors_are_joined_by_hand():
    # A vector (x, y) beside a pair (left, right) whose signs flip.
    index, sign = join([((0, 1), (1, -1)), ((1, 0), (-1, -1))])
    assert index == (0, 1, 3, 2)
    assert sign == (1.0, -1.0, -1.0, -1.0)


def test_a_part_of_a_mirror_by_hand():
    part = MIRROR.part((3, 1, 0))
    assert part.observation_index == (0, 2, 1)
    assert part.observation_sign == tuple(MIRROR.observation_sign[i] for i in (3, 1, 0))
    assert (part.action_index, part.action_sign) == (MIRROR.action_index, MIRROR.action_sign)
    x = torch.randn(7, 4)
    image = x[:, [3, 1, 0]][:, list(part.observation_index)] * torch.tensor(part.observation_sign)
    assert torch.equal(image, mirrored(x)[:, [3, 1, 0]])


def test_a_part_without_its_mirror_image_is_refused():
    with pytest.raises(ConfigError, match=r"numbers \[1\] are kept without their mirror images"):
        MIRROR.part((1, 2))


def test_a_mirror_of_another_robot_is_refused():
    with pytest.raises(ConfigError, match="3 observations and 2 actions"):
        make(
            Mirror(
                observation_index=(0, 1, 2),
                observation_sign=(1.0,) * 3,
                action_index=(0, 1),
                action_sign=(1.0,) * 2,
            )
        )


def test_running_statistics_are_refused():
    with pytest.raises(ConfigError, match="obs_normalization=False"):
        make(obs_normalization=True)


def test_a_specialist_folder_keeps_the_symmetry(make_specialist, tmp_path):
    register_policy("symmetric", SymmetricMLPModel)
    noise = {"class_name": GaussianDistribution, "init_std": 0.5, "std_type": "log"}
    model, x = make(distribution_cfg=noise), torch.randn(5, 4)
    folder = save_specialist(make_specialist(policy=model), tmp_path / "it")
    loaded = load_specialist(folder).policy
    assert torch.equal(act(loaded, x), act(model, x))
    assert torch.equal(loaded.mlp.observation_sign, model.mlp.observation_sign)
