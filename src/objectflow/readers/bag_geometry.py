"""The steps that bring a bag's colour and depth to the pixels of one pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objectflow import geometry
from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers.bag_camera import CameraChoice, ImageTopic, choose_camera
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.bag_records import EXTRINSICS_TYPES, TRANSFORM_TYPES
from objectflow.readers.camera_info import ImageCamera, is_rectified
from objectflow.readers.frame_steps import DepthAtColor
from objectflow.readers.rectify import Rectification
from objectflow.readers.register_depth import DepthRegistration
from objectflow.readers.sequence import FrameStep
from objectflow.readers.transforms import TransformTree, extrinsics_matrix
from objectflow.typing import Float64Array

REGISTERED_NAMES = ("aligned_depth_to_color", "depth_registered", "depth_to_rgb", "depth_to_color")
"""Parts of the names of topics whose depth lies on the pixels of colour."""
_ADVICE = (
    "record depth that is registered to colour (align_depth.enable:=true, depth_registration:=true), or /tf_static "
    "and the camera_info of both"
)


@dataclass(frozen=True)
class GeometrySettings:
    """Thresholds for cameras and frames that count as equal.

    Attributes:
        same_focal: largest relative difference of two focal lengths.
        same_center: largest distance of two principal points, in pixels.
        same_position: largest distance of two frames, metres.
        same_orientation: largest angle between two frames, radians.
        same_aspect: largest relative difference of two aspect ratios.
    """

    same_focal: float = 0.005
    same_center: float = 1.5
    same_position: float = 0.001
    same_orientation: float = 0.002
    same_aspect: float = 0.01


@dataclass(frozen=True)
class BagGeometry:
    """How frames are made from decoded images.

    Attributes:
        camera: of the frames.
        steps: to apply to colour and depth, in order.
        notes: what the steps do, one sentence each.
    """

    camera: Camera
    steps: tuple[FrameStep, ...]
    notes: tuple[str, ...]


def plan_geometry(
    path: Path,
    messages: BagMessages,
    color: ImageTopic,
    depth: ImageTopic,
    given: ImageCamera | None,
    settings: GeometrySettings | None = None,
) -> BagGeometry:
    """Find the cameras of both topics and the steps that make frames of them.

    Args:
        path: of the bag, for error messages.
        messages: of the bag.
        color, depth: the two topics.
        given: the caller's camera of the colour images, which replaces their CameraInfo.
        settings: thresholds.

    Raises:
        ReaderError: colour has no camera, or depth is not registered and the bag lacks what registration needs.
    """
    settings = settings or GeometrySettings()
    choice = CameraChoice(given) if given else choose_camera(messages, color, related=(depth.name,))
    if choice.camera is None:
        reasons = "; ".join(choice.reasons) or "found: none"
        width, height = color.size
        raise ReaderError(f"{path}: no CameraInfo for {color.name} at {width}x{height} ({reasons}): give --intrinsics")
    found = choice.camera
    own = choose_camera(messages, depth)
    color_T_depth, origin = _relate(messages, color, depth)
    is_same = color_T_depth is not None and _is_identity(color_T_depth, settings)
    equal = own.camera is None or _equal(own.camera.camera, found.camera, settings)
    named = any(name in depth.name for name in REGISTERED_NAMES)
    if color.size == depth.size and equal and (is_same or named):
        return _on_color_pixels(found, color, depth, (), ())
    if color_T_depth is None:
        raise ReaderError(
            f"{path}: depth on {depth.name} is in frame {depth.frame}, colour in {color.frame}, and no transform "
            f"between them was recorded: {_ADVICE}"
        )
    if own.camera is None:
        if is_same and _same_aspect(color.size, depth.size, settings):
            note = f"depth of {_size(depth)} is resampled to colour's {_size(color)} by the nearest pixel"
            return _on_color_pixels(found, color, depth, (DepthAtColor(depth.size),), (note,))
        raise ReaderError(
            f"{path}: depth on {depth.name} is {_size(depth)}, colour {_size(color)}, and depth has no CameraInfo "
            f"{'(' + '; '.join(own.reasons) + ')' if own.reasons else ''}: {_ADVICE}"
        )
    steps: list[FrameStep] = []
    notes = [*found.notes, *own.camera.notes]
    if found.lens is not None:
        steps.append(Rectification(found.lens, found.camera, images="color"))
        notes.append(f"colour is undistorted ({found.lens.model} lens)")
    if own.camera.lens is not None:
        steps.append(Rectification(own.camera.lens, own.camera.camera, images="depth"))
        notes.append(f"depth is undistorted ({own.camera.lens.model} lens)")
    steps.append(DepthRegistration(own.camera.camera, found.camera, color_T_depth))
    distance = 100 * float(np.linalg.norm(color_T_depth[:3, 3]))
    notes.append(f"depth is registered to colour by {origin} and both CameraInfos ({distance:.1f} cm apart)")
    return BagGeometry(found.camera, tuple(steps), tuple(notes))


def _on_color_pixels(
    found: ImageCamera, color: ImageTopic, depth: ImageTopic, steps: tuple[FrameStep, ...], notes: tuple[str, ...]
) -> BagGeometry:
    """The geometry of depth that lies on the pixels of colour, after `steps`."""
    notes = (*found.notes, *notes)
    if found.lens is None:
        return BagGeometry(found.camera, steps, notes)
    # Depth that was registered to rectified colour may be recorded with raw colour.
    only_color = is_rectified(depth.name) and not is_rectified(color.name)
    steps = (*steps, Rectification(found.lens, found.camera, images="color" if only_color else "both"))
    what = "colour is" if only_color else "colour and depth are"
    return BagGeometry(found.camera, steps, (*notes, f"{what} undistorted ({found.lens.model} lens)"))


def _relate(messages: BagMessages, color: ImageTopic, depth: ImageTopic) -> tuple[Float64Array | None, str]:
    """`color_T_depth` and its origin; None if the frames differ and nothing relates them."""
    if not color.frame or not depth.frame or color.frame == depth.frame:
        return np.eye(4), "their common frame_id"
    tree = TransformTree()
    topics = [topic for topic, msgtype in messages.types.items() if msgtype in TRANSFORM_TYPES]
    # Static transforms come first: the first transform of two frames is kept.
    for topic in sorted(topics, key=lambda name: "static" not in name):
        for number in range(len(messages.stamps(topic))):
            try:
                tree.add(messages.read(topic, number))
            except ReaderError:
                continue
        color_T_depth = tree.find(color.frame, depth.frame)
        if color_T_depth is not None:
            return color_T_depth, topic
    for topic, msgtype in messages.types.items():
        if msgtype in EXTRINSICS_TYPES and topic.endswith("depth_to_color"):
            color_T_depth = extrinsics_matrix(messages.read(topic, 0))
            if color_T_depth is not None:
                return color_T_depth, topic
    return None, ""


def _is_identity(transform: Float64Array, settings: GeometrySettings) -> bool:
    offset = float(np.linalg.norm(transform[:3, 3]))
    return (
        offset <= settings.same_position
        and float(geometry.rotation_angle(transform[:3, :3])) <= settings.same_orientation
    )


def _equal(a: Camera, b: Camera, settings: GeometrySettings) -> bool:
    return (
        abs(a.fx / b.fx - 1) <= settings.same_focal
        and abs(a.fy / b.fy - 1) <= settings.same_focal
        and abs(a.cx - b.cx) <= settings.same_center
        and abs(a.cy - b.cy) <= settings.same_center
    )


def _same_aspect(a: tuple[int, int], b: tuple[int, int], settings: GeometrySettings) -> bool:
    return abs(a[0] * b[1] / (a[1] * b[0]) - 1) <= settings.same_aspect


def _size(topic: ImageTopic) -> str:
    return f"{topic.size[0]}x{topic.size[1]}"
