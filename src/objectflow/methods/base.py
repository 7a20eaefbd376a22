"""The interface that every method has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Protocol

from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion


class Estimator(Protocol):
    """Two frames in, the motion of the scene out, on the pixels of the current frame."""

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """Estimate the motion from `curr` back to `prev`.

        Raises:
            FrameError: the frames differ in size or intrinsics.
        """
        ...


class PairEstimator(ABC):
    """Base of the methods: they work on a prepared pair, so that what one step computed serves the next."""

    @abstractmethod
    def estimate(self, pair: FramePair) -> SceneMotion:
        """Estimate the motion between two prepared frames; see `Estimator`."""

    def start(self, pair: FramePair) -> None:
        """Start in side threads what `estimate` needs of the frames alone, into `FramePair.beside`."""
        return

    def closer(self) -> PairEstimator:
        """The method with settings that find smaller objects in more time; itself if it has none."""
        return self

    def estimate_batch(self, pairs: Iterable[FramePair]) -> list[SceneMotion]:
        """Estimate several pairs; methods with a network evaluate it once for all of them."""
        return [self.estimate(pair) for pair in pairs]

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        return self.estimate(FramePair(prev, curr))


def closer(estimator: Estimator) -> Estimator:
    """Any estimator with the settings of `PairEstimator.closer`."""
    return estimator.closer() if isinstance(estimator, PairEstimator) else estimator


def estimate_pair(estimator: Estimator, pair: FramePair) -> SceneMotion:
    """The result of any estimator on a prepared pair; one that cannot use it is given the frames."""
    if isinstance(estimator, PairEstimator):
        return estimator.estimate(pair)
    return estimator(pair.prev.frame, pair.curr.frame)


def check_camera_option(camera: str) -> None:
    """Check the option that every method has.

    Raises:
        MethodError: not one of "auto", "static", "moving".
    """
    if camera not in ("auto", "static", "moving"):
        raise MethodError(f"camera must be auto, static or moving, not {camera!r}")
