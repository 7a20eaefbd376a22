"""Pairs that known plates explain are not estimated; every other pair is."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.plate_scenes import Place, PlateScene, iou
from objectflow import SequenceEstimator
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.tracking import SequenceStep
from objectflow.tracking.explained_step import METHOD

STILL: Place = (0.3, 0.2, 1.2)
STEP = 0.03
"""Metres per frame."""


def pushed(count: int) -> list[dict[int, Place]]:
    """Plate 1 slides by `STEP` from frame to frame, plate 2 never moves."""
    return [{1: (-0.25 + STEP * k, 0.0, 1.0), 2: STILL} for k in range(count)]


def play(
    places: list[dict[int, Place]], times: list[float] | None = None
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep], list[int]]:
    """Feed frames of the plates at these places; returns the numbers of the frames that were estimated as well."""
    scene, estimated = PlateScene(), list[int]()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        estimated.append(round(curr.timestamp or 0))
        return scene.motion(estimated[-1])

    sequence = SequenceEstimator(estimate, skip_explained=True)
    at = times or [float(number) for number in range(len(frames))]
    steps = [
        step for frame, time in zip(frames, at, strict=True) if (step := sequence.update(frame, time)) is not None
    ]
    return scene, sequence, steps, estimated


def test_a_known_object_is_followed_without_estimates() -> None:
    scene, sequence, steps, estimated = play([*pushed(9), *[pushed(9)[-1]] * 3])
    assert estimated == [1]
    assert [step.estimated for step in steps] == [True] + [False] * 10
    for number, step in enumerate(steps[1:], start=2):
        assert step.motion.method == METHOD
        assert iou(step.known == 1, scene.labels[number] == 1) > 0.9
        if number < 9:
            assert step.tracks == {1: 1}
            (obj,) = step.motion.moving
            np.testing.assert_allclose(obj.prev_T_curr[:3, 3], [-STEP, 0, 0], atol=0.002)
            np.testing.assert_allclose(obj.displacement, STEP, atol=0.002)
            flow = step.motion.scene_flow[step.motion.labels == 1]
            np.testing.assert_allclose(flow, np.broadcast_to([-STEP, 0, 0], flow.shape), atol=0.002)
            assert not step.motion.scene_flow[step.motion.labels == 0].any()
        else:
            assert step.tracks == {}
            assert step.motion.objects == ()
    (track,) = sequence.tracks
    shifts = np.array([pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object])
    np.testing.assert_allclose(shifts[:9], STEP * np.arange(9), atol=0.003)


def test_a_step_of_another_length_is_predicted_by_the_times() -> None:
    """Some frames are two steps and twice the time after the last one."""
    numbers = [0, 1, 2, 4, 5, 7]
    places = [pushed(8)[number] for number in numbers]
    *_, steps, estimated = play(places, [float(number) for number in numbers])
    assert estimated == [1]
    found = [step.motion.objects[0].displacement for step in steps]
    np.testing.assert_allclose(found, STEP * np.diff(numbers), atol=0.002)


def test_a_new_object_is_estimated() -> None:
    """Plate 3 starts to move in frame 4 and rests from frame 6 on, plate 1 moves all the time."""
    places = [{**here, 3: (0.1 + STEP * min(max(k - 3, 0), 2), -0.25, 1.1)} for k, here in enumerate(pushed(8))]
    scene, _, steps, estimated = play(places)
    assert estimated[:2] == [1, 4]
    assert set(np.unique(steps[3].known)) == {0, 1, 2}
    assert iou(steps[-1].known == 2, scene.labels[7] == 3) > 0.9


def test_an_object_that_leaves_and_a_hand_over_one_are_estimated() -> None:
    rest = pushed(4)[-1]
    hand = {**rest, 9: (rest[1][0] + 0.05, 0.0, 0.6)}
    *_, estimated = play([*pushed(4), rest, hand, rest, {2: STILL}])
    # What the hand uncovers when it leaves may have been there.
    assert sorted(set(estimated)) == [1, 5, 7]


def test_every_pair_of_a_moving_camera_is_estimated() -> None:
    places: list[dict[int, Place]] = [
        {1: (-0.1 - 0.03 * k, 0.0, 1.0), 2: (0.1 - 0.03 * k, 0.1, 1.0)} for k in range(4)
    ]
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]
    # The wall shows edges that shift with the camera.
    stripes = np.repeat(np.tile(np.array([60, 180], np.uint8), 60), 8)
    for number, frame in enumerate(frames):
        wall = scene.labels[number] == 0
        frame.color[wall] = np.broadcast_to(stripes[3 * number :][:160, None], (120, 160, 3))[wall]
    asked = []

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        asked.append(curr.timestamp)
        return SceneMotion(np.zeros((120, 160), np.int32), np.zeros((120, 160, 3), np.float32))

    sequence = SequenceEstimator(estimate, skip_explained=True)
    for frame in frames:
        sequence.update(frame)
    assert set(asked) >= {1.0, 2.0, 3.0}


def test_every_pair_is_estimated_where_the_user_says_that_the_camera_moves() -> None:
    """A slow motion of the camera may not be seen in one pair, but adds up."""
    scene = PlateScene()
    frames = [scene.frame(number, pushed(1)[0]) for number in range(4)]

    class Moving:
        camera = "moving"
        estimated = 0

        def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
            self.estimated += 1
            return scene.motion(1)

    estimator = Moving()
    sequence = SequenceEstimator(estimator, skip_explained=True)
    for frame in frames:
        sequence.update(frame)
    assert estimator.estimated == 3


def test_explain_adds_nothing_where_an_estimate_is_needed() -> None:
    scene, sequence, steps, _ = play(pushed(4))
    count = len(sequence.tracks[0].times)
    appeared = {**pushed(5)[-1], 3: (0.1, -0.25, 1.1)}
    assert sequence.explain(scene.frame(4, appeared), 4.0) is None
    assert len(sequence.tracks[0].times) == count
    step = sequence.explain(scene.frame(4, pushed(5)[-1]), 4.0)
    assert step is not None
    assert step.times == (3.0, 4.0)
    assert SequenceEstimator(lambda prev, curr: steps[0].motion).explain(scene.frame(0, pushed(1)[0]), 0.0) is None


@pytest.mark.parametrize("count", [1, 3])
def test_a_scene_in_which_nothing_moves_is_not_estimated_again(count: int) -> None:
    *_, steps, estimated = play([pushed(1)[0]] * (count + 1))
    assert estimated == [1]
    assert all(step.motion.objects == () for step in steps)
