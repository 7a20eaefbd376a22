"""A stand-in for depthai 3 with one camera, which runs the pipeline that it is given.

It delivers frames only where the nodes are linked so that colour and aligned depth reach the output.
`tests/readers/test_camera_libraries.py` compares its names and parameters with those of the real library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.typing import UInt8Array

CameraBoardSocket = Enum("CameraBoardSocket", "CAM_A CAM_B CAM_C")
Platform = Enum("Platform", "RVC2 RVC4")
Type = Enum("Type", "RGB888i NV12")


class QueueException(Exception):  # noqa: N818 (the name in depthai)
    """Raised by a queue whose pipeline has stopped."""


@dataclass
class ImgTransformation:
    size: tuple[int, int]

    def getSize(self) -> tuple[int, int]:
        return self.size

    def getIntrinsicMatrix(self) -> list[list[float]]:
        width, height = self.size
        return [[1.2 * width, 0.0, width / 2 - 1], [0.0, 1.25 * width, height / 2 + 1], [0.0, 0.0, 1.0]]


@dataclass
class ImgFrame:
    pixels: NDArray[Any]
    time: timedelta

    def getFrame(self) -> NDArray[Any]:
        return self.pixels

    def getTimestamp(self) -> timedelta:
        return self.time

    def getTransformation(self) -> ImgTransformation:
        return ImgTransformation((self.pixels.shape[1], self.pixels.shape[0]))


class Input:
    """An input, which knows the output that it is linked to."""

    def __init__(self) -> None:
        self.source: Output | None = None


class Output:
    """An output of a node, described by a tuple."""

    def __init__(self, node: Any, *what: Any) -> None:
        self.node, self.what = node, what
        self.queue: MessageQueue | None = None

    def link(self, input: Input) -> None:
        input.source = self

    def createOutputQueue(self, *, maxSize: int, blocking: bool) -> MessageQueue:
        # A queue that blocks would deliver old frames to a slow method.
        assert not blocking
        assert maxSize <= 2
        self.queue = MessageQueue(self)
        return self.queue


class MessageQueue:
    QueueException = QueueException

    def __init__(self, output: Output) -> None:
        self._output = output
        self.camera: OakCamera | None = None
        self._number = 0

    def get(self, timeout: timedelta) -> dict[str, ImgFrame] | None:
        assert self.camera is not None, "the pipeline has not been started"
        number, self._number = self._number, self._number + 1
        if number >= self.camera.count:
            if self.camera.unplugged:
                raise QueueException("MessageQueue was closed")
            return None
        return self.camera.frames(self._output.node, number)


class Camera:
    def build(self, boardSocket: CameraBoardSocket) -> Camera:
        self.socket = boardSocket
        return self

    def requestOutput(
        self, size: tuple[int, int], type: Type | None = None, *, fps: float, enableUndistortion: bool | None = None
    ) -> Output:
        return Output(self, size, type, fps, enableUndistortion)


class StereoDepth:
    def __init__(self) -> None:
        self.left, self.right, self.inputAlignTo = Input(), Input(), Input()
        self.depth = Output(self)
        self.checks = self.subpixel = False

    def setLeftRightCheck(self, enable: bool) -> None:
        self.checks = enable

    def setSubpixel(self, enable: bool) -> None:
        self.subpixel = enable


class ImageAlign:
    def __init__(self) -> None:
        self.input, self.inputAlignTo, self.outputAligned = Input(), Input(), Output(self)


class Sync:
    def __init__(self) -> None:
        self.inputs = {"color": Input(), "depth": Input()}
        self.out = Output(self)

    def setSyncThreshold(self, syncThreshold: timedelta) -> None:
        self.threshold = syncThreshold


@dataclass
class OakCamera:
    """What the camera has and delivers, and what was done to it.

    Attributes:
        color: makes the colour image of a size and a number.
        millimetres: of all depth pixels of a frame, by its number.
        count: number of frames until the camera is silent.
        unplugged: an error is raised after `count` frames, in place of silence.
    """

    color: Callable[[tuple[int, int], int], UInt8Array]
    millimetres: Callable[[int], int] = lambda _: 1500
    count: int = 20
    connected: bool = True
    unplugged: bool = False
    serial: str = "1944"
    platform: Platform = Platform.RVC2
    sockets: tuple[CameraBoardSocket, ...] = tuple(CameraBoardSocket)
    rate: float = 0.0
    started: int = 0
    stopped: int = 0
    closed: int = 0
    opened: list[str] = field(default_factory=list)

    def frames(self, sync: Sync, number: int) -> dict[str, ImgFrame]:
        """What a synchronised pair of outputs delivers; checks that the nodes are linked as the hardware requires."""
        image, depth = sync.inputs["color"].source, sync.inputs["depth"].source
        assert image is not None
        assert depth is not None
        size, kind, self.rate, is_undistorted = image.what
        assert (image.node.socket, kind, is_undistorted) == (CameraBoardSocket.CAM_A, Type.RGB888i, True)
        if self.platform is Platform.RVC4:
            align = depth.node
            assert isinstance(align, ImageAlign)
            assert align.inputAlignTo.source is image
            stereo = align.input.source.node
        else:
            stereo = depth.node
            assert stereo.inputAlignTo.source is image
        assert stereo.checks, "alignment needs the left-right check"
        pair = [one.source.node.socket for one in (stereo.left, stereo.right)]
        assert pair == [CameraBoardSocket.CAM_B, CameraBoardSocket.CAM_C]
        assert sync.threshold < timedelta(seconds=1 / self.rate)
        values = np.full((size[1], size[0]), self.millimetres(number), np.uint16)
        time = timedelta(seconds=100, milliseconds=40 * number)
        return {
            "color": ImgFrame(self.color(size, number), time),
            "depth": ImgFrame(values, time + timedelta(milliseconds=3)),
        }

    def module(self) -> ModuleType:
        """The module to put into `sys.modules`."""
        camera = self

        class Device:
            def __init__(self, nameOrDeviceId: str = "any") -> None:
                if not camera.connected or nameOrDeviceId not in ("any", camera.serial):
                    raise RuntimeError("Cannot find any device with given deviceInfo")
                camera.opened.append(nameOrDeviceId)

            def getConnectedCameras(self) -> list[CameraBoardSocket]:
                return list(camera.sockets)

            def getPlatform(self) -> Platform:
                return camera.platform

            def close(self) -> None:
                camera.closed += 1

        class Pipeline:
            def __init__(self, defaultDevice: Device) -> None:
                self._nodes: list[Any] = []

            def create(self, arg0: type[Any]) -> Any:
                node = arg0()
                self._nodes.append(node)
                return node

            def start(self) -> None:
                camera.started += 1
                for node in self._nodes:
                    if isinstance(node, Sync) and node.out.queue is not None:
                        node.out.queue.camera = camera

            def stop(self) -> None:
                camera.stopped += 1
                if camera.unplugged:
                    raise RuntimeError("the device is gone")

        out = ModuleType("depthai")
        for one in (Device, Pipeline, CameraBoardSocket, Platform, MessageQueue, ImgTransformation):
            setattr(out, one.__name__, one)
        out.ImgFrame = type("ImgFrame", (ImgFrame,), {"Type": Type})  # type: ignore[attr-defined]
        out.Node = SimpleNamespace(Output=Output)  # type: ignore[attr-defined]
        out.node = SimpleNamespace(  # type: ignore[attr-defined]
            Camera=Camera, StereoDepth=StereoDepth, ImageAlign=ImageAlign, Sync=Sync
        )
        return out
