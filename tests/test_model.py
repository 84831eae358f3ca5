"""The network against its equations written out, and what it promises of its output."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite.experiments.lab.convolution import ConvolutionNet
from nrsfm_lite.model import EPSILON


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


def kronecker_form(net, X):
    """Shapes and cameras with every Kronecker product formed, frame by frame, and an SVD."""
    ones, eye = torch.ones(3, 2, dtype=X.dtype), torch.eye(3, dtype=X.dtype)
    first = torch.cat(list(net.D[0]), dim=1)  # D1#: (P, 3 K1)
    shapes, cameras = [], []
    for x in X:
        Psi = torch.relu(first.T @ x - torch.kron(net.encoder_threshold[0][:, None], ones))
        for D, b in zip(list(net.D)[1:], list(net.encoder_threshold)[1:], strict=True):
            Psi = torch.relu(torch.kron(D, eye).T @ Psi - torch.kron(b[:, None], ones))
        blocks = Psi.view(-1, 3, 2)  # (K_N, 3, 2)
        U, _, Vh = torch.linalg.svd(torch.einsum("kij,k->ij", blocks, net.gamma), full_matrices=False)
        psi = blocks.permute(2, 1, 0).flatten() @ net.beta
        for D, b in zip(list(net.D)[:0:-1], list(net.decoder_threshold)[::-1], strict=True):
            psi = torch.relu(D @ psi - b)
        S = first @ torch.kron(psi[:, None], eye)  # D1# (psi kron I3)
        shapes.append(S + net.output_bias)
        cameras.append(U @ Vh)
    return torch.stack(shapes), torch.stack(cameras)


def package_form(net, X):
    _, S, M = net.lift(X)
    return S, M


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float, 1e-5), (torch.double, 1e-10)])
def test_kronecker_convolution_and_matrix_products_are_one_function(dtype, rtol):
    g = torch.Generator().manual_seed(0)
    net = nl.DeepNRSfM(nl.Config(31), generator=g)
    with torch.no_grad():
        for D in list(net.D)[1:]:
            D *= 2  # else the codes of twelve layers die out
        for p in [*net.encoder_threshold, *net.decoder_threshold, net.output_bias]:
            p.normal_(0, 0.02, generator=g)
    net = net.to(dtype)
    conv = ConvolutionNet(net)
    X, weights = torch.randn(2, 8, 31, 2, dtype=dtype, generator=g)
    results = {}
    for name, (S, M), kernels in [
        ("products", package_form(net, X), list(net.D)),
        ("kronecker", kronecker_form(net, X), list(net.D)),
        ("convolution", conv(X), list(conv.kernels)),
    ]:
        gradients = torch.autograd.grad(((S @ M) * weights).sum(), kernels)
        if name == "convolution":
            gradients = [gradients[0][..., 0].permute(1, 0, 2), *(k[..., 0, 0] for k in gradients[1:])]
        results[name] = (S, M, *gradients)
    for name in ("kronecker", "convolution"):
        for a, b in zip(results["products"], results[name], strict=True):
            assert (a - b).norm() <= rtol * b.norm(), name


def test_output_is_orthonormal_centred_and_reprojects_best(net, W):
    S, M, t = net(W)
    torch.testing.assert_close(M.mT @ M, torch.eye(2, dtype=torch.double).expand(6, 2, 2))
    torch.testing.assert_close(S.mean(1), torch.zeros(6, 3, dtype=torch.double), atol=1e-12, rtol=0)
    torch.testing.assert_close(t, (W - S @ M).mean(1))


@pytest.mark.parametrize("projection", ["orthographic", "weak_perspective"])
def test_result_comes_back_in_the_users_units(W, projection):
    net = nl.DeepNRSfM(nl.Config(5, 3, 9, 3, projection=projection)).double()
    S, M, t = net(W)
    net.normalizer = replace(net.normalizer, scale=50.0)
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
        ({"n_points": 2}, "n_points=2; expected a whole number, at least 3"),
        ({"n_points": 5, "n_dictionaries": 0}, "n_dictionaries=0"),
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


def test_names_and_shapes_of_the_weights_are_stable():
    """Files saved today must load tomorrow."""
    shapes = {k: v.shape for k, v in nl.DeepNRSfM(nl.Config(5, 3, 8, 4)).to_arrays()[1].items()}
    assert shapes == {
        "beta": (24, 4), "gamma": (4,), "output_bias": (5, 3),
        "normalizer/scale": (), "normalizer/covariance": (5, 5), "normalizer/origin": (2,),
        "D.0": (8, 5, 3), "D.1": (8, 6), "D.2": (6, 4),
        "encoder_threshold.0": (8,), "encoder_threshold.1": (6,), "encoder_threshold.2": (4,),
        "decoder_threshold.0": (8,), "decoder_threshold.1": (6,),
    }  # fmt: skip


def test_translations_add_a_row_to_every_block():
    net = nl.DeepNRSfM(nl.Config(5, 3, 8, 4, translation=True))
    assert net.beta.shape == (32, 4) and net.D[0].shape == (8, 5, 3)
    W = torch.randn(7, 5, 2) + torch.tensor([3.0, -2.0])
    Psi = net.encode(W)
    assert Psi.shape == (7, 2, 4, 4)
    first = net.first_dictionary().view(5, 4, 8)
    torch.testing.assert_close(first[:, 3].abs(), torch.full((5, 8), EPSILON))
    assert (first[:, 3] > 0).sum() == (first[:, 3] < 0).sum()  # else a negative translation vanishes in every block
    S, M, t = net(W)
    assert S.shape == (7, 5, 3) and M.shape == (7, 3, 2) and t.shape == (7, 2)
    torch.testing.assert_close(S.mean(1), torch.zeros(7, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(t, W.mean(1))  # all visible: the image of the centroid is the mean


def test_a_hidden_point_does_not_matter_and_a_weight_of_zero_hides(net, W):
    visible = torch.ones(W.shape[:2], dtype=torch.bool)
    visible[:, 1] = False
    other = torch.where(visible[..., None], W, 1e6)
    results = [
        net(W, visible),
        net(other, visible),
        net(other, visible.float()),
        net(other, confidence=visible.double()),
    ]
    for a, *same in zip(*results, strict=True):
        for b in same:
            torch.testing.assert_close(a, b)


def test_save_and_load(net, W, tmp_path):
    net.normalizer = replace(net.normalizer, scale=2.0)
    again = nl.DeepNRSfM.load(net.save(tmp_path / "net.pt"))
    assert again.config == net.config and not again.training
    for a, b in zip(again(W), net(W), strict=True):
        assert torch.equal(a, b)


def test_what_is_not_a_network_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        nl.DeepNRSfM.load(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("hello")
    torch.save({"config": {"n_points": 5}, "weights": {}}, tmp_path / "other.pt")
    torch.save({"config": {"n_points": 5}, "arrays": {}}, tmp_path / "empty.pt")
    for name, words in [("text.pt", "not a saved"), ("other.pt", "not a saved"), ("empty.pt", "is incomplete")]:
        with pytest.raises(ValueError, match=f"{name}: .*{words}"):
            nl.DeepNRSfM.load(tmp_path / name)


@pytest.mark.filterwarnings("ignore")  # of the exporter's own making
@pytest.mark.parametrize("settings", [{}, {"threshold": "soft", "beta": "shared", "projection": "weak_perspective"}])
def test_onnx_is_the_same_function_for_any_number_of_frames(settings, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    g = torch.Generator().manual_seed(0)
    net = nl.DeepNRSfM(nl.Config(5, 3, 12, 4, **settings), generator=g)
    net.normalizer = replace(net.normalizer, scale=3.0)
    session = onnxruntime.InferenceSession(str(net.to_onnx(tmp_path / "net.onnx")))
    for frames in (1, 7):
        W = 10 * torch.randn(frames, 5, 2, generator=g) + 100
        visible = torch.rand(frames, 5, generator=g) > 0.2
        visible[:, :3] = True
        got = session.run(["S", "M", "t"], {"W": W.numpy(), "visible": visible.numpy()})
        with torch.no_grad():
            for a, b in zip(got, net(W, visible), strict=True):
                np.testing.assert_allclose(a, b.numpy(), rtol=1e-4, atol=1e-4)


def test_any_kind_of_array_goes_in_and_its_own_type_comes_out(W):
    net = nl.DeepNRSfM(nl.Config(5, 3, 12, 4), generator=torch.Generator().manual_seed(0))  # float32 inside
    expected = net(W)
    assert {x.dtype for x in expected} == {torch.double} and {x.dtype for x in net(W.float())} == {torch.float}
    visible = np.ones((6, 5), int)
    for other in (net(W.numpy()), net(W.tolist()), net(W, torch.ones(6, 5)), net(W.numpy(), visible)):
        for a, b in zip(other, expected, strict=True):
            torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)
    assert net((100 * W).long())[0].shape == (6, 5, 3)


def test_what_the_network_cannot_take_is_said(net, W):
    with pytest.raises(ValueError, match=r"W has shape \(6, 4, 2\); expected \(B, 5, 2\), as the network has 5 points"):
        net(W[:, :4])
    with pytest.raises(ValueError, match=r"W has shape \(5, 2\)"):
        net(W[0])
    with pytest.raises(ValueError, match=r"visible has shape \(6, 4\); expected \(6, 5\)"):
        net(W, torch.ones(6, 4))
    with pytest.raises(ValueError, match="visible points that are NaN"):
        net(torch.full_like(W, torch.nan))
    with pytest.raises(ValueError, match=r"visible holds 0\.5; expected truth values; weights are given as confidence"):
        net(W, torch.full((6, 5), 0.5))
    with pytest.raises(ValueError, match="confidence holds 2; expected 0 to 1"):
        net(W, confidence=torch.full((6, 5), 2.0))


def test_only_the_part_of_a_prior_that_is_in_use_is_kept(tmp_path):
    net = nl.DeepNRSfM(n_points=300)
    assert not [key for key in net.to_arrays()[1] if "prior" in key]
    small = net.save(tmp_path / "net.pt").stat().st_size
    assert small < 4 * sum(p.numel() for p in net.parameters()) + 8 * 300**2 + 50_000
    views = nl.datasets.make_views(nl.datasets.make_motion(60))
    fitted = nl.fit(views, steps=2, progress=False)
    assert len(fitted.prior) == 1
    again = nl.DeepNRSfM.load(fitted.save(tmp_path / "fitted.pt"))
    torch.testing.assert_close(again.prior[0].covariance, fitted.prior[0].covariance, rtol=0, atol=0)


@pytest.mark.parametrize("missing", ["normalizer/scale", "D.0", "prior/0/mean"])
def test_an_incomplete_network_is_refused(missing, tmp_path):
    net = nl.fit(nl.datasets.make_views(nl.datasets.make_motion(60)), steps=1, progress=False)
    config, arrays = net.to_arrays()
    del arrays[missing]
    with pytest.raises(ValueError, match="incomplete or of another version"):
        nl.DeepNRSfM.from_arrays(config, arrays)


def test_settings_are_not_cut():
    for wrong in (31.7, "31", True, None):
        with pytest.raises(ValueError, match="n_points="):
            nl.Config(wrong)
    assert nl.Config(31.0).n_points == 31
    with pytest.raises(ValueError, match="translation='no'; expected True or False"):
        nl.Config(31, translation="no")
