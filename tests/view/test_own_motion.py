"""An object's own motion in every output under a moving camera: the true displacement, and 0 for what stands still."""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
import objectflow
from helpers.truths import true_object
from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion, geometry
from objectflow.cli import main
from objectflow.cli.live import step_line
from objectflow.cli.output import print_objects
from objectflow.evaluation.data.truth import make_pair_truth
from objectflow.evaluation.results import EvaluationPair, facts_of
from objectflow.live import Step
from objectflow.storage.image_files import read_image
from objectflow.storage.images import encode_png
from objectflow.tracking.tracker import Tracker
from objectflow.typing import Float64Array
from objectflow.view import draw_flow, draw_overlay
from objectflow.view.colors import INK, PAPER
from objectflow.view.flow import flow_range
from objectflow.view.report_page.pair_block import make_pair_block
from objectflow.view.viewer_frames import pair_frames, tracked_frames

TOLERANCE = 0.003
"""Metres: largest error of a displacement in any output."""
CAMERA_MOTION: Float64Array = geometry.make_transform(
    Rotation.from_euler("xyz", (3, -4, 2), degrees=True).as_matrix(), [0.06, -0.03, 0.04]
)
GAP = 0.5
"""Seconds between the frames."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingCameraScene:
    """A scene in which some objects stand still, its exact result, and the true displacements in metres."""

    scene: analytic.AnalyticPair
    motion: SceneMotion
    displacements: dict[int, float]
    centers: dict[int, Float64Array]


def make(seed: int) -> MovingCameraScene:
    scene = analytic.make_scene(seed, objects=(4, 5), moving_share=0.5, camera_motion=CAMERA_MOTION)
    v, u = np.mgrid[:240, :320]
    camera = scene.curr.camera
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    points = rays * scene.curr.depth[..., None]
    displacements, centers, objects = {}, {}, []
    for label in sorted(set(np.unique(scene.labels[scene.curr.valid]).tolist()) - {0}):
        mask = (scene.labels == label) & scene.curr.valid
        centers[label] = points[mask].mean(axis=0)
        # In the world: where the centre was for the previous camera, brought to the current one by a static point.
        before = np.linalg.solve(CAMERA_MOTION, scene.prev_T_curr[label] @ np.append(centers[label], 1))[:3]
        displacements[label] = float(np.linalg.norm(before - centers[label])) if label in scene.moving else 0.0
        objects.append(
            ObjectMotion(label, int(mask.sum()), 0.9, label in scene.moving, centers[label], scene.prev_T_curr[label])
        )
    motion = SceneMotion(scene.labels, scene.scene_flow, tuple(objects), CAMERA_MOTION, method="exact")
    assert any(displacements.values())
    assert not all(displacements.values())
    return MovingCameraScene(scene, motion, displacements, centers)


SCENES = [make(3), make(5)]


@pytest.fixture(params=SCENES, ids=["seed 3", "seed 5"])
def case(request: pytest.FixtureRequest) -> MovingCameraScene:
    return request.param  # type: ignore[no-any-return]


def check(shown: dict[int, float], case: MovingCameraScene) -> None:
    """Every displacement in metres is the true one, and exactly 0 for what stands still."""
    assert set(shown) == set(case.displacements)
    for label, metres in shown.items():
        assert metres == pytest.approx(case.displacements[label], abs=TOLERANCE)
        if case.displacements[label] == 0:
            assert metres == 0.0


def test_the_api_and_the_files(case: MovingCameraScene, tmp_path: Path) -> None:
    check({obj.id: obj.displacement for obj in case.motion}, case)
    case.motion.save(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "objects.json").read_text())
    check({entry["id"]: entry["displacement_m"] for entry in summary["objects"]}, case)
    for entry in summary["objects"]:
        own = np.array(entry["own_prev_T_curr"])
        center = np.array(entry["center"])
        moved = float(np.linalg.norm(own[:3, :3] @ center + own[:3, 3] - center))
        assert moved == pytest.approx(case.displacements[entry["id"]], abs=1e-6)
        if entry["id"] not in case.scene.moving:
            np.testing.assert_array_equal(own, np.eye(4))
            assert entry["rotation_deg"] == 0
    loaded = SceneMotion.load(tmp_path / "out")
    check({obj.id: obj.displacement for obj in loaded}, case)
    check({entry["id"]: entry["attributes"]["displacement_m"] for entry in case.motion.to_coco()}, case)


def test_the_printed_and_the_html_table(case: MovingCameraScene, capsys: pytest.CaptureFixture[str]) -> None:
    print_objects(case.motion)
    printed = capsys.readouterr().out
    assert "camera moved 7.8 cm, 5.4 deg" in printed
    rows = [line.split() for line in printed.splitlines()[1:] if line and line.split()[0].isdigit()]
    check({int(row[0]): float(row[2]) / 100 for row in rows}, case)
    assert all(row[2] == "0" for row in rows if int(row[0]) not in case.scene.moving)
    cells = [re.findall(r"<td>([^<]*)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", case.motion._repr_html_())]
    check({int(row[0]): float(row[2]) / 100 for row in cells if row}, case)


def test_the_arrows_and_captions_of_the_overlay(case: MovingCameraScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its captions the overlay differs from that of resting objects by the arrows alone."""
    written: list[str] = []
    monkeypatch.setattr("objectflow.view.canvas.write", lambda _, text, *__, **___: written.append(text))
    monkeypatch.setattr(
        "objectflow.view.tags._draw", lambda _, tag, *__: written.append(f"{tag.number} {tag.caption}")
    )
    for obj in case.motion.moving:
        rest = dataclasses.replace(obj, prev_T_curr=CAMERA_MOTION @ geometry.make_transform(np.eye(3), [0, 0, 1e-6]))
        with_arrow, without = (
            draw_overlay(case.scene.curr, dataclasses.replace(case.motion, objects=(one,), labels=_only(case, obj.id)))
            for one in (obj, rest)
        )
        scale = with_arrow.shape[1] / 320
        ends = [_project(point, case.scene.curr.camera, scale) for point in (obj.prev_center, obj.center)]
        true_length = float(np.linalg.norm(ends[1] - ends[0]))
        changed = (np.abs(with_arrow.astype(int) - without).max(axis=-1) > 40) & _inked(with_arrow)
        rows, columns = np.nonzero(changed)
        if true_length < 12:
            continue
        along = (ends[1] - ends[0]) / true_length
        places = (np.stack([columns, rows], axis=1) - ends[0]) @ along
        pixel = float(obj.center[2]) / (case.scene.curr.camera.fx * scale)
        drawn = (places.max() - places.min()) * pixel
        assert drawn <= true_length * pixel + TOLERANCE
        assert drawn >= true_length * pixel - 2 * TOLERANCE
    written.clear()
    draw_overlay(case.scene.curr, case.motion)
    tags = dict(text.split(" ", 1) for text in written)
    check({int(n): float(caption.split()[0]) / 100 if caption else 0.0 for n, caption in tags.items()}, case)


def _only(case: MovingCameraScene, label: int) -> np.ndarray:
    return np.where(case.motion.labels == label, case.motion.labels, np.int32(0))


def _project(point: Float64Array, camera: Camera, scale: float) -> Float64Array:
    pixel = np.array([camera.fx * point[0] / point[2] + camera.cx, camera.fy * point[1] / point[2] + camera.cy])
    return (pixel + 0.5) * scale - 0.5


def _inked(image: np.ndarray) -> np.ndarray:
    """Pixels of the arrow's outline or inside."""
    return np.logical_or.reduce([np.abs(image.astype(int) - color).max(axis=-1) < 60 for color in (INK, PAPER)])


def test_the_flow_picture(case: MovingCameraScene, tmp_path: Path) -> None:
    """Static points have the colour of no motion, and the length at full colour is that of the world's motion."""
    own = case.motion.own_flow(case.scene.curr)
    known = case.scene.curr.valid
    length = np.linalg.norm(own, axis=-1)
    moving = np.isin(case.motion.labels, list(case.scene.moving))
    assert (length[known & ~moving] == 0).all()
    sheet = draw_flow(case.scene.curr, case.motion)
    assert sheet.shape[1] == 3 * 640 + 4 * 14  # Across the image, in depth, and the camera's motion.
    left, middle, camera = (sheet[34:514, 14 + k * 654 : 654 + k * 654] for k in range(3))
    still = np.repeat(np.repeat(known & ~moving, 2, axis=0), 2, axis=1)
    still[[0, -1], :] = still[:, [0, -1]] = False  # The frame around the panel.
    for panel in (left, middle):
        assert np.ptp(panel[still].astype(int), axis=-1).max() <= 1
    assert np.ptp(camera[still].astype(int), axis=-1).mean() > 20
    largest = max(case.displacements.values())
    assert largest * 0.8 < flow_range(own[known].astype(np.float64)) < 2.5 * largest
    case.motion.to_ply(tmp_path / "points.ply", case.scene.curr)
    header, data = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")
    names = re.findall(rb"property (\w+) (\w+)", header)
    kinds = {b"float": "<f4", b"uchar": "u1", b"int": "<i4"}
    table = np.frombuffer(data, np.dtype([(name.decode(), kinds[kind]) for kind, name in names]))
    written = np.stack([table[f"own_flow_{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(written, own[known])


def test_the_viewer_and_live(case: MovingCameraScene) -> None:
    prev, curr = (
        dataclasses.replace(frame, timestamp=time) for frame, time in ((case.scene.prev, 0.0), (case.scene.curr, GAP))
    )
    _, after = pair_frames(prev, curr, case.motion)
    lengths = {
        obj.id: 0.0 if obj.path is None else float(np.linalg.norm(np.diff(obj.path, axis=0))) for obj in after.objects
    }
    check(lengths, case)
    captions = {obj.id: float(obj.caption.split()[0]) / 100 if obj.caption else 0.0 for obj in after.objects}
    check(captions, case)
    assert after.own_flow is not None
    np.testing.assert_array_equal(after.own_flow, case.motion.own_flow(curr))
    tracker = Tracker()
    tracks = tracker.update(0.0, curr, GAP, case.motion)
    assert set(tracks) == set(case.scene.moving)
    _, tracked = tracked_frames(tracker, tracks, (prev, curr), case.motion, (0, 1), (0.0, GAP))
    for label, track in tracks.items():
        poses = tracker.tracks[track - 1].world_T_object
        assert np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3]) == pytest.approx(
            case.displacements[label], abs=TOLERANCE
        )
        shown = next(obj for obj in tracked.objects if obj.id == track)
        assert float(shown.caption.split()[0]) / 100 == pytest.approx(case.displacements[label], abs=TOLERANCE)
    line = step_line(Step(prev, curr, case.motion, tracks, (0.0, GAP), 0.1, 0))
    speeds = {int(n): float(v) / 100 * GAP for n, v in re.findall(r"#(\d+) ([\d.]+) cm/s", line)}
    for label, track in tracks.items():
        assert speeds[track] == pytest.approx(case.displacements[label], abs=TOLERANCE)


def test_the_report_and_its_facts(case: MovingCameraScene) -> None:
    scene = case.scene
    objects = [true_object(k, case.centers[k], scene.prev_T_curr[k]) for k in case.displacements if k in scene.moving]
    labels = np.where(np.isin(scene.labels, list(scene.moving)), scene.labels, np.int32(0))
    truth = make_pair_truth("pair", scene.curr, labels, objects, background_prev_T_curr=CAMERA_MOTION)
    for fact in facts_of(truth).objects:
        assert fact.displacement_cm / 100 == pytest.approx(case.displacements[fact.label], abs=TOLERANCE)
    block = make_pair_block(EvaluationPair(scene.prev, scene.curr, truth), {0: case.motion}, {})
    true_layer, found_layer = block["layers"]
    for obj, label in zip(true_layer["objects"], sorted(scene.moving & set(case.displacements)), strict=True):
        assert np.linalg.norm(obj["translation"]) == pytest.approx(case.displacements[label], abs=TOLERANCE)
    shown = {int(obj["name"].split()[-1]): float(np.linalg.norm(obj["translation"])) for obj in found_layer["objects"]}
    check(shown, case)
    largest = max(case.displacements.values())
    assert block["full"] < 2.5 * largest


def test_the_table_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`run` and `estimate` with a method that returns the exact result."""
    case = SCENES[0]
    for number, frame in enumerate((case.scene.prev, case.scene.curr)):
        _write_frame(tmp_path / "pair", number, frame)
    camera = case.scene.curr.camera.to_dict() | {"depth_scale": 10000}
    (tmp_path / "pair" / "camera.json").write_text(json.dumps(camera))
    monkeypatch.setattr("objectflow.cli.arguments.load", lambda *_, **__: lambda prev, curr: case.motion)
    assert main(["run", str(tmp_path / "pair"), "--out", str(tmp_path / "run")]) == 0
    table = list(csv.DictReader(io.StringIO((tmp_path / "run" / "summary.csv").read_text())))
    largest = max(case.displacements.values())
    assert float(table[0]["largest_displacement_cm"]) / 100 == pytest.approx(largest, abs=TOLERANCE)
    assert float(table[0]["camera_cm"]) == pytest.approx(7.8, abs=0.05)
    assert main(["estimate", str(tmp_path / "pair"), "--out", str(tmp_path / "one")]) == 0
    picture = read_image(tmp_path / "one" / "flow.png")
    # The stored depth is rounded to 0.1 mm, which changes the camera's panel by one grey level at most.
    np.testing.assert_allclose(picture, draw_flow(case.scene.curr, case.motion), atol=1)


def _write_frame(folder: Path, number: int, frame: RgbdFrame) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"color{number}.png").write_bytes(encode_png(frame.color))
    (folder / f"depth{number}.png").write_bytes(encode_png(np.rint(frame.depth * 10000).astype(np.uint16)))


@functools.cache
def rendered() -> analytic.AnalyticPair:
    return analytic.make_scene(2, objects=(4, 5), width=480, height=360, moving_share=0.5, camera_motion=CAMERA_MOTION)


@pytest.mark.parametrize("method", ["consensus", "rigidmatch"])
def test_estimates_under_a_moving_camera(method: str) -> None:
    """The displacements of a real estimate: within 3 mm of the truth, and 0 for what stands still."""
    scene = rendered()
    motion = objectflow.load(method)(scene.prev, scene.curr)
    found = 0
    for label in sorted(set(np.unique(scene.labels).tolist()) - {0}):
        mask = scene.labels == label
        ids = np.bincount(motion.labels[mask], minlength=1)
        own = int(np.argmax(ids))
        obj = motion[own] if own else None
        if label not in scene.moving:
            assert obj is None or obj.displacement == 0.0
            continue
        assert obj is not None
        before = np.linalg.solve(CAMERA_MOTION, scene.prev_T_curr[label] @ np.append(obj.center, 1))[:3]
        assert obj.displacement == pytest.approx(float(np.linalg.norm(before - obj.center)), abs=TOLERANCE)
        found += 1
    assert found
