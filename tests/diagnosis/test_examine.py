"""`examine` on correct pairs and on pairs with deliberate input errors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from helpers.paths import SHARED
from objectflow import cli
from objectflow.diagnosis import examine
from objectflow.diagnosis.registration import estimate_offset
from objectflow.diagnosis.settings import DiagnosisSettings
from objectflow.frame import RgbdFrame
from objectflow.readers import CameraOptions, open_source
from objectflow.settings import build

DATA = SHARED / "data"


def pair(seed: int = 17) -> analytic.AnalyticPair:
    return analytic.make_scene(seed, objects=(4, 6), moving_share=0.5)


def suspicious(prev: RgbdFrame, curr: RgbdFrame) -> set[str]:
    return {finding.check for finding in examine(prev, curr) if finding.level == "suspicious"}


@pytest.mark.parametrize("seed", [3, 5, 17, 23])
def test_a_correct_pair_has_no_suspicious_finding(seed: int) -> None:
    scene = pair(seed)
    assert suspicious(scene.prev, scene.curr) == set()


def test_a_wrong_depth_scale_is_found() -> None:
    scene = pair()
    for factor in (0.1, 10.0):
        frames = [dataclasses.replace(f, depth=f.depth * np.float32(factor)) for f in (scene.prev, scene.curr)]
        assert "depth units" in suspicious(*frames)


def test_the_thresholds_of_the_checks_are_settings() -> None:
    scene = pair()
    far = [dataclasses.replace(f, depth=f.depth * np.float32(10)) for f in (scene.prev, scene.curr)]
    settings = build(DiagnosisSettings, {"depth.max_median_depth": "20", "registration.min_edges": str(10**6)})
    findings = {finding.check: finding for finding in examine(*far, settings=settings)}
    assert findings["depth units"].level == "fine"
    assert "too few depth edges" in findings["registration"].text


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("depth.max_median=3", "unknown setting depth.max_median: did you mean depth.max_median_depth? choose one of"),
        ("width=3", "setting width must be at least 16, not 3"),
    ],
)
def test_a_wrong_setting_of_the_checks_is_named(word: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check-pair", "missing", "--set", word]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]


@pytest.mark.parametrize("shift", [(6, 0), (-5, 3), (0, 7)])
def test_unregistered_depth_is_found_and_its_offset_measured(shift: tuple[int, int]) -> None:
    scene = pair()
    du, dv = shift
    frames = [dataclasses.replace(f, depth=np.roll(f.depth, (-dv, -du), (0, 1))) for f in (scene.prev, scene.curr)]
    assert "registration" in suspicious(*frames)
    offset = estimate_offset(frames[1])
    assert offset is not None
    assert abs(offset.du - du) <= 1
    assert abs(offset.dv - dv) <= 1


def test_ray_length_instead_of_planar_depth_is_found() -> None:
    scene = pair()
    camera = scene.curr.camera
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    stretch = np.sqrt(1 + ((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2).astype(np.float32)
    frames = [dataclasses.replace(f, depth=f.depth * stretch) for f in (scene.prev, scene.curr)]
    assert "ray length" in suspicious(*frames)


def test_holes_and_coarse_depth_are_found() -> None:
    scene = pair()
    holes = np.random.default_rng(0).random(scene.curr.depth.shape) < 0.5
    holed = dataclasses.replace(scene.curr, depth=np.where(holes, 0, scene.curr.depth).astype(np.float32))
    assert "holes" in suspicious(scene.prev, holed)
    coarse = dataclasses.replace(scene.curr, depth=np.round(scene.curr.depth * 40).astype(np.float32) / 40)
    assert "depth steps" in suspicious(scene.prev, coarse)


def test_identical_frames_and_identical_depth_are_found() -> None:
    scene = pair()
    assert "two frames" in suspicious(scene.curr, scene.curr)
    assert "two frames" in suspicious(dataclasses.replace(scene.prev, depth=scene.curr.depth), scene.curr)


def test_swapped_depth_is_found() -> None:
    scene = analytic.make_scene(17, objects=(4, 6), motion=(0.05, 0.08))
    prev = dataclasses.replace(scene.prev, depth=scene.curr.depth)
    curr = dataclasses.replace(scene.curr, depth=scene.prev.depth)
    assert "swapped" in suspicious(prev, curr)
    assert "swapped" not in suspicious(scene.prev, scene.curr)


def test_changed_exposure_and_wrong_intrinsics_are_found() -> None:
    scene = pair()
    dark = dataclasses.replace(scene.curr, color=(scene.curr.color * 0.5).astype(np.uint8))
    assert "exposure" in suspicious(scene.prev, dark)
    narrow = dataclasses.replace(scene.curr.camera, fx=1500.0, fy=1500.0)
    frames = [dataclasses.replace(f, camera=narrow) for f in (scene.prev, scene.curr)]
    assert "camera" in suspicious(*frames)


def test_a_moving_camera_and_a_static_scene_are_noted() -> None:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    moved = analytic.make_scene(3, camera_motion=motion)
    notes = {f.check: f.text for f in examine(moved.prev, moved.curr) if f.level == "note"}
    assert "3.0 degrees" in notes["camera motion"]
    # Depth noise and a change of intensity keep the frames from being identical.
    static = analytic.make_scene(9, moving_share=0.0, depth_noise=0.001)
    curr = dataclasses.replace(static.curr, color=np.clip(static.curr.color.astype(int) + 1, 0, 255).astype(np.uint8))
    notes = {f.check: f.text for f in examine(static.prev, curr) if f.level == "note"}
    assert "nothing moved" in notes["amount of motion"]


def test_frames_of_different_scenes_are_suspicious() -> None:
    a, b = analytic.make_scene(3), analytic.make_scene(44)
    assert suspicious(a.prev, b.curr) == {"camera motion"}


@pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout: real pairs are not tested")
def test_real_pairs() -> None:
    expected = {"boxes_1": {"registration"}, "bin_1": set(), "robot": set(), "person_standing": set()}
    for name, checks in expected.items():
        frames = open_source(DATA / name, CameraOptions())
        assert suspicious(frames[0], frames[1]) == checks, name


def test_the_command_prints_every_check(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    scene = pair()
    with (tmp_path / "camera.json").open("w") as file:
        file.write(
            '{"width": 320, "height": 240, "fx": 236.46, "fy": 236.46, "cx": 159.5, "cy": 119.5, "depth_scale": 10000}'
        )
    for number, frame in enumerate((scene.prev, scene.curr)):
        cv2.imwrite(str(tmp_path / f"color{number}.png"), frame.color[..., ::-1])
        cv2.imwrite(str(tmp_path / f"depth{number}.png"), np.rint(frame.depth * 10000).astype(np.uint16))
    assert cli.main(["check-pair", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for word in ("registration", "depth units", "exposure", "camera motion", "nothing suspicious"):
        assert word in out
    assert cli.main(["check-pair", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
