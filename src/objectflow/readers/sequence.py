"""`FrameSource`, the interface of every reader, and `FrameSequence`, its implementation for image files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.storage.image_files import read_color, read_depth, to_metres
from objectflow.typing import Float32Array, UInt8Array

FrameStep: TypeAlias = Callable[[UInt8Array, Float32Array], tuple[UInt8Array, Float32Array]]
"""A step between decoding and the frame, from (colour, depth in metres) to the same."""


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

    @property
    def cuts(self) -> tuple[int, ...]:
        """Ascending indices of the frames with which the time restarts; no pair crosses a cut."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """Corrections made when the source was opened, one sentence each."""
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
        depth_scale: units per metre of integer depth.
        float_depth_scale: units per metre of floating-point depth.
        max_depth: depth beyond it is missing, metres; None for no limit.
        steps: applied to colour and depth in metres after decoding.
        cuts: ascending indices of the frames with which the time restarts; no pair crosses a cut.
        notes: corrections made when the sequence was opened, one sentence each.
    """

    paths: tuple[FramePaths, ...]
    camera: Camera
    depth_scale: float
    float_depth_scale: float = 1.0
    max_depth: float | None = None
    steps: tuple[FrameStep, ...] = ()
    cuts: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read a frame from disk.

        Raises:
            ReaderError: a file is missing, broken or of the wrong kind.
            FrameError: the images do not make a valid frame or do not match the camera's size.
        """
        files = self.paths[index]
        color, raw = read_color(files.color), read_depth(files.depth)
        depth = to_metres(
            raw, depth_scale=self.depth_scale, float_depth_scale=self.float_depth_scale, max_depth=self.max_depth
        )
        for step in self.steps:
            color, depth = step(color, depth)
        return RgbdFrame(color, depth, self.camera, timestamp=files.timestamp, name=str(files.depth))

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float | None:
        """Time of a frame in seconds, without reading it; None where the source has no times."""
        return self.paths[index].timestamp
