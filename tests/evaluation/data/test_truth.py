"""The truth of a generated row: flow, masks, and symmetry axes in the camera frame."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.cameras import small_camera
from objectflow import ObjectMotion, RgbdFrame, SceneMotion, geometry
from objectflow.dataset.schema import PairObject, PairRow
from objectflow.errors import DatasetError, ResultError
from objectflow.evaluation.data.truth import truth_of_row
from objectflow.evaluation.metrics.pair_score import score_pair
from objectflow.geometry.symmetry import SymmetryAxis


def box(label: int, *, shift: float, in_both: bool = True) -> PairObject:
    """An object that moves along x; its fourfold z axis points along the camera's y."""
    prev_pose, curr_pose = np.eye(4), np.eye(4)
    curr_pose[:3, :3] = prev_pose[:3, :3] = geometry.so3_exp([-np.pi / 2, 0, 0])
    curr_pose[:3, 3] = [0, 0, 1]
    prev_pose[:3, 3] = [shift, 0, 1]
    return PairObject(
        label=label,
        category="box",
        model="box-0",
        center=curr_pose[:3, 3],
        translation=np.array([shift, 0.0, 0.0]),
        rotation_vector=np.zeros(3),
        raw_rotation_vector=np.zeros(3),
        symmetry=(SymmetryAxis((0.0, 0.0, 1.0), 4),),
        prev_pose=prev_pose,
        curr_pose=curr_pose,
        in_both=in_both,
    )


def row(*objects: PairObject) -> PairRow:
    depth = np.ones((6, 8), np.float32)
    depth[0, 0] = 0
    frame = RgbdFrame(color=np.zeros((6, 8, 3), np.uint8), depth=depth, camera=small_camera(8, 6))
    labels = np.zeros((6, 8), np.int32)
    labels[:2, :2], labels[:2, 6:], labels[4:, :2] = 1, 2, 3
    return PairRow("k", "s", frame, labels, frame, labels, objects)


OBJECTS = (box(1, shift=0.1), box(2, shift=0.001), box(3, shift=0.2, in_both=False), box(4, shift=0.2))


def test_the_truth_of_a_row() -> None:
    truth = truth_of_row(row(*OBJECTS))
    assert (truth.key, truth.scene) == ("k", "s")
    # The fourth object has no pixel, the second one moves by 1 mm, which is below the limit, and the third one is not
    # visible in the previous frame.
    assert [obj.label for obj in truth.objects] == [1, 2, 3]
    assert truth.moving == {1, 3}
    assert np.array_equal(truth.masked, np.isin(truth.labels, [1, 2]))
    assert np.isnan(truth.scene_flow[0, 0]).all()
    assert truth.scene_flow[1, 1] == pytest.approx([0.1, 0, 0], abs=1e-6)
    assert truth.scene_flow[0, 7] == pytest.approx([0.001, 0, 0], abs=1e-6)
    assert truth.scene_flow[3, 3].tolist() == [0, 0, 0]
    # A rotation by -90 degrees about x takes z to y.
    assert np.allclose(truth.objects[0].axes, [[0, 1, 0]], atol=1e-12)
    assert truth.objects[0].orders == (4,)


def test_all_metrics_of_a_pair() -> None:
    truth = truth_of_row(row(*OBJECTS))
    # Objects 1 and 2 are found as 7 and 9; 7 has the true motion after a quarter turn about the fourfold axis.
    labels = np.where(truth.labels == 1, 7, np.where(truth.labels == 2, 9, 0)).astype(np.int32)
    quarter = np.eye(4)
    quarter[:3, :3] = geometry.so3_exp([0, np.pi / 2, 0])
    at = geometry.make_transform(np.eye(3), truth.objects[0].center)
    motions = (truth.objects[0].prev_T_curr @ at @ quarter @ geometry.inverse(at), np.eye(4))
    objects = tuple(ObjectMotion(i, 4, 1.0, True, np.zeros(3), T) for i, T in zip((7, 9), motions, strict=True))
    flow = np.where(np.isnan(truth.scene_flow), truth.scene_flow, 0).astype(np.float32)
    score = score_pair(SceneMotion(labels, flow, objects, seconds=0.5), truth)
    assert (score.key, score.scene, score.seconds) == ("k", "s", 0.5)
    # Of 47 pixels with depth, three of object 1 are off by 10 cm, four of 2 by 0.1 cm, and four of 3 by 20 cm.
    assert score.flow.masked.epe_cm == pytest.approx((3 * 10 + 4 * 0.1) / 7, rel=1e-5)
    assert score.flow.moving.epe_cm == pytest.approx(10, rel=1e-5)
    assert score.flow.all.epe_cm == pytest.approx((3 * 10 + 4 * 0.1 + 4 * 20) / 47, rel=1e-5)
    assert (score.flow.all.pixels, score.flow.masked.pixels, score.flow.moving.pixels) == (47, 7, 3)
    assert (score.segmentation.extracted, score.segmentation.true_objects) == (2, 3)
    assert [(e.label, e.moving) for e in score.objects] == [(1, True), (2, False)]
    assert [e.rotation_deg for e in score.objects] == pytest.approx([0, 0], abs=1e-5)
    assert [e.translation_cm for e in score.objects] == pytest.approx([0, 0.1], abs=1e-9)


def test_what_does_not_fit() -> None:
    with pytest.raises(DatasetError, match=r"labels \[2, 3\] belong to no object"):
        truth_of_row(row(box(1, shift=0.1)))
    truth = truth_of_row(row(*OBJECTS))
    with pytest.raises(ResultError, match="do not fit"):
        score_pair(SceneMotion(np.zeros((3, 3), np.int32), np.zeros((3, 3, 3), np.float32)), truth)
