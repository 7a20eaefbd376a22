"""Frames of a Luxonis OAK-D camera by DepthAI, version 3: undistorted colour, and stereo depth aligned to it."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import numpy as np

from objectflow.errors import ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers.camera_driver import TIMEOUT_MS, CameraDriver, CameraImages, StreamRequest, import_library
from objectflow.readers.camera_info import ImageCamera

dai: Any = import_library("depthai", "OAK", "oak")

DEFAULT_SIZE = 640, 400
"""Width and height of colour and depth, pixels, unless others are requested."""
STEREO_SIZE = 640, 400
"""Width and height of the images of the stereo pair, pixels: half of the sensor of most OAK-D cameras."""
DEFAULT_RATE = 30
"""Frames per second, unless others are requested."""
DEPTH_SCALE = 1000.0
"""Units of depth per metre."""


class Oak(CameraDriver):
    """Cameras of the OAK-D family, which compute stereo depth themselves."""

    title = "OAK"
    errors = (RuntimeError, dai.MessageQueue.QueueException)

    def __init__(self) -> None:
        self._device: Any = None
        self._pipeline: Any = None

    def open(self, request: StreamRequest) -> None:
        """Start colour and depth of one size."""
        self._device = device = dai.Device() if request.serial is None else dai.Device(request.serial)
        sockets = dai.CameraBoardSocket.CAM_A, dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
        if not set(sockets) <= set(device.getConnectedCameras()):
            raise ReaderError("this OAK camera lacks a colour camera (CAM_A) or a stereo pair (CAM_B, CAM_C)")
        rate = request.rate or DEFAULT_RATE
        self._pipeline = pipeline = dai.Pipeline(device)
        color, left, right = (pipeline.create(dai.node.Camera).build(socket) for socket in sockets)
        image = color.requestOutput(
            request.size or DEFAULT_SIZE, dai.ImgFrame.Type.RGB888i, fps=rate, enableUndistortion=True
        )
        stereo = pipeline.create(dai.node.StereoDepth)
        stereo.setLeftRightCheck(True)  # alignment to colour requires it
        stereo.setSubpixel(True)
        left.requestOutput(STEREO_SIZE, fps=rate).link(stereo.left)
        right.requestOutput(STEREO_SIZE, fps=rate).link(stereo.right)
        depth = stereo.depth
        if device.getPlatform() == dai.Platform.RVC4:
            # The stereo hardware of this platform does not align depth itself.
            align = pipeline.create(dai.node.ImageAlign)
            depth.link(align.input)
            image.link(align.inputAlignTo)
            depth = align.outputAligned
        else:
            image.link(stereo.inputAlignTo)
        sync = pipeline.create(dai.node.Sync)
        sync.setSyncThreshold(timedelta(seconds=0.5 / rate))
        image.link(sync.inputs["color"])
        depth.link(sync.inputs["depth"])
        self._queue = sync.out.createOutputQueue(maxSize=2, blocking=False)
        pipeline.start()

    def read(self) -> CameraImages:
        """Wait for the next images."""
        group = self._queue.get(timedelta(milliseconds=TIMEOUT_MS))
        if group is None:
            raise TimeoutError(f"no frame within {TIMEOUT_MS / 1000:g} s")
        color, depth = group["color"], group["depth"]
        self._transformation = color.getTransformation()
        return CameraImages(
            np.array(color.getFrame(), dtype=np.uint8),
            np.array(depth.getFrame(), dtype=np.uint16),
            DEPTH_SCALE,
            seconds=color.getTimestamp().total_seconds(),
        )

    def camera(self) -> ImageCamera:
        """The camera model of the colour images, which the camera undistorts, crops and scales."""
        K, (width, height) = self._transformation.getIntrinsicMatrix(), self._transformation.getSize()
        return ImageCamera(Camera(width, height, K[0][0], K[1][1], K[0][2], K[1][2]))

    def close(self) -> None:
        """Stop the camera."""
        try:
            if self._pipeline is not None:
                self._pipeline.stop()
        finally:
            if self._device is not None:
                self._device.close()
