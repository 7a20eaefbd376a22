"""Threads of linear algebra, and of a worker, so that several workers on one machine share its cores."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of the environment that the libraries of linear algebra read when they are loaded."""


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let the linear algebra below NumPy and SciPy use one thread in this block; the former number returns after it.

    The matrices of an estimate are small. More threads do not make them faster, and wait for work by spinning, which
    takes a third of the processor's time in a scene of many objects.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    import scipy.linalg  # brings a library of its own  # noqa: F401

    return ThreadpoolController()


@contextmanager
def shared_environment(workers: int) -> Iterator[None]:
    """Start processes in this block, whose linear algebra then uses their share of the cores.

    The libraries below NumPy and SciPy start as many threads as the machine has cores, and their threads wait for work
    by spinning. What the user has set stays.

    Args:
        workers: number of processes that compute side by side on this machine.
    """
    added = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(added, str(_share(workers))))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def share_cores(workers: int | None) -> None:
    """Make torch and OpenCV use this process's share of the cores.

    Args:
        workers: number of processes that compute side by side on this machine; None for one thread, as on a cluster
            that gives each worker one core.
    """
    import cv2
    import torch

    count = 1 if workers is None else _share(workers)
    cv2.setNumThreads(count)
    torch.set_num_threads(count)


def _share(workers: int) -> int:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // workers)
