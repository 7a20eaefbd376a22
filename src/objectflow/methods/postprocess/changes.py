"""What a step of the pipeline changed: objects added, dropped, merged, set to rest, and motions replaced."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.methods.labels import Objects
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage

_SAME_DISPLACEMENT = 0.0005
"""Metres: two motions that place a centre closer than this count as the same."""
_SAME_ROTATION = np.radians(0.1)
"""Radians: likewise of rotations."""


@dataclass(frozen=True)
class StepChange:
    """The changes of one step. Ids are those after the step; ids of dropped and merged objects those before it.

    Attributes:
        step: its name.
        added: objects that keep most pixels of no earlier one.
        dropped: objects of whose pixels no object keeps a majority.
        merged: (earlier id, id of the object that took it in).
        stopped: objects that count as static from here on.
        started: objects that count as moving from here on.
        replaced: (id, displacement of the centre's end point in metres, rotation in degrees) of other motions.
        relabelled: number of pixels that changed between object and background, or between objects.
        rescored: objects with another score.
    """

    step: str
    added: tuple[int, ...]
    dropped: tuple[int, ...]
    merged: tuple[tuple[int, int], ...]
    stopped: tuple[int, ...]
    started: tuple[int, ...]
    replaced: tuple[tuple[int, float, float], ...]
    relabelled: int
    rescored: tuple[int, ...]

    def words(self) -> str:
        """The changes in one line; "nothing changed" where there is none."""
        parts = []
        for name, ids in (("added", self.added), ("dropped", self.dropped)):
            if ids:
                parts.append(f"{name} {_listed(ids)}")
        if self.merged:
            parts.append("merged " + ", ".join(f"{old} into {new}" for old, new in self.merged))
        if self.stopped:
            parts.append(f"now static {_listed(self.stopped)}")
        if self.started:
            parts.append(f"now moving {_listed(self.started)}")
        parts += [f"motion of {n} changed by {100 * d:.1f} cm, {a:.1f} deg" for n, d, a in self.replaced]
        if self.relabelled:
            parts.append(f"{self.relabelled} pixels relabelled")
        if self.rescored:
            parts.append(f"scores of {_listed(self.rescored)}")
        return "; ".join(parts) or "nothing changed"


def describe_change(
    step: str, old_labels: LabelImage, old: Objects, new_labels: LabelImage, new: Objects
) -> StepChange:
    """Compare labels and objects before and after a step; an object's successor keeps most of its pixels."""
    overlap = np.zeros((1 + _last(old), 1 + _last(new)), np.int64)
    np.add.at(overlap, (old_labels, new_labels), 1)
    heir = {obj.id: _largest(overlap[obj.id]) for obj in old}
    # Only earlier objects whose pixels an object keeps are candidates, so that one that grows stays the same object.
    origin = {
        obj.id: max((n for n in heir if heir[n] == obj.id), key=lambda n: int(overlap[n, obj.id]), default=0)
        for obj in new
    }
    before = {obj.id: obj for obj in old}
    merged = [(number, target) for number, target in heir.items() if target and origin.get(target) != number]
    same = {n: before[o] for n, o in origin.items() if o}
    kept = sum(int(overlap[o, n]) for n, o in origin.items() if o) + int(overlap[0, 0])
    return StepChange(
        step=step,
        added=tuple(number for number, source in origin.items() if not source),
        dropped=tuple(number for number, target in heir.items() if not target),
        merged=tuple(merged),
        stopped=tuple(obj.id for obj in new if obj.id in same and same[obj.id].moving and not obj.moving),
        started=tuple(obj.id for obj in new if obj.id in same and not same[obj.id].moving and obj.moving),
        replaced=tuple(
            (obj.id, *_difference(same[obj.id], obj.prev_T_curr))
            for obj in new
            if obj.id in same and not _is_same(*_difference(same[obj.id], obj.prev_T_curr))
        ),
        relabelled=int(old_labels.size - kept),
        rescored=tuple(obj.id for obj in new if obj.id in same and obj.score != same[obj.id].score),
    )


def _largest(row: np.ndarray[tuple[int], np.dtype[np.int64]]) -> int:
    """The id that holds most of an object's pixels; 0 for the background."""
    return int(row.argmax()) if row.any() else 0


def _last(objects: Objects) -> int:
    return max((obj.id for obj in objects), default=0)


def _difference(obj: ObjectMotion, other: Float64Array) -> tuple[float, float]:
    """Metres between the centre's end points under two motions, and degrees between their rotations."""
    ends = geometry.transform(obj.prev_T_curr, obj.center) - geometry.transform(other, obj.center)
    angle = geometry.rotation_angle(obj.prev_T_curr[:3, :3].T @ other[:3, :3])
    return float(np.linalg.norm(ends)), float(np.degrees(angle))


def _is_same(displacement: float, degrees: float) -> bool:
    return displacement < _SAME_DISPLACEMENT and np.radians(degrees) < _SAME_ROTATION


def _listed(ids: tuple[int, ...]) -> str:
    return ", ".join(map(str, ids))
