"""Where results go, and the tables that are printed."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.storage import files

OUTPUT_ROOT = Path("objectflow_out")
RESULT_FILES = frozenset({"labels.png", "scene_flow.npy", "objects.json", "overlay.png", "flow.png"})


@contextmanager
def new_result(out: Path | None) -> Iterator[tuple[Path, Path]]:
    """Open the folder of a result before the work starts, so that a disk that refuses is noticed first.

    Args:
        out: the folder asked for; an earlier result there is replaced. None: a dated one under `objectflow_out`.

    Yields:
        The temporary folder to fill and the name that it will have.

    Raises:
        ResultError: the folder holds anything but an earlier result.
        StorageError: the disk refused.
    """
    path = _dated_folder() if out is None else out
    check_not_below_a_file(path)
    with files.new_folder(path, replace=_is_result(path)) as temporary:
        yield temporary, path
    if out is None:
        link_latest(path)


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep image libraries from writing to stderr on their own; what is wrong with a file is raised anyway."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def write_result(folder: Path, curr: RgbdFrame, motion: SceneMotion) -> None:
    """Fill a folder with the five files of a result."""
    from objectflow.view import write_pictures

    motion.write_into(folder)
    write_pictures(folder, curr, motion)


def check_not_below_a_file(path: Path) -> None:
    """Check that a folder can have this name.

    Raises:
        ResultError: a part of the path is a file.
    """
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise ResultError(f"{path}: {parent} is a file, not a folder: name another output folder")
            return


def link_latest(path: Path) -> None:
    """Point `latest`, beside a result, at it. A file system without links does without."""
    link = path.parent / "latest"
    temporary = path.parent / f".latest.{os.getpid()}.tmp"
    with suppress(OSError):
        temporary.symlink_to(path.name, target_is_directory=True)
        os.replace(temporary, link)
    with suppress(OSError):
        temporary.unlink()


def print_objects(motion: SceneMotion) -> None:
    """Print the table of a result's objects and what else it says."""
    console = Console(highlight=False)
    if motion.objects:
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("id", "pixels", "translation cm", "rotation deg", "score"):
            table.add_column(name, justify="right")
        table.add_column("moving")
        for obj in motion.objects:
            table.add_row(
                str(obj.id),
                str(obj.pixels),
                f"{100 * float(np.linalg.norm(obj.translation)):.1f}",
                f"{math.degrees(float(np.linalg.norm(obj.rotation_vector))):.1f}",
                f"{obj.score:.2f}",
                "yes" if obj.moving else "no",
            )
        console.print(table)
    else:
        console.print("no moving object found")
    console.print(f"{describe_camera(motion)}; {motion.method}, {motion.seconds:.2f} s")


def describe_camera(motion: SceneMotion) -> str:
    """The camera's own motion in words."""
    if motion.camera_motion is None:
        return "camera static"
    from objectflow import geometry

    angle = math.degrees(float(geometry.rotation_angle(motion.camera_motion[:3, :3])))
    shift = 100 * float(np.linalg.norm(motion.camera_motion[:3, 3]))
    return f"camera moved {shift:.1f} cm, {angle:.1f} deg"


def _is_result(path: Path) -> bool:
    """Whether a folder holds a result and nothing else: only such a folder may be replaced."""
    if not path.is_dir():
        return False
    names = {file.name for file in path.iterdir()}
    return "objects.json" in names and names <= RESULT_FILES


def _dated_folder() -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path, count = OUTPUT_ROOT / stamp, 1
    while path.exists():
        count += 1
        path = OUTPUT_ROOT / f"{stamp}-{count}"
    return path
