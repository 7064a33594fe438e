"""Feasibility-Net: the paper's Eqs. 1-4 against numbers worked by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from fgtutor.errors import ThresholdError
from fgtutor.feasibility import FeasibilityNet, ood_weight

POINTS = 6


@pytest.fixture
def net() -> FeasibilityNet:
    torch.manual_seed(0)
    return FeasibilityNet(POINTS, hidden=(8, 4), vae_hidden=(8, 4), latent=3, height_scale=1.0)


@pytest.fixture
def blank(net: FeasibilityNet) -> FeasibilityNet:
    """A net of zeros: f = 0.5, latent mean 0, variance 1, reconstruction 0."""
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
    return net


@pytest.mark.parametrize(
    ("loss", "weight"),
    # 1.05 is half-way between the paper's 0.1 and 2.0.
    [(0.0, 1.0), (0.1, 1.0), (1.05, 0.5), (2.0, 0.0), (100.0, 0.0)],
)
def test_ood_weight_by_hand(loss, weight):
    assert ood_weight(loss) == pytest.approx(weight)
    assert ood_weight(np.array([loss]))[0] == pytest.approx(weight)
    assert ood_weight(torch.tensor([loss])).item() == pytest.approx(weight)


def test_ood_weight_keeps_the_kind_of_its_argument():
    assert isinstance(ood_weight(1.0), float)
    assert isinstance(ood_weight(np.zeros(2)), np.ndarray)
    assert isinstance(ood_weight(torch.zeros(2)), torch.Tensor)


@pytest.mark.parametrize(
    "taus", [(2.0, 0.1), (1.0, 1.0), (math.nan, 1.0), (0.0, math.inf), (-math.inf, 1.0)]
)
def test_ood_weight_refuses_thresholds_without_a_slope(taus):
    with pytest.raises(ThresholdError, match="tau_low < tau_high"):
        ood_weight(0.5, *taus)


@given(st.floats(0, 10), st.floats(0, 10), st.floats(0, 5), st.floats(0.01, 5))
def test_ood_weight_never_grows_with_the_loss(one, other, low, width):
    better, worse = sorted((one, other))
    weights = ood_weight(better, low, low + width), ood_weight(worse, low, low + width)
    assert 1 >= weights[0] >= weights[1] >= 0


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_outputs_have_the_shape_of_the_batch(net, batch):
    patch, command = torch.randn(*batch, POINTS), torch.randn(*batch, 3)
    feasibility = net.feasibility(patch, command)
    assert feasibility.shape == net.reconstruction(patch).shape == batch
    assert ((feasibility > 0) & (feasibility < 1)).all()


def test_reconstruction_is_a_sum_over_points(blank):
    # Reconstructing zeros: 6 points of 0.5 m at scale 1 are 6 * 0.25 = 1.5, not their mean 0.25.
    assert blank.reconstruction(torch.full((POINTS,), 0.5)).item() == pytest.approx(1.5)


def test_the_height_scale_enters_squared(blank):
    blank.height_scale = 4.0
    # 6 points of 0.5 m are 2 units of 0.25 m each: 6 * 4 = 24.
    assert blank.reconstruction(torch.full((POINTS,), 0.5)).item() == pytest.approx(24.0)


def test_reconstruction_is_the_same_in_training_mode(net):
    patch = torch.randn(4, POINTS)
    torch.testing.assert_close(net.train().reconstruction(patch), net.eval().reconstruction(patch))


@pytest.mark.parametrize("saturation", [None, 0.15])
@pytest.mark.parametrize("command", [(0.65, 0.0, 0.0), (-0.3, 0.2, 1.0)])
def test_a_folded_net_says_the_same(saturation, command):
    net = FeasibilityNet(
        POINTS, hidden=(16, 8), vae_hidden=(24, 12), latent=5, saturation=saturation
    )
    torch.manual_seed(0)
    for weight in net.parameters():  # not the small ones of a fresh net
        nn.init.normal_(weight, std=0.5)
    patch, told = 0.3 * torch.randn(200, POINTS), torch.tensor(command)
    heights, folded = net.relief(patch), net.folded(told)
    close = torch.testing.assert_close
    close(
        folded.feasibility(patch), net.feasibility(patch, told.expand(200, -1)), rtol=0, atol=1e-6
    )
    close(folded.reconstruction(heights), net.losses(heights)[0], rtol=1e-5, atol=1e-5)
    assert folded.feasibility(patch).std() > 0.1


def test_loss_by_hand(blank):
    with torch.no_grad():
        blank.encoder[-1].bias[:3] = 2.0  # latent mean 2, log-variance 0, in 3 dimensions
    patch, command = torch.full((2, POINTS), 0.5), torch.zeros(2, 3)
    total, parts = blank.loss(patch, command, torch.tensor([0.5, 1.0]), alpha=0.1, beta=0.01)
    # f = 0.5: errors 0 and 0.5, mean square 0.125. KL = 3 * 0.5 * (2^2 + 1 - 1 - 0) = 6.
    assert parts["feasibility"].item() == pytest.approx(0.125)
    assert parts["reconstruction"].item() == pytest.approx(1.5)
    assert parts["kl"].item() == pytest.approx(6.0)
    assert total.item() == pytest.approx(0.125 + 0.1 * (1.5 + 0.01 * 6.0))


def test_divergence_equals_torchs(net):
    patch = torch.randn(7, POINTS)
    mean, log_variance = net.encoder(patch).chunk(2, dim=-1)
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(torch.zeros_like(mean), torch.ones_like(mean))
    expected = torch.distributions.kl_divergence(posterior, prior).sum(dim=-1).mean()
    _, parts = net.loss(patch, torch.zeros(7, 3), torch.zeros(7))
    torch.testing.assert_close(parts["kl"], expected)


def test_latent_is_sampled_in_training_only(net):
    patch, command, r_v = torch.randn(4, POINTS), torch.zeros(4, 3), torch.zeros(4)

    def total(seed: int) -> float:
        return net.loss(patch, command, r_v, generator=torch.Generator().manual_seed(seed))[
            0
        ].item()

    net.train()
    assert total(1) == total(1) != total(2)
    net.eval()
    assert total(1) == total(2)


def test_learning_tells_its_terrain_from_another(net):
    generator = torch.Generator().manual_seed(0)
    ramps = torch.linspace(-1, 1, POINTS) * torch.rand(64, 1, generator=generator)
    up = torch.ones(64, 3)
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(300):
        optimiser.zero_grad()
        net.loss(ramps, up, ramps[:, -1], generator=generator)[0].backward()
        optimiser.step()
    with torch.no_grad():
        assert net.reconstruction(ramps).mean() < 0.1
        assert net.reconstruction(-ramps[ramps[:, -1] > 0.5]).mean() > 0.5
        assert (net.feasibility(ramps, up) - ramps[:, -1]).abs().mean() < 0.1
