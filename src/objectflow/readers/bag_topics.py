"""Selection of a bag's colour and depth topics, and of the CameraInfo that belongs to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import CameraError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.options import CameraOptions
from objectflow.readers.ros_images import is_depth, to_color

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
REALSENSE = "/device_"
"""Prefix of all topics in recordings of the RealSense driver, whose depth is not aligned to colour."""


def choose_topics(path: Path, messages: BagMessages, color: str | None, depth: str | None) -> tuple[str, str]:
    """The colour and the depth topic: as requested, or the only ones in the bag.

    Args:
        path: the bag, for error messages.
        messages: its messages.
        color, depth: requested topics.

    Raises:
        ReaderError: a topic is missing or ambiguous, or the bag is a recording of the RealSense driver.
    """
    holds_depth = _classify(messages)
    if color is None and depth is None and holds_depth and all(topic.startswith(REALSENSE) for topic in holds_depth):
        raise ReaderError(
            f"{path}: a recording of the RealSense driver, whose depth is not aligned to colour: "
            f"`objectflow live realsense:{path}` aligns it"
        )
    return _choose(path, holds_depth, color, depth=False), _choose(path, holds_depth, depth, depth=True)


def find_camera(
    path: Path, messages: BagMessages, topics: tuple[str, str], options: CameraOptions, first: int
) -> Camera:
    """The requested camera, or the CameraInfo whose topic name is closest to the colour topic, then the depth topic.

    Args:
        path: the bag.
        messages: its messages.
        topics: of colour and depth.
        options: a camera file or intrinsics override the bag's CameraInfo.
        first: number of the first colour message that belongs to a frame.

    Raises:
        ReaderError: no CameraInfo matches the images, or its values are invalid.
    """
    color = topics[0]
    height, width = to_color(messages.read(color, first), color).shape[:2]
    if options.camera_file is not None or options.intrinsics is not None:
        return options.fit((width, height), path.parent, color).camera
    infos = [topic for topic, msgtype in messages.types.items() if msgtype == INFO and messages.stamps(topic)]
    for image in topics:
        for topic in sorted(infos, key=lambda info: -_shared_levels(info, image)):
            info = messages.read(topic, 0)
            if (int(info.width), int(info.height)) == (width, height) and _shared_levels(topic, image) > 0:
                return _from_info(info, topic)
    listed = ", ".join(infos) or "none"
    raise ReaderError(f"{path}: no CameraInfo for {color} at {width}x{height} (found: {listed}): give --intrinsics")


def _classify(messages: BagMessages) -> dict[str, bool]:
    """Every image topic that has messages, and whether its first message holds depth."""
    holds_depth = {}
    for topic, msgtype in sorted(messages.types.items()):
        if msgtype in IMAGES and messages.stamps(topic):
            depth = is_depth(messages.read(topic, 0))
            if depth is not None:
                holds_depth[topic] = depth
    return holds_depth


def _choose(path: Path, holds_depth: dict[str, bool], requested: str | None, *, depth: bool) -> str:
    name, flag = ("depth", "--depth-topic") if depth else ("colour", "--color-topic")
    choices = [topic for topic, is_depth_topic in holds_depth.items() if is_depth_topic == depth]
    listed = " ".join(f"{flag} {topic}" for topic in choices) or "none"
    if requested is not None:
        if requested not in holds_depth:
            raise ReaderError(f"{path}: no images on {requested}; {name} topics: {listed}")
        return requested
    if not choices:
        others = ", ".join(holds_depth) or "none"
        raise ReaderError(f"{path}: no {name} images (16UC1 or 32FC1 is depth); image topics: {others}")
    if len(choices) > 1:
        raise ReaderError(f"{path}: several {name} topics, choose one: {listed}")
    return choices[0]


def _shared_levels(a: str, b: str) -> int:
    """Number of leading name levels that two topics share."""
    count = 0
    for x, y in zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count


def _from_info(info: Any, topic: str) -> Camera:
    """The camera of a CameraInfo message, whose matrix is called K in ROS 1 and k in ROS 2."""
    K = np.asarray(getattr(info, "K", None) if hasattr(info, "K") else info.k, dtype=np.float64).reshape(3, 3)
    try:
        return Camera(int(info.width), int(info.height), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    except CameraError as error:
        raise ReaderError(f"{topic}: {error}: give --intrinsics") from error
