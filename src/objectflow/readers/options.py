"""The caller's settings of a source: its camera, its depth and the pairing of colour and depth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.readers.camera_files import find_camera_file, read_camera_file
from objectflow.readers.camera_values import CameraValues, check_upright
from objectflow.readers.lens import Lens

NUMBERS = (int, float, np.integer, np.floating)
"""Types of the numbers that callers may give."""
DEFAULT_DEPTH_SCALE = 1000.0
"""Default units per metre of integer depth; most depth cameras write millimetres."""

NAMED_CAMERAS: dict[str, Camera] = {
    "fr1": Camera(width=640, height=480, fx=517.3, fy=516.5, cx=318.6, cy=255.3),
    "fr2": Camera(width=640, height=480, fx=520.9, fy=521.0, cx=325.1, cy=249.7),
    "fr3": Camera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6),
}
"""The three colour cameras of the TUM RGB-D benchmark, from its file-format page."""


class CameraSetup(NamedTuple):
    """A camera and how depth is stored.

    Attributes:
        camera: of the images.
        depth_scale: units per metre of integer depth.
        float_depth_scale: units per metre of floating-point depth.
        lens: the distortion of the images; None where there is none.
        note: what the camera file was taken to mean; empty where that is clear.
    """

    camera: Camera
    depth_scale: float
    float_depth_scale: float = 1.0
    lens: Lens | None = None
    note: str = ""


@dataclass(frozen=True)
class CameraOptions:
    """Settings of the caller; a camera or scale that is None is read from the camera file beside the images.

    Attributes:
        camera_file: a camera file of any form of `readers.camera_files`, or a name of `NAMED_CAMERAS`.
        intrinsics: fx, fy, cx, cy in pixels, at the size of the images.
        depth_scale: units per metre of integer and of floating-point depth; None for the file's or the layout's scale
            of integers, and for metres of floating-point depth.
        max_depth: depth beyond it is missing, metres; None for no limit.
        max_lag: longest time between a colour image and its depth image, seconds; None for the reader's own limit.
    """

    camera_file: Path | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None
    max_depth: float | None = None
    max_lag: float | None = None

    def __post_init__(self) -> None:
        for name in ("max_depth", "max_lag"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, NUMBERS) and 0 < value < float("inf")):
                raise ReaderError(f"{name} must be a positive number, not {value}")
        if self.intrinsics is not None and not (
            isinstance(self.intrinsics, Sequence)
            and len(self.intrinsics) == 4
            and all(isinstance(value, NUMBERS) for value in self.intrinsics)
        ):
            raise ReaderError(f"intrinsics must be four numbers, fx fy cx cy, not {self.intrinsics!r}")

    def to_dict(self) -> dict[str, Any]:
        """The options as JSON values, with an absolute path of the camera file."""
        file = self.camera_file
        named = None if file is None else str(file if self._is_named() else file.resolve())
        return {**dataclasses.asdict(self), "camera_file": named, "intrinsics": self.intrinsics and [*self.intrinsics]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> CameraOptions:
        """The options of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: values that `to_dict` does not make.
        """
        file, intrinsics = values["camera_file"], values["intrinsics"]
        numbers = (values[name] for name in ("depth_scale", "max_depth", "max_lag"))
        scale, depth, lag = (None if value is None else float(value) for value in numbers)
        four = None if intrinsics is None else (*map(float, intrinsics),)
        return cls(None if file is None else Path(file), four, scale, depth, lag)  # type: ignore[arg-type]

    @property
    def has_camera(self) -> bool:
        """Whether the caller gives a camera."""
        return self.camera_file is not None or self.intrinsics is not None

    def fit(
        self,
        size: tuple[int, int],
        folder: Path,
        image: str = "the image",
        default_scale: float = DEFAULT_DEPTH_SCALE,
        default_camera: CameraValues | None = None,
    ) -> CameraSetup:
        """Find the camera of images of one size.

        Args:
            size: (width, height) of the images, which the camera must have.
            folder: may hold a camera file.
            image: an image of the source, for messages.
            default_scale: units per metre of integer depth if neither the caller nor the file sets them.
            default_camera: the camera of the layout, if neither the caller nor a file gives one.

        Raises:
            ReaderError: there is no camera, two cameras are given, the camera has another image size, or a file
                cannot be read.
            CameraError: invalid intrinsics.
            FrameError: invalid depth scale.
        """
        if self.camera_file is not None and self.intrinsics is not None:
            raise ReaderError("both a camera file and intrinsics are given: leave one out")
        if self.depth_scale is not None:
            check_depth_scale(self.depth_scale)
        width, height = size
        values: CameraValues | None = None
        where = ""
        if self.intrinsics is not None:
            check_upright(*self.intrinsics, "--intrinsics")
            fx, fy, cx, cy = self.intrinsics
            camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        elif self.camera_file is not None and self._is_named():
            where, camera = str(self.camera_file), NAMED_CAMERAS[str(self.camera_file)]
        else:
            where, values = self._read_file(folder, default_camera)
            camera = values.camera(size, where)
        if (camera.width, camera.height) != (width, height):
            raise ReaderError(
                f"{where}: the camera is {camera.width}x{camera.height}, "
                f"but {image} is {width}x{height}: give the intrinsics of that size"
            )
        scale = self.depth_scale or (values and values.depth_scale) or default_scale
        lens, note = (None, "") if values is None else (values.lens(where), values.note)
        return CameraSetup(camera, scale, self.depth_scale or 1.0, lens, note)

    def _is_named(self) -> bool:
        return (
            str(self.camera_file) in NAMED_CAMERAS and self.camera_file is not None and not self.camera_file.exists()
        )

    def _read_file(self, folder: Path, default: CameraValues | None) -> tuple[str, CameraValues]:
        path = self.camera_file or find_camera_file(folder)
        if path is not None:
            return str(path), read_camera_file(path)
        if default is not None:
            return str(folder), default
        raise ReaderError(
            f"{folder}: no camera.json in this folder, and no other camera file: give --camera-file FILE (or "
            f"{', '.join(NAMED_CAMERAS)} for the TUM cameras) or --intrinsics fx fy cx cy"
        )
