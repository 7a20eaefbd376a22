"""Timing for benchmarks that run in one process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")


def time_each(work: Callable[[Item], object], items: Iterable[Item], device: str = "cpu") -> list[float]:
    """Wall-clock seconds per item, without the first item, which is a warm-up; CUDA work is synchronised."""
    seconds = []
    for item in items:
        start = time.perf_counter()
        work(item)
        if device == "cuda":
            import torch

            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return seconds[1:]
