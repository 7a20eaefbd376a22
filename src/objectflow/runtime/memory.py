"""Memory that a process has freed, kept for its next arrays."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Parameters of `mallopt` in the C library of GNU."""
_KEPT = 256 * 2**20
"""Bytes at the end of the heap that are kept when they are free."""
_LARGEST = 64 * 2**20
"""Bytes from which an array gets pages of its own, which are returned when it is freed."""


def keep_freed_memory() -> bool:
    """Keep the memory of freed arrays in this process.

    Each estimate allocates and frees the same hundreds of MiB. The C library returns large arrays to the kernel, which
    clears every page anew: about a twentieth of the time of a pair. All threads share what is kept, since side threads
    would otherwise keep as much again. The settings hold for the whole process, so that commands and workers use them,
    and the library leaves them to its user.

    Returns:
        Whether the C library has these settings; only that of GNU does.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((_M_TRIM_THRESHOLD, _KEPT), (_M_MMAP_THRESHOLD, _LARGEST), (_M_ARENA_MAX, 1))
    return all(bool(mallopt(*one)) for one in settings)
