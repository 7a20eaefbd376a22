"""`homc`: motion segmentation by higher-order minimum cost lifted multicuts (Keuper, ICCV 2017), from the paper.

Points are tracked through all frames by dense optical flow (`tracks`). Two tracks are compared by motion, distance and
colour, three tracks by how well a 2D similarity transform explains their motion (`costs`). Neighbours are connected by
edges, distant tracks by lifted edges, and triples replace pairs with a cutting cost (`graph`). The partition of
minimum cost is computed (`problem`, `multicut`, `search`); its parts are the segments. Depth is not used for them.

Differences from the author's program:
- Optical flow is DIS (Kroeger et al., ECCV 2016) from OpenCV, not the slower flow of the paper.
- Only tracks visible in the labelled frame are clustered; tracks that end before it have no pixel to label.
- Triples are formed only from the two equilateral triangles over each pair with a cutting cost.
- Kernighan-Lin is a library's second-order implementation, on triple costs spread over pairs, followed by a local
  search on the true energy (`search`); the paper's Kernighan-Lin has higher-order gains.
- d_s is in units of 32 pixels at a width of 320, and t0 was chosen on a validation split: docs/baselines.md.
- The largest segment is the background, and segments with fewer than `min_tracks` tracks are merged into it.
- A rigid motion is fitted to the depth-lifted track ends of each segment, since objects need one here.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, matching
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.moved import is_moving
from objectflow.methods.base import PairEstimator
from objectflow.methods.baselines.homc.costs import CostSettings
from objectflow.methods.baselines.homc.densify import densify
from objectflow.methods.baselines.homc.graph import build_problem
from objectflow.methods.baselines.homc.multicut import import_solver
from objectflow.methods.baselines.homc.search import solve
from objectflow.methods.baselines.homc.tracks import track_points
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, Int64Array, UInt8Array


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Labelled tracks.

    Attributes:
        positions: (N, 2) pixels (u, v) in the current frame.
        prev_positions: (N, 2) pixels in the previous frame; NaN where the track does not reach back to it.
        labels: (N,) 0 = background, 1..K by decreasing size.
        lab: (N, 3) colours in Lab.
    """

    positions: Float64Array
    prev_positions: Float64Array
    labels: Int64Array
    lab: Float64Array


@dataclass(frozen=True)
class Homc(Settings, PairEstimator):
    """Motion segments of point tracks.

    Raises:
        SettingsError: an invalid setting.
        MissingExtraError: `bioimage-cpp` is not installed.
    """

    camera: Literal["auto", "static", "moving"] = "auto"
    """moving fits a motion to the background's tracks; otherwise the background is static."""
    labels: Literal["dense", "sparse"] = "dense"
    """dense labels every pixel; sparse only tracked pixels, with NaN flow and label 0 elsewhere."""
    width: int = setting(320, minimum=1)
    """Pixels: wider images are downscaled to it."""
    sampling: int = setting(4, minimum=1)
    """Pixels between tracks."""
    repeats: int = setting(5, minimum=1)
    """Repetitions of a pair that form a sequence, as in the experiments of Shao et al. 2018."""
    min_tracks: int = setting(8, minimum=1)
    """Minimum number of tracks of a segment."""
    join: float = setting(2.0, above=-1e3, below=1e3)
    """Bias t0 of `costs`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        import_solver()

    def estimate(self, pair: FramePair) -> SceneMotion:
        """See `PairEstimator`."""
        count = 2 * self.repeats
        return self.estimate_in_sequence([pair.prev.frame, pair.curr.frame] * self.repeats, count - 2, count - 1)

    def estimate_in_sequence(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> SceneMotion:
        """Segment `frames[curr]` by the motion in all frames, given in time order; motions lead to `frames[prev]`.

        Raises:
            FrameError: there are fewer than two frames, they differ in size or intrinsics, or an index is invalid.
        """
        start = time.perf_counter()
        segmentation = self.segment(frames, prev, curr)
        frame = frames[curr]
        if self.labels == "dense":
            labels = densify(segmentation.positions, segmentation.labels, segmentation.lab, lab_image(frame.color))
        else:
            labels = np.zeros(frame.depth.shape, np.int64)
            labels[pixel_index(segmentation.positions)] = segmentation.labels
        known = np.zeros(labels.shape, np.bool_)
        known[pixel_index(segmentation.positions)] = True
        return self._result(frames[prev], frame, segmentation, labels, known | (self.labels == "dense"), start)

    def segment(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> Segmentation:
        """Compute labelled tracks of `frames[curr]`; see `estimate_in_sequence`."""
        if len(frames) < 2:
            raise FrameError(f"motion segmentation needs two frames or more, not {len(frames)}")
        if not (0 <= prev < len(frames) and 0 <= curr < len(frames)) or prev == curr:
            raise FrameError(f"prev and curr must be two of the {len(frames)} frames, not {prev} and {curr}")
        for frame in frames:
            check_pair(frame, frames[curr])
        full = frames[curr].camera.width, frames[curr].camera.height
        width = min(self.width, full[0])
        size = width, max(1, round(full[1] * width / full[0]))
        # Keyed by identity, so that a repeated frame keeps its image and `track_points` reuses its flow.
        resized = {id(frame): cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA) for frame in frames}
        images = [np.asarray(resized[id(frame)], dtype=np.uint8) for frame in frames]
        if curr == len(images) - 1:
            # Tracks start in every image but the last, so points that appear in the last frame need one more image.
            images.append(images[-2])
        tracks = track_points(images, self.sampling).visible_in(curr)
        positions = tracks.positions[:, curr].astype(np.float64)
        lab = lab_image(images[curr])[pixel_index(positions)].astype(np.float64)
        settings = CostSettings(join=self.join, distance_unit=32.0 * width / 320)
        partition = solve(build_problem(tracks, lab, curr, self.sampling, settings))
        scale = np.array(full) / size
        return Segmentation(
            positions=(positions + 0.5) * scale - 0.5,
            prev_positions=(tracks.positions[:, prev].astype(np.float64) + 0.5) * scale - 0.5,
            labels=_rank_by_size(partition, self.min_tracks),
            lab=lab,
        )

    def _result(
        self,
        prev: RgbdFrame,
        curr: RgbdFrame,
        segmentation: Segmentation,
        labels: Int64Array,
        known: BoolMask,
        start: float,
    ) -> SceneMotion:
        """Fit a rigid motion to each segment's tracks."""
        tracked = np.isfinite(segmentation.prev_positions[:, 0])
        pixels = segmentation.positions[tracked].astype(np.float32)
        prev_pixels = segmentation.prev_positions[tracked].astype(np.float32)
        matches, lifted = matching.lift(pixels, prev_pixels, prev, curr)
        match_labels = segmentation.labels[tracked][lifted]
        points = geometry.back_project(curr.depth, curr.camera)
        camera_motion = _fit(matches[match_labels == 0], curr)[0] if self.camera == "moving" else None
        background = np.eye(4) if camera_motion is None else camera_motion
        final = np.zeros(labels.shape, np.int32)
        objects: list[ObjectMotion] = []
        for label in range(1, int(segmentation.labels.max(initial=0)) + 1):
            mask = labels == label
            surface = points[mask & curr.valid].astype(np.float64)
            if not len(surface):
                continue
            prev_T_curr, score = _fit(matches[match_labels == label], curr)
            center = surface.mean(0)
            relative = geometry.inverse(background) @ prev_T_curr
            shift = geometry.transform(relative, center) - center
            final[mask] = len(objects) + 1
            objects.append(
                ObjectMotion(
                    id=len(objects) + 1,
                    pixels=int(mask.sum()),
                    score=score,
                    moving=bool(is_moving(relative[:3, :3], shift)),
                    center=center,
                    prev_T_curr=prev_T_curr,
                )
            )
        flow = geometry.flow_from_motions(points, final, {obj.id: obj.prev_T_curr for obj in objects}, camera_motion)
        flow[~known] = np.nan
        return SceneMotion(
            labels=final,
            scene_flow=flow,
            objects=tuple(objects),
            camera_motion=camera_motion,
            method="homc",
            seconds=time.perf_counter() - start,
        )


def _fit(matches: matching.PixelMatches, curr: RgbdFrame) -> tuple[Float64Array, float]:
    """The rigid motion of lifted tracks and its inlier ratio; identity and 0 for fewer than three tracks."""
    if len(matches.curr) < 3:
        return np.eye(4), 0.0
    prev_T_curr, inliers = fitting.fit_matches(matches, curr.camera)
    return prev_T_curr, float(inliers.mean())


def _rank_by_size(parts: Int64Array, min_size: int) -> Int64Array:
    """Labels by decreasing size, with 0 for the largest part and for parts of fewer than `min_size` members."""
    if not len(parts):
        return parts
    _, index, counts = np.unique(parts, return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    rank[counts < min_size] = 0
    return np.asarray(rank[index])


def lab_image(color: UInt8Array) -> Float32Array:
    """(H, W, 3) RGB -> (H, W, 3) Lab, L in 0..100, smoothed by a 3x3 Gaussian."""
    lab = cv2.cvtColor(color.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return np.asarray(cv2.GaussianBlur(lab, (3, 3), 0), dtype=np.float32)


def pixel_index(positions: Float64Array) -> tuple[IndexArray, IndexArray]:
    """(N, 2) positions (u, v) -> rows and columns of the nearest pixels."""
    nearest = np.rint(positions).astype(np.intp)
    return nearest[:, 1], nearest[:, 0]
