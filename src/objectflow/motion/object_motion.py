"""`ObjectMotion`: one object and its rigid motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.errors import ResultError
from objectflow.typing import Float64Array

MAX_NUMBER = 2**31 - 1
"""Largest id, number of pixels and score: labels are int32."""
IDENTITY_TOLERANCE = 1e-9
"""Largest difference from the identity, per matrix entry, that rounding explains."""


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """One object and its rigid motion from the current frame back to the previous one.

    Attributes:
        id: its value in `SceneMotion.labels`, from 1.
        pixels: number of pixels with this label.
        score: 0..1, confidence that this is one rigid object with this motion.
        moving: whether it moved relative to the static background by more than the noise.
        center: (3,) float64, metres, camera frame: the centre of the visible surface in the current frame, the mean
            of its points with depth.
        prev_T_curr: (4, 4) float64 rigid transform that maps a point of `curr` to its position in `prev`. It includes
            the motion of the camera.
        camera_motion: (4, 4) float64 `prev_T_curr` of the static background, None for a static camera. `SceneMotion`
            sets it to its own.
        rigid: False where no rigid motion explains the visible surface: the object deforms, or the mask holds things
            that move differently. `prev_T_curr` is then the motion of the part that it explains.

    Raises:
        ResultError: a value of another type, a number that is not finite, or a `prev_T_curr` that is not rigid.
    """

    id: int
    pixels: int
    score: float
    moving: bool
    center: Float64Array
    prev_T_curr: Float64Array
    camera_motion: Float64Array | None = None
    rigid: bool = True

    def __post_init__(self) -> None:
        for name in ("id", "pixels"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise ResultError(f"{name} of an object must be a whole number, not {value!r}")
            if not 0 <= value <= MAX_NUMBER:
                raise ResultError(f"{name} of an object must lie in 0..{MAX_NUMBER}, not {value!r}")
        if isinstance(self.score, bool) or not isinstance(self.score, int | float | np.number):
            raise ResultError(f"object {self.id}: its score must be a number, not {self.score!r}")
        if not abs(self.score) <= MAX_NUMBER:
            raise ResultError(f"object {self.id}: its score must be a finite number, not {self.score!r}")
        if not isinstance(self.moving, bool | np.bool_):
            raise ResultError(f"object {self.id}: moving must be true or false, not {self.moving!r}")
        if not isinstance(self.rigid, bool | np.bool_):
            raise ResultError(f"object {self.id}: rigid must be true or false, not {self.rigid!r}")
        center = self.center
        if not isinstance(center, np.ndarray) or center.shape != (3,) or center.dtype.kind != "f":
            raise ResultError(f"object {self.id} has no center of three floating-point numbers")
        with np.errstate(over="ignore"):  # Numbers beyond float64 become infinite, which is refused.
            distance = np.abs(center.astype(np.float64)).max()  # The limit exceeds the range of float16.
        if not distance <= geometry.MAX_DISTANCE:  # written so that NaN fails too
            raise ResultError(f"object {self.id}: its center is not finite, or further than any camera sees")
        if not geometry.is_rigid(self.prev_T_curr):
            raise ResultError(f"object {self.id}: its prev_T_curr is not a rigid 4x4 transform")

    @property
    def own_prev_T_curr(self) -> Float64Array:
        """(4, 4) the object's own motion, without the camera's: where a point was before, in the current camera frame.

        It is the identity for an object that is not moving.
        """
        if not self.moving:
            return np.eye(4)
        if self.camera_motion is None:
            return self.prev_T_curr
        return geometry.inverse(self.camera_motion) @ self.prev_T_curr

    @property
    def prev_center(self) -> Float64Array:
        """(3,) metres: where the centre was before, in the current camera frame."""
        return geometry.transform(self.own_prev_T_curr, self.center)

    @property
    def displacement(self) -> float:
        """Metres: how far the centre of the visible surface moved in the world."""
        return float(np.linalg.norm(self.prev_center - self.center))

    @property
    def rotation_deg(self) -> float:
        """Degrees: how far the object rotated in the world."""
        return math.degrees(float(geometry.rotation_angle(self.own_prev_T_curr[:3, :3])))

    @property
    def motion_known(self) -> bool:
        """False for a region that changed but whose motion was not found: its own motion is the identity."""
        return not self.moving or bool(np.abs(self.own_prev_T_curr - np.eye(4)).max() > IDENTITY_TOLERANCE)

    @property
    def rotation_vector(self) -> Float64Array:
        """(3,) axis-angle in radians of the rotation part of `prev_T_curr`, which includes the camera's motion."""
        return geometry.so3_log(self.prev_T_curr[:3, :3])

    @property
    def translation(self) -> Float64Array:
        """(3,) metres: T of the paper, `P_prev = R (P_curr - X) + X + T` with the centre X; see `prev_T_curr`."""
        return geometry.transform(self.prev_T_curr, self.center) - self.center

    @property
    def curr_T_prev(self) -> Float64Array:
        """(4, 4) float64: the inverse of `prev_T_curr`."""
        return geometry.inverse(self.prev_T_curr)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ObjectMotion):
            return NotImplemented
        plain = ("id", "pixels", "score", "moving", "rigid")
        return all(getattr(self, name) == getattr(other, name) for name in plain) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("center", "prev_T_curr")
        )

    __hash__ = None  # type: ignore[assignment]  # equal by its arrays, which can change

    def __repr__(self) -> str:
        what = "static"
        if self.moving:
            what = f"moved {100 * self.displacement:.1f} cm, {self.rotation_deg:.1f} deg"
        if not self.motion_known:
            what = "changed, motion unknown"
        if not self.rigid:
            what += ", not rigid"
        return f"ObjectMotion({self.id}: {what}, score {self.score:.2f}, {self.pixels} pixels)"

    def to_dict(self) -> dict[str, Any]:
        """The object's entry in `objects.json`."""
        return {
            "id": self.id,
            "pixels": self.pixels,
            "score": self.score,
            "moving": self.moving,
            "motion_known": self.motion_known,
            "rigid": bool(self.rigid),
            "center": self.center.tolist(),
            "displacement_m": self.displacement,
            "rotation_deg": self.rotation_deg,
            "own_prev_T_curr": self.own_prev_T_curr.tolist(),
            "rotation_vector": self.rotation_vector.tolist(),
            "translation": self.translation.tolist(),
            "prev_T_curr": self.prev_T_curr.tolist(),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> ObjectMotion:
        """The inverse of `to_dict`.

        Raises:
            ResultError: a value that describes no object.
            ValueError, KeyError, TypeError: a value is missing, or not a list of numbers.
        """
        return cls(
            id=entry["id"],
            pixels=entry["pixels"],
            score=entry["score"],
            moving=entry["moving"],
            rigid=entry.get("rigid", True),
            center=np.array(entry["center"], dtype=np.float64),
            prev_T_curr=np.array(entry["prev_T_curr"], dtype=np.float64),
        )
