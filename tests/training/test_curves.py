"""The loss figure, tested by its pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from objectflow.training.curves import PANEL_HEIGHT, PANEL_WIDTH, Series, draw_curves, panel, write_curve
from objectflow.typing import IndexArray, UInt8Array

BLUE, RED = (31, 90, 180), (200, 50, 40)


def run_lines() -> list[dict[str, Any]]:
    train = [
        {"kind": "train", "step": step, "losses": {"total": 10 * 0.99 ** (step / 4)}} for step in range(10, 1010, 10)
    ]
    validation = [
        {
            "kind": "validation", "step": step, "losses": {"total": 20.0}, "epe_cm": 6 - step / 250,
            "zero_epe_cm": 6.0, "mean_f": step / 2000, "extracted_share": None,
        }
        for step in (250, 500, 750, 1000)
    ]  # fmt: skip
    return [*train, *validation]


def rows_of(image: UInt8Array, color: tuple[int, int, int], column: int) -> IndexArray:
    """The rows below the legend where a column has a given colour."""
    return np.flatnonzero((image[64:, column] == color).all(axis=-1)) + 64


def test_a_straight_line_lies_where_its_numbers_say() -> None:
    image = panel([Series("a", RED, [(0.0, 0.0), (100.0, 50.0)])], "title")
    ends = [rows_of(image, RED, column).mean() for column in (150, 300, 450, 600)]
    # The slope is constant, and the axis ends at 1.08 of the largest value.
    np.testing.assert_allclose(np.diff(ends), np.diff(ends)[0], atol=1.0)
    slope = -np.diff(ends)[0] / 150
    plot_height, plot_width = PANEL_HEIGHT - 66 - 74, PANEL_WIDTH - 92 - 48
    np.testing.assert_allclose(slope, plot_height / 1.08 / plot_width, rtol=0.02)


def test_an_exponential_is_straight_on_a_logarithmic_axis() -> None:
    points = [(float(step), 8.0 * 0.98**step) for step in range(0, 201, 5)]
    image = panel([Series("a", BLUE, points)], "title", logarithmic=True)
    heights = [rows_of(image, BLUE, column).mean() for column in (200, 350, 500, 650)]
    np.testing.assert_allclose(np.diff(heights), np.diff(heights).mean(), atol=1.0)
    assert heights[0] < heights[-1]


def test_training_falls_and_validation_lies_above() -> None:
    image = draw_curves(run_lines(), "tiny")
    assert image.shape == (PANEL_HEIGHT, 3 * PANEL_WIDTH, 3)
    blue, red = rows_of(image, BLUE, 600), rows_of(image, RED, 600)
    assert red.max() < blue.min()
    # In the second panel, the validation line falls below the constant line of zero flow.
    early, late = (rows_of(image, RED, PANEL_WIDTH + column).mean() for column in (300, 700))
    assert early < late - 50
    # The third panel shows one line: null values of the metrics are left out.
    assert not (image[64:, 2 * PANEL_WIDTH :] == BLUE).all(axis=-1).any()


def test_nothing_measured_yet_is_no_error(tmp_path: Path) -> None:
    write_curve(tmp_path / "curve.png", [])
    drawn = cv2.imread(str(tmp_path / "curve.png"))
    assert drawn is not None
    assert drawn.shape == (PANEL_HEIGHT, 3 * PANEL_WIDTH, 3)
    one = [{"kind": "train", "step": 1, "losses": {"total": 3.0}}]
    write_curve(tmp_path / "curve.png", one)
    again = cv2.imread(str(tmp_path / "curve.png"))
    assert again is not None
    assert (again != drawn).any()
