"""Threads of a worker, so that several workers on one machine share its cores."""

from __future__ import annotations

import os


def share_cores(workers: int | None) -> None:
    """Make torch and OpenCV use this process's share of the cores.

    Args:
        workers: number of processes that compute side by side on this machine; None for one thread, as on a cluster
            that gives each worker one core.
    """
    import cv2
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = 1 if workers is None else max(1, cores // workers)
    cv2.setNumThreads(count)
    torch.set_num_threads(count)
