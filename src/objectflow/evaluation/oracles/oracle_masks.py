"""`oracle-masks`: true masks with our rigid fit, which shows how much of a method's error comes from its masks."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, matching, registration
from objectflow.alignment.camera_motion import CameraMotionSettings, background_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches
from objectflow.errors import ResultError
from objectflow.evaluation.data.truth import MIN_DISPLACEMENT
from objectflow.geometry.resample import resize_nearest
from objectflow.methods.base import PairEstimator, check_camera_option
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float64Array, LabelImage


@dataclass(frozen=True, eq=False)
class OracleMasks(PairEstimator):
    """An estimator that is given the true labels of one pair, but no motions.

    Attributes:
        labels: (H, W) int32 of the current frame; 0 = background.
        camera: "static", "moving" or "auto", as for every method.
        match_width: pixels; wider images are matched at this width, as in `consensus`.
        seed: of the random minimal sets.
    """

    labels: LabelImage
    camera: str = "auto"
    match_width: int = 640
    seed: int = 0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`.

        Raises:
            FrameError: frames that differ in size or intrinsics.
            ResultError: labels of another size than the frame.
        """
        start = time.perf_counter()
        curr = pair.curr.frame
        if self.labels.shape != curr.depth.shape:
            raise ResultError(f"true labels {self.labels.shape} do not match the frame {curr.depth.shape}")
        # 1. Match the frames, at the width of `consensus`.
        small = pair.at_width(self.match_width)
        labels_s = resize_nearest(self.labels, small.curr.frame.depth.shape)
        along_flow, features = _flow_matches(small), matching.feature_matches(small.prev, small.curr)
        # 2. The camera's motion, from the true background.
        camera_motion = None
        if ((self.labels == 0) & curr.valid).any():
            rng = np.random.default_rng(self.seed)
            settings = CameraMotionSettings(width=self.match_width)
            camera_motion = background_motion(
                pair, camera=self.camera, rng=rng, mask=self.labels == 0, settings=settings
            )
        background = np.eye(4) if camera_motion is None else camera_motion
        # 3. The motion of each mask, and the flow of the motions.
        points = pair.curr.points
        objects = []
        for label in np.unique(self.labels[self.labels > 0]).tolist():
            mask, mask_s = self.labels == label, labels_s == label
            source = small.sources.take(mask_s)
            found = _fit(small.target, source, _inside(along_flow, mask_s), _inside(features, mask_s), background)
            seen = points[mask & curr.valid].astype(np.float64)
            objects.append(_object_motion(label, int(mask.sum()), found, seen, background))
        motions = {obj.id: obj.prev_T_curr for obj in objects}
        return SceneMotion(
            labels=self.labels,
            scene_flow=geometry.flow_from_motions(points, self.labels, motions, camera_motion),
            objects=tuple(objects),
            camera_motion=camera_motion,
            method="oracle-masks",
            seconds=time.perf_counter() - start,
        )


def _fit(
    target: registration.RegistrationTarget,
    source: registration.RegistrationSource,
    along_flow: PixelMatches,
    features: PixelMatches,
    background: Float64Array,
) -> registration.RegistrationResult:
    """Refine the background's motion and fits to matches, and keep the result that explains most of the object.

    Optical flow and features have separate starts because they fail in different cases: features on objects without
    texture, flow on objects with large displacements, where a wrong match can still be consistent.
    """
    matches = along_flow + features
    starts = [background]
    starts += [fitting.fit_matches(m, target.camera)[0] for m in (matches, features) if len(m.curr) >= 6]
    refined = [registration.refine(target, source, start, matches=matches) for start in starts]
    return max(refined, key=lambda r: r.fitness * r.visible)


def _object_motion(
    label: int, pixels: int, found: registration.RegistrationResult, points: Float64Array, background: Float64Array
) -> ObjectMotion:
    center, shift = np.zeros(3), 0.0
    if len(points):
        center = points.mean(axis=0)
        against = geometry.transform(found.prev_T_curr, points) - geometry.transform(background, points)
        shift = float(np.linalg.norm(against, axis=1).mean())
    return ObjectMotion(
        id=label,
        pixels=pixels,
        score=round(found.fitness, 4),
        moving=shift > MIN_DISPLACEMENT,
        center=center,
        prev_T_curr=found.prev_T_curr,
    )


def _flow_matches(pair: FramePair) -> PixelMatches:
    """Optical flow on a grid twice as fine as that of `consensus`, for small objects."""
    flow, consistent = matching.dense_flow(pair.prev.gray, pair.curr.gray)
    return matching.flow_matches(flow, consistent, pair.prev.frame, pair.curr.frame, stride=4)


def _inside(matches: PixelMatches, mask: BoolMask) -> PixelMatches:
    columns, rows = np.rint(matches.pixels).astype(int).T
    height, width = mask.shape
    return matches[mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]]
