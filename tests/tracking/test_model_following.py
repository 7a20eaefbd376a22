"""Known plates that the estimate of a pair lacks, or links to the wrong track: their models follow and find them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.plate_scenes import Place, PlateScene, iou, play_changed
from objectflow import SequenceEstimator
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.tracking import KnownSettings, SequenceStep, Tracker, TrackerSettings, known_step
from objectflow.tracking.follow_settings import FollowSettings
from objectflow.tracking.looks import Looks, LooksSettings

STILL: Place = (0.3, 0.2, 1.2)
STEP = 0.03
"""Metres per frame."""


def pushed(count: int) -> list[dict[int, Place]]:
    """Plate 1 slides by `STEP` from frame to frame, plate 2 never moves."""
    return [{1: (-0.25 + STEP * k, 0.0, 1.0), 2: STILL} for k in range(count)]


def play(
    places: list[dict[int, Place]], missed: set[int], tracker: Tracker | None = None
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep]]:
    """Feed frames of the plates at these places to a method that finds no object in the missed frames."""

    def change(number: int, found: SceneMotion) -> SceneMotion:
        return SceneMotion(np.zeros_like(found.labels), found.scene_flow) if number in missed else found

    return play_changed(places, change, tracker=tracker)


def test_steps_that_the_method_misses_are_followed_by_the_model() -> None:
    scene, sequence, steps = play([*pushed(8), pushed(8)[-1]], missed={4, 5, 7})
    assert [step.followed for step in steps] == [(), (), (), (1,), (1,), (), (1,), ()]
    (track,) = sequence.tracks
    assert track.times == list(range(8)) + ([8] if len(track.times) > 8 else [])
    shifts = np.array([pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object[:8]])
    np.testing.assert_allclose(shifts, STEP * np.arange(8), atol=0.003)
    for number in (4, 5, 7, 8):
        assert iou(steps[number - 1].known == 1, scene.labels[number] == 1) > 0.9


def test_an_object_at_rest_under_a_hand_and_one_that_was_taken_away_are_not_followed() -> None:
    rest = pushed(4)[-1]
    hand = {**rest, 9: (rest[1][0] + 0.05, 0.0, 0.6)}
    _, sequence, steps = play([*pushed(4), rest, hand, hand, rest, {2: STILL}, {2: STILL}], missed={5, 6, 7, 8, 9})
    assert all(not step.followed for step in steps)
    assert len(sequence.tracks) == 1


@pytest.mark.parametrize("moves", [True, False])
def test_a_motion_that_the_frame_refutes_is_given_to_a_new_track(moves: bool) -> None:
    """The method reports a motion of the plate's pixels, whether the plate moves or rests."""
    places = [*pushed(4), pushed(4)[-1], {**pushed(4)[-1]}]
    places[-1][1] = (places[-1][1][0] + (STEP if moves else 0.0), 0.0, 1.0)
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    sequence = SequenceEstimator(scene.estimator(5, 3, 0.9))
    for frame in frames:
        sequence.update(frame)
    last = sequence.tracks[0].world_T_object[-1][0, 3] - sequence.tracks[0].world_T_object[0][0, 3]
    assert last == pytest.approx(STEP * (4 if moves else 3), abs=0.004)
    assert len(sequence.tracks) == (1 if moves else 2)


def test_an_object_that_was_put_elsewhere_is_found_again_by_its_looks() -> None:
    """The plate disappears and lies 30 cm away, nearer to the camera, three frames later; the method finds nothing."""
    gone: dict[int, Place] = {2: STILL}
    there: dict[int, Place] = {1: (0.12, 0.1, 0.9), 2: STILL}
    places = [*pushed(5), pushed(5)[-1], gone, gone, gone, there, there]
    scene, sequence, steps = play(places, missed={5, 6, 7, 8, 9, 10})
    assert not any((step.known == 1).any() for step in steps[5:8])
    assert steps[8].followed == (1,)
    for number in (9, 10):
        assert iou(steps[number - 1].known == 1, scene.labels[number] == 1) > 0.85
    (track,) = sequence.tracks
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, np.subtract(there[1], places[0][1]), atol=0.01)


def test_a_twin_that_was_always_there_is_not_taken_for_an_object_that_was_taken_away() -> None:
    """Plate 4 has the texture of plate 1."""
    places = [{**here, 4: (0.2, -0.2, 1.1)} for here in pushed(5)]
    gone: dict[int, Place] = {2: STILL, 4: (0.2, -0.2, 1.1)}
    _, _, steps = play([*places, places[-1], gone, gone, gone], missed={5, 6, 7, 8})
    assert all(not step.followed for step in steps)
    assert not any(step.known.any() for step in steps[5:])


def test_an_object_that_moves_again_elsewhere_keeps_its_id() -> None:
    """The plate is carried 35 cm while it is hidden, and slides on there; the pair alone shows a new object."""
    gone: dict[int, Place] = {2: STILL}
    places = [
        *pushed(5),
        pushed(5)[-1],
        gone,
        gone,
        {1: (0.15, -0.1, 0.9), 2: STILL},
        {1: (0.18, -0.1, 0.9), 2: STILL},
    ]
    scene, sequence, steps = play(places, missed={6, 7, 8})
    assert set(steps[-1].tracks.values()) == {1}
    (track,) = sequence.tracks
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, np.subtract(places[-1][1], places[0][1]), atol=0.01)
    assert iou(steps[-1].known == 1, scene.labels[len(places) - 1] == 1) > 0.9


def test_the_track_of_an_object_that_is_seen_at_rest_does_not_end() -> None:
    rest = pushed(4)[-1]
    again = [{**rest, 1: (rest[1][0], STEP * k, 1.0)} for k in (1, 2)]
    tracker = Tracker(TrackerSettings(max_age=3))
    _, sequence, steps = play([*pushed(4), *[rest] * 8, *again], missed=set(), tracker=tracker)
    assert [set(step.tracks.values()) for step in steps[-2:]] == [{1}, {1}]
    assert len(sequence.tracks) == 1


@pytest.mark.parametrize("apart", [True, False])
def test_two_that_moved_as_one_and_come_apart_are_two_tracks_with_the_whole_trajectory(apart: bool) -> None:
    """Plates 1 and 3 touch and slide together as one object; then plate 1 slides on alone, or both do."""
    together = [{1: (-0.3 + STEP * k, 0.0, 1.0), 3: (-0.06 + STEP * k, 0.0, 1.0)} for k in range(5)]
    rest = together[-1]
    alone: list[dict[int, Place]] = [
        {1: (rest[1][0], -0.04 * k, 1.0), 3: (rest[3][0], 0.0 if apart else -0.04 * k, 1.0)} for k in (1, 2)
    ]
    places = [*together, rest, *alone, alone[-1]]
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        found = scene.motion(round(curr.timestamp or 0))
        if len(found.objects) == 2:  # one object of both
            labels = np.minimum(found.labels, 1).astype(np.int32)
            return SceneMotion(labels, found.scene_flow, (replace(found.objects[0], pixels=int(labels.sum())),))
        return found

    sequence = SequenceEstimator(estimate)
    steps = [step for frame in frames if (step := sequence.update(frame)) is not None]
    assert len(sequence.tracks) == (2 if apart else 1)
    last = steps[-1].known
    if not apart:
        assert iou(last == 1, scene.labels[8] > 0) > 0.9
        return
    moved, rested = sequence.tracks
    assert rested.times[:5] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(rested.world_T_object[:5], moved.world_T_object[:5])
    assert iou(last == moved.id, scene.labels[8] == 1) > 0.85
    assert iou(last == rested.id, scene.labels[8] == 3) > 0.85


def test_known_objects_in_one_mask_of_the_method_are_told_apart_by_their_models() -> None:
    """Plates 1 and 3 have moved one after the other; then both move, and the method reports them as one object."""
    left, right = [-0.3 + STEP * k for k in range(4)], [0.06 + STEP * k for k in range(4)]
    places = [{1: (x, 0.0, 1.0), 3: (right[0], 0.0, 1.0), 2: STILL} for x in left]
    places += [{1: (left[-1], 0.0, 1.0), 3: (x, 0.0, 1.0), 2: STILL} for x in right[1:]]
    places += [{1: (left[-1], STEP * k, 1.0), 3: (right[-1], STEP * k, 1.0), 2: STILL} for k in (1, 2)]
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        number = round(curr.timestamp or 0)
        found = scene.motion(number)
        if number < 7:
            return found
        both = found.objects[0]
        labels = np.where(np.isin(scene.labels[number], (1, 3)), both.id, 0).astype(np.int32)
        return SceneMotion(labels, found.scene_flow, (both,))

    sequence = SequenceEstimator(estimate)
    steps = [step for frame in frames if (step := sequence.update(frame)) is not None]
    assert [set(step.tracks.values()) | set(step.followed) for step in steps[-2:]] == [{1, 2}, {1, 2}]
    for number in (7, 8):
        for track, plate in ((1, 1), (2, 3)):
            assert iou(steps[number - 1].known == track, scene.labels[number] == plate) > 0.9
    for track in sequence.tracks:
        moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
        np.testing.assert_allclose(moved, [3 * STEP, 2 * STEP, 0], atol=0.005)


def test_the_pose_of_an_object_that_moved_unseen_is_corrected_when_it_moves_again() -> None:
    """A jump of 12 cm is missed, and the object is not searched by its looks; the next step starts elsewhere."""
    before, jump = pushed(4), 0.12
    end = before[-1][1][0] + jump
    places = [*before, *({1: (end + STEP * k, 0.0, 1.0), 2: STILL} for k in range(3))]
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        number = round(curr.timestamp or 0)
        found = scene.motion(number)
        return SceneMotion(np.zeros_like(found.labels), found.scene_flow) if number == 4 else found

    settings = KnownSettings(follow=FollowSettings(looks=LooksSettings(min_inliers=10_000), min_matches=10_000))
    sequence = SequenceEstimator(estimate, settings=settings)
    for frame in frames:
        sequence.update(frame)
    track = sequence.tracks[0]
    assert track.times[-3:] == [4, 5, 6]
    shifts = [pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object[-3:]]
    np.testing.assert_allclose(shifts, 3 * STEP + jump + STEP * np.arange(3), atol=0.01)


def test_a_fragment_does_not_take_the_id_of_the_whole() -> None:
    """One pair shows a strip of the plate alone, the next one this strip and the rest of the plate as two objects."""
    places = pushed(7)

    def change(number: int, found: SceneMotion) -> SceneMotion:
        columns = np.flatnonzero((found.labels == 1).any(axis=0))
        strip = (found.labels == 1) & (np.arange(160) < columns[0] + 8)
        if number == 4:
            return replace(found, labels=np.where(strip, 1, 0).astype(np.int32))
        if number == 5:
            # The strip's motion is another one, so that it is no piece of the plate.
            other = found.objects[0].prev_T_curr.copy()
            other[1, 3] += 0.012
            objects = found.objects[0], replace(found.objects[0], id=7, prev_T_curr=other)
            return replace(found, labels=np.where(strip, 7, found.labels).astype(np.int32), objects=objects)
        return found

    scene, _, steps = play_changed(places, change)
    assert steps[4].tracks[1] == 1
    assert iou(steps[3].known == 1, scene.labels[4] == 1) > 0.9


def test_an_object_without_features_is_found_where_the_frames_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plate jumps by 30 cm in a pair of which the method finds nothing."""
    monkeypatch.setattr(Looks, "find", lambda *args: None)
    monkeypatch.setattr(known_step, "matched_motion", lambda *args: None)
    rest = pushed(5)[-1]
    there = {**rest, 1: (rest[1][0] + 0.16, 0.28, rest[1][2])}
    scene, sequence, steps = play([*pushed(5), rest, there, there], missed={5, 6, 7})
    assert steps[5].followed == (1,)
    assert iou(steps[5].known == 1, scene.labels[6] == 1) > 0.85
    (track,) = sequence.tracks
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, np.subtract(there[1], pushed(5)[0][1]), atol=0.01)
