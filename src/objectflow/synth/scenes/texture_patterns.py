"""The procedural patterns: each draws a (size, size, 3) float32 texture, 0..255, that tiles at its borders."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from objectflow.typing import Float32Array

MIN_CONTRAST = 45
"""Minimum mean difference between a word and its ground, grey levels."""

Colors = tuple[Float32Array, Float32Array, Float32Array]
"""Ground, pattern and accent, each (3,) RGB, 0..255."""


def value_noise(rng: np.random.Generator, size: int, cells: Sequence[tuple[int, int]]) -> Float32Array:
    """Value noise that tiles: (size, size) in [0, 1], a sum of octaves of interpolated random cells.

    Args:
        rng: source of randomness.
        size: pixels per side.
        cells: rows and columns of random cells of each octave. Each octave has half the weight of the previous one.
    """
    total = np.zeros((size, size), dtype=np.float32)
    weight = 1.0
    for octave in cells:
        rows, columns = (min(count, size) for count in octave)
        grid = rng.random((rows, columns), dtype=np.float32)
        # A wrapped border of two cells on each side makes the interpolation tile.
        wrapped = cv2.copyMakeBorder(grid, 2, 2, 2, 2, cv2.BORDER_WRAP)
        y = (np.arange(size, dtype=np.float32) + 0.5) * rows / size + 1.5
        x = (np.arange(size, dtype=np.float32) + 0.5) * columns / size + 1.5
        map_x, map_y = np.meshgrid(x, y)
        total += weight * cv2.remap(wrapped, map_x, map_y, cv2.INTER_LINEAR)
        weight /= 2
    low, high = float(total.min()), float(total.max())
    return ((total - low) / max(high - low, 1e-6)).astype(np.float32)


def _mix(a: Float32Array, b: Float32Array, share: Float32Array) -> Float32Array:
    """Blend colours (3,) or (H, W, 3) with the weight (H, W) of the second."""
    return np.asarray(a + (b - a) * share[..., None], dtype=np.float32)


def _octaves(scale: int) -> list[tuple[int, int]]:
    return [(scale * 2**k, scale * 2**k) for k in range(1, 5)]


def _plain(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    # Slightly uneven, as real surfaces are.
    return _mix(colors[0], colors[0] * np.float32(0.92), value_noise(rng, size, _octaves(scale)))


def _noise(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    first = _mix(colors[0], colors[1], value_noise(rng, size, _octaves(scale)))
    return _mix(first, np.broadcast_to(colors[2], first.shape), value_noise(rng, size, _octaves(scale)) ** 3)


def _checker(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    index = np.arange(size) * 2 * scale // size
    squares = (index[:, None] + index[None, :]) % 2
    return _mix(colors[0], colors[1], squares.astype(np.float32)) * _shade(rng, size, 0.06)


def _shade(rng: np.random.Generator, size: int, amount: float) -> Float32Array:
    """(H, W, 1) factors from `1 - amount` to 1: dirt and wear."""
    return np.float32(1) - np.float32(amount) * value_noise(rng, size, [(8, 8), (32, 32), (128, 128)])[..., None]


def _wood(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    grain = value_noise(rng, size, [(3 * scale, 2), (12 * scale, 3), (40 * scale, 5)])
    rings = 0.5 + 0.5 * np.sin(grain * np.float32(30))
    board = np.arange(size) * scale // size
    tone = rng.uniform(0.8, 1.1, scale).astype(np.float32)[board][:, None, None]
    surface = _mix(colors[0], colors[1], 0.6 * grain + 0.25 * rings) * tone
    gap = (np.arange(size) * scale % size < max(scale, size // 100 * scale)).astype(np.float32)
    return _mix(surface, colors[2] * np.float32(0.4), np.repeat(gap[:, None], size, axis=1))


def _tiles(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    index = np.arange(size) * scale // size
    tone = rng.uniform(0.85, 1.0, (scale, scale)).astype(np.float32)[index][:, index][..., None]
    marble = value_noise(rng, size, _octaves(scale))
    surface = _mix(colors[0], colors[1], 0.35 * marble) * tone
    joint = np.arange(size) * scale % size < max(scale, 0.05 * size)
    lines = (joint[:, None] | joint[None, :]).astype(np.float32)
    return _mix(surface, colors[2], lines)


def _fabric(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    phase = np.arange(size, dtype=np.float32) * (2 * np.pi * 8 * scale / size)
    weave = 0.5 + 0.25 * (np.sin(phase)[:, None] + np.sin(phase)[None, :])
    band = np.arange(size) * scale // size % 3 == 0
    cloth = _mix(colors[0], colors[1], 0.45 * (band[:, None].astype(np.float32) + band[None, :]))
    return np.asarray(cloth * (0.75 + 0.25 * weave[..., None]) * _shade(rng, size, 0.15), dtype=np.float32)


def _gravel(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    count = min(1500, 12 * scale * scale)
    out = np.tile(colors[2] * np.float32(0.5), (size, size, 1))
    for _ in range(count):
        center = rng.integers(0, size, 2)
        radii = np.maximum(1, rng.uniform(0.15, 0.4, 2) * size / scale).astype(int)
        share = rng.random(2)
        color = (colors[0] + (colors[1] - colors[0]) * share[0]) * (0.6 + 0.4 * share[1])
        angle = float(rng.uniform(0, 180))
        # A stone that crosses the border is drawn again one period away, so that the texture tiles.
        for dx in (-size, 0, size):
            for dy in (-size, 0, size):
                x, y = int(center[0] + dx), int(center[1] + dy)
                reach = int(radii.max())
                if -reach < x < size + reach and -reach < y < size + reach:
                    cv2.ellipse(out, ((x, y), (2.0 * radii[0], 2.0 * radii[1]), angle), color.tolist(), -1)
    return out * _shade(rng, size, 0.3)


def _letters(
    rng: np.random.Generator, out: Float32Array, color: Float32Array, lines: int, left: float, right: float
) -> None:
    """Draw lines of word-sized dashes in place: small print as seen from half a metre."""
    height, size = out.shape[0] / lines, out.shape[1]
    for line in range(lines):
        x = left * size
        top, bottom = int((line + 0.3) * height), int((line + 0.7) * height)
        while x < right * size and rng.random() > 0.04:
            width = rng.uniform(0.4, 2.0) * height
            cv2.rectangle(out, (int(x), top), (int(min(x + width, right * size)), bottom), color.tolist(), -1)
            x += width + 0.4 * height


def _paper(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    out = np.full((size, size, 3), 235, dtype=np.float32) * _shade(rng, size, 0.05)
    _letters(rng, out, colors[2] * np.float32(0.4), 6 * scale, 0.06, 0.94)
    for _ in range(scale):
        x, y = (rng.random(2) * 0.7 * size).astype(int)
        w, h = (rng.uniform(0.1, 0.3, 2) * size).astype(int)
        color = colors[int(rng.integers(0, 2))].tolist()
        cv2.rectangle(out, (int(x), int(y)), (int(x + w), int(y + h)), color, -1)
    return out


def _stripes(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    vertical = rng.random() < 0.5
    index = np.arange(size) * 3 * scale // size
    choice = rng.integers(0, 3, 3 * scale)[index]
    row = np.stack(colors)[choice]
    out = np.repeat(row[:, None], size, axis=1)
    return np.asarray(out if vertical else out.swapaxes(0, 1), dtype=np.float32) * _shade(rng, size, 0.08)


def draw_word(word: str, size: int, left: float, middle: float) -> Float32Array:
    """Draw a complete word, at most two thirds of the texture wide: (size, size), 1 = ink.

    Args:
        word: the text.
        size: pixels per side.
        left: share of the remaining width that is to the left of the word, 0..1.
        middle: vertical position of the word's middle as a share of the height, 0..1.
    """
    font, thick, margin = cv2.FONT_HERSHEY_SIMPLEX, max(1, size // 40), 0.05 * size
    scale = size / 110
    (width, _), _ = cv2.getTextSize(word, font, scale, thick)
    scale *= min(1.0, 0.66 * size / width)
    (width, height), _ = cv2.getTextSize(word, font, scale, thick)
    x, y = margin + left * (size - width - 2 * margin), middle * size + height / 2
    ink = np.zeros((size, size), dtype=np.uint8)
    cv2.putText(ink, word, (round(x), round(y)), font, scale, (255,), thick)
    return ink.astype(np.float32) / np.float32(255)


def _readable(color: Float32Array, ground: Float32Array) -> Float32Array:
    """The colour itself, or black or white where its contrast with the ground is too low."""
    far = float(np.abs(color - ground).mean()) > MIN_CONTRAST
    return color if far else np.full(3, 20 if ground.mean() > 127 else 235, dtype=np.float32)


def _label(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    out = _plain(rng, size, scale, colors)
    for _ in range(int(rng.integers(1, 4))):
        x, y = (rng.random(2) * size).astype(int)
        cv2.circle(out, (int(x), int(y)), int(rng.uniform(0.06, 0.2) * size), colors[2].tolist(), -1)
    # The band with the name and the small print are drawn over the spots and do not overlap, so that both are legible.
    top, height = rng.uniform(0.04, 0.25), rng.uniform(0.24, 0.34)
    cv2.rectangle(out, (0, int(top * size)), (size, int((top + height) * size)), colors[1].tolist(), -1)
    word = "".join(chr(65 + letter) for letter in rng.integers(0, 26, int(rng.integers(3, 7))))
    ink = draw_word(word, size, float(rng.random()), top + height / 2)
    out = _mix(out, _readable(colors[2], colors[1]), ink)
    rows, columns = slice(int(0.63 * size), int(0.97 * size)), slice(int(0.5 * size), int(0.96 * size))
    panel = np.full_like(out[rows, columns], 225)
    _letters(rng, panel, np.full(3, 40, dtype=np.float32), 7, 0.06, 0.94)
    out[rows, columns] = panel
    return out


def _package(rng: np.random.Generator, size: int, scale: int, colors: Colors) -> Float32Array:
    """A printed carton: two panels side by side, each with a name, a picture and small print, and a plain side."""
    out = _plain(rng, size, scale, colors)
    half = size // 2
    word = "".join(chr(65 + letter) for letter in rng.integers(0, 26, int(rng.integers(4, 8))))
    band = rng.uniform(0.12, 0.3)
    blobs = [(rng.random(2), rng.uniform(0.05, 0.2), rng.random(3) * 255) for _ in range(int(rng.integers(3, 9)))]
    ink = draw_word(word, half, float(rng.random()), 0.5)
    for left in (0, half):
        panel = out[:, left : left + half - size // 6]
        width = panel.shape[1]
        cv2.rectangle(panel, (0, int(0.4 * size)), (width, int(0.8 * size)), colors[1].tolist(), -1)
        for place, radius, color in blobs:
            center = (int(place[0] * width), int((0.45 + 0.3 * place[1]) * size))
            cv2.circle(panel, center, max(1, int(radius * half)), color.tolist(), -1)
        top = int(band * size)
        rows = slice(top, top + half)
        name = cv2.resize(ink, (width, half), interpolation=cv2.INTER_AREA).astype(np.float32)
        cv2.rectangle(panel, (0, top + half // 3), (width, top + 2 * half // 3), colors[2].tolist(), -1)
        panel[rows] = _mix(panel[rows], _readable(colors[0], colors[2]), name)
        _letters(rng, panel[int(0.84 * size) :], np.full(3, 40, dtype=np.float32), 3, 0.06, 0.94)
    return out


PATTERNS: dict[str, Callable[[np.random.Generator, int, int, Colors], Float32Array]] = {
    "wood": _wood,
    "tiles": _tiles,
    "fabric": _fabric,
    "gravel": _gravel,
    "noise": _noise,
    "checker": _checker,
    "plain": _plain,
    "paper": _paper,
    "label": _label,
    "package": _package,
    "stripes": _stripes,
}
"""Patterns by name; arguments: random generator, pixels per side, features per side, colours."""
