"""RGB-D frames of a bag: colour and depth messages paired by time, on the pixels of one pinhole camera."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.readers.bag_camera import ImageTopic
from objectflow.readers.bag_geometry import plan_geometry
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.bag_times import pair_messages
from objectflow.readers.bag_topics import choose_topics
from objectflow.readers.camera_info import ImageCamera, frame_name
from objectflow.readers.options import DEFAULT_DEPTH_SCALE, CameraOptions
from objectflow.readers.ros_images import to_color, to_depth
from objectflow.readers.sequence import CutOffWarning, FrameStep
from objectflow.readers.tum import MAX_TIME_DIFFERENCE
from objectflow.typing import Float32Array, UInt8Array

MAX_BROKEN_IMAGES = 100
"""Number of images that are tried to find the size of a topic's images; if all are broken, so is the bag."""


@dataclass(frozen=True, eq=False)
class BagSequence:
    """The frames of a bag in the order of recording, decoded on access.

    Attributes:
        messages: the bag's messages.
        camera: of the frames.
        depth_scale: units per metre of integer depth.
        float_depth_scale: units per metre of floating-point depth.
        topics: of colour and depth.
        pairs: for each frame, the numbers of its colour and its depth message, and the colour stamp in seconds.
        max_depth: depth beyond it is missing, metres; None for no limit.
        steps: applied to colour and depth in metres after decoding: undistortion and registration.
        cuts: ascending indices of the frames with which the time restarts; no pair crosses a cut.
        notes: corrections made when the bag was opened, one sentence each.
    """

    messages: BagMessages
    camera: Camera
    depth_scale: float
    float_depth_scale: float
    topics: tuple[str, str]
    pairs: tuple[tuple[int, int, float], ...]
    max_depth: float | None = None
    steps: tuple[FrameStep, ...] = ()
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
        message = self.messages.read(depth_topic, depth_number)
        depth = to_depth(message, depth_topic, self.depth_scale, self.float_depth_scale, self.max_depth)
        for step in self.steps:
            color, depth = step(color, depth)
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
    """Open a ROS 1 bag, a ROS 2 bag, an MCAP file, or a folder with the files of one bag.

    Args:
        path: the bag.
        options: a camera file or intrinsics override the bag's CameraInfo of colour.
        color_topic, depth_topic: required where the bag has several.

    Raises:
        ReaderError: the path is not a bag, it has no or several colour or depth topics (the message lists them), the
            colour and depth stamps do not overlap, there is no camera, or depth is not registered to colour and the
            bag lacks what registration needs.
    """
    options = options or CameraOptions()
    if options.depth_scale is not None:
        check_depth_scale(options.depth_scale)
    messages = BagMessages(path)
    if messages.cut_off:
        warnings.warn(CutOffWarning(f"{path}: cut off in the middle: only its complete part is read"), stacklevel=2)
    topics = choose_topics(path, messages, color_topic, depth_topic)
    found = pair_messages(path, messages, *topics, options.max_lag or MAX_TIME_DIFFERENCE)
    color = _image_topic(messages, topics[0], [pair[0] for pair in found.pairs], to_color)
    depth = _image_topic(messages, topics[1], [pair[1] for pair in found.pairs], partial(to_depth, depth_scale=1.0))
    given = None
    depth_scale, float_depth_scale = options.depth_scale or DEFAULT_DEPTH_SCALE, options.depth_scale or 1.0
    if options.has_camera:
        setup = options.fit(color.size, path.parent, color.name)
        depth_scale, float_depth_scale = setup.depth_scale, setup.float_depth_scale
        given = ImageCamera(setup.camera, setup.lens, (setup.note,) if setup.note else ())
    plan = plan_geometry(path, messages, color, depth, given)
    return BagSequence(
        messages,
        plan.camera,
        depth_scale,
        float_depth_scale,
        topics,
        found.pairs,
        options.max_depth,
        plan.steps,
        found.cuts,
        (*messages.notes, *found.notes, *plan.notes),
    )


def _image_topic(
    messages: BagMessages,
    topic: str,
    numbers: list[int],
    decode: Callable[[Any, str], UInt8Array | Float32Array],
) -> ImageTopic:
    """Frame and image size of a topic, from its first image that can be decoded.

    Raises:
        ReaderError: none of the first images can be decoded.
    """
    first: ReaderError | None = None
    for number in numbers[:MAX_BROKEN_IMAGES]:
        try:
            message = messages.read(topic, number)
            height, width = decode(message, topic).shape[:2]
        except ReaderError as error:
            first = first or error
            continue
        return ImageTopic(topic, frame_name(message.header.frame_id), (width, height))
    raise first or ReaderError(f"{topic}: no image")
