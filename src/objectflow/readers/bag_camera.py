"""Selection of the CameraInfo that belongs to an image topic: by its name and its frame_id."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from objectflow.errors import ReaderError
from objectflow.readers.bag_messages import BagMessages
from objectflow.readers.bag_records import INFO_TYPE
from objectflow.readers.camera_info import ImageCamera, image_camera, info_frame, is_rectified, is_valid_info

_TRANSPORTS = ("compressed", "compressedDepth")


@dataclass(frozen=True)
class ImageTopic:
    """An image topic of a bag.

    Attributes:
        name: of the topic.
        frame: frame_id of its images, without a leading slash; empty if they have none.
        size: (width, height) of its images.
    """

    name: str
    frame: str
    size: tuple[int, int]


@dataclass(frozen=True)
class CameraChoice:
    """The camera of an image topic, or why there is none.

    Attributes:
        camera: None if no CameraInfo belongs to the images.
        topic: of the chosen CameraInfo.
        reasons: why other CameraInfos were refused.
    """

    camera: ImageCamera | None
    topic: str = ""
    reasons: tuple[str, ...] = ()


def choose_camera(messages: BagMessages, image: ImageTopic, related: tuple[str, ...] = ()) -> CameraChoice:
    """Choose the CameraInfo of an image topic: its sibling by name, then one of the same frame_id.

    Args:
        messages: of the bag.
        image: the image topic.
        related: image topics on the same pixels, whose siblings are preferred among those of the same frame_id.
    """
    siblings = sibling_names(image.name)
    preferred = [*siblings, *(name for topic in related for name in sibling_names(topic))]
    infos = [topic for topic, msgtype in messages.types.items() if msgtype == INFO_TYPE]
    rest = sorted((topic for topic in infos if topic not in preferred), key=lambda t: -shared_levels(t, image.name))
    reasons: list[str] = []
    doubtful: list[tuple[str, ImageCamera]] = []
    for topic in [name for name in preferred if name in infos] + rest:
        info, changes = _first_valid(messages, topic)
        if info is None:
            reasons.append(f"{topic} holds no intrinsics")
            continue
        frame = info_frame(info)
        is_named = bool(frame and image.frame)
        if is_named and frame != image.frame and topic not in siblings:
            reasons.append(f"{topic} is of frame {frame}")
            continue
        if not is_named and topic not in siblings and not shared_levels(topic, image.name):
            continue
        try:
            found = image_camera(info, image.size, rectified=is_rectified(image.name), topic=topic)
        except ReaderError as error:
            reasons.append(str(error))
            continue
        notes = found.notes
        if changes:
            notes += (f"{topic} changes during the recording: its first valid message is used",)
        found = ImageCamera(found.camera, found.lens, notes)
        if is_named and frame != image.frame:
            doubtful.append((topic, found))
            continue
        return CameraChoice(found, topic)
    if doubtful:
        topic, found = doubtful[0]
        note = f"{topic} belongs to {image.name} by its name, although its frame_id is another"
        return CameraChoice(ImageCamera(found.camera, found.lens, (*found.notes, note)), topic)
    return CameraChoice(None, reasons=tuple(reasons))


def sibling_names(topic: str) -> tuple[str, ...]:
    """Names of the CameraInfo beside an image topic: that of image_transport, then that of RealSense recordings."""
    levels = topic.split("/")
    if levels[-1] in _TRANSPORTS:
        levels = levels[:-1]
    sibling = "/".join([*levels[:-1], "camera_info"])
    if levels[-2:] == ["image", "data"]:
        return sibling, "/".join([*levels[:-2], "info", "camera_info"])
    return (sibling,)


def shared_levels(a: str, b: str) -> int:
    """Number of leading name levels that two topics share."""
    count = 0
    for x, y in zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count


def _first_valid(messages: BagMessages, topic: str) -> tuple[Any, bool]:
    """The first message with intrinsics (None if there is none), and whether later ones differ from it.

    Messages that equal the one before them are not kept by the scan.
    """
    first, values = None, None
    for number in range(len(messages.stamps(topic))):
        try:
            info = messages.read(topic, number)
        except ReaderError:
            continue
        if not is_valid_info(info):
            continue
        found = _values(info)
        if first is None:
            first, values = info, found
        elif found != values:
            return first, True
    return first, False


def _values(info: Any) -> tuple[Any, ...]:
    """What a camera depends on."""
    K = info.K if hasattr(info, "K") else info.k
    D = info.D if hasattr(info, "D") else info.d
    roi = info.roi
    region = (roi.x_offset, roi.y_offset, roi.width, roi.height)
    return (*K, *D, info.width, info.height, info.binning_x, info.binning_y, *region)
