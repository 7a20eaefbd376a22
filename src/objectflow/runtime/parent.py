"""Child processes that end with their parent, even in the middle of a job."""

from __future__ import annotations

import os
import threading
import time

_INTERVAL = 0.5
"""Seconds between two looks at the parent."""


def end_with_parent(parent: int) -> None:
    """Watch the parent of this process in a thread, and end this process once the parent has ended.

    The kernel hands an orphan to another process, so its parent's number changes. A signal of the kernel
    (PR_SET_PDEATHSIG) would be sent when the parent's thread ends, and on Linux only.

    Args:
        parent: process number of the parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_INTERVAL)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()
