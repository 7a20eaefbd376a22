"""The report's JavaScript computes the colours of `view/colors.py`; it runs in Node or Chromium."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import chromium, find_chromium
from helpers.report_set import make_pair
from objectflow.typing import UInt8Array
from objectflow.view import colors
from objectflow.view.report_page.pair_block import TRUTH, make_pair_block

LENGTHS = np.linspace(-1.3, 1.3, 53)


def run(expression: str, folder: Path) -> Any:
    """The value of an expression that may use the page's colour functions."""
    page = resources.files("objectflow.view.report_page")
    parts = [page.joinpath(name).read_text(encoding="utf-8") for name in ("colors.js", "pictures.js")]
    script = "(() => { const NO_FLOW = -32768;\n" + "\n".join(parts) + f"\nreturn {expression}; }})()"
    node, browser = shutil.which("node"), find_chromium()
    if node is not None:
        command = [node, "--print", f"JSON.stringify({script})"]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout)
    if browser is not None:
        with chromium(browser, folder / "profile") as tab:
            return tab.run(script)
    pytest.skip("neither Node nor Chromium is installed: the report's script is not run")


def assert_same(colors: list[list[int]], expected: UInt8Array) -> None:
    """Compare colours up to the rounding of halves, which JavaScript rounds up and NumPy to even."""
    found = np.array(colors).reshape(expected.shape)
    assert np.abs(found - expected).max() <= 1
    assert (found == expected).mean() > 0.999


def test_colour_maps_equal_those_of_the_pictures(tmp_path: Path) -> None:
    right, down = np.meshgrid(LENGTHS, LENGTHS)
    points = json.dumps(np.stack([right, down], axis=-1).reshape(-1, 2).tolist())
    found = run(
        f"{{wheel: {points}.map((p) => wheel(...p)), diverging: {json.dumps(LENGTHS.tolist())}.map(diverging)}}",
        tmp_path,
    )
    assert_same(found["wheel"], colors.wheel(right, down))
    assert_same(found["diverging"], colors.diverging(LENGTHS))


def test_flow_is_coloured_forward_in_time(tmp_path: Path) -> None:
    flow = np.random.default_rng(0).integers(-60, 61, (3, 200))
    full = 0.05
    call = f"flowColor(kind, {json.dumps(flow.ravel().tolist())}, [], i, 200, {full})"
    found = run(f"['across', 'depth'].map((kind) => Array.from({{length: 200}}, (_, i) => {call}))", tmp_path)
    moved = -flow / 1000 / full
    assert_same(found[0], colors.wheel(moved[0], moved[1]))
    assert_same(found[1], colors.diverging(moved[2]))
    missing = run("flowColor('across', [NO_FLOW, NO_FLOW, NO_FLOW], [], 0, 1, 0.05)", tmp_path)
    assert tuple(missing) == colors.NO_DEPTH


def test_objects_have_the_colours_of_the_overlay(tmp_path: Path) -> None:
    pair = make_pair("a pair", 0, (80, 60))
    layer = next(layer for layer in make_pair_block(pair, {}, {})["layers"] if layer["method"] == TRUTH)
    # This grey level of the photo leaves a mask's brightness unchanged.
    shown = run(f"{json.dumps(layer['colors'])}.map((color) => objectColor(color, [188, 188, 188, 255], 0))", tmp_path)
    assert [tuple(color) for color in shown[1:]] == [colors.object_color(o.label) for o in pair.truth.objects]
    assert len(shown) > 2
    assert len(set(shown[0])) == 1  # The background is grey.
