"""`rigidmatch` as an estimator: two frames, matches, objects as a set, solved motions."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, get_args

import torch
from torch import Tensor

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.resample import nearest_indices
from objectflow.geometry.torch_pinhole import depth_factor
from objectflow.methods.base import check_camera_option
from objectflow.methods.find_weights import find_weights
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.methods.network_io import resize_to, to_tensors, trained_size
from objectflow.methods.postprocess.pipeline import postprocess
from objectflow.methods.rigidmatch.decoding import MIN_PIXELS, OBJECT_MASK_THRESHOLD, decode, matched_flow
from objectflow.motion import SceneMotion
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput
from objectflow.networks.weights import load_network
from objectflow.runtime.devices import find_device

Rigid = Literal["none", "solve", "refine"]


@dataclass(frozen=True)
class RigidMatchEstimator:
    """A trained `RigidMatch`.

    Attributes:
        camera: whatever it says, the network takes the camera to stand still, and the flow off the objects is 0.
            `objectflow.load` makes it fit for one that moves; see `MovingCamera`.
        weights: a file, a folder, or `hf://OWNER/NAME`; None takes the released ones. Afterwards the file found.
        rigid: "none" gives each pixel of an object its own match's flow, "solve" the flow of the motion that fits the
            object's matches best, "refine" that of the motion aligned with the previous frame's depth.
        device: "auto", "cpu", "cuda" or "cuda:N".
        threshold: least probability of being an object.
        min_pixels: of the network's input; fewer are no object.
    """

    METHOD: ClassVar[str] = "rigidmatch"

    camera: str = "auto"
    weights: str | Path | None = None
    rigid: Rigid = "refine"
    device: str = "auto"
    threshold: float = OBJECT_MASK_THRESHOLD
    min_pixels: int = MIN_PIXELS
    network: RigidMatch = field(init=False, repr=False, compare=False)
    size: tuple[int, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        if self.rigid not in get_args(Rigid):
            raise MethodError(f"rigid must be none, solve or refine, not {self.rigid!r}")
        if not 0 <= self.threshold < 1 or self.min_pixels < 1:
            raise MethodError(
                "rigidmatch needs a threshold in 0..1, below 1, and min_pixels from 1, "
                f"not {self.threshold} and {self.min_pixels}"
            )
        device = find_device(self.device)
        path = find_weights(self.METHOD, self.weights)
        network, metadata = load_network(path, device)
        if not isinstance(network, RigidMatch):
            variant = metadata.get("variant", "another network")
            raise MethodError(f"{path}: weights of {variant}, not of {self.METHOD}: load them by their own name")
        # A frozen dataclass sets what follows from its options once, here.
        object.__setattr__(self, "size", trained_size(metadata, path))
        object.__setattr__(self, "weights", path)
        object.__setattr__(self, "network", network.to(memory_format=torch.channels_last))  # type: ignore[call-overload]

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        return self.estimate(prev, curr, FramePair(prev, curr))

    def estimate(self, prev: RgbdFrame, curr: RgbdFrame, pair: FramePair) -> SceneMotion:
        """The same with the frames made ready for alignment by whoever needed them before."""
        start = time.perf_counter()
        check_pair(prev, curr)
        # 1. The network, at the size that it knows.
        prev_s, curr_s = resize_to(prev, self.size), resize_to(curr, self.size)
        output, seen = self.predict(prev_s, curr_s)
        # 2. Objects.
        labels_s, objects = decode(output, curr_s.depth.shape, threshold=self.threshold, min_pixels=self.min_pixels)
        # 3. The input's own pixels.
        rows, columns = nearest_indices(labels_s.shape, curr.depth.shape)
        labels, objects = relabel_present(labels_s[rows[:, None], columns], objects)
        # 4. Motions that the frames bear out, objects that the network missed, and borders.
        if self.rigid == "refine":
            labels, objects = postprocess(pair, curr_s, labels, objects)
        else:
            labels, objects = relabel_present(snap_to_edges(labels, curr_s, curr), objects)
        # 5. The flow that they make.
        points = geometry.back_project(curr.depth, curr.camera)
        if self.rigid == "none":
            flow = matched_flow(output, seen, self.network.settings.fine_stride, labels, points)
        else:
            flow = rigid_flow(objects, labels, points)
        return SceneMotion(
            labels=labels,
            scene_flow=flow,
            objects=objects,
            method=self.METHOD,
            seconds=time.perf_counter() - start,
        )

    def predict(self, prev: RgbdFrame, curr: RgbdFrame) -> tuple[RigidMatchOutput, Tensor]:
        """The network's output on frames of any one size, and the current points (1, 3, H, W), both in metres."""
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            (prev_color, prev_points), (curr_color, curr_points) = to_tensors(prev, device), to_tensors(curr, device)
            # The network is trained at one median depth; lengths are scaled back.
            factor = depth_factor(curr_points, self.network.settings.median_depth)
            out: RigidMatchOutput = self.network(
                prev_color, factor * prev_points, curr_color, factor * curr_points, table=False
            )
        return out.rescaled(1 / float(factor)), curr_points
