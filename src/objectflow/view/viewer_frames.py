"""What a viewer shows at one time: a frame with its camera pose, and the objects with their motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.motion.words import motion_caption
from objectflow.tracking.tracker import Tracker
from objectflow.typing import Float32Array, Float64Array, LabelImage

NO_TRACK = 65535
"""Id of masks without a track: objects at rest, and regions that no motion explains."""
NO_TRACK_NAME = "no track"


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object at one time. The world frame is the camera of the first frame; units are metres.

    Attributes:
        id: persistent over a sequence, from 1.
        name: for display.
        world_T_object: (4, 4) pose.
        path: (2, 3) its centre in the previous and in this frame; None if it did not move.
        caption: displacement and rotation, for display.
    """

    id: int
    name: str
    world_T_object: Float64Array
    path: Float64Array | None = None
    caption: str = ""


@dataclass(frozen=True, eq=False)
class ViewerFrame:
    """One frame with its camera pose, masks, flow and objects.

    Attributes:
        number: of the frame in its source; a viewer shows each number once.
        seconds: since the first frame; None where the source has no times.
        frame: colour and depth.
        world_T_camera: (4, 4), metres.
        ids: (H, W) uint16 object ids, 0 = static background; None for the first frame.
        own_flow: (H, W, 3) float32 metres, as of `SceneMotion.own_flow`; None for the first frame.
        objects: in order of id.
    """

    number: int
    seconds: float | None
    frame: RgbdFrame
    world_T_camera: Float64Array
    ids: NDArray[np.uint16] | None = None
    own_flow: Float32Array | None = None
    objects: tuple[ShownObject, ...] = ()


def pair_frames(prev: RgbdFrame, curr: RgbdFrame, motion: SceneMotion) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair; objects have the ids of the result.

    The object frame starts at the object's centre, aligned with the world, as in `tracking.Track`.

    Raises:
        ResultError: the sizes of the result and of the frames differ.
    """
    check_size(motion, curr, "the result")
    world_T_curr = np.eye(4) if motion.camera_motion is None else motion.camera_motion
    before, after = [], []
    for obj in motion.objects:
        path = geometry.transform(world_T_curr, np.stack([obj.prev_center, obj.center]))
        start = np.eye(4)
        start[:3, 3] = path[0]
        own = world_T_curr @ obj.own_prev_T_curr @ geometry.inverse(world_T_curr)
        pose = geometry.inverse(own) @ start
        name = f"object {obj.id}" if obj.moving else f"object {obj.id} (static)"
        before.append(ShownObject(obj.id, name, start))
        after.append(ShownObject(obj.id, name, pose, path if obj.moving else None, motion_caption(obj)))
    gap = None if prev.timestamp is None or curr.timestamp is None else curr.timestamp - prev.timestamp
    return (
        ViewerFrame(0, None if gap is None else 0.0, prev, np.eye(4), objects=tuple(before)),
        ViewerFrame(1, gap, curr, world_T_curr, motion.labels.astype(np.uint16), motion.own_flow(curr), tuple(after)),
    )


def tracked_frames(
    tracker: Tracker,
    tracks: Mapping[int, int],
    frames: tuple[RgbdFrame, RgbdFrame],
    motion: SceneMotion,
    numbers: tuple[int, int],
    seconds: tuple[float | None, float | None],
    known: LabelImage | None = None,
) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of the pair that a tracker was just updated with; objects have the ids of their tracks.

    Args:
        tracker: after its `update` with this pair.
        tracks: the return value of `update`.
        frames: previous and current.
        motion: between the frames.
        numbers, seconds: of both frames.
        known: (H, W) track ids of known objects in the current frame, which are also shown at rest; None for none.
    """
    # A lost camera has no poses.
    world_T_prev, world_T_curr = tracker.world_T_camera[-2:] or (np.eye(4), np.eye(4))
    by_track = {track: obj for obj in motion.objects for label, track in tracks.items() if label == obj.id}
    before, after = [], []
    for track in tracker.tracks:
        if track.id not in by_track:
            continue
        start, pose = track.world_T_object[-2:]
        obj, name = by_track[track.id], f"object {track.id}"
        path = geometry.transform(world_T_curr, np.stack([obj.prev_center, obj.center]))
        before.append(ShownObject(track.id, name, start))
        after.append(ShownObject(track.id, name, pose, path, motion_caption(obj)))
    id_of_label = np.full(int(motion.labels.max(initial=0)) + 1, NO_TRACK, np.uint16)
    id_of_label[0] = 0
    for label, track_id in tracks.items():
        if label < len(id_of_label):
            id_of_label[label] = track_id
    ids = id_of_label[motion.labels]
    if known is not None:
        ids = np.where((known > 0) & ((ids == 0) | (ids == NO_TRACK)), known, ids).astype(np.uint16)
    return (
        ViewerFrame(numbers[0], seconds[0], frames[0], world_T_prev, objects=tuple(before)),
        ViewerFrame(numbers[1], seconds[1], frames[1], world_T_curr, ids, motion.own_flow(frames[1]), tuple(after)),
    )


def check_size(motion: SceneMotion, curr: RgbdFrame, where: str) -> None:
    """Check that a result and a frame have the same size.

    Raises:
        ResultError: they differ; the message starts with `where`.
    """
    if motion.labels.shape != curr.depth.shape:
        height, width = motion.labels.shape
        raise ResultError(
            f"{where} is {width}x{height}, the frames are {curr.camera.width}x{curr.camera.height}: "
            "it was not made from these frames"
        )
