"""`consensus`: rigid motions by agreement among matches, pixels by agreement with the motions, without training.

In the spirit of SF2SE3 (Sommer et al., GCPR 2022): propose rigid motions from matched points, keep those that cover
most, assign each pixel to the motion that explains it, refine, and compute the flow from the motions.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, registration
from objectflow.alignment.camera_estimate import CameraCheckSettings, estimate_camera
from objectflow.alignment.camera_motion import CameraMotionSettings
from objectflow.alignment.fitting import FitSettings
from objectflow.alignment.frame_pair import MATCH_WIDTH, FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.alignment.matching import MatchSettings, PixelMatches, inside
from objectflow.alignment.registration import RegistrationSettings
from objectflow.geometry.depth_noise import DepthNoiseName
from objectflow.geometry.resample import upsample_mask
from objectflow.methods.base import PairEstimator
from objectflow.methods.consensus.assignment import Assignment, AssignmentSettings, MovingMask
from objectflow.methods.consensus.pixel_graph import PixelGraphSettings
from objectflow.methods.consensus.proposals import ProposalSettings, propose
from objectflow.methods.consensus.selection import Selection, SelectionSettings, prune, select_objects
from objectflow.methods.consensus.unexplained import RecoverySettings, recover_unexplained
from objectflow.methods.labels import unknown_motion
from objectflow.methods.mask_edges import MaskEdgeSettings, upsample_labels
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.runtime.threads import one_blas_thread
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


@dataclass(frozen=True)
class ConsensusConfig(Settings):
    """The settings of `consensus`."""

    camera: Literal["auto", "static", "moving"] = "auto"
    """static: the background's flow is exactly 0. moving: it is estimated. auto: it is estimated where its motion
    exceeds the noise."""
    match_width: int = setting(MATCH_WIDTH, minimum=64)
    """Pixels: wider frames are downscaled to it for matching and registration."""
    label_width: int = setting(320, minimum=64)
    """Pixels: pixels are assigned to motions at this width, and labels are then upsampled to the full image."""
    min_object_share: float = setting(0.0012, above=0, below=1)
    """Share of the image: smaller objects are not reported."""
    min_object_pixels: int = setting(12, minimum=1)
    """Pixels at `label_width`: smaller objects are not reported either."""
    rounds: int = setting(3, minimum=1)
    """Rounds of assigning pixels and refining motions."""
    seed: int = setting(0, minimum=0)
    """Seed of the random minimal sets; the same seed gives the same result."""
    background_sigmas: float = setting(3.0, minimum=0)
    """Standard deviations: matches up to this distance from the background's motion belong to the background."""
    max_points: int = setting(2000, minimum=6)
    """Maximum number of points per object that are registered, sampled evenly."""
    min_matches: int = setting(6, minimum=3)
    """Minimum number of matches inside a mask for their fit to be an initial motion."""
    min_fit_gain: float = setting(6.0, minimum=0)
    """Standard deviations, summed over the matches, by which their fit must improve on an initial motion to replace
    it: about what its six free parameters explain."""
    min_fit_gain_per_match: float = setting(0.1, minimum=0)
    """The same per match; the larger of the two limits holds."""
    depth_noise: DepthNoiseName = "measured"
    """Noise model of the depth camera; measured: fitted to each pair."""
    matching: MatchSettings = MatchSettings()
    camera_motion: CameraMotionSettings = CameraMotionSettings()
    camera_check: CameraCheckSettings = CameraCheckSettings()
    proposals: ProposalSettings = ProposalSettings()
    likelihood: LikelihoodSettings = LikelihoodSettings()
    graph: PixelGraphSettings = PixelGraphSettings()
    assignment: AssignmentSettings = AssignmentSettings()
    recovery: RecoverySettings = RecoverySettings()
    selection: SelectionSettings = SelectionSettings()
    mask_edges: MaskEdgeSettings = MaskEdgeSettings()
    fit: FitSettings = FitSettings()
    registration: RegistrationSettings = RegistrationSettings()


class Hypothesis(NamedTuple):
    """A moving object in progress: its motion, points that follow it, its matches, and its mask once there is one."""

    prev_T_curr: Float64Array
    anchors: Float32Array
    matches: PixelMatches
    mask: BoolMask | None = None


@dataclass(frozen=True)
class ConsensusEstimator(ConsensusConfig, PairEstimator):
    """The training-free estimator; its fields are its settings."""

    @one_blas_thread()
    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        start = time.perf_counter()
        camera = estimate_camera(
            pair.with_matching(self.matching),
            camera=self.camera,
            depth_noise=self.depth_noise,
            seed=self.seed,
            motion=self.camera_motion,
            settings=self.camera_check,
        )
        if camera.state == "unknown":
            motion = dataclasses.replace(
                unknown_motion(pair.curr.frame.depth.shape), method="consensus", settings=self.to_dict()
            )
        else:
            motion = self.find(camera.pair, camera.prev_T_curr)
        return dataclasses.replace(motion, notes=camera.notes, seconds=time.perf_counter() - start)

    def find(
        self,
        pair: FramePair,
        camera_motion: Float64Array | None = None,
        *,
        known: BoolMask | None = None,
        others: Sequence[MovingMask] = (),
    ) -> SceneMotion:
        """The moving objects among the pixels that nothing else explains.

        Args:
            pair: the frames, with the noise of their depth.
            camera_motion: (4, 4) `prev_T_curr` of the static background; None for a static camera.
            known: (H, W) bool of the current frame: pixels that belong to known objects. They are not searched, and
                are background in the result.
            others: motion and (H, W) mask of each object that is known to move and may have hidden background.
        """
        start = time.perf_counter()
        rng = np.random.default_rng(self.seed)
        # 1. Match the frames.
        full = pair.at_width(self.match_width)
        # 2. What does not follow the background moves.
        background = np.eye(4) if camera_motion is None else camera_motion
        # 3. Propose rigid motions of the remaining matches.
        movers = _moving(full.matches, background, full, self.background_sigmas)
        if known is not None:
            movers = movers[~inside(known, movers, full.curr.frame.camera)]
        proposed = propose(
            movers, full.curr.frame.camera, rng=rng, noise=full.noise, fit=self.fit, settings=self.proposals
        )
        hypotheses = [Hypothesis(p.prev_T_curr, p.matches.curr, p.matches) for p in proposed]
        # 4. Assign pixels to motions and refine the motions of the pixels, in turn.
        small = pair.at_width(self.label_width)
        shape = small.curr.frame.depth.shape
        assignment = Assignment(
            small,
            camera_motion,
            min_pixels=max(self.min_object_pixels, round(self.min_object_share * small.curr.frame.depth.size)),
            likelihood=self.likelihood,
            graph=self.graph,
            settings=self.assignment,
        )
        if known is not None:
            moving_masks = [(motion, upsample_mask(mask, shape)) for motion, mask in others]
            assignment.exclude(upsample_mask(known, shape), moving_masks)
        masks: list[BoolMask] = []
        for number in range(self.rounds):
            fine = number + 1 == self.rounds
            masks, hypotheses = self._assign_and_refine(assignment, hypotheses, full, movers, fine=fine)
            if not fine:
                motions = [h.prev_T_curr for h in hypotheses]
                more = recover_unexplained(
                    assignment,
                    masks,
                    motions,
                    full,
                    movers,
                    self.recovery,
                    fit=self.fit,
                    registration=self.registration,
                )
                hypotheses += [Hypothesis(f.prev_T_curr, assignment.points[f.mask], f.matches, f.mask) for f in more]
        # 5. Select the objects that moved, and regions that no motion explains.
        labels_s, objects = select_objects(
            assignment,
            masks,
            [h.prev_T_curr for h in hypotheses],
            full.curr.frame.camera,
            movers,
            self.selection,
            fit=self.fit,
        )
        # 6. Upsample the labels to the full image and compute the flow from the motions.
        labels = upsample_labels(labels_s, pair.curr, pair.noise, self.mask_edges)
        if known is not None:
            labels = np.where(known, np.int32(0), labels)
        return self._result(pair, labels, objects, camera_motion, start)

    def _assign_and_refine(
        self,
        assignment: Assignment,
        hypotheses: list[Hypothesis],
        full: FramePair,
        movers: PixelMatches,
        *,
        fine: bool,
    ) -> tuple[list[BoolMask], list[Hypothesis]]:
        """One round: the masks of the present motions, and the refined motion of each mask."""
        if not hypotheses:
            return [], []
        frame = full.curr.frame
        known = [h.mask for h in hypotheses if h.mask is not None]
        motions, anchors = [h.prev_T_curr for h in hypotheses], [h.anchors for h in hypotheses]
        labels = assignment.assign(motions, anchors, known, fine=fine)
        masks: list[BoolMask] = []
        refined: list[Hypothesis] = []
        for label, mask in assignment.split(labels):
            initial = motions[label - 1]
            own = movers[inside(mask, movers, frame.camera)]
            source = full.sources.take(upsample_mask(mask, frame.depth.shape), limit=self.max_points)
            if len(own.curr) >= self.min_matches:
                initial = _better_initial(initial, own, full, self)
            motion = registration.refine(
                full.target, source, initial, matches=own, settings=self.registration
            ).prev_T_curr
            refined.append(Hypothesis(motion, assignment.anchors(mask, motion), own, mask))
            masks.append(mask)
        kept = prune(assignment, masks, [h.prev_T_curr for h in refined], self.selection)
        return [masks[k] for k in kept], [refined[k] for k in kept]

    def _result(
        self,
        pair: FramePair,
        labels: LabelImage,
        objects: list[Selection],
        camera_motion: Float64Array | None,
        start: float,
    ) -> SceneMotion:
        points, valid = pair.curr.points, pair.curr.valid
        kept: list[ObjectMotion] = []
        final = np.zeros_like(labels)
        for number, found in enumerate(objects, 1):
            mask = labels == number
            if not (mask & valid).any():
                continue
            identifier = len(kept) + 1
            final[mask] = identifier
            kept.append(
                ObjectMotion(
                    id=identifier,
                    pixels=int(mask.sum()),
                    score=found.score,
                    moving=found.moving,
                    center=np.asarray(points[mask & valid].mean(axis=0), dtype=np.float64),
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
            settings=self.to_dict(),
        )


def _moving(matches: PixelMatches, background: Float64Array, pair: FramePair, sigmas: float) -> PixelMatches:
    """Matches that lie farther from the background's motion than noise explains."""
    error = np.linalg.norm(geometry.transform(background, matches.curr) - matches.prev, axis=1)
    return matches[error > sigmas * pair.noise.match_sigma(matches.curr[:, 2], pair.curr.frame.camera)]


def _better_initial(
    prev_T_curr: Float64Array, matches: PixelMatches, pair: FramePair, config: ConsensusConfig
) -> Float64Array:
    """The fit to the matches, where it is better than the motion so far by more than its free parameters explain."""
    fit = config.fit
    fitted = fitting.fit_matches(matches, pair.curr.frame.camera, noise=pair.noise, settings=fit)[0]
    limit = fit.inlier_sigmas
    gain = _misfit(prev_T_curr, matches, pair, limit) - _misfit(fitted, matches, pair, limit)
    least = max(config.min_fit_gain, config.min_fit_gain_per_match * len(matches.curr))
    return fitted if gain > least else prev_T_curr


def _misfit(prev_T_curr: Float64Array, matches: PixelMatches, pair: FramePair, limit: float) -> float:
    error = np.linalg.norm(geometry.transform(prev_T_curr, matches.curr) - matches.prev, axis=1)
    return float(np.minimum(error / pair.noise.match_sigma(matches.curr[:, 2], pair.curr.frame.camera), limit).sum())
