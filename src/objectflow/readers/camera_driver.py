"""Live depth cameras: what the driver of a kind of camera provides, and the stream of frames that all kinds share.

A driver is a page of code: it opens the camera, returns one pair of images at a time and closes it. Warm-up,
undistortion, units, unusable frames and errors are handled here.
"""

from __future__ import annotations

import contextlib
import importlib
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from numpy.typing import NDArray

from objectflow.errors import FrameError, MissingExtraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.readers.camera_info import ImageCamera
from objectflow.readers.rectify import Rectification
from objectflow.storage.image_files import to_metres
from objectflow.typing import UInt8Array

WARM_UP = 15
"""Number of initial frames that are skipped until the auto-exposure has converged."""
TIMEOUT_MS = 5000
"""Longest wait for a frame, milliseconds."""
MAX_UNUSABLE = 300
"""Number of consecutive unusable frames after which a camera is given up; 10 s at 30 frames per second."""


@dataclass(frozen=True)
class StreamRequest:
    """Which camera is opened, and what it is asked to deliver.

    Attributes:
        serial: serial number of the camera; None for the only one, or any.
        size: (width, height) of colour in pixels; None for the default of the driver.
        rate: frames per second; None for the default of the driver.
        max_depth: depth beyond it is missing, metres; None for no limit.
    """

    serial: str | None = None
    size: tuple[int, int] | None = None
    rate: int | None = None
    max_depth: float | None = None

    def __post_init__(self) -> None:
        if (self.size is not None and min(self.size) < 1) or (self.rate is not None and self.rate < 1):
            raise ReaderError("the size and the rate of a camera must be positive")


@dataclass(frozen=True, eq=False)
class CameraImages:
    """A colour image and the depth at its pixels, copied from the buffers of the camera's library.

    Attributes:
        color: (H, W, 3) uint8, RGB.
        depth: (H, W) integers or floating-point numbers, planar z.
        depth_scale: units of depth per metre.
        seconds: time of the colour image by the clock of the camera.
    """

    color: UInt8Array
    depth: NDArray[Any]
    depth_scale: float
    seconds: float


class CameraDriver(ABC):
    """A kind of camera. Its library may raise any of `errors` from any method.

    Attributes:
        title: name of the cameras in messages, such as "RealSense".
        errors: exceptions of the camera's library.
        distorted: images that lie on the pixels of the lens, if the camera has one: some libraries align depth to
            the pixels of an ideal pinhole camera.
    """

    title: ClassVar[str]
    errors: ClassVar[tuple[type[Exception], ...]] = (RuntimeError,)
    distorted: ClassVar[Literal["both", "color"]] = "both"

    @abstractmethod
    def open(self, request: StreamRequest) -> None:
        """Start the camera.

        Raises:
            ReaderError: the camera cannot deliver what is requested.
        """

    @abstractmethod
    def read(self) -> CameraImages:
        """Wait for the next images.

        Raises:
            TimeoutError: no images within `TIMEOUT_MS`.
            FrameError: these images are unusable, but the next ones may not be.
            ReaderError: the images are not of a kind that is supported.
        """

    @abstractmethod
    def camera(self) -> ImageCamera:
        """The camera model of the colour images; images have been read before.

        Raises:
            CameraError: values that make no camera, or a lens that is not known.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the camera, which may not have been started or may have been unplugged."""


def import_library(package: str, title: str, extra: str) -> Any:
    """Import the library of a kind of camera.

    Args:
        package: the module.
        title: of the cameras.
        extra: the extra that installs it.

    Raises:
        MissingExtraError: it is not installed, or lacks a system library.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"{title} cameras need {package}", extra) from error
    except ImportError as error:
        raise MissingExtraError(f"{package} is installed, but it lacks a system library: {error}") from error


def read_camera(driver: CameraDriver, request: StreamRequest | None = None) -> Generator[RgbdFrame, None, None]:
    """Yield the frames of a camera endlessly; closing the generator stops the camera.

    The first `WARM_UP` frames are skipped. Images of a lens are undistorted. Unusable frames, such as those without
    any depth, are left out.

    Raises:
        ReaderError: there is no camera, it does not deliver what is requested, it stopped delivering frames, or none
            of `MAX_UNUSABLE` consecutive frames was usable.
    """
    request = request or StreamRequest()
    failures: tuple[type[Exception], ...] = (TimeoutError, *driver.errors)
    try:
        try:
            driver.open(request)
        except failures as error:
            reason = " ".join(str(error).split())
            advice = "plug it in, close other programs that use it, or try another size"
            raise ReaderError(f"no {driver.title} camera ({reason}): {advice}") from error
        yield from _frames(driver, request.max_depth)
    finally:
        with contextlib.suppress(*driver.errors):  # it may have been unplugged
            driver.close()


def _frames(driver: CameraDriver, max_depth: float | None) -> Generator[RgbdFrame, None, None]:
    to_frame: _FrameMaker | None = None
    skipped = unusable = 0
    reason: FrameError | None = None
    failures: tuple[type[Exception], ...] = (TimeoutError, *driver.errors)
    while unusable < MAX_UNUSABLE:
        try:
            images = driver.read()
            if skipped < WARM_UP:
                skipped += 1
                continue
            to_frame = to_frame or _FrameMaker(driver, max_depth)
            frame = to_frame(images)
        except FrameError as error:
            unusable, reason = unusable + 1, error
            continue
        except failures as error:
            raise ReaderError(f"the {driver.title} camera stopped: {error}: is it still plugged in?") from error
        unusable = 0
        yield frame
    raise ReaderError(f"the {driver.title} camera delivered {unusable} unusable frames in a row: {reason}")


class _FrameMaker:
    """Makes frames of a camera's images: depth in metres, both images on the pixels of a pinhole camera."""

    def __init__(self, driver: CameraDriver, max_depth: float | None) -> None:
        image = driver.camera()
        self._camera = image.camera
        self._title = driver.title
        self._max_depth = max_depth
        self._rectification = (
            None if image.lens is None else Rectification(image.lens, image.camera, images=driver.distorted)
        )

    def __call__(self, images: CameraImages) -> RgbdFrame:
        """Make a frame.

        Raises:
            FrameError: the images do not make a valid frame.
        """
        color = images.color
        depth = to_metres(images.depth, depth_scale=images.depth_scale, max_depth=self._max_depth)
        if self._rectification is not None:
            color, depth = self._rectification(color, depth)
        name = f"{self._title} at {images.seconds:.3f} s"
        return RgbdFrame(color, depth, self._camera, timestamp=images.seconds, name=name)
