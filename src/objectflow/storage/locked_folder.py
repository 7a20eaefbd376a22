"""Output folders of runs: created with their settings, continued with the same ones, held by one process at a time."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from objectflow.errors import ObjectflowError, ResultError, StorageError
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.temporaries import sweep

SETTINGS = "settings.json"


@dataclass(frozen=True)
class FolderKind:
    """The error type and the wording of the messages about one kind of output folder.

    Attributes:
        error: raised for folders that cannot be used.
        content: what the folder holds, such as "a run".
        foreign: what is said of a folder without settings, such as "is no earlier run".
        busy: what is said of a folder that another process holds.
        target: what the user is asked to name instead, such as "output folder".
    """

    error: type[ObjectflowError]
    content: str
    foreign: str
    busy: str
    target: str


def is_unused(path: Path) -> bool:
    """Whether a folder is missing or empty."""
    return not path.is_dir() or not any(path.iterdir())


def read_settings(path: Path, kind: FolderKind) -> dict[str, Any]:
    """Read the settings that an output folder was created with.

    Raises:
        ObjectflowError: of the kind's type, if the settings are missing, unreadable or not a JSON object.
    """
    file = path / SETTINGS
    try:
        with foreign_errors(kind.error, f"{file}: cannot be read"):
            settings = json.loads(files.read_bytes(file))
    except kind.error as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise kind.error(f"{path} exists and {kind.foreign}: name another {kind.target}") from None
        raise
    if not isinstance(settings, dict):
        raise kind.error(f"{file}: not the settings of {kind.content}")
    return settings


@contextmanager
def locked_folder(
    path: Path, settings: Mapping[str, Any], kind: FolderKind, *, check: Callable[[dict[str, Any]], None]
) -> Iterator[None]:
    """Create an output folder or continue an earlier one, and hold it for this process.

    The lock ends with the process, however that ends. Temporaries that killed processes left in the folder and beside
    it are removed. A new folder that holds nothing but its settings when an error ends the `with` block is removed.

    Args:
        path: the folder.
        settings: written as JSON into a new folder.
        kind: for error messages.
        check: called with the settings of an earlier folder; raises where the folder cannot be continued.

    Raises:
        ObjectflowError: of the kind's type, if the folder holds something else or another process holds it.
        StorageError: reading or writing failed, here or inside the `with` block.
    """
    try:
        sweep(path.parent)
        parents = [parent for parent in path.parents if not parent.exists()]
        is_new = _is_created(path, settings)
        if not is_new:
            check(read_settings(path, kind))
        with open(path / SETTINGS) as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                is_held = os.path.samestat(os.fstat(lock.fileno()), os.stat(path / SETTINGS))
            except (BlockingIOError, FileNotFoundError):
                is_held = False
            if not is_held:
                raise kind.error(f"{path}: {kind.busy}: wait, or name another {kind.target}")
            sweep(path)
            try:
                yield
            except BaseException:
                if is_new and os.listdir(path) == [SETTINGS]:
                    _remove(path, parents)
                raise
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error


def _remove(path: Path, parents: list[Path]) -> None:
    """Remove a folder, and those of its parents that are empty."""
    files.remove_folder(path)
    for parent in parents:
        with suppress(OSError):
            parent.rmdir()


def _is_created(path: Path, settings: Mapping[str, Any]) -> bool:
    """Create a folder with its settings, unless there is one with content."""
    if not is_unused(path):
        return False
    try:
        with files.new_folder(path) as folder:
            files.write_text(folder / SETTINGS, json.dumps(settings, indent=2) + "\n")
    except ResultError:
        if is_unused(path):
            raise
        return False  # another process has just created it
    return True
