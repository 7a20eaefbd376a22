"""A training run's output folder: settings, metrics line by line, checkpoints; only the same run may continue it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from objectflow.errors import StorageError, TrainingError
from objectflow.storage import files
from objectflow.storage.locked_folder import FolderKind, locked_folder
from objectflow.storage.serialize import to_plain
from objectflow.storage.temporaries import sweep
from objectflow.training.checkpoint import checkpoints
from objectflow.training.recipe import FREE

METRICS, WEIGHTS, CURVE = "metrics.jsonl", "weights.safetensors", "loss_curve.png"
CHECKPOINTS = "checkpoints"
TRAINING_FOLDER = FolderKind(
    error=TrainingError,
    content="a run",
    foreign="holds no run",
    busy="another process trains there",
    target="--out",
)


class RunFolder:
    """The files of one run. Only the process of rank 0 has one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints, self.weights, self.curve = path / CHECKPOINTS, path / WEIGHTS, path / CURVE
        self._metrics = path / METRICS

    def append(self, line: Mapping[str, Any]) -> None:
        """Add a line to the metrics; non-finite numbers become null.

        Raises:
            StorageError: reading or writing failed.
        """
        data = (json.dumps(to_plain(line)) + "\n").encode()
        try:
            descriptor = os.open(self._metrics, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                # With one write per line, a killed process leaves a whole line or none.
                if os.write(descriptor, data) != len(data):
                    raise StorageError(f"cannot write {self._metrics}: no room on the disk")
            finally:
                os.close(descriptor)
        except OSError as error:
            raise StorageError(f"cannot write {self._metrics}: {error.strerror or error}") from error

    def cut(self, step: int) -> None:
        """Remove the lines of later steps, which a continued run writes again, and a line torn by a power cut."""
        if self._metrics.exists():
            kept = [line for line in read_metrics(self.path) if line["step"] <= step]
            files.write_text(self._metrics, "".join(json.dumps(line) + "\n" for line in kept))


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics, in order; an empty list before the first one.

    Raises:
        StorageError: the file cannot be read.
    """
    try:
        text = files.read_bytes(path / METRICS).decode(errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path / METRICS}: cannot be read: {error.strerror}") from error
    lines = []
    for line in text.splitlines():
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            continue  # torn by a power cut
        if isinstance(values, dict) and isinstance(values.get("step"), int):
            lines.append(values)
    return lines


@contextmanager
def opened(path: Path, settings: Mapping[str, Any], *, resume: bool) -> Iterator[RunFolder]:
    """Create the folder of a new run, or continue the same run; hold it for this process.

    Args:
        path: the folder.
        settings: everything that the weights depend on, as plain JSON.
        resume: whether the folder may hold an earlier part of the same run.

    Raises:
        TrainingError: the folder holds something else, a run with other settings (the message names the field), or
            this run although `resume` is false; or another process trains there.
        StorageError: reading or writing failed.
    """

    def check(earlier: dict[str, Any]) -> None:
        _check_same(path, settings, earlier)
        if not resume:
            last = checkpoints(path / CHECKPOINTS)[-1:]
            done = f" ({last[0].name})" if last else ""
            raise TrainingError(f"{path} holds this run already{done}: add --resume, or name another --out")

    with locked_folder(path, settings, TRAINING_FOLDER, check=check):
        (path / CHECKPOINTS).mkdir(exist_ok=True)
        sweep(path / CHECKPOINTS)
        try:
            yield RunFolder(path)
        except BaseException:
            with suppress(OSError):  # it is kept once it holds a checkpoint
                (path / CHECKPOINTS).rmdir()
            raise


def _check_same(path: Path, settings: Mapping[str, Any], earlier: Mapping[str, Any]) -> None:
    before, now = _flat(earlier), _flat(settings)
    for name in sorted(before.keys() | now.keys()):
        if name.removeprefix("recipe.") not in FREE and before.get(name) != now.get(name):
            raise TrainingError(
                f"{path} holds a run with {name} = {_shown(before.get(name))}, now it is {_shown(now.get(name))}: "
                "name another --out, or repeat the run's own options"
            )


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(values, Mapping):
        return {prefix.removesuffix("."): values}
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.")
    return flat


def _shown(value: Any) -> str:
    return "none" if value is None else json.dumps(value)
