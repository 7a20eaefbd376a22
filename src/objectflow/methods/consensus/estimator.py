"""`consensus`: rigid motions by agreement among matches, pixels by agreement with the motions; nothing is learned.

In the spirit of SF2SE3 (Sommer et al., GCPR 2022): propose rigid motions from matched points, keep those that cover
most, give each pixel to the motion that explains it, refine, and make the flow again from the motions.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.camera_motion import background_motion
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import PixelMatches, inside
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import match_sigma
from objectflow.geometry.resample import upsample_mask
from objectflow.methods.base import check_camera_option
from objectflow.methods.consensus import selection
from objectflow.methods.consensus.assignment import Assignment
from objectflow.methods.consensus.proposals import propose
from objectflow.methods.consensus.unexplained import recover_unexplained
from objectflow.methods.mask_edges import upsample_labels
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


class Hypothesis(NamedTuple):
    """One moving object on the way: a motion, points that follow it, and its mask once there is one."""

    prev_T_curr: Float64Array
    anchors: Float32Array
    matches: PixelMatches
    mask: BoolMask | None = None


@dataclass(frozen=True)
class ConsensusEstimator:
    """The training-free estimator.

    Attributes:
        camera: "static" fixes the background's flow to exactly 0, "moving" estimates it, "auto" decides by whether
            the background's motion stands out from the noise.
        match_width: pixels; wider images are matched at this width.
        label_width: pixels; pixels are assigned to motions at this width, then sharpened to the full image.
        min_object_share: of the image; smaller objects are not reported.
        rounds: of assigning pixels and refining motions.
        seed: of the random minimal sets; the same seed gives the same result.
    """

    camera: str = "auto"
    match_width: int = 640
    label_width: int = 320
    min_object_share: float = 0.0012
    rounds: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        if self.match_width < 64 or self.label_width < 64 or self.rounds < 1 or not 0 < self.min_object_share < 1:
            raise MethodError("consensus needs widths of at least 64, one round or more, and a share within (0, 1)")

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        return self.find(FramePair(prev, curr, self.match_width))

    def find(
        self, pair: FramePair, *, known: BoolMask | None = None, others: Sequence[tuple[Float64Array, BoolMask]] = ()
    ) -> SceneMotion:
        """What moves among pixels that nothing else explains.

        Args:
            pair: the frames, as wide as they were made ready; `match_width` says nothing here.
            known: (H, W) bool of the current frame: pixels that are spoken for. Nothing is looked for there, and the
                result has background there.
            others: `prev_T_curr` and (H, W) mask of each object that is known to move: what it hid may be background.

        Raises:
            FrameError: the frames differ in size or intrinsics.
        """
        start = time.perf_counter()
        prev, curr = pair.prev, pair.curr
        check_pair(prev, curr)
        rng = np.random.default_rng(self.seed)
        # 1. Match the frames and lift the matches by depth.
        curr_m, matches, target, sources = pair.curr_small, pair.matches, pair.target, pair.sources
        # 2. The background first: what moves is what does not follow it.
        camera_motion = background_motion(matches, target, curr_m, camera=self.camera, rng=rng)
        background = np.eye(4) if camera_motion is None else camera_motion
        # 3. Rigid motions among the matches that are left.
        movers = _moving(matches, background, curr_m)
        if known is not None:
            movers = movers[~inside(known, movers, curr_m.camera)]
        hypotheses = [
            Hypothesis(p.prev_T_curr, p.matches.curr, p.matches) for p in propose(movers, curr_m.camera, rng=rng)
        ]
        # 4. Pixels to motions, motions from pixels.
        prev_s, curr_s = prev.downscaled_to_width(self.label_width), curr.downscaled_to_width(self.label_width)
        assignment = Assignment(prev_s, curr_s, camera_motion, min_pixels=self._min_pixels(curr_s))
        if known is not None:
            assignment.leave_out(
                upsample_mask(known, curr_s), [(motion, upsample_mask(mask, curr_s)) for motion, mask in others]
            )
        masks: list[BoolMask] = []
        for number in range(self.rounds):
            fine = number + 1 == self.rounds
            masks, hypotheses = self._assign_and_refine(
                assignment, hypotheses, target, sources, curr_m, movers, fine=fine
            )
            if not fine:
                motions = [h.prev_T_curr for h in hypotheses]
                more = recover_unexplained(assignment, masks, motions, target, sources, curr_m, movers)
                hypotheses += [Hypothesis(f.prev_T_curr, assignment.points[f.mask], f.matches, f.mask) for f in more]
        # 5. Keep what stands: objects that moved, and regions that no motion explains.
        labels_s, objects = selection.select_objects(
            assignment, masks, [h.prev_T_curr for h in hypotheses], target, movers
        )
        # 6. The full image: sharp labels, and the flow made again from the motions.
        labels = upsample_labels(labels_s, curr_s, curr)
        if known is not None:
            labels = np.where(known, np.int32(0), labels)
        return self._result(curr, labels, objects, camera_motion, start)

    def _min_pixels(self, frame: RgbdFrame) -> int:
        return max(12, round(self.min_object_share * frame.depth.size))

    def _assign_and_refine(
        self,
        assignment: Assignment,
        hypotheses: list[Hypothesis],
        target: registration.RegistrationTarget,
        sources: registration.RegistrationSources,
        curr: RgbdFrame,
        movers: PixelMatches,
        *,
        fine: bool,
    ) -> tuple[list[BoolMask], list[Hypothesis]]:
        """One round: the masks of the present motions, and each mask's motion refined."""
        if not hypotheses:
            return [], []
        known = [h.mask for h in hypotheses if h.mask is not None]
        motions, anchors = [h.prev_T_curr for h in hypotheses], [h.anchors for h in hypotheses]
        labels = assignment.assign(motions, anchors, known, fine=fine)
        masks: list[BoolMask] = []
        refined: list[Hypothesis] = []
        for label, mask in assignment.split(labels):
            start = motions[label - 1]
            own = movers[inside(mask, movers, curr.camera)]
            source = sources.take(upsample_mask(mask, curr), limit=2000)
            if len(own.curr) >= 6:
                start = _better_start(start, own, curr)
            motion = registration.refine(target, source, start, matches=own).prev_T_curr
            refined.append(Hypothesis(motion, assignment.anchors(mask, motion), own, mask))
            masks.append(mask)
        kept = selection.prune(assignment, masks, [h.prev_T_curr for h in refined])
        return [masks[k] for k in kept], [refined[k] for k in kept]

    def _result(
        self,
        curr: RgbdFrame,
        labels: LabelImage,
        objects: list[selection.Selection],
        camera_motion: Float64Array | None,
        start: float,
    ) -> SceneMotion:
        points = geometry.back_project(curr.depth, curr.camera)
        kept: list[ObjectMotion] = []
        final = np.zeros_like(labels)
        for number, found in enumerate(objects, 1):
            mask = labels == number
            if not (mask & curr.valid).any():
                continue
            identifier = len(kept) + 1
            final[mask] = identifier
            kept.append(
                ObjectMotion(
                    id=identifier,
                    pixels=int(mask.sum()),
                    score=found.score,
                    moving=found.moving,
                    center=np.asarray(points[mask & curr.valid].mean(axis=0), dtype=np.float64),
                    prev_T_curr=found.prev_T_curr,
                )
            )
        flow = geometry.flow_from_motions(points, final, {obj.id: obj.prev_T_curr for obj in kept}, camera_motion)
        return SceneMotion(
            labels=final,
            scene_flow=flow,
            objects=tuple(kept),
            camera_motion=camera_motion,
            method="consensus",
            seconds=time.perf_counter() - start,
        )


def _moving(matches: PixelMatches, background: Float64Array, curr: RgbdFrame) -> PixelMatches:
    """Matches that the background's motion leaves further off than noise does."""
    error = np.linalg.norm(geometry.transform(background, matches.curr) - matches.prev, axis=1)
    return matches[error > 3 * match_sigma(matches.curr[:, 2], curr.camera)]


def _better_start(prev_T_curr: Float64Array, matches: PixelMatches, curr: RgbdFrame) -> Float64Array:
    """The matches' own fit, if it beats the motion so far by more than six free parameters would by chance."""
    fitted = fitting.fit_matches(matches, curr.camera)[0]
    gain = _misfit(prev_T_curr, matches, curr) - _misfit(fitted, matches, curr)
    return fitted if gain > max(6.0, 0.1 * len(matches.curr)) else prev_T_curr


def _misfit(prev_T_curr: Float64Array, matches: PixelMatches, curr: RgbdFrame) -> float:
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    return float(np.minimum(error / match_sigma(matches.curr[:, 2], curr.camera), 3).sum())
