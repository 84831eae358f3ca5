"""The gradient that is written out, against autograd through the network itself."""

import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite.gradient import backpropagate


@pytest.fixture
def batch():
    g = torch.Generator().manual_seed(0)
    X = torch.randn(11, 7, 2, dtype=torch.double, generator=g)
    visible = torch.rand(11, 7, generator=g) > 0.2
    return X * visible[..., None], visible


def network(dtype=torch.double, **settings):
    net = nl.DeepNRSfM(nl.Config(7, 4, 20, 5, **settings), generator=torch.Generator().manual_seed(1)).to(dtype)
    with torch.no_grad():
        for p in [*net.encoder_threshold, *net.decoder_threshold]:
            p.uniform_(0, 0.05)
        net.output_bias.normal_(0, 0.1)
    return net


def by_autograd(net, X, visible, size, pull=0.0):
    psi, M = net.bottleneck(net.encode(X))
    residual = X - net.decode(psi) @ M
    if visible is not None or net.config.translation:
        weight = torch.ones(X.shape[:2]).to(X) if visible is None else visible.to(X)
        t = (residual * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)
        residual = (residual - t[:, None]) * weight[..., None].sqrt()
    loss = (residual.flatten(1).norm(dim=1) / size).mean()
    away = (net.decode(psi) - net.output_bias).flatten(1).norm(dim=1) / size
    objective = loss + pull * away.mean()
    return loss, torch.autograd.grad(objective, [p for p in net.parameters() if p.requires_grad])


@pytest.mark.parametrize("beta", ["full", "shared"])
@pytest.mark.parametrize("threshold", ["relu", "soft"])
def test_loss_and_gradient_are_autograds(batch, beta, threshold):
    net = network(beta=beta, threshold=threshold)
    X, visible = batch
    expected, gradients = by_autograd(net, X, visible, X.flatten(1).norm(dim=1))
    torch.testing.assert_close(backpropagate(net, X, visible), expected.detach(), rtol=1e-10, atol=0)
    for p, g in zip(net.parameters(), gradients, strict=True):
        torch.testing.assert_close(p.grad, g, rtol=1e-10, atol=1e-12)


def test_the_papers_own_loss_without_bias_in_float32(batch):
    net = network(torch.float, output_bias=False)
    X = batch[0].float()
    expected, gradients = by_autograd(net, X, None, torch.ones(11))
    torch.testing.assert_close(backpropagate(net, X, size=torch.ones(11)), expected.detach())
    for p, g in zip([p for p in net.parameters() if p.requires_grad], gradients, strict=True):
        torch.testing.assert_close(p.grad, g, rtol=1e-4, atol=1e-6)
    assert net.output_bias.grad is None


def test_the_pull_to_the_mean_shape_is_in_the_gradient_only(batch):
    net = network()
    X, visible = batch
    size = X.flatten(1).norm(dim=1)
    expected, gradients = by_autograd(net, X, visible, size, pull=0.7)
    torch.testing.assert_close(backpropagate(net, X, visible, size=size, pull=0.7), expected.detach())
    for p, g in zip(net.parameters(), gradients, strict=True):
        torch.testing.assert_close(p.grad, g, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("hidden", [True, False])
@pytest.mark.parametrize("beta", ["full", "shared"])
def test_translations_and_weights(batch, beta, hidden):
    net = network(beta=beta, translation=True)
    X = batch[0] + torch.randn(11, 1, 2, dtype=torch.double, generator=torch.Generator().manual_seed(2))
    weight = torch.rand(11, 7, dtype=torch.double, generator=torch.Generator().manual_seed(3)) * batch[1]
    X, weight = (X * (weight > 0)[..., None], weight) if hidden else (X, None)
    size = X.flatten(1).norm(dim=1)
    expected, gradients = by_autograd(net, X, weight, size)
    torch.testing.assert_close(backpropagate(net, X, weight), expected.detach(), rtol=1e-10, atol=0)
    for p, g in zip(net.parameters(), gradients, strict=True):
        torch.testing.assert_close(p.grad, g, rtol=1e-10, atol=1e-12)


def test_one_dictionary(batch):
    net = nl.DeepNRSfM(nl.Config(7, 1, 6, 6)).double()
    expected, gradients = by_autograd(net, *batch, batch[0].flatten(1).norm(dim=1))
    torch.testing.assert_close(backpropagate(net, *batch), expected.detach())
    for p, g in zip(net.parameters(), gradients, strict=True):
        torch.testing.assert_close(p.grad, g, rtol=1e-8, atol=1e-12)


def test_a_frame_hit_exactly_and_a_dead_network_have_finite_gradients():
    net = network()
    with torch.no_grad():
        net.encoder_threshold[0].fill_(1e3)  # every code is zero, every camera degenerate
        net.output_bias.zero_()
        for b in net.decoder_threshold:
            b.zero_()
    X = torch.zeros(3, 7, 2, dtype=torch.double)
    loss = backpropagate(net, X, size=torch.ones(3, dtype=torch.double))
    assert loss == 0 and all(torch.isfinite(p.grad).all() for p in net.parameters())
