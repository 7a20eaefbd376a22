"""Random bytes, random arrays and damaged files may raise only `ObjectflowError`."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion
from objectflow.errors import ObjectflowError
from objectflow.typing import Float64Array

CAMERA = Camera(width=8, height=6, fx=9.0, fy=9.0, cx=3.5, cy=2.5)
COLOR = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(500, 2000, (6, 8), dtype=np.uint16)

fuzz = settings(
    derandomize=True,
    deadline=None,
    max_examples=150,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
numbers = st.floats() | st.integers() | st.sampled_from([8, 6, 9.0, 3.5, 10**400, -(10**400), 1e308, 5e-324])
json_values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
damages = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6)


def value_or_error(call: Callable[[], Any]) -> Any:
    """The return value of the call, or None if it raised a one-line `ObjectflowError`; other errors propagate."""
    try:
        return call()
    except ObjectflowError as error:
        message = str(error)
    assert "\n" not in message
    return None


def damaged(data: bytes, damage: list[tuple[float, int]]) -> bytes:
    """Overwrite bytes at shares of the length; an odd number of damages also truncates the data at the last."""
    out = bytearray(data)
    for share, value in damage:
        out[int(share * (len(out) - 1))] = value
    return bytes(out[: int(damage[-1][0] * len(out))] if len(damage) % 2 else out)


def encoded(kind: str, image: NDArray[Any]) -> bytes:
    return cv2.imencode(kind, image)[1].tobytes()


# --- cameras ---


@given(st.fixed_dictionaries(dict.fromkeys(CAMERA.to_dict(), numbers | json_values)))
@fuzz
def test_cameras_of_random_values(values: dict[str, Any]) -> None:
    camera = value_or_error(lambda: Camera(**values))
    if camera is not None:
        assert all(math.isfinite(value) for value in camera.to_dict().values())
        assert camera.fx > 0
        assert camera.width >= 1


@given(st.sampled_from([*sorted(CAMERA.to_dict()), "depth_scale"]), numbers | json_values)
@fuzz
def test_camera_files_with_one_random_value(tmp_path: Path, name: str, value: Any) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA.to_dict() | {"depth_scale": 1000, name: value}))
    read = value_or_error(lambda: Camera.read(path))
    if read is not None and name != "depth_scale":
        assert read[0].to_dict()[name] == value


@given(st.binary(max_size=80) | st.builds(damaged, st.just(json.dumps(CAMERA.to_dict()).encode()), damages))
@fuzz
def test_camera_files_of_random_and_damaged_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(content)
    read = value_or_error(lambda: Camera.read(path))
    assert read is None or isinstance(read[0], Camera)


# --- frames ---


@given(hnp.arrays(np.float64, (6, 8), elements=st.floats() | st.floats(0.1, 9)), st.sampled_from("efdg"))
@fuzz
def test_frames_of_random_depth_of_every_float(depth: Float64Array, kind: str) -> None:
    with np.errstate(all="ignore"):
        values = depth.astype(kind)
    frame = value_or_error(lambda: RgbdFrame(color=COLOR, depth=values, camera=CAMERA))
    if frame is not None:
        assert frame.depth.dtype == np.float32
        assert np.isfinite(frame.depth).all()
        assert frame.depth.min() >= 0
        assert frame.valid.any()


@given(
    hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=1, max_dims=3, max_side=4)) | json_values,
    hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=1, max_dims=3, max_side=4)) | json_values,
    st.sampled_from([CAMERA, None, CAMERA.matrix, "camera"]),
)
@fuzz
def test_frames_of_random_objects(color: Any, depth: Any, camera: Any) -> None:
    # No array has the size of the camera's image, so no frame is valid.
    assert value_or_error(lambda: RgbdFrame(color=color, depth=depth, camera=camera)) is None


COLOR_FILES = [encoded(".png", COLOR), encoded(".jpg", COLOR), encoded(".bmp", COLOR), encoded(".tiff", COLOR)]
DEPTH_FILES = [encoded(".png", DEPTH), encoded(".tiff", DEPTH), encoded(".png", DEPTH.astype(np.uint8))]
signatures = st.sampled_from(
    [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"BM", b"II*\x00", b"GIF89a", b"P5 8 6 65535 "]
)
random_files = st.builds(bytes.__add__, signatures, st.binary(max_size=60))


@given(
    random_files | st.sampled_from(COLOR_FILES) | st.builds(damaged, st.sampled_from(COLOR_FILES), damages),
    random_files | st.sampled_from(DEPTH_FILES) | st.builds(damaged, st.sampled_from(DEPTH_FILES), damages),
    st.sampled_from([1000, 1000, 1000, 1e-300, 1e300]),
)
@fuzz
def test_image_files_of_random_and_damaged_bytes(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], color: bytes, depth: bytes, scale: float
) -> None:
    (tmp_path / "color.png").write_bytes(color)
    (tmp_path / "depth.png").write_bytes(depth)
    frame = value_or_error(
        lambda: RgbdFrame.read(tmp_path / "color.png", tmp_path / "depth.png", camera=CAMERA, depth_scale=scale)
    )
    if frame is not None:
        assert frame.color.shape == (6, 8, 3)
        assert frame.depth.dtype == np.float32


@given(damages)
@fuzz
def test_a_damaged_depth_png_is_refused_or_unchanged(tmp_path: Path, damage: list[tuple[float, int]]) -> None:
    (tmp_path / "color.png").write_bytes(COLOR_FILES[0])
    (tmp_path / "depth.png").write_bytes(damaged(DEPTH_FILES[0], damage))
    frame = value_or_error(lambda: RgbdFrame.read(tmp_path / "color.png", tmp_path / "depth.png", camera=CAMERA))
    if frame is not None:  # The damage rewrote the same value or hit an irrelevant byte.
        np.testing.assert_array_equal(frame.depth, DEPTH.astype(np.float32) / np.float32(1000))


# --- results ---


@pytest.fixture
def result(tmp_path: Path) -> Path:
    labels = np.random.default_rng(2).integers(0, 2, (6, 8), dtype=np.int32)
    obj = ObjectMotion(1, int(labels.sum()), 0.5, True, np.array([0.0, 0.1, 0.7]), np.eye(4))
    flow = np.random.default_rng(3).normal(size=(6, 8, 3)).astype(np.float32)
    SceneMotion(labels, flow, (obj,), np.eye(4), "made up", 0.5).save(tmp_path / "out")
    return tmp_path / "out"


def check_load(folder: Path) -> None:
    """Load a result folder; if it is accepted, it must be consistent."""
    motion = value_or_error(lambda: SceneMotion.load(folder))
    if motion is not None:
        assert motion.labels.dtype == np.int32
        assert motion.scene_flow.shape == (*motion.labels.shape, 3)
        assert set(np.unique(motion.labels)) <= {0} | {obj.id for obj in motion.objects}
        assert all(np.isfinite(obj.prev_T_curr).all() for obj in motion.objects)


@given(st.sampled_from(["labels.png", "scene_flow.npy", "objects.json"]), st.none() | random_files, damages)
@fuzz
def test_result_folders_with_one_damaged_file(
    result: Path, name: str, content: bytes | None, damage: list[tuple[float, int]]
) -> None:
    whole = (result / name).read_bytes()
    (result / name).write_bytes(damaged(whole, damage) if content is None else content)
    check_load(result)
    (result / name).write_bytes(whole)


@given(
    st.sampled_from(["objects", "camera_motion", "method", "seconds", "width", "height"]),
    st.sampled_from([None, "id", "pixels", "score", "moving", "center", "prev_T_curr"]),
    numbers | json_values,
)
@fuzz
def test_result_folders_with_one_random_value(result: Path, name: str, inner: str | None, value: Any) -> None:
    whole = (result / "objects.json").read_text()
    summary = json.loads(whole)
    if inner is None:
        summary[name] = value
    else:
        summary["objects"][0][inner] = value
    (result / "objects.json").write_text(json.dumps(summary))
    check_load(result)
    (result / "objects.json").write_text(whole)


@pytest.mark.filterwarnings("ignore")  # The header is parsed as a Python literal, which may have invalid escapes.
@given(st.binary(max_size=60), st.floats(0, 1))
@fuzz
def test_flow_files_with_a_damaged_header(result: Path, junk: bytes, share: float) -> None:
    whole = (result / "scene_flow.npy").read_bytes()
    at = 10 + int(share * 60)
    (result / "scene_flow.npy").write_bytes(whole[:at] + junk + whole[at + len(junk) :])
    check_load(result)
    (result / "scene_flow.npy").write_bytes(whole)
