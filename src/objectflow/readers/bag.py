"""RGB-D frames of a bag: which topics, which colour with which depth, and through which camera."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import CameraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.readers.bag_messages import BagMessages, open_messages
from objectflow.readers.options import DEFAULT_DEPTH_SCALE, CameraOptions
from objectflow.readers.ros_images import is_depth, to_color, to_depth
from objectflow.readers.sequence import CutOffWarning
from objectflow.readers.tum import MAX_TIME_DIFFERENCE, associate

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
REALSENSE = "/device_"
"""What the topics of a RealSense driver's own recordings start with; their depth is never aligned."""


@dataclass(frozen=True, eq=False)
class BagSequence:
    """The frames of a bag in order of time, decoded when they are asked for.

    Attributes:
        camera: of the colour images, to which depth must be registered.
        depth_scale: units a metre of whole-number depth.
        topics: of colour and depth.
        pairs: numbers of the colour and the depth message of each frame, and the colour's seconds.
    """

    messages: BagMessages
    camera: Camera
    depth_scale: float
    topics: tuple[str, str]
    pairs: tuple[tuple[int, int, float], ...]

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Decode a frame.

        Raises:
            ReaderError: a message that is broken, or no image of its kind.
            FrameError: images that make no frame, or are not of the camera's size.
        """
        color_number, depth_number, seconds = self.pairs[index]
        color_topic, depth_topic = self.topics
        color = to_color(self.messages.read(color_topic, color_number), color_topic)
        depth = to_depth(self.messages.read(depth_topic, depth_number), depth_topic, self.depth_scale)
        if depth.shape != color.shape[:2]:
            (h, w), (height, width) = depth.shape, color.shape[:2]
            raise ReaderError(
                f"{depth_topic}: depth is {w}x{h}, colour {width}x{height}: "
                "record depth registered to colour (aligned_depth_to_color, depth_registered)"
            )
        return RgbdFrame(color, depth, self.camera, timestamp=seconds, name=f"{depth_topic} at {seconds:.3f} s")

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float:
        """Seconds, from the colour image's header."""
        return self.pairs[index][2]


def open_bag(
    path: Path,
    options: CameraOptions | None = None,
    *,
    color_topic: str | None = None,
    depth_topic: str | None = None,
) -> BagSequence:
    """Open a ROS 1 bag, a ROS 2 bag's folder, or an MCAP file.

    Args:
        path: the bag.
        options: a camera file or intrinsics win over the bag's CameraInfo.
        color_topic, depth_topic: where there are several.

    Raises:
        ReaderError: no bag; no, or several, colour or depth topics (they are listed); times that do not fit; no
            camera.
    """
    options = options or CameraOptions()
    if options.depth_scale is not None:
        check_depth_scale(options.depth_scale)
    messages = open_messages(path)
    if messages.cut_off:
        warnings.warn(CutOffWarning(f"{path}: cut off in the middle: what is whole is used"), stacklevel=2)
    kinds = _kinds(messages)
    if color_topic is None and depth_topic is None and kinds and all(topic.startswith(REALSENSE) for topic in kinds):
        raise ReaderError(
            f"{path}: a recording of the RealSense driver, whose depth is not aligned to colour: "
            f"`objectflow live realsense:{path}` aligns it"
        )
    color = _choose(path, kinds, color_topic, depth=False)
    depth = _choose(path, kinds, depth_topic, depth=True)
    pairs = _associate(path, messages, color, depth)
    camera = _camera(path, messages, color, depth, options, pairs[0][0])
    return BagSequence(messages, camera, options.depth_scale or DEFAULT_DEPTH_SCALE, (color, depth), tuple(pairs))


def _kinds(messages: BagMessages) -> dict[str, bool]:
    """Every image topic with messages, and whether it holds depth: told by its first message."""
    kinds = {}
    for topic, msgtype in sorted(messages.types.items()):
        if msgtype in IMAGES and messages.stamps(topic):
            holds_depth = is_depth(messages.read(topic, 0))
            if holds_depth is not None:
                kinds[topic] = holds_depth
    return kinds


def _choose(path: Path, kinds: dict[str, bool], wanted: str | None, *, depth: bool) -> str:
    """The topic asked for, or the only one there is."""
    name, flag = ("depth", "--depth-topic") if depth else ("colour", "--color-topic")
    choices = [topic for topic, holds_depth in kinds.items() if holds_depth == depth]
    listed = " ".join(f"{flag} {topic}" for topic in choices) or "none"
    if wanted is not None:
        if wanted not in kinds:
            raise ReaderError(f"{path}: no images on {wanted}; {name} topics: {listed}")
        return wanted
    if not choices:
        others = ", ".join(kinds) or "none at all"
        raise ReaderError(f"{path}: no {name} images (16UC1 or 32FC1 is depth); image topics: {others}")
    if len(choices) > 1:
        raise ReaderError(f"{path}: several {name} topics, choose one: {listed}")
    return choices[0]


def _associate(path: Path, messages: BagMessages, color: str, depth: str) -> list[tuple[int, int, float]]:
    """Colour and depth messages of one moment, by the stamps in their headers."""
    stamps = [np.array(messages.stamps(topic)) / 1e9 for topic in (color, depth)]
    orders = [np.argsort(times, kind="stable") for times in stamps]
    ordered = [times[order] for times, order in zip(stamps, orders, strict=True)]
    found = associate(ordered[0].tolist(), ordered[1].tolist())
    if not found:
        apart = float(np.median(ordered[1]) - np.median(ordered[0]))
        raise ReaderError(
            f"{path}: no {color} lies within {MAX_TIME_DIFFERENCE} s of a {depth}: their clocks are "
            f"{apart:+.3f} s apart: record both with one clock"
        )
    return [(int(orders[0][i]), int(orders[1][j]), float(ordered[0][i])) for i, j in found]


def _camera(path: Path, messages: BagMessages, color: str, depth: str, options: CameraOptions, first: int) -> Camera:
    """The camera asked for, or the CameraInfo nearest by name to the colour topic, then to the depth topic."""
    height, width = to_color(messages.read(color, first), color).shape[:2]
    if options.camera_file is not None or options.intrinsics is not None:
        return options.fit((width, height), path.parent, color).camera
    infos = [topic for topic, msgtype in messages.types.items() if msgtype == INFO and messages.stamps(topic)]
    for image in (color, depth):
        for topic in sorted(infos, key=lambda info: -_shared(info, image)):
            info = messages.read(topic, 0)
            if (int(info.width), int(info.height)) == (width, height) and _shared(topic, image) > 0:
                return _from_info(info, topic)
    listed = ", ".join(infos) or "none"
    raise ReaderError(f"{path}: no CameraInfo for {color} at {width}x{height} (there is: {listed}): give --intrinsics")


def _shared(a: str, b: str) -> int:
    """How many leading parts two topics' names share."""
    count = 0
    for x, y in zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count


def _from_info(info: Any, topic: str) -> Camera:
    """K of a CameraInfo; ROS 1 writes it in capitals."""
    K = np.asarray(getattr(info, "K", None) if hasattr(info, "K") else info.k, dtype=np.float64).reshape(3, 3)
    try:
        return Camera(int(info.width), int(info.height), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    except CameraError as error:
        raise ReaderError(f"{topic}: {error}: give --intrinsics") from error
