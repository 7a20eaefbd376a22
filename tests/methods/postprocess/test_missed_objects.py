"""What the network did not see: movers beside the known ones, and pieces of these, by scenes whose truth is known."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

import analytic
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import COST_HIDDEN
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.consensus.assignment import HIDDEN_BY_KNOWN, Assignment
from objectflow.methods.consensus.estimator import ConsensusEstimator
from objectflow.methods.postprocess.missed_objects import recover_missed_objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

Objects = tuple[ObjectMotion, ...]


def scene(seed: int) -> analytic.AnalyticPair:
    return analytic.make_scene(seed, objects=(3, 5), depth_noise=0.0015, width=320, height=240)


def true_objects(pair: analytic.AnalyticPair) -> Objects:
    """In the order of their numbers."""
    found = []
    for k, motion in sorted(pair.prev_T_curr.items()):
        if count := int((pair.labels == k).sum()):
            moving = bool(np.linalg.norm(geometry.transform(motion, pair.centers[k]) - pair.centers[k]) > 0.01)
            found.append(ObjectMotion(k, count, 0.9, moving, pair.centers[k], motion))
    return tuple(found)


def overlap(a: BoolMask, b: BoolMask) -> float:
    """F-measure."""
    return float(2 * (a & b).sum() / max(1, a.sum() + b.sum()))


def look(pair: analytic.AnalyticPair, labels: LabelImage, objects: Objects) -> tuple[LabelImage, Objects]:
    return recover_missed_objects(
        FramePair(pair.prev, pair.curr), PairLikelihood(pair.prev, pair.curr, labels), labels, objects
    )


def clear_mover(pair: analytic.AnalyticPair, objects: Objects) -> ObjectMotion:
    """The largest of those that moved some centimetres."""
    return max((obj for obj in objects if np.linalg.norm(obj.translation) > 0.02), key=lambda obj: obj.pixels)


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_a_mover_without_a_label_is_found(seed: int) -> None:
    pair = scene(seed)
    objects = true_objects(pair)
    lost = clear_mover(pair, objects)
    labels = np.where(pair.labels == lost.id, np.int32(0), pair.labels)
    after, found = look(pair, labels, tuple(obj for obj in objects if obj.id != lost.id))
    assert max(overlap(after == obj.id, pair.labels == lost.id) for obj in found) > 0.85
    best = max(found, key=lambda obj: overlap(after == obj.id, pair.labels == lost.id))
    off = geometry.transform(best.prev_T_curr, lost.center) - geometry.transform(lost.prev_T_curr, lost.center)
    assert best.moving
    assert np.linalg.norm(off) < 0.01
    # The others keep their pixels, and numbers count from 1.
    for obj in objects:
        if obj.id != lost.id:
            assert max(overlap(after == one.id, pair.labels == obj.id) for one in found) > 0.97
    assert [obj.id for obj in found] == list(range(1, len(found) + 1))
    assert [obj.pixels for obj in found] == [int((after == obj.id).sum()) for obj in found]


@pytest.mark.parametrize("share", [0.05, 0.2])
@pytest.mark.parametrize("seed", [51, 53, 56])
def test_a_body_seen_in_part_becomes_whole_with_its_own_motion(seed: int, share: float) -> None:
    """The network saw a strip of it, and its motion too badly for the rest to follow."""
    pair = scene(seed)
    objects = true_objects(pair)
    body = clear_mover(pair, objects)
    mask = pair.labels == body.id
    rows = np.nonzero(mask)[0]
    first, last = np.quantile(rows, (0.5 - share / 2, 0.5 + share / 2))
    strip = mask & (np.arange(240)[:, None] >= first) & (np.arange(240)[:, None] <= last)
    labels = np.where(mask & ~strip, np.int32(0), pair.labels)
    off = geometry.se3_exp([0, 0, 0, 0.15, 0.1, -0.15])
    about = np.eye(4)
    about[:3, 3] = geometry.transform(body.prev_T_curr, body.center)
    badly = about @ off @ geometry.inverse(about) @ body.prev_T_curr
    seen = tuple(
        dataclasses.replace(obj, prev_T_curr=badly, pixels=int(strip.sum())) if obj is body else obj for obj in objects
    )
    after, found = look(pair, labels, seen)
    at = np.bincount(after[mask]).argmax()
    assert overlap(after == at, mask) > 0.85
    (whole,) = (obj for obj in found if obj.id == at)
    error = geometry.inverse(body.prev_T_curr) @ whole.prev_T_curr
    assert np.degrees(geometry.rotation_angle(error[:3, :3])) < 3


@pytest.mark.parametrize("seed", [51, 53, 56])
def test_the_lost_half_of_a_mover_comes_back_to_it(seed: int) -> None:
    pair = scene(seed)
    objects = true_objects(pair)
    whole = clear_mover(pair, objects)
    columns = np.nonzero((pair.labels == whole.id).any(axis=0))[0]
    half = (pair.labels == whole.id) & (np.arange(320)[None] > np.median(columns))
    after, found = look(pair, np.where(half, np.int32(0), pair.labels), objects)
    assert len(found) == len(objects)
    number = next(i for i, obj in enumerate(objects, 1) if obj.id == whole.id)
    before = overlap((pair.labels == whole.id) & ~half, pair.labels == whole.id)
    assert overlap(after == number, pair.labels == whole.id) > max(0.85, before)


def test_where_all_is_explained_nothing_is_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("there was nothing to look for")

    monkeypatch.setattr(ConsensusEstimator, "find", refuse)
    pair = scene(51)
    grown = cv2.dilate(pair.labels.astype(np.float32), np.ones((5, 5))).astype(np.int32)
    labels = np.where(pair.labels > 0, pair.labels, grown)
    objects = true_objects(pair)
    after, found = look(pair, labels, objects)
    np.testing.assert_array_equal(after, labels)
    assert found == objects


@pytest.mark.parametrize(("pixels", "faster", "stays"), [(900, 0.3, False), (900, 4.0, True), (300, 4.0, False)])
def test_small_neighbours_are_shadows(
    monkeypatch: pytest.MonkeyPatch, pixels: int, faster: float, stays: bool
) -> None:
    """A piece beside an object: of up to half its size if it goes along, else of up to a quarter."""
    pair = scene(51)
    objects = true_objects(pair)
    host = dataclasses.replace(clear_mover(pair, objects), pixels=2000)
    beside = (cv2.dilate((pair.labels == host.id).astype(np.uint8), np.ones((9, 9))) > 0) & (pair.labels == 0)
    motion = host.prev_T_curr.copy()
    motion[:3, 3] += faster * (geometry.transform(motion, host.center) - host.center)
    piece = ObjectMotion(1, pixels, 0.9, True, host.center, motion)

    def one_piece(*_: object, **__: object) -> SceneMotion:
        return SceneMotion(beside.astype(np.int32), np.zeros((240, 320, 3), np.float32), (piece,))

    def cost(_: PairLikelihood, prev_T_curr: Float64Array, mask: BoolMask) -> Float32Array:
        return np.full(mask.sum(), 0.0 if np.array_equal(prev_T_curr, motion) else 1.0, np.float32)

    monkeypatch.setattr(ConsensusEstimator, "find", one_piece)
    monkeypatch.setattr(PairLikelihood, "cost", cost)
    # Something unexplained has to be there for anyone to look.
    labels = np.where(pair.labels == host.id, pair.labels, np.int32(0))
    after, found = look(pair, labels, (host,))
    assert len(found) == 1 + stays
    assert (after[beside] > 0).any() == stays


def test_consensus_leaves_alone_what_is_known() -> None:
    pair = scene(53)
    known = pair.labels == clear_mover(pair, true_objects(pair)).id
    free, bound = (
        ConsensusEstimator(camera="static")(pair.prev, pair.curr),
        ConsensusEstimator(camera="static").find(FramePair(pair.prev, pair.curr), known=known),
    )
    assert max(overlap(free.labels == obj.id, known) for obj in free.objects) > 0.8
    assert not bound.labels[known].any()
    assert all(overlap(bound.labels == obj.id, known) < 0.1 for obj in bound.objects)
    assert (
        not ConsensusEstimator(camera="static")
        .find(FramePair(pair.prev, pair.curr), known=np.ones_like(known))
        .objects
    )


def test_what_a_known_mover_hid_may_be_background() -> None:
    """A dull wall behind a box that went 0.2 m to the right: where the box was, the wall had been hidden."""
    camera = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
    frames = []
    for column in (30, 70):
        depth = np.full((120, 160), 1.0, np.float32)
        depth[50:70, column : column + 20] = 0.6
        frames.append(RgbdFrame(np.full((120, 160, 3), 120, np.uint8), depth, camera))
    box = frames[1].depth < 0.8
    motion = geometry.make_transform(np.eye(3), [-40 / 120 * 0.6, 0, 0])
    stage = Assignment(*frames, None, min_pixels=12)
    stage.leave_out(box, [(motion, box)])
    stage.assign([], [], [], fine=False)
    assert stage.background_cost[60, 40] == COST_HIDDEN
    assert stage.rival_cost[60, 40] == pytest.approx(HIDDEN_BY_KNOWN)
    assert not stage.rival_cost[box].any()
    assert stage.rival_cost[60, 120] == stage.background_cost[60, 120] == 0
