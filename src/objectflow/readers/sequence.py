"""`FrameSource`: what every reader returns; `FrameSequence`: the one for image files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera


class CutOffWarning(UserWarning):
    """A recording ends in the middle; what is whole is used."""


class FrameSource(Protocol):
    """The frames of one camera in order of time, read one by one when they are asked for."""

    @property
    def camera(self) -> Camera:
        """The camera of all frames."""
        ...

    @property
    def depth_scale(self) -> float:
        """Depth units a metre."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> RgbdFrame: ...

    def __iter__(self) -> Iterator[RgbdFrame]: ...

    def timestamp(self, index: int, /) -> float | None:
        """Seconds, without reading the frame; None where the source has no times."""
        ...


@dataclass(frozen=True)
class FramePaths:
    """The two files of a frame and, where the source has one, its time in seconds."""

    color: Path
    depth: Path
    timestamp: float | None = None


@dataclass(frozen=True)
class FrameSequence:
    """The frames of one camera in the order of time; nothing is kept in memory.

    Attributes:
        paths: the files of each frame.
        camera: the camera of all frames.
        depth_scale: depth units a metre.
    """

    paths: tuple[FramePaths, ...]
    camera: Camera
    depth_scale: float

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read a frame from the disk.

        Raises:
            ReaderError: a file that is missing, broken or of the wrong kind.
            FrameError: images that make no frame, or are not of the camera's size.
        """
        files = self.paths[index]
        return RgbdFrame.read(
            files.color, files.depth, camera=self.camera, depth_scale=self.depth_scale, timestamp=files.timestamp
        )

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float | None:
        """Seconds, without reading the frame; None where the source has no times."""
        return self.paths[index].timestamp
