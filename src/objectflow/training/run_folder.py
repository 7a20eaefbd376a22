"""A run's output folder: its settings, its metrics line by line; taken up again only by the run that made it."""

from __future__ import annotations

import fcntl
import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from objectflow.errors import StorageError, TrainingError
from objectflow.storage import files
from objectflow.training.checkpoint import checkpoints, remove_leftovers
from objectflow.training.recipe import FREE

SETTINGS, METRICS, WEIGHTS, CURVE = "settings.json", "metrics.jsonl", "weights.safetensors", "loss_curve.png"
CHECKPOINTS = "checkpoints"


class RunFolder:
    """The files of one run. Only the first process has one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints, self.weights, self.curve = path / CHECKPOINTS, path / WEIGHTS, path / CURVE
        self._metrics = path / METRICS

    def append(self, line: Mapping[str, Any]) -> None:
        """Add a line to the metrics; numbers that are not finite become null.

        Raises:
            StorageError: the disk refused.
        """
        data = (json.dumps(_finite(dict(line))) + "\n").encode()
        try:
            descriptor = os.open(self._metrics, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            try:
                # One write a line: a killed process leaves all of it or nothing.
                if os.write(descriptor, data) != len(data):
                    raise StorageError(f"cannot write {self._metrics}: no room on the disk")
            finally:
                os.close(descriptor)
        except OSError as error:
            raise StorageError(f"cannot write {self._metrics}: {error.strerror or error}") from error

    def cut(self, step: int) -> None:
        """Remove lines of later steps, which a continued run writes anew, and a last line that a power cut tore."""
        if self._metrics.exists():
            kept = [line for line in read_metrics(self.path) if line["step"] <= step]
            files.write_text(self._metrics, "".join(json.dumps(line) + "\n" for line in kept))


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics, in order; none where there are none yet."""
    try:
        text = (path / METRICS).read_text()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path / METRICS}: cannot be read: {error.strerror}") from error
    lines = []
    for line in text.splitlines():
        try:
            lines.append(dict(json.loads(line)))
        except ValueError:
            continue  # torn by a power cut
    return lines


@contextmanager
def opened(path: Path, settings: Mapping[str, Any], *, resume: bool) -> Iterator[RunFolder]:
    """Make the folder of a new run, or take up the same run's; hold it for this process.

    Args:
        path: the folder.
        settings: everything that the weights depend on, as plain JSON.
        resume: an earlier part of the same run may be there.

    Raises:
        TrainingError: the folder holds something else, a run with other settings (the message names the field), this
            run although `resume` is false, or another process writes there.
        StorageError: the disk refused.
    """
    if not path.is_dir() or not any(path.iterdir()):
        with files.new_folder(path) as folder:
            files.write_text(folder / SETTINGS, json.dumps(settings, indent=2) + "\n")
            (folder / CHECKPOINTS).mkdir()
    else:
        _check_same(path, settings)
        if not resume:
            last = checkpoints(path / CHECKPOINTS)[-1:]
            done = f" ({last[0].name})" if last else ""
            raise TrainingError(f"{path} holds this run already{done}: add --resume, or name another --out")
    try:
        with open(path / SETTINGS) as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise TrainingError(f"{path}: another process trains there: wait, or name another --out") from None
            (path / CHECKPOINTS).mkdir(exist_ok=True)
            remove_leftovers(path / CHECKPOINTS)
            yield RunFolder(path)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


def _check_same(path: Path, settings: Mapping[str, Any]) -> None:
    try:
        earlier = json.loads((path / SETTINGS).read_text())
    except FileNotFoundError:
        raise TrainingError(f"{path} exists and holds no run: name another --out") from None
    except (OSError, ValueError) as error:
        raise TrainingError(f"{path / SETTINGS}: cannot be read: {error}") from error
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


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
