"""The rows of a data set (pairs, and frames of sequences) and their Parquet form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from objectflow import geometry
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera, check_depth_scale
from objectflow.geometry.se3 import MAX_DISTANCE
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.storage.foreign import located_errors
from objectflow.storage.images import decode_png, encode_png
from objectflow.typing import Float64Array, LabelImage

DEPTH_SCALE = 10_000.0
"""Depth units per metre: steps of 0.1 mm up to 6.55 m; larger depth is stored as missing."""
MAX_LABEL = 255
"""Largest label of an object: labels are stored in 8 bits."""
PNG_COMPRESSION = 3
"""zlib level of stored images, 0..9. It determines the bytes of a set, so it is part of the format."""
IMAGES = ("color", "depth", "labels")
"""Image columns of a frame, without the prefix of the frame."""


@dataclass(frozen=True, eq=False)
class PairObject:
    """One object of a pair, in the camera frame, in metres and radians.

    Attributes:
        label: its value in both label images.
        category, model: for example "mug" and "mug-00012".
        center: (3,) X, the object's centre in the current frame.
        translation: (3,) T, from the current centre to the previous one.
        rotation_vector: (3,) R as axis-angle, reduced by the object's symmetry: `P_prev = R (P_curr - X) + X + T`.
        raw_rotation_vector: (3,) R before the reduction.
        symmetry: its axes, as unit vectors in the *object* frame; may be empty.
        prev_pose, curr_pose: (4, 4) `camera_T_object`.
        in_both: whether it is visible (at least one pixel) in both frames; every object is visible in at least one.
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

    def __post_init__(self) -> None:
        _check_identity(self.label, self.category, self.model)
        for name in ("center", "translation", "rotation_vector", "raw_rotation_vector"):
            if not np.isfinite(getattr(self, name)).all():
                raise DatasetError(f"{name} of object {self.label} is not finite")
            if np.abs(getattr(self, name)).max() > MAX_DISTANCE:
                raise DatasetError(f"{name} of object {self.label} is beyond {MAX_DISTANCE:g}")
        for name in ("prev_pose", "curr_pose"):
            check_pose(getattr(self, name), f"{name} of object {self.label}")

    def prev_T_curr(self, *, raw: bool = False) -> Float64Array:
        """(4, 4) motion of the object back in time, with the reduced or the raw rotation."""
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
            label=entry["label"],
            category=entry["category"],
            model=entry["model"],
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
    """One object in a frame of a sequence. `pose` is (4, 4) `camera_T_object`; the rest is as in `PairObject`."""

    label: int
    category: str
    model: str
    symmetry: tuple[SymmetryAxis, ...]
    pose: Float64Array

    def __post_init__(self) -> None:
        _check_identity(self.label, self.category, self.model)
        check_pose(self.pose, f"pose of object {self.label}")

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
            label=entry["label"],
            category=entry["category"],
            model=entry["model"],
            symmetry=_symmetry_from_list(entry["symmetry"]),
            pose=_pose(entry["pose"]),
        )


@dataclass(frozen=True, eq=False)
class PairRow:
    """A pair of frames with its ground truth.

    Attributes:
        key: unique in its data set, for example "train-000012" ("train-000012-3" for the fourth pair of a scene).
        scene: shared by the rows of one scene ("train-000012"), which are not independent samples.
        prev, curr: the frames.
        prev_labels, curr_labels: (H, W) int32, 0 = background.
        objects: in order of label.
        camera_motion: (4, 4) `prev_T_curr` of the static background; the identity for a static camera. If it is
            given, static objects count as background (see `objectflow.dataset.moving_objects`). None, as in the
            paper's data: the camera is static, and no object counts as background.
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
        """The row in its Parquet form, with images as PNG bytes."""
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
        """The inverse of `to_dict`, up to rounding of depth to 0.1 mm.

        Raises:
            DatasetError: a column is missing or broken; the message starts with `where`.
        """
        with located_errors(DatasetError, f"{where}: not a row of pairs"):
            prev, prev_labels = _frame_from(row, "prev_")
            curr, curr_labels = _frame_from(row, "curr_")
            objects = tuple(PairObject.from_dict(entry) for entry in row["objects"])
            camera = None if row.get("camera_motion") is None else _pose(row["camera_motion"])
            if camera is not None:
                check_pose(camera, "camera_motion")
            key, scene = _text(row, "key"), _text(row, "scene")
            return cls(key, scene, prev, prev_labels, curr, curr_labels, objects, camera)


@dataclass(frozen=True, eq=False)
class SequenceRow:
    """One frame of a sequence with its ground truth; the rows of a sequence are adjacent and in order of time.

    Attributes:
        sequence: for example "test-sequence-000003".
        frame: frame number of the simulation, at 60 Hz.
        image: colour and depth.
        labels: (H, W) int32, 0 = background.
        objects: all objects of the sequence, in order of label.
        world_T_camera: (4, 4) pose of a moving camera; the world is the camera of the sequence's first frame. None for
            a static camera.
    """

    sequence: str
    frame: int
    image: RgbdFrame
    labels: LabelImage
    objects: tuple[FrameObject, ...]
    world_T_camera: Float64Array | None = None

    def to_dict(self) -> dict[str, Any]:
        """The row in its Parquet form, with images as PNG bytes."""
        return {
            "sequence": self.sequence,
            "frame": self.frame,
            **_frame_columns(self.image, self.labels, ""),
            "camera": _camera_to_dict(self.image.camera),
            "objects": [obj.to_dict() for obj in self.objects],
            **({} if self.world_T_camera is None else {"world_T_camera": self.world_T_camera.ravel().tolist()}),
        }

    @classmethod
    def from_dict(cls, row: Mapping[str, Any], *, where: str = "row") -> SequenceRow:
        """The inverse of `to_dict`, up to rounding of depth to 0.1 mm.

        Raises:
            DatasetError: a column is missing or broken; the message starts with `where`.
        """
        with located_errors(DatasetError, f"{where}: not a row of sequences"):
            image, labels = _frame_from(row, "")
            objects = tuple(FrameObject.from_dict(entry) for entry in row["objects"])
            camera = None if row.get("world_T_camera") is None else _pose(row["world_T_camera"])
            if camera is not None:
                check_pose(camera, "world_T_camera")
            return cls(_text(row, "sequence"), int(row["frame"]), image, labels, objects, camera)


Row = TypeVar("Row", bound=PairRow | SequenceRow)


def _frame_columns(frame: RgbdFrame, labels: LabelImage, prefix: str) -> dict[str, bytes]:
    units = np.round(frame.depth.astype(np.float64) * DEPTH_SCALE)
    units[units > np.iinfo(np.uint16).max] = 0
    if labels.min(initial=0) < 0 or labels.max(initial=0) > np.iinfo(np.uint8).max:
        raise DatasetError(f"{frame.name}: labels must lie in 0..255")
    return {
        f"{prefix}color": encode_png(frame.color, compression=PNG_COMPRESSION),
        f"{prefix}depth": encode_png(units.astype(np.uint16), compression=PNG_COMPRESSION),
        f"{prefix}labels": encode_png(labels.astype(np.uint8), compression=PNG_COMPRESSION),
    }


def _frame_from(row: Mapping[str, Any], prefix: str) -> tuple[RgbdFrame, LabelImage]:
    camera = Camera.from_dict(row["camera"])
    size = (camera.width, camera.height)
    names = [f"{prefix}{image}" for image in IMAGES]
    color, depth, labels = (decode_png(row[name], name, size=size) for name in names)
    check_depth_scale(row["camera"]["depth_scale"])
    if depth.ndim != 2 or labels.shape != depth.shape or labels.dtype != np.uint8:
        raise DatasetError(f"{names[1]} must have one channel, and {names[2]} one of 8 bits")
    with np.errstate(all="ignore"):  # an absurd scale gives 0 or infinity, which the frame reports
        metres = depth.astype(np.float32) / np.float32(row["camera"]["depth_scale"])
    name = str(row.get("key") or f"{row.get('sequence')}/{row.get('frame')}")
    frame = RgbdFrame(color=color, depth=metres, camera=camera, name=name)
    return frame, labels.astype(np.int32)


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


def _check_identity(label: object, category: object, model: object) -> None:
    if isinstance(label, bool) or not isinstance(label, int | np.integer) or not 1 <= label <= MAX_LABEL:
        raise DatasetError(f"the label of an object must be a whole number in 1..{MAX_LABEL}, not {label!r}")
    if not isinstance(category, str) or not isinstance(model, str):
        raise DatasetError(f"object {label}: category and model must be names, not {category!r} and {model!r}")


def check_pose(pose: Float64Array, name: str) -> None:
    """Check a pose of a row.

    Raises:
        DatasetError: it is not a rigid transform; the message starts with `name`.
    """
    if not geometry.is_rigid(pose):
        raise DatasetError(f"{name} is not a rigid transform")


def _text(row: Mapping[str, Any], name: str) -> str:
    if not isinstance(row[name], str) or not row[name]:
        raise DatasetError(f"{name} must be a name, not {row[name]!r}")
    return str(row[name])
