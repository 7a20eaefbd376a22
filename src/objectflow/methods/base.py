"""The interface that every method has."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion


class Estimator(Protocol):
    """Two frames in, the motion of the scene out, on the pixels of `curr`."""

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """Estimate the motion from `curr` back to `prev`.

        Raises:
            FrameError: the frames differ in size or intrinsics.
        """


def check_camera_option(camera: str) -> None:
    """Check the option that every method has.

    Raises:
        MethodError: not one of "auto", "static", "moving".
    """
    if camera not in ("auto", "static", "moving"):
        raise MethodError(f"camera must be auto, static or moving, not {camera!r}")


@runtime_checkable
class AcceptsFramePair(Protocol):
    """An estimator that spares itself what somebody else has prepared."""

    def estimate(self, prev: RgbdFrame, curr: RgbdFrame, pair: FramePair) -> SceneMotion:
        """As the call of an `Estimator`."""
        ...
