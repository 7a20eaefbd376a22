"""Outputs of a viewer: the file it saves, the display of its window and the ports of its web page."""

from __future__ import annotations

import os
import socket
import sys
from contextlib import suppress
from pathlib import Path

from objectflow.errors import StorageError, ViewerError
from objectflow.storage.temporaries import Temporary, sweep, temporary_file


def temporary_beside(path: Path) -> Temporary:
    """Create an empty file beside `path`, so that an unwritable folder is reported before the work starts.

    Temporaries that killed processes left there are removed.

    Raises:
        StorageError: `path` is a folder, or its folder cannot be written.
    """
    if path.is_dir():
        raise StorageError(f"cannot write {path}: it is a folder: name a file, such as view.rrd")
    sweep(path.parent)
    try:
        return temporary_file(path.parent)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error


def check_display() -> None:
    """Check that a window can open; rerun's window is a separate process whose failure would go unnoticed.

    Raises:
        ViewerError: there is no display.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(
            "no display for the viewer's window: save a file (view --save, elsewhere --save-view), or view --web"
        )


def free_port(preferred: int) -> int:
    """A port that is not in use, `preferred` if possible.

    Raises:
        ViewerError: no port is free.
    """
    for port in (preferred, 0):
        with socket.socket() as probe:
            # Servers set this option too, so a port that was closed a moment ago counts as free.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with suppress(OSError):
                probe.bind(("0.0.0.0", port))
                return int(probe.getsockname()[1])
    raise ViewerError("no free port for the web viewer")
