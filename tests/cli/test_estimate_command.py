"""Files and output of `objectflow estimate` and `objectflow demo`."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow.cli import main
from objectflow.cli.demo_truth import DemoTruth, flow_errors, match_object
from objectflow.cli.output import RESULT_FILES
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.readers import open_pair

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"


def test_a_complete_result_folder_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "result"
    assert main(["estimate", str(PAIR), "--method", "zero", "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == RESULT_FILES
    assert [path.name for path in out.parent.iterdir()] == ["result"]
    summary = json.loads((out / "objects.json").read_text())
    assert (summary["method"], summary["width"], summary["height"], summary["objects"]) == ("zero", 640, 480, [])
    labels = cv2.imread(str(out / "labels.png"), cv2.IMREAD_UNCHANGED)
    assert (labels.dtype, labels.shape) == (np.uint16, (480, 640))
    flow = np.load(out / "scene_flow.npy")
    depth = cv2.imread(str(PAIR / "depth1.png"), cv2.IMREAD_UNCHANGED)
    assert (flow.dtype, flow.shape) == (np.float32, (480, 640, 3))
    np.testing.assert_array_equal(np.isnan(flow).any(-1), depth == 0)
    assert str(out) in capsys.readouterr().out
    SceneMotion.load(out)


def test_four_files_give_the_same_result_as_their_folder(tmp_path: Path) -> None:
    files = [str(PAIR / name) for name in ("color0.jpg", "depth0.png", "color1.jpg", "depth1.png")]
    options = ["--intrinsics", "615", "615", "319.5", "239.5", "--depth-scale", "1000", "--camera", "static"]
    assert main(["estimate", *files, *options, "--method", "dense-flow", "--out", str(tmp_path / "a")]) == 0
    assert main(["estimate", str(PAIR), "--method", "dense-flow", "--out", str(tmp_path / "b")]) == 0
    flows = [np.load(tmp_path / name / "scene_flow.npy") for name in "ab"]
    np.testing.assert_array_equal(*flows)
    assert np.nanmax(np.abs(flows[0])) > 0.02


def test_without_out_the_folder_is_dated_and_linked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["estimate", str(PAIR), "--method", "zero"]) == 0
    folders = [path for path in (tmp_path / "objectflow_out").iterdir() if not path.is_symlink()]
    assert len(folders) == 2
    latest = tmp_path / "objectflow_out" / "latest"
    assert latest.resolve() in [folder.resolve() for folder in folders]
    assert {path.name for path in latest.iterdir()} == RESULT_FILES


def test_an_earlier_result_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "result"
    for method in ("zero", "dense-flow"):
        assert main(["estimate", str(PAIR), "--method", method, "--out", str(out)]) == 0
    assert json.loads((out / "objects.json").read_text())["method"] == "dense-flow"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_the_demo_compares_with_the_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--method", "zero", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    for name in ("tea box", "can", "ball"):
        assert name in printed
    assert printed.count("missed") == 3


def test_the_truth_of_the_demo_is_consistent_with_its_depth() -> None:
    """Points moved by the true motions must lie on the measured surface of the previous frame."""
    prev, curr = open_pair(PAIR)
    truth = DemoTruth.read(PAIR / "truth.npz")
    v, u = np.mgrid[:480, :640]
    points = np.stack([(u - 319.5) / 615, (v - 239.5) / 615, np.ones_like(u)], -1) * curr.depth[..., None]
    for index in range(len(truth.names)):
        surface = points[(truth.labels == index + 1) & curr.valid]
        moved = surface @ truth.prev_T_curr[index, :3, :3].T + truth.prev_T_curr[index, :3, 3]
        x, y = (np.rint(moved[:, a] / moved[:, 2] * 615 + c).astype(int) for a, c in ((0, 319.5), (1, 239.5)))
        measured = prev.depth[y.clip(0, 479), x.clip(0, 639)]
        assert np.median(np.abs(measured - moved[:, 2])[measured > 0]) < 0.002, truth.names[index]


def test_a_perfect_result_matches_the_demo_perfectly() -> None:
    _, curr = open_pair(PAIR)
    truth = DemoTruth.read(PAIR / "truth.npz")
    objects = tuple(
        ObjectMotion(i + 1, int((truth.labels == i + 1).sum()), 1.0, bool(truth.moving[i]), center, motion)
        for i, (center, motion) in enumerate(zip(truth.centers, truth.prev_T_curr, strict=True))
    )
    flow = np.zeros((480, 640, 3), np.float32)
    result = SceneMotion(truth.labels, flow, objects)
    for index in range(len(truth.names)):
        match = match_object(truth.labels == index + 1, truth.centers[index], truth.prev_T_curr[index], result)
        assert match.id == index + 1
        assert match.iou == 1
        assert match.translation_mm == pytest.approx(0, abs=1e-6)
        assert match.rotation_deg == pytest.approx(0, abs=1e-4)
    moving, static = flow_errors(truth, curr, result)
    assert 0.02 < moving < 0.08  # The flow above is zero, so its error is the motion itself: 2 to 6 cm.
    assert static < 1e-6


@pytest.mark.parametrize("words", [["methods"], ["info"], ["--help"], ["estimate", "--help"], ["run", "-h"], ["-V"]])
def test_commands_that_only_print(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    expected = {"methods": "dense-flow", "info": "numpy", "-V": "objectflow"}.get(words[0], "Examples:\n  objectflow")
    assert expected in printed.out
    if words[-1] in ("--help", "-h"):
        assert printed.out.startswith("Examples:")


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from objectflow.cli import main; main(['estimate', '--help']); "
        "print(sorted({'torch', 'mujoco', 'ray', 'pyarrow'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


def test_notes_on_the_camera_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Frames of two different places: the camera's motion is unknown, which is said in one line."""
    rng = np.random.default_rng(0)
    pair = tmp_path / "pair"
    pair.mkdir()
    for number, depth in ((0, 700), (1, 2400)):
        color = cv2.resize(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), (160, 120))
        cv2.imwrite(str(pair / f"color{number}.png"), color)
        cv2.imwrite(str(pair / f"depth{number}.png"), np.full((120, 160), depth, np.uint16))
    camera = {"width": 160, "height": 120, "fx": 150.0, "fy": 150.0, "cx": 79.5, "cy": 59.5, "depth_scale": 1000}
    (pair / "camera.json").write_text(json.dumps(camera))
    assert main(["estimate", str(pair), "--method", "consensus", "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    motion = SceneMotion.load(tmp_path / "out")
    assert motion.camera == "unknown"
    assert [line for line in lines if line.startswith("note: camera: unknown: ")] == [f"note: {motion.notes[0]}"]
    assert main(["run", str(pair), "--method", "consensus", "--out", str(tmp_path / "run")]) == 0
    assert "the camera's motion is unknown in 1" in capsys.readouterr().out
    assert (tmp_path / "run" / "summary.csv").read_text().splitlines()[1].split(",")[5] == "unknown"
