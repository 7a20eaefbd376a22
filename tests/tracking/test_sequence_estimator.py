"""Known objects on plates before a wall, with true motions: masks at rest, half hidden, hidden and found again."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from helpers.plate_scenes import CAMERA, Place, PlateScene, iou, play
from objectflow import SequenceEstimator, geometry
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion

STILL: Place = (0.3, 0.2, 1.2)
PUSH: list[dict[int, Place]] = [{1: (-0.25 + 0.03 * k, 0.0, 1.0), 2: STILL} for k in range(5)]


def test_an_object_stays_known_at_rest_and_what_never_moved_is_not_known() -> None:
    scene, _, steps = play([*PUSH, *[PUSH[-1]] * 6])
    for number, step in enumerate(steps, start=1):
        assert set(np.unique(step.known)) == {0, 1}
        assert iou(step.known == 1, scene.labels[number] == 1) > (0.99 if number < 5 else 0.9)
    assert [len(step.tracks) for step in steps] == [1] * 4 + [0] * 6


def test_masks_at_rest_hold_under_the_noise_of_the_sequences_own_camera() -> None:
    """The noise is that of a stereo camera; the formula of structured light gives 2 mm at this depth."""
    scene, sequence, steps = play([*PUSH, *[PUSH[-1]] * 6], noise=0.012)
    assert sequence.noise.noise.sigma(1.0) == pytest.approx(0.012, rel=0.2)
    for number in range(6, 11):
        assert iou(steps[number - 1].known == 1, scene.labels[number] == 1) > 0.9


def test_a_half_hidden_object_is_known_where_it_is_seen_and_a_hidden_one_is_found_again() -> None:
    rest = PUSH[-1]
    cover = [{**rest, 9: (x, 0.0, 0.6)} for x in (-0.18, -0.08)]
    scene, sequence, steps = play([*PUSH, rest, *cover, rest])
    x = rest[1][0]
    assert x == pytest.approx(-0.13)
    half, full = cover
    for number, here in ((6, half), (7, full)):
        known = steps[number - 1].known == 1
        visible = scene.labels[number] == 1
        assert here in (half, full)
        assert not (known & (scene.labels[number] == 9)).any()
        assert known.sum() <= visible.sum()
        if visible.sum() > 100:
            assert iou(known, visible) > 0.8
    assert (scene.labels[7] == 1).sum() < 10
    assert sequence.known_objects.objects[1].present > 0.9
    assert iou(steps[-1].known == 1, scene.labels[8] == 1) > 0.9


def test_an_object_that_is_taken_away_is_not_reported_at_its_last_place() -> None:
    _, sequence, steps = play([*PUSH, PUSH[-1], {2: STILL}, {2: STILL}])
    assert (steps[-3].known == 1).sum() > 1000
    assert not steps[-1].known.any()
    assert sequence.known_objects.objects[1].present < 0.1


def test_registration_to_the_model_bounds_the_drift_of_chained_motions() -> None:
    places: list[dict[int, Place]] = [{1: (-0.2 + 0.02 * k, 0.0, 1.0)} for k in range(16)]
    # Every estimated motion is 2 mm off along the ray: chained motions would be 30 mm off at the end.
    _, sequence, _ = play([*places, places[-1]], error=(0, 0, 0.002))
    (track,) = sequence.tracks
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, [0.3, 0, 0], atol=0.004)


def test_a_pickled_state_continues_with_the_same_results() -> None:
    places = [*PUSH, PUSH[-1], *({1: (-0.13, 0.02 * k, 1.0), 2: STILL} for k in range(1, 4))]
    scene, whole, steps = play(places)
    frames = [scene.frame(number, here) for number, here in enumerate(places)]
    first = SequenceEstimator(whole.estimator)
    for frame in frames[:6]:
        first.update(frame)
    second = SequenceEstimator(whole.estimator)
    second.restore(pickle.loads(pickle.dumps(first.state())))
    for frame, expected in zip(frames[6:], steps[5:], strict=True):
        step = second.update(frame)
        assert step is not None
        assert step.tracks == expected.tracks
        np.testing.assert_array_equal(step.known, expected.known)
    for a, b in zip(whole.tracks, second.tracks, strict=True):
        np.testing.assert_array_equal(a.world_T_object, b.world_T_object)


def test_models_are_bounded_and_a_cut_starts_a_new_world() -> None:
    places: list[dict[int, Place]] = [{1: (0.1 * np.sin(k / 5), 0.0, 1.0)} for k in range(25)]
    scene, sequence, _ = play(places)
    sizes = [len(known.model) for known in sequence.known_objects.objects.values()]
    assert sizes
    # 24 cm in voxels of two pixels are 18 x 18; noise of the pose spreads them over a few layers.
    assert max(sizes) < 6 * 18 * 18
    sequence.cut()
    assert sequence.update(scene.frame(0, places[0])) is None
    step = sequence.update(scene.frame(1, places[1]))
    assert step is not None
    assert set(step.tracks.values()) == {2}


def test_a_moving_camera_sees_the_object_at_rest_where_it_is() -> None:
    """The camera moves by 1 cm a frame to the right; the plate rests in the world after two pushes."""
    scene = PlateScene()
    places = [{1: (-0.1 + 0.03 * min(k, 2) - 0.01 * k, 0.0, 1.0)} for k in range(8)]
    frames = [scene.frame(number, here) for number, here in enumerate(places)]
    step_of_camera = np.eye(4)
    step_of_camera[0, 3] = 0.01

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        number = round(curr.timestamp or 0)
        found = scene.motion(number)
        if number > 2:
            return SceneMotion(np.zeros((120, 160), np.int32), found.scene_flow, (), step_of_camera)
        return SceneMotion(found.labels, found.scene_flow, found.objects, step_of_camera)

    sequence = SequenceEstimator(estimate)
    for number, frame in enumerate(frames):
        step = sequence.update(frame)
        if step is not None:
            assert iou(step.known == 1, scene.labels[number] == 1) > 0.9
    pose = sequence.tracks[0].world_T_object[-1]
    assert geometry.rotation_angle(pose[:3, :3]) < 0.01


def test_times_must_rise() -> None:
    scene, sequence, _ = play(PUSH)
    with pytest.raises(FrameError, match="in order of time"):
        sequence.update(scene.frame(4, PUSH[4]))


@pytest.mark.parametrize("moves", [True, False])
def test_a_step_of_low_score_is_followed_where_the_model_confirms_it(moves: bool) -> None:
    """In the last pair the method reports the plate's usual motion with a low score; the plate moves, or rests."""
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate([*PUSH[:4], PUSH[4 if moves else 3]])]

    sequence = SequenceEstimator(scene.estimator(4, 3, 0.1))
    for frame in frames:
        sequence.update(frame)
    (track,) = sequence.tracks
    assert track.gaps == ([] if moves else [4])
    moved = track.world_T_object[-1][0, 3] - track.world_T_object[0][0, 3]
    assert moved == pytest.approx(0.12 if moves else 0.09, abs=0.004)
    assert track.confidence == pytest.approx((3 * 0.9 + (0.1 if moves else 0)) / 4)


def other_scene(number: int) -> RgbdFrame:
    """A slope of another colour at 0.6 to 1.2 m."""
    depth = np.tile(np.linspace(0.6, 1.2, 160, dtype=np.float32), (120, 1))
    return RgbdFrame(np.full((120, 160, 3), (40, 160, 60), np.uint8), depth, CAMERA, timestamp=float(number))


def test_a_cut_to_another_scene_starts_a_new_world_and_is_noted() -> None:
    """The method reports a moving object at the cut, as one for a static camera does."""
    scene = PlateScene()
    frames = [*(scene.frame(number, here) for number, here in enumerate(PUSH)), other_scene(5), other_scene(6)]
    scene.labels[5], scene.places[5] = scene.labels[4], {**PUSH[4], 1: (0.0, 0.0, 1.0)}
    still = SceneMotion(np.zeros((120, 160), np.int32), np.zeros((120, 160, 3), np.float32))
    sequence = SequenceEstimator(lambda prev, curr: scene.motion(int(curr.timestamp)) if curr.timestamp < 6 else still)
    steps = [step for frame in frames if (step := sequence.update(frame)) is not None]
    assert [step.motion.camera_known for step in steps] == [True] * 4 + [False, True]
    assert "cut" in steps[4].motion.notes[0]
    assert steps[4].tracks == {}
    assert not steps[4].known.any()
    assert not sequence.known_objects.objects
    assert sequence.tracker.camera_times == [5, 6]


def test_neither_a_change_of_light_nor_a_hand_before_the_lens_is_a_cut() -> None:
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(PUSH)]
    darker = [RgbdFrame(f.color // 2 if k > 2 else f.color, f.depth, CAMERA, float(k)) for k, f in enumerate(frames)]
    hand = frames[4].depth.copy()
    hand[:, :110] = 0.3
    sequence = SequenceEstimator(lambda prev, curr: scene.motion(min(4, int(curr.timestamp))))
    for frame in (*darker, RgbdFrame(darker[4].color, hand, CAMERA, 5.0)):
        step = sequence.update(frame)
        assert step is None or step.motion.camera_known
