"""`objectflow run --models` and `objectflow reconstruct`, on a turning box with known shape and poses."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from helpers.turning_solids import View, distance_to_surface, solid, turning, write_recording
from objectflow.cli import main
from objectflow.geometry import inverse, transform
from objectflow.motion import SceneMotion
from objectflow.typing import Float64Array

BOX = solid("box", (0.05, 0.07, 0.04))
COMMAND = ["--method", "consensus", "--camera", "static", "--no-pictures"]


@pytest.fixture(scope="module")
def views() -> list[View]:
    return turning(BOX, 9, degrees=8)


@pytest.fixture(scope="module")
def recording(views: list[View], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turning") / "recording"
    write_recording(folder, views)
    return folder


@pytest.fixture(scope="module")
def result(recording: Path) -> Path:
    out = recording.parent / "result"
    assert main(["run", str(recording), *COMMAND, "--models", "--out", str(out)]) == 0
    return out


def masked_points(result: Path, views: list[View]) -> Float64Array:
    """The exact surface points of the box in the estimated masks, away from their edges."""
    out = []
    for number in range(1, len(views)):
        mask = SceneMotion.load(result / f"pair_{number - 1:06d}_{number:06d}").labels == 1
        inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))[views[number].mask] > 0
        out.append(views[number].points[inside])
    return np.concatenate(out)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_models_lie_on_the_true_surface_at_every_pose(result: Path, views: list[View]) -> None:
    index = json.loads((result / "models" / "index.json").read_text())
    assert index["format"] == 1
    (entry,) = index["objects"]
    assert entry["id"] == 1
    assert entry["frames"] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert 0 < entry["residual_mm"] < 4
    mesh = trimesh.load(result / "models" / "object_001.ply", process=False)
    assert len(mesh.vertices) == entry["vertices"]
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(entry["extent"], abs=1e-5)
    for frame, pose in zip(entry["frames"], entry["world_T_object"], strict=True):
        # The camera is static, so the world is every frame's camera.
        points = transform(inverse(views[frame].camera_T_object) @ np.array(pose), np.asarray(mesh.vertices))
        distance = distance_to_surface(BOX, points)
        assert np.median(distance) < 0.0015
        assert np.quantile(distance, 0.9) < 0.004
        if frame == 1:
            assert (cKDTree(points).query(masked_points(result, views)[::3])[0] < 0.003).mean() > 0.85


def test_seen_share_is_an_upper_bound(result: Path) -> None:
    (entry,) = json.loads((result / "models" / "index.json").read_text())["objects"]
    whole = 8 * (0.05 * 0.07 + 0.05 * 0.04 + 0.07 * 0.04)
    assert entry["area"] / whole < entry["seen_share_at_most"] < 1


def test_both_files_hold_the_same_mesh(result: Path) -> None:
    ply = trimesh.load(result / "models" / "object_001.ply", process=False)
    glb = trimesh.load(result / "models" / "object_001.glb", force="mesh", process=False)
    assert np.array_equal(ply.vertices, glb.vertices)
    assert np.array_equal(ply.faces, glb.faces)
    assert np.array_equal(ply.visual.vertex_colors, glb.visual.vertex_colors)


def test_the_background_is_the_plane(result: Path) -> None:
    cloud = trimesh.load(result / "models" / "background.ply")
    points = np.asarray(cloud.vertices)
    assert len(points) > 5000
    # The plane lies 0.5 m below the centre of the box, which the camera sees at 1 m with a tilt of 35 degrees.
    tilt = np.radians(35)
    up = np.array([0, -np.cos(tilt), -np.sin(tilt)])
    height = (points - [0, 0, 1.0]) @ up
    assert np.median(np.abs(height + 0.5)) < 0.01
    # The method's masks leave parts of the box out.
    assert (height > -0.2).sum() < 0.01 * len(points)
    assert json.loads((result / "models" / "index.json").read_text())["background"]["points"] == len(points)


def test_reconstruct_writes_the_same_bytes(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(result, copy)
    shutil.rmtree(copy / "models")
    assert main(["reconstruct", str(copy)]) == 0
    assert "models of 1 of 1 object: models" in capsys.readouterr().out
    assert contents(copy / "models") == contents(result / "models")


def test_a_continued_run_writes_the_same_bytes(recording: Path, result: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(result, copy)
    shutil.rmtree(copy / "models")
    shutil.rmtree(copy / "pair_000006_000007")
    (copy / "tracks.json").unlink()
    assert main(["run", str(recording), *COMMAND, "--models", "--out", str(copy)]) == 0
    assert contents(copy / "models") == contents(result / "models")


def test_a_moved_source_is_named_by_an_option(
    recording: Path, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, moved = tmp_path / "copy", tmp_path / "moved"
    shutil.copytree(result, copy)
    shutil.copytree(recording, moved)
    settings = json.loads((copy / "settings.json").read_text())
    (copy / "settings.json").write_text(json.dumps(settings | {"source": str(tmp_path / "gone")}))
    assert main(["reconstruct", str(copy)]) == 2
    assert "give their path by --source SOURCE" in capsys.readouterr().err
    assert main(["reconstruct", str(copy), "--source", str(moved)]) == 0
    assert contents(copy / "models") == contents(result / "models")


def test_an_unfinished_run_is_refused(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(result, copy)
    shutil.rmtree(copy / "models")
    (copy / "tracks.json").unlink()
    assert main(["reconstruct", str(copy)]) == 2
    assert "the run is not finished" in capsys.readouterr().err
    assert not (copy / "models").exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(tmp_path)]) == 2
    assert "not a folder of objectflow run" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["run", "reconstruct"])
def test_a_missing_extra_is_said_before_anything_is_done(
    command: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "skimage", None)
    out = tmp_path / "out"
    words = (
        ["run", str(recording), *COMMAND, "--models", "--out", str(out)] if command == "run" else [command, str(out)]
    )
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "models need scikit-image and trimesh: pip install" in error
    assert "[models]" in error
    assert error.count("\n") == 1
    assert not out.exists()
