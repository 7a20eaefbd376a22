"""Plates that the method misses at first, or between consecutive frames: they are found later, and followed back."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from helpers.plate_scenes import Place, PlateScene, iou
from objectflow import SequenceEstimator
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.base import PairEstimator
from objectflow.motion import SceneMotion
from objectflow.tracking import SequenceStep
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.longer_gap_settings import LongerGapSettings

STILL: Place = (0.3, 0.2, 1.2)
STEP = 0.02
"""Metres per frame."""


def pushed(count: int, step: float = STEP) -> list[dict[int, Place]]:
    """Plate 1 slides by `step` from frame to frame, plate 2 never moves."""
    return [{1: (-0.25 + step * k, 0.0, 1.0), 2: STILL} for k in range(count)]


def play(
    places: list[dict[int, Place]],
    sees: Callable[[int, int], bool],
    noise: float = 0.0,
    restart: int | None = None,
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep], list[tuple[int, int]]]:
    """Feed frames of the plates at these places to a method that sees the motion between some frames only.

    Args:
        places: of the plates in each frame.
        sees: tells from the numbers of two frames whether the method sees what moved between them.
        noise: standard deviation of depth, metres.
        restart: number of the frame before which the state is pickled and restored.

    Returns:
        The scene, the sequence, its steps, and the numbers of the frames of each estimate.
    """
    scene = PlateScene()
    frames = [scene.frame(number, here, noise) for number, here in enumerate(places)]
    calls: list[tuple[int, int]] = []

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        numbers = round(prev.timestamp or 0), round(curr.timestamp or 0)
        calls.append(numbers)
        found = scene.motion(numbers[1], since=numbers[0])
        return found if sees(*numbers) else SceneMotion(np.zeros_like(found.labels), found.scene_flow)

    sequence = SequenceEstimator(estimate)
    steps = []
    for number, frame in enumerate(frames):
        if number == restart:
            state = pickle.loads(pickle.dumps(sequence.state()))
            sequence = SequenceEstimator(estimate)
            sequence.restore(state)
        step = sequence.update(frame)
        if step is not None:
            steps.append(step)
    return scene, sequence, steps, calls


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_an_object_is_followed_back_through_the_steps_that_the_method_missed(noise: float) -> None:
    """The plate rests until frame 2, and moves on; the method sees it from frame 5 on."""
    places = [*[pushed(1)[0]] * 2, *pushed(7)]
    scene, sequence, steps, _ = play(places, lambda prev, curr: prev == curr - 1 and curr > 5, noise)
    (track,) = sequence.tracks
    assert track.times == list(range(2, 9))
    shifts = np.array([pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object])
    np.testing.assert_allclose(shifts, STEP * np.arange(7), atol=0.004)
    assert not any(step.revised for step in (*steps[:5], *steps[6:]))
    assert set(steps[5].revised) == {2, 3, 4, 5}
    for number, known in steps[5].revised.items():
        assert set(np.unique(known)) == {0, 1}
        assert iou(known == 1, scene.labels[round(number)] == 1) > 0.85


def test_an_object_that_rested_before_its_first_step_has_no_earlier_one() -> None:
    places = [*[pushed(1)[0]] * 4, *pushed(4)]
    _, sequence, steps, _ = play(places, lambda prev, curr: prev == curr - 1, noise=0.003)
    assert sequence.tracks[0].times == [4, 5, 6, 7]
    assert [sorted(step.revised) for step in steps if step.revised] == [[4]]


def test_masks_of_the_recent_frames_are_completed_as_far_as_they_are_kept() -> None:
    """The plate has moved for 20 frames when the method sees it: 8 frames before the latest are kept."""
    places = pushed(22, 0.01)
    _, sequence, steps, _ = play(places, lambda prev, curr: prev == curr - 1 and curr > 20)
    assert sequence.tracks[0].times[0] == 13
    assert sorted(steps[20].revised) == list(range(13, 21))
    assert len(sequence.state()["recent"]) == 8


def test_motion_that_only_frames_farther_apart_show_is_found_between_these() -> None:
    """The method sees nothing that moved by less than 2.5 cm; the plate slides by 1 cm a frame and rests."""
    places = [*pushed(9, 0.01), *[pushed(9, 0.01)[-1]] * 6]
    scene, sequence, steps, calls = play(places, lambda prev, curr: min(curr, 8) - min(prev, 8) > 2)
    (track,) = sequence.tracks
    first = next(number for number, step in enumerate(steps, start=1) if step.known.any())
    assert first == 6  # the second such estimate: the first one comes too early
    assert steps[first - 1].longer is not None
    assert steps[first - 1].followed == (1,)
    assert track.times[:9] == list(range(9))
    shifts = [pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object[:9]]
    np.testing.assert_allclose(shifts, 0.01 * np.arange(9), atol=0.006)
    for number in range(first, 15):
        assert iou(steps[number - 1].known == 1, scene.labels[number] == 1) > 0.9
    # What is known explains the change, so that no more such estimates are made.
    assert max(curr for prev, curr in calls if prev < curr - 1) == first


def test_frames_farther_apart_are_compared_in_a_fifth_of_the_pairs_at_most() -> None:
    """The plate moves all the time, but the method never sees it."""
    places = [{1: (0.1 * np.sin(k / 3), 0.0, 1.0), 2: STILL} for k in range(31)]
    _, sequence, _, calls = play(places, lambda prev, curr: False)
    assert not sequence.tracks
    longer = [pair for pair in calls if pair[0] < pair[1] - 1]
    assert 30 / 5 - 1 <= len(longer) <= 30 / 5 + 2
    assert all(curr - prev <= 4 for prev, curr in longer)


class Near(PairEstimator):
    """Sees what moves only with its closer look."""

    def __init__(self, scene: PlateScene, sees: bool = False) -> None:
        self.scene, self.sees = scene, sees

    def estimate(self, pair: FramePair) -> SceneMotion:
        prev, curr = (round(one.frame.timestamp or 0) for one in (pair.prev, pair.curr))
        found = self.scene.motion(curr, since=prev)
        return found if self.sees else SceneMotion(np.zeros_like(found.labels), found.scene_flow)

    def closer(self) -> Near:
        return Near(self.scene, sees=True)


@pytest.mark.parametrize("closer", [True, False])
def test_frames_farther_apart_are_looked_at_more_closely(closer: bool) -> None:
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(pushed(8))]
    settings = KnownSettings(longer_gap=LongerGapSettings(closer=closer))
    sequence = SequenceEstimator(Near(scene), settings=settings)
    steps = [sequence.update(frame) for frame in frames]
    assert any(step is not None and step.longer is not None for step in steps)
    assert len(sequence.tracks) == closer


def test_no_frames_farther_apart_are_compared_where_nothing_changed() -> None:
    _, _, _, calls = play([pushed(1)[0]] * 8, lambda prev, curr: True, noise=0.003)
    assert calls == [(number, number + 1) for number in range(7)]


def test_an_estimate_between_frames_farther_apart_that_the_frames_refute_adds_no_object() -> None:
    """Plate 1 moves and is missed; between frames farther apart, plate 2 is said to have moved, which rests."""
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(pushed(8))]
    wrong = PlateScene()
    for number in range(8):
        wrong.frame(number, {2: (STILL[0] - 0.02 * number, STILL[1], STILL[2])})
        wrong.labels[number] = np.where(scene.labels[number] == 2, 2, 0).astype(np.int32)
    count = 0

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        nonlocal count
        numbers = round(prev.timestamp or 0), round(curr.timestamp or 0)
        count += numbers[0] < numbers[1] - 1
        return wrong.motion(numbers[1], since=numbers[0] if numbers[0] < numbers[1] - 1 else numbers[1])

    sequence = SequenceEstimator(estimate)
    for frame in frames:
        sequence.update(frame)
    assert count > 0
    assert not sequence.tracks


@pytest.mark.parametrize("restart", [3, 5, 6])
def test_a_restored_state_finds_the_same_earlier_steps(restart: int) -> None:
    places = [*pushed(6, 0.01), *[pushed(6, 0.01)[-1]] * 4]
    results = [play(places, lambda prev, curr: curr - prev > 2, restart=at) for at in (None, restart)]
    (_, whole, steps, _), (_, other, others, _) = results
    assert any(step.revised for step in steps)
    for a, b in zip(steps, others, strict=True):
        assert a.revised.keys() == b.revised.keys()
        np.testing.assert_array_equal(a.known, b.known)
        for time in a.revised:
            np.testing.assert_array_equal(a.revised[time], b.revised[time])
    for c, d in zip(whole.tracks, other.tracks, strict=True):
        np.testing.assert_array_equal(c.world_T_object, d.world_T_object)


def test_a_small_last_step_is_a_step_of_the_object() -> None:
    """The plate slides by 2 cm a frame, at last by 9 mm, which the method misses."""
    places = pushed(5)
    end = places[-1][1][0] + 0.009
    places += [{1: (end, 0.0, 1.0), 2: STILL}] * 3
    _, sequence, steps, _ = play(places, lambda prev, curr: prev == curr - 1 and curr < 5)
    assert [step.followed for step in steps] == [(), (), (), (), (1,), (), ()]
    (track,) = sequence.tracks
    moved = [pose[0, 3] - track.world_T_object[0][0, 3] for pose in track.world_T_object]
    # A pixel has 7 mm.
    assert moved[4] == pytest.approx(4 * STEP, abs=0.005)
    assert moved[5] == pytest.approx(4 * STEP + 0.009, abs=0.005)


@pytest.mark.parametrize("together", [True, False])
def test_what_touches_a_known_object_and_moves_with_it_is_its_surface(together: bool) -> None:
    """Consecutive frames show plate 1 only, frames farther apart plate 3, which touches it; or it moves otherwise."""
    places = [
        {1: (-0.32 + STEP * k, 0.0, 1.0), 3: (-0.08 + STEP * k, 0.0 if together else STEP * k, 1.0)} for k in range(8)
    ]
    scene = PlateScene()
    frames = [scene.frame(number, here) for number, here in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        numbers = round(prev.timestamp or 0), round(curr.timestamp or 0)
        found = scene.motion(numbers[1], since=numbers[0])
        plate = 1 if numbers[1] == numbers[0] + 1 else 3
        objects = tuple(obj for obj in found.objects if obj.id == plate)
        return SceneMotion(
            np.where(found.labels == plate, found.labels, 0).astype(np.int32), found.scene_flow, objects
        )

    sequence = SequenceEstimator(estimate)
    steps = [step for frame in frames if (step := sequence.update(frame)) is not None]
    assert len(sequence.tracks) == (1 if together else 2)
    found = next(number for number, step in enumerate(steps, start=1) if step.longer is not None)
    whole = np.isin(scene.labels[found], (1, 3))
    known = steps[found - 1].known
    assert iou(known == 1, whole if together else scene.labels[found] == 1) > 0.9
    assert sequence.tracks[0].model is not None
    width = np.ptp(sequence.tracks[0].model.points, axis=0)[0]
    assert width == pytest.approx(0.48 if together else 0.24, abs=0.04)
