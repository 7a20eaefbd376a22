"""Memory that a process has freed, kept for its next arrays."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Parameters of `mallopt` in the C library of GNU."""
_KEPT = 256 * 2**20
"""Bytes at the end of the heap that are kept when they are free."""
_LARGEST = 64 * 2**20
"""Bytes from which an array gets pages of its own, which are returned when it is freed."""


def keep_freed_memory() -> bool:
    """Keep the memory of freed arrays in this process.

    Each estimate allocates and frees the same hundreds of MiB. The C library returns large arrays to the kernel, which
    clears every page anew: about a twentieth of the time of a pair. The setting holds for the whole process, so that
    commands and workers use it, and the library leaves it to its user.

    Returns:
        Whether the C library has this setting; only that of GNU does.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, _KEPT)) and bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST))
