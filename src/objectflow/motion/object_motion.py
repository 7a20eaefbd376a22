"""`ObjectMotion`: one object and its rigid motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.typing import Float64Array


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """One object and its rigid motion from the current frame back to the previous one.

    Attributes:
        id: its value in `SceneMotion.labels`, from 1.
        pixels: number of pixels with this label.
        score: 0..1, confidence that this is one rigid object with this motion.
        moving: whether it moved relative to the static background by more than the noise.
        center: (3,) float64, metres, camera frame: X of the paper, in the current frame.
        prev_T_curr: (4, 4) float64 rigid transform that maps a point of `curr` to its position in `prev`.
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

    @property
    def curr_T_prev(self) -> Float64Array:
        """(4, 4) float64: the inverse of `prev_T_curr`."""
        return geometry.inverse(self.prev_T_curr)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ObjectMotion):
            return NotImplemented
        plain = ("id", "pixels", "score", "moving")
        return all(getattr(self, name) == getattr(other, name) for name in plain) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("center", "prev_T_curr")
        )

    __hash__ = None  # type: ignore[assignment]  # equal by its arrays, which can change

    def __repr__(self) -> str:
        shift = 100 * float(np.linalg.norm(self.translation))
        angle = float(np.degrees(np.linalg.norm(self.rotation_vector)))
        what = f"moved {shift:.1f} cm, {angle:.1f} deg" if self.moving else "static"
        return f"ObjectMotion({self.id}: {what}, score {self.score:.2f}, {self.pixels} pixels)"

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

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> ObjectMotion:
        """The inverse of `to_dict`.

        Raises:
            ValueError, KeyError, TypeError: an entry that describes no object.
        """
        prev_T_curr = np.array(entry["prev_T_curr"], dtype=np.float64)
        center = np.array(entry["center"], dtype=np.float64)
        if prev_T_curr.shape != (4, 4) or center.shape != (3,):
            raise ValueError(f"object {entry['id']} has no 4x4 prev_T_curr or no center[3]")
        if not (np.isfinite(prev_T_curr).all() and np.isfinite(center).all()):
            raise ValueError(f"object {entry['id']} has a prev_T_curr or a center that is not finite")
        return cls(
            id=int(entry["id"]),
            pixels=int(entry["pixels"]),
            score=float(entry["score"]),
            moving=bool(entry["moving"]),
            center=center,
            prev_T_curr=prev_T_curr,
        )
