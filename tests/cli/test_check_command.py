"""`objectflow check` of sources: problems first, a verdict, a picture and an exit code."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import analytic
from objectflow.cli import main


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A TUM directory of six frames, alternating between the two of an analytic scene with a little noise."""
    scene = analytic.make_scene(5)
    rng = np.random.default_rng(0)
    folder = tmp_path / "recording"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        lines = "".join(f"{100 + 0.2 * k:.3f} {name}/{k}.png\n" for k in range(6))
        (folder / f"{name}.txt").write_text(lines)
    for k in range(6):
        frame = (scene.prev, scene.curr)[k % 2]
        noisy = frame.color.astype(int) + rng.integers(-1, 2, frame.color.shape)
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), noisy.clip(0, 255).astype(np.uint8)[..., ::-1])
        units = np.rint(frame.depth * 5000) + rng.integers(0, 2, frame.depth.shape) * (frame.depth > 0)
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), units.astype(np.uint16))
    (folder / "camera.json").write_text(json.dumps(scene.prev.camera.to_dict()))
    return folder


def test_a_sound_recording_has_no_problem(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(recording), "--strict", "--pair", "2", "3"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert captured.out.splitlines()[0].endswith("frames 2 and 3:")
    assert captured.out.splitlines()[-1] == "verdict: nothing suspicious"
    for word in ("times", "repeated images", "registration", "depth units", "camera motion"):
        assert word in captured.out


def test_problems_come_first_and_strict_exits_with_one(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["check", str(recording), "--depth-scale", "300"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "depth units" in lines[3]
    assert "suspicious" in lines[3]
    assert lines[-1].startswith("verdict: 2 suspicious: depth units")
    assert main([*command, "--strict"]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith(f"objectflow: {recording}: 2 suspicious: depth units")
    assert captured.err.count("\n") == 1


def test_bad_and_repeated_frames_are_found(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (recording / "depth" / "0.png").write_bytes(b"")
    shutil.copy(recording / "rgb" / "3.png", recording / "rgb" / "4.png")
    assert main(["check", str(recording)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "verdict: 2 suspicious: frames, repeated images" in out
    assert "colour repeats in 1" in " ".join(out.replace("│", " ").split())


def test_the_picture_shows_depth_edges_over_colour(recording: Path, tmp_path: Path) -> None:
    picture = tmp_path / "edges.png"
    assert main(["check", str(recording), "--picture", str(picture), "--pair", "0", "1"]) == 0
    image = cv2.imread(str(picture))
    color = cv2.imread(str(recording / "rgb" / "1.png"))
    assert image.shape == color.shape
    red = (image == (40, 40, 255)).all(axis=2)
    depth = cv2.imread(str(recording / "depth" / "1.png"), cv2.IMREAD_UNCHANGED).astype(float)
    # A pixel far from every step of depth is never marked.
    step = np.abs(np.diff(depth, axis=1)) > 0.02 * depth[:, 1:]
    near = cv2.dilate(np.pad(step, ((0, 0), (1, 0))).astype(np.uint8), np.ones((9, 9))) > 0
    assert 20 < red.sum() < 0.2 * red.size
    assert (red & near).sum() > 0.7 * red.sum()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--pair", "4", "9"], "expected two ascending numbers from 0 to 5"),
        (["--pair", "3", "3"], "expected two ascending numbers"),
        (["--json"], "--limit and --json are for data sets"),
        (["--camera-file", "nowhere.json"], "no such camera file"),
    ],
)
def test_bad_options_are_one_line(
    recording: Path, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(recording), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert words in captured.err
