"""The camera of a source: a file beside the images, a named camera or four intrinsics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.storage.images import read_color

DEFAULT_DEPTH_SCALE = 1000.0
"""Default depth units per metre; most depth cameras write millimetres."""

NAMED_CAMERAS: dict[str, Camera] = {
    "fr1": Camera(width=640, height=480, fx=517.3, fy=516.5, cx=318.6, cy=255.3),
    "fr2": Camera(width=640, height=480, fx=520.9, fy=521.0, cx=325.1, cy=249.7),
    "fr3": Camera(width=640, height=480, fx=535.4, fy=539.2, cx=320.1, cy=247.6),
}
"""The three colour cameras of the TUM RGB-D benchmark, from its file-format page."""


class CameraSetup(NamedTuple):
    """A camera and its depth units per metre."""

    camera: Camera
    depth_scale: float


@dataclass(frozen=True)
class CameraOptions:
    """Camera settings of the caller; a value that is None is read from the `camera.json` beside the images.

    Attributes:
        camera_file: a `camera.json`, or a name of `NAMED_CAMERAS`.
        intrinsics: fx, fy, cx, cy in pixels, at the size of the images.
        depth_scale: depth units per metre; overrides the camera file.
    """

    camera_file: Path | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None

    def resolve(self, folder: Path, first_color: Path, default_scale: float = DEFAULT_DEPTH_SCALE) -> CameraSetup:
        """Find the camera of a folder of images.

        Args:
            folder: may hold a `camera.json`.
            first_color: a colour image of the source, whose size the camera must have.
            default_scale: depth units per metre if neither the caller nor the file sets it.

        Raises:
            ReaderError: there is no camera, two cameras are given, the camera has another image size, or a file
                cannot be read.
            CameraError: invalid intrinsics.
            FrameError: invalid depth scale.
        """
        height, width = read_color(first_color).shape[:2]
        return self.fit((width, height), folder, str(first_color), default_scale)

    def fit(
        self, size: tuple[int, int], folder: Path, image: str = "the image", default_scale: float = DEFAULT_DEPTH_SCALE
    ) -> CameraSetup:
        """The camera of images of a size (width, height); other arguments and errors as for `resolve`."""
        if self.camera_file is not None and self.intrinsics is not None:
            raise ReaderError("both a camera file and intrinsics are given: leave one out")
        if self.depth_scale is not None:
            check_depth_scale(self.depth_scale)
        width, height = size
        if self.intrinsics is not None:
            fx, fy, cx, cy = self.intrinsics
            camera, scale = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy), None
        else:
            camera, scale = self._read_file(folder)
        if (camera.width, camera.height) != (width, height):
            raise ReaderError(
                f"{self.camera_file or folder / 'camera.json'}: the camera is {camera.width}x{camera.height}, "
                f"but {image} is {width}x{height}: give the intrinsics of that size"
            )
        return CameraSetup(camera, self.depth_scale or scale or default_scale)

    def _read_file(self, folder: Path) -> tuple[Camera, float | None]:
        path = self.camera_file
        if path is not None and str(path) in NAMED_CAMERAS and not path.exists():
            return NAMED_CAMERAS[str(path)], None
        if path is None:
            path = folder / "camera.json"
            if not path.exists():
                raise ReaderError(
                    f"{folder}: no camera.json in this folder: give --camera-file FILE (or {', '.join(NAMED_CAMERAS)} "
                    "for the TUM cameras) or --intrinsics fx fy cx cy"
                )
        try:
            return Camera.read(path)
        except OverflowError:
            # JSON integers are unbounded; floats are not.
            raise ReaderError(f"{path}: a number is too large for a camera") from None
