"""Readers raise only `ObjectflowError`, whatever the files hold."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from objectflow.errors import ObjectflowError
from objectflow.readers import CameraOptions, open_source

FUZZ = settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CAMERA = {"width": 16, "height": 12, "fx": 16.0, "fy": 16.0, "cx": 8.0, "cy": 6.0, "depth_scale": 1000}
GOOD = {
    "color": cv2.imencode(".png", np.full((12, 16, 3), 7, np.uint8))[1].tobytes(),
    "depth": cv2.imencode(".png", np.full((12, 16), 900, np.uint16))[1].tobytes(),
}
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(sorted(CAMERA)), inner, max_size=7),
    max_leaves=8,
)


def read_all(folder: Path, options: CameraOptions | None = None) -> int:
    return len([frame.depth for frame in open_source(folder, options)])


def write_good(folder: Path) -> None:
    for index in (0, 1):
        (folder / f"color{index}.png").write_bytes(GOOD["color"])
        (folder / f"depth{index}.png").write_bytes(GOOD["depth"])
    (folder / "camera.json").write_text(json.dumps(CAMERA))


def test_the_valid_pair_is_read(tmp_path: Path) -> None:
    write_good(tmp_path)
    assert read_all(tmp_path) == 2


@pytest.mark.parametrize("name", ["color1.png", "depth0.png", "camera.json"])
@given(data=st.binary(max_size=300))
@FUZZ
def test_random_bytes(tmp_path: Path, name: str, data: bytes) -> None:
    write_good(tmp_path)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ObjectflowError):
        read_all(tmp_path)


@pytest.mark.parametrize("kind", ["color", "depth"])
@given(where=st.integers(0, 60), value=st.binary(min_size=1, max_size=8), cut=st.integers(0, 40))
@FUZZ
def test_damaged_images(tmp_path: Path, kind: str, where: int, value: bytes, cut: int) -> None:
    write_good(tmp_path)
    data = bytearray(GOOD[kind])
    data[where : where + len(value)] = value
    (tmp_path / f"{kind}1.png").write_bytes(bytes(data[: len(data) - cut]))
    with suppress(ObjectflowError):
        assert read_all(tmp_path) == 2


@given(values=st.dictionaries(st.sampled_from(sorted(CAMERA)), json_values, max_size=7) | json_values)
@example(values={**CAMERA, "fx": float("nan")})
@example(values={**CAMERA, "width": 10**400})
@example(values={**CAMERA, "depth_scale": 10**400})
@example(values={**CAMERA, "depth_scale": "1000"})
@FUZZ
def test_random_camera_files(tmp_path: Path, values: Any) -> None:
    write_good(tmp_path)
    mixed = {**CAMERA, **values} if isinstance(values, dict) else values
    (tmp_path / "camera.json").write_text(json.dumps(mixed))
    with suppress(ObjectflowError):
        assert read_all(tmp_path) == 2


@given(rgb=st.binary(max_size=80) | st.text(max_size=80).map(lambda text: text.encode("utf-8", "ignore")))
@example(rgb=b"1.0 color0.png\n1e400 color1.png")
@example(rgb=b"1.0 " + b"a" * 5000)
@FUZZ
def test_random_lists(tmp_path: Path, rgb: bytes) -> None:
    write_good(tmp_path)
    (tmp_path / "rgb.txt").write_bytes(rgb)
    (tmp_path / "depth.txt").write_text("1.0 depth0.png\n")
    with suppress(ObjectflowError):
        assert read_all(tmp_path) <= 1


@given(numbers=st.tuples(*[st.floats()] * 4), scale=st.floats())
@FUZZ
def test_random_options(tmp_path: Path, numbers: tuple[float, float, float, float], scale: float) -> None:
    write_good(tmp_path)
    with suppress(ObjectflowError):
        assert read_all(tmp_path, CameraOptions(intrinsics=numbers, depth_scale=scale)) == 2
