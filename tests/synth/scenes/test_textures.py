"""Procedural textures and texture images: reproducible, of every size, tiling."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow.errors import DatasetError
from objectflow.synth.scenes.texture_patterns import draw_word, value_noise
from objectflow.synth.scenes.textures import FLOOR_KINDS, OBJECT_KINDS, TextureSpec, draw_texture, list_images

KINDS = sorted({*FLOOR_KINDS, *OBJECT_KINDS})


@pytest.mark.parametrize("kind", KINDS)
def test_a_texture_is_determined_by_its_spec(kind: str) -> None:
    spec = TextureSpec(kind, seed=7, colors=((180, 90, 60), (60, 120, 200), (30, 30, 30)), scale=4)
    first, again = draw_texture(spec, 96), draw_texture(spec, 96)
    other = draw_texture(TextureSpec(kind, seed=8, colors=spec.colors, scale=4), 96)

    assert first.shape == (96, 96, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [16, 61, 256])
@pytest.mark.parametrize("scale", [1, 12])
def test_every_size_and_scale_can_be_drawn(kind: str, size: int, scale: int) -> None:
    image = draw_texture(TextureSpec(kind, seed=1, scale=scale), size)

    assert image.shape == (size, size, 3)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "plain"])
def test_patterns_have_contrast(kind: str) -> None:
    colors = ((230, 230, 230), (40, 90, 160), (20, 20, 20))
    image = draw_texture(TextureSpec(kind, seed=3, colors=colors, scale=3), 128)

    assert image.astype(float).std(axis=(0, 1)).max() > 10


@pytest.mark.parametrize("size", [64, 128, 400])
@pytest.mark.parametrize("left", [0.0, 1.0])
@pytest.mark.parametrize("middle", [0.16, 0.42])
def test_a_word_is_never_cropped(size: int, left: float, middle: float) -> None:
    for word in ("III", "WWWWWW", "QJQJQJ"):
        ink = draw_word(word, size, left, middle) > 0
        rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))

        assert 0 < columns[0] < columns[-1] < size - 1
        assert 0 < rows[0] < rows[-1] < 0.6 * size  # the small print is below
        assert 0.12 * size < columns[-1] - columns[0] < 0.75 * size


def test_a_labels_word_is_legible() -> None:
    # Ground, band and accent are similar: the word must have another colour.
    image = draw_texture(TextureSpec("label", seed=3, colors=((90, 90, 90), (95, 95, 95), (100, 100, 100))), 128)

    assert (np.abs(image[: int(0.6 * 128)].astype(float) - 95).mean(axis=-1) > 45).sum() > 200


def test_plain_keeps_its_colour() -> None:
    image = draw_texture(TextureSpec("plain", colors=((200, 100, 50), (0, 0, 0), (0, 0, 0))), 64)

    # Wear darkens it by at most 8%.
    assert np.all(image <= [200, 100, 50])
    assert np.all(image >= np.floor(0.92 * np.array([200, 100, 50])))


def test_noise_tiles() -> None:
    noise = value_noise(np.random.default_rng(0), 64, [(4, 4), (8, 8)])
    inside = np.abs(np.diff(noise, axis=1)).max()
    seam = np.abs(noise[:, 0] - noise[:, -1]).max()

    assert noise.min() == 0
    assert noise.max() == 1
    assert seam <= inside * 1.5


def test_images_of_a_folder(tmp_path: Path) -> None:
    image = np.zeros((40, 60, 3), dtype=np.uint8)
    image[:, :, 2] = 255  # red in OpenCV's BGR order
    cv2.imwrite(str(tmp_path / "b.png"), image)
    (tmp_path / "a.txt").write_text("no image")

    assert list_images(tmp_path) == [tmp_path / "b.png"]
    drawn = draw_texture(TextureSpec("image", path=str(tmp_path / "b.png")), 16)
    np.testing.assert_array_equal(drawn, np.full((16, 16, 3), (255, 0, 0)))


def test_invalid_input_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no images in"):
        list_images(tmp_path)
    with pytest.raises(DatasetError, match="unknown texture kind 'lava'"):
        draw_texture(TextureSpec("lava"), 16)
    (tmp_path / "broken.png").write_bytes(b"not an image")
    with pytest.raises(DatasetError, match=r"cannot read the texture .*broken\.png"):
        draw_texture(TextureSpec("image", path=str(tmp_path / "broken.png")), 16)
