"""`FrameSource`, the interface of every reader, and `FrameSequence`, its implementation for image files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera


class CutOffWarning(UserWarning):
    """A recording is truncated; only its complete part is read."""


class FrameSource(Protocol):
    """The frames of one camera in time order, read on access."""

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        ...

    @property
    def depth_scale(self) -> float:
        """Depth units per metre."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> RgbdFrame: ...

    def __iter__(self) -> Iterator[RgbdFrame]: ...

    def timestamp(self, index: int, /) -> float | None:
        """Time of a frame in seconds, without reading it; None where the source has no times."""
        ...


@dataclass(frozen=True)
class FramePaths:
    """The two files of a frame, and its time in seconds where the source has one."""

    color: Path
    depth: Path
    timestamp: float | None = None


@dataclass(frozen=True)
class FrameSequence:
    """The frames of one camera in time order; nothing is kept in memory.

    Attributes:
        paths: the files of each frame.
        camera: the camera of all frames.
        depth_scale: depth units per metre.
    """

    paths: tuple[FramePaths, ...]
    camera: Camera
    depth_scale: float

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read a frame from disk.

        Raises:
            ReaderError: a file is missing, broken or of the wrong kind.
            FrameError: the images do not make a valid frame or do not match the camera's size.
        """
        files = self.paths[index]
        return RgbdFrame.read(
            files.color, files.depth, camera=self.camera, depth_scale=self.depth_scale, timestamp=files.timestamp
        )

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float | None:
        """Time of a frame in seconds, without reading it; None where the source has no times."""
        return self.paths[index].timestamp
