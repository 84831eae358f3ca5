"""Thresholds, ISTA and its relatives: optimality conditions, an independent solver, and hand-made cases."""

from itertools import pairwise

import cvxpy as cp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

from nrsfm_lite import sparse_coding as sc


def draw(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.double, generator=torch.Generator().manual_seed(seed))


def lasso(n, K, seed, share=0.2, problems=3):
    """Random problems; λ is a share of the smallest one for which z = 0 is the answer."""
    D, x = draw(n, K, seed=seed), draw(problems, n, seed=seed + 1)
    lam = share * (x @ D).abs().amax(1, keepdim=True)
    return D, x, lam


def lasso_violation(D, x, z, lam):
    """How far z is from the optimality conditions of ½‖x − Dz‖² + λ‖z‖₁."""
    pull = (x - z @ D.mT) @ D  # Dᵀ(x − Dz): equal to λ sign(z) where z ≠ 0, at most λ elsewhere
    return torch.where(z != 0, (pull - lam * z.sign()).abs(), torch.relu(pull.abs() - lam)).max()


def block_violation(D, W, Z, lam, visible=None):
    """The same for ½‖Ω(W − Σ D_k Z_k)‖² + λ Σ‖Z_k‖_F."""
    residual = W - torch.einsum("kpi,bkij->bpj", D, Z)
    if visible is not None:
        residual = residual * visible[..., None]
    pull = torch.einsum("kpi,bpj->bkij", D, residual)
    length = Z.flatten(2).norm(dim=2)
    active = (pull - lam * Z / length.clamp(min=1e-300)[..., None, None]).flatten(2).norm(dim=2)
    return torch.where(length > 0, active, torch.relu(pull.flatten(2).norm(dim=2) - lam)).max()


sizes = {"n": st.integers(2, 15), "K": st.integers(1, 30), "seed": st.integers(0, 10**6)}


@settings(max_examples=30, deadline=None)
@given(**sizes, share=st.floats(0.05, 0.9), nonnegative=st.booleans())
def test_fista_meets_the_optimality_conditions(n, K, seed, share, nonnegative):
    D, x, lam = lasso(n, K, seed, share)
    z = sc.fista(D, x, lam, steps=20_000, tol=1e-14, nonnegative=nonnegative)
    if nonnegative:
        assert (z >= 0).all()
        pull = (x - z @ D.mT) @ D
        assert torch.where(z > 0, (pull - lam).abs(), torch.relu(pull - lam)).max() < 1e-6
    else:
        assert lasso_violation(D, x, z, lam) < 1e-6


@settings(max_examples=15, deadline=None)
@given(**sizes, share=st.floats(0.2, 0.9))
def test_ista_meets_the_optimality_conditions(n, K, seed, share):
    D, x, lam = lasso(n, K, seed, share)
    assert lasso_violation(D, x, sc.ista(D, x, lam, steps=50_000, tol=1e-13), lam) < 1e-6


@settings(max_examples=15, deadline=None)
@given(P=st.integers(3, 10), K=st.integers(1, 8), seed=st.integers(0, 10**6), hide=st.booleans())
def test_block_ista_meets_the_optimality_conditions(P, K, seed, hide):
    D, W = draw(K, P, 3, seed=seed), draw(3, P, 2, seed=seed + 1)
    visible = draw(3, P, seed=seed + 2) > -0.8 if hide else None
    seen = W if visible is None else W * visible[..., None]
    lam = 0.3 * torch.einsum("kpi,bpj->bkij", D, seen).flatten(2).norm(dim=2).max().item() + 1e-3
    Z = sc.block_ista(D, W, lam, visible=visible, steps=20_000, tol=1e-14, accelerate=True)
    assert block_violation(D, W, Z, lam, visible) < 1e-6


def test_ista_and_fista_equal_an_independent_solver():
    D, x, lam = lasso(8, 20, seed=5)
    for problem in range(3):
        z = cp.Variable(20)
        l1 = float(lam[problem]) * cp.norm1(z)
        cp.Problem(cp.Minimize(0.5 * cp.sum_squares(D.numpy() @ z - x[problem].numpy()) + l1)).solve(cp.CLARABEL)
        for method in (sc.ista, sc.fista):
            mine = method(D, x[problem], lam[problem], steps=20_000, tol=1e-13)
            np.testing.assert_allclose(mine, z.value, atol=1e-5)


def test_block_ista_equals_an_independent_solver():
    D, W, lam = draw(6, 8, 3, seed=2), draw(1, 8, 2, seed=3), 4.0
    visible = torch.ones(1, 8, dtype=torch.bool)
    visible[0, 2] = False
    Z = [cp.Variable((3, 2)) for _ in range(6)]
    residual = W[0].numpy() - sum(D[k].numpy() @ Z[k] for k in range(6))
    fit = 0.5 * cp.sum_squares(cp.multiply(visible[0].double().numpy()[:, None] @ np.ones((1, 2)), residual))
    cp.Problem(cp.Minimize(fit + lam * sum(cp.norm(z, "fro") for z in Z))).solve(cp.CLARABEL)
    mine = sc.block_ista(D, W, lam, visible=visible, steps=20_000, tol=1e-13)[0]
    np.testing.assert_allclose(mine, np.stack([z.value for z in Z]), atol=1e-4)
    assert 0 < (mine.flatten(1).norm(dim=1) > 0).sum() < 6, "some blocks active, some not"


def test_soft_threshold_by_hand():
    x = torch.tensor([-3.0, -1.0, 0.0, 0.5, 2.0])
    assert sc.soft_threshold(x, 1.0).tolist() == [-2, 0, 0, 0, 1]
    assert sc.soft_threshold(x, 1.0, nonnegative=True).tolist() == [0, 0, 0, 0, 1]


def test_thresholds_are_proximal_maps():
    """No random competitor has a smaller ½‖u − v‖² + τ·penalty(u)."""
    V, tau = draw(4, 3, 2), 0.8
    others = draw(5000, 4, 3, 2, seed=1)
    cost = {
        "entries": lambda U: 0.5 * (U - V).square().flatten(-3).sum(-1) + tau * U.abs().flatten(-3).sum(-1),
        "blocks": lambda U: 0.5 * (U - V).square().flatten(-3).sum(-1) + tau * U.flatten(-2).norm(dim=-1).sum(-1),
    }
    for name, best in [
        ("entries", sc.block_soft_threshold(V, tau, exact=False)),
        ("blocks", sc.block_soft_threshold(V, tau)),
    ]:
        near = best + 0.01 * others
        assert cost[name](best) <= cost[name](near).min() and cost[name](best) <= cost[name](others).min()


def test_block_threshold_keeps_the_direction_and_takes_one_threshold_per_block():
    Z = draw(5, 4, 3, 2)
    tau = torch.tensor([0.0, 0.5, 1.0, 100.0], dtype=torch.double)
    T = sc.block_soft_threshold(Z, tau)
    length = Z.flatten(2).norm(dim=2)
    torch.testing.assert_close(T, Z * (torch.relu(length - tau) / length)[..., None, None])
    assert not T[:, 3].any()


def test_gradients_pass_through():
    D, x, lam = lasso(4, 6, seed=1, problems=2)
    D.requires_grad_()
    assert gradcheck(lambda D: sc.ista(D, x, lam, steps=5, step_size=0.05), (D,))
    assert gradcheck(lambda D: sc.fista(D, x, lam, steps=5, step_size=0.05), (D,))
    zero = torch.zeros(2, 3, 2, requires_grad=True)
    sc.block_soft_threshold(zero, 0.5).sum().backward()
    assert torch.isfinite(zero.grad).all()


def test_the_objective_never_rises_with_ista():
    D, x, lam = lasso(10, 25, seed=3, problems=1)

    def objective(z):
        return float(0.5 * (x - z @ D.mT).square().sum() + lam * z.abs().sum())

    values = [objective(sc.ista(D, x, lam, steps=k)) for k in range(0, 40)]
    assert all(b <= a + 1e-12 for a, b in pairwise(values))
    assert objective(sc.fista(D, x, lam, steps=40)) < values[-1]


def test_problems_of_a_batch_do_not_meet():
    D, x, lam = lasso(6, 12, seed=4, problems=5)
    for method in (sc.ista, sc.fista):
        together = method(D, x, lam, steps=200)
        alone = torch.stack([method(D, x[i], lam[i], steps=200) for i in range(5)])
        torch.testing.assert_close(together, alone)


def test_hidden_points_do_not_matter_to_block_ista():
    D, W = draw(5, 7, 3), draw(4, 7, 2, seed=1)
    visible = draw(4, 7, seed=2) > 0
    other = torch.where(visible[..., None], W, torch.nan)
    for exact in (True, False):
        a, b = (sc.block_ista(D, w, 0.3, visible=visible, exact=exact, steps=50) for w in (W, other))
        torch.testing.assert_close(a, b)


def test_elementwise_block_ista_is_the_lasso_of_the_entries():
    """With one λ and the elementwise threshold the blocks fall apart into plain ISTA on D♯."""
    D, W = draw(4, 6, 3), draw(2, 6, 2, seed=1)
    Z = sc.block_ista(D, W, 0.7, exact=False, steps=3000)
    sharp = torch.cat(list(D), dim=1)  # D♯ (P, 3K)
    z = sc.ista(sharp, W.mT, 0.7, steps=3000)  # (2, 2, 3K): each image column on its own
    torch.testing.assert_close(Z, z.view(2, 2, 4, 3).permute(0, 2, 3, 1))


def test_hierarchical_code_is_the_forward_pass_or_the_solution_of_each_layer():
    Ds, x = [draw(5, 8), draw(8, 6, seed=1)], draw(3, 5, seed=2)
    one = sc.hierarchical_code(Ds, x, [0.1, 0.2])
    first = torch.relu(x @ Ds[0] - 0.1)
    torch.testing.assert_close(one, [first, torch.relu(first @ Ds[1] - 0.2)])
    full = sc.hierarchical_code(Ds, x, [0.1, 0.2], steps=500, nonnegative=False)
    torch.testing.assert_close(full[0], sc.fista(Ds[0], x, 0.1, steps=500))
    torch.testing.assert_close(full[1], sc.fista(Ds[1], full[0], 0.2, steps=500))


def test_lipschitz_is_the_largest_eigenvalue():
    D = draw(6, 9)
    assert sc.lipschitz(D) == pytest.approx(torch.linalg.eigvalsh(D.mT @ D).max().item())
    D = draw(4, 6, 3)
    sharp = torch.cat(list(D), dim=1)
    assert sc.lipschitz(D) == pytest.approx(sc.lipschitz(sharp).item())


def cosines(D):
    unit = D / np.linalg.norm(D, axis=0)
    return np.abs(unit.T @ unit) - np.eye(D.shape[1])


def test_coherence_and_babel_against_every_pair(rng):
    D = rng.normal(size=(5, 8))
    assert sc.mutual_coherence(D) == pytest.approx(cosines(D).max())
    assert sc.babel(D, 1) == pytest.approx(sc.mutual_coherence(D))
    assert sc.babel(D, 3) == pytest.approx(max(np.sort(row)[-3:].sum() for row in cosines(D)))


def test_coherence_of_special_dictionaries():
    assert sc.mutual_coherence(np.eye(4)) == 0
    assert sc.mutual_coherence(np.array([[1.0, -2.0], [1.0, -2.0]])) == pytest.approx(1)
    assert sc.mutual_coherence(np.eye(3, dtype=int)) == 0, "whole numbers are numbers"
    assert sc.mutual_coherence(np.array([[1.0, 0.0], [0.0, 0.0]])) == 0, "a column of zeros is orthogonal to all"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sc.soft_threshold(draw(3), -1.0), "negative"),
        (lambda: sc.ista(draw(4, 6), draw(5), 0.1), "do not fit"),
        (lambda: sc.block_ista(draw(4, 6), draw(2, 6, 2), 0.1), "do not fit"),
        (lambda: sc.block_ista(draw(3, 6, 3), draw(2, 5, 2), 0.1), "do not fit"),
        (lambda: sc.block_ista(draw(3, 6, 3), draw(2, 6, 2), 0.1, visible=torch.ones(2, 5) > 0), "visible has shape"),
        (lambda: sc.hierarchical_code([draw(4, 6)], draw(4), [0.1, 0.2]), "1 dictionaries, but 2 thresholds"),
        (lambda: sc.mutual_coherence(np.ones((3, 1))), "K >= 2"),
        (lambda: sc.babel(np.eye(3), 3), "1 … 2"),
        (lambda: sc.babel(np.eye(3), 1.5), "m=1.5"),
        (lambda: sc.soft_threshold(draw(3), np.nan), "negative or NaN"),
        (lambda: sc.block_soft_threshold(draw(3, 2), 0.1), r"expected \(\.\.\., K, a, b\)"),
        (lambda: sc.lipschitz(draw(3)), r"D has shape \(3,\)"),
        (lambda: sc.ista(draw(4, 6), draw(4), 0.1, steps=2.5), "steps=2.5"),
        (lambda: sc.ista(draw(4, 6), draw(4), 0.1, step_size=0.0), "step_size=0.0"),
        (lambda: sc.fista(draw(4, 6), draw(4), 0.1, tol=-1), "tol=-1"),
        (lambda: sc.hierarchical_code([draw(4, 6)], draw(4), [0.1], steps=-1), "steps=-1"),
        (lambda: sc.block_ista(draw(3, 6, 3), torch.nan * draw(2, 6, 2), 0.1), "mark missing points as False"),
        (lambda: sc.block_ista(draw(3, 6, 3), draw(2, 6, 2), 0.1, visible=draw(2, 6)), "visible has values of type"),
    ],
)
def test_wrong_input_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
