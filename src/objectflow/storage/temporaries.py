"""Temporary files and folders beside their targets: created exclusively, held by a lock, swept after a kill."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_PREFIX = ".objectflow-"
_NAME = re.compile(re.escape(_PREFIX) + r"[0-9a-f]{16}\.(tmp|old)")

ASIDE = ".old"
"""Suffix of the folder that holds, under its own name, a folder that is being replaced."""


class Temporary:
    """A temporary file or folder that this process holds by a lock.

    A lock tells the temporaries of running processes from those of killed ones. Process numbers cannot: they are
    reused, and differ between hosts and containers that share a folder.

    Attributes:
        path: of the file or folder.
        descriptor: open for reading and writing (a file) or for reading (a folder).
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.descriptor = path, descriptor

    def release(self) -> None:
        """End the lock; the caller has renamed or removed the path. Further calls have no effect."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def remove(self) -> None:
        """Remove the path and end the lock."""
        _remove(self.path)
        self.release()


def temporary_file(folder: Path) -> Temporary:
    """Create an empty file of a new name in `folder`, with the permissions that the umask leaves.

    Raises:
        OSError: the file cannot be created.
    """

    def create(path: Path) -> int:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)

    return _create(folder, ".tmp", create)


def temporary_folder(folder: Path, suffix: str = ".tmp") -> Temporary:
    """Create an empty folder of a new name in `folder`, with the permissions that the umask leaves.

    Raises:
        OSError: the folder cannot be created.
    """

    def create(path: Path) -> int:
        os.mkdir(path)
        return os.open(path, os.O_RDONLY)

    return _create(folder, suffix, create)


def sweep(folder: Path) -> None:
    """Remove the temporaries in `folder` that killed processes left behind.

    A folder that was moved aside in order to be replaced returns to its place if its replacement never arrived.
    Temporaries of running processes stay, as do all of a file system without locks.
    """
    try:
        found = [folder / name for name in os.listdir(folder) if _NAME.fullmatch(name)]
    except OSError:
        return
    for path in found:
        with suppress(OSError):  # another process removed it
            access = os.O_RDONLY if path.is_dir() else os.O_RDWR
            descriptor = os.open(path, access | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if path.suffix == ASIDE:
                    _restore(path)
                _remove(path)
            finally:
                os.close(descriptor)


def _create(folder: Path, suffix: str, create: Callable[[Path], int]) -> Temporary:
    while True:
        path = folder / f"{_PREFIX}{secrets.token_hex(8)}{suffix}"
        try:
            descriptor = create(path)
        except FileExistsError:
            continue
        except FileNotFoundError:
            if not folder.is_dir():
                raise
            continue  # swept before it was opened
        with suppress(OSError):  # a file system without locks, whose temporaries `sweep` leaves alone
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        # A sweep may have removed the path between its creation and the lock.
        with suppress(OSError):
            if os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return Temporary(path, descriptor)
        os.close(descriptor)


def _restore(aside: Path) -> None:
    for path in aside.iterdir():
        target = aside.parent / path.name
        if not target.exists():
            os.rename(path, target)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
