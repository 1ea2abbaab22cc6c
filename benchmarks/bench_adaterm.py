"""Cost of a step of AdaTerm relative to torch.optim.Adam(foreach=True), for the paper's network, on one thread."""

from __future__ import annotations

import statistics
import time

import torch

from torchrl_tsallis.optim import AdaTerm

SHAPES = [(100, 28), (100,), (100,), (100, 100), (100,), (100,), (16, 100), (16,)]


def main(repeats: int = 200, steps: int = 10) -> float:
    """Prints and returns the ratio of the medians of interleaved repeats."""
    torch.set_num_threads(1)
    optimizers = {}
    for name in ("adaterm", "adam"):
        params = [torch.nn.Parameter(torch.randn(s)) for s in SHAPES]
        for p in params:
            p.grad = torch.randn_like(p)
        optimizers[name] = AdaTerm(params) if name == "adaterm" else torch.optim.Adam(params, foreach=True)
    times: dict[str, list[float]] = {name: [] for name in optimizers}
    for _ in range(repeats):
        for name, optimizer in optimizers.items():
            start = time.process_time()
            for _ in range(steps):
                optimizer.step()
            times[name].append((time.process_time() - start) / steps)
    medians = {name: statistics.median(x) for name, x in times.items()}
    ratio = medians["adaterm"] / medians["adam"]
    print(f"adaterm {medians['adaterm'] * 1e6:.0f} us, adam {medians['adam'] * 1e6:.0f} us, ratio {ratio:.2f}")
    return ratio


if __name__ == "__main__":
    main()
