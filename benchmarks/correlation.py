"""The fused correlation and weighted max-pool against the formulas as written: `python benchmarks/correlation.py`.

Prints milliseconds, peak memory above the inputs, and the ratios naive / fused, for the forward pass as in inference
and for forward and backward passes as in training. Every form runs in a separate process, so that peak memories are
comparable. The script fails if the two forms differ in their results.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import platform
import resource
import statistics
import sys
import time

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from objectflow.networks.sceneflownet import correlation


@dataclasses.dataclass
class Settings:
    """Measures the correlation at the network's sizes."""

    batches: tuple[int, ...] = (1, 2)
    """Batch sizes. The naive form takes 1.6 GB per pair."""
    height: int = 30
    """Height in cells; 30 x 40 is 240x320 at stride 8."""
    width: int = 40
    """Width in cells."""
    color_channels: int = 256
    """Channels of the correlated features."""
    shape_channels: int = 64
    """Channels of the pooled features."""
    reach: int = 10
    """L of the paper, in cells."""
    repeats: int = 5
    """Number of runs, of which the median is reported."""
    threads: int = 1
    """Threads of torch on the CPU."""


def run(form: str, features: list[Tensor], reach: int) -> Tensor:
    curr, prev, values = features
    if form == "fused":
        return correlation.weighted_max_pool(correlation.correlate(curr, prev, reach).relu(), values, reach)
    return correlation.weighted_max_pool_naive(correlation.correlate_naive(curr, prev, reach).relu(), values, reach)


def measure(
    form: str, backward: bool, device: str, batch: int, settings: Settings, queue: multiprocessing.Queue[list[float]]
) -> None:
    torch.set_num_threads(settings.threads)
    generator = torch.Generator().manual_seed(0)
    channels = (settings.color_channels, settings.color_channels, settings.shape_channels)
    features = [
        torch.randn(batch, c, settings.height, settings.width, generator=generator).to(device) for c in channels
    ]
    features[2] = features[2].relu()
    upstream = torch.randn(features[2].shape, generator=generator).to(device)
    # A small run first loads what torch initialises once.
    with torch.set_grad_enabled(backward):
        warm = run(form, [x[..., :4, :4].clone().requires_grad_(backward) for x in features], 1)
        if backward:
            torch.autograd.backward(warm.sum())
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated() / 2**20
    else:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    seconds, check = [], 0.0
    for _ in range(settings.repeats):
        inputs = [x.detach().requires_grad_(backward) for x in features]
        start = time.perf_counter()
        with torch.set_grad_enabled(backward):
            out = run(form, inputs, settings.reach)
            if backward:
                torch.autograd.backward(out, upstream)
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
        results = [x.grad for x in inputs if x.grad is not None] if backward else [out]
        check = sum(float((x.double().flatten() * _signs(x)).sum()) for x in results)
        scale = sum(float(x.double().norm()) for x in results)
    if device == "cuda":
        peak = torch.cuda.max_memory_allocated() / 2**20
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    queue.put([1000 * statistics.median(seconds), peak - before, check, scale])


def _signs(x: Tensor) -> Tensor:
    """A random sign per number, so that a signed sum differs if any number differs."""
    bits = torch.randint(2, (x.numel(),), generator=torch.Generator().manual_seed(1))
    return (2.0 * bits - 1).double().to(x.device)


def main(settings: Settings) -> None:
    cells = f"{settings.height}x{settings.width} cells, L = {settings.reach}, {settings.threads} threads"
    table = Table(title=f"{cells}, {platform.machine()}, torch {torch.__version__}")
    for column in ("device", "batch", "pass", "fused ms", "naive ms", "times", "fused MB", "naive MB", "times"):
        table.add_column(column, justify="right")
    context = multiprocessing.get_context("spawn")
    different = False
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        for batch in settings.batches:
            for backward in (False, True):
                found = {}
                for form in ("fused", "naive"):
                    queue: multiprocessing.Queue[list[float]] = context.Queue()
                    process = context.Process(target=measure, args=(form, backward, device, batch, settings, queue))
                    process.start()
                    process.join()
                    if process.exitcode:
                        sys.exit(f"{form}, batch {batch}: exit code {process.exitcode}; possibly out of memory")
                    found[form] = queue.get()
                (fused_ms, fused_mb, check, scale), (naive_ms, naive_mb, other, _) = found["fused"], found["naive"]
                different |= abs(check - other) > 1e-4 * scale
                figures = (f"{fused_ms:.0f}", f"{naive_ms:.0f}", f"{naive_ms / fused_ms:.1f}")
                memory = (f"{fused_mb:.0f}", f"{naive_mb:.0f}", f"{naive_mb / max(fused_mb, 1e-3):.1f}")
                table.add_row(device, str(batch), "both" if backward else "forward", *figures, *memory)
    Console(width=100).print(table)
    if different:
        sys.exit("the two forms differ by more than float32 rounding")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
