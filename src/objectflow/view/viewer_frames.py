"""What a viewer shows at one time: a frame with its camera pose, and the objects with their motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

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
        model: binary glTF file of its model in the object frame; None without a model.
    """

    id: int
    name: str
    world_T_object: Float64Array
    path: Float64Array | None = None
    caption: str = ""
    model: Path | None = None


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
        known: (H, W) track ids of known objects in the current frame, at rest as well; None for none.
    """
    # A lost camera has no poses.
    cameras = tuple(tracker.world_T_camera[-2:]) or (np.eye(4), np.eye(4))
    poses = {}
    for track in tracker.world_tracks:
        moved = track.id in tracks.values()
        poses[track.id] = (track.world_T_object[-2 if moved else -1], track.world_T_object[-1])
    return posed_frames(poses, tracks, (cameras[0], cameras[1]), frames, motion, numbers, seconds, known)


def posed_frames(
    poses: Mapping[int, tuple[Float64Array, Float64Array]],
    tracks: Mapping[int, int],
    world_T_camera: tuple[Float64Array, Float64Array],
    frames: tuple[RgbdFrame, RgbdFrame],
    motion: SceneMotion,
    numbers: tuple[int, int],
    seconds: tuple[float | None, float | None],
    known: LabelImage | None = None,
    models: Mapping[int, Path] | None = None,
) -> tuple[ViewerFrame, ViewerFrame]:
    """Both frames of a pair in a sequence, with all objects of its world.

    Args:
        poses: (4, 4) `world_T_object` in both frames by track id, also of objects at rest.
        tracks: track id by the object's id in `motion`, of the objects that moved.
        world_T_camera: (4, 4) of both frames.
        frames: previous and current.
        motion: between the frames.
        numbers, seconds: of both frames.
        known: (H, W) track ids of known objects in the current frame, at rest as well; None for none.
        models: model files by track id.
    """
    by_track = {tracks[obj.id]: obj for obj in motion.objects if obj.id in tracks}
    before, after = [], []
    for number, (start, pose) in poses.items():
        model = (models or {}).get(number)
        shown = ShownObject(number, f"object {number}", start, model=model)
        before.append(shown)
        path, caption = None, ""
        if number in by_track:
            obj = by_track[number]
            path = geometry.transform(world_T_camera[1], np.stack([obj.prev_center, obj.center]))
            caption = motion_caption(obj)
        after.append(replace(shown, world_T_object=pose, path=path, caption=caption))
    id_of_label = np.full(int(motion.labels.max(initial=0)) + 1, NO_TRACK, np.uint16)
    id_of_label[0] = 0
    for label, track_id in tracks.items():
        if label < len(id_of_label):
            id_of_label[label] = track_id
    ids = id_of_label[motion.labels]
    if known is not None:
        ids = np.where((known > 0) & ((ids == 0) | (ids == NO_TRACK)), known, ids).astype(np.uint16)
    own_flow = motion.own_flow(frames[1])
    return (
        ViewerFrame(numbers[0], seconds[0], frames[0], world_T_camera[0], objects=tuple(before)),
        ViewerFrame(numbers[1], seconds[1], frames[1], world_T_camera[1], ids, own_flow, tuple(after)),
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
