"""Output folders of results, and printed tables."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.motion.words import motion_texts
from objectflow.storage import files

if TYPE_CHECKING:
    from objectflow.view.overlay import TrackMarks
from objectflow.storage.temporaries import sweep, temporary_folder

OUTPUT_ROOT = Path("objectflow_out")
RESULT_FILES = frozenset({"labels.png", "scene_flow.npy", "objects.json", "overlay.png", "flow.png"})
COCO = "coco.json"
POINTS = "points_{:03d}.ply"
"""File of one object's points, by its id."""

Export = Literal["coco", "ply"]
"""Files for other programs: all masks as COCO annotations, or a point cloud per object."""

_STARTED = time.perf_counter()
"""Seconds: when this module was imported, early in every command."""


@contextmanager
def new_result(out: Path | None) -> Iterator[tuple[Path, Path]]:
    """Open the folder of a result before the work starts, so that storage errors are reported early.

    Args:
        out: the requested folder, in which an earlier result is replaced; None for a dated one in `objectflow_out`.

    Yields:
        The temporary folder to fill and its final path.

    Raises:
        ResultError: the folder contains anything but an earlier result.
        StorageError: reading or writing failed.
    """
    path = _dated_folder() if out is None else out
    check_not_below_a_file(path)
    sweep(path.parent)
    with files.new_folder(path, replace=_is_result) as temporary:
        yield temporary, path
    if out is None:
        link_latest(path)


def write_result(
    folder: Path,
    curr: RgbdFrame,
    motion: SceneMotion,
    *,
    tracks: TrackMarks | None = None,
    pictures: bool = True,
    exports: Collection[Export] = (),
) -> None:
    """Write the files of a result into a folder.

    Args:
        folder: must exist.
        curr: the current frame.
        motion: the result.
        tracks: numbers and trails of the objects in the overlay; those of the result without trails if None.
        pictures: write overlay.png and flow.png.
        exports: further files to write.
    """
    motion.write_into(folder)
    if pictures:
        from objectflow.view import write_pictures

        write_pictures(folder, curr, motion, tracks)
    if "coco" in exports:
        (folder / COCO).write_text(json.dumps(motion.to_coco_dataset(curr.name)) + "\n")
    if "ply" in exports:
        for obj in motion.objects:
            motion.to_ply(folder / POINTS.format(obj.id), curr, obj.id)


def check_not_below_a_file(path: Path) -> None:
    """Check that no parent of a folder is a file.

    Raises:
        ResultError: a parent is a file.
    """
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise ResultError(f"{path}: {parent} is a file, not a folder: name another output folder")
            return


def print_written(path: Path, hint: str = "") -> None:
    """Print where a result lies and how long the whole command took."""
    print(f"written to {path}{hint}; total {time.perf_counter() - _STARTED:.1f} s")


def link_latest(path: Path) -> None:
    """Link `latest` in the parent folder to a result, if the file system supports links."""
    with suppress(OSError):
        temporary = temporary_folder(path.parent)
        try:
            link = temporary.path / "latest"
            link.symlink_to(path.name, target_is_directory=True)
            os.replace(link, path.parent / link.name)
        finally:
            temporary.remove()


def print_objects(motion: SceneMotion) -> None:
    """Print the objects of a result as a table, then its camera motion, method and run time."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    if motion.objects:
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in ("id", "pixels", "displacement, cm", "rotation, deg", "score"):
            table.add_column(name, justify="right")
        table.add_column("moving")
        for obj in motion.objects:
            table.add_row(
                str(obj.id),
                str(obj.pixels),
                *motion_texts(obj),
                f"{obj.score:.2f}",
                _moving_text(obj),
            )
        console.print(table)
    else:
        console.print("no moving object found")
    console.print(f"{motion.camera_text}; {motion.method}, {motion.seconds:.2f} s")


def _moving_text(obj: ObjectMotion) -> str:
    if not obj.moving:
        return "no"
    return "yes" if obj.rigid else "yes, not rigid"


def _is_result(path: Path) -> bool:
    """Whether a folder contains a result and nothing else, so that it may be replaced."""
    names = {file.name for file in path.iterdir()}
    known = {name for name in names if name == COCO or re.fullmatch(r"points_\d+\.ply", name)}
    return "objects.json" in names and names <= RESULT_FILES | known


def _dated_folder() -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path, count = OUTPUT_ROOT / stamp, 1
    while path.exists():
        count += 1
        path = OUTPUT_ROOT / f"{stamp}-{count}"
    return path
