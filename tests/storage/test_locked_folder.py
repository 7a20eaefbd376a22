"""Output folders: created with their settings, continued with the same ones, held by one process at a time."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from objectflow.errors import ResultError, StorageError
from objectflow.storage import files
from objectflow.storage.locked_folder import SETTINGS, FolderKind, is_unused, locked_folder, read_settings

KIND = FolderKind(ResultError, "a test", "is no test", "another test runs there", "folder")
GIVEN = {"a": 1, "b": [0.5, None]}


def same(earlier: dict[str, Any]) -> None:
    if earlier != GIVEN:
        raise ResultError("other settings")


def opened(path: Path, check: Callable[[dict[str, Any]], None] = same) -> Any:
    return locked_folder(path, GIVEN, KIND, check=check)


def test_a_folder_is_created_and_continued(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "out"
    assert is_unused(path)
    for _ in range(2):
        with opened(path):
            assert read_settings(path, KIND) == GIVEN
        assert not is_unused(path)
    assert [file.name for file in path.iterdir()] == [SETTINGS]


def test_an_empty_folder_is_used_without_a_check(tmp_path: Path) -> None:
    def fail(_: dict[str, Any]) -> None:
        pytest.fail("a new folder has no earlier settings")

    with opened(tmp_path, fail):
        assert (tmp_path / SETTINGS).is_file()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "out exists and is no test: name another folder"),
        ("{", r"settings\.json: cannot be read"),
        ("[" * 100_000, r"settings\.json: cannot be read: nested too deeply"),
        ("[1]", r"settings\.json: not the settings of a test"),
        (json.dumps({"a": 2}), "other settings"),
    ],
)
def test_other_folders_are_refused_untouched(tmp_path: Path, content: str | None, message: str) -> None:
    path = tmp_path / "out"
    path.mkdir()
    (path / "mine").touch()
    if content is not None:
        (path / SETTINGS).write_text(content)
    before = sorted(path.iterdir())
    with pytest.raises(ResultError, match=message), opened(path):
        pytest.fail("must not get here")
    assert sorted(path.iterdir()) == before


def hold(path: str, ready: Any, done: Any) -> None:
    with opened(Path(path)):
        ready.set()
        done.wait(60)


def test_one_process_holds_a_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    ready, done = context.Event(), context.Event()
    other = context.Process(target=hold, args=(str(tmp_path), ready, done))
    other.start()
    try:
        assert ready.wait(60)
        with (
            pytest.raises(ResultError, match="another test runs there: wait, or name another folder"),
            opened(tmp_path),
        ):
            pytest.fail("must not get here")
    finally:
        other.kill()
        other.join()
    with opened(tmp_path):  # the lock ended with the killed process
        pass


def test_of_two_processes_that_create_a_folder_at_once_one_holds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, write = tmp_path / "out", files.write_text
    with ExitStack() as other:

        def write_late(target: Path, text: str) -> None:
            monkeypatch.setattr(files, "write_text", write)
            other.enter_context(opened(path))  # the other one is faster
            write(target, text)

        monkeypatch.setattr(files, "write_text", write_late)
        with pytest.raises(ResultError, match="another test runs there"), opened(path):
            pytest.fail("must not get here")
        (path / "work").touch()
        assert sorted(file.name for file in path.iterdir()) == [SETTINGS, "work"]
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("content", [[], ["work"]])
def test_a_new_folder_without_content_is_removed_after_an_error(tmp_path: Path, content: list[str]) -> None:
    def fail() -> None:
        with opened(tmp_path / "deep" / "out"):
            for name in content:
                (tmp_path / "deep" / "out" / name).touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    left = sorted(path.name for path in tmp_path.rglob("*"))
    assert left == (["deep", "out", SETTINGS, "work"] if content else [])


def test_an_earlier_folder_stays_after_an_error(tmp_path: Path) -> None:
    with opened(tmp_path / "out"):
        pass
    with pytest.raises(StorageError), opened(tmp_path / "out"):
        raise OSError(28, "No space left on device")
    assert (tmp_path / "out" / SETTINGS).is_file()


def test_a_disk_that_refuses_inside_is_a_storage_error(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"cannot write .*: No space left"), opened(tmp_path):
        raise OSError(28, "No space left on device")
