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
    found = decode_png(encode_png(image, compression=compression), "image")
    assert found.dtype == image.dtype
    np.testing.assert_array_equal(found, image)


def test_arrays_are_rgb_and_files_have_standard_channel_order() -> None:
    red = np.zeros((4, 5, 3), np.uint8)
    red[..., 0] = 200
    stored = cv2.imdecode(np.frombuffer(encode_png(red), np.uint8), cv2.IMREAD_COLOR)  # BGR
    assert stored[0, 0].tolist() == [0, 0, 200]
    np.testing.assert_array_equal(decode_png(encode_png(red[:, ::-1]), "image"), red)


def test_broken_bytes_are_refused_by_name() -> None:
    data = encode_png(IMAGES["colour"])
    with pytest.raises(ReaderError, match="prev_color is not a complete PNG"):
        decode_png(data[:-20], "prev_color")
    with pytest.raises(ReaderError, match="prev_color cannot be decoded"):
        decode_png(b"not an image" + data[-12:], "prev_color")
