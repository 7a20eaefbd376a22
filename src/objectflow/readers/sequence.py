"""`FrameSequence`: what every reader returns, frames read one by one when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from objectflow.frame import Camera, RgbdFrame


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
