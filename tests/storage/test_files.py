"""Atomic files and folders, with errors injected at every step."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from objectflow.errors import ResultError, StorageError
from objectflow.storage import files


def refuse(*_: Any, **__: Any) -> None:
    raise OSError(28, "No space left on device")


def interrupt(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


def everything_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_a_file_is_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "note.txt"
    files.write_bytes(path, b"one")
    files.write_text(path, "zwölf")
    assert path.read_bytes() == "zwölf".encode()
    assert everything_in(tmp_path) == {"note.txt"}


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "note.txt"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, step, refuse)
    with pytest.raises(StorageError, match=r"cannot write .*note\.txt: No space left") as caught:
        files.write_bytes(path, b"new")
    assert caught.value.exit_code == 1
    assert path.read_bytes() == b"old"
    assert everything_in(tmp_path) == {"note.txt"}


def test_an_interrupted_write_leaves_no_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        files.write_bytes(tmp_path / "note.txt", b"new")
    assert everything_in(tmp_path) == set()


def test_a_file_in_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="No such file or directory"):
        files.write_bytes(tmp_path / "nowhere" / "note.txt", b"")


def test_a_folder_appears_with_its_parents_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "out"
    with files.new_folder(path) as folder:
        (folder / "one").write_text("1")
        (folder / "deep").mkdir()
        (folder / "deep" / "two").write_text("2")
        assert not path.exists()
    assert everything_in(path) == {"one", "deep", "deep/two"}
    assert everything_in(tmp_path / "a") == {"b", "b/out", "b/out/one", "b/out/deep", "b/out/deep/two"}
    assert path.stat().st_mode & 0o777 == 0o755


def test_an_empty_folder_may_exist_already(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with files.new_folder(tmp_path / "out") as folder:
        (folder / "one").write_text("1")
    assert everything_in(tmp_path) == {"out", "out/one"}


def test_a_folder_with_content_and_a_file_are_refused_and_unchanged(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("keep")
    with pytest.raises(ResultError, match="exists and is not empty"), files.new_folder(tmp_path / "out"):
        pytest.fail("must not get here")
    with pytest.raises(ResultError, match="is a file"), files.new_folder(tmp_path / "out" / "mine"):
        pytest.fail("must not get here")
    assert everything_in(tmp_path) == {"out", "out/mine"}
    assert (tmp_path / "out" / "mine").read_text() == "keep"


def test_a_folder_is_replaced_on_request(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    with files.new_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").write_text("new")
        assert (tmp_path / "out" / "old").exists()
    assert everything_in(tmp_path) == {"out", "out/new"}


@pytest.mark.parametrize("error", [ValueError("mine"), KeyboardInterrupt(), ResultError("no")])
def test_errors_inside_propagate_and_leave_nothing(tmp_path: Path, error: BaseException) -> None:
    def fill_and_fail() -> None:
        with files.new_folder(tmp_path / "a" / "b" / "out") as folder:
            (folder / "one").write_text("1")
            raise error

    with pytest.raises(type(error)):
        fill_and_fail()
    assert everything_in(tmp_path) == set()


def nth_rename_refuses(count: int) -> Callable[..., None]:
    rename, calls = os.rename, []

    def wrapped(*arguments: Any) -> None:
        calls.append(arguments)
        if len(calls) == count:
            refuse()
        rename(*arguments)

    return wrapped


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_failed_swap_leaves_the_old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")
    monkeypatch.setattr(os, "rename", nth_rename_refuses(count))
    with pytest.raises(StorageError), files.new_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").write_text("new")
    assert (tmp_path / "out" / "old").read_text() == "old"
    assert everything_in(tmp_path) == {"out", "out/old"}


def test_a_folder_that_another_process_fills_meanwhile_is_kept(tmp_path: Path) -> None:
    def fill() -> None:
        with files.new_folder(tmp_path / "out") as folder:
            (folder / "mine").touch()
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / "theirs").touch()

    with pytest.raises(ResultError, match="exists and is not empty"):
        fill()
    assert everything_in(tmp_path) == {"out", "out/theirs"}


def test_whether_a_folder_is_replaced_may_depend_on_what_is_found_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "out"

    def fill(replace: Callable[[Path], bool]) -> None:
        with files.new_folder(path, replace=replace) as folder:
            (folder / "mine").touch()
            path.mkdir(exist_ok=True)
            (path / "theirs").touch()

    with pytest.raises(ResultError, match="exists and is not empty"):
        fill(lambda found: (found / "other").exists())
    assert everything_in(tmp_path) == {"out", "out/theirs"}
    fill(lambda found: (found / "theirs").exists())
    assert everything_in(tmp_path) == {"out", "out/mine"}


@pytest.mark.parametrize("moment", ["before it is moved aside", "after it is moved aside"])
def test_a_folder_that_another_process_replaces_meanwhile_is_replaced_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    rename, path, met = os.rename, tmp_path / "out", []

    def wrapped(source: Path, target: Path) -> None:
        if moment.startswith("before") and source == path and not met:
            met.append(moment)
            rename(path, tmp_path / "elsewhere")
        elif moment.startswith("after") and target == path and not path.exists() and not met:
            met.append(moment)
            path.mkdir()
            (path / "theirs").touch()
        rename(source, target)

    path.mkdir()
    (path / "old").touch()
    monkeypatch.setattr(os, "rename", wrapped)
    with files.new_folder(path, replace=True) as folder:
        (folder / "mine").touch()
    assert met == [moment]
    assert everything_in(tmp_path) - {"elsewhere", "elsewhere/old"} == {"out", "out/mine"}


def test_a_link_is_replaced_on_request_and_its_target_stays(tmp_path: Path) -> None:
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "old").touch()
    (tmp_path / "out").symlink_to("target")
    with pytest.raises(ResultError, match="exists and is not empty"), files.new_folder(tmp_path / "out"):
        pytest.fail("must not get here")
    with files.new_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").touch()
    assert everything_in(tmp_path) == {"out", "out/new", "target", "target/old"}
    assert not (tmp_path / "out").is_symlink()


def test_a_failed_parent_removes_the_parents_created_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mkdir = Path.mkdir

    def selective(self: Path, *arguments: Any, **options: Any) -> None:
        if self.name == "b":
            refuse()
        mkdir(self, *arguments, **options)

    monkeypatch.setattr(Path, "mkdir", selective)
    with pytest.raises(StorageError), files.new_folder(tmp_path / "a" / "b" / "out"):
        pytest.fail("must not get here")
    assert everything_in(tmp_path) == set()


def test_impossible_paths_are_storage_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "out", tmp_path / ("n" * 300), tmp_path / "a\0b", tmp_path / "\ud800"):
        with pytest.raises(StorageError, match="cannot write"), files.new_folder(path):
            pytest.fail("must not get here")
    assert everything_in(tmp_path) == {"file"}
