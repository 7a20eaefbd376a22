"""`objectflow run`: all pairs of a sequence, resumed after an interruption."""

from __future__ import annotations

import csv
import itertools
import json
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from objectflow.cli import main
from objectflow.cli.output import RESULT_FILES
from objectflow.cli.run import KNOWN, SEGMENTATION

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Five small frames of random colours on an approaching wall."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "sequence"
    (folder / "color").mkdir(parents=True)
    (folder / "depth").mkdir()
    for index in range(5):
        cv2.imwrite(str(folder / "color" / f"{index}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), np.full((48, 64), 1000 - 20 * index, np.uint16))
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "depth_scale": 1000}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def names(folder: Path) -> set[str]:
    """The names in a folder, without estimates from older frames."""
    return {path.name for path in folder.iterdir() if not path.name.startswith("since_")}


def test_every_pair_has_a_result_folder(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["run", str(sequence), "--method", "zero", "--out", str(out)]) == 0
    pairs = {f"pair_{i:06d}_{i + 1:06d}" for i in range(4)}
    assert names(out) == pairs | {"settings.json", "summary.csv", "tracks.json", "trajectories", SEGMENTATION}
    assert all(names(out / pair) == RESULT_FILES | {KNOWN} for pair in pairs)
    rows = list(csv.DictReader((out / "summary.csv").open()))
    assert [(row["prev"], row["curr"], row["moving"]) for row in rows] == [(str(i), str(i + 1), "0") for i in range(4)]
    assert "4 pairs; something moved in 0" in capsys.readouterr().out


def test_workers_give_the_results_of_one_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "clip"
    for kind, suffix in (("color", "jpg"), ("depth", "png")):
        (source / kind).mkdir(parents=True)
        for index in range(4):  # there and back again
            shutil.copy(PAIR / f"{kind}{index % 2}.{suffix}", source / kind / f"{index}.{suffix}")
    shutil.copy(PAIR / "camera.json", source)
    words = ["run", str(source), "--method", "consensus", "--camera", "static", "--no-pictures"]
    assert main([*words, "--out", str(tmp_path / "one")]) == 0
    # A pair that is done keeps its place in the order of the workers.
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    for pair in ("pair_000000_000001", "pair_000002_000003"):
        shutil.rmtree(tmp_path / "two" / pair)
    assert main([*words, "--out", str(tmp_path / "two"), "--workers", "2"]) == 0
    for name in ("tracks.json", *(f"pair_00000{i}_00000{i + 1}/{KNOWN}" for i in range(3))):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    one, two = (
        json.loads((tmp_path / run / "pair_000002_000003" / "objects.json").read_text()) for run in ("one", "two")
    )
    assert one["objects"]
    assert {**one, "seconds": 0} == {**two, "seconds": 0}
    assert "1 of them done before" in capsys.readouterr().out


def test_every_selects_each_nth_frame(sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["run", str(sequence), "--method", "zero", "--every", "2", "--out", str(out)]) == 0
    assert {"pair_000000_000002", "pair_000002_000004"} < names(out)
    assert len(names(out)) == 7


def test_finished_pairs_are_kept_and_missing_ones_are_estimated(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    assert main(command) == 0
    shutil.rmtree(out / "pair_000002_000003")
    (out / ".objectflow-0123456789abcdef.tmp").mkdir()  # Leftover of a killed run.
    kept = (out / "pair_000001_000002" / "objects.json").stat().st_mtime_ns
    capsys.readouterr()
    assert main(command) == 0
    assert "3 of them done before" in capsys.readouterr().out
    assert (out / "pair_000001_000002" / "objects.json").stat().st_mtime_ns == kept
    assert names(out / "pair_000002_000003") == RESULT_FILES | {KNOWN}
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    ("method", "options", "words"),
    [
        ("zero", ["--method", "dense-flow"], "method = zero, now it is dense-flow"),
        ("zero", ["--method", "zero", "--every", "2"], "every = 1, now it is 2"),
        ("zero", ["--method", "zero", "--depth-scale", "500"], "depth_scale"),
        ("vo-sf", ["--method", "vo-sf", "--camera", "static"], "camera = auto"),
        ("consensus", ["--method", "consensus", "--set", "matching.stride=4"], "matching.stride = 8, now it is 4"),
    ],
)
def test_other_settings_are_refused(
    sequence: Path, tmp_path: Path, method: str, options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["run", str(sequence), "--method", method, "--out", str(out)]) == 0
    before = sorted(out.rglob("*"))
    capsys.readouterr()
    assert main(["run", str(sequence), "--out", str(out), *options]) == 2
    assert words in capsys.readouterr().err
    assert sorted(out.rglob("*")) == before


def test_an_interrupt_exits_with_130_and_keeps_finished_pairs(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from objectflow.cli import run as module

    calls = 0
    write = module.write_result

    def interrupted(*arguments: Any, **options: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise KeyboardInterrupt
        write(*arguments, **options)

    out = tmp_path / "out"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    monkeypatch.setattr(module, "write_result", interrupted)
    assert main(command) == 130
    assert capsys.readouterr().err == "objectflow: interrupted: the same command continues\n"
    assert names(out) == {"settings.json", "pair_000000_000001", "pair_000001_000002"}
    monkeypatch.setattr(module, "write_result", write)
    assert main(command) == 0
    assert len(names(out)) == 9


def test_a_sequence_without_a_readable_pair_leaves_no_files(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for index in range(4):
        (sequence / "depth" / f"{index}.png").write_text("no picture")
    assert main(["run", str(sequence), "--method", "zero", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "0.png" in error
    assert error.count("\n") == 1
    assert names(tmp_path) == {"sequence"}


def test_a_pair_that_cannot_be_written_ends_the_run_with_one_line(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from objectflow.cli import run as module

    write = module.write_result

    def fails(folder: Path, *arguments: Any, **options: Any) -> None:
        write(folder, *arguments, **options)
        if len(list(folder.parent.glob("pair_*"))) == 1:  # the second pair
            raise OSError(28, "No space left on device")

    out = tmp_path / "out"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    monkeypatch.setattr(module, "write_result", fails)
    assert main(command) != 0
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot write" in error
    assert "No space left on device" in error
    # Later pairs are not written either, and nothing is left of the second one.
    assert names(out) == {"settings.json", "pair_000000_000001"}
    monkeypatch.setattr(module, "write_result", write)
    assert main(command) == 0
    assert len(names(out)) == 9


@pytest.mark.parametrize("bad", [0, 1, 2, 4])
def test_a_bad_frame_is_left_out_and_named(
    sequence: Path, tmp_path: Path, bad: int, capsys: pytest.CaptureFixture[str]
) -> None:
    (sequence / "depth" / f"{bad}.png").write_text("no picture")
    out = tmp_path / "out"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    assert main(command) == 0
    left = [index for index in range(5) if index != bad]
    pairs = {f"pair_{i:06d}_{j:06d}" for i, j in itertools.pairwise(left)}
    assert {name for name in names(out) if name.startswith("pair")} == pairs
    first = capsys.readouterr().out
    assert f"frame {bad} left out" in first
    assert f"{bad}.png" in (out / "notes.txt").read_text()
    # A continued run leaves out the same frame, and keeps the same pairs.
    assert main(command) == 0
    again = capsys.readouterr().out
    assert "3 of them done before" in again
    assert f"frame {bad} left out" in again


def test_no_pair_crosses_a_cut(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from objectflow.cli import arguments as module

    opened = module.open_source
    monkeypatch.setattr(module, "open_source", lambda *args, **kw: replace(opened(*args, **kw), cuts=(2,)))
    out = tmp_path / "out"
    assert main(["run", str(sequence), "--method", "zero", "--out", str(out)]) == 0
    pairs = {name for name in names(out) if name.startswith("pair")}
    assert pairs == {"pair_000000_000001", "pair_000002_000003", "pair_000003_000004"}


def test_a_cut_to_another_scene_starts_a_new_world_and_is_said(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for index in (3, 4):
        cv2.imwrite(str(sequence / "depth" / f"{index}.png"), np.full((48, 64), 2000, np.uint16))
    out = tmp_path / "out"
    command = ["run", str(sequence), "--method", "zero", "--out", str(out)]
    for _ in range(2):  # a continued run says the same
        assert main(command) == 0
        assert "a new world starts at frame 3 written to" in " ".join(capsys.readouterr().out.split())
        assert "frame 3: a new world starts" in (out / "notes.txt").read_text()
        rows = list(csv.DictReader((out / "summary.csv").open()))
        assert [row["camera_cm"] for row in rows] == ["0.0", "0.0", "unknown", "0.0"]


def test_a_pair_folder_is_a_sequence_of_one_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", str(PAIR), "--method", "zero"]) == 0
    assert names(tmp_path / "objectflow_out" / "latest") == {
        "pair_000000_000001",
        "segmentation.png",
        "settings.json",
        "summary.csv",
        "tracks.json",
        "trajectories",
        SEGMENTATION,
    }


@pytest.mark.parametrize("every", ["0", "5"])
def test_a_step_without_pairs_is_refused(sequence: Path, every: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(sequence), "--method", "zero", "--every", every]) == 2
    assert "every" in capsys.readouterr().err


def test_trajectories_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(PAIR), "--out", str(tmp_path / "out")]) == 0
    assert "3 objects followed" in capsys.readouterr().out
    tracks = json.loads((tmp_path / "out" / "tracks.json").read_text())["tracks"]
    objects = json.loads((tmp_path / "out" / "pair_000000_000001" / "objects.json").read_text())["objects"]
    for track, obj in zip(tracks, objects, strict=True):
        first, last = (np.array(pose) for pose in track["world_T_object"])
        # The camera is static, so the inverse of the step is the object's motion.
        np.testing.assert_allclose(first @ np.linalg.inv(last), np.array(obj["prev_T_curr"]), atol=1e-9)
        lines = np.loadtxt(tmp_path / "out" / "trajectories" / f"object_{track['id']:03d}.txt")
        np.testing.assert_allclose(lines[:, 1:4], [first[:3, 3], last[:3, 3]], atol=1e-6)


def test_overlays_have_lasting_colours_and_trails_and_make_a_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A square moves right over three pairs; its ids in the results are 1, 3 and 2, its track is always 1."""
    from objectflow import ObjectMotion, RgbdFrame, SceneMotion
    from objectflow.view.colors import object_color

    folder = tmp_path / "sequence"
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for index in range(4):
        cv2.imwrite(str(folder / "color" / f"{index}.png"), np.full((240, 320, 3), 128 + index, np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{index}.png"), np.full((240, 320), 1000, np.uint16))
    ids = iter((1, 3, 2, 1))

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        place = int(curr.color[0, 0, 0]) - 128
        labels = np.zeros((240, 320), np.int32)
        number = next(ids)
        labels[90:150, 60 + 30 * place : 120 + 30 * place] = number
        motion = np.eye(4)
        motion[0, 3] = -0.1  # 30 pixels at 1 m.
        center = np.array([(89.5 + 30 * place - 159.5) / 300, 0.0, 1.0])
        obj = ObjectMotion(number, 3600, 0.9, True, center, motion)
        return SceneMotion(labels, np.zeros((240, 320, 3), np.float32), (obj,), method="test")

    monkeypatch.setattr("objectflow.cli.arguments.load", lambda *_, **__: estimate)
    words = ["run", str(folder), "--intrinsics", "300,300,159.5,119.5", "--depth-scale", "1000"]
    assert main([*words, "--out", str(tmp_path / "out"), "--video"]) == 0
    for index in range(3):
        picture = cv2.imread(str(tmp_path / "out" / f"pair_{index:06d}_{index + 1:06d}" / "overlay.png"))[..., ::-1]
        outline = np.abs(picture.astype(int) - object_color(1)).max(axis=-1) < 12
        columns = np.nonzero(outline[300:420].any(axis=0))[0] / 3
        assert columns.max() == pytest.approx(149.5 + 30 * index, abs=3)
        # The trail begins where the object was first, 30 pixels left of its first current place.
        trail = outline[345:375, 3 * 62 : 3 * (88 + 30 * index)]
        assert trail.any() == (index > 0)
    video = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FRAME_WIDTH)) == (3, 960)
    assert main([*words, "--out", str(tmp_path / "other"), "--video", "--no-pictures"]) == 2

    # A pair that is lost and made again has the same known objects, whose models come from the stored results.
    known = tmp_path / "out" / "pair_000001_000002" / KNOWN
    before, picture = known.read_bytes(), (tmp_path / "out" / SEGMENTATION).read_bytes()
    labels = cv2.imread(str(known), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16
    np.testing.assert_array_equal(np.unique(labels), [0, 1])
    shutil.rmtree(known.parent)
    assert main([*words, "--out", str(tmp_path / "out"), "--video"]) == 0
    assert known.read_bytes() == before
    assert (tmp_path / "out" / SEGMENTATION).read_bytes() == picture


def test_start_stop_and_limit(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def pairs(*options: str) -> set[str]:
        out = tmp_path / "_".join(options)
        assert main(["run", str(sequence), "--method", "zero", "--out", str(out), *options]) == 0
        return {name for name in names(out) if name.startswith("pair")}

    assert pairs("--start", "1", "--stop", "4") == {"pair_000001_000002", "pair_000002_000003"}
    assert pairs("--start", "1", "--every", "2") == {"pair_000001_000003"}
    assert pairs("--limit", "2") == {"pair_000000_000001", "pair_000001_000002"}
    assert pairs("--stop", "99", "--limit", "99") == {f"pair_{k:06d}_{k + 1:06d}" for k in range(4)}
    capsys.readouterr()
    command = ["run", str(sequence), "--method", "zero", "--out", str(tmp_path / "no")]
    for options, words in (
        (["--start", "4"], "5 frames, every 1 taken from --start 4: a pair needs two"),
        (["--start", "-1"], "--start must be at least 0"),
        (["--limit", "0"], "--limit at least 1"),
    ):
        assert main([*command, *options]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_a_limited_run_is_continued(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", str(sequence), "--method", "zero", "--out", str(tmp_path / "out")]
    assert main([*command, "--limit", "1"]) == 0
    capsys.readouterr()
    assert main(command) == 0
    assert "4 pairs, 1 of them done before" in capsys.readouterr().out


def test_bad_frames_are_left_out_and_named(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(sequence / "depth" / "0.png"), np.zeros((48, 64), np.uint16))  # the camera warms up
    (sequence / "color" / "3.png").write_bytes((sequence / "color" / "3.png").read_bytes()[:200])
    assert main(["run", str(sequence), "--method", "zero", "--out", str(tmp_path / "out")]) == 0
    assert {"pair_000001_000002", "pair_000002_000004"} < names(tmp_path / "out")
    out = capsys.readouterr().out
    assert "2 frames left out" in out
    assert "depth/0.png: depth is missing everywhere" in out
    assert "color/3.png: the PNG is cut off" in out


def test_suspicious_input_is_warned_of_once(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", str(sequence), "--method", "zero", "--depth-scale", "100", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("warning: depth units: current: the median depth is 9.8 m")
    assert main(["run", str(sequence), "--method", "zero", "--out", str(tmp_path / "fine")]) == 0
    assert capsys.readouterr().err == ""
