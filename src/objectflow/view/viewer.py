"""A viewer that may be off: whoever shows something need not know."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Protocol, cast

from objectflow.view.viewer_frames import ViewerFrame


class Viewer(Protocol):
    """Shows moments; use it in a `with` block, which finishes a file that is saved."""

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Show what `make` returns; a viewer that is off never calls it, so that it costs nothing."""

    def __enter__(self) -> Viewer: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class NoViewer:
    """The viewer that is off."""

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Do nothing."""

    def __enter__(self) -> NoViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


def open_viewer(title: str, *, window: bool = False, save: Path | None = None, web: bool = False) -> Viewer:
    """The viewer that was asked for.

    Args:
        title: of the recording.
        window: open rerun's window.
        save: write an .rrd file, which appears when the viewer is closed without an error.
        web: serve the web viewer; its address is printed.

    Raises:
        MissingExtraError: rerun is not installed.
        ViewerError: there is no display for a window, or no port.
        StorageError: the file cannot be written.
    """
    if not (window or save or web):
        return NoViewer()
    # rerun is imported there alone, and only when somebody wants to see something.
    module = importlib.import_module("objectflow.view.rerun_view")
    return cast(Viewer, module.RerunViewer(title, window=window, save=save, web=web))
