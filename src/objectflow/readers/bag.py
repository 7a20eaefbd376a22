"""RGB-D frames of a bag: colour and depth messages associated by time, with the camera of the colour topic."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.readers.bag_messages import BagMessages, open_messages
from objectflow.readers.bag_topics import choose_topics, find_camera
from objectflow.readers.options import DEFAULT_DEPTH_SCALE, CameraOptions
from objectflow.readers.ros_images import to_color, to_depth
from objectflow.readers.sequence import CutOffWarning
from objectflow.readers.tum import MAX_TIME_DIFFERENCE, associate


@dataclass(frozen=True, eq=False)
class BagSequence:
    """The frames of a bag in time order, decoded on access.

    Attributes:
        messages: the bag's messages.
        camera: of the colour images, to which depth must be registered.
        depth_scale: units per metre of integer depth.
        topics: of colour and depth.
        pairs: for each frame, the numbers of its colour and its depth message, and the colour stamp in seconds.
        cuts: ascending indices of the frames with which the time restarts; no pair crosses a cut.
        notes: corrections made when the bag was opened, one sentence each.
    """

    messages: BagMessages
    camera: Camera
    depth_scale: float
    topics: tuple[str, str]
    pairs: tuple[tuple[int, int, float], ...]
    cuts: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Decode a frame.

        Raises:
            ReaderError: a message is broken or is not an image of the expected kind.
            FrameError: the images do not make a valid frame or do not match the camera's size.
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
        """Stamp of the colour image's header, seconds."""
        return self.pairs[index][2]


def open_bag(
    path: Path,
    options: CameraOptions | None = None,
    *,
    color_topic: str | None = None,
    depth_topic: str | None = None,
) -> BagSequence:
    """Open a ROS 1 bag, a ROS 2 bag folder or an MCAP file.

    Args:
        path: the bag.
        options: a camera file or intrinsics override the bag's CameraInfo.
        color_topic, depth_topic: required where the bag has several.

    Raises:
        ReaderError: the path is not a bag, it has no or several colour or depth topics (the message lists them), the
            colour and depth stamps do not overlap, or there is no camera.
    """
    options = options or CameraOptions()
    if options.depth_scale is not None:
        check_depth_scale(options.depth_scale)
    messages = open_messages(path)
    if messages.cut_off:
        warnings.warn(CutOffWarning(f"{path}: cut off in the middle: only its complete part is read"), stacklevel=2)
    color, depth = choose_topics(path, messages, color_topic, depth_topic)
    pairs = _associate(path, messages, color, depth)
    camera = find_camera(path, messages, (color, depth), options, pairs[0][0])
    return BagSequence(messages, camera, options.depth_scale or DEFAULT_DEPTH_SCALE, (color, depth), tuple(pairs))


def _associate(path: Path, messages: BagMessages, color: str, depth: str) -> list[tuple[int, int, float]]:
    """Pair colour and depth messages by their header stamps."""
    stamps = [np.array(messages.stamps(topic)) / 1e9 for topic in (color, depth)]
    orders = [np.argsort(times, kind="stable") for times in stamps]
    ordered = [times[order] for times, order in zip(stamps, orders, strict=True)]
    found = associate(ordered[0].tolist(), ordered[1].tolist())
    if not found:
        offset = float(np.median(ordered[1]) - np.median(ordered[0]))
        raise ReaderError(
            f"{path}: no {color} message lies within {MAX_TIME_DIFFERENCE} s of a {depth} message: their clocks are "
            f"{offset:+.3f} s apart: record both with the same clock"
        )
    return [(int(orders[0][i]), int(orders[1][j]), float(ordered[0][i])) for i, j in found]
