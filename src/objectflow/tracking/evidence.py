"""`Evidence`: what the current frame shows of objects whose shape is known, as a tracker uses it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array


class Evidence(Protocol):
    """What the current frame of a pair shows of objects whose shape is known."""

    def confirms(self, number: int, before: Float64Array, after: Float64Array) -> bool:
        """Whether the frame confirms a step of low score; such a step is no gap.

        Args:
            number: of the track.
            before, after: (4, 4) `camera_T_object` if the object rests, and after the step.
        """
        ...

    def refuses(self, number: int, before: Float64Array, after: Float64Array) -> bool:
        """Whether the frame shows that a step, with the same arguments, is not that of the track."""
        ...

    def rests(self, number: int, camera_T_object: Float64Array) -> bool:
        """Whether the frame shows a track's object at its last pose (4, 4)."""
        ...

    def arrives(self, obj: ObjectMotion) -> bool:
        """Whether the frames show that an object of low score was not where it is now, so that it moved somehow."""
        ...

    def recognises(self, obj: ObjectMotion, candidates: Sequence[int]) -> tuple[int, Float64Array] | None:
        """The track that an object without an association is, and its pose `camera_T_object` (4, 4) in the frame.

        Args:
            obj: of the estimate.
            candidates: tracks without an association, those of the most similar colours first.

        Returns:
            None for a new object.
        """
        ...

    def contains(self, obj: ObjectMotion, steps: Mapping[int, tuple[Float64Array, Float64Array]]) -> int | None:
        """The track of which an object without an association is a piece.

        Args:
            obj: of the estimate.
            steps: of the tracks with an association, the poses `camera_T_object` (4, 4) in both frames.

        Returns:
            None where it is no piece of a known object.
        """
        ...
