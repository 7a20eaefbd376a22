"""Selection of a bag's colour and depth topics."""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ReaderError
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.bag_records import IMAGE_TYPES
from objectflow.readers.ros_images import is_depth

REALSENSE = "/device_"
"""Prefix of all topics in recordings of the RealSense driver, whose depth is not aligned to colour."""
MAX_BROKEN_MESSAGES = 20
"""Number of messages that are tried to find out whether a topic holds depth."""


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


def _classify(messages: BagMessages) -> dict[str, bool]:
    """Every image topic that has messages, and whether its first readable message holds depth."""
    holds_depth = {}
    for topic, msgtype in sorted(messages.types.items()):
        if msgtype not in IMAGE_TYPES:
            continue
        for number in range(min(MAX_BROKEN_MESSAGES, len(messages.stamps(topic)))):
            try:
                depth = is_depth(messages.read(topic, number))
            except ReaderError:
                continue
            if depth is not None:
                holds_depth[topic] = depth
                break
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
