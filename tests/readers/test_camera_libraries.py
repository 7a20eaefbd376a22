"""The real libraries of live cameras (extras `orbbec`, `oak`), without a camera.

The stand-ins of the other tests have the names and the parameters of these libraries, and the drivers read real frames
that the libraries align and describe. The drivers have not been tested with a physical camera.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from helpers import oak_standin, orbbec_standin
from objectflow.errors import ReaderError
from objectflow.readers.camera_driver import WARM_UP, StreamRequest, read_camera

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
MADE = ("Context", "Config", "Pipeline", "AlignFilter", "Device")
"""Classes whose objects the drivers make; other objects are made by the libraries."""
VALUES = ("OBCameraIntrinsic", "OBCameraDistortion")
"""Classes whose attributes are read."""


@pytest.fixture(params=["orbbec", "oak"])
def pair(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    """A stand-in and the library that it stands in for."""
    if request.param == "orbbec":
        device = orbbec_standin.Camera(encode=lambda _: b"", color=[])
        return device.module(), pytest.importorskip("pyorbbecsdk", reason="extra `orbbec` is not installed")
    module = oak_standin.OakCamera(lambda size, _: np.zeros((*size, 3), np.uint8)).module()
    return module, pytest.importorskip("depthai", reason="extra `oak` is not installed")


def classes(module: Any) -> dict[str, type[Any]]:
    """The classes of a stand-in by their dotted names."""
    found = {name: value for name, value in vars(module).items() if isinstance(value, type)}
    for space in ("node", "Node"):
        found |= {f"{space}.{name}": value for name, value in vars(getattr(module, space, SimpleNamespace())).items()}
    return found


def lookup(module: Any, dotted: str) -> Any:
    for name in dotted.split("."):
        module = getattr(module, name)
    return module


def overloads(function: Any) -> list[list[tuple[str, bool]]]:
    """Parameters of each overload of a pybind11 function without `self`: the name, and whether it has a default."""
    found = []
    for line in (function.__doc__ or "").splitlines():
        match = re.match(r"(?:\d+\. )?\w+\((.*)\) -> ", line.strip())
        if match is None or "*args" in match[1]:
            continue
        parameters, depth, start = [], 0, 0
        text = re.sub(r"<[^<>]*>", "0", match[1]) + ","  # values such as <CameraBoardSocket.???: -1>
        for at, character in enumerate(text):
            depth += (character in "[(") - (character in "])")
            if character == "," and depth == 0:
                one = text[start:at].strip()
                parameters += [(one.split(":")[0], " = " in one)] if one else []
                start = at + 1
        found.append([parameter for parameter in parameters if parameter[0] != "self"])
    return found


def accepts(real: list[tuple[str, bool]], used: inspect.Signature) -> bool:
    """Whether an overload can be called as a function of the stand-in."""
    values = [one for one in used.parameters.values() if one.name != "self"]
    positional = [one for one in values if one.kind is not inspect.Parameter.KEYWORD_ONLY]
    names = [name for name, _ in real]
    by_name = {one.name for one in values if one.kind is inspect.Parameter.KEYWORD_ONLY}
    left = {name for name, has_default in real[len(positional) :] if not has_default}
    return len(positional) <= len(real) and by_name <= set(names[len(positional) :]) and left <= by_name


def test_the_stand_ins_have_the_names_and_parameters_of_the_libraries(pair: tuple[Any, Any]) -> None:
    fake, real = pair
    checked = 0
    for name, fake_class in classes(fake).items():
        real_class = lookup(real, name)
        if hasattr(fake_class, "__members__"):
            assert set(fake_class.__members__) <= set(real_class.__members__), name
            continue
        if name in VALUES:
            missing = {field.name for field in dataclasses.fields(fake_class)} - set(dir(real_class))
            assert missing == set(), name
            continue
        for method, function in vars(fake_class).items():
            if not callable(function) and not isinstance(function, staticmethod):
                continue
            if method.startswith("_") and not (method == "__init__" and name in MADE):
                continue
            assert hasattr(real_class, method), f"{name}.{method}"
            known = overloads(getattr(real_class, method))
            if isinstance(function, type) or not known:
                continue  # classes, and objects that only the library makes
            used = inspect.signature(getattr(fake_class, method))
            assert any(accepts(one, used) for one in known), f"{name}.{method}{used} is not among {known}"
            checked += 1
    assert checked > 15


def test_attributes_of_nodes_exist(pair: tuple[Any, Any]) -> None:
    fake, real = pair
    for name in vars(getattr(fake, "node", SimpleNamespace())):
        for attribute in vars(getattr(fake.node, name)()):
            if attribute[0] != "_" and attribute not in ("checks", "subpixel"):
                assert hasattr(getattr(real.node, name), attribute), f"{name}.{attribute}"


def orbbec_frames(ob: Any, number: int) -> Any:
    """A frame set of the real SDK: a step in depth at column 50, from 1 m to 2 m, and a lens with distortion."""
    K = ob.OBCameraIntrinsic()
    K.width, K.height, K.fx, K.fy, K.cx, K.cy = WIDTH, HEIGHT, FOCAL, FOCAL, 31.5, 23.5
    lens, none, extrinsics = ob.OBCameraDistortion(), ob.OBCameraDistortion(), ob.OBExtrinsic()
    lens.model, lens.k1, lens.p1 = ob.OBCameraDistortionModel.BROWN_CONRADY, -0.3, 0.002
    extrinsics.rot, extrinsics.transform = np.eye(3, dtype=np.float32), np.zeros(3, np.float32)
    color = ob.Frame.create_video_frame(ob.OBFrameType.COLOR_FRAME, ob.OBFormat.RGB, WIDTH, HEIGHT)
    color.update_data(orbbec_color(number).tobytes())
    ob.Frame.set_frame_device_timestamp_us(color, 1_000_000 + 40_000 * number)
    depth = ob.Frame.create_video_frame(ob.OBFrameType.DEPTH_FRAME, ob.OBFormat.Y16, WIDTH, HEIGHT)
    units = np.full((HEIGHT, WIDTH), 10_000, np.uint16)
    units[:, 50:] = 20_000
    depth.update_data(units.tobytes())
    depth.as_depth_frame().set_value_scale(0.1)
    to = color.get_stream_profile().as_video_stream_profile()
    to.set_intrinsic(K)
    to.set_distortion(lens)
    of = depth.get_stream_profile().as_video_stream_profile()
    of.set_intrinsic(K)
    of.set_distortion(none)
    of.bind_extrinsic_to(to, extrinsics)
    frames = ob.Frame.create_frame_set()
    frames.push_frame(color)
    frames.push_frame(depth)
    return frames


def orbbec_color(number: int) -> Any:
    out = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    out[..., 0], out[..., 1], out[..., 2] = 3 * np.arange(WIDTH), 4 * np.arange(HEIGHT)[:, None], number
    return out


def test_orbbec_frames_that_the_real_sdk_aligns(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    ob = pytest.importorskip("pyorbbecsdk", reason="extra `orbbec` is not installed")
    monkeypatch.chdir(tmp_path)
    sets = iter(range(100))
    profile = orbbec_frames(ob, 0).get_color_frame().get_stream_profile().as_video_stream_profile()
    calls = []
    pipeline = SimpleNamespace(
        get_stream_profile_list=lambda _: SimpleNamespace(get_default_video_stream_profile=lambda: profile),
        enable_frame_sync=lambda: calls.append("sync"),
        start=lambda config: calls.append(type(config).__name__),
        wait_for_frames=lambda _: orbbec_frames(ob, next(sets)),
        stop=lambda: calls.append("stop"),
    )
    monkeypatch.setattr(ob, "Pipeline", lambda: pipeline)
    frames = read_camera(importlib.import_module("objectflow.readers.orbbec").Orbbec())
    frame = next(frames)
    frames.close()
    assert calls == ["sync", "Config", "stop"]
    assert frame.timestamp == pytest.approx(1 + 0.04 * WARM_UP)
    assert frame.camera.matrix.tolist() == [[FOCAL, 0, 31.5], [0, FOCAL, 23.5], [0, 0, 1]]
    # Depth and lens have one position, so that the step stays where it is on the pixels of a pinhole camera.
    np.testing.assert_allclose(frame.depth[:, :50], 1.0, rtol=1e-6)
    np.testing.assert_allclose(frame.depth[:, 51:], 2.0, rtol=1e-6)  # near pixels are splatted over their neighbours
    expected = cv2.undistort(orbbec_color(WARM_UP), frame.camera.matrix, np.array([-0.3, 0, 0.002, 0, 0]))
    assert np.abs(frame.color.astype(int) - expected.astype(int)).max() <= 1


def test_no_orbbec_camera(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ob = pytest.importorskip("pyorbbecsdk", reason="extra `orbbec` is not installed")
    monkeypatch.chdir(tmp_path)
    driver = importlib.import_module("objectflow.readers.orbbec").Orbbec
    with pytest.raises(ReaderError, match=r"no Orbbec camera \(Device not found by serial number: none\)"):
        next(read_camera(driver(), StreamRequest(serial="none")))
    if len(ob.Context().query_devices()) == 0:
        with pytest.raises(ReaderError, match=r"no Orbbec camera \(No device found\)"):
            next(read_camera(driver()))
    assert list(tmp_path.iterdir()) == []


def test_oak_frames_of_the_real_library(monkeypatch: pytest.MonkeyPatch) -> None:
    dai = pytest.importorskip("depthai", reason="extra `oak` is not installed")
    module = importlib.import_module("objectflow.readers.oak")
    driver = module.Oak()
    queue = dai.MessageQueue("out", 100, False)
    monkeypatch.setattr(driver, "open", lambda _: setattr(driver, "_queue", queue))
    for number in range(WARM_UP + 1):
        queue.send(oak_group(dai, number))
    frames = read_camera(driver)
    frame = next(frames)
    np.testing.assert_array_equal(frame.color, orbbec_color(WARM_UP))
    np.testing.assert_allclose(frame.depth, 0.75, rtol=1e-6)
    assert frame.timestamp == pytest.approx(50 + 0.05 * WARM_UP)
    # The sensor's 128x112 pixels at focal length 120 were halved and cut by 4 rows above and below.
    np.testing.assert_allclose(frame.camera.matrix, [[60, 0, 32], [0, 60, 24], [0, 0, 1]])
    queue.close()
    with pytest.raises(ReaderError, match=r"the OAK camera stopped: .*closed"):
        next(frames)


def oak_group(dai: Any, number: int) -> Any:
    color, depth = dai.ImgFrame(), dai.ImgFrame()
    color.setType(dai.ImgFrame.Type.RGB888i)
    color.setSize(WIDTH, HEIGHT)
    color.setData(orbbec_color(number).ravel())
    color.setTimestamp(timedelta(seconds=50 + 0.05 * number))
    transformation = dai.ImgTransformation(128, 112, [[120.0, 0, 64], [0, 120.0, 56], [0, 0, 1]])
    transformation.addScale(0.5, 0.5)
    transformation.addCrop(0, 4, WIDTH, HEIGHT)
    color.setTransformation(transformation)
    depth.setType(dai.ImgFrame.Type.RAW16)
    depth.setSize(WIDTH, HEIGHT)
    depth.setData(np.full(WIDTH * HEIGHT, 750, np.uint16).view(np.uint8))
    group = dai.MessageGroup()
    group["color"], group["depth"] = color, depth
    return group
