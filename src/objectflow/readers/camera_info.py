"""From `sensor_msgs/CameraInfo` to the camera of an image: intrinsics, crop, binning and lens.

K and D describe the raw image of the full sensor, P the rectified one. An image may be a region of interest of the
sensor, and may be binned; the message then still describes the full sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow.errors import CameraError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers.lens import Lens, make_lens


@dataclass(frozen=True)
class ImageCamera:
    """The camera of an image as it is stored.

    Attributes:
        camera: its pinhole intrinsics.
        lens: its distortion; None if the image is rectified, or its lens has none.
        notes: corrections of the message, one sentence each.
    """

    camera: Camera
    lens: Lens | None = None
    notes: tuple[str, ...] = ()


def is_valid_info(info: Any) -> bool:
    """Whether a message holds intrinsics; an uncalibrated camera publishes zeros."""
    K = _matrix(info, "k", 9)
    return K is not None and K[0] > 0 and K[4] != 0


def frame_name(frame_id: str) -> str:
    """A frame_id without the leading slash of early ROS versions."""
    return str(frame_id).strip().lstrip("/")


def info_frame(info: Any) -> str:
    """The frame_id of a message."""
    return frame_name(info.header.frame_id)


def is_rectified(topic: str) -> bool:
    """Whether the name of an image topic says that it is rectified, as `image_rect_color` does."""
    return any("rect" in level for level in topic.lower().split("/")[-3:])


def image_camera(info: Any, size: tuple[int, int], *, rectified: bool, topic: str) -> ImageCamera:
    """The camera of an image that a `CameraInfo` belongs to.

    Args:
        info: a valid message.
        size: (width, height) of the image in pixels.
        rectified: whether the image is rectified: P is used instead of K, and D is ignored.
        topic: of the message, for error messages.

    Raises:
        ReaderError: the image has neither the size of the camera nor that of its region or binned image, or the values
            make no camera.
    """
    K, P = _matrix(info, "k", 9), _matrix(info, "p", 12)
    assert K is not None  # a valid message has K
    fx, cx, fy, cy = K[0], K[2], K[4], K[5]
    if rectified and P is not None and P[0] > 0:
        fx, cx, fy, cy = P[0], P[2], P[5], P[6]
    scaled = crop_and_bin(info, size, (cx, cy), topic)
    (bin_x, bin_y), (x, y), notes = scaled
    try:
        camera = Camera(*size, fx / bin_x, fy / bin_y, (cx - x) / bin_x, (cy - y) / bin_y)
        lens = None if rectified else make_lens(str(info.distortion_model), _distortion(info))
    except CameraError as error:
        raise ReaderError(f"{topic}: {error}: give --intrinsics") from error
    return ImageCamera(camera, lens, notes)


def crop_and_bin(
    info: Any, size: tuple[int, int], center: tuple[float, float], topic: str
) -> tuple[tuple[int, int], tuple[int, int], tuple[str, ...]]:
    """How an image of `size` was cut out of the sensor, by a message's region of interest and binning.

    Args:
        info: the message, or an object with its `width`, `height`, `binning_x`, `binning_y` and `roi`.
        size: (width, height) of the image.
        center: the principal point on the sensor.
        topic: start of notes and messages.

    Returns:
        Binning factors, offset of the region of interest in sensor pixels, and notes on the message.

    Raises:
        ReaderError: the message does not describe an image of this size.
    """
    full = int(info.width), int(info.height)
    binning = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    offset = int(info.roi.x_offset), int(info.roi.y_offset)
    region = int(info.roi.width) or full[0], int(info.roi.height) or full[1]
    is_full = offset == (0, 0) and region == full
    if full == (0, 0):
        return (1, 1), (0, 0), (f"{topic} has no image size: its intrinsics are taken for {size[0]}x{size[1]}",)
    if size == full and not is_full and region == full:
        # The driver states the size of the crop in place of that of the sensor; K is that of the sensor if the crop
        # then has its principal point nearer to its centre.
        shifted = center[0] - offset[0], center[1] - offset[1]
        if _distance(shifted, size) < _distance(center, size):
            return (1, 1), offset, (f"{topic} states the size of its region of interest: its offset is subtracted",)
        return (1, 1), (0, 0), ()
    if size == binned(region, binning):
        return binning, offset, ()
    if size == full:
        note = f"{topic} states binning by {binning[0]}x{binning[1]}, but the size of the image: K is used as it is"
        return (1, 1), (0, 0), (note,) if binning != (1, 1) else ()
    if size == binned(full, binning):
        return binning, (0, 0), ()
    raise ReaderError(f"{topic}: the camera is {full[0]}x{full[1]}, the image {size[0]}x{size[1]}: give --intrinsics")


def binned(size: tuple[int, int], binning: tuple[int, int]) -> tuple[int, int]:
    """The size of a binned image, in pixels."""
    return size[0] // binning[0], size[1] // binning[1]


def _distance(center: tuple[float, float], size: tuple[int, int]) -> float:
    """Distance of a principal point from the centre of the image, pixels."""
    return float(np.hypot(center[0] - size[0] / 2, center[1] - size[1] / 2))


def _matrix(info: Any, name: str, length: int) -> list[float] | None:
    """The values of a matrix, whose name is in capitals in ROS 1; None if they are not finite."""
    values = np.asarray(getattr(info, name.upper(), None) if hasattr(info, name.upper()) else getattr(info, name))
    values = values.astype(np.float64).ravel()
    return values.tolist() if len(values) == length and np.isfinite(values).all() else None


def _distortion(info: Any) -> tuple[float, ...]:
    values = info.D if hasattr(info, "D") else info.d
    return tuple(float(value) for value in values)
