"""Forked child processes: one thread each, because the threads of a pool do not survive a fork."""

from __future__ import annotations

import os
import sys


def use_one_thread_after_fork() -> None:
    """Make every process that is forked from this one compute with one thread in torch and OpenCV.

    The first estimate of a process starts torch's threads. A forked child inherits the pool but not its threads, and
    would wait for them for ever. `fork` is the default start method of multiprocessing on Linux up to Python 3.13.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    # 0 makes OpenCV compute without its pool; 1 would make it join threads that do not exist here.
    for library, function, threads in (("torch", "set_num_threads", 1), ("cv2", "setNumThreads", 0)):
        # A library that is still being imported has no threads yet.
        set_threads = getattr(sys.modules.get(library), function, None)
        if set_threads is not None:
            set_threads(threads)
