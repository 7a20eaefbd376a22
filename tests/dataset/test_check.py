"""Exact ground truth gives no errors; wrong ground truth gives errors of the right size."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from helpers.small_sets import make_frame
from objectflow import geometry
from objectflow.dataset import manifest as manifests
from objectflow.dataset.check import CheckReport, Histogram, add_pair, check, contradictions
from objectflow.dataset.manifest import Manifest, Part, Shard
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import FrameObject, PairRow, SequenceRow
from objectflow.dataset.shards import write_shard
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.storage import files
from objectflow.view.data_pictures import draw_frames, draw_pair

CAMERA = Camera(width=80, height=60, fx=59.0, fy=59.0, cx=39.5, cy=29.5)
RADIUS = 0.08
PREV = geometry.se3_exp([0.02, -0.01, 0.5, 0.3, -0.2, 0.4])
CURR = geometry.se3_exp([-0.01, 0.01, 0.45, 0.1, 0.1, 0.1])


def render(camera_T_object: np.ndarray, frame: int) -> SequenceRow:
    """A ball in front of a wall, rendered from its equation; its colour rotates with it."""
    rays = np.concatenate([geometry.pixel_grid(CAMERA), np.ones((60, 80, 1), np.float32)], -1).astype(np.float64)
    center = camera_T_object[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - RADIUS**2
    root = b**2 - a * c
    hit = root > 0
    z = np.where(hit, (b - np.sqrt(np.maximum(root, 0))) / a, 1.0)
    on_ball = (rays * z[..., None] - center) @ camera_T_object[:3, :3] / RADIUS
    color = np.where(hit[..., None], 128 + 100 * on_ball, 60)
    image = RgbdFrame(color=color.round().astype(np.uint8), depth=z.astype(np.float32), camera=CAMERA)
    ball = FrameObject(label=1, category="ball", model="ball-0", symmetry=(), pose=camera_T_object)
    return SequenceRow("test-000000", frame, image, hit.astype(np.int32), (ball,))


@pytest.fixture
def pair() -> PairRow:
    return pair_of_frames(render(PREV, 20), render(CURR, 30))


def test_pair_of_frames_follows_equation_1(pair: PairRow) -> None:
    obj = pair.objects[0]
    assert (pair.key, obj.in_both) == ("test-000000/30", True)
    np.testing.assert_allclose(obj.center, CURR[:3, 3])
    np.testing.assert_allclose(obj.prev_T_curr(raw=True), PREV @ geometry.inverse(CURR), atol=1e-12)
    assert contradictions(pair) == []


def test_objects_visible_in_one_frame_are_listed_and_invisible_ones_are_not() -> None:
    prev, curr = render(PREV, 20), render(CURR, 30)
    hidden = FrameObject(label=2, category="cube", model="c", symmetry=(), pose=np.eye(4))
    prev, curr = (dataclasses.replace(row, objects=(*row.objects, hidden)) for row in (prev, curr))
    assert [obj.label for obj in pair_of_frames(prev, curr).objects] == [1]
    labels = curr.labels.copy()
    labels[0, 0] = 2
    listed = pair_of_frames(prev, dataclasses.replace(curr, labels=labels)).objects
    assert [(obj.label, obj.in_both) for obj in listed] == [(1, True), (2, False)]


def test_exact_ground_truth_has_no_error(pair: PairRow) -> None:
    errors = warp_errors(pair, raw=True)
    assert len(errors.depth) > 0.3 * (pair.curr_labels == 1).sum()
    assert np.median(np.abs(errors.depth)) < 2e-4
    assert np.median(errors.color) < 1.5


def test_the_depth_error_measures_a_wrong_translation(pair: PairRow) -> None:
    obj = pair.objects[0]
    wrong = dataclasses.replace(obj, translation=obj.translation + np.array([0, 0, 0.005]))
    errors = warp_errors(dataclasses.replace(pair, objects=(wrong,)), raw=True)
    assert np.median(errors.depth) == pytest.approx(0.005, abs=5e-4)


def test_only_colour_reveals_the_wrong_rotation_of_a_ball(pair: PairRow) -> None:
    obj = pair.objects[0]
    wrong = dataclasses.replace(obj, raw_rotation_vector=np.array([0.0, 0.0, 0.0]))
    errors = warp_errors(dataclasses.replace(pair, objects=(wrong,)), raw=True)
    assert np.median(np.abs(errors.depth)) < 2e-4
    assert np.median(errors.color) > 5


def test_symmetry_removes_the_rotation_about_its_axis_and_keeps_the_depth() -> None:
    axis = np.array([0.0, 0.0, 1.0])
    turned = CURR @ geometry.make_transform(geometry.so3_exp(2.0 * axis), np.zeros(3))
    frames = [render(pose, number) for pose, number in ((turned, 20), (CURR, 30))]
    frames = [
        dataclasses.replace(
            row, objects=(dataclasses.replace(row.objects[0], symmetry=(SymmetryAxis((0.0, 0.0, 1.0), 0),)),)
        )
        for row in frames
    ]
    pair = pair_of_frames(*frames)
    assert np.linalg.norm(pair.objects[0].raw_rotation_vector) == pytest.approx(2.0)
    np.testing.assert_allclose(pair.objects[0].rotation_vector, 0, atol=1e-6)
    assert np.abs(warp_errors(pair, raw=False).depth).max() < 1e-6


def test_contradictions_are_named(pair: PairRow) -> None:
    obj = pair.objects[0]
    moved = dataclasses.replace(obj, center=obj.center + 0.001)
    assert "differs from that of its poses" in contradictions(dataclasses.replace(pair, objects=(moved,)))[0]
    unseen = dataclasses.replace(obj, in_both=False)
    assert "in_both=False of object 1 contradicts" in contradictions(dataclasses.replace(pair, objects=(unseen,)))[0]
    empty = contradictions(dataclasses.replace(pair, objects=()))
    assert "curr_labels contain [1], the object table does not" in empty[1]


def test_the_report_counts_pixels_objects_and_motions(pair: PairRow) -> None:
    report = CheckReport("test", 1, "", {})
    add_pair(report, pair)
    numbers = report.to_dict()
    distance = 100 * float(np.linalg.norm(PREV[:3, 3] - CURR[:3, 3]))
    assert numbers["displacement_cm"]["mean"] == pytest.approx(distance)
    angle = float(np.degrees(geometry.rotation_angle(PREV[:3, :3] @ CURR[:3, :3].T)))
    assert numbers["raw_rotation_deg"]["mean"] == pytest.approx(angle)
    assert numbers["visible"]["mean"] == (pair.curr_labels == 1).sum()
    assert numbers["objects"]["mean"] == 1
    assert numbers["symmetric_share"] == 0
    assert numbers["wrong"] == []
    assert [entry["model"] for entry in numbers["worst"]] == ["ball-0"]


def test_histogram_against_numpy() -> None:
    values = np.random.default_rng(0).exponential(3.0, 1000)
    histogram = Histogram(0.01, 10_000)
    for chunk in np.split(values, 10):
        histogram.add(chunk)
    assert histogram.mean == pytest.approx(values.mean())
    for share in (0.05, 0.5, 0.95):
        assert histogram.quantile(share) == pytest.approx(float(np.quantile(values, share)), abs=0.03)
    grouped = [int(part.sum()) for part in np.split(histogram.counts, [100, 500])]
    assert grouped == np.histogram(values, [0, 1, 5, 1e9])[0].tolist()
    assert np.isnan(Histogram(1, 3).quantile(0.5))


def write_sequence(folder: Path, frames: list[SequenceRow]) -> None:
    path = folder / manifests.shard_name("test-sequences", 0, 1)
    write_shard(path, [row.to_dict() for row in frames], "sequences", {})
    shard = Shard(path.name, len(frames), path.stat().st_size, files.hash_file(path))
    part = Part("sequences", "test", len(frames), 1, 1, {"sinks": 2}, (shard,))
    Manifest(0, {}, {"test-sequences": part}, "0").write(folder)


def test_check_reads_a_set_and_pairs_up_sequences(tmp_path: Path) -> None:
    write_sequence(tmp_path, [render(PREV, 20), render(CURR, 30), render(PREV, 40)])
    calls: list[tuple[str, int, int]] = []
    (report,) = check(tmp_path, report=lambda *call: calls.append(call))
    assert calls == [("test-sequences", 1, 2), ("test-sequences", 2, 2)]
    assert report.rejected == {"sinks": 2}
    assert report.depth_mm.quantile(0.5) < 0.3
    assert report.displacement_cm.count == 2
    (limited,) = check(tmp_path, limit=1)
    assert limited.displacement_cm.count == 1


def test_check_refuses_a_changed_shard(tmp_path: Path) -> None:
    write_sequence(tmp_path, [render(PREV, 20), render(CURR, 30)])
    path = next(tmp_path.glob("*.parquet"))
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="its hash differs from that in"):
        check(tmp_path)


def test_pictures_show_centres_labels_and_depth(pair: PairRow) -> None:
    picture = draw_pair(pair)
    assert picture.dtype == np.uint8
    # Two lines of three panels, and flow.png below at the same width.
    assert picture.shape[1] == 3 * (320 + 4)
    assert picture.shape[0] > 2 * (18 + 240 + 4) + 300
    u, v = geometry.project(pair.objects[0].center, CAMERA)
    column, row = round((u + 0.5) * 4 - 0.5) + 324, round((v + 0.5) * 4 - 0.5) + 18
    # The cross at the current centre, in the second panel.
    np.testing.assert_allclose(picture[row, column].astype(int), [255, 255, 0], atol=3)
    frames = draw_frames([render(PREV, 20), render(CURR, 30)])
    assert frames.shape == (2 * (18 + 240 + 4), 3 * (320 + 4), 3)


def test_moving_objects_are_counted_in_rows_with_a_camera_motion() -> None:
    report = CheckReport("test", 2, "", {})
    pair = pair_of_frames(make_frame("a", 20), make_frame("a", 80))
    assert "movers" not in report.to_dict()
    add_pair(report, dataclasses.replace(pair, camera_motion=np.eye(4)))
    still = pair_of_frames(make_frame("a", 20), dataclasses.replace(make_frame("a", 20), frame=80))
    add_pair(report, dataclasses.replace(still, camera_motion=np.eye(4)))
    numbers = report.to_dict()
    assert numbers["movers"] == {"mean": 0.5, "most": 1}
    assert numbers["motionless_share"] == 0.5
    assert numbers["moving_camera_share"] == 0
    # Only the moving object counts: 60 frames of 1 mm.
    assert report.displacement_cm.count == 1
    assert report.displacement_cm.mean == pytest.approx(6.0)
