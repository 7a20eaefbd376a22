"""Bags of known frames, written by rosbags."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera

Kind = Literal["ros1", "sqlite3", "mcap"]
COLOR = "/camera/color/image_raw"
DEPTH = "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"


class BagBuilder:
    """Collects messages by topic and writes them as a bag of one of the three kinds."""

    def __init__(self, kind: Kind) -> None:
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if "tf2_msgs/msg/TFMessage" not in self.store.types:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
        self.messages: list[tuple[str, str, int, Any]] = []
        self.frame_id = "camera"
        """Of the messages that are added from now on."""

    def header(self, seconds: float) -> Any:
        types = self.store.types
        whole = int(seconds)
        stamp = types["builtin_interfaces/msg/Time"](sec=whole, nanosec=round((seconds - whole) * 1e9))
        extra = {"seq": 0} if self.kind == "ros1" else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=self.frame_id, **extra)

    def add(self, topic: str, msgtype: str, seconds: float, recorded: float | None = None, **fields: Any) -> None:
        message = self.store.types[msgtype](header=self.header(seconds), **fields)
        self.messages.append((topic, msgtype, round((seconds if recorded is None else recorded) * 1e9), message))

    def image(self, topic: str, seconds: float, array: np.ndarray[Any, Any], encoding: str, pad: int = 0) -> None:
        height, width = array.shape[:2]
        rows = np.ascontiguousarray(array).reshape(height, -1).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        self.add(
            topic,
            "sensor_msgs/msg/Image",
            seconds,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, topic: str, seconds: float, data: bytes, kind: str) -> None:
        self.add(
            topic, "sensor_msgs/msg/CompressedImage", seconds, format=kind, data=np.frombuffer(data, np.uint8).copy()
        )

    def info(
        self,
        topic: str,
        seconds: float,
        frame: RgbdFrame | Camera,
        *,
        D: Sequence[float] = (0.0,) * 5,
        model: str = "plumb_bob",
        P: Camera | None = None,
        binning: int = 0,
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
        size: tuple[int, int] | None = None,
    ) -> None:
        """Add a CameraInfo; `roi` is x, y, width, height, and `size` (width, height) replaces that of the camera."""
        camera = frame.camera if isinstance(frame, RgbdFrame) else frame
        width, height = size or (camera.width, camera.height)
        capital = self.kind == "ros1"
        matrices = {
            "D": np.array(D, dtype=np.float64),
            "K": camera.matrix.ravel(),
            "R": np.eye(3).ravel(),
            "P": np.hstack([(P or camera).matrix, np.zeros((3, 1))]).ravel(),
        }
        region = self.store.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=roi[0], y_offset=roi[1], height=roi[3], width=roi[2], do_rectify=False
        )
        self.add(
            topic,
            "sensor_msgs/msg/CameraInfo",
            seconds,
            height=height,
            width=width,
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=region,
            **{name if capital else name.lower(): value for name, value in matrices.items()},
        )

    def transform(self, parent: str, child: str, parent_T_child: np.ndarray[Any, Any]) -> None:
        """Add a transform to `/tf_static`."""
        types = self.store.types
        x, y, z, w = Rotation.from_matrix(parent_T_child[:3, :3]).as_quat()
        tx, ty, tz = parent_T_child[:3, 3]
        header = self.header(1.0)
        header = type(header)(**{**vars(header), "frame_id": parent})
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=header,
            child_frame_id=child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](x=tx, y=ty, z=tz),
                rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
            ),
        )
        message = types["tf2_msgs/msg/TFMessage"](transforms=[stamped])
        self.messages.append(("/tf_static", "tf2_msgs/msg/TFMessage", 10**9, message))

    def write(self, path: Path) -> Path:
        """Write the bag and return its path: a file, or a ROS 2 bag folder."""
        if self.kind == "ros1":
            with Writer1(path) as writer1:
                known: dict[str, Any] = {}
                for topic, msgtype, time, message in sorted(self.messages, key=lambda m: m[2]):
                    if topic not in known:
                        known[topic] = writer1.add_connection(topic, msgtype, typestore=self.store)
                    writer1.write(known[topic], time, self.store.serialize_ros1(message, msgtype))
            return path
        plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
        with Writer2(path, version=9, storage_plugin=plugin) as writer2:
            known = {}
            for topic, msgtype, time, message in sorted(self.messages, key=lambda m: m[2]):
                if topic not in known:
                    known[topic] = writer2.add_connection(topic, msgtype, typestore=self.store)
                writer2.write(known[topic], time, self.store.serialize_cdr(message, msgtype))
        return path


def write_frames(
    path: Path,
    frames: Sequence[RgbdFrame],
    kind: Kind,
    *,
    period: float = 0.1,
    lag: float = 0.004,
    start: float = 1000.0,
    bag: BagBuilder | None = None,
) -> Path:
    """Write a typical recording: rgb8, 16UC1 in millimetres delayed by `lag` seconds, and CameraInfo.

    The messages are added to `bag`, if it is given.
    """
    bag = bag or BagBuilder(kind)
    for number, frame in enumerate(frames):
        seconds = start + period * number
        bag.image(COLOR, seconds, frame.color, "rgb8")
        bag.image(DEPTH, seconds + lag, np.rint(frame.depth * 1000).astype(np.uint16), "16UC1")
        bag.info(INFO, seconds, frame)
    return bag.write(path)


def compressed_depth(depth: np.ndarray[Any, Any], *, floating: bool) -> tuple[bytes, str]:
    """The data and format of a compressedDepth message: the transport's header, then a PNG."""
    if not floating:
        return struct.pack("<iff", 0, 0.0, 0.0) + _png(
            np.rint(depth * 1000).astype(np.uint16)
        ), "16UC1; compressedDepth"
    a, b = 100.0, 1.0
    inverse = np.where(depth > 0, a / np.maximum(depth, 1e-6) + b, 0)
    return struct.pack("<iff", 0, a, b) + _png(np.rint(inverse).astype(np.uint16)), "32FC1; compressedDepth png"


def _png(image: np.ndarray[Any, Any]) -> bytes:
    done, data = cv2.imencode(".png", image)
    assert done
    return data.tobytes()
