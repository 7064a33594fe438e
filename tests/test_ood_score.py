"""What is familiar to a Feasibility-Net: the paper's score, ours, and how a specialist gets it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fgtutor.errors import ConfigError, ThresholdError
from fgtutor.feasibility import FeasibilityNet, OodScore, ood_weight
from fgtutor.learning import refit, training
from fgtutor.learning.calibrate import (
    HELD_OUT,
    CalibrateConfig,
    Rollout,
    calibrated,
    met_in_training,
    own_terrain,
    quantiles_on,
    roll_out,
)
from fgtutor.learning.training import TrainConfig, train
from fgtutor.robots import condition_of
from fgtutor.settings import PlanSettings
from fgtutor.specialist import ZOO, load_specialist, save_specialist
from fgtutor.tensorization import assess, ood_score

OWN = {"0.5": 1.0, "0.9": 2.0, "0.99": 4.0, "0.999": 8.0}


def test_the_paper_s_score_is_equation_4():
    loss = torch.linspace(0, 3, 50)
    assert torch.equal(OodScore().weight(loss), ood_weight(loss))
    assert torch.equal(OodScore((0.5, 1.0)).weight(loss, loss), ood_weight(loss, 0.5, 1.0))


def test_a_p_value_is_the_share_of_own_patches_at_least_as_strange():
    score, familiar = OodScore(None, (OWN, OWN), alpha=0.1), torch.full((4,), 1e-3)
    at = torch.tensor([1.0, 2.0, 4.0, 8.0])
    shares = torch.tensor([0.5, 0.1, 0.01, 0.001])
    # Twice the smaller of the two: either score may find the patch strange.
    torch.testing.assert_close(score.p_value(at, familiar), 2 * shares.clip(max=0.5))
    torch.testing.assert_close(score.p_value(familiar, at), 2 * shares.clip(max=0.5))
    torch.testing.assert_close(score.weight(at, familiar), (20 * shares).clip(0, 1))
    # Halfway between two quantiles, in logarithms; and as steep beyond the last one.
    between = score.p_value(torch.tensor([8**0.5, 16.0]), torch.full((2,), 1e-3))
    torch.testing.assert_close(between, 2 * torch.tensor([1e-3**0.5, 1e-4]))


def test_at_most_alpha_of_the_own_patches_lose_weight():
    rng = np.random.default_rng(0)
    own = torch.tensor(rng.lognormal(size=(2, 40_000)), dtype=torch.float32)
    levels = (0.5, 0.9, 0.95, 0.99, 0.995, 0.999)
    known, new = own.split(20_000, dim=1)
    tails = tuple(
        {str(q): float(np.quantile(values, q)) for q in levels} for values in known.numpy()
    )
    for alpha in (0.1, 0.03, 0.01):
        lost = (OodScore(None, tails, alpha).weight(*new) < 1).float().mean()
        assert 0.5 * alpha < lost < 1.4 * alpha  # two samples, and a line between quantiles


def test_the_strangeness_is_a_share_of_the_relief():
    net = FeasibilityNet(12, hidden=(4, 4), vae_hidden=(4, 4), latent=2, height_scale=2.0)
    patch = torch.randn(5, 12)
    loss, strangeness = net.losses(net.relief(patch))
    torch.testing.assert_close(loss, net.reconstruction(patch))
    torch.testing.assert_close(strangeness, loss / (1 + (2 * patch).square().sum(-1)))
    flat = FeasibilityNet(12, hidden=(4, 4), vae_hidden=(4, 4), latent=2, saturation=0.1)
    flat.load_state_dict(net.state_dict())
    # Saturated heights: a chasm of 10 m looks like one of 1 m, a step of 1 cm like itself.
    deep = torch.zeros(2, 12)
    deep[0, :6], deep[1, :6] = -1.0, -10.0
    torch.testing.assert_close(*flat.losses(flat.relief(deep))[0], rtol=1e-3, atol=1e-3)
    low = 0.01 * patch / patch.abs().max()
    torch.testing.assert_close(flat.relief(low), 4 * low, rtol=4e-3, atol=0)


@pytest.mark.parametrize(
    "own",
    [{}, {"0.9": 1.0}, {"0.9": 2.0, "0.99": 1.0}, {"0.9": 0.0, "0.99": 1.0}, {"a": 1, "b": 2}],
)
def test_unusable_quantiles_are_refused(own):
    with pytest.raises(ThresholdError, match="fgtutor calibrate"):
        OodScore(None, (OWN, own))


def test_what_cannot_be_a_score_is_refused():
    for alpha in (0.0, 1.0, float("nan")):
        with pytest.raises(ThresholdError, match="alpha"):
            OodScore(None, (OWN, OWN), alpha)
    with pytest.raises(ThresholdError, match="tau_low < tau_high"):
        OodScore((2.0, 1.0))
    with pytest.raises(ThresholdError, match="strangeness"):
        OodScore(None, (OWN, OWN)).weight(torch.ones(3))


def test_without_a_calibration_our_weights_are_refused(make_specialist):
    quantiles = {"0.9": 0.2, "0.99": 1.0}
    specialist = make_specialist(quantiles=quantiles, strangeness={})
    with pytest.raises(ThresholdError, match="never calibrated: run `fgtutor calibrate`"):
        ood_score("calibrated", specialist)


@pytest.fixture
def config(tmp_path) -> CalibrateConfig:
    return CalibrateConfig(folder=tmp_path, envs=3, seconds=1.0, worlds=1)


def test_calibrating_changes_neither_policy_nor_f(make_rolling, config, tmp_path):
    rolling = make_rolling("steps")
    known = calibrated(rolling, config)
    assert set(known.strangeness) == {"0.5", "0.9", "0.95", "0.99", "0.995", "0.999"}
    assert known.feasibility is rolling.feasibility and known.policy is rolling.policy
    assert known.strangeness == calibrated(rolling, config).strangeness
    assert known.provenance["calibration"]["patches"] > 10
    loaded = load_specialist(save_specialist(known, tmp_path / "steps"))
    assert loaded.strangeness == known.strangeness


def test_f_is_scaled_to_what_the_policy_reaches(make_rolling, config):
    shy = make_rolling("flat", f=0.2, provenance={"terrain": "flat"})
    config = replace(config, agree_under=("undisturbed", "disturbed"))
    known = calibrated(shy, config)
    assert known.provenance["calibration"]["agree_under"] == ("undisturbed", "disturbed")
    assert known.strangeness == calibrated(shy, replace(config, agree_under=())).strangeness
    patch, command = torch.zeros(1, shy.grid.num_points), torch.tensor([shy.command])
    presets = [condition_of("toy", name).options for name in config.agree_under]
    tiles = own_terrain(shy, 3, 2 * HELD_OUT + 1)
    reached = torch.cat([roll_out(shy, tiles, 3, 1.0, options=one).label for one in presets])
    with torch.no_grad():
        assert shy.feasibility.feasibility(patch, command).item() == pytest.approx(0.2, abs=1e-3)
        f = known.feasibility.feasibility(patch, command).item()
    assert f == pytest.approx(reached.mean().item(), abs=1e-3) and f > 0.5


def test_scaling_finds_the_factor_and_keeps_what_is_feasible():
    net = FeasibilityNet(12, hidden=(8, 8))
    patch, command = torch.randn(400, 12), torch.randn(400, 3)
    with torch.no_grad():
        weight, bias = list(net.head.parameters())[-2:]
        weight *= 6.0  # some steps below f_min
        bias -= 1.5
        said = net.feasibility(patch, command)
        pivot = torch.tensor(PlanSettings().f_min).logit()
        label = torch.sigmoid(pivot + 1.3 * (said.logit() - pivot))
        drive = Rollout(patch, command, label)
        f = refit.scaled(net, [drive, drive]).feasibility(patch, command)
        mirrored = torch.sigmoid(2 * pivot - said.logit())  # the higher f, the lower r_v
        askew = refit.scaled(net, [Rollout(patch, command, mirrored)])
        reverse = askew.feasibility(patch, command)
    assert 0.1 < (said < 0.1).float().mean() < 0.9
    torch.testing.assert_close(f, label, atol=1e-3, rtol=0)
    assert torch.equal(f < 0.1, said < 0.1)
    assert reverse.max() - reverse.min() < 0.01  # the less feasible never before the more feasible
    torch.testing.assert_close(net.feasibility(patch, command), said)  # the net itself stays


def test_a_specialist_is_calibrated_on_ground_as_it_was_trained_on(make_specialist):
    straight = own_terrain(make_specialist(), 4, 1)
    assert all(one.elevation.shape[0] > one.elevation.shape[1] for one in straight)
    config = {"neighbours": 0.0, "turned": 0.5}
    square = own_terrain(make_specialist(provenance={"config": config}), 40, 1)
    assert {one.elevation.shape[0] - one.elevation.shape[1] for one in square} == {0}
    askew = [one for one in square if abs(one.goal[1] - one.start[1]) > 1e-6]
    assert 10 <= len(askew) <= 30
    assert {one.name for one in square} == {"steps"}


def test_another_planning_speed_is_one_that_it_was_trained_with(make_rolling, config):
    rolling = make_rolling("steps")
    slower = calibrated(rolling, replace(config, planning_speed=0.75))
    assert slower.command == (0.75, 0.0, 0.0)
    assert slower.strangeness == calibrated(rolling, config).strangeness
    with pytest.raises(ConfigError, match=r"trained with 0\.7 to 1 m/s: .*, got 0\.5"):
        calibrated(rolling, replace(config, planning_speed=0.5))
    slow = make_rolling("steps", provenance={"config": {"speed": [0.2, 0.6]}})
    assert calibrated(slow, replace(config, planning_speed=0.5)).command[0] == 0.5
    odd = make_rolling("steps", provenance={"config": {"speed": [0.5]}})
    with pytest.raises(ConfigError, match="speed"):
        calibrated(odd, replace(config, planning_speed=0.5))


def test_it_is_driven_at_speeds_as_in_training(make_rolling, config):
    tiles = own_terrain(make_rolling("steps"), 2, 1)
    slow = make_rolling("steps", provenance={"config": {"speed": [0.2, 0.3]}})
    assert roll_out(slow, tiles, 8, 1.2).command[:, 0].max() <= 0.3
    assert roll_out(make_rolling("steps"), tiles, 8, 1.2).command[:, 0].max() > 0.7


def test_a_new_autoencoder_knows_its_terrain_better(make_rolling, config):
    rolling = make_rolling("steps")
    config = replace(config, updates=150, vae_hidden=(16, 8), latent=3, saturation=0.2)
    net = refit.refitted(rolling, met_in_training(rolling, config), config)
    assert net.saturation == 0.2 and net.vae_hidden == (16, 8)
    patch, command = 0.1 * torch.randn(30, net.num_points), torch.randn(30, 3)
    torch.testing.assert_close(
        net.feasibility(patch, command), rolling.feasibility.feasibility(patch, command)
    )
    fresh = FeasibilityNet(net.num_points, vae_hidden=(16, 8), latent=3, saturation=0.2)
    flat = torch.zeros(1, net.num_points)
    assert net.reconstruction(flat) < fresh.reconstruction(flat)


def test_a_smaller_head_without_updates_is_refused(config):
    with pytest.raises(ConfigError, match="give --updates with --hidden"):
        replace(config, hidden=(24, 12))


def test_a_smaller_head_says_the_same_anywhere(config, monkeypatch):
    monkeypatch.setattr(refit, "GROUNDS", 6)
    monkeypatch.setattr(refit, "POSES", 300)
    shipped = load_specialist(ZOO / "toy" / "steps")
    config = replace(config, updates=4000, hidden=(24, 12), vae_hidden=(8, 4), latent=2)
    net = refit.refitted(shipped, met_in_training(shipped, config), config)
    assert net.hidden == (24, 12)
    patch = refit.any_ground(shipped, config.easiest, seed=1)
    command = torch.tensor(shipped.command).expand(len(patch), -1)
    with torch.no_grad():
        old = shipped.feasibility.feasibility(patch, command)
        error = net.feasibility(patch, command) - old
    assert error.square().mean() < 0.1 * old.var()


def test_a_finished_training_is_safe_before_it_is_calibrated(tmp_path, monkeypatch):
    def stopped(specialist, config):
        assert load_specialist(tmp_path / "specialist").name == "flat"
        assert not specialist.policy.training  # what was written, not what learns
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "calibrated", stopped)
    config = TrainConfig(terrain="flat", out=tmp_path, iterations=1, num_envs=4, steps=26)
    with pytest.raises(KeyboardInterrupt):
        train(config)
    assert load_specialist(tmp_path / "specialist").strangeness == {}


def test_fitting_leaves_the_head_alone():
    net = FeasibilityNet(12, hidden=(4, 4), vae_hidden=(8, 4), latent=2)
    head = [value.clone() for value in net.head.state_dict().values()]
    patch = 0.1 * torch.randn(200, 12)
    before = net.reconstruction(patch).mean()
    refit.fit_autoencoder(net, patch, 100)
    assert net.reconstruction(patch).mean() < before
    assert all(map(torch.equal, head, net.head.state_dict().values()))
    losses, strangeness = quantiles_on(net, patch)
    assert losses["0.5"] < losses["0.99"] and strangeness["0.5"] < strangeness["0.99"]


def test_an_assessment_weighs_by_the_specialist_s_calibration(make_specialist):
    from fgtutor.elevation import ElevationMap

    rng = np.random.default_rng(1)
    elevation = ElevationMap(rng.random((7, 6)) * 0.1, resolution=0.1)
    specialist = make_specialist()
    said = assess(elevation, specialist)
    own = OodScore(None, (specialist.quantiles, specialist.strangeness))
    assert torch.equal(said.ood(), own.weight(said.reconstruction, said.strangeness))
    assert torch.equal(said.ood(0.1, 2.0), ood_weight(said.reconstruction))
