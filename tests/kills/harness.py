"""Kill commands where they change the file system: `python tests/kills/harness.py` does it at every point.

The undisturbed run is made by this process, which imports what the command needs once, the others by forked children.
The functions that change the file system are replaced in the child by ones that count their calls and end the process
with SIGKILL before or after a given one; a write is also cut in the middle. The same command is then run again, and
must leave the same files as the undisturbed run, and no others. It is run again once for all kills that leave the same
files behind.
"""

from __future__ import annotations

import argparse
import builtins
import contextlib
import dataclasses
import io
import itertools
import mmap
import os
import pathlib
import random
import re
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1])]

CHANGES = (
    "fsync", "replace", "rename", "mkdir", "rmdir", "unlink", "remove", "symlink", "link", "truncate", "ftruncate",
)  # fmt: skip
"""Functions of `os` that are counted; `os.open` and `open` are counted where they create or truncate."""
WRITING = os.O_CREAT | os.O_TRUNC
_TEMPORARY = re.compile(r"(?<=\.objectflow-)[0-9a-f]{16}")
State = tuple[tuple[str, int, bytes], ...]
"""The name, permissions and content of each file."""
Command = Callable[[Path], object]
"""Works in the folder that it is given."""
Make = Callable[[Path], None]
"""Fills that folder with the command's inputs before the first run."""


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


def state(folder: Path) -> State:
    """The names, permissions and content below a folder; the random names of temporaries are left out."""
    found = ((_TEMPORARY.sub("", name), (folder / name).lstat().st_mode, data) for name, data in tree(folder).items())
    return tuple(sorted(found))


def kill_everywhere(
    command: Command, make: Make, folder: Path, *, sample: int | None = None, seed: int = 0, copies: bool = False
) -> tuple[int, int, list[Difference]]:
    """Kill a command at its points, run it again after each kill, and compare with an undisturbed run.

    Args:
        command: the command.
        make: makes its inputs.
        folder: for the runs.
        sample: number of points, drawn at random; None for all.
        seed: of the draw.
        copies: instead of killing a run for each point, copy the files that each point of one run finds, which are
            those that a kill would leave.

    Returns:
        The number of kills, the number of points, and the differences.
    """
    work = folder / "work"  # the same path for every run, since settings record paths
    make(fresh(work))
    with contextlib.suppress(SystemExit):
        command(work)
    expected = tree(work)
    make(fresh(work))
    code, count = run_child(command, work)
    if code != 0 or tree(work) != expected:
        raise RuntimeError(f"two undisturbed runs differ, or the second one failed: {code}")
    points = list(range(count))
    if sample is not None and sample < count:
        points = sorted(random.Random(seed).sample(points, sample))
    differences: list[Difference] = []
    outcomes: dict[State, tuple[str, ...]] = {}
    for point, left in (copied if copies else killed)(command, make, folder, points):
        if left not in outcomes:
            code, _ = run_child(command, work)
            if code != 0:
                raise RuntimeError(f"the run after the kill at point {point} failed: {code}")
            found = tree(work)
            outcomes[left] = tuple(
                sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
            )
        if outcomes[left]:
            differences.append(Difference(point, outcomes[left]))
    return len(points), count, differences


def killed(command: Command, make: Make, folder: Path, points: list[int]) -> Iterator[tuple[int, State]]:
    """Kill a run at each point, and yield the point and what the kill left in the folder `work`."""
    work = folder / "work"
    for point in points:
        make(fresh(work))
        code, _ = run_child(command, work, point.__eq__, lambda: os.kill(os.getpid(), signal.SIGKILL))
        if code != -signal.SIGKILL:
            raise RuntimeError(f"the run was not killed at point {point}, but ended with {code}")
        yield point, state(work)


def copied(command: Command, make: Make, folder: Path, points: list[int]) -> Iterator[tuple[int, State]]:
    """Copy what each point of a run finds, then restore each copy into the folder `work` and yield it as `killed`."""
    work, numbers = folder / "work", itertools.count()
    make(fresh(work))

    found: dict[tuple[int, int, int, int], str] = {}

    def copy() -> None:
        shutil.copytree(work, folder / "copies" / f"{next(numbers):04d}", symlinks=True, copy_function=link)

    def link(source: str, target: str) -> None:
        """Copy a file, or link the copy of it that an earlier point made."""
        status = os.stat(source)
        known = found.setdefault((status.st_ino, status.st_mtime_ns, status.st_size, status.st_mode), target)
        (shutil.copy2 if known == target else os.link)(source if known == target else known, target)

    code, _ = run_child(command, work, points.__contains__, copy)
    copies = sorted((folder / "copies").iterdir())
    if code != 0 or len(copies) != len(points):
        raise RuntimeError(f"the run whose files are copied failed: {code}, or some points were not reached")
    for point, source in zip(points, copies, strict=True):
        shutil.rmtree(work)
        shutil.copytree(source, work, symlinks=True)
        yield point, state(work)


def run_child(
    command: Command,
    work: Path,
    wanted: Callable[[int], bool] = lambda _: False,
    visit: Callable[[], None] = lambda: None,
) -> tuple[int, int]:
    """Run a command in a forked child.

    Args:
        command: the command.
        work: its folder.
        wanted: whether a point is visited.
        visit: called there, in the child.

    Returns:
        Its exit code, or minus the signal; and the number of points that it reached.
    """
    reached = mmap.mmap(-1, 8)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            _count_points(wanted, visit, reached)
            command(work)
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status), int.from_bytes(reached[:8], "little")


def fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _count_points(wanted: Callable[[int], bool], visit: Callable[[], None], reached: mmap.mmap) -> None:
    """Count the changes of the file system in this process, two or three points each, and visit the wanted ones."""
    points: Iterator[int] = itertools.count()
    process = os.getpid()
    visiting = False

    def reach() -> bool:
        """Whether this point, in this process, is to be visited."""
        if os.getpid() != process or visiting:
            return False
        point = next(points)
        reached[:8] = (point + 1).to_bytes(8, "little")
        return wanted(point)

    def visit_here() -> None:
        nonlocal visiting
        visiting = True
        visit()
        visiting = False

    def counted(change: Callable[..., Any], applies: Callable[..., bool]) -> Callable[..., Any]:
        def wrapped(*arguments: Any, **options: Any) -> Any:
            if not applies(*arguments, **options):
                return change(*arguments, **options)
            if reach():
                visit_here()
            result = change(*arguments, **options)
            if reach():
                visit_here()
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
    write = os.write

    def cut(descriptor: int, data: bytes) -> int:
        if not reach():
            return write(descriptor, data)
        half = write(descriptor, data[: len(data) // 2])
        visit_here()
        return half + write(descriptor, data[half:])

    os.write = counted(cut, lambda descriptor, _: descriptor > 2)


def main() -> int:
    from kills.commands import COMMANDS, stopped_clocks

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--command", action="append", choices=list(COMMANDS), help="only these commands")
    parser.add_argument("--sample", type=int, help="number of points of each command; all if not given")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--copies", action="store_true", help="copy the files at each point of one run: no kills")
    options = parser.parse_args()
    wrong = 0
    for name in options.command or COMMANDS:
        command, make = COMMANDS[name]
        with tempfile.TemporaryDirectory() as folder, stopped_clocks():
            kills, points, differences = kill_everywhere(
                command, make, Path(folder), sample=options.sample, seed=options.seed, copies=options.copies
            )
        how = "copied" if options.copies else "killed"
        print(f"{name}: {how} at {kills} of {points} points, {len(differences)} differences", flush=True)
        for difference in differences:
            print(f"  point {difference.point}: {', '.join(difference.files)}", flush=True)
        wrong += len(differences)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
