"""`ObjectMotion` and `SceneMotion`: what comes out, with a folder form that round-trips."""

from __future__ import annotations

import json
import tokenize
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from objectflow import geometry
from objectflow.errors import ReaderError, ResultError
from objectflow.storage import files
from objectflow.storage.images import read_image
from objectflow.typing import Float32Array, Float64Array, LabelImage

# What broken JSON and .npy files make their parsers raise: numbers without end, brackets that never close, a header
# that is no Python or asks for more memory than there is.
_BROKEN = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    EOFError,
    OverflowError,
    RecursionError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
)


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """One object and its rigid motion from the current frame back to the previous one.

    Attributes:
        id: its value in `SceneMotion.labels`, from 1.
        pixels: how many pixels carry it.
        score: 0..1, how sure the method is that this is one rigid object with this motion.
        moving: whether it moved against the static background by more than the noise.
        center: (3,) float64, metres, camera frame: X of the paper, in the current frame.
        prev_T_curr: (4, 4) float64 rigid transform: where a point seen in `curr` was in `prev`.
    """

    id: int
    pixels: int
    score: float
    moving: bool
    center: Float64Array
    prev_T_curr: Float64Array

    @property
    def rotation_vector(self) -> Float64Array:
        """(3,) axis-angle in radians of the rotation part of `prev_T_curr`."""
        return geometry.so3_log(self.prev_T_curr[:3, :3])

    @property
    def translation(self) -> Float64Array:
        """(3,) metres: displacement of the centre, T of the paper: `P_prev = R (P_curr - X) + X + T`."""
        return geometry.transform(self.prev_T_curr, self.center) - self.center

    def to_dict(self) -> dict[str, Any]:
        """The object's entry in `objects.json`."""
        return {
            "id": self.id,
            "pixels": self.pixels,
            "score": self.score,
            "moving": self.moving,
            "center": self.center.tolist(),
            "rotation_vector": self.rotation_vector.tolist(),
            "translation": self.translation.tolist(),
            "prev_T_curr": self.prev_T_curr.tolist(),
        }


@dataclass(frozen=True, eq=False)
class SceneMotion:
    """The motion of a whole scene, on the pixels of the current frame.

    Attributes:
        labels: (H, W) int32, 0 = background, otherwise an object's id.
        scene_flow: (H, W, 3) float32 metres, `P_prev - P_curr`; NaN where depth is missing.
        objects: in order of id.
        camera_motion: (4, 4) float64 `prev_T_curr` of the static background, or None for a static camera.
        method: the estimator's name.
        seconds: what the estimate took.

    Raises:
        ResultError: arrays that do not fit together, or labels without an object.
    """

    labels: LabelImage
    scene_flow: Float32Array
    objects: tuple[ObjectMotion, ...] = ()
    camera_motion: Float64Array | None = None
    method: str = ""
    seconds: float = field(default=0.0)

    def __post_init__(self) -> None:
        if self.labels.ndim != 2 or self.labels.dtype != np.int32:
            raise ResultError(f"labels must be (H, W) int32, not {self.labels.shape} {self.labels.dtype}")
        if self.scene_flow.shape != (*self.labels.shape, 3) or self.scene_flow.dtype != np.float32:
            raise ResultError(
                f"scene_flow must be {(*self.labels.shape, 3)} float32, "
                f"not {self.scene_flow.shape} {self.scene_flow.dtype}"
            )
        if self.camera_motion is not None and self.camera_motion.shape != (4, 4):
            raise ResultError(f"camera_motion must be a 4x4 transform, not {self.camera_motion.shape}")
        object.__setattr__(self, "objects", tuple(self.objects))
        ids = [obj.id for obj in self.objects]
        if sorted(set(ids)) != ids or (ids and ids[0] < 1):
            raise ResultError(f"object ids must be rising and from 1, not {ids}")
        stray = set(np.unique(self.labels).tolist()) - {0} - set(ids)
        if stray:
            raise ResultError(f"labels {sorted(stray)} belong to no object")

    def save(self, folder: str | Path) -> None:
        """Write `labels.png`, `scene_flow.npy` and `objects.json` into a new folder: all of it or nothing.

        Raises:
            ResultError: the folder has content already.
            StorageError: the disk refused.
        """
        with files.new_folder(Path(folder)) as temporary:
            self.write_into(temporary)

    def write_into(self, folder: Path) -> None:
        """Write the three files of `save` into a folder that exists, for callers that add files of their own."""
        if self.labels.max(initial=0) > np.iinfo(np.uint16).max:
            raise ResultError(f"{folder}: labels above 65535 do not fit a 16-bit PNG")
        done, png = cv2.imencode(".png", self.labels.astype(np.uint16))
        if not done:
            raise ResultError(f"{folder}: labels cannot be encoded as PNG")
        (folder / "labels.png").write_bytes(png.tobytes())
        np.save(folder / "scene_flow.npy", self.scene_flow)
        summary = {
            "objects": [obj.to_dict() for obj in self.objects],
            "camera_motion": None if self.camera_motion is None else self.camera_motion.tolist(),
            "method": self.method,
            "seconds": self.seconds,
            "width": self.labels.shape[1],
            "height": self.labels.shape[0],
        }
        (folder / "objects.json").write_text(json.dumps(summary, indent=2) + "\n")

    @classmethod
    def load(cls, folder: str | Path) -> SceneMotion:
        """Read what `save` or `objectflow estimate` wrote.

        Raises:
            ResultError: a file is missing, broken, or does not fit the others.
        """
        folder = Path(folder)
        try:
            summary = json.loads((folder / "objects.json").read_text(encoding="utf-8"))
            labels = read_image(folder / "labels.png")
            if labels.dtype.kind != "u":
                raise ValueError("labels.png must hold whole numbers")
            if labels.shape != (summary["height"], summary["width"]):
                raise ValueError(f"labels.png has shape {labels.shape}, objects.json tells of another size")
            with open(folder / "scene_flow.npy", "rb") as file:
                flow = np.lib.format.read_array(file, allow_pickle=False)
            camera_motion = summary["camera_motion"]
            return cls(
                labels=labels.astype(np.int32),
                scene_flow=flow,
                objects=tuple(_object_from_dict(entry) for entry in summary["objects"]),
                camera_motion=None if camera_motion is None else np.array(camera_motion, dtype=np.float64),
                method=str(summary["method"]),
                seconds=float(summary["seconds"]),
            )
        except FileNotFoundError as error:
            raise ResultError(f"{folder}: not a result folder: {Path(error.filename).name} is missing") from None
        except (ReaderError, ResultError) as error:
            raise ResultError(f"{folder}: not a result folder that can be read: {error}") from error
        except _BROKEN as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise ResultError(f"{folder}: not a result folder that can be read: {reason}") from error


def _object_from_dict(entry: dict[str, Any]) -> ObjectMotion:
    prev_T_curr = np.array(entry["prev_T_curr"], dtype=np.float64)
    center = np.array(entry["center"], dtype=np.float64)
    if prev_T_curr.shape != (4, 4) or center.shape != (3,):
        raise ValueError(f"object {entry['id']} has no 4x4 prev_T_curr or no center[3]")
    if not (np.isfinite(prev_T_curr).all() and np.isfinite(center).all()):
        raise ValueError(f"object {entry['id']} has a prev_T_curr or a center that is not finite")
    return ObjectMotion(
        id=int(entry["id"]),
        pixels=int(entry["pixels"]),
        score=float(entry["score"]),
        moving=bool(entry["moving"]),
        center=center,
        prev_T_curr=prev_T_curr,
    )
