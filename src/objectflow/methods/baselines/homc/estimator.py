"""`homc`: motion segmentation by higher-order minimum cost lifted multicuts (Keuper, ICCV 2017), from the paper.

Points are followed through all frames by dense optical flow (`tracks`). Two tracks are compared by motion, distance
and colour, three by whether one similarity of the plane moves them all (`costs`); neighbours are edges, tracks further
off lifted edges, and triples stand where pairs cut (`graph`). The partition of least cost is sought (`problem`,
`multicut`, `search`); its parts are the segments. Only colour is used for that.

What differs from the author's program, and why:
- Flow is DIS (Kroeger et al., ECCV 2016), which OpenCV has, not the slower flow of the paper.
- Only tracks that the wanted frame sees are clustered. Those that end before it have no pixel to label.
- Triples stand on the two equilateral triangles over each pair that cuts, and no others.
- Kernighan-Lin is a library's for pairs, on triples spread over their pairs; a local search with the true energy
  follows (`search`), where the paper's Kernighan-Lin has higher-order gains.
- d_s is in units of 32 pixels at a width of 320, and t0 was chosen on a validation split: docs/baselines.md.
- The largest segment is the background, and segments under `min_tracks` join it; the paper's are not ranked.
- Objects need a rigid motion here: the tracks' ends, lifted by depth, are fitted when the segments are done.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment import fitting, matching
from objectflow.alignment.moved import is_moving
from objectflow.errors import FrameError, MethodError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.methods.base import check_camera_option
from objectflow.methods.baselines.homc.costs import CostSettings
from objectflow.methods.baselines.homc.densify import densify
from objectflow.methods.baselines.homc.graph import build_problem
from objectflow.methods.baselines.homc.multicut import import_solver
from objectflow.methods.baselines.homc.search import solve
from objectflow.methods.baselines.homc.tracks import follow
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, Int64Array, UInt8Array


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Labelled tracks.

    Attributes:
        at: (N, 2) pixels (u, v) in the wanted frame.
        origin: (N, 2) where they were in the other frame; NaN where the track does not reach back to it.
        labels: (N,) 0 = background, 1..K by falling size.
        lab: (N, 3) colours in Lab.
    """

    at: Float64Array
    origin: Float64Array
    labels: Int64Array
    lab: Float64Array


@dataclass(frozen=True)
class Homc:
    """Motion segments of point tracks.

    Attributes:
        camera: "moving": the background has a motion of its own, fitted to its tracks; otherwise it stands still.
        labels: "dense" for every pixel, or "sparse": only where tracks are; elsewhere the flow is NaN and the label 0.
        width: pixels; wider pictures are worked on at this width.
        sampling: pixels between tracks.
        repeats: how often a pair is repeated to make a sequence, as in the experiments of Shao et al. 2018.
        min_tracks: least size of a segment.
        join: t0 of `costs`.

    Raises:
        MethodError: an option without meaning.
        MissingExtraError: `bioimage-cpp` is not installed.
    """

    camera: str = "auto"
    labels: str = "dense"
    width: int = 320
    sampling: int = 4
    repeats: int = 5
    min_tracks: int = 8
    join: float = 2.0

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        if self.labels not in ("dense", "sparse"):
            raise MethodError(f"labels must be dense or sparse, not {self.labels!r}")
        for name in ("width", "sampling", "repeats", "min_tracks"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise MethodError(f"{name} must be a whole number from 1, not {value!r}")
        if isinstance(self.join, bool) or not isinstance(self.join, (int, float)) or not -1e3 < self.join < 1e3:
            raise MethodError(f"join must be a number, not {self.join!r}")
        import_solver()

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        check_pair(prev, curr)
        count = 2 * self.repeats
        return self.estimate_in_sequence([prev, curr] * self.repeats, count - 2, count - 1)

    def estimate_in_sequence(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> SceneMotion:
        """Segment `frames[curr]` by the motion in all frames, in order of time; motions are back to `frames[prev]`.

        Raises:
            FrameError: fewer than two frames, frames that differ in size or intrinsics, or no such frame.
        """
        start = time.perf_counter()
        segmentation = self.segment(frames, prev, curr)
        frame = frames[curr]
        if self.labels == "dense":
            labels = densify(segmentation.at, segmentation.labels, segmentation.lab, lab_image(frame.color))
        else:
            labels = np.zeros(frame.depth.shape, np.int64)
            labels[pixel_index(segmentation.at)] = segmentation.labels
        known = np.zeros(labels.shape, np.bool_)
        known[pixel_index(segmentation.at)] = True
        return self._result(frames[prev], frame, segmentation, labels, known | (self.labels == "dense"), start)

    def segment(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> Segmentation:
        """The method itself: labelled tracks of `frames[curr]`; see `estimate_in_sequence`."""
        if len(frames) < 2:
            raise FrameError(f"motion segmentation needs two frames or more, not {len(frames)}")
        if not (0 <= prev < len(frames) and 0 <= curr < len(frames)) or prev == curr:
            raise FrameError(f"prev and curr must be two of the {len(frames)} frames, not {prev} and {curr}")
        for frame in frames:
            check_pair(frame, frames[curr])
        full = frames[curr].camera.width, frames[curr].camera.height
        width = min(self.width, full[0])
        size = width, max(1, round(full[1] * width / full[0]))
        # By identity: a frame that comes again keeps its picture, and `follow` its flow.
        resized = {id(frame): cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA) for frame in frames}
        images = [np.asarray(resized[id(frame)], dtype=np.uint8) for frame in frames]
        if curr == len(images) - 1:
            images.append(images[-2])  # so that points which come into sight in the last frame are followed as well
        tracks = follow(images, self.sampling).seen_in(curr)
        at = tracks.positions[:, curr].astype(np.float64)
        lab = lab_image(images[curr])[pixel_index(at)].astype(np.float64)
        settings = CostSettings(join=self.join, distance_unit=32.0 * width / 320)
        found = solve(build_problem(tracks, lab, curr, self.sampling, settings))
        scale = np.array(full) / size
        return Segmentation(
            at=(at + 0.5) * scale - 0.5,
            origin=(tracks.positions[:, prev].astype(np.float64) + 0.5) * scale - 0.5,
            labels=_ranked(found, self.min_tracks),
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
        followed = np.isfinite(segmentation.origin[:, 0])
        pixels = segmentation.at[followed].astype(np.float32)
        matches, lifted = matching.lift(pixels, segmentation.origin[followed].astype(np.float32), prev, curr)
        owners = segmentation.labels[followed][lifted]
        points = geometry.back_project(curr.depth, curr.camera)
        camera_motion = _fit(matches[owners == 0], curr)[0] if self.camera == "moving" else None
        background = np.eye(4) if camera_motion is None else camera_motion
        final = np.zeros(labels.shape, np.int32)
        objects: list[ObjectMotion] = []
        for label in range(1, int(segmentation.labels.max(initial=0)) + 1):
            mask = labels == label
            seen = points[mask & curr.valid].astype(np.float64)
            if not len(seen):
                continue
            prev_T_curr, score = _fit(matches[owners == label], curr)
            center = seen.mean(0)
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
    """The rigid motion of lifted tracks and the share of them that it explains; identity and 0 of fewer than three."""
    if len(matches.curr) < 3:
        return np.eye(4), 0.0
    prev_T_curr, explained = fitting.fit_matches(matches, curr.camera)
    return prev_T_curr, float(explained.mean())


def _ranked(parts: Int64Array, least: int) -> Int64Array:
    """Labels by falling size, the largest 0; parts of fewer than `least` are 0 as well."""
    if not len(parts):
        return parts
    _, index, counts = np.unique(parts, return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    rank[counts < least] = 0
    return np.asarray(rank[index])


def lab_image(color: UInt8Array) -> Float32Array:
    """(H, W, 3) RGB -> (H, W, 3) Lab, L in 0..100, smoothed by a 3x3 Gaussian against noise."""
    lab = cv2.cvtColor(color.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return np.asarray(cv2.GaussianBlur(lab, (3, 3), 0), dtype=np.float32)


def pixel_index(at: Float64Array) -> tuple[IndexArray, IndexArray]:
    """(N, 2) positions -> rows and columns of the nearest pixels."""
    nearest = np.rint(at).astype(np.intp)
    return nearest[:, 1], nearest[:, 0]
