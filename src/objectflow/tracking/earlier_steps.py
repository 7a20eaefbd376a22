"""The earlier steps of an object: its model is followed back from the frame in which its motion was found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from objectflow import geometry
from objectflow.tracking.earlier_settings import EarlierSettings
from objectflow.tracking.fine_step import NeighbourFrame, fine_step
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.recent_frames import RecentViews
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import Float64Array


class EarlierPose(NamedTuple):
    """The pose of an object in a recent frame.

    Attributes:
        number: of the frame among the recent ones.
        world_T_object: (4, 4).
        present: share of the model's visible points that the frame confirms, 0..1.
        moved: whether the object moved from this frame to the next one.
    """

    number: int
    world_T_object: Float64Array
    present: float
    moved: bool


def earlier_poses(
    model: SurfaceModel,
    recent: RecentViews,
    first: int,
    following: tuple[FrameView, Float64Array],
    later: Sequence[Float64Array],
    settings: EarlierSettings,
    hints: Sequence[Float64Array] = (),
) -> list[EarlierPose]:
    """Follow an object back, from frame to frame, until it is not seen or has rested for a while.

    `fine_step` determines which steps count.

    Args:
        model: of the object.
        recent: the frames.
        first: number of the latest frame whose pose is wanted.
        following: the frame after it and its (4, 4) `world_T_camera`.
        later: (4, 4) each, `world_T_object` in the two frames after it, the nearer one first; one is enough.
        settings: thresholds.
        hints: (4, 4) each, further initial poses `world_T_object`.

    Returns:
        The poses from the latest frame to that before the first step; empty without a step.
    """
    found: list[EarlierPose] = []
    poses = list(later[:2])
    rests = 0
    for number in range(first, -1, -1):
        view = recent.view(number)
        camera = recent.frames[number].world_T_camera
        starts = list(hints)
        if len(poses) > 1:
            # The same step once more.
            starts.append(poses[0] @ geometry.inverse(poses[1]) @ poses[0])
        curr_T_world = geometry.inverse(camera)
        neighbour = NeighbourFrame(following[0], geometry.inverse(following[1]) @ camera)
        step = fine_step(
            view, neighbour, model, curr_T_world @ poses[0], [curr_T_world @ start for start in starts], settings
        )
        if step is None:
            break
        world_T_object = camera @ step.camera_T_object if step.moved else poses[0]
        found.append(EarlierPose(number, world_T_object, step.present, step.moved))
        poses, following = [world_T_object, poses[0]], (view, camera)
        rests = 0 if step.moved else rests + 1
        if rests > settings.max_rests:
            break
    steps = [k for k, one in enumerate(found) if one.moved]
    return found[: steps[-1] + 1] if steps else []
