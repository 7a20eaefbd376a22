"""The PNG codec: round trips of every kind of image, channel order, and broken bytes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from objectflow.errors import ReaderError
from objectflow.storage.images import decode_png, encode_png

RNG = np.random.default_rng(0)
IMAGES = {
    "labels": RNG.integers(0, 256, (7, 9), dtype=np.uint8),
    "depth": RNG.integers(0, 65536, (7, 9), dtype=np.uint16),
    "colour": RNG.integers(0, 256, (7, 9, 3), dtype=np.uint8),
}


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
@pytest.mark.parametrize("compression", [None, 0, 3, 9])
def test_images_survive_a_round_trip(image: NDArray[Any], compression: int | None) -> None:
    found = decode_png(encode_png(image, compression=compression), "image", size=(image.shape[1], image.shape[0]))
    assert found.dtype == image.dtype
    np.testing.assert_array_equal(found, image)


def test_arrays_are_rgb_and_files_have_standard_channel_order() -> None:
    red = np.zeros((4, 5, 3), np.uint8)
    red[..., 0] = 200
    stored = cv2.imdecode(np.frombuffer(encode_png(red), np.uint8), cv2.IMREAD_COLOR)  # BGR
    assert stored[0, 0].tolist() == [0, 0, 200]
    np.testing.assert_array_equal(decode_png(encode_png(red[:, ::-1]), "image", size=(5, 4)), red)


def test_broken_bytes_are_refused_by_name() -> None:
    data = encode_png(IMAGES["colour"])
    damaged = data[:50] + bytes([data[50] ^ 1]) + data[51:]
    huge = data[:16] + (30_000).to_bytes(4, "big") * 2 + data[24:]
    for broken, message in (
        (data[:-20], "prev_color: the PNG is cut off"),
        (damaged, "prev_color: not an image that can be decoded: the PNG is damaged"),
        (b"not an image" + data[-12:], "prev_color is not a PNG"),
        (None, "prev_color is not a PNG"),
        (huge, "prev_color has 30000x30000 pixels, not the 9x7 of its camera"),
    ):
        with pytest.raises(ReaderError, match=message):
            decode_png(broken, "prev_color", size=(9, 7))
