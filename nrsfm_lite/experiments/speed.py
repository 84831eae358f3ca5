"""How fast a training step and inference are, beside the convolution form and the bare matrix products."""

import time
from itertools import pairwise
from statistics import median, quantiles

import torch

from ..gradient import backpropagate
from ..model import DeepNRSfM
from ..threads import use_threads
from ..training import SCHEDULES, make_optimizers
from .lab.convolution import ConvolutionNet

QUESTION = "How far is a training step from its bare matrix products, and from the paper's convolutions?"
_POINTS = 31
_ROUNDS = 9


def cases(quick: bool) -> list[dict[str, object]]:
    """Device, threads and batch size; a GPU only where there is one."""
    batches = (32,) if quick else (32, 128, 512, 2048)
    rows = [{"device": "cpu", "threads": t, "batch": b} for t in ((1,) if quick else (1, 2)) for b in batches]
    if torch.cuda.is_available():
        rows += [{"device": "cuda", "threads": 1, "batch": b} for b in batches]
    return rows


def conditions(quick: bool) -> dict[str, object]:
    """What all cases share."""
    return {
        "network": "the default, 31 points, float32",
        "step": "forward, backward and fused Adam, of the package as `fit` runs it, and of the convolution form",
        "floor": "3 times the bare matrix products of the forward pass, nothing added",
        "default_step": "the same with the default schedule's optimiser, Muon on the inner dictionaries",
        "ratios": f"median, with quartiles, over {_ROUNDS} rounds, in each of which all were timed in turn",
    }


def measure(device: str, threads: int, batch: int) -> dict[str, object]:
    """Milliseconds of each, and the ratios of those timed in the same round."""
    torch.manual_seed(0)
    X = torch.randn(batch, _POINTS, 2, device=device)
    timed = {
        "step": _package_step(X, "original"),
        "default_step": _package_step(X, "default"),
        "convolution": _convolution_step(X),
        "products": _products(batch, device),
        "inference": _inference(X),
    }
    repeats = max(3, 1024 // batch)
    with use_threads(threads):
        for function in timed.values():
            _seconds(function, 3, device)
        rounds = [{name: _seconds(f, repeats, device) for name, f in timed.items()} for _ in range(_ROUNDS)]
    ms = {name: 1e3 * median(r[name] for r in rounds) for name in timed}
    return {
        "step_ms": ms["step"],
        "default_step_ms": ms["default_step"],
        "convolution_ms": ms["convolution"],
        "floor_ms": 3 * ms["products"],
        **_spread("step_over_floor", [r["step"] / (3 * r["products"]) for r in rounds]),
        **_spread("convolution_over_step", [r["convolution"] / r["step"] for r in rounds]),
        "inference_frames_per_s": 1e3 * batch / ms["inference"],
    }


def report(rows: list[dict[str, str]]) -> str:
    """The ratios, one line per case."""
    lines = []
    for r in rows:
        floor, convolution = float(r["step_over_floor"]), float(r["convolution_over_step"])
        lines.append(
            f"{r['device']:4s} {r['threads']} threads, batch {r['batch']:>4s}: step {float(r['step_ms']):7.2f} ms, "
            f"{floor:.2f} times the floor; convolutions take {convolution:.2f} times as long; "
            f"inference {float(r['inference_frames_per_s']):8.0f} frames/s"
        )
    return "\n".join(lines)


def _package_step(X, schedule):
    net = DeepNRSfM(n_points=_POINTS).to(X.device)
    size = X.flatten(1).norm(dim=1)
    optimizers = make_optimizers(net, SCHEDULES[schedule])

    def step():
        backpropagate(net, X, size=size)
        for optimizer in optimizers:
            optimizer.step()

    return step


def _convolution_step(X):
    net = ConvolutionNet(DeepNRSfM(n_points=_POINTS)).to(X.device)
    size = X.flatten(1).norm(dim=1)
    optimizer = torch.optim.Adam(net.parameters(), 1e-3, fused=True)

    def step():
        S, M = net(X)
        loss = ((X - S @ M).flatten(1).norm(dim=1) / size).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def _products(batch, device):
    """Every matrix product of the forward pass, on numbers of the right shapes."""
    net = DeepNRSfM(n_points=_POINTS).to(device)
    K, P = net.config.widths, _POINTS

    def random(*shape):
        return torch.randn(*shape, device=device)

    pairs = [(random(2 * batch, P), random(P, 3 * K[0]))]  # first layer
    pairs += [(random(6 * batch, a), random(a, b)) for a, b in pairwise(K)]
    pairs += [(random(batch, 6 * K[-1]), random(6 * K[-1], K[-1]))]  # code
    pairs += [(random(6 * batch, K[-1]), random(K[-1], 1))]  # camera
    pairs += [(random(batch, b), random(b, a)) for a, b in pairwise(K)]  # decoder
    pairs += [(random(batch, K[0]), random(K[0], 3 * P))]  # shape
    pairs += [(random(batch, P, 3), random(batch, 3, 2))]  # projection

    def products():
        for a, b in pairs:
            a @ b

    return products


def _inference(X):
    net = DeepNRSfM(n_points=_POINTS).to(X.device)

    @torch.no_grad()
    def forward():
        net(X)

    return forward


def _seconds(function, repeats, device):
    """Median seconds of one call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return median(times)


def _spread(name, values):
    low, middle, high = quantiles(values, n=4)
    return {name: middle, f"{name}_low": low, f"{name}_high": high}
