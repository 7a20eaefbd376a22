"""What one row of a data set holds, and its Parquet form (pairs, and frames of sequences)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import DatasetError, ObjectflowError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.typing import Float64Array, LabelImage

DEPTH_SCALE = 10_000.0
"""Depth units a metre: steps of 0.1 mm up to 6.55 m; what lies beyond is stored as missing."""


@dataclass(frozen=True, eq=False)
class PairObject:
    """One object of a pair: camera frame, metres and radians.

    Attributes:
        label: its value in both label images.
        category, model: what it is, for example "mug" and "mug-00012".
        center: (3,) X, the object's centre in the current frame.
        translation: (3,) T, from the current centre to the previous one.
        rotation_vector: (3,) R as axis-angle, reduced by the object's symmetry: `P_prev = R (P_curr - X) + X + T`.
        raw_rotation_vector: (3,) the same before the reduction.
        symmetry: its axes, as unit vectors in the *object* frame, which the poses take to the camera; may be empty.
        prev_pose, curr_pose: (4, 4) `camera_T_object`.
        in_both: seen (a pixel or more) in both frames; an object of a row is seen in one at least.
    """

    label: int
    category: str
    model: str
    center: Float64Array
    translation: Float64Array
    rotation_vector: Float64Array
    raw_rotation_vector: Float64Array
    symmetry: tuple[SymmetryAxis, ...]
    prev_pose: Float64Array
    curr_pose: Float64Array
    in_both: bool

    def prev_T_curr(self, *, raw: bool = False) -> Float64Array:
        """(4, 4) the object's motion back in time, with the reduced or the raw rotation."""
        R = geometry.so3_exp(self.raw_rotation_vector if raw else self.rotation_vector)
        return geometry.make_transform(R, self.center + self.translation - R @ self.center)

    def to_dict(self) -> dict[str, Any]:
        """The object's entry in the `objects` column."""
        return {
            "label": self.label,
            "category": self.category,
            "model": self.model,
            "center": self.center.tolist(),
            "translation": self.translation.tolist(),
            "rotation_vector": self.rotation_vector.tolist(),
            "raw_rotation_vector": self.raw_rotation_vector.tolist(),
            "symmetry": _symmetry_to_list(self.symmetry),
            "prev_pose": self.prev_pose.ravel().tolist(),
            "curr_pose": self.curr_pose.ravel().tolist(),
            "in_both": self.in_both,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> PairObject:
        """The inverse of `to_dict`."""
        return cls(
            label=int(entry["label"]),
            category=str(entry["category"]),
            model=str(entry["model"]),
            center=_vector(entry["center"]),
            translation=_vector(entry["translation"]),
            rotation_vector=_vector(entry["rotation_vector"]),
            raw_rotation_vector=_vector(entry["raw_rotation_vector"]),
            symmetry=_symmetry_from_list(entry["symmetry"]),
            prev_pose=_pose(entry["prev_pose"]),
            curr_pose=_pose(entry["curr_pose"]),
            in_both=bool(entry["in_both"]),
        )


@dataclass(frozen=True, eq=False)
class FrameObject:
    """One object of a sequence's frame. `pose` is (4, 4) `camera_T_object`; the rest as in `PairObject`."""

    label: int
    category: str
    model: str
    symmetry: tuple[SymmetryAxis, ...]
    pose: Float64Array

    def to_dict(self) -> dict[str, Any]:
        """The object's entry in the `objects` column."""
        return {
            "label": self.label,
            "category": self.category,
            "model": self.model,
            "symmetry": _symmetry_to_list(self.symmetry),
            "pose": self.pose.ravel().tolist(),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> FrameObject:
        """The inverse of `to_dict`."""
        return cls(
            label=int(entry["label"]),
            category=str(entry["category"]),
            model=str(entry["model"]),
            symmetry=_symmetry_from_list(entry["symmetry"]),
            pose=_pose(entry["pose"]),
        )


@dataclass(frozen=True, eq=False)
class PairRow:
    """A pair of frames with its truth.

    Attributes:
        key: unique in its data set, for example "train-000012" ("train-000012-3" for the fourth pair of a scene).
        scene: rows of one scene share it ("train-000012"): such pairs are siblings, not independent samples.
        prev, curr: the frames.
        prev_labels, curr_labels: (H, W) int32, 0 = background.
        objects: in order of label.
        camera_motion: (4, 4) `prev_T_curr` of everything that stands still, the identity before a camera that does
            too. Where it is given, objects that move with it are background (see
            `objectflow.dataset.moving_objects`); None, as in the paper's data: the camera is still, and every
            object counts.
    """

    key: str
    scene: str
    prev: RgbdFrame
    prev_labels: LabelImage
    curr: RgbdFrame
    curr_labels: LabelImage
    objects: tuple[PairObject, ...]
    camera_motion: Float64Array | None = None

    def to_dict(self) -> dict[str, Any]:
        """The row as Parquet holds it: images as PNG bytes."""
        return {
            "key": self.key,
            "scene": self.scene,
            **_frame_columns(self.prev, self.prev_labels, "prev_"),
            **_frame_columns(self.curr, self.curr_labels, "curr_"),
            "camera": _camera_to_dict(self.curr.camera),
            "objects": [obj.to_dict() for obj in self.objects],
            **({} if self.camera_motion is None else {"camera_motion": self.camera_motion.ravel().tolist()}),
        }

    @classmethod
    def from_dict(cls, row: Mapping[str, Any], *, where: str = "row") -> PairRow:
        """The inverse of `to_dict`, up to the rounding of depth to 0.1 mm.

        Raises:
            DatasetError: a column is missing or broken; the message starts with `where`.
        """
        try:
            prev, prev_labels = _frame_from(row, "prev_")
            curr, curr_labels = _frame_from(row, "curr_")
            objects = tuple(PairObject.from_dict(entry) for entry in row["objects"])
            camera = None if row.get("camera_motion") is None else _pose(row["camera_motion"])
            return cls(str(row["key"]), str(row["scene"]), prev, prev_labels, curr, curr_labels, objects, camera)
        except (KeyError, TypeError, ValueError, ObjectflowError) as error:
            raise DatasetError(f"{where}: not a row of pairs: {_reason(error)}") from error


@dataclass(frozen=True, eq=False)
class SequenceRow:
    """One frame of a sequence with its truth; the rows of a sequence follow each other in order of time.

    Attributes:
        sequence: for example "test-sequence-000003".
        frame: the simulation's frame number, at 60 Hz.
        image: colour and depth.
        labels: (H, W) int32, 0 = background.
        objects: all objects of the sequence, in order of label.
    """

    sequence: str
    frame: int
    image: RgbdFrame
    labels: LabelImage
    objects: tuple[FrameObject, ...]

    def to_dict(self) -> dict[str, Any]:
        """The row as Parquet holds it: images as PNG bytes."""
        return {
            "sequence": self.sequence,
            "frame": self.frame,
            **_frame_columns(self.image, self.labels, ""),
            "camera": _camera_to_dict(self.image.camera),
            "objects": [obj.to_dict() for obj in self.objects],
        }

    @classmethod
    def from_dict(cls, row: Mapping[str, Any], *, where: str = "row") -> SequenceRow:
        """The inverse of `to_dict`, up to the rounding of depth to 0.1 mm.

        Raises:
            DatasetError: a column is missing or broken; the message starts with `where`.
        """
        try:
            image, labels = _frame_from(row, "")
            objects = tuple(FrameObject.from_dict(entry) for entry in row["objects"])
            return cls(str(row["sequence"]), int(row["frame"]), image, labels, objects)
        except (KeyError, TypeError, ValueError, ObjectflowError) as error:
            raise DatasetError(f"{where}: not a row of sequences: {_reason(error)}") from error


Row = TypeVar("Row", bound=PairRow | SequenceRow)


def _frame_columns(frame: RgbdFrame, labels: LabelImage, prefix: str) -> dict[str, bytes]:
    units = np.round(frame.depth.astype(np.float64) * DEPTH_SCALE)
    units[units > np.iinfo(np.uint16).max] = 0
    if labels.min(initial=0) < 0 or labels.max(initial=0) > np.iinfo(np.uint8).max:
        raise DatasetError(f"{frame.name}: labels must lie in 0..255")
    return {
        f"{prefix}color": _png(frame.color[..., ::-1]),
        f"{prefix}depth": _png(units.astype(np.uint16)),
        f"{prefix}labels": _png(labels.astype(np.uint8)),
    }


def _frame_from(row: Mapping[str, Any], prefix: str) -> tuple[RgbdFrame, LabelImage]:
    camera = Camera.from_dict(row["camera"])
    color = _decode(row[f"{prefix}color"], f"{prefix}color")[..., ::-1]
    depth = _decode(row[f"{prefix}depth"], f"{prefix}depth").astype(np.float32)
    labels = _decode(row[f"{prefix}labels"], f"{prefix}labels").astype(np.int32)
    depth /= np.float32(row["camera"]["depth_scale"])
    name = str(row.get("key") or f"{row.get('sequence')}/{row.get('frame')}")
    frame = RgbdFrame(color=np.ascontiguousarray(color, dtype=np.uint8), depth=depth, camera=camera, name=name)
    if labels.shape != depth.shape:
        raise DatasetError(f"{prefix}labels are {labels.shape}, depth is {depth.shape}")
    return frame, labels


def _png(image: NDArray[Any]) -> bytes:
    done, data = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise DatasetError("an image cannot be encoded as PNG")
    return data.tobytes()


def _decode(data: bytes, name: str) -> NDArray[Any]:
    # OpenCV fills the missing rows of a cut-off PNG with zeros and says nothing.
    if data[-8:-4] != b"IEND":
        raise DatasetError(f"{name} is not a whole PNG")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"{name} cannot be decoded")
    return np.asarray(image)


def _camera_to_dict(camera: Camera) -> dict[str, float]:
    return {**camera.to_dict(), "depth_scale": DEPTH_SCALE}


def _symmetry_to_list(axes: tuple[SymmetryAxis, ...]) -> list[dict[str, Any]]:
    return [{"axis": list(axis.axis), "order": axis.order} for axis in axes]


def _symmetry_from_list(entries: list[Mapping[str, Any]]) -> tuple[SymmetryAxis, ...]:
    axes = []
    for entry in entries:
        x, y, z = map(float, entry["axis"])
        axes.append(SymmetryAxis((x, y, z), int(entry["order"])))
    return tuple(axes)


def _vector(values: list[float]) -> Float64Array:
    return np.array(values, dtype=np.float64).reshape(3)


def _pose(values: list[float]) -> Float64Array:
    return np.array(values, dtype=np.float64).reshape(4, 4)


def _reason(error: Exception) -> str:
    return f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
