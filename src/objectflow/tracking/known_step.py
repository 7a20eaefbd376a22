"""The step of one known object from the previous to the current frame: it rests, it moved, or it is lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from objectflow import geometry
from objectflow.tracking.fine_step import NeighbourFrame, fine_step
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_motion import ModelPose, PairViews, matched_motion, model_motion
from objectflow.typing import Float64Array


class Starts(NamedTuple):
    """Hypotheses of an object's motion.

    Attributes:
        rest: (4, 4) `curr_T_object` at the last pose.
        predicted: (4, 4) `curr_T_object` at its last speed; None where it rested.
        motions: (4, 4) `prev_T_curr` each, of the objects of an estimate.
    """

    rest: Float64Array
    predicted: Float64Array | None
    motions: Sequence[Float64Array] = ()

    def poses(self, prev_T_curr: Float64Array) -> list[Float64Array]:
        """The hypotheses as initial poses `curr_T_object`.

        Args:
            prev_T_curr: (4, 4) motion of the static background.
        """
        poses = [self.rest] if self.predicted is None else [self.rest, self.predicted]
        return poses + [geometry.inverse(motion) @ prev_T_curr @ self.rest for motion in self.motions]


class KnownStep(NamedTuple):
    """What the frames show of a known object.

    Attributes:
        moved: its pose if it moved, None otherwise.
        fine: whether the last pose explains the frame well too, so that the step is small.
        lost: whether the frame shows the object neither at its last pose nor elsewhere.
    """

    moved: ModelPose | None = None
    fine: bool = False
    lost: bool = False


def known_step(
    views: PairViews, number: int, known: KnownObject, starts: Starts, settings: KnownSettings, *, quick: bool = False
) -> KnownStep:
    """Compare an object's model with the current frame at its last pose, and register it where it moved.

    Args:
        views: the pair.
        number: track id of the object.
        known: the object.
        starts: hypotheses of its motion; the matches between the frames provide one more.
        settings: thresholds.
        quick: try the last speed alone, and where it explains too little the pose that the object's looks give, which
            does not depend on how far it moved. The features of the frame are shared by all objects; matches between
            the frames, which take longer, are not made.
    """
    view, follow = views.curr, settings.follow
    fit = view.fit(known.model, starts.rest)
    seen = (fit.fits | fit.missing).sum() >= follow.min_points
    dropped = known.present - fit.present >= follow.min_drop
    if seen and fit.present >= follow.max_rest and not dropped:
        if known.moved:
            neighbour = NeighbourFrame(views.prev, views.prev_T_curr)
            poses = starts.poses(views.prev_T_curr) if quick else _all(views, number, starts, settings)
            fine = fine_step(view, neighbour, known.model, starts.rest, poses, settings.earlier)
            if fine is not None and fine.moved:
                return KnownStep(ModelPose(fine.camera_T_object, fine.present), fine=True)
        return KnownStep()
    found = None
    # A model that fits as badly as in the last frame is inexact or half hidden, and does not move.
    if seen and (known.moved or dropped):
        if not quick:
            found = model_motion(views, known.model, starts.rest, _all(views, number, starts, settings), follow)
        elif starts.predicted is not None and view.fit(known.model, starts.predicted).present >= fit.present:
            found = model_motion(views, known.model, starts.rest, [starts.predicted], follow)
        if quick and (found is None or found.present < follow.max_rest):
            start = known.looks.find(view.frame, view.noise, follow.looks)
            again = None if start is None else model_motion(views, known.model, starts.rest, [start], follow)
            if again is not None and (found is None or again.present > found.present):
                found = again
    return KnownStep(found, lost=found is None and (not seen or fit.present < settings.min_present))


def _all(views: PairViews, number: int, starts: Starts, settings: KnownSettings) -> list[Float64Array]:
    """All initial poses `curr_T_object`, one of them by the matches between the frames."""
    matched = matched_motion(views, number, settings.follow)
    motions = starts.motions if matched is None else [*starts.motions, matched]
    return starts._replace(motions=motions).poses(views.prev_T_curr)
