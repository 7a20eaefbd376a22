"""Atomic writing of files and folders: write beside the target, fsync, rename; and file hashes."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from objectflow.errors import DatasetError, ResultError, StorageError
from objectflow.storage.temporaries import ASIDE, Temporary, temporary_file, temporary_folder

MAX_BYTES = 1 << 30
"""Largest file that `read_bytes` reads by default, in bytes."""


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file so that `path` holds either its old content or all of `data`, even after a power cut.

    Raises:
        StorageError: writing failed (no space, no permission); no temporary file is left behind.
    """
    temporary: Temporary | None = None
    try:
        temporary = temporary_file(path.parent)
        with open(temporary.descriptor, "wb", closefd=False) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary.path, path)
        temporary.release()
        _fsync_folder(path.parent)
    except BaseException as error:
        if temporary is not None:
            with suppress(OSError):
                temporary.remove()
        if isinstance(error, (OSError, ValueError)):  # ValueError: a path with a NUL
            raise _cannot_write(path, error) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with the guarantee of `write_bytes`."""
    write_bytes(path, text.encode())


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the path of a file to be written by a library; rename it to `path` at the end, or remove it on failure.

    The temporary file has the name of `path`, since some libraries choose the format by its ending.

    Raises:
        StorageError: writing failed, or nothing was written.
    """
    temporary: Temporary | None = None
    try:
        temporary = temporary_folder(path.parent)
        written = temporary.path / path.name
        yield written
        _fsync_file(written)
        os.replace(written, path)
        _fsync_folder(path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.remove()


@contextmanager
def new_folder(path: Path, *, replace: bool | Callable[[Path], bool] = False) -> Iterator[Path]:
    """Yield a temporary folder to fill; rename it to `path` at the end, or remove it on failure.

    Args:
        path: the folder to create. It may exist if it is empty.
        replace: whether an existing folder with content is removed once the new one is in place; or a function that
            tells it from the folder, called at the start and again before the folder is replaced. The caller sees to
            it that the content may be deleted.

    Raises:
        ResultError: `path` is a file, or a folder with content and `replace` is false; also if another process fills
            it meanwhile.
        StorageError: reading or writing failed.
    """
    path = Path(path)
    made_parents: list[Path] = []
    temporary: Temporary | None = None
    _check_name(path)
    try:
        if path.exists() and not path.is_dir():
            raise ResultError(f"{path} is a file, not a folder: name another output folder")
        if path.is_dir() and any(path.iterdir()):
            _check_replaceable(path, replace)
        _make_parents(path.parent, made_parents)
        temporary = temporary_folder(path.parent)
        yield temporary.path
        for file in temporary.path.rglob("*"):
            _fsync_file(file)
        _swap_in(temporary.path, path, replace=replace)
        temporary.release()
    except BaseException as error:
        if temporary is not None:
            with suppress(OSError):
                temporary.remove()
        for parent in reversed(made_parents):
            with suppress(OSError):
                parent.rmdir()
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise


def _check_replaceable(path: Path, replace: bool | Callable[[Path], bool]) -> None:
    if not (replace(path) if callable(replace) else replace):
        raise ResultError(f"{path} exists and is not empty: name another output folder, or remove it")


def _swap_in(temporary: Path, path: Path, *, replace: bool | Callable[[Path], bool]) -> None:
    """Rename `temporary` to `path`; an existing folder is kept until the new one is in place.

    Raises:
        ResultError: `path` has content that may not be removed; another process may have written it meanwhile.
    """
    while not _renamed(temporary, path):
        with suppress(FileNotFoundError):  # another process is replacing it too
            _check_replaceable(path, replace)
        aside = temporary_folder(path.parent, ASIDE)
        old = aside.path / path.name
        try:
            with suppress(FileNotFoundError):
                os.rename(path, old)
            if _renamed(temporary, path):
                _fsync_folder(path.parent)
                return
        except BaseException:
            if old.is_dir() and not path.exists():
                os.rename(old, path)
            raise
        finally:
            aside.remove()
    _fsync_folder(path.parent)


def _renamed(temporary: Path, path: Path) -> bool:
    """Rename a folder, unless `path` is a folder with content or a link."""
    try:
        os.rename(temporary, path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) or path.is_symlink():
            return False
        raise
    return True


def remove_folder(path: Path) -> None:
    """Remove a folder so that `path` never holds a part of it, even after a kill.

    Raises:
        StorageError: the folder cannot be removed.
    """
    try:
        temporary = temporary_folder(path.parent)
        try:
            os.rename(path, temporary.path / path.name)
        finally:
            temporary.remove()
    except OSError as error:
        raise StorageError(f"cannot remove {path}: {error.strerror or error}") from error


def _check_name(path: Path) -> None:
    """Refuse a path that no file can have: the functions of `os` raise ValueError for it, as others do for data."""
    try:
        if b"\0" not in os.fsencode(path):
            return
    except UnicodeEncodeError:  # a lone surrogate
        pass
    raise StorageError(f"cannot write {path}: no file can have this name")


def _make_parents(folder: Path, made: list[Path]) -> None:
    """Create a folder and its missing parents; append each to `made`, so that the caller can undo a partial result."""
    missing: list[Path] = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for parent in reversed(missing):
        parent.mkdir()
        made.append(parent)


def _fsync_file(path: Path) -> None:
    if path.is_file():
        with open(path, "rb") as file:
            os.fsync(file.fileno())


def _fsync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _cannot_write(path: Path, error: OSError | ValueError) -> StorageError:
    return StorageError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}")


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Read a regular file. A pipe would wait for its writer, and a device has no end.

    Raises:
        OSError: no such file, no permission, no regular file, or one with more than `limit` bytes.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except ValueError as error:  # a path with a NUL
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    with open(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        if status.st_size > limit:
            raise OSError(errno.EFBIG, f"it has more than {limit // 1_000_000} MB", str(path))
        return file.read(limit)


def hash_file(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        DatasetError: no such file.
        StorageError: reading or writing failed.
    """
    try:
        digest = hashlib.sha256()
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
        return digest.hexdigest()
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
