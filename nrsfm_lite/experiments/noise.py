"""Noisy images: trained and tested at each level (chapter 14)."""

import torch

from .. import baselines
from .lab import scoring

QUESTION = "How does the error grow with the noise of the images, and what do the thresholds do about it?"
_LEVELS = (0.0, 0.05, 0.1, 0.2, 0.3)
_CLASSICAL = {"rigid": baselines.tomasi_kanade, "pta": baselines.pta, "em_gaussian": baselines.em_gaussian}


def cases(quick: bool) -> list[dict[str, object]]:
    """Data, noise, method and seed."""
    data, levels, seeds = ("motion-small", (0.2,), 1) if quick else ("martial", _LEVELS, 3)
    rows = [(n, "network", s) for s in range(seeds) for n in levels]
    rows += [(n, m, 0) for m in _CLASSICAL for n in levels]
    return [{"data": data, "noise": n, "method": m, "seed": s} for n, m, s in rows]


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "noise": "norm of the noise over that of the centred image points, in every frame",
        "errors": "normalised 3D error against the noiseless shapes",
        "first_threshold": "mean of the first encoder threshold; active: share of positive entries of the first code",
        "pta": "rank 12, on frames in their order, each from its own camera, for which it is not made",
        "em_gaussian": "the shape prior from one rigid shape, no network",
        "steps": scoring.QUICK_STEPS if quick else "the default schedule's",
    }


def measure(data: str, noise: float, method: str, seed: int) -> dict[str, object]:
    """Errors of one training, or of a baseline."""
    if method == "network":
        net, result = scoring.train_and_score(data, seed, {"noise": noise})
        return {k: v for k, v in result.items() if not k.endswith("_hidden")} | _sparsity(net, data, noise)
    train, _ = scoring.views(data, noise=noise)
    rec = _CLASSICAL[method](train, progress=False)
    keys = ("seen", "unseen", "refined", "shift", "refined_unseen", "first_threshold", "active", "found_noise")
    seen = scoring.hidden_errors("seen", rec.shapes, train)["seen"]
    return dict.fromkeys(keys, "") | {"seen": seen}


def report(rows: list[dict[str, str]]) -> str:
    """Mean and spread over seeds, a line per level and method."""
    return scoring.by_groups(
        ("noise", "method"), ("seen", "refined", "refined_unseen", "first_threshold", "active", "found_noise"), rows
    )


@torch.no_grad()
def _sparsity(net, data, noise):
    """Thresholds, active entries, and σ of the shape prior over the root mean square of image coordinates."""
    train, _ = scoring.views(data, noise=noise)
    W = torch.as_tensor(train.points2d[::20])
    image, _, _ = net.normalize(W, torch.ones(W.shape[:2]))
    code = torch.relu(
        (image.float().mT.reshape(-1, train.n_points) @ net.first_dictionary()).view(-1, net.config.first_atoms)
        - net.encoder_threshold[0]
    )
    return {
        "first_threshold": float(net.encoder_threshold[0].mean()),
        "active": float((code > 0).float().mean()),
        "found_noise": net.prior[0].noise ** 0.5,
    }
