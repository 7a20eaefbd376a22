"""Kill a command at every point where it changes the file system, and compare what the same command makes afterwards.

The undisturbed run is made by this process, which imports what the command needs once, the others by forked children.
The functions that change the file system
are replaced in the child by ones that count their calls and end the process with SIGKILL before or after a given one.
"""

from __future__ import annotations

import builtins
import contextlib
import dataclasses
import io
import itertools
import os
import pathlib
import shutil
import signal
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

CHANGES = ("fsync", "replace", "rename", "mkdir", "rmdir", "unlink", "remove", "symlink")
"""Functions of `os` that are counted; `os.open` and `open` are counted where they create or truncate."""
WRITING = os.O_CREAT | os.O_TRUNC


@dataclasses.dataclass(frozen=True)
class Difference:
    """A kill point after which the same command left other files, and their names."""

    point: int
    files: tuple[str, ...]


def tree(folder: Path) -> dict[str, bytes]:
    """Every file, link and folder below a folder: its content, its target, or nothing."""
    found: dict[str, bytes] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = os.readlink(path).encode()
        else:
            found[name] = path.read_bytes() if path.is_file() else b""
    return found


def kill_everywhere(
    command: Callable[[Path], object], make: Callable[[Path], None], folder: Path, *, stride: int = 1
) -> tuple[int, list[Difference]]:
    """Kill a command at every `stride`-th point, run it again, and compare with an undisturbed run.

    Args:
        command: works in the folder that it is given.
        make: fills that folder with the command's inputs before the first run.
        folder: for the runs.
        stride: 1 for every point.

    Returns:
        The number of kills, and the differences.
    """
    work = folder / "work"  # the same path for every run, since settings record paths
    make(fresh(work))
    with contextlib.suppress(SystemExit):
        command(work)
    expected = tree(work)
    differences: list[Difference] = []
    for kills, point in enumerate(itertools.count(0, stride)):
        make(fresh(work))
        if run_child(command, work, point) == 0:
            return kills, differences
        code = run_child(command, work, None)
        if code != 0:
            raise RuntimeError(f"the run after the kill at point {point} failed: {code}")
        found = tree(work)
        different = tuple(sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name)))
        if different:
            differences.append(Difference(point, different))
    raise AssertionError("unreachable")


def run_child(command: Callable[[Path], object], work: Path, point: int | None) -> int:
    """Run a command in a forked child that is killed at a point; returns its exit code, or minus the signal."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            if point is not None:
                _kill_at(point)
            command(work)
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status)


def fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _kill_at(point: int) -> None:
    """Count the changes of the file system in this process, two points each, and end it at one of them."""
    points: Iterator[int] = itertools.count()

    def reach() -> None:
        if next(points) == point:
            os.kill(os.getpid(), signal.SIGKILL)

    def counted(change: Callable[..., Any], applies: Callable[..., bool]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            if not applies(*arguments, **options):
                return change(*arguments, **options)
            reach()
            result = change(*arguments, **options)
            reach()
            return result

        return wrapped

    def creates(path: Any, flags: int, *_: Any, **__: Any) -> bool:
        return bool(flags & WRITING)

    def writes(file: Any, mode: str = "r", *_: Any, **__: Any) -> bool:
        return isinstance(file, (str, pathlib.PurePath)) and mode[:1] in "wxa"

    for name in CHANGES:
        setattr(os, name, counted(getattr(os, name), lambda *_, **__: True))
    os.open = counted(os.open, creates)
    opened = counted(open, writes)
    builtins.open, io.open = opened, opened
