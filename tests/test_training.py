"""Training: it learns, it repeats itself, it resumes, and it never turns NaN."""

import dataclasses

import numpy as np
import pytest
import torch

import nrsfm_lite as nl
from nrsfm_lite import training

SMALL = nl.Config(6, n_dictionaries=3, first_atoms=16, last_atoms=4)


@pytest.fixture(scope="module")
def views():
    """A bending tetrahedron with two loose points."""
    rng = np.random.default_rng(0)
    S = rng.normal(size=(6, 3)) + 0.3 * rng.normal(size=(200, 1, 1)) * rng.normal(size=(6, 3))
    return nl.datasets.make_views(nl.Landmarks(points3d=S))


def reprojection(net, W):
    W = torch.as_tensor(W).float()
    with torch.no_grad():
        S, M, t = net(W)
    residual = (W - S @ M - t[:, None]).flatten(1).norm(dim=1)
    return float((residual / (W - W.mean(1, keepdim=True)).flatten(1).norm(dim=1)).mean())


@pytest.mark.parametrize("schedule", ["default", "original"])
def test_the_loss_falls(views, schedule):
    few, many = (nl.fit(views.points2d, None, SMALL, schedule=schedule, steps=n, progress=False) for n in (1, 300))
    assert reprojection(many, views.points2d) < 0.5 * reprojection(few, views.points2d)


def test_same_seed_same_weights_and_no_global_state_touched(views):
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    a, b, c = (nl.fit(views.points2d, None, SMALL, steps=20, seed=s, progress=False) for s in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), state) and torch.get_num_threads() == threads
    assert torch.equal(a.D[0], b.D[0]) and not torch.equal(a.D[0], c.D[0])


@pytest.mark.parametrize("schedule", ["default", "original"])
def test_interrupted_training_resumes_to_the_same_result(views, schedule, tmp_path, monkeypatch):
    def train(**more):
        return nl.fit(views.points2d, None, SMALL, schedule=schedule, steps=40, progress=False, **more)

    whole = train()
    monkeypatch.setattr(training, "_CHECKPOINT_EVERY", 15)
    backpropagate, calls = training.backpropagate, iter(range(25))

    def interrupted(*inputs, **more):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return backpropagate(*inputs, **more)

    monkeypatch.setattr(training, "backpropagate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(checkpoint=tmp_path / "state.pt")
    monkeypatch.setattr(training, "backpropagate", backpropagate)
    resumed = train(checkpoint=tmp_path / "state.pt")
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)
    assert not list(tmp_path.glob("*.part"))


def test_a_finished_checkpoint_trains_no_more(views, tmp_path, monkeypatch):
    train = {"steps": 10, "progress": False, "checkpoint": tmp_path / "state.pt"}
    first = nl.fit(views.points2d, None, SMALL, **train)
    monkeypatch.setattr(training, "backpropagate", None)  # would raise if called
    again = nl.fit(views.points2d, None, SMALL, **train)
    assert torch.equal(first.D[0], again.D[0])


def test_a_checkpoint_of_other_settings_is_refused(views, tmp_path):
    train = {"steps": 5, "progress": False, "checkpoint": tmp_path / "state.pt"}
    nl.fit(views.points2d, None, SMALL, seed=0, **train)
    with pytest.raises(ValueError, match="other data or settings"):
        nl.fit(views.points2d, None, SMALL, seed=1, **train)
    (tmp_path / "state.pt").write_bytes(b"PK\x03\x04 not a checkpoint")
    with pytest.raises(ValueError, match="broken"):
        nl.fit(views.points2d, None, SMALL, seed=0, **train)


def test_degenerate_frames_do_not_turn_the_loss_nan():
    """All points of a frame on one line: its best camera block has rank one."""
    rng = np.random.default_rng(0)
    W = rng.normal(size=(40, 6, 2))
    W[::2] = W[::2, :, :1] * (1.0, 2.0)
    net = nl.fit(W, None, SMALL, steps=200, progress=False)
    assert all(torch.isfinite(p).all() for p in net.parameters())
    assert np.isfinite(reprojection(net, W))


def test_a_nonfinite_gradient_costs_a_step_not_the_run(views, monkeypatch):
    backpropagate, calls = training.backpropagate, iter([False] * 5 + [True] + [False] * 20)

    def sometimes_infinite(net, *inputs, **more):
        loss = backpropagate(net, *inputs, **more)
        if next(calls):
            net.gamma.grad.fill_(torch.inf)
        return loss

    monkeypatch.setattr(training, "backpropagate", sometimes_infinite)
    net = nl.fit(views.points2d, None, SMALL, steps=20, progress=False)
    assert all(torch.isfinite(p).all() for p in net.parameters())


@pytest.mark.filterwarnings("ignore:Detected call of")  # the scheduler, before any step was taken
def test_a_run_that_has_diverged_says_so(views, monkeypatch):
    def not_a_number(net, *inputs, **more):
        net.gamma.grad = torch.full_like(net.gamma, torch.nan)
        return torch.tensor(torch.nan)

    monkeypatch.setattr(training, "backpropagate", not_a_number)
    with pytest.raises(FloatingPointError, match="no finite gradient since step 0"):
        nl.fit(views.points2d, None, SMALL, steps=200, progress=False)


def test_numpy_integers_are_integers(views, tmp_path):
    config = nl.Config(np.int64(6), np.int64(3), np.int64(16), np.int64(4))
    net = nl.fit(views, None, config, steps=2, seed=np.int64(3), checkpoint=tmp_path / "c.pt", progress=False)
    assert net.config == SMALL


def test_hidden_points_do_not_change_the_result(views):
    visible = np.ones((200, 6), bool)
    visible[::3, 2] = False
    a, b = np.where(visible[..., None], views.points2d, 7.0), np.where(visible[..., None], views.points2d, np.nan)
    nets = [nl.fit(W, visible, SMALL, steps=10, progress=False) for W in (a, b)]
    assert torch.equal(nets[0].D[0], nets[1].D[0])


def test_confidence_counts_in_training(views):
    confidence = np.ones((200, 6))
    confidence[:, 2] = 0.5
    doubted = nl.Landmarks(views.points2d, confidence=confidence)
    nets = [
        nl.fit(views, config=SMALL, steps=10, progress=False),
        nl.fit(views, config=SMALL, steps=10, confidence=confidence, progress=False),
        nl.fit(doubted, config=SMALL, steps=10, progress=False),
    ]
    assert torch.equal(nets[1].D[0], nets[2].D[0]) and not torch.equal(nets[0].D[0], nets[1].D[0])


def dead_frame():
    visible = np.ones((20, 6), bool)
    visible[7] = False
    return visible


def dead_point():
    visible = np.ones((20, 6), bool)
    visible[:, 4] = False
    return visible


def one_place():
    W = np.random.default_rng(0).normal(size=(20, 6, 2))
    W[3] = 5.0
    return W


@pytest.mark.parametrize(
    ("W", "more", "message"),
    [
        (np.zeros((20, 6, 3)), {}, r"expected \(F, P, 2\)"),
        (np.full((20, 6, 2), np.nan), {}, "visible points that are NaN"),
        (np.ones((20, 6, 2)), {"visible": np.ones((20, 5))}, r"visible has shape \(20, 5\)"),
        (np.full((20, 6, 2), 0.1), {}, "no shape to see"),
        (np.ones((20, 6, 2)), {"visible": dead_frame()}, "frame 7 of W has no visible point"),
        (np.ones((20, 6, 2)), {}, "no shape to see"),
        (one_place(), {"visible": dead_point()}, "point 4 is hidden in every frame of W; leave it out"),
        (one_place(), {}, "frame 3 of W has all its visible points at one place"),
        (one_place()[:2], {}, "at least 10 frames and 4 points; got 2 frames of 6 points"),
        (one_place()[:, :3], {}, "got 20 frames of 3 points"),
        (np.arange(240.0).reshape(20, 6, 2), {"config": nl.Config(5)}, "config.n_points is 5"),
        (np.ones((20, 6, 2)), {"schedule": "fast"}, "schedule='fast'"),
        (np.ones((20, 6, 2)), {"steps": 0}, "steps=0"),
    ],
)
def test_wrong_input_is_refused(W, more, message):
    with pytest.raises(ValueError, match=message):
        nl.fit(W, progress=False, **more)


def test_the_callers_default_dtype_does_not_matter(views):
    expected = nl.fit(views, config=SMALL, steps=5, progress=False)
    torch.set_default_dtype(torch.double)
    try:
        net = nl.fit(views, config=SMALL, steps=5, progress=False)
    finally:
        torch.set_default_dtype(torch.float)
    assert net.D[0].dtype == expected.D[0].dtype == torch.float


def test_a_schedule_of_ones_own_and_a_look_at_every_step(views):
    plan = dataclasses.replace(training.SCHEDULES["default"], steps=7, batch=16, pull=0.0)
    steps = []
    net = nl.fit(views, schedule=plan, progress=False, callback=lambda step, net: steps.append((step, net.coherence)))
    assert [s for s, _ in steps] == list(range(1, 8)) and steps[0][1] != steps[-1][1]
    assert net.prior is not None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"optimizer": "sgd"}, "optimizer='sgd'; expected one of muon, adam"),
        ({"optimizer": "muon"}, "needs a muon_rate above 0"),
        ({"optimizer": "adam", "muon_rate": 0.1}, "has no use for muon_rate"),
        ({"steps": 2.9}, "steps=2.9; expected a whole number, at least 1"),
        ({"batch": 0}, "batch=0"),
        ({"rate": 0.0}, "rate=0.0; expected a number above 0"),
        ({"rate": float("nan")}, "rate=nan"),
        ({"turn": 1.5}, "turn=1.5; expected a share of the steps"),
        ({"pull": -1}, "pull=-1"),
        ({"clip": 0}, "clip=0"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(wrong, message):
    fields = {"steps": 10, "batch": 8, "optimizer": "adam", "rate": 1e-3} | wrong
    with pytest.raises(ValueError, match=message):
        nl.Schedule(**fields)


def test_steps_are_not_cut_and_the_device_must_be_there(views):
    for wrong, message in [({"steps": 2.9}, "steps=2.9"), ({"device": "nonsense"}, "no such device here")]:
        with pytest.raises(ValueError, match=message):
            nl.fit(views, config=SMALL, progress=False, **wrong)
    with pytest.raises(FileNotFoundError, match="no such folder for the checkpoint"):
        nl.fit(views, config=SMALL, progress=False, checkpoint="nowhere/state.pt")


def test_a_prior_that_cannot_be_learned_does_not_cost_the_training(views, monkeypatch):
    def fails(*arguments, **settings):
        raise torch.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(training.shape_prior, "learn", fails)
    with pytest.warns(UserWarning, match="no shape prior could be learned.*not positive definite"):
        rec = nl.reconstruct(views, steps=5, progress=False)
    assert rec.model.prior is None and np.isfinite(rec.shapes).all()


@pytest.mark.parametrize("unit", [2.0**10, 2.0**-7, 1000.0, 0.0254])
def test_the_unit_of_length_does_not_matter(views, unit):
    W = views.points2d + np.array([3.0, -1.0])
    one, other = (nl.reconstruct(k * W, steps=30, progress=False) for k in (1.0, unit))
    exact = unit in (2.0**10, 2.0**-7)
    for a, b in [(other.shapes / unit, one.shapes), (other.cameras, one.cameras)]:
        np.testing.assert_allclose(a, b, rtol=0, atol=0 if exact else 1e-4)
