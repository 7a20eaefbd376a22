"""`SceneMotion`: the motion of a whole scene, the result of every method."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from objectflow import geometry
from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import export, result_folder
from objectflow.motion.object_motion import ObjectMotion
from objectflow.motion.own_flow import own_flow
from objectflow.motion.picture import to_html
from objectflow.storage import files
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

FORMAT_VERSION = 2
"""Version of `objects.json`; 2 added each object's own motion, displacement and rotation."""

MAX_SECONDS = 1e9
"""Longest duration of an estimate, seconds."""

UNITS = {"length": "metres", "rotation_deg": "degrees", "rotation_vector": "radians", "seconds": "seconds"}
"""Units of the numbers in `objects.json`."""


@dataclass(frozen=True, eq=False)
class SceneMotion:
    """The motion of a whole scene, on the pixels of the current frame.

    Attributes:
        labels: (H, W) int32, 0 = background, otherwise an object's id.
        scene_flow: (H, W, 3) float32 metres, `P_prev - P_curr`; NaN where depth is missing.
        objects: in ascending order of id.
        camera_motion: (4, 4) float64 `prev_T_curr` of the static background, or None for a static camera.
        method: the estimator's name.
        seconds: duration of the estimate.
        settings: of the estimator, as plain JSON.
        frames: where the frames were read from: `paths`, `intrinsics` (fx, fy, cx, cy) and `depth_scale`; empty if
            they were not read from files.
        changes: what each step of the method changed, a line per step, where it was asked to record that.
        camera_known: whether the camera's motion could be found; without it there are no objects and no flow.
        notes: what a user should know about the estimate, a line each.

    Raises:
        ResultError: the arrays do not match each other, or a label has no object.
    """

    labels: LabelImage
    scene_flow: Float32Array
    objects: tuple[ObjectMotion, ...] = ()
    camera_motion: Float64Array | None = None
    method: str = ""
    seconds: float = field(default=0.0)
    settings: Mapping[str, Any] = field(default_factory=dict)
    frames: Mapping[str, Any] = field(default_factory=dict)
    changes: tuple[str, ...] = ()
    camera_known: bool = True
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.labels.ndim != 2 or self.labels.dtype != np.int32:
            raise ResultError(f"labels must be (H, W) int32, not {self.labels.shape} {self.labels.dtype}")
        if self.scene_flow.shape != (*self.labels.shape, 3) or self.scene_flow.dtype != np.float32:
            raise ResultError(
                f"scene_flow must be {(*self.labels.shape, 3)} float32, "
                f"not {self.scene_flow.shape} {self.scene_flow.dtype}"
            )
        if self.camera_motion is not None and not geometry.is_rigid(self.camera_motion):
            raise ResultError("camera_motion must be a rigid 4x4 transform, or None")
        if not isinstance(self.method, str):
            raise ResultError(f"method must be the name of a method, not {self.method!r}")
        if isinstance(self.seconds, bool) or not isinstance(self.seconds, int | float | np.number):
            raise ResultError(f"seconds must be a number, not {self.seconds!r}")
        if not 0 <= self.seconds <= MAX_SECONDS:
            raise ResultError(f"seconds must lie in 0..{MAX_SECONDS:g}, not {self.seconds!r}")
        # Every object knows the camera's motion, so that it can tell its own motion from it.
        objects = tuple(
            obj if obj.camera_motion is self.camera_motion else replace(obj, camera_motion=self.camera_motion)
            for obj in self.objects
        )
        object.__setattr__(self, "objects", objects)
        ids = [obj.id for obj in self.objects]
        if sorted(set(ids)) != ids or (ids and ids[0] < 1):
            raise ResultError(f"object ids must be rising, from 1, not {ids}")
        stray = set(np.unique(self.labels).tolist()) - {0} - set(ids)
        if stray:
            raise ResultError(f"labels {sorted(stray)} belong to no object")

    def __len__(self) -> int:
        """The number of objects."""
        return len(self.objects)

    def __iter__(self) -> Iterator[ObjectMotion]:
        """The objects, in order of id."""
        return iter(self.objects)

    def __getitem__(self, number: int) -> ObjectMotion:
        """The object with an id.

        Raises:
            ResultError: there is none; the message lists the ids.
        """
        for obj in self.objects:
            if obj.id == number:
                return obj
        ids = ", ".join(str(obj.id) for obj in self.objects) or "none"
        raise ResultError(f"there is no object {number!r}: the ids are {ids}")

    @property
    def moving(self) -> tuple[ObjectMotion, ...]:
        """The objects that move."""
        return tuple(obj for obj in self.objects if obj.moving)

    @property
    def camera(self) -> Literal["static", "moving", "unknown"]:
        """What is known of the camera."""
        if not self.camera_known:
            return "unknown"
        return "static" if self.camera_motion is None else "moving"

    @property
    def curr_T_prev(self) -> Float64Array:
        """(4, 4) inverse of the camera's motion; the identity for a static camera."""
        return np.eye(4) if self.camera_motion is None else geometry.inverse(self.camera_motion)

    def mask(self, number: int) -> BoolMask:
        """(H, W) bool: the pixels of an object.

        Raises:
            ResultError: there is no object with this id.
        """
        return np.asarray(self.labels == self[number].id)

    @property
    def camera_displacement(self) -> float:
        """Metres: how far the camera moved; 0 for a static camera."""
        return float(np.linalg.norm(self.curr_T_prev[:3, 3]))

    @property
    def camera_rotation_deg(self) -> float:
        """Degrees: how far the camera rotated; 0 for a static camera."""
        return math.degrees(float(geometry.rotation_angle(self.curr_T_prev[:3, :3])))

    @property
    def camera_text(self) -> str:
        """The camera's motion in words."""
        if self.camera_motion is None:
            return f"camera {self.camera}"
        return f"camera moved {100 * self.camera_displacement:.1f} cm, {self.camera_rotation_deg:.1f} deg"

    def own_flow(self, frame: RgbdFrame) -> Float32Array:
        """(H, W, 3) metres: the scene flow without the camera's motion, in the current camera frame.

        It is the previous minus the current position of each point in the world: 0 for what stands still, static
        objects included, and NaN where depth is missing.

        Args:
            frame: the current frame of the estimate.

        Raises:
            ResultError: the frame has another size.
        """
        self._check_size(frame)
        points = geometry.back_project(frame.depth, frame.camera)
        return own_flow(self.scene_flow, points, self.labels, self.objects, self.camera_motion)

    def points(self, number: int, frame: RgbdFrame) -> Float32Array:
        """(N, 3) metres: the visible surface of an object, in the camera frame of the current frame.

        Args:
            number: the object's id.
            frame: the current frame of the estimate.

        Raises:
            ResultError: there is no object with this id, or the frame has another size.
        """
        self._check_size(frame)
        return geometry.back_project(frame.depth, frame.camera)[self.mask(number) & frame.valid]

    def _check_size(self, frame: RgbdFrame) -> None:
        if frame.depth.shape != self.labels.shape:
            raise ResultError(f"the frame has shape {frame.depth.shape}, but the result {self.labels.shape}")

    def __eq__(self, other: object) -> bool:
        """Whether labels, flow, objects, camera motion and method are equal; the duration does not count."""
        if not isinstance(other, SceneMotion):
            return NotImplemented
        mine, theirs = (np.empty(0) if one.camera_motion is None else one.camera_motion for one in (self, other))
        return (
            self.method == other.method
            and self.objects == other.objects
            and np.array_equal(self.labels, other.labels)
            and np.array_equal(self.scene_flow, other.scene_flow, equal_nan=True)
            and np.array_equal(mine, theirs)
            and self.camera_known == other.camera_known
        )

    __hash__ = None  # type: ignore[assignment]  # equal by its arrays, which can change

    def __repr__(self) -> str:
        height, width = self.labels.shape
        return (
            f"SceneMotion({width}x{height}, {len(self)} objects, {len(self.moving)} moving, "
            f"{self.camera} camera, {self.method!r})"
        )

    def _repr_html_(self) -> str:
        """The label image and a table of the objects, for notebooks."""
        return to_html(repr(self), self.labels, self.objects)

    def to_coco(self, image_id: int = 0) -> list[dict[str, Any]]:
        """The objects as COCO annotations, with run-length encoded masks.

        Args:
            image_id: of every annotation.

        Returns:
            One dict per object: id, image_id, category_id (1), segmentation (uncompressed RLE, as
            `pycocotools.mask.frPyObjects` takes it), area, bbox [x, y, width, height], iscrowd, score.
        """
        return export.to_coco(self.labels, self.objects, image_id)

    def to_coco_dataset(self, file_name: str = "", image_id: int = 0) -> dict[str, Any]:
        """The result as a COCO data set of one image, which COCO's own tools read.

        Args:
            file_name: of the current frame's colour image.
            image_id: of the image and every annotation.

        Returns:
            A dict with images, annotations (see `to_coco`) and the single category "object".
        """
        height, width = self.labels.shape
        return {
            "images": [{"id": image_id, "file_name": file_name, "width": width, "height": height}],
            "annotations": self.to_coco(image_id),
            "categories": [{"id": 1, "name": "object"}],
        }

    def to_ply(self, path: str | Path, frame: RgbdFrame, number: int | None = None) -> None:
        """Write the points of the current frame as a binary PLY file with colour, label and flow.

        `flow_x` etc. are the scene flow, `own_flow_x` etc. the flow without the camera's motion, both in metres.

        Args:
            path: of the file; one that exists is replaced.
            frame: the current frame of the estimate.
            number: an object's id, whose points alone are written; all points if None.

        Raises:
            ResultError: the frame has another size, or there is no object with this id.
            StorageError: the file cannot be written.
        """
        shown = frame.valid if number is None else frame.valid & self.mask(number)
        files.write_bytes(Path(path), export.to_ply(frame, shown, self.labels, self.scene_flow, self.own_flow(frame)))

    def save(self, folder: str | Path) -> None:
        """Write `labels.png`, `scene_flow.npy` and `objects.json` into a new folder, atomically.

        Raises:
            ResultError: The folder is not empty.
            StorageError: The folder cannot be written.
        """
        with files.new_folder(Path(folder)) as temporary:
            self.write_into(temporary)

    def write_into(self, folder: Path) -> None:
        """Write the three files of `save` into an existing folder, for callers that add further files."""
        summary = {
            "format_version": FORMAT_VERSION,
            "units": UNITS,
            "objects": [obj.to_dict() for obj in self.objects],
            "camera": self.camera,
            "camera_motion": None if self.camera_motion is None else self.camera_motion.tolist(),
            "notes": list(self.notes),
            "method": self.method,
            "seconds": self.seconds,
            "settings": dict(self.settings),
            "frames": dict(self.frames),
            "width": self.labels.shape[1],
            "height": self.labels.shape[0],
        }
        result_folder.write(folder, self.labels, self.scene_flow, summary)

    @classmethod
    def load(cls, folder: str | Path) -> SceneMotion:
        """Read a result folder written by `save` or `objectflow estimate`.

        Raises:
            ResultError: A file is missing, broken or inconsistent with the others.
        """
        with result_folder.reading(Path(folder)):
            labels, flow, summary = result_folder.read(Path(folder))
            camera_motion = summary["camera_motion"]
            return cls(
                labels=labels,
                scene_flow=flow,
                objects=tuple(ObjectMotion.from_dict(entry) for entry in summary["objects"]),
                camera_motion=None if camera_motion is None else np.array(camera_motion, dtype=np.float64),
                method=summary["method"],
                seconds=summary["seconds"],
                settings=dict(summary.get("settings", {})),
                frames=dict(summary.get("frames", {})),
                camera_known=summary.get("camera") != "unknown",
                notes=tuple(map(str, summary.get("notes", ()))),
            )
