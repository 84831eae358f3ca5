"""How fast the network trains and infers on this machine."""

import time

import torch

from ..model import DeepNRSfM
from ..reconstruction import infer
from ..training import SCHEDULES, _loss, _optimizers


def main(n_points=31, repeats=20):
    """Print milliseconds per training step and frames per second of inference, one and all threads."""
    plan = SCHEDULES["default"]
    every = torch.get_num_threads()
    print(f"torch {torch.__version__}, {n_points} points, default network and optimiser, median of {repeats}")
    for threads in sorted({1, every}):
        torch.set_num_threads(threads)
        for batch in (32, 128, 512, 2048):
            net = DeepNRSfM(n_points=n_points)
            optimizers = _optimizers(net, plan)
            X, visible = torch.randn(batch, n_points, 2), torch.ones(batch, n_points, dtype=torch.bool)

            def step(net=net, optimizers=optimizers, X=X, visible=visible):
                for optimizer in optimizers:
                    optimizer.zero_grad()
                _loss(net, X, visible, X.flatten(1).norm(dim=1)).backward()
                for optimizer in optimizers:
                    optimizer.step()

            def forward(net=net, X=X, visible=visible):
                infer(net, X, visible, refine=False)

            print(
                f"{threads} threads, batch {batch:5d}: training step {1e3 * _median(step, repeats):7.2f} ms, "
                f"inference {batch / _median(forward, repeats):9.0f} frames/s"
            )
    torch.set_num_threads(every)


def _median(function, repeats):
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return sorted(times)[repeats // 2]


if __name__ == "__main__":
    main()
