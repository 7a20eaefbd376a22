"""The viewer interface, with a null object for callers without a viewer."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Protocol, cast

from objectflow.view.viewer_frames import ViewerFrame


class Viewer(Protocol):
    """Shows frames; use it in a `with` block, which completes the saved file."""

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Show the frames that `make` returns; `NoViewer` never calls it, so it costs nothing."""

    def __enter__(self) -> Viewer: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class NoViewer:
    """A viewer that shows nothing."""

    def show(self, make: Callable[[], Iterable[ViewerFrame]]) -> None:
        """Do nothing."""

    def __enter__(self) -> NoViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


def open_viewer(
    title: str, *, window: bool = False, save: Path | None = None, web: bool = False, models: bool = False
) -> Viewer:
    """Open rerun's viewer, or a `NoViewer` if no output is requested.

    Args:
        title: of the recording.
        window: open rerun's window.
        save: write an .rrd file, which appears when the viewer is closed without an error.
        web: serve the web viewer; `RerunViewer.address` holds its address.
        models: add a tab with the models of objects.

    Raises:
        MissingExtraError: rerun is not installed.
        ViewerError: there is no display for a window, or no free port.
        StorageError: the file cannot be written.
    """
    if not (window or save or web):
        return NoViewer()
    # Imported here because rerun is optional and slow to import.
    module = importlib.import_module("objectflow.view.rerun_view")
    return cast(Viewer, module.RerunViewer(title, window=window, save=save, web=web, models=models))
