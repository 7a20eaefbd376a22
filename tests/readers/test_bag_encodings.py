"""Images in every encoding, written into bags by rosbags and read back to the same pixels."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.bags import COLOR, DEPTH, INFO, BagBuilder
from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions, open_source
from objectflow.typing import Float32Array, UInt8Array

CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.0)
BAYER = {"rggb": (0, 1, 1, 2), "bggr": (2, 1, 1, 0), "gbrg": (1, 2, 0, 1), "grbg": (1, 0, 2, 1)}
"""Channel of the four pixels of a block."""


def smooth_color() -> UInt8Array:
    """Colour of 16x12 blocks of 4x4 pixels, which survives subsampled colour."""
    blocks = np.random.default_rng(3).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    return blocks.repeat(4, axis=0).repeat(4, axis=1)


def depth_in_millimetres() -> np.ndarray[Any, Any]:
    depth = np.random.default_rng(2).integers(500, 4000, (48, 64)).astype(np.uint16)
    depth[5:9, 10:40] = 0
    depth[20] = 0
    return depth


def read_back(tmp_path: Path, color: tuple[Any, str], depth: tuple[Any, str], **options: Any) -> Any:
    bag = BagBuilder("mcap")
    for topic, (pixels, encoding) in ((COLOR, color), (DEPTH, depth)):
        if isinstance(pixels, bytes):
            bag.compressed(f"{topic}/compressed", 5.0, pixels, encoding)
        else:
            bag.image(topic, 5.0, pixels, encoding, pad=8)
    bag.info(INFO, 5.0, CAMERA)
    (frame,) = open_source(bag.write(tmp_path / "bag"), CameraOptions(**options))
    return frame


def encoded(color: UInt8Array, encoding: str) -> tuple[Any, UInt8Array]:
    """An image in an encoding by the definition of the format, and its RGB by OpenCV or by hand."""
    name = encoding.removesuffix("16").removesuffix("8")
    order = {"rgb": [0, 1, 2], "bgr": [2, 1, 0], "rgba": [0, 1, 2, 0], "bgra": [2, 1, 0, 0]}
    if name in order:
        pixels: Any = color[..., order[name]]
        return (pixels.astype(np.uint16) * 257 if encoding.endswith("16") else pixels), color
    if name == "mono":
        grey = color[..., 0]
        return (grey.astype(np.uint16) << 8 if encoding.endswith("16") else grey), grey[..., None].repeat(3, axis=2)
    if name.startswith("bayer"):
        # Of one colour, because a Bayer image holds one channel per pixel.
        flat = np.full_like(color, (200, 100, 50))
        block = np.array([(200, 100, 50)[channel] for channel in BAYER[name[-4:]]]).reshape(2, 2)
        pixels = np.tile(block, (24, 32)).astype(np.uint8)
        return (pixels.astype(np.uint16) * 257 if encoding.endswith("16") else pixels), flat
    yuv = cv2.cvtColor(color, cv2.COLOR_RGB2YUV_I420)  # (72, 64): Y, then U and V at half the resolution
    luma, planes = yuv[:48], yuv[48:].reshape(2, 24, 32)
    if encoding == "i420":
        return yuv, np.asarray(cv2.cvtColor(yuv, cv2.COLOR_YUV2RGB_I420))
    if encoding in ("nv12", "nv21"):
        order_uv = planes if encoding == "nv12" else planes[::-1]
        pixels = np.vstack([luma, order_uv.transpose(1, 2, 0).reshape(24, 64)])
        return pixels, np.asarray(cv2.cvtColor(yuv, cv2.COLOR_YUV2RGB_I420))
    chroma = planes.repeat(2, axis=1).transpose(1, 2, 0).reshape(48, 64)  # U V U V ... of each row
    first_luma = encoding in ("yuyv", "yuv422_yuy2")
    pixels = np.stack([luma, chroma] if first_luma else [chroma, luma], axis=-1)
    return pixels, np.asarray(cv2.cvtColor(yuv, cv2.COLOR_YUV2RGB_I420))


@pytest.mark.parametrize(
    "encoding",
    ["rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16", "mono8"]
    + [f"bayer_{pattern}{bits}" for pattern in BAYER for bits in (8, 16)]
    + ["yuv422", "uyvy", "yuyv", "yuv422_yuy2"],
)
def test_raw_colour(tmp_path: Path, encoding: str) -> None:
    pixels, expected = encoded(smooth_color(), encoding)
    frame = read_back(tmp_path, (pixels, encoding), (depth_in_millimetres(), "16UC1"))
    inner = np.s_[2:-2, 2:-2] if "bayer" in encoding else np.s_[:]
    np.testing.assert_array_equal(frame.color[inner], expected[inner])


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "i420"])
def test_raw_colour_with_subsampled_planes(tmp_path: Path, encoding: str) -> None:
    pixels, expected = encoded(smooth_color(), encoding)
    bag = BagBuilder("ros1")
    bag.add(COLOR, "sensor_msgs/msg/Image", 5.0, height=48, width=64, encoding=encoding, is_bigendian=0, step=64,
            data=np.ascontiguousarray(pixels).ravel())  # fmt: skip
    bag.image(DEPTH, 5.0, depth_in_millimetres(), "16UC1")
    bag.info(INFO, 5.0, CAMERA)
    (frame,) = open_source(bag.write(tmp_path / "a.bag"))
    np.testing.assert_array_equal(frame.color, expected)


def test_mono16_is_colour_if_it_is_chosen(tmp_path: Path) -> None:
    bag = BagBuilder("mcap")
    pixels, expected = encoded(smooth_color(), "mono16")
    bag.image("/infra/image", 5.0, pixels, "mono16")
    bag.image(DEPTH, 5.0, depth_in_millimetres(), "16UC1")
    bag.info("/infra/camera_info", 5.0, CAMERA)
    path = bag.write(tmp_path / "a")
    (frame,) = open_source(path, color_topic="/infra/image", depth_topic=DEPTH)
    np.testing.assert_array_equal(frame.color, expected)


@pytest.mark.parametrize("kind", ["png", "webp", "jpeg", "bmp"])
def test_compressed_colour(tmp_path: Path, kind: str) -> None:
    color = smooth_color()
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if kind == "webp" else []
    done, data = cv2.imencode(f".{kind}", color[..., ::-1], options)
    assert done
    frame = read_back(tmp_path, (data.tobytes(), f"rgb8; {kind} compressed bgr8"), (depth_in_millimetres(), "16UC1"))
    if kind == "jpeg":
        np.testing.assert_array_equal(frame.color, cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    else:
        np.testing.assert_array_equal(frame.color, color)


def rvl(depth: np.ndarray[Any, Any]) -> bytes:
    """RVL as its paper describes it, pixel by pixel."""
    nibbles: list[int] = []

    def write(value: int) -> None:
        while True:
            part, value = value & 7, value >> 3
            nibbles.append(part | (8 if value else 0))
            if not value:
                return

    values, position, previous = depth.ravel().tolist(), 0, 0
    while position < len(values):
        start = position
        while position < len(values) and values[position] == 0:
            position += 1
        write(position - start)
        start = position
        while position < len(values) and values[position] != 0:
            position += 1
        write(position - start)
        for value in values[start:position]:
            delta = value - previous
            write(2 * delta if delta >= 0 else -2 * delta - 1)
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack("<ii", depth.shape[1], depth.shape[0]) + struct.pack(f"<{len(words)}I", *words)


def test_depth_in_every_encoding(tmp_path: Path) -> None:
    millimetres = depth_in_millimetres()
    metres = (millimetres / 1000).astype(np.float32)
    missing = np.where(millimetres > 0, metres, np.float32(np.nan))
    infinite = np.where(millimetres > 0, metres, np.float32(-np.inf))
    full = np.where(millimetres > 0, millimetres, np.uint16(65535))
    done, png = cv2.imencode(".png", millimetres)
    assert done
    header = struct.pack("<iff", 0, 0.0, 0.0)
    cases: dict[str, tuple[Any, str, dict[str, Any]]] = {
        "16UC1": (millimetres, "16UC1", {}),
        "largest": (full, "16UC1", {}),
        "mono16": (millimetres, "mono16", {}),
        "16SC1": (millimetres.astype(np.int16), "16SC1", {}),
        "tenths": (millimetres * 10, "16UC1", {"depth_scale": 10000.0}),
        "32FC1": (missing, "32FC1", {}),
        "infinite": (infinite, "32FC1", {}),
        "32FC1 mm": (metres * 1000, "32FC1", {"depth_scale": 1000.0}),
        "64FC1": (metres.astype(np.float64), "64FC1", {}),
        "png": (png.tobytes(), "16UC1; png compressed ", {}),
        "png of unknown format": (png.tobytes(), "png", {}),
        "compressedDepth": (header + png.tobytes(), "16UC1; compressedDepth png", {}),
        "rvl": (header + rvl(millimetres), "16UC1; compressedDepth rvl", {}),
    }
    color = smooth_color()
    for number, (name, (pixels, encoding, options)) in enumerate(cases.items()):
        frame = read_back(tmp_path / str(number), (color, "rgb8"), (pixels, encoding), **options)
        np.testing.assert_allclose(frame.depth, metres, atol=1e-6, err_msg=name)


def test_depth_beyond_a_limit_is_missing(tmp_path: Path) -> None:
    millimetres = depth_in_millimetres()
    frame = read_back(tmp_path, (smooth_color(), "rgb8"), (millimetres, "16UC1"), max_depth=2.0)
    np.testing.assert_array_equal(frame.depth > 0, (millimetres > 0) & (millimetres <= 2000))


def quantised_rvl() -> tuple[bytes, Float32Array]:
    a, b = 3000.0, 2.0
    depth = np.linspace(0.6, 3.0, 48 * 64).reshape(48, 64).astype(np.float32)
    values = np.rint(a / depth + b).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + rvl(values), (a / (values - b)).astype(np.float32)


def test_quantised_depth_in_rvl(tmp_path: Path) -> None:
    data, expected = quantised_rvl()
    frame = read_back(tmp_path, (smooth_color(), "rgb8"), (data, "32FC1; compressedDepth rvl"))
    np.testing.assert_allclose(frame.depth, expected, rtol=1e-5)


BIG_PNG = b"\x89PNG\r\n\x1a\n" + b"".join(
    struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    for kind, body in ((b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 16, 0, 0, 0, 0)), (b"IEND", b""))
)


@pytest.mark.parametrize(
    ("pixels", "encoding", "message"),
    [
        (BIG_PNG, "16UC1; png compressed ", "too many pixels"),
        (struct.pack("<iff", 0, 0, 0) + struct.pack("<ii", 60000, 60000), "16UC1; compressedDepth rvl", "megapixels"),
        (struct.pack("<iff", 0, 0, 0) + struct.pack("<ii", 64, 48), "16UC1; compressedDepth rvl", "cut off after 0"),
        (struct.pack("<iff", 0, 0, 0) + rvl(np.ones((48, 64), int))[:40], "16UC1; compressedDepth rvl", "RVL"),
        (struct.pack("<iff", 0, 0, 0) + b"\xff" * 400, "16UC1; compressedDepth rvl", "is not read|no content|RVL"),
        (b"", "16UC1; png compressed ", "not an image"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "16UC1; compressedDepth png", "PNG|not an image"),
    ],
)  # fmt: skip
def test_broken_depth_is_refused_in_one_line(tmp_path: Path, pixels: bytes, encoding: str, message: str) -> None:
    with pytest.raises(ReaderError, match=message) as caught:
        read_back(tmp_path, (smooth_color(), "rgb8"), (pixels, encoding))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"height": 60000, "width": 60000, "step": 180000}, "megapixels"),
        ({"height": 4000, "width": 64, "step": 192}, "does not fit its data"),
        ({"height": 48, "width": 64, "step": 100}, "does not fit its data"),
        ({"height": 0, "width": 64, "step": 192}, "no content"),
        ({"encoding": "yuv422", "width": 63}, "half the resolution"),
        ({"encoding": "8UC17"}, "'8UC17' is not supported"),
    ],
)
def test_a_header_is_checked_before_the_image_is_decoded(tmp_path: Path, fields: dict[str, Any], message: str) -> None:
    bag = BagBuilder("mcap")
    header = {"height": 48, "width": 64, "encoding": "rgb8", "is_bigendian": 0, "step": 192} | fields
    bag.add(COLOR, "sensor_msgs/msg/Image", 5.0, **header, data=np.zeros(48 * 192, np.uint8))
    bag.image(DEPTH, 5.0, depth_in_millimetres(), "16UC1")
    bag.info(INFO, 5.0, CAMERA)
    with pytest.raises(ReaderError, match=message):
        open_source(bag.write(tmp_path / "bag"))
