"""Bad input: one line on stderr, exit code 2 (1 for storage errors), and no files left behind."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from objectflow.cli import main
from objectflow.methods import base, registry

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"


def half(name: str) -> Callable[[Path], None]:
    def change(pair: Path) -> None:
        data = (pair / name).read_bytes()
        (pair / name).write_bytes(data[: len(data) // 2])

    return change


def resize(*names: str) -> Callable[[Path], None]:
    def change(pair: Path) -> None:
        for name in names:
            image = cv2.imread(str(pair / name), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(pair / name), cv2.resize(image, (320, 240), interpolation=cv2.INTER_NEAREST))

    return change


def camera(**values: Any) -> Callable[[Path], None]:
    def change(pair: Path) -> None:
        merged = {**json.loads((pair / "camera.json").read_text()), **values}
        kept = {name: value for name, value in merged.items() if value is not None}
        (pair / "camera.json").write_text(json.dumps(kept))

    return change


def text_as_png(pair: Path) -> None:
    (pair / "color1.jpg").unlink()
    (pair / "color1.png").write_text("this is no picture\n")


def eight_bits(pair: Path) -> None:
    depth = cv2.imread(str(pair / "depth1.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(pair / "depth1.png"), (depth // 8).astype(np.uint8))


def all_zero(pair: Path) -> None:
    cv2.imwrite(str(pair / "depth1.png"), np.zeros((480, 640), np.uint16))


def damaged(pair: Path) -> None:
    """A PNG with zeros in the middle and a valid end, for which the decoder itself writes to stderr."""
    data = bytearray((pair / "depth1.png").read_bytes())
    data[5000:5400] = bytes(400)
    (pair / "depth1.png").write_bytes(data)


def swapped(pair: Path) -> None:
    depth = (pair / "depth0.png").read_bytes()
    color = cv2.imread(str(pair / "color0.jpg"))
    (pair / "color0.jpg").unlink()
    (pair / "color0.png").write_bytes(depth)
    cv2.imwrite(str(pair / "depth0.png"), color)


BAD_PAIRS: dict[str, tuple[Callable[[Path], None], list[str], str]] = {
    "missing file": (lambda pair: (pair / "depth1.png").unlink(), [], "depth1.png: no such file"),
    "no pair": (lambda pair: (pair / "color0.jpg").unlink(), [], "no color0.png"),
    "text as png": (text_as_png, [], "color1.png: not an image"),
    "truncated png": (half("depth1.png"), [], "depth1.png: the PNG is cut off"),
    "truncated jpeg": (half("color1.jpg"), [], "color1.jpg: the JPEG is cut off"),
    "damaged png": (damaged, [], "depth1.png: not an image"),
    "8-bit depth": (eight_bits, [], "depth1.png: a depth image has 16 bits"),
    "zero depth": (all_zero, [], "depth1.png: depth is missing everywhere"),
    "colour and depth differ": (resize("depth1.png"), [], "colour is 640x480, depth 320x240"),
    "frames differ": (resize("color1.jpg", "depth1.png"), [], "320x240"),
    "camera lacks fx": (camera(fx=None), [], "camera.json: fx missing"),
    "camera of another width": (camera(width=800), [], "800x480"),
    "camera is no json": (lambda pair: (pair / "camera.json").write_text("{"), [], "camera.json: not a JSON file"),
    "no camera": (lambda pair: (pair / "camera.json").unlink(), [], "--intrinsics"),
    "scale that gives 500 m": (camera(depth_scale=1.3), [], "depth scale"),
    "scale 0": (camera(), ["--depth-scale", "0"], "positive"),
    "swapped": (swapped, [], "swapped"),
    "unknown method": (camera(), ["--method", "best"], "choose one of"),
    "unknown camera": (camera(), ["--camera", "sideways"], "auto"),
    "three intrinsics": (camera(), ["--intrinsics", "1", "2", "3"], "--intrinsics"),
    "intrinsics of another size": (camera(), ["--intrinsics", "900", "900", "80000", "400"], "principal point"),
    "unknown option": (camera(), ["--bogus"], "--bogus"),
}


@pytest.mark.parametrize("case", BAD_PAIRS)
def test_bad_pairs(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, options, words = BAD_PAIRS[case]
    pair = tmp_path / "pair"
    shutil.copytree(PAIR, pair)
    change(pair)
    code = main(["estimate", str(pair), "--out", str(tmp_path / "out" / "result"), *options])
    check_one_line(capfd, words)
    assert code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["pair"]


def test_an_unknown_method_lists_all_choices(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["estimate", str(PAIR), "--method", "best"]) == 2
    line = capfd.readouterr().err
    assert all(name in line for name in registry.METHODS)


@pytest.mark.parametrize("command", ["estimate", "run"])
def test_an_output_folder_with_other_content_is_unchanged(
    command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    assert main([command, str(PAIR), "--method", "zero", "--out", str(tmp_path)]) == 2
    check_one_line(capfd, "name another output folder")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize("command", ["estimate", "run"])
@pytest.mark.parametrize("name", ["file", "file/below"])
def test_an_output_folder_that_is_a_file_is_refused(
    command: str, name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main([command, str(PAIR), "--method", "zero", "--out", str(tmp_path / name)]) == 2
    check_one_line(capfd, "is a file, not a folder")


@pytest.mark.parametrize("command", ["estimate", "run"])
def test_an_unwritable_output_folder_is_reported_before_the_estimate(
    command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is simulated because root can write anywhere."""

    def refuse(*_: Any, **__: Any) -> str:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    def never(name: str, **_: Any) -> base.Estimator:
        def call(prev: Any, curr: Any) -> Any:
            pytest.fail("estimated before the output was checked")

        return call

    monkeypatch.setattr("objectflow.storage.files.temporary_folder", refuse)
    monkeypatch.setattr("objectflow.cli.arguments.load", never)
    assert main([command, str(PAIR), "--out", str(tmp_path / "a" / "b")]) == 1
    check_one_line(capfd, "Permission denied")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_no_files(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.save", full)
    assert main(["estimate", str(PAIR), "--method", "zero", "--out", str(tmp_path / "a" / "b")]) == 1
    check_one_line(capfd, "No space left")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["estimate"], "expected a pair folder or four files"),
        (["estimate", "a", "b"], "not 2 paths"),
        (["estimate", "nowhere"], "nowhere: no such folder"),
        (["estimate", "a", "b", "c", "d"], "a: no such file"),
        (["run", "nowhere"], "nowhere: no such folder"),
        (["run", "nowhere.mkv"], "nowhere.mkv: no such file"),
        (["run", "nowhere.bag"], "nowhere.bag: no such file"),
        (["run"], "SOURCE"),
        (["fly"], "choose one of estimate"),
        (["demo", "--method", "best"], "unknown method"),
    ],
)
def test_bad_commands(
    words: list[str], expected: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    check_one_line(capfd, expected)
    assert list(tmp_path.iterdir()) == []


def test_internal_errors_are_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.delenv("OBJECTFLOW_DEBUG", raising=False)
    monkeypatch.setattr("objectflow.cli.estimate.write_result", broken)
    assert main(["estimate", str(PAIR), "--method", "zero", "--out", str(tmp_path / "a")]) == 1
    check_one_line(capfd, "internal error: ZeroDivisionError: a mistake")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("module", [False, True])
def test_errors_in_a_shell(module: bool, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    command = (
        ["-m", "objectflow"] if module else ["-c", "import sys; from objectflow.cli import main; sys.exit(main())"]
    )
    done = subprocess.run(
        [sys.executable, *command, "run", "empty"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("objectflow: empty: no RGB-D frames")
    assert done.stderr.count("\n") == 1
    assert os.listdir(tmp_path) == ["empty"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_terminated_estimate_leaves_no_files(tmp_path: Path, number: int) -> None:
    """The signal arrives while the result is written."""
    code = (
        "import os, signal, sys; from objectflow.cli import estimate, main; "
        # Under nohup, the tests inherit that SIGHUP is ignored.
        "signal.signal(signal.SIGHUP, signal.SIG_DFL); "
        f"estimate.write_result = lambda *_, **__: os.kill(os.getpid(), {int(number)}); sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "estimate", str(PAIR), "--method", "zero", "--out", "deep/result"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", "")
    assert os.listdir(tmp_path) == []


def check_one_line(capfd: pytest.CaptureFixture[str], words: str) -> None:
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith("objectflow: ")
    assert words in captured.err
