"""Callbacks of the training loop: none, a terminal with a progress bar, TensorBoard, or several of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from objectflow.training.validation import Validation


class Callback:
    """The hooks of a run; this base class does nothing."""

    def start(self, step: int, total: int | None) -> None:
        """The run starts or continues at a step; the total is None if time limits the run."""

    def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
        """A line of metrics was written after a step; `progress` is the share of the run that is done, 0..1."""

    def validated(self, step: int, result: Validation, best: bool) -> None:
        """A validation is done; `best` tells whether its score is the lowest so far."""

    def note(self, text: str) -> None:
        """One line of information for the user."""

    def close(self) -> None:
        """The run has ended."""


class Terminal(Callback):
    """A progress bar with pairs per second, and a line per validation; without a terminal, a line per minute."""

    def __init__(self, *, every_seconds: float = 60.0) -> None:
        self._console = Console(highlight=False, soft_wrap=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=self._console, disable=not self._console.is_terminal, transient=True)
        self._task = self._bar.add_task("training", total=1.0)
        self._every, self._last, self._total = every_seconds, float("-inf"), ""

    def start(self, step: int, total: int | None) -> None:
        """See `Callback`."""
        self._total = "" if total is None else f"/{total}"
        self._bar.start()
        self._bar.update(self._task, description=f"step {step}{self._total}")

    def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
        """See `Callback`."""
        text = f"step {step}{self._total}  loss {line['losses']['total']:.3f}  {line['pairs_per_second']:.1f} pairs/s"
        self._bar.update(self._task, completed=progress, description=text)
        if not self._console.is_terminal and line["seconds"] - self._last >= self._every:
            self._last = line["seconds"]
            self._console.print(text)

    def validated(self, step: int, result: Validation, best: bool) -> None:
        """See `Callback`."""
        self._console.print(
            f"step {step}: {result.pairs} validation pairs: loss {result.losses['total']:.3f}, masked EPE "
            f"{result.epe_cm:.2f} cm (zero flow {result.zero_epe_cm:.2f}), mean F {result.mean_f:.3f}, "
            f"extracted {result.extracted}/{result.true_objects}{', best so far' if best else ''}"
        )

    def note(self, text: str) -> None:
        """See `Callback`."""
        self._console.print(text, markup=False)

    def close(self) -> None:
        """See `Callback`."""
        self._bar.stop()


class TensorBoard(Callback):
    """Writes the same numbers for TensorBoard if it is installed; otherwise does nothing."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None

    def start(self, step: int, total: int | None) -> None:
        """See `Callback`."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        # An interrupted run wrote events past its checkpoint; they are written again and hidden by this.
        self._writer = SummaryWriter(str(self._folder), purge_step=step)

    def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
        """See `Callback`."""
        self._write(step, "train", {**line["losses"], "learning_rate": line["learning_rate"]})

    def validated(self, step: int, result: Validation, best: bool) -> None:
        """See `Callback`."""
        values = result.to_dict()
        losses = values.pop("losses")
        self._write(step, "validation", {**losses, **values})

    def close(self) -> None:
        """See `Callback`."""
        if self._writer is not None:
            self._writer.close()

    def _write(self, step: int, group: str, values: Mapping[str, float]) -> None:
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, step)


class CallbackList(Callback):
    """Passes every call on to several callbacks, in order."""

    def __init__(self, *callbacks: Callback) -> None:
        self._callbacks = callbacks

    def start(self, step: int, total: int | None) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.start(step, total)

    def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.line(step, progress, line)

    def validated(self, step: int, result: Validation, best: bool) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.validated(step, result, best)

    def note(self, text: str) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.note(text)

    def close(self) -> None:
        """See `Callback`."""
        for callback in self._callbacks:
            callback.close()
