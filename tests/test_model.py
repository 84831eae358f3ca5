"""The network against its equations written out, and what it promises of its output."""

import json

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite.experiments.convolution import ConvolutionNet


@pytest.fixture
def net():
    torch.manual_seed(0)
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=4, first_atoms=12, last_atoms=3)).double()
    with torch.no_grad():
        for p in [*net.encoder_threshold, *net.decoder_threshold, net.output_bias]:
            p.normal_(0, 0.05)
    return net


@pytest.fixture
def W():
    return torch.randn(6, 5, 2, dtype=torch.double, generator=torch.Generator().manual_seed(1))


def test_default_widths_are_the_papers():
    assert nl.Config(31).widths == np.linspace(125, 10, 12).astype(int).tolist()
    assert [tuple(D.shape) for D in nl.DeepNRSfM(n_points=31).D][:2] == [(125, 31, 3), (125, 114)]


def test_encoder_is_the_papers_with_kronecker_products(net, W):
    """Psi_1 = relu((D1#)ᵀ W − b1 ⊗ 1), Psi_i = relu((D_i ⊗ I3)ᵀ Psi_{i-1} − b_i ⊗ 1), in full."""
    ones = torch.ones(3, 2, dtype=torch.double)
    D1 = torch.cat(list(net.D[0]), dim=1)  # D1#: (P, 3 K1), one (P, 3) atom beside the other
    for w, code in zip(W, net.encode(W), strict=True):
        Psi = torch.relu(D1.T @ w - torch.kron(net.encoder_threshold[0][:, None], ones))
        for D, b in zip(list(net.D)[1:], list(net.encoder_threshold)[1:], strict=True):
            Psi = torch.relu(torch.kron(D, torch.eye(3, dtype=torch.double)).T @ Psi - torch.kron(b[:, None], ones))
        torch.testing.assert_close(code.permute(2, 1, 0), Psi.view(-1, 3, 2))


def test_decoder_is_the_papers(net):
    psi = torch.rand(6, 3, dtype=torch.double, generator=torch.Generator().manual_seed(2))
    expected = []
    for z in psi:
        for D, b in zip(list(net.D)[:0:-1], list(net.decoder_threshold)[::-1], strict=True):
            z = torch.relu(D @ z - b)
        expected.append(sum(z[k] * net.D[0][k] for k in range(len(z))) + net.output_bias)
    torch.testing.assert_close(net.decode(psi), torch.stack(expected))


def test_camera_is_the_polar_factor_of_the_weighted_blocks(net, W):
    Psi = net.encode(W)
    _, M = net.bottleneck(Psi)
    A = torch.einsum("bjik,k->bij", Psi, net.gamma)
    U, _, Vh = torch.linalg.svd(A, full_matrices=False)
    torch.testing.assert_close(M, U @ Vh)


def test_shared_beta_is_one_weight_per_entry_of_a_block(W):
    net = nl.DeepNRSfM(nl.Config(5, n_dictionaries=2, first_atoms=6, last_atoms=3, beta="shared")).double()
    Psi = net.encode(W)
    psi, _ = net.bottleneck(Psi)
    torch.testing.assert_close(psi, torch.einsum("ji,bjik->bk", net.beta.view(2, 3), Psi))


def test_soft_thresholds_keep_both_signs_and_read_the_code_in_magnitude(W):
    net = nl.DeepNRSfM(nl.Config(5, 3, 9, 4, threshold="soft")).double()
    with torch.no_grad():
        for b in net.encoder_threshold:
            b.fill_(0.05)
    Psi = net.encode(W)
    torch.testing.assert_close(net.encode(-W), -Psi)
    D1 = torch.cat(list(net.D[0]), dim=1)
    first = nl.sparse_coding.block_soft_threshold((D1.T @ W).view(6, 9, 3, 2), 0.05, exact=False)
    layer = nl.DeepNRSfM(nl.Config(5, 1, 9, 9, threshold="soft")).double()
    with torch.no_grad():
        layer.D[0].copy_(net.D[0])
        layer.encoder_threshold[0].fill_(0.05)
    torch.testing.assert_close(layer.encode(W).permute(0, 3, 2, 1), first)
    (psi, M), (turned, M_turned) = net.bottleneck(Psi), net.bottleneck(-Psi)
    torch.testing.assert_close((turned, M_turned), (psi, -M))  # a picture on its head: same shape


@pytest.mark.parametrize("dtype, rtol", [(torch.float, 1e-5), (torch.double, 1e-10)])
def test_the_convolution_form_is_the_same_function(dtype, rtol):
    g = torch.Generator().manual_seed(0)
    net = nl.DeepNRSfM(nl.Config(31), generator=g)
    with torch.no_grad():
        for D in list(net.D)[1:]:
            D *= 2  # else the codes of twelve layers die out
        for p in [*net.encoder_threshold, *net.decoder_threshold, net.output_bias]:
            p.normal_(0, 0.02, generator=g)
    net = net.to(dtype)
    conv = ConvolutionNet(net)
    X = torch.randn(8, 31, 2, dtype=dtype, generator=g)
    psi, M = net.bottleneck(net.encode(X))
    S = net.decode(psi)
    S2, M2 = conv(X)
    weights = torch.randn(8, 31, 2, dtype=dtype, generator=g)
    ours = torch.autograd.grad(((S @ M) * weights).sum(), list(net.D))
    theirs = torch.autograd.grad(((S2 @ M2) * weights).sum(), list(conv.kernels))
    theirs = [theirs[0][..., 0].permute(1, 0, 2), *(k[..., 0, 0] for k in theirs[1:])]
    for a, b in zip((S, M, *ours), (S2, M2, *theirs), strict=True):
        assert (a - b).abs().max() <= rtol * b.abs().max()


def test_output_is_orthonormal_centred_and_reprojects_best(net, W):
    S, M, t = net(W)
    torch.testing.assert_close(M.mT @ M, torch.eye(2, dtype=torch.double).expand(6, 2, 2))
    torch.testing.assert_close(S.mean(1), torch.zeros(6, 3, dtype=torch.double), atol=1e-12, rtol=0)
    torch.testing.assert_close(t, (W - S @ M).mean(1))


@pytest.mark.parametrize("projection", ["orthographic", "weak_perspective"])
def test_result_comes_back_in_the_users_units(W, projection):
    net = nl.DeepNRSfM(nl.Config(5, 3, 9, 3, projection=projection)).double()
    S, M, t = net(W)
    net.scale *= 50
    shift = torch.tensor([320.0, 240.0], dtype=torch.double)
    S2, M2, t2 = net(50 * W + shift)
    torch.testing.assert_close((S2, M2, t2), (50 * S, M, 50 * t + shift))


def test_hidden_points_do_not_reach_the_network(net, W):
    visible = torch.ones(6, 5, dtype=torch.bool)
    visible[:, 2] = False
    other = W.clone()
    other[:, 2] = torch.nan
    torch.testing.assert_close(net(other, visible), net(W, visible))


def test_a_dead_frame_gives_finite_gradients():
    """Thresholds so high that every code is zero: the camera block is degenerate in all frames."""
    net = nl.DeepNRSfM(n_points=5)
    with torch.no_grad():
        net.encoder_threshold[0].fill_(1e3)
    S, M, _ = net(torch.randn(4, 5, 2))
    (S @ M).square().sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_output_bias_is_optional():
    net = nl.DeepNRSfM(nl.Config(5, output_bias=False))
    assert not net.output_bias.requires_grad and not net.output_bias.any()


def test_to_arrays_and_back(net, W):
    config, weights = net.to_arrays()
    again = nl.DeepNRSfM.from_arrays(json.loads(json.dumps(config)), weights).double()
    torch.testing.assert_close(again(W), net(W))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_points": 2}, "n_points is 2"),
        ({"n_points": 5, "n_dictionaries": 0}, "n_dictionaries is 0"),
        ({"n_points": 5, "first_atoms": 4, "last_atoms": 8}, "first_atoms=4"),
        ({"n_points": 5, "beta": "none"}, "beta='none'"),
        ({"n_points": 5, "threshold": "hard"}, "threshold='hard'"),
        ({"n_points": 5, "projection": "fisheye"}, "projection='fisheye'"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        nl.Config(**settings)


def test_a_network_needs_its_number_of_points():
    with pytest.raises(ValueError, match="n_points or a Config"):
        nl.DeepNRSfM()
