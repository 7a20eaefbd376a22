"""Runtime: seconds per pair, and the machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Runtime:
    """The runtime of a method's estimates, including pre-processing and grouping.

    Attributes:
        median, p95: seconds per pair, after the warm-up; NaN without pairs.
        pairs: number of pairs included.
        warm_up: number of pairs before them that are excluded.
        machine: where the method ran.
    """

    median: float
    p95: float
    pairs: int
    warm_up: int
    machine: str


def summarise_runtime(seconds: Sequence[float], *, warm_up: int = 1, machine: str | None = None) -> Runtime:
    """Summarise the seconds of pairs, in the order in which they were run.

    Args:
        seconds: of each pair.
        warm_up: number of pairs to exclude at the start (imports, kernels, caches), unless none would remain.
        machine: this machine if None.
    """
    skipped = min(warm_up, max(0, len(seconds) - 1))
    counted = np.asarray(seconds[skipped:], dtype=np.float64)
    median, p95 = np.quantile(counted, [0.5, 0.95]) if len(counted) else (np.nan, np.nan)
    return Runtime(float(median), float(p95), len(counted), skipped, machine or machine_name())


def machine_name() -> str:
    """The processor and the number of its cores that this process may use: "Intel Xeon, 2 cores, Linux"."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return f"{_processor()}, {usable} core{'' if usable == 1 else 's'}, {platform.system()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()
