"""Live tracking: slow methods get the newest frame, recordings play in real time, sources stop cleanly."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.paths import ROOT
from helpers.plate_scenes import PlateScene
from objectflow.cli import main
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.live import NewestFrame, follow, replay
from objectflow.live.newest_frame import FrameTaken
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.readers import FramePaths, FrameSequence
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.tracker_settings import TrackerSettings

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
PAIR = ROOT / "src" / "objectflow" / "demo" / "pair"


def frame(number: int, period: float = 0.1) -> RgbdFrame:
    return RgbdFrame(
        np.full((12, 16, 3), number % 250, np.uint8), np.ones((12, 16), np.float32), CAMERA, timestamp=number * period
    )


class RecordingEstimator:
    """An estimator that finds no objects and records the times of the frames that it receives."""

    def __init__(self) -> None:
        self.times: list[tuple[float | None, float | None]] = []

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        self.times.append((prev.timestamp, curr.timestamp))
        shape = curr.depth.shape
        return SceneMotion(np.zeros(shape, np.int32), np.zeros((*shape, 3), np.float32))


def test_a_slow_method_gets_the_newest_frame_and_the_others_are_dropped() -> None:
    first, rest, finished = threading.Event(), threading.Event(), threading.Event()

    def source() -> Iterator[RgbdFrame]:
        yield frame(0)
        first.wait(5)
        yield frame(1)
        rest.wait(5)
        for number in range(2, 50):
            yield frame(number)
        finished.set()

    estimator = RecordingEstimator()
    with NewestFrame(source()) as newest:
        steps = follow(newest, estimator, Tracker(), skip_explained=False)
        # The first frame must be taken before the second arrives.
        threading.Timer(0.05, first.set).start()
        step = next(steps)
        assert (step.times, step.dropped) == ((0.0, pytest.approx(0.1)), 0)
        rest.set()
        assert finished.wait(5)
        step = next(steps)
        assert step.times == (pytest.approx(0.1), pytest.approx(4.9))
        assert step.dropped == 47
        with pytest.raises(StopIteration):
            next(steps)
    assert len(estimator.times) == 2


def test_frames_closer_in_time_than_the_minimum_gap_are_not_paired() -> None:
    taken = threading.Semaphore(0)

    def source() -> Iterator[RgbdFrame]:
        for number in range(10):
            yield frame(number)
            taken.acquire(timeout=0.2)

    estimator = RecordingEstimator()
    with NewestFrame(source()) as newest:
        for _ in follow(newest, estimator, Tracker(), min_gap=0.35):
            taken.release()
    assert all(b - a >= 0.35 for a, b in estimator.times if a is not None and b is not None)
    assert len(estimator.times) >= 1


def test_no_pair_spans_the_restart_of_a_recording() -> None:
    times = [0.0, 1.0, 0.0, 1.0]
    taken = threading.Semaphore(0)

    def source() -> Iterator[RgbdFrame]:
        for number, seconds in enumerate(times):
            yield RgbdFrame(
                np.full((12, 16, 3), number, np.uint8), np.ones((12, 16), np.float32), CAMERA, timestamp=seconds
            )
            taken.acquire(timeout=0.2)

    estimator = RecordingEstimator()
    with NewestFrame(source()) as newest:
        for _ in follow(newest, estimator, Tracker()):
            taken.release()
    assert estimator.times == [(0.0, 1.0), (0.0, 1.0)]


def test_errors_of_the_source_are_raised_to_the_consumer() -> None:
    def source() -> Iterator[RgbdFrame]:
        yield frame(0)
        raise ReaderError("the camera stopped")

    with NewestFrame(source()) as newest, pytest.raises(ReaderError, match="the camera stopped"):
        newest.take(0, timeout=5)


def test_leaving_the_block_closes_the_source() -> None:
    closed = threading.Event()

    def source() -> Iterator[RgbdFrame]:
        try:
            number = 0
            while True:
                yield frame(number)
                number += 1
                time.sleep(0.001)
        finally:
            closed.set()

    with NewestFrame(source()) as newest:
        assert newest.take(timeout=5) is not None
    assert closed.wait(5)


class FakeClock:
    """A clock that advances only in `sleep`."""

    def __init__(self) -> None:
        self.now = 50.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def sequence(count: int) -> FrameSequence:
    paths = tuple(FramePaths(Path(f"{k}.png"), Path(f"{k}.png"), 1000 + 0.1 * k) for k in range(count))
    return FrameSequence(paths, CAMERA, 1000.0)


def test_a_recording_plays_in_real_time_and_skips_overdue_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FrameSequence, "__getitem__", lambda self, index: frame(index))
    for speed in (1.0, 4.0):
        clock = FakeClock()
        shown_at = [clock.now - 50 for _ in replay(sequence(6), speed=speed, clock=clock, sleep=clock.sleep)]
        np.testing.assert_allclose(shown_at, 0.1 * np.arange(6) / speed, atol=1e-9)
    clock, numbers = FakeClock(), []
    for shown in replay(sequence(6), clock=clock, sleep=clock.sleep):
        numbers.append(round((shown.timestamp or 0) * 10))
        clock.now += 0.25  # The consumer is slower than the recording.
    # After frame 0 it is 0.25 s, so frame 1, due at 0.1 s, is skipped, and so on; the last frame is always yielded.
    assert numbers == [0, 2, 5]


def test_memory_is_bounded_over_two_thousand_frames() -> None:
    tracker = Tracker(TrackerSettings(history=2, min_color_similarity=0.0))  # colours encode the frame number
    shape = (12, 16)
    labels = np.zeros(shape, np.int32)
    labels[3:9, 4:10] = 1
    for number in range(1, 2000):
        obj = ObjectMotion(1, 36, 0.9, True, np.array([0.0, 0.0, 1.0]), np.eye(4))
        tracker.update(
            number - 1, frame(number), number, SceneMotion(labels, np.zeros((*shape, 3), np.float32), (obj,))
        )
    assert len(tracker.camera_times) == len(tracker.world_T_camera) == 2
    assert [len(track.times) for track in tracker.tracks] == [2]
    assert tracker.tracks[0].id == 1


def test_the_command_tracks_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live", str(PAIR), "--min-gap", "0", "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "#1 " in lines[0]
    assert "#3 " in lines[0]
    assert lines[1].startswith("1 estimates, median latency")
    assert sorted(path.name for path in (tmp_path / "out" / "trajectories").iterdir()) == [
        f"object_00{number}.txt" for number in (1, 2, 3)
    ]
    assert main(["live", str(PAIR), "--min-gap", "60"]) == 2
    assert "no two frames at least 60 s apart" in capsys.readouterr().err
    assert main(["live", str(PAIR), "--speed", "0"]) == 2
    assert main(["live", str(tmp_path / "nowhere")]) == 2


class Given(NewestFrame):
    """Serves given frames."""

    def __init__(self, frames: list[FrameTaken]) -> None:
        super().__init__([])
        self.frames = frames

    def take(self, after: int = -1, timeout: float | None = None) -> FrameTaken | None:
        return self.frames.pop(0) if self.frames else None


def test_no_pair_spans_a_restart_that_the_method_did_not_see() -> None:
    """The clock goes back during an estimate, and the next frame that is taken has a later stamp than the last one."""
    with NewestFrame([frame(0), frame(10), frame(2), frame(15)]) as newest:
        while (taken := newest.take(2, timeout=5)) is None or taken.number < 3:
            pass
    assert taken.part == 1
    estimator = RecordingEstimator()
    for _ in follow(Given([FrameTaken(0, frame(0), 0), taken, FrameTaken(4, frame(20), 1)]), estimator, Tracker()):
        pass
    assert estimator.times == [(1.5, 2.0)]


class Clocked:
    """A recording with given stamps, of which some frames cannot be read, and a clock that only waiting advances."""

    def __init__(self, stamps: list[float], broken: set[int]) -> None:
        self.stamps, self.broken, self.now = stamps, broken, 100.0
        self.camera, self.depth_scale = CAMERA, 1000.0
        self.cuts: tuple[int, ...] = ()
        self.notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.stamps)

    def timestamp(self, index: int) -> float:
        return self.stamps[index]

    def __getitem__(self, index: int) -> RgbdFrame:
        if index in self.broken:
            raise ReaderError(f"frame {index} is broken")
        return frame(index)

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_a_playback_leaves_out_broken_frames_and_shortens_pauses() -> None:
    # A pause of an hour, and a clock that goes back.
    source = Clocked([0.0, 0.5, 3600.0, 3600.5, 10.0, 10.5], broken={1, 3})
    played = [
        (read.color[0, 0, 0], round(source.now - 100, 6))
        for read in replay(source, clock=lambda: source.now, sleep=source.sleep)
    ]
    assert played == [(0, 0.0), (2, 1.5), (4, 2.0), (5, 2.5)]
    with pytest.raises(ReaderError, match="frame 0 is broken"):
        list(replay(Clocked([0.0, 0.1], broken={0, 1}), clock=lambda: 0.0, sleep=lambda _: None))


def test_a_few_earlier_frames_are_kept_at_a_distance() -> None:
    """Frames arrive every 0.1 s; of those 0.2 s apart, the last three are kept."""
    now = [0.0]

    def source() -> Iterator[RgbdFrame]:
        for number in range(10):
            yield frame(number)
            now[0] += 0.1

    with NewestFrame(source(), keep=3, spacing=0.19, clock=lambda: now[0]) as newest:
        while newest.take(8, timeout=5) is None:
            pass
        assert [one.number for one in newest.earlier(-1)] == [4, 6, 8]
        assert [one.number for one in newest.earlier(4)] == [6, 8]
        assert [one.arrived for one in newest.earlier(6)] == pytest.approx([0.8])


class Busy(Given):
    """Serves given frames; `kept` are those that arrived during the estimate of the first pair."""

    def __init__(self, frames: list[FrameTaken], kept: list[FrameTaken]) -> None:
        super().__init__(frames)
        self.kept = kept

    def earlier(self, after: int) -> list[FrameTaken]:
        return [one for one in self.kept if one.number > after]


def test_after_an_estimate_known_objects_are_followed_through_the_frames_that_arrived_meanwhile() -> None:
    scene = PlateScene()
    frames = [scene.frame(number, {1: (-0.25 + 0.03 * number, 0.0, 1.0)}) for number in range(9)]
    taken = [FrameTaken(number, one, 0) for number, one in enumerate(frames)]
    estimates: list[tuple[float | None, float | None]] = []

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        estimates.append((prev.timestamp, curr.timestamp))
        return scene.motion(round(curr.timestamp or 0), since=round(prev.timestamp or 0))

    source = Busy([*taken[:2], taken[7], taken[7], taken[8]], taken[2:7])
    steps = list(follow(source, estimate, Tracker(), min_gap=1))
    # From frame 1 halfway to the newest one, 7, then to the newest one.
    assert [step.times for step in steps] == [(0, 1), (1, 4), (4, 7), (7, 8)]
    assert [step.dropped for step in steps] == [0, 2, 2, 0]
    assert estimates == [(0, 1)]
    shifts = [step.motion.objects[0].displacement for step in steps]
    assert shifts == pytest.approx([0.03, 0.09, 0.09, 0.03], abs=0.003)
    source = Busy([*taken[:2], taken[7], taken[8]], taken[2:7])
    estimates.clear()
    assert [step.times for step in follow(source, estimate, Tracker(), min_gap=1, skip_explained=False)][1] == (1, 7)
    assert estimates[:3] == [(0, 1), (1, 7), (7, 8)]


def test_kept_frames_without_time_stamps_have_the_times_of_their_arrival() -> None:
    """Objects are predicted by the time between the frames, not by when they are looked at."""
    scene = PlateScene()
    frames = [
        replace(scene.frame(number, {1: (-0.25 + 0.03 * number, 0.0, 1.0)}), timestamp=None) for number in range(8)
    ]
    taken = [FrameTaken(number, one, 0, 10.0 + number) for number, one in enumerate(frames)]
    source = Busy([*taken[:2], taken[7], taken[7]], taken[2:7])
    steps = list(follow(source, lambda prev, curr: scene.motion(1), Tracker(), min_gap=1, clock=lambda: 100.0))
    assert [step.times for step in steps] == [(10, 11), (11, 14), (14, 17)]
    assert [step.latency for step in steps] == [89, 86, 83]
