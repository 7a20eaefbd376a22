"""`oracle-masks`: true masks with our rigid fit, to show how much of a method's error comes from its masks."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, matching, registration
from objectflow.alignment.camera_motion import background_motion
from objectflow.alignment.matching import PixelMatches
from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.methods.base import check_camera_option
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float64Array, LabelImage

_MOVED = 0.005
"""Metres of mean displacement against the background from which an object is said to move."""


@dataclass(frozen=True, eq=False)
class OracleMasks:
    """An estimator that is told the true labels of one pair, and nothing of its motions.

    Attributes:
        labels: (H, W) int32 of the current frame; 0 = background.
        camera: "static", "moving" or "auto", as for every method.
        match_width: pixels; wider images are matched at this width, as `consensus` does.
        seed: of the random minimal sets.
    """

    labels: LabelImage
    camera: str = "auto"
    match_width: int = 640
    seed: int = 0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`.

        Raises:
            FrameError: the frames differ in size or intrinsics.
            ResultError: the labels are of another size.
        """
        start = time.perf_counter()
        check_pair(prev, curr)
        if self.labels.shape != curr.depth.shape:
            raise ResultError(f"true labels {self.labels.shape} do not fit the frame {curr.depth.shape}")
        # 1. Match and lift, at the width of `consensus`.
        prev_m, curr_m = prev.downscaled_to_width(self.match_width), curr.downscaled_to_width(self.match_width)
        labels_m = _narrow_labels(self.labels, curr_m.depth.shape)
        along_flow, features = _flow_matches(prev_m, curr_m), matching.feature_matches(prev_m, curr_m)
        target, sources = registration.RegistrationTarget(prev_m), registration.RegistrationSources(curr_m)
        # 2. The background from what is background in truth.
        rng = np.random.default_rng(self.seed)
        behind = _only(curr_m, labels_m == 0)
        camera_motion = None
        if behind is not None:
            matches = _inside(along_flow, labels_m == 0) + _inside(features, labels_m == 0)
            camera_motion = background_motion(matches, target, behind, camera=self.camera, rng=rng)
        background = np.eye(4) if camera_motion is None else camera_motion
        # 3. Every mask's motion, and the flow made from the motions.
        points = geometry.back_project(curr.depth, curr.camera)
        objects = []
        for label in np.unique(self.labels[self.labels > 0]).tolist():
            mask, mask_m = self.labels == label, labels_m == label
            source = sources.take(mask_m)
            found = _fit(target, source, _inside(along_flow, mask_m), _inside(features, mask_m), background)
            seen = points[mask & curr.valid].astype(np.float64)
            objects.append(_describe(label, int(mask.sum()), found, seen, background))
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
    """Refine from the fits to matches and from the background's motion; what explains most of the object stands.

    Flow and features fail apart: features on dull things, flow on objects that moved far, where it still agrees with
    itself in the wrong place. So each has a start of its own.
    """
    matches = along_flow + features
    starts = [background]
    starts += [fitting.fit_matches(m, target.camera)[0] for m in (matches, features) if len(m.curr) >= 6]
    refined = [registration.refine(target, source, start, matches=matches) for start in starts]
    return max(refined, key=lambda r: r.fitness * r.visible)


def _describe(
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
        moving=shift > _MOVED,
        center=center,
        prev_T_curr=found.prev_T_curr,
    )


def _narrow_labels(labels: LabelImage, shape: tuple[int, ...]) -> LabelImage:
    """Labels at the pixels that `RgbdFrame.resized` takes depth from."""
    rows = ((np.arange(shape[0]) + 0.5) * labels.shape[0] / shape[0]).astype(int)
    columns = ((np.arange(shape[1]) + 0.5) * labels.shape[1] / shape[1]).astype(int)
    return np.asarray(labels[rows[:, None], columns[None, :]])


def _flow_matches(prev: RgbdFrame, curr: RgbdFrame) -> PixelMatches:
    """Flow on a grid twice as fine as that of `consensus`: small objects need their matches."""
    flow, consistent = matching.dense_flow(matching.gray(prev.color), matching.gray(curr.color))
    return matching.flow_matches(flow, consistent, prev, curr, stride=4)


def _inside(matches: PixelMatches, mask: BoolMask) -> PixelMatches:
    columns, rows = np.rint(matches.pixels).astype(int).T
    height, width = mask.shape
    return matches[mask[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]]


def _only(frame: RgbdFrame, mask: BoolMask) -> RgbdFrame | None:
    """The frame with depth only inside a mask; None where there would be none."""
    depth = np.where(mask, frame.depth, np.float32(0))
    if not (depth > 0).any():
        return None
    return RgbdFrame(color=frame.color, depth=depth, camera=frame.camera, name=frame.name)
