"""`objectflow view RESULT --web` in headless Chromium: rerun's web viewer opens and draws the result."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from browser import chromium, find_chromium
from objectflow import geometry
from objectflow.cli.demo_truth import DemoTruth
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.readers import open_pair
from objectflow.typing import Int64Array
from objectflow.view.colors import object_color

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"
TIMEOUT = 240.0
"""Longest time to compile and draw on a busy machine, seconds; an idle machine needs 10 s."""
WORLD, LABELS = (slice(70, 620), slice(0, 770)), (slice(462, 630), slice(780, 1100))
"""Rows and columns of the 3D view and of the labels in a window of 1100x660."""


@pytest.fixture
def program() -> str:
    """Path of Chromium; skips the test if Chromium or rerun is missing."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    found = find_chromium()
    if found is None:
        pytest.skip("no Chromium or Chrome is installed: the web viewer is not opened")
    return found


@pytest.fixture
def address(program: str, tmp_path: Path) -> Iterator[str]:
    """Address of the web viewer, which serves the demo's truth as a result; Ctrl-C must end it."""
    truth = DemoTruth.read(PAIR / "truth.npz")
    _, curr = open_pair(PAIR)
    objects = tuple(
        ObjectMotion(k + 1, int((truth.labels == k + 1).sum()), 1.0, bool(truth.moving[k]), center, motion)
        for k, (center, motion) in enumerate(zip(truth.centers, truth.prev_T_curr, strict=True))
    )
    points = geometry.back_project(curr.depth, curr.camera)
    flow = geometry.flow_from_motions(points, truth.labels, {obj.id: obj.prev_T_curr for obj in objects})
    SceneMotion(truth.labels, flow, objects).save(tmp_path / "result")
    command = ["-m", "objectflow", "view", str(tmp_path / "result"), "--frames", str(PAIR), "--web"]
    server = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        words = server.stdout.readline().split()
        assert words[:1] == ["open"]
        yield words[1]
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=TIMEOUT) == 0
    finally:
        server.kill()
        server.wait()


def share(picture: Int64Array, color: tuple[int, int, int], part: tuple[slice, slice], *, shaded: bool) -> float:
    """Share of the pixels of a part that have a colour, or (if `shaded`) a darker shade of it."""
    pixels = picture[part].reshape(-1, 3)
    bright = np.maximum(pixels.max(axis=1), 1)
    scale = bright[:, None] / max(color) if shaded else 1
    near = np.abs(pixels - scale * np.array(color)).max(axis=1) < 12
    return float((near & (bright > 60)).mean())


def test_the_web_viewer_draws_every_object(address: str, program: str, tmp_path: Path) -> None:
    truth = DemoTruth.read(PAIR / "truth.npz").labels
    numbers = range(1, int(truth.max()) + 1)
    # The labels fill the height of their view but not its width.
    expected = {number: (truth == number).mean() * 225 / 320 for number in numbers}
    world = labels = dict.fromkeys(numbers, 0.0)
    with chromium(program, tmp_path / "profile") as page:
        page.size(1100, 660)
        page.call("Page.navigate", url=address)
        page.wait("document.readyState === 'complete' && document.querySelector('canvas')")
        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end and min(*world.values(), *labels.values()) == 0:
            time.sleep(1.0)
            data = np.frombuffer(page.picture(tmp_path / "web_viewer.png"), np.uint8)
            picture = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(np.int64)
            world = {number: share(picture, object_color(number), WORLD, shaded=True) for number in numbers}
            labels = {number: share(picture, object_color(number), LABELS, shaded=False) for number in numbers}
    assert labels == pytest.approx(expected, rel=0.35)
    assert min(world.values()) > 0.0005, world
