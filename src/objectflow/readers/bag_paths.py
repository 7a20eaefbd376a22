"""The files of a bag: one file, a folder of several, splits, unfinished recordings and compressed files."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import shutil
import tempfile
import weakref
from pathlib import Path
from typing import IO, Any, NamedTuple

from objectflow.errors import ReaderError
from objectflow.storage.foreign import foreign_errors

_BAG_NAME = re.compile(
    r"\.(?P<kind>bag|mcap|db3)(?:\.orig)?(?:\.active)?(?:\.(?P<packed>zst|zstd|gz|bz2|xz|lz4))?$", re.IGNORECASE
)
MIN_FREE_BYTES = 1 << 30
"""Space in bytes that the decompression of a file leaves free on the disk."""
BLOCK_BYTES = 1 << 22
"""Number of bytes that are decompressed at a time."""


class BagPaths(NamedTuple):
    """The files of a bag.

    Attributes:
        files: to read, without compression.
        folder: of decompressed files, which exists as long as this object; None if there are none.
        notes: missing files, one sentence each.
    """

    files: tuple[Path, ...]
    folder: TemporaryFolder | None
    notes: tuple[str, ...]


class TemporaryFolder:
    """A folder that is removed with this object, or at the end of the program."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="objectflow-bag-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


def is_bag_file(path: Path) -> bool:
    """Whether a file has the name of a bag: `.bag`, `.mcap` or `.db3`, with `.active`, `.zst` and such after it."""
    return _BAG_NAME.search(path.name) is not None and path.is_file()


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder holds a bag: the metadata of ROS 2, or files of bags beside no folder of images."""
    if (folder / "metadata.yaml").is_file():
        return True
    with foreign_errors(ReaderError, f"{folder}: cannot be read"):
        return any(is_bag_file(path) for path in folder.iterdir()) and not (folder / "depth").exists()


def find_files(path: Path) -> BagPaths:
    """The files of a bag in natural order of their names; compressed ones are decompressed into a temporary folder.

    Args:
        path: a file, or a folder with the files of one bag.

    Raises:
        ReaderError: there is no file, or one cannot be decompressed.
    """
    if not path.is_dir():
        found = [path]
    else:
        with foreign_errors(ReaderError, f"{path}: cannot be read"):
            found = sorted((file for file in path.iterdir() if is_bag_file(file)), key=_natural)
    # `ros2 bag play` leaves the decompressed file beside the compressed one.
    names = {file.name for file in found}
    found = [file for file in found if not (_packed(file) and file.stem in names)]
    if not found:
        raise ReaderError(f"{path}: not a bag that can be read: no .bag, .mcap or .db3 file in this folder")
    folder = TemporaryFolder() if any(_packed(file) for file in found) else None
    files = []
    for number, file in enumerate(found):
        if folder is not None and _packed(file):
            target = folder.path / f"{number}-{file.stem}"
            _unpack(file, target)
            files.append(target)
        else:
            files.append(file)
    return BagPaths(tuple(files), folder, _missing(path, names))


def _packed(file: Path) -> str | None:
    """The compression of a file by its suffix."""
    found = _BAG_NAME.search(file.name)
    return found["packed"].lower() if found and found["packed"] else None


def _natural(path: Path) -> list[tuple[int, str]]:
    """A sort key with which `bag_10` follows `bag_9`."""
    return [
        (int(part), "") if part.isascii() and part.isdigit() else (0, part)
        for part in re.split(r"([0-9]+)", path.name)
    ]


def _unpack(source: Path, target: Path) -> None:
    """Decompress a file while there is space.

    Raises:
        ReaderError: the file is damaged, or the disk is full.
    """
    with (
        foreign_errors(ReaderError, f"{source}: cannot be decompressed"),
        source.open("rb") as raw,
        _opened(raw, str(_packed(source))) as packed,
        target.open("wb") as out,
    ):
        while block := packed.read(BLOCK_BYTES):
            if shutil.disk_usage(target.parent).free < MIN_FREE_BYTES:
                raise ReaderError(
                    f"{source}: too large to decompress into {target.parent.parent}: decompress it by hand, or set "
                    "TMPDIR to a larger disk"
                )
            out.write(block)


def _opened(raw: IO[bytes], compression: str) -> Any:
    """A decompressed stream."""
    if compression == "gz":
        return gzip.GzipFile(fileobj=raw)
    if compression == "bz2":
        return bz2.BZ2File(raw)
    if compression == "xz":
        return lzma.LZMAFile(raw)
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return lz4.frame.open(raw, "rb")
    from backports import zstd

    return zstd.open(raw, "rb")


def _missing(path: Path, names: set[str]) -> tuple[str, ...]:
    """Notes on files that the metadata of a ROS 2 bag lists, and that are not in its folder."""
    metadata = path / "metadata.yaml"
    if not path.is_dir() or not metadata.is_file():
        return ()
    try:
        text = metadata.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ()
    block = re.search(r"relative_file_paths:\s*\n((?:\s*-\s*.+\n?)+)", text)
    listed = re.findall(r"-\s*(.+)", block[1]) if block else []
    missing = [name for name in (Path(line.strip().strip("'\"")).name for line in listed) if name not in names]
    missing = [name for name in missing if Path(name).stem not in names]
    return tuple(f"{name} of metadata.yaml is missing: the other files are read" for name in missing)
