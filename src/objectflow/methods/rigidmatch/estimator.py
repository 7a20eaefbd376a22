"""`rigidmatch` as an estimator: two frames, matches, objects as a set, solved motions, and the steps after them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from objectflow.alignment.apparent_shift import apparent_shift
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import MatchSettings
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.errors import FrameError, MethodError
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import nearest_indices
from objectflow.geometry.torch_pinhole import depth_factor
from objectflow.methods.find_weights import find_weights
from objectflow.methods.labels import Objects, relabel_present, rigid_flow
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.methods.moving_camera import CompensationConfig, StaticCameraEstimator
from objectflow.methods.network_io import same_size_groups, scaled_size, to_tensors, trained_size
from objectflow.methods.postprocess.changes import StepChange
from objectflow.methods.postprocess.look_windows import Window
from objectflow.methods.postprocess.pipeline import check_steps, postprocess, prepare
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.rigidmatch.decoding import (
    DUPLICATE_IOU,
    MIN_PIXELS,
    OBJECT_MASK_THRESHOLD,
    OVERLAP_THRESHOLD,
    QUERY_THRESHOLD,
    decode,
    matched_flow,
    select,
)
from objectflow.motion import SceneMotion
from objectflow.networks.kinds import Settings as NetworkSettings
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput, RigidMatchSettings
from objectflow.networks.rigidmatch.settings import MOST
from objectflow.networks.weights import load_network, read_header
from objectflow.runtime.devices import find_device
from objectflow.runtime.side_threads import has_side_threads, start_beside
from objectflow.settings import setting
from objectflow.typing import LabelImage

_DECODED = "decoded"
"""Part of the key of the network's objects in `FramePair.beside`."""
SCALED_DEPTH = 0.75
"""Metres: median depth to which scenes are scaled that lie nearer or farther than those of the training data."""


class _Decoded(NamedTuple):
    """The network's output for one pair, its points (1, 3, h, w) in metres, its labels (h, w) and their objects."""

    output: RigidMatchOutput
    points: Tensor
    labels: LabelImage
    objects: Objects


@dataclass(frozen=True)
class RigidMatchConfig(CompensationConfig):
    """The settings of `rigidmatch`."""

    weights: str | Path | None = None
    """A file, a folder, or hf://OWNER/NAME; the released weights where none is given."""
    rigid: Literal["none", "solve", "refine"] = "refine"
    """none: flow of each pixel's own match. solve: flow of the motion that fits an object's matches best. refine: the
    steps of `postprocess` follow."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    queries: int | None = setting(None, minimum=1, maximum=MOST["queries"])
    """Number of queries of the network; by default that of the weights. More find more of many objects."""
    seed_radius: float | None = setting(None, above=0)
    """Metres in trajectory space within which a query suppresses others; by default that of the weights."""
    threshold: float = setting(OBJECT_MASK_THRESHOLD, minimum=0, below=1)
    """Minimum probability of an object."""
    min_pixels: int = setting(MIN_PIXELS, minimum=1)
    """Minimum size of an object, in pixels of the network's input."""
    unscaled_depth: tuple[float, float] = (0.25, 3.0)
    """Metres: median depths between these are given to the network as they are, if it was trained without scaling;
    nearer and farther scenes are scaled to 0.75 m, and lengths are scaled back."""
    overlap_threshold: float = setting(OVERLAP_THRESHOLD, minimum=0, maximum=1)
    """Minimum share of its mask that an object keeps where masks overlap; an object with less is removed."""
    duplicate_iou: float = setting(DUPLICATE_IOU, minimum=0, maximum=1)
    """Minimum intersection over union of the masks of two queries on one object, which are merged; 1 merges none."""
    matching: MatchSettings = MatchSettings(feature_width=320, sufficient_flow_share=0.5)
    """The network finds large displacements of objects, so features serve large motions of the camera alone: they are
    matched where optical flow fails, and at half the size."""
    likely_static_px: float = setting(0.6, minimum=0)
    """Pixels, at a width of 320: median shift of the edges up to which the network is evaluated beside the estimate of
    the camera's motion, where there are side threads. It is evaluated again if the camera moved after all, so this
    decides about time alone."""
    detail: Literal["frame", "crops"] = "frame"
    """frame: the network is given the frame as a whole. crops: it is also given enlarged parts of it where changes are
    left unexplained (`postprocess.second_look`), which finds more small objects in about 1.4 times the time."""
    explain: bool = False
    """Record what each step after the network changed, in `SceneMotion.changes`."""
    postprocess: PostprocessSettings = PostprocessSettings()


@dataclass(frozen=True)
class RigidMatchEstimator(RigidMatchConfig, StaticCameraEstimator):
    """A trained `RigidMatch`; its fields are its settings. `weights` becomes the file that was found."""

    METHOD: ClassVar[str] = "rigidmatch"

    network: RigidMatch = field(init=False, repr=False, compare=False)
    size: tuple[int, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_steps(self.postprocess)
        device = find_device(self.device)
        path = find_weights(self.METHOD, self.weights)
        network, metadata = load_network(path, device, settings=self._network_settings(path))
        if not isinstance(network, RigidMatch):
            variant = metadata.get("variant", "another network")
            raise MethodError(f"{path}: weights of {variant}, not of {self.METHOD}: load them by their own name")
        # A frozen dataclass sets what follows from its settings once, here.
        object.__setattr__(self, "size", trained_size(metadata, path))
        object.__setattr__(self, "weights", path)
        object.__setattr__(self, "network", network.to(memory_format=torch.channels_last))  # type: ignore[call-overload]

    def _network_settings(self, path: Path) -> NetworkSettings:
        """The settings of the file, with those of this method that no tensor depends on."""
        found, _ = read_header(path)
        if not isinstance(found, RigidMatchSettings):
            return found
        queries = found.queries if self.queries is None else self.queries
        seed_radius = found.seed_radius if self.seed_radius is None else self.seed_radius
        return dataclasses.replace(found, queries=queries, seed_radius=seed_radius)

    def start(self, pair: FramePair) -> None:
        """See `PairEstimator`: XFeat is evaluated, and the network if the camera is likely static."""
        if next(self.network.parameters()).device.type != "cpu" or (_DECODED, self.network) in pair.beside:
            return
        prev, curr = self._small(pair)
        likely_static = self.camera != "moving" and apparent_shift(pair.prev, pair.curr) <= self.likely_static_px
        # A camera that moved gives another previous frame.
        for frame in (curr, prev) if likely_static else (curr,):
            if self.network.settings.xfeat != "none" and self._xfeat_key not in frame.memo:
                frame.memo[self._xfeat_key] = start_beside(partial(self._xfeat, frame.frame))
        if likely_static:
            pair.beside[_DECODED, self.network] = start_beside(partial(self._decoded, [prev], [curr]))

    def closer(self) -> RigidMatchEstimator:
        """See `PairEstimator`: the same network with `detail="crops"`."""
        out = copy.copy(self)
        object.__setattr__(out, "detail", "crops")
        return out

    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """See `StaticCameraEstimator`; the network is evaluated once for all pairs of one size."""
        motions: dict[int, SceneMotion] = {}
        for group in same_size_groups([scaled_size(pair.curr.frame, self.size) for pair in pairs]):
            started = pairs[group.members[0]].beside.pop((_DECODED, self.network), None)
            if started is None:
                prev, curr = zip(*(self._small(pairs[k]) for k in group.members), strict=True)
                found = self._decoded(prev, curr)
            else:
                if self.rigid == "refine":
                    prepare(pairs[group.members[0]], self.postprocess)
                found = started.result()
            for k, decoded in zip(group.members, found, strict=True):
                motions[k] = self._finish(pairs[k], decoded, group.size)
        return [motions[k] for k in range(len(pairs))]

    def _small(self, pair: FramePair) -> tuple[PreparedFrame, PreparedFrame]:
        """Both frames at the size of the network's input."""
        height, width = scaled_size(pair.curr.frame, self.size)
        return pair.prev.resized(width, height), pair.curr.resized(width, height)

    def _decoded(self, prev: Sequence[PreparedFrame], curr: Sequence[PreparedFrame]) -> list[_Decoded]:
        """The network's output on pairs of frames of one size, and its objects."""
        output, points = self.predict(prev, curr)
        found = []
        for place, frame in enumerate(curr):
            own = select(output, place)
            labels, objects = decode(
                own,
                frame.frame.depth.shape,
                threshold=self.threshold,
                min_pixels=self.min_pixels,
                overlap_threshold=self.overlap_threshold,
                duplicate_iou=self.duplicate_iou,
            )
            found.append(_Decoded(own, points[place : place + 1], labels, objects))
        return found

    def predict(
        self, prev: Sequence[RgbdFrame | PreparedFrame], curr: Sequence[RgbdFrame | PreparedFrame]
    ) -> tuple[RigidMatchOutput, Tensor]:
        """The network's output on pairs of frames of one size, and the current points (B, 3, H, W) in metres.

        Queries that are no object in any of the pairs are left out.

        XFeat's features are kept with prepared frames, so that a sequence computes them once per frame.
        """
        device = next(self.network.parameters()).device
        before, after = ([PreparedFrame.of(frame) for frame in frames] for frames in (prev, curr))
        with torch.inference_mode():
            (prev_color, prev_points), (curr_color, curr_points) = (
                to_tensors([one.frame for one in frames], device) for frames in (before, after)
            )
            # The network is trained at one median depth; lengths are scaled back.
            factor = depth_factor(curr_points, self.network.settings.median_depth or SCALED_DEPTH)
            if not self.network.settings.median_depth:
                low, high = self.unscaled_depth
                median = SCALED_DEPTH / factor
                factor = torch.where((median < low) | (median > high), factor, torch.ones_like(factor))
            wide = factor[:, None, None, None]
            known: dict[str, Any] = {}
            if self.network.settings.xfeat != "none":
                known["xfeat"] = partial(self._features, [*after, *before], [curr_color, prev_color])
            out: RigidMatchOutput = self.network(
                prev_color,
                wide * prev_points,
                curr_color,
                wide * curr_points,
                table=False,
                min_probability=min(self.threshold, QUERY_THRESHOLD),
                **known,
            )
        return out.rescaled(1 / factor), curr_points

    @property
    def _xfeat_key(self) -> tuple[str, RigidMatch]:
        """Key of XFeat's features in `PreparedFrame.memo`; the value is a tensor, or the future of one."""
        return "xfeat", self.network

    def _features(self, frames: Sequence[PreparedFrame], colors: Sequence[Tensor]) -> Tensor:
        """XFeat's features of frames, whose colours are (B, 3, H, W) in all; they are kept with the frames.

        On a CPU, frames are evaluated one at a time, which takes no longer, and features do not depend on the batch.
        """
        key, color = self._xfeat_key, torch.cat(list(colors))
        missing = [k for k, frame in enumerate(frames) if key not in frame.memo]
        parts = [color[k : k + 1] for k in missing]
        if parts and color.device.type != "cpu":
            found = list(self.network.xfeat(torch.cat(parts)).split(1))
        else:
            found = [self.network.xfeat(part) for part in parts]
        for k, features in zip(missing, found, strict=True):
            frames[k].memo[key] = features
        kept = (frame.memo[key] for frame in frames)
        return torch.cat([one.result() if isinstance(one, Future) else one for one in kept])

    def _xfeat(self, frame: RgbdFrame) -> Tensor:
        """XFeat's features of one frame."""
        with torch.inference_mode():
            color, _ = to_tensors([frame], torch.device("cpu"))
            features: Tensor = self.network.xfeat(color)
        return features

    def _look(self, pair: FramePair, windows: Sequence[Window]) -> list[tuple[LabelImage, Objects]]:
        """The network's objects in windows of a pair; see `second_look`."""
        works = [partial(self._look_at, pair, window) for window in windows]
        if next(self.network.parameters()).device.type == "cpu" and has_side_threads():
            return [one.result() for one in [start_beside(work) for work in works]]
        return [work() for work in works]

    def _look_at(self, pair: FramePair, window: Window) -> tuple[LabelImage, Objects]:
        """The network's objects in one window, on its pixels."""
        shape = (window.height, window.width)
        if not all(one.valid[window.slices].any() for one in (pair.prev, pair.curr)):
            return np.zeros(shape, np.int32), ()
        prev, curr = (one.frame.cropped(*window) for one in (pair.prev, pair.curr))
        settings = self.postprocess.second_look.windows
        rows, columns = (round(side * settings.enlargement / settings.zoom) for side in self.size)
        height, width = scaled_size(curr, (rows, columns))
        try:
            small = [PreparedFrame(frame.resized(width, height)) for frame in (prev, curr)]
        except FrameError:  # no pixel with depth is left
            return np.zeros(shape, np.int32), ()
        found = self._decoded(small[:1], small[1:])[0]
        down, across = nearest_indices((height, width), shape)
        return relabel_present(found.labels[down[:, None], across], found.objects)

    def _finish(self, pair: FramePair, decoded: _Decoded, size: tuple[int, int]) -> SceneMotion:
        """One pair's objects on the pixels of its current frame."""
        curr, points = pair.curr.frame, pair.curr.points
        # 1. The pixels of the frame.
        rows, columns = nearest_indices(size, curr.depth.shape)
        labels, objects = relabel_present(decoded.labels[rows[:, None], columns], decoded.objects)
        # 2. The steps that verify and complete them.
        changes: list[StepChange] | None = [] if self.explain else None
        if self.rigid == "refine":
            settings = dataclasses.replace(self.postprocess, label_size=size)
            look = self._look if self.detail == "crops" else None
            labels, objects = postprocess(pair, labels, objects, settings, changes, look=look)
        else:
            snapped = snap_to_edges(labels, pair.curr, size, pair.noise, self.postprocess.snap_to_edges)
            labels, objects = relabel_present(snapped, objects)
        # 3. The flow of their motions.
        if self.rigid == "none":
            flow = matched_flow(decoded.output, decoded.points, self.network.settings.fine_stride, labels, points)
        else:
            flow = rigid_flow(objects, labels, points)
        return SceneMotion(
            labels=labels,
            scene_flow=flow,
            objects=objects,
            method=self.METHOD,
            changes=tuple(f"{c.step}: {c.words()}" for c in changes or ()),
        )
