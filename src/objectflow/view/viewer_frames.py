"""What a viewer shows at one time: a frame in the world, and the objects in it with where they were and are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.tracking.tracker import Tracker
from objectflow.typing import Float32Array, Float64Array

NO_TRACK = 65535
"""The id of masks in a sequence that no track follows: things that rest, and regions that no motion explains."""
NO_TRACK_NAME = "no track"


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object at one time. World: the first frame's camera; metres.

    Attributes:
        id: lasting over a sequence, from 1.
        name: to be read.
        world_T_object: (4, 4) its pose.
        way: (2, 3) its centre, where it was a frame before and where it is; None where nothing moved it yet.
        caption: how far and how much it turned.
    """

    id: int
    name: str
    world_T_object: Float64Array
    way: Float64Array | None = None
    caption: str = ""


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """One frame and what is known about it.

    Attributes:
        number: of the frame in its source; a viewer shows each number once.
        seconds: since the first frame; None where the source has no times.
        frame: what the camera saw.
        world_T_camera: (4, 4), metres.
        ids: (H, W) uint16, the object's id on each pixel, 0 = the static rest; None before any motion is known.
        scene_flow: (H, W, 3) float32 metres, as in `SceneMotion`; None before any motion is known.
        objects: in order of id.
    """

    number: int
    seconds: float | None
    frame: RgbdFrame
    world_T_camera: Float64Array
    ids: NDArray[np.uint16] | None = None
    scene_flow: Float32Array | None = None
    objects: tuple[ShownObject, ...] = ()


def pair_moments(prev: RgbdFrame, curr: RgbdFrame, motion: SceneMotion) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair; objects have the ids of the result.

    An object's own frame lies at its first centre, turned like the world, as in `tracking.Track`.

    Raises:
        ResultError: the result has other pixels than the frames.
    """
    check_size(motion, curr, "the result")
    world_T_curr = np.eye(4) if motion.camera_motion is None else motion.camera_motion
    before, after = [], []
    for obj in motion.objects:
        start = np.eye(4)
        start[:3, 3] = geometry.transform(obj.prev_T_curr, obj.center)
        pose = world_T_curr @ geometry.inverse(obj.prev_T_curr) @ start
        name = f"object {obj.id}" if obj.moving else f"object {obj.id} (still)"
        before.append(ShownObject(obj.id, name, start))
        way = np.stack([start[:3, 3], geometry.transform(world_T_curr, obj.center)])
        after.append(ShownObject(obj.id, name, pose, way if obj.moving else None, caption(way, start, pose)))
    gap = None if prev.timestamp is None or curr.timestamp is None else curr.timestamp - prev.timestamp
    return (
        ViewerFrame(0, None if gap is None else 0.0, prev, np.eye(4), objects=tuple(before)),
        ViewerFrame(1, gap, curr, world_T_curr, motion.labels.astype(np.uint16), motion.scene_flow, tuple(after)),
    )


def tracked_moments(
    tracker: Tracker,
    found: Mapping[int, int],
    frames: tuple[RgbdFrame, RgbdFrame],
    motion: SceneMotion,
    numbers: tuple[int, int],
    seconds: tuple[float | None, float | None],
) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of the pair that a tracker has just linked; objects have their tracks' ids.

    Args:
        tracker: after its `update` with this pair.
        found: what `update` returned.
        frames: previous and current.
        motion: between them.
        numbers, seconds: of both frames.
    """
    world_T_prev, world_T_curr = tracker.world_T_camera[-2:]
    by_track = {track: obj for obj in motion.objects for label, track in found.items() if label == obj.id}
    before, after = [], []
    for track in tracker.tracks:
        if track.id not in by_track:
            continue
        start, pose = track.world_T_object[-2:]
        obj, name = by_track[track.id], f"object {track.id}"
        was = geometry.transform(world_T_prev @ obj.prev_T_curr, obj.center)
        way = np.stack([was, geometry.transform(world_T_curr, obj.center)])
        before.append(ShownObject(track.id, name, start))
        after.append(ShownObject(track.id, name, pose, way, caption(way, start, pose)))
    table = np.full(int(motion.labels.max(initial=0)) + 1, NO_TRACK, np.uint16)
    table[0] = 0
    for label, track_id in found.items():
        if label < len(table):
            table[label] = track_id
    return (
        ViewerFrame(numbers[0], seconds[0], frames[0], world_T_prev, objects=tuple(before)),
        ViewerFrame(
            numbers[1], seconds[1], frames[1], world_T_curr, table[motion.labels], motion.scene_flow, tuple(after)
        ),
    )


class RunMoments:
    """The moments of a run's results, pair after pair, linked as `tracks.json` is."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._tracker = Tracker()
        self._start: float | None = None
        self._last: tuple[int, RgbdFrame] | None = None

    def read(self, folder: Path, prev: int, curr: int) -> tuple[ViewerFrame, ViewerFrame]:
        """The moments of the result in `folder`, between the source's frames of those numbers.

        Raises:
            ResultError: no result there, or one of other pixels than the frames.
            ReaderError: frames that cannot be read.
        """
        motion = SceneMotion.load(folder)
        if max(prev, curr) >= len(self._source):
            raise ResultError(f"{folder}: its source has {len(self._source)} frames now: it is another one")
        before = self._last[1] if self._last is not None and self._last[0] == prev else self._source[prev]
        after = self._source[curr]
        check_size(motion, after, str(folder))
        self._last = (curr, after)
        times = self._source.timestamp(prev), self._source.timestamp(curr)
        found = self._tracker.update(
            *(prev if times[0] is None else times[0], after, curr if times[1] is None else times[1]), motion
        )
        if self._start is None:
            self._start = times[0]
        start = self._start or 0.0
        seconds = tuple(None if time is None else time - start for time in times)
        return tracked_moments(self._tracker, found, (before, after), motion, (prev, curr), (seconds[0], seconds[1]))


def check_size(motion: SceneMotion, curr: RgbdFrame, where: str) -> None:
    """Check that a result and a frame have the same pixels.

    Raises:
        ResultError: they do not; the message starts with `where`.
    """
    if motion.labels.shape != curr.depth.shape:
        height, width = motion.labels.shape
        raise ResultError(
            f"{where} is {width}x{height}, the frames are {curr.camera.width}x{curr.camera.height}: "
            "they are not what it was made from"
        )


def caption(way: Float64Array, start: Float64Array, pose: Float64Array) -> str:
    """How far a centre went and how much its object turned, in the world."""
    turn = math.degrees(float(geometry.rotation_angle(pose[:3, :3] @ start[:3, :3].T)))
    return f"{100 * float(np.linalg.norm(way[1] - way[0])):.1f} cm, {turn:.0f}°"
