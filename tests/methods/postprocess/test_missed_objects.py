"""Recovery of objects that the network missed, and of missed parts of known objects, on scenes with known motions."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import analytic
from helpers.truths import true_objects
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.consensus.assignment import Assignment, AssignmentSettings
from objectflow.methods.consensus.estimator import ConsensusEstimator
from objectflow.methods.consensus.pixel_graph import PixelGraphSettings
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.missed_objects import recover_missed_objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import MissedObjectSettings, PostprocessSettings
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

DEFAULTS = PostprocessSettings()


def scene_of(seed: int) -> analytic.AnalyticPair:
    return analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, width=320, height=240)


def overlap(a: BoolMask, b: BoolMask) -> float:
    """F-measure."""
    return float(2 * (a & b).sum() / max(1, a.sum() + b.sum()))


def recover(
    scene: analytic.AnalyticPair, labels: LabelImage, objects: Objects, settings: PostprocessSettings = DEFAULTS
) -> tuple[LabelImage, Objects]:
    return recover_missed_objects(FramePair(scene.prev, scene.curr), labels, objects, settings)


def largest_mover(objects: Objects) -> ObjectMotion:
    """The largest of the objects that moved by more than 2 cm."""
    return max((obj for obj in objects if np.linalg.norm(obj.translation) > 0.02), key=lambda obj: obj.pixels)


@pytest.mark.parametrize("seed", [53, 56])
def test_a_moving_object_is_found_where_depth_has_scattered_holes(seed: int) -> None:
    scene = scene_of(seed)
    objects = true_objects(scene, score=0.9)
    lost = largest_mover(objects)
    rng = np.random.default_rng(0)
    prev, curr = (
        dataclasses.replace(frame, depth=np.where(rng.random(frame.depth.shape) < 0.25, np.float32(0), frame.depth))
        for frame in (scene.prev, scene.curr)
    )
    labels = np.where(scene.labels == lost.id, np.int32(0), scene.labels)
    others = tuple(obj for obj in objects if obj.id != lost.id)
    after, found = recover_missed_objects(FramePair(prev, curr), labels, others, DEFAULTS)
    assert len(found) == len(others) + 1
    true = (scene.labels == lost.id) & curr.valid
    assert max(float((after == obj.id)[true].mean()) for obj in found) > 0.7


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_a_moving_object_without_a_label_is_found(seed: int) -> None:
    scene = scene_of(seed)
    objects = true_objects(scene, score=0.9)
    lost = largest_mover(objects)
    labels = np.where(scene.labels == lost.id, np.int32(0), scene.labels)
    after, found = recover(scene, labels, tuple(obj for obj in objects if obj.id != lost.id))
    assert max(overlap(after == obj.id, scene.labels == lost.id) for obj in found) > 0.85
    best = max(found, key=lambda obj: overlap(after == obj.id, scene.labels == lost.id))
    off = geometry.transform(best.prev_T_curr, lost.center) - geometry.transform(lost.prev_T_curr, lost.center)
    assert best.moving
    assert np.linalg.norm(off) < 0.01
    # The other objects keep their pixels, and ids start at 1.
    for obj in objects:
        if obj.id != lost.id:
            assert max(overlap(after == one.id, scene.labels == obj.id) for one in found) > 0.97
    assert [obj.id for obj in found] == list(range(1, len(found) + 1))
    assert [obj.pixels for obj in found] == [int((after == obj.id).sum()) for obj in found]


def test_large_minimum_sizes_and_scores_leave_it_out() -> None:
    scene = scene_of(51)
    objects = true_objects(scene, score=0.9)
    lost = largest_mover(objects)
    labels = np.where(scene.labels == lost.id, np.int32(0), scene.labels)
    left = tuple(obj for obj in objects if obj.id != lost.id)
    for missed in (MissedObjectSettings(min_object_share=0.9), MissedObjectSettings(min_score=1.0)):
        after, found = recover(scene, labels, left, dataclasses.replace(DEFAULTS, missed_objects=missed))
        assert len(found) == len(left)
        np.testing.assert_array_equal(after > 0, labels > 0)


@pytest.mark.parametrize("share", [0.05, 0.2])
@pytest.mark.parametrize("seed", [51, 53, 56])
def test_a_partly_labelled_body_is_completed_with_its_own_motion(seed: int, share: float) -> None:
    """The network labels a strip of it, with a motion too wrong to explain the rest."""
    scene = scene_of(seed)
    objects = true_objects(scene, score=0.9)
    body = largest_mover(objects)
    mask = scene.labels == body.id
    rows = np.nonzero(mask)[0]
    first, last = np.quantile(rows, (0.5 - share / 2, 0.5 + share / 2))
    strip = mask & (np.arange(240)[:, None] >= first) & (np.arange(240)[:, None] <= last)
    labels = np.where(mask & ~strip, np.int32(0), scene.labels)
    off = geometry.se3_exp([0, 0, 0, 0.15, 0.1, -0.15])
    about = np.eye(4)
    about[:3, 3] = geometry.transform(body.prev_T_curr, body.center)
    wrong = about @ off @ geometry.inverse(about) @ body.prev_T_curr
    known = tuple(
        dataclasses.replace(obj, prev_T_curr=wrong, pixels=int(strip.sum())) if obj is body else obj for obj in objects
    )
    after, found = recover(scene, labels, known)
    number = np.bincount(after[mask]).argmax()
    assert overlap(after == number, mask) > 0.85
    (whole,) = (obj for obj in found if obj.id == number)
    error = geometry.inverse(body.prev_T_curr) @ whole.prev_T_curr
    assert np.degrees(geometry.rotation_angle(error[:3, :3])) < 3


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_the_missing_half_of_a_moving_object_is_attached_to_it(seed: int) -> None:
    scene = scene_of(seed)
    objects = true_objects(scene, score=0.9)
    whole = largest_mover(objects)
    columns = np.nonzero((scene.labels == whole.id).any(axis=0))[0]
    half = (scene.labels == whole.id) & (np.arange(320)[None] > np.median(columns))
    after, found = recover(scene, np.where(half, np.int32(0), scene.labels), objects)
    assert len(found) == len(objects)
    number = next(i for i, obj in enumerate(objects, 1) if obj.id == whole.id)
    before = overlap((scene.labels == whole.id) & ~half, scene.labels == whole.id)
    assert overlap(after == number, scene.labels == whole.id) > max(0.85, before)


def test_there_is_no_search_where_everything_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("there was nothing to search for")

    monkeypatch.setattr(ConsensusEstimator, "find", refuse)
    scene = scene_of(51)
    grown = cv2.dilate(scene.labels.astype(np.float32), np.ones((5, 5))).astype(np.int32)
    labels = np.where(scene.labels > 0, scene.labels, grown)
    objects = true_objects(scene, score=0.9)
    after, found = recover(scene, labels, objects)
    np.testing.assert_array_equal(after, labels)
    assert found == objects
    # The threshold of change is a setting: at 0 everything counts as changed.
    missed = MissedObjectSettings(changed_cost=0.0)
    with pytest.raises(AssertionError, match="nothing to search for"):
        recover(scene, labels, objects, dataclasses.replace(DEFAULTS, missed_objects=missed))


@pytest.mark.parametrize(
    ("pixels", "speed", "missed", "kept"),
    [
        (900, 0.3, MissedObjectSettings(), False),  # the same motion, less than half of the size
        (900, 4.0, MissedObjectSettings(), True),  # another motion, more than a quarter
        (300, 4.0, MissedObjectSettings(), False),  # another motion, less than a quarter
        (900, 0.3, MissedObjectSettings(min_area_ratio_same_motion=0.4), True),
        (900, 0.3, MissedObjectSettings(same_motion_ratio=0.0), True),
        (300, 4.0, MissedObjectSettings(min_area_ratio=0.1), True),
    ],
)
def test_small_pieces_beside_an_object_are_dropped(
    monkeypatch: pytest.MonkeyPatch, pixels: int, speed: float, missed: MissedObjectSettings, kept: bool
) -> None:
    """A piece beside an object of 2000 pixels, whose displacement is 1 + `speed` times that of the object."""
    scene = scene_of(51)
    objects = true_objects(scene, score=0.9)
    host = dataclasses.replace(largest_mover(objects), pixels=2000)
    beside = (cv2.dilate((scene.labels == host.id).astype(np.uint8), np.ones((9, 9))) > 0) & (scene.labels == 0)
    motion = host.prev_T_curr.copy()
    motion[:3, 3] += speed * (geometry.transform(motion, host.center) - host.center)
    piece = ObjectMotion(1, pixels, 0.9, True, host.center, motion)

    def one_piece(*_: object, **__: object) -> SceneMotion:
        return SceneMotion(beside.astype(np.int32), np.zeros((240, 320, 3), np.float32), (piece,))

    def cost(_: PairLikelihood, prev_T_curr: Float64Array, mask: BoolMask) -> Float32Array:
        return np.full(mask.sum(), 0.0 if np.array_equal(prev_T_curr, motion) else 1.0, np.float32)

    monkeypatch.setattr(ConsensusEstimator, "find", one_piece)
    monkeypatch.setattr(PairLikelihood, "cost", cost)
    # The search starts only where something is unexplained: the other objects, which have no label here.
    labels = np.where(scene.labels == host.id, scene.labels, np.int32(0))
    after, found = recover(scene, labels, (host,), dataclasses.replace(DEFAULTS, missed_objects=missed))
    assert len(found) == 1 + kept
    assert (after[beside] > 0).any() == kept


def test_consensus_does_not_search_known_pixels() -> None:
    scene = scene_of(53)
    known = scene.labels == largest_mover(true_objects(scene, score=0.9)).id
    estimator, pair = ConsensusEstimator(camera="static"), FramePair(scene.prev, scene.curr)
    free, bound = estimator(scene.prev, scene.curr), estimator.find(pair, known=known)
    assert max(overlap(free.labels == obj.id, known) for obj in free.objects) > 0.8
    assert not bound.labels[known].any()
    assert all(overlap(bound.labels == obj.id, known) < 0.1 for obj in bound.objects)
    assert not estimator.find(pair, known=np.ones_like(known)).objects


def test_background_that_a_known_object_hid_costs_less() -> None:
    """A wall without texture behind a box that moved 0.2 m to the right: the wall was hidden where the box was."""
    camera = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
    frames = []
    for column in (30, 70):
        depth = np.full((120, 160), 1.0, np.float32)
        depth[50:70, column : column + 20] = 0.6
        frames.append(RgbdFrame(np.full((120, 160, 3), 120, np.uint8), depth, camera))
    box = frames[1].depth < 0.8
    motion = geometry.make_transform(np.eye(3), [-40 / 120 * 0.6, 0, 0])
    likelihood, settings = LikelihoodSettings(), AssignmentSettings()
    assignment = Assignment(
        FramePair(*frames),
        None,
        min_pixels=12,
        likelihood=likelihood,
        graph=PixelGraphSettings(),
        settings=settings,
    )
    assignment.exclude(box, [(motion, box)])
    assignment.assign([], [], [], fine=False)
    assert assignment.background_cost[60, 40] == likelihood.hidden
    assert assignment.rival_cost[60, 40] == pytest.approx(settings.hidden_by_known)
    assert not assignment.rival_cost[box].any()
    assert assignment.rival_cost[60, 120] == assignment.background_cost[60, 120] == 0


def test_labels_near_the_motions_are_those_of_the_whole_image() -> None:
    scene = analytic.make_scene(3, objects=(2, 2))
    numbers = [number for number in sorted(scene.moving) if (scene.labels == number).sum() > 100]
    motions, masks = [scene.prev_T_curr[number] for number in numbers], [scene.labels == k for k in numbers]
    found = []
    for limited in (False, True):
        assignment = Assignment(
            FramePair(scene.prev, scene.curr),
            None,
            min_pixels=20,
            likelihood=LikelihoodSettings(),
            graph=PixelGraphSettings(),
            settings=AssignmentSettings(),
        )
        anchors = [assignment.anchors(mask, motion) for mask, motion in zip(masks, motions, strict=True)]
        if limited:
            assignment.limit([assignment.around(points) for points in anchors])
            assert np.prod(assignment.graph.shape) < 0.9 * scene.labels.size
        found.append(assignment.assign(motions, anchors, masks, fine=True))
    assert set(np.unique(found[0])) == {0, *range(1, len(numbers) + 1)}
    np.testing.assert_array_equal(found[1], found[0])
