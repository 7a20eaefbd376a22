"""Image files of every format, written by independent libraries and read back to the same pixels."""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from objectflow.errors import ReaderError
from objectflow.storage.image_files import is_image, read_color, read_depth, read_size, to_metres

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)
UNITS = RNG.integers(1, 65535, (12, 16), dtype=np.uint16)
METRES = RNG.uniform(0.5, 3, (12, 16)).astype(np.float32)
Write = Callable[[Path, NDArray[Any]], Any]


def pillow(path: Path, image: NDArray[Any], **options: Any) -> None:
    Image.fromarray(image).save(path, **options)


def tiff(path: Path, image: NDArray[Any], **options: Any) -> None:
    tifffile.imwrite(path, image, **options)


def exr(path: Path, image: NDArray[Any], channel: str = "Z") -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {channel: image}).write(str(path))


def exr_rgb(path: Path, image: NDArray[Any]) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": image, "G": image, "B": image}).write(str(path))


def pnm(path: Path, image: NDArray[Any]) -> None:
    """Binary PGM or PPM, by the definition of the format: 16 bits are big-endian."""
    kind, largest = ("P6" if image.ndim == 3 else "P5"), np.iinfo(image.dtype).max
    data = image.astype(">u2").tobytes() if image.dtype == np.uint16 else image.tobytes()
    path.write_bytes(f"{kind}\n{image.shape[1]} {image.shape[0]}\n{largest}\n".encode() + data)


def pfm(path: Path, image: NDArray[Any]) -> None:
    """PFM, by the definition of the format: rows from the bottom up."""
    path.write_bytes(f"Pf\n{image.shape[1]} {image.shape[0]}\n-1.0\n".encode() + image[::-1].astype("<f4").tobytes())


def npy_of_python_2(path: Path, image: NDArray[Any]) -> None:
    """Python 2 wrote the sizes as long integers, at which NumPy warns."""
    np.save(path, image)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"(12, 16), }  ", b"(12L, 16L), }"))


COLOR_FILES: dict[str, tuple[str, Write]] = {
    "png": ("c.png", pillow),
    "upper case": ("c.PNG", lambda path, image: pillow(path, image, format="png")),
    "bmp": ("c.bmp", pillow),
    "ppm": ("c.ppm", pnm),
    "tiff": ("c.tiff", lambda path, image: tiff(path, image, photometric="rgb")),
    "tiff lzw": ("c.tif", lambda path, image: pillow(path, image, compression="tiff_lzw")),
    "webp": ("c.webp", lambda path, image: pillow(path, image, lossless=True)),
    "npy": ("c.npy", np.save),
    "npz": ("c.npz", lambda path, image: np.savez_compressed(path, rgb=image, other=image[:1])),
}
DEPTH_FILES: dict[str, tuple[str, Write, NDArray[Any]]] = {
    "png": ("d.png", pillow, UNITS),
    "pgm": ("d.pgm", pnm, UNITS),
    "tiff": ("d.tif", tiff, UNITS),
    "tiff deflate": ("d.TIFF", lambda path, image: tiff(path, image, compression="zlib"), UNITS),
    "tiff big-endian": ("d.tif", lambda path, image: tiff(path, image, byteorder=">"), UNITS),
    "tiff big": ("d.tif", lambda path, image: tiff(path, image, bigtiff=True), UNITS),
    "tiff of tiles": ("d.tif", lambda path, image: tiff(path, image, tile=(16, 16)), UNITS),
    "tiff float32": ("d.tiff", tiff, METRES),
    "tiff float64": ("d.tiff", tiff, METRES.astype(np.float64)),
    "exr": ("d.exr", exr, METRES),
    "exr half": ("d.exr", exr, METRES.astype(np.float16)),
    "exr of a layer": ("d.exr", lambda path, image: exr(path, image, "Depth.V"), METRES),
    "exr in three channels": ("d.EXR", exr_rgb, METRES),
    "pfm": ("d.pfm", pfm, METRES),
    "npy float32": ("d.npy", np.save, METRES),
    "npy float16": ("d.npy", np.save, METRES.astype(np.float16)),
    "npy uint16": ("d.npy", np.save, UNITS),
    "npy big-endian": ("d.npy", lambda path, image: np.save(path, image.astype(">u2")), UNITS),
    "npy uint32": ("d.npy", np.save, UNITS.astype(np.uint32)),
    "npy in columns": ("d.npy", lambda path, image: np.save(path, np.asfortranarray(image)), METRES),
    "npy of Python 2": ("d.npy", npy_of_python_2, METRES),
    "npy with a channel": ("d.npy", lambda path, image: np.save(path, image[..., None]), METRES),
    "npy with a batch": ("d.npy", lambda path, image: np.save(path, image[None]), METRES),
    "npz": ("d.npz", np.savez, METRES),
    "npz of several": ("d.NPZ", lambda path, image: savez(path, depth=image, confidence=image[:2]), METRES),
}


def savez(path: Path, **arrays: NDArray[Any]) -> None:
    with open(path, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", COLOR_FILES)
def test_colour_of_every_format_is_read_to_the_same_pixels(tmp_path: Path, kind: str) -> None:
    name, write = COLOR_FILES[kind]
    write(tmp_path / name, COLOR)
    assert is_image(tmp_path / name)
    assert read_size(tmp_path / name) == (16, 12)
    np.testing.assert_array_equal(read_color(tmp_path / name), COLOR)


@pytest.mark.parametrize("kind", DEPTH_FILES)
def test_depth_of_every_format_is_read_to_the_same_values(tmp_path: Path, kind: str) -> None:
    name, write, image = DEPTH_FILES[kind]
    write(tmp_path / name, image)
    assert is_image(tmp_path / name)
    assert read_size(tmp_path / name) == (16, 12)
    found = read_depth(tmp_path / name)
    assert found.dtype == image.dtype
    np.testing.assert_array_equal(found, image)
    expected = image.astype(np.float64) / (1000 if image.dtype.kind == "u" else 1)
    np.testing.assert_allclose(to_metres(found), expected, rtol=1e-6)


def test_lossy_colour_is_close(tmp_path: Path) -> None:
    smooth = np.broadcast_to(np.linspace(0, 250, 16).astype(np.uint8)[None, :, None], (12, 16, 3)).copy()
    for name in ("c.jpg", "c.JPEG", "c.webp"):
        pillow(tmp_path / name, smooth, **({"format": "jpeg"} if "j" in name.lower() else {}), quality=95)
        assert np.abs(read_color(tmp_path / name).astype(int) - smooth).max() < 12


def test_sixteen_bit_colour_is_reduced_to_eight(tmp_path: Path) -> None:
    tiff(tmp_path / "c.tif", COLOR.astype(np.uint16) * 257, photometric="rgb")
    np.testing.assert_array_equal(read_color(tmp_path / "c.tif"), COLOR)


@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.int32, np.uint32, np.float16, np.float32, np.float64])
def test_missing_depth_becomes_zero(dtype: type[np.generic]) -> None:
    floating = np.issubdtype(dtype, np.floating)
    largest = np.finfo(dtype).max if floating else np.iinfo(dtype).max  # type: ignore[arg-type, type-var]
    values = [0, 2, largest] + ([np.nan, np.inf, -np.inf, -1] if floating else [])
    if np.issubdtype(dtype, np.signedinteger):
        values.append(-5)
    metres = to_metres(np.array([values], dtype), depth_scale=1000)
    expected = np.zeros(len(values))
    expected[1] = 2 if floating else 0.002
    np.testing.assert_allclose(metres[0], expected, rtol=1e-3)


def test_scales_and_the_largest_depth() -> None:
    integers, floats = np.array([[1000, 8000]], np.uint16), np.array([[1000.0, 8000.0]], np.float32)
    np.testing.assert_allclose(to_metres(integers, depth_scale=2000, max_depth=3), [[0.5, 0]])
    np.testing.assert_allclose(to_metres(floats, depth_scale=2000, float_depth_scale=1000), [[1, 8]])


def header_of_png(width: int, height: int) -> bytes:
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"")),
        (b"IEND", b""),
    ]
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def header_of_npy(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": dtype, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


def npz_of(member: bytes, name: str = "depth.npy") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, member)
    return buffer.getvalue()


HUGE: dict[str, bytes] = {
    "a.png": header_of_png(60000, 60000),
    "a.bmp": b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 60000, 60000, 1, 24, 0, 0, 0, 0, 0, 0),
    "a.pgm": b"P5\n60000 60000\n65535\n\0\0",
    "a.npy": header_of_npy((60000, 60000)) + b"\0" * 100,
    "a.npz": npz_of(header_of_npy((60000, 60000)) + b"\0" * 5_000_000),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_header_that_asks_for_too_much_is_refused_before_decoding(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(HUGE[name])
    for read in (read_size, read_depth, read_color):
        with pytest.raises(ReaderError, match=r"60000x60000 pixels are too many|too many pixels"):
            read(path)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("d.npy", b"\x93NUMPY\x01\x00", "not an NPY file"),
        ("d.npy", header_of_npy((12, 16)) + b"\0" * 8, "not an NPY file"),
        ("d.npy", header_of_npy((12, 16), "|O") + b"\0" * 800, "not object"),
        ("d.npy", header_of_npy((12, 16), "<c8") + b"\0" * 1536, "not complex64"),
        ("d.npy", header_of_npy((4, 3, 12, 16)), "neither a colour nor a depth image"),
        ("d.npy", header_of_npy((0, 16)), "16x0 pixels"),
        ("d.npz", b"PK\x03\x04 and no more", "not an NPZ file"),
        ("d.npz", npz_of(b"", "readme.txt"), "this has none"),
        ("d.exr", b"\x76\x2f\x31\x01 and no more", "not an OpenEXR file"),
        ("d.tif", b"II*\0 and no more", "not an image"),
        ("d.webp", b"RIFF\x10\0\0\0WEBPVP8 ", "not an image"),
        ("d.pgm", b"P5\n16 12\n65535\n\0\0", "not an image"),
    ],
)
def test_broken_files_are_refused_in_one_line(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ReaderError, match=words) as caught:
        read_depth(path)
    assert name in str(caught.value)


def test_eight_bit_depth_is_refused_in_every_format(tmp_path: Path) -> None:
    grey = COLOR[..., 0]
    pillow(tmp_path / "d.bmp", grey)
    np.save(tmp_path / "d.npy", grey)
    tiff(tmp_path / "d.tif", grey)
    for name in ("d.bmp", "d.npy", "d.tif"):
        with pytest.raises(ReaderError, match="save raw depth, not a picture of it"):
            read_depth(tmp_path / name)


def test_colour_in_floating_point_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", COLOR.astype(np.float32) / 255)
    with pytest.raises(ReaderError, match="8 bits per channel"):
        read_color(tmp_path / "c.npy")


def test_pipes_and_devices_are_never_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/zero")
    for name in ("a.png", "b.png"):
        assert not is_image(tmp_path / name)
        for read in (read_size, read_depth, read_color):
            with pytest.raises(ReaderError, match="not a regular file"):
                read(tmp_path / name)
