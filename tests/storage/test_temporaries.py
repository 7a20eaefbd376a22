"""Temporaries: exclusive, held by a lock, and swept only when nobody holds them."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from objectflow.storage import files
from objectflow.storage.temporaries import ASIDE, sweep, temporary_file, temporary_folder


def everything_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_a_sweep_removes_what_nobody_holds(tmp_path: Path) -> None:
    """A killed process closes its descriptors, as `release` does."""
    (tmp_path / ".mine.tmp").touch()
    held = [temporary_file(tmp_path), temporary_folder(tmp_path)]
    left = [temporary_file(tmp_path), temporary_folder(tmp_path)]
    (left[1].path / "deep").mkdir()
    for one in left:
        one.release()
    sweep(tmp_path)
    assert everything_in(tmp_path) == {".mine.tmp", *(one.path.name for one in held)}
    for one in held:
        one.remove()
    assert everything_in(tmp_path) == {".mine.tmp"}


def test_a_folder_moved_aside_returns_if_nothing_replaced_it(tmp_path: Path) -> None:
    for replaced in (False, True):
        aside = temporary_folder(tmp_path, ASIDE)
        (aside.path / "out").mkdir()
        (aside.path / "out" / "old").touch()
        aside.release()
        if replaced:
            (tmp_path / "out" / "old").rename(tmp_path / "out" / "new")
        sweep(tmp_path)
        assert everything_in(tmp_path) == {"out", "out/new" if replaced else "out/old"}


def test_a_sweep_touches_nothing_through_links_and_pipes(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("keep")
    name = ".objectflow-0123456789abcde{}.tmp"
    (tmp_path / name.format(0)).symlink_to("mine")
    os.mkfifo(tmp_path / name.format(1))
    sweep(tmp_path)
    assert (tmp_path / "mine").read_text() == "keep"
    sweep(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("umask", "file", "folder"), [(0o022, 0o644, 0o755), (0o077, 0o600, 0o700), (0, 0o666, 0o777)]
)
def test_the_umask_is_respected(tmp_path: Path, umask: int, file: int, folder: int) -> None:
    before = os.umask(umask)
    try:
        files.write_bytes(tmp_path / "file", b"")
        with files.new_folder(tmp_path / "folder") as new:
            (new / "one").touch()
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == file
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == folder


def test_threads_that_write_one_file_leave_one_whole_version(tmp_path: Path) -> None:
    path = tmp_path / "file"
    contents = {bytes([65 + number]) * 100_000 for number in range(8)}
    files.write_bytes(path, next(iter(contents)))

    def write(content: bytes) -> bool:
        for _ in range(5):
            files.write_bytes(path, content)
            sweep(tmp_path)
            if path.read_bytes() not in contents:
                return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(write, contents))
    assert everything_in(tmp_path) == {"file"}


def test_a_link_in_place_of_the_target_is_replaced_not_followed(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("keep")
    (tmp_path / "file").symlink_to("victim")
    files.write_text(tmp_path / "file", "new")
    assert (tmp_path / "victim").read_text() == "keep"
    assert not (tmp_path / "file").is_symlink()
