"""Recordings of Record3D (iPhone and iPad): an exported folder, or an `.r3d` file.

Both hold JPEG or PNG colour, float32 depth in metres and a `metadata` file with the camera of colour. Depth has a
lower resolution and the same field of view. An `.r3d` file is a ZIP archive whose depth is compressed by LZFSE.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import CameraError, MissingExtraError, ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.resample import resize_nearest
from objectflow.readers.assemble import Layout
from objectflow.readers.camera_mappings import from_mapping
from objectflow.readers.folder import find_images, open_images
from objectflow.readers.options import CameraOptions
from objectflow.readers.sequence import FrameSequence
from objectflow.storage.coded_images import check_complete, coded_size, decode
from objectflow.storage.foreign import foreign_errors
from objectflow.storage.image_files import check_pixels, to_metres
from objectflow.typing import Float32Array, UInt8Array

METADATA = ("metadata", "metadata.json")
SUFFIX = ".r3d"
MAX_MEMBER_BYTES = 1 << 28
"""Largest member of an archive, in bytes when it is decompressed."""
MAX_BLOCKS = 1 << 16
"""Largest number of LZFSE blocks of a depth image; the encoder writes blocks of tens of kilobytes."""
_FRAME = re.compile(r"rgbd/([0-9]{1,9})\.(jpg|depth)")


def is_record3d(path: Path) -> bool:
    """Whether a path is an `.r3d` file or an exported folder."""
    if path.is_file():
        return path.suffix.lower() == SUFFIX
    return (path / "rgb").is_dir() and (path / "depth").is_dir() and _metadata(path) is not None


def open_record3d(path: Path, options: CameraOptions | None = None) -> FrameSequence | ArchiveSequence:
    """Open an `.r3d` file or an exported folder.

    Raises:
        ReaderError: the recording cannot be read or holds fewer than two frames.
        CameraError, FrameError: invalid intrinsics or depth scale.
        MissingExtraError: lzfse is not installed; only `.r3d` files need it.
    """
    if path.is_file():
        return _open_archive(path, options or CameraOptions())
    metadata = _metadata(path)
    assert metadata is not None
    with foreign_errors(ReaderError, f"{metadata}: not the metadata of Record3D"):
        values = json.loads(metadata.read_bytes())
    return open_images(
        path, find_images(path), options, Layout(camera=from_mapping(_dict(values, path), str(metadata)))
    )


@dataclass(frozen=True, eq=False)
class ArchiveSequence:
    """The frames of an `.r3d` file, decoded on access.

    Attributes:
        path: the file.
        camera: of colour.
        depth_size: (width, height) of depth.
        frames: the numbers of the frames in the archive.
        times: seconds of each frame; None where the metadata have none.
        max_depth: depth beyond it is missing, metres; None for no limit.
        notes: see `FrameSource`.
    """

    path: Path
    camera: Camera
    depth_size: tuple[int, int]
    frames: tuple[int, ...]
    times: tuple[float | None, ...]
    max_depth: float | None
    notes: tuple[str, ...]

    @property
    def depth_scale(self) -> float:
        """Depth is stored in metres."""
        return 1.0

    @property
    def cuts(self) -> tuple[int, ...]:
        """A recording is never restarted."""
        return ()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Decode a frame.

        Raises:
            ReaderError: a broken image.
            FrameError: the images do not make a valid frame.
        """
        name = f"{self.path}: frame {self.frames[index]}"
        with foreign_errors(ReaderError, f"{name} cannot be read"), zipfile.ZipFile(self.path) as archive:
            data = _read_member(archive, f"rgbd/{self.frames[index]}.jpg", name)
            raw = _read_member(archive, f"rgbd/{self.frames[index]}.depth", name)
        check_complete(data, Path(name))
        check_pixels(coded_size(io.BytesIO(data), Path(name)), Path(name))
        color = decode(data, Path(name))
        depth = to_metres(_decode_depth(raw, self.depth_size, name), max_depth=self.max_depth)
        pixels: UInt8Array = np.ascontiguousarray(color[..., :3], dtype=np.uint8)
        return RgbdFrame(
            pixels, resize_nearest(depth, pixels.shape[:2]), self.camera, timestamp=self.times[index], name=name
        )

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float | None:
        """Time of a frame in seconds."""
        return self.times[index]


def _open_archive(path: Path, options: CameraOptions) -> ArchiveSequence:
    _lzfse()
    with foreign_errors(ReaderError, f"{path}: not an .r3d file that can be read"), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        values: Any = json.loads(_read_member(archive, "metadata", str(path)))
    given = _dict(values, path)
    found: dict[str, set[int]] = {"jpg": set(), "depth": set()}
    for name in names:
        # The numbers of other names would not lead back to a member.
        if (match := _FRAME.fullmatch(name)) and match[1] == str(int(match[1])):
            found[match[2]].add(int(match[1]))
    frames = tuple(sorted(found["jpg"] & found["depth"]))
    if len(frames) < 2:
        raise ReaderError(f"{path}: {len(frames)} frames with colour and depth: a pair needs two")
    alone = len(found["jpg"] ^ found["depth"])
    camera = from_mapping(given, str(path))
    if camera.size is None:
        raise CameraError(f"{path}: w, h missing in the metadata")
    setup = options.fit(camera.size, path.parent, str(path), 1.0, camera) if options.has_camera else None
    depth_size = (given.get("dw", 192), given.get("dh", 256))
    if not all(isinstance(value, int) and 0 < value < 10_000 for value in depth_size):
        raise ReaderError(f"{path}: the metadata hold no valid size of depth (dw, dh)")
    known = _finite_numbers(given.get("frameTimestamps"))
    times = tuple(known[k] if k < len(known) else None for k in frames)
    return ArchiveSequence(
        path,
        setup.camera if setup else camera.camera(camera.size, str(path)),
        depth_size,
        frames,
        times if None not in times else (None,) * len(frames),
        options.max_depth,
        (f"{alone} images without a counterpart left out",) if alone else (),
    )


def _finite_numbers(values: Any) -> list[float]:
    """A list of finite numbers; an empty list in place of anything else."""
    if not isinstance(values, list) or not all(isinstance(value, (int, float)) for value in values):
        return []
    try:
        numbers = [float(value) for value in values]
    except OverflowError:
        return []
    return numbers if np.isfinite(numbers).all() else []


def _decode_depth(data: bytes, size: tuple[int, int], name: str) -> Float32Array:
    width, height = size
    with foreign_errors(ReaderError, f"{name}: depth cannot be decompressed"):
        if _raw_bytes(data) != 4 * width * height:
            raise ReaderError(f"{name}: depth has {_raw_bytes(data)} bytes, not {width}x{height} values")
        values = np.frombuffer(_lzfse().decompress(data), np.float32)
    if len(values) != width * height:
        raise ReaderError(f"{name}: depth has {len(values)} values, not {width}x{height}")
    return values.reshape(height, width)


def _raw_bytes(data: bytes) -> int:
    """The size of LZFSE data when they are decompressed, from the headers of their blocks.

    The library decompresses without a limit. Source: lzfse_internal.h of https://github.com/lzfse/lzfse.
    """
    at = total = 0
    for _ in range(MAX_BLOCKS):
        magic = data[at : at + 4]
        if magic == b"bvx$":
            return total
        raw = struct.unpack_from("<I", data, at + 4)[0]
        if magic == b"bvx2":
            fields = struct.unpack_from("<3Q", data, at + 8)
            payload = (fields[0] >> 20 & 0xFFFFF) + (fields[1] >> 40 & 0xFFFFF)
            length = (fields[2] & 0xFFFFFFFF) + payload
        elif magic == b"bvxn":
            length = 12 + struct.unpack_from("<I", data, at + 8)[0]
        elif magic == b"bvx-":
            length = 8 + raw
        else:
            raise ValueError(f"unknown LZFSE block {magic!r}")
        total += raw
        at += max(length, 1)
    raise ValueError(f"more than {MAX_BLOCKS} LZFSE blocks")


def _read_member(archive: zipfile.ZipFile, member: str, name: str) -> bytes:
    with archive.open(member) as file:
        data = file.read(MAX_MEMBER_BYTES + 1)
    if len(data) > MAX_MEMBER_BYTES:
        raise ReaderError(f"{name}: {member} is too large")
    return data


def _metadata(folder: Path) -> Path | None:
    return next((folder / name for name in METADATA if (folder / name).is_file()), None)


def _dict(values: Any, path: Path) -> dict[str, Any]:
    if not isinstance(values, dict) or "K" not in values:
        raise ReaderError(f"{path}: the metadata hold no camera matrix K")
    return values


def _lzfse() -> Any:
    try:
        import lzfse
    except ImportError as error:
        raise MissingExtraError(".r3d files need lzfse", "record3d") from error
    return lzfse
