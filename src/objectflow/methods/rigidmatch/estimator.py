"""`rigidmatch` as an estimator: two frames, matches, objects as a set, solved motions, and the steps after them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor

from objectflow.alignment.apparent_shift import apparent_shift
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import MatchSettings
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import nearest_indices
from objectflow.geometry.torch_pinhole import depth_factor
from objectflow.methods.find_weights import find_weights
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.methods.moving_camera import CompensationConfig, StaticCameraEstimator
from objectflow.methods.network_io import same_size_groups, scaled_size, to_tensors, trained_size
from objectflow.methods.postprocess.changes import StepChange
from objectflow.methods.postprocess.pipeline import check_steps, postprocess
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.rigidmatch.decoding import (
    DUPLICATE_IOU,
    MIN_PIXELS,
    OBJECT_MASK_THRESHOLD,
    OVERLAP_THRESHOLD,
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
from objectflow.runtime.side_threads import start_beside
from objectflow.settings import setting

_OUTPUT = "output"
"""Part of the key of the network's output in `FramePair.beside`."""
SCALED_DEPTH = 0.75
"""Metres: median depth to which scenes are scaled that lie nearer or farther than those of the training data."""


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
        """See `StaticCameraEstimator`: evaluate the network, unless the camera moved or the light changed."""
        if next(self.network.parameters()).device.type != "cpu" or self.camera == "moving":
            return
        if apparent_shift(pair.prev, pair.curr) <= self.likely_static_px:
            prev, curr = self._small(pair)
            pair.beside[_OUTPUT, self.network] = start_beside(partial(self.predict, [prev], [curr]))

    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """See `StaticCameraEstimator`; the network is evaluated once for all pairs of one size."""
        motions: dict[int, SceneMotion] = {}
        for group in same_size_groups([scaled_size(pair.curr.frame, self.size) for pair in pairs]):
            started = pairs[group.members[0]].beside.pop((_OUTPUT, self.network), None)
            if started is not None:
                output, points = started.result()
            else:
                small = [self._small(pairs[k]) for k in group.members]
                output, points = self.predict([one for one, _ in small], [other for _, other in small])
            for place, k in enumerate(group.members):
                motions[k] = self._finish(pairs[k], select(output, place), points[place : place + 1], group.size)
        return [motions[k] for k in range(len(pairs))]

    def _small(self, pair: FramePair) -> tuple[PreparedFrame, PreparedFrame]:
        """Both frames at the size of the network's input."""
        height, width = scaled_size(pair.curr.frame, self.size)
        return pair.prev.resized(width, height), pair.curr.resized(width, height)

    def predict(
        self, prev: Sequence[RgbdFrame | PreparedFrame], curr: Sequence[RgbdFrame | PreparedFrame]
    ) -> tuple[RigidMatchOutput, Tensor]:
        """The network's output on pairs of frames of one size, and the current points (B, 3, H, W) in metres.

        XFeat's features are kept with prepared frames, so that a sequence computes them once per frame.
        """
        device = next(self.network.parameters()).device
        before, after = ([PreparedFrame.of(frame) for frame in frames] for frames in (prev, curr))
        with torch.inference_mode():
            (prev_color, prev_points), (curr_color, curr_points) = (
                to_tensors([one.frame for one in frames], device) for frames in (before, after)
            )
            known = self._known_features([*after, *before], [curr_color, prev_color])
            # The network is trained at one median depth; lengths are scaled back.
            factor = depth_factor(curr_points, self.network.settings.median_depth or SCALED_DEPTH)
            if not self.network.settings.median_depth:
                low, high = self.unscaled_depth
                median = SCALED_DEPTH / factor
                factor = torch.where((median < low) | (median > high), factor, torch.ones_like(factor))
            wide = factor[:, None, None, None]
            out: RigidMatchOutput = self.network(
                prev_color, wide * prev_points, curr_color, wide * curr_points, table=False, **known
            )
        return out.rescaled(1 / factor), curr_points

    def _known_features(self, frames: Sequence[PreparedFrame], colors: Sequence[Tensor]) -> dict[str, Tensor]:
        """Arguments of the network: `xfeat`, the features of frames, whose colours are (B, 3, H, W) in all.

        On a CPU, frames are evaluated one at a time, which takes no longer, and features do not depend on the batch.
        """
        if self.network.settings.xfeat == "none":
            return {}
        key, color = ("xfeat", self.network), torch.cat(list(colors))
        missing = [k for k, frame in enumerate(frames) if key not in frame.memo]
        parts = [color[k : k + 1] for k in missing]
        if parts and color.device.type != "cpu":
            found = list(self.network.xfeat(torch.cat(parts)).split(1))
        else:
            found = [self.network.xfeat(part) for part in parts]
        for k, features in zip(missing, found, strict=True):
            frames[k].memo[key] = features
        return {"xfeat": torch.cat([frame.memo[key] for frame in frames])}

    def _finish(self, pair: FramePair, output: RigidMatchOutput, seen: Tensor, size: tuple[int, int]) -> SceneMotion:
        """One pair's output as objects on the pixels of its current frame."""
        curr, points = pair.curr.frame, pair.curr.points
        # 1. Objects on the network's input.
        labels_s, objects = decode(
            output,
            size,
            threshold=self.threshold,
            min_pixels=self.min_pixels,
            overlap_threshold=self.overlap_threshold,
            duplicate_iou=self.duplicate_iou,
        )
        # 2. The pixels of the frame.
        rows, columns = nearest_indices(labels_s.shape, curr.depth.shape)
        labels, objects = relabel_present(labels_s[rows[:, None], columns], objects)
        # 3. The steps that verify and complete them.
        changes: list[StepChange] | None = [] if self.explain else None
        if self.rigid == "refine":
            settings = dataclasses.replace(self.postprocess, label_size=size)
            labels, objects = postprocess(pair, labels, objects, settings, changes)
        else:
            snapped = snap_to_edges(labels, pair.curr, size, pair.noise, self.postprocess.snap_to_edges)
            labels, objects = relabel_present(snapped, objects)
        # 4. The flow of their motions.
        if self.rigid == "none":
            flow = matched_flow(output, seen, self.network.settings.fine_stride, labels, points)
        else:
            flow = rigid_flow(objects, labels, points)
        return SceneMotion(
            labels=labels,
            scene_flow=flow,
            objects=objects,
            method=self.METHOD,
            changes=tuple(f"{c.step}: {c.words()}" for c in changes or ()),
        )
