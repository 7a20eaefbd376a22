"""Textures of floors (wood, tiles, fabric, ...) and objects (labels, stripes, ...), drawn from a few numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from objectflow.errors import DatasetError, ReaderError
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.image_files import read_photograph
from objectflow.synth.scenes.texture_patterns import PATTERNS
from objectflow.typing import UInt8Array

Rgb = tuple[int, int, int]

FLOOR_KINDS = ("wood", "tiles", "fabric", "gravel", "noise", "checker", "plain", "paper")
OBJECT_KINDS = ("label", "stripes", "noise", "plain")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


@dataclass(frozen=True)
class TextureSpec:
    """The parameters that determine a texture's pixels at a given size.

    Attributes:
        kind: one of FLOOR_KINDS or OBJECT_KINDS, "package", "image", or "model" (the mesh file's own texture).
        seed: of the pattern.
        colors: three RGB colours: ground, pattern, accent.
        scale: number of features per side; the kind decides what a feature is (a plank, a tile, a stripe, ...).
        path: image file of kind "image", otherwise "".
    """

    kind: str
    seed: int = 0
    colors: tuple[Rgb, Rgb, Rgb] = ((200, 200, 200), (120, 120, 120), (60, 60, 60))
    scale: int = 4
    path: str = ""


def draw_texture(spec: TextureSpec, size: int) -> UInt8Array:
    """Draw a square texture that tiles at its borders: (size, size, 3) uint8 RGB, the same bytes for the same spec.

    Raises:
        DatasetError: an unknown kind, or an image that cannot be read.
    """
    return _draw_once(spec, size).copy()


@lru_cache(maxsize=48)
def _draw_once(spec: TextureSpec, size: int) -> UInt8Array:
    """Cached, because the slabs of a group share a texture and images are used in many scenes."""
    if spec.kind == "image":
        return _read_image(Path(spec.path), size)
    pattern = PATTERNS.get(spec.kind)
    if pattern is None:
        raise DatasetError(f"unknown texture kind {spec.kind!r}: one of {', '.join(PATTERNS)}, image")
    rng = np.random.default_rng(spec.seed)
    ground, second, accent = (np.array(color, dtype=np.float32) for color in spec.colors)
    drawn = pattern(rng, size, spec.scale, (ground, second, accent))
    return np.clip(np.rint(drawn), 0, 255).astype(np.uint8)


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name.

    Raises:
        DatasetError: the folder is missing or holds no images.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES) if folder.is_dir() else []
    if not files:
        raise DatasetError(f"no images in {folder}: give a folder with {', '.join(IMAGE_SUFFIXES)} files")
    return files


def _read_image(path: Path, size: int) -> UInt8Array:
    try:
        with silence_stderr():
            image = read_photograph(path)
    except ReaderError as error:
        raise DatasetError(f"cannot read the texture {path}: {str(error).removeprefix(f'{path}: ')}") from error
    side = min(image.shape[:2])
    # Area averaging, because the ray tracer has no mip maps and would alias a sharper image.
    resized = cv2.resize(image[:side, :side], (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8)
