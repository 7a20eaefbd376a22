"""`loss_curve.png`: a run's training and validation loss, as in the paper's loss figure, and its metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.storage import files
from objectflow.storage.images import encode_png
from objectflow.typing import Float64Array, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import Rgb

PANEL_WIDTH, PANEL_HEIGHT = 760, 560
"""Size of a panel in pixels."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 92, 48, 66, 74
_INK, _GRID, _BLUE, _RED, _GREY = (40, 40, 40), (225, 225, 225), (31, 90, 180), (200, 50, 40), (140, 140, 140)
_SMOOTH = 0.04
"""Share of the run over which the training loss is averaged for the thick line, 0..1."""


@dataclass(frozen=True)
class Series:
    """One line of a panel: its name, colour and points (x, y); `thin` lines form the background."""

    name: str
    color: Rgb
    points: Sequence[tuple[float, float]]
    thin: bool = False


def write_curve(path: Path, lines: Sequence[Mapping[str, Any]], *, title: str = "") -> None:
    """Draw a run's metrics as a PNG file.

    Args:
        path: of the picture.
        lines: from `read_metrics`.
        title: the run's name, above the first panel.

    Raises:
        StorageError: the picture cannot be written.
    """
    files.write_bytes(path, encode_png(draw_curves(lines, title)))


def draw_curves(lines: Sequence[Mapping[str, Any]], title: str = "") -> UInt8Array:
    """The picture, (PANEL_HEIGHT, 3 PANEL_WIDTH, 3) uint8, with panels for loss, end-point error and segmentation."""
    train = [line for line in lines if line["kind"] == "train"]
    validation = [line for line in lines if line["kind"] == "validation"]
    loss = points_of(train, "losses", "total")
    panels = [
        panel(
            [
                Series("", (190, 207, 235), loss, thin=True),
                Series("training", _BLUE, smoothed(loss)),
                Series("validation", _RED, points_of(validation, "losses", "total")),
            ],
            f"{title}: loss" if title else "loss",
            logarithmic=True,
        ),
        panel(
            [
                Series("zero flow", _GREY, points_of(validation, "zero_epe_cm")),
                Series("validation", _RED, points_of(validation, "epe_cm")),
            ],
            "masked end-point error, cm",
        ),
        panel(
            [
                Series("mean F", _RED, points_of(validation, "mean_f")),
                Series("share of extracted objects", _BLUE, points_of(validation, "extracted_share")),
            ],
            "segmentation",
        ),
    ]
    return np.concatenate(panels, axis=1)


def panel(series: Sequence[Series], title: str, *, logarithmic: bool = False) -> UInt8Array:
    """One diagram over steps, (PANEL_HEIGHT, PANEL_WIDTH, 3) uint8, or a note that there are no points yet."""
    image: UInt8Array = np.full((PANEL_HEIGHT, PANEL_WIDTH, 3), 255, np.uint8)
    canvas.write(image, title, _LEFT, 34, 26, _INK, bold=True)
    xs = [x for one in series for x, _ in one.points]
    ys = [y for one in series for _, y in one.points if y > 0 or not logarithmic]
    if not ys:
        canvas.write(image, "nothing measured yet", _LEFT + 20, PANEL_HEIGHT / 2, 22, _GREY)
        return image
    low, high = (min(ys) / 1.1, max(ys) * 1.1) if logarithmic else (0.0, 1.08 * max(ys) or 1.0)
    most = max(xs) or 1.0

    def place(x: float, y: float) -> tuple[float, float]:
        a, b, value = (math.log(max(one, low)) for one in (low, high, y)) if logarithmic else (low, high, y)
        share = (value - a) / (b - a)
        return (
            _LEFT + (PANEL_WIDTH - _LEFT - _RIGHT) * x / most,
            PANEL_HEIGHT - _BOTTOM - (PANEL_HEIGHT - _TOP - _BOTTOM) * min(max(share, 0.0), 1.0),
        )

    for value in _ticks(low, high, logarithmic):
        left, y = place(0, value)
        canvas.line(image, [(left, y), (PANEL_WIDTH - _RIGHT, y)], _GRID, 1)
        text = f"{value:g}"
        canvas.write(image, text, _LEFT - 10 - canvas.text_size(text, 20)[0], y + 7, 20, _INK)
    for value in _ticks(0, most, False):
        x, _ = place(value, low)
        canvas.line(image, [(x, PANEL_HEIGHT - _BOTTOM), (x, PANEL_HEIGHT - _BOTTOM + 6)], _INK, 1)
        text = f"{value:g}"
        canvas.write(image, text, x - canvas.text_size(text, 20)[0] / 2, PANEL_HEIGHT - _BOTTOM + 28, 20, _INK)
    canvas.write(image, "step", PANEL_WIDTH / 2, PANEL_HEIGHT - 14, 20, _INK)
    for one in series:
        points = [place(x, y) for x, y in one.points]
        if len(points) > 1:
            canvas.line(image, points, one.color, 1 if one.thin else 3)
        if len(points) <= 30 and not one.thin:
            for point in points:
                canvas.disk(image, point, 4.5, one.color)
    corners = [(_LEFT, _TOP), (_LEFT, PANEL_HEIGHT - _BOTTOM), (PANEL_WIDTH - _RIGHT, PANEL_HEIGHT - _BOTTOM)]
    canvas.line(image, [(float(x), float(y)) for x, y in corners], _INK, 1)
    _legend(image, [one for one in series if one.name and one.points])
    return image


def _legend(image: UInt8Array, series: Sequence[Series]) -> None:
    """Draw the names above the diagram, each beside a sample of its line."""
    x = float(_LEFT)
    for one in series:
        canvas.line(image, [(x, 52.0), (x + 28, 52.0)], one.color, 3)
        canvas.write(image, one.name, x + 36, 58, 20, _INK)
        x += 60 + canvas.text_size(one.name, 20)[0]


def points_of(lines: Sequence[Mapping[str, Any]], *names: str) -> list[tuple[float, float]]:
    """(step, value) of the lines that have a value under the nested keys `names`."""
    points = []
    for line in lines:
        value: Any = line
        for name in names:
            value = value.get(name) if isinstance(value, Mapping) else None
        if value is not None:
            points.append((float(line["step"]), float(value)))
    return points


def smoothed(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The mean over a window around each point; the window shrinks towards the ends."""
    if not points:
        return []
    values: Float64Array = np.array(points)
    half = int(len(points) * _SMOOTH / 2)
    sums = np.concatenate([[0.0], np.cumsum(values[:, 1])])
    index = np.arange(len(points))
    reach = np.minimum(half, np.minimum(index, len(points) - 1 - index))
    mean = (sums[index + reach + 1] - sums[index - reach]) / (2 * reach + 1)
    return [(float(x), float(y)) for x, y in zip(values[:, 0], mean, strict=True)]


def _ticks(low: float, high: float, logarithmic: bool) -> list[float]:
    """About four to eight round values between two bounds."""
    if logarithmic and high / low > 5:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        digits = (1, 2, 5) if high / low < 1000 else (1,)
        return [digit * 10.0**power for power in powers for digit in digits if low <= digit * 10.0**power <= high]
    rough = (high - low) / 5
    unit = 10.0 ** math.floor(math.log10(rough))
    step = unit * min((digit for digit in (1, 2, 5, 10) if digit * unit >= rough), default=10)
    first = math.ceil(low / step)
    return [round(index * step, 10) for index in range(first, math.floor(high / step) + 1)]
