"""Mutated files that once let a foreign exception out, hung, or took gigabytes: each gives one of our errors."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuzz.doors import frames_of, rows_of
from fuzz.harness import judged
from objectflow import Camera, RgbdFrame
from objectflow.dataset.manifest import Manifest, verify
from objectflow.evaluation.cache import read_prediction
from objectflow.networks.sceneflownet.backbone import Trunk, load_backbone
from objectflow.networks.weights import load_network

CASES = Path(__file__).parents[3] / "shared" / "cases" / "broken"
NAMES = sorted(path.name for path in CASES.iterdir()) if CASES.is_dir() else []
READ = {"bag", "metadata"}
"""Kinds of which what is whole may be read."""
NUMPY = {"np": np, "Decimal": Decimal, "inf": np.inf, "nan": np.nan, "array": np.array}

pytestmark = pytest.mark.skipif(not NAMES, reason="the mutated files are not beside this checkout")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_foreign_comes_out(name: str, tmp_path: Path) -> None:
    case = tmp_path / "case"
    shutil.copytree(CASES / name, case)
    kind, outcome = name.partition("-")[0], list[str]()

    def read() -> None:
        use(kind, case)
        outcome.append("read")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert judged(read) == []
    assert not outcome or kind in READ


def use(kind: str, case: Path) -> None:
    files = [path for path in case.iterdir() if path.name != "WHY.txt"]
    if kind in ("bag", "metadata", "camera", "pair", "tum"):
        if kind == "tum" and (case / "rgb.txt").is_file() and not (case / "depth.txt").is_file():
            (case / "rgb").mkdir()
            os.mkfifo(case / "rgb" / "fifo.png")
            (case / "depth.txt").write_text((case / "rgb.txt").read_text())
            (case / "camera.json").write_text(json.dumps({**CAMERA.to_dict(), "depth_scale": 1000}))
        frames_of(case if kind == "tum" else files[0])()
    elif kind == "frame":
        _frame(files[0].read_text(encoding="utf-8", errors="surrogatepass"))
    elif kind == "manifest":
        verify(case / "set", Manifest.read(case / "set"))
        rows_of(case / "set")()
    elif kind == "parquet":
        rows_of(case / "set")()
    elif kind == "npz":
        read_prediction(files[0])
    elif kind == "torch":
        load_backbone(Trunk(8, (1, 1)), files[0])
    elif kind == "weights":
        load_network(_weights(files[0]))


CAMERA = Camera(width=48, height=36, fx=46.0, fy=46.0, cx=23.5, cy=17.5)


def _frame(text: str) -> None:
    values: Any = eval(text, NUMPY)
    if isinstance(values, dict):
        Camera(**values)
    else:
        frame = RgbdFrame(np.zeros((36, 48, 3), np.uint8), np.ones((36, 48), np.float32), CAMERA)
        frame.resized(*values)


def _weights(header: Path) -> Path:
    """A file with this header, and zeros as tensors."""
    text = header.read_bytes()
    entries = json.loads(text)
    size = max(entry["data_offsets"][1] for name, entry in entries.items() if name != "__metadata__")
    path = header.with_name("network.safetensors")
    path.write_bytes(len(text).to_bytes(8, "little") + text)
    os.truncate(path, 8 + len(text) + size)
    return path
