"""The paper's networks as estimators: two frames, dense maps, groups in trajectory space, rigid motions."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import torch

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_objects
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.base import check_camera_option
from objectflow.methods.find_weights import find_weights
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.network_io import resize_to, to_tensors, trained_size
from objectflow.methods.sceneflownet.decoding import average_objects, label_pixels, pixel_flow
from objectflow.methods.sceneflownet.grouping import GroupingSettings
from objectflow.motion import SceneMotion
from objectflow.networks.sceneflownet.network import SceneFlowNet
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput
from objectflow.networks.weights import load_weights
from objectflow.runtime.devices import find_device

Rigid = Literal["none", "average", "refine"]


@dataclass(frozen=True)
class SceneFlowEstimator:
    """A trained network.

    Attributes:
        camera: whatever it says, the networks take the camera to stand still, and the flow off the objects is 0.
            `objectflow.load` makes them fit for one that moves; see `MovingCamera`.
        weights: a file, a folder, or `hf://OWNER/NAME`; None takes the released ones. See `find_weights`. Afterwards
            the file that was found.
        rigid: "none" gives each pixel the network's own flow, "average" the flow of its object's mean motion (the
            paper's +Rig), "refine" that of the mean motion aligned with the previous frame's depth.
        device: "auto", "cpu", "cuda" or "cuda:N".
        rotation_weight: metres a radian, of rotation in the trajectory feature; None takes what the weights were
            trained with. See `GroupingSettings`.
        min_pixels: of the network's input; smaller groups join the nearest object.
    """

    METHOD: ClassVar[str] = ""
    CORRELATION: ClassVar[bool] = True

    camera: str = "auto"
    weights: str | Path | None = None
    rigid: Rigid = "average"
    device: str = "auto"
    rotation_weight: float | None = None
    min_pixels: int = GroupingSettings.min_pixels
    network: SceneFlowNet = field(init=False, repr=False, compare=False)
    size: tuple[int, int] = field(init=False, repr=False, compare=False)
    grouping: GroupingSettings = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_camera_option(self.camera)
        if self.rigid not in get_args(Rigid):
            raise MethodError(f"rigid must be none, average or refine, not {self.rigid!r}")
        device = find_device(self.device)
        path = find_weights(self.METHOD, self.weights)
        network, metadata = load_weights(path, device)
        self._check_kind(network, metadata, path)
        weight = _trained_weight(metadata, path) if self.rotation_weight is None else self.rotation_weight
        # A frozen dataclass sets what follows from its options once, here.
        object.__setattr__(self, "grouping", GroupingSettings(rotation_weight=weight, min_pixels=self.min_pixels))
        object.__setattr__(self, "size", trained_size(metadata, path))
        # The file that was found: whoever keeps results can say what they depend on.
        object.__setattr__(self, "weights", path)
        # Channels last: 1.5 times as fast on a CPU.
        object.__setattr__(self, "network", network.to(memory_format=torch.channels_last))  # type: ignore[call-overload]

    def __call__(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """See `Estimator`."""
        return self.estimate(prev, curr, FramePair(prev, curr))

    def estimate(self, prev: RgbdFrame, curr: RgbdFrame, pair: FramePair) -> SceneMotion:
        """The same with the frames made ready for alignment by whoever needed them before."""
        start = time.perf_counter()
        check_pair(prev, curr)
        # 1. Dense maps, at the size that the network knows.
        prev_s, curr_s = self.resize(prev), self.resize(curr)
        maps = self.predict(prev_s, curr_s)
        # 2. Pixels to objects, and a motion for each.
        labels_s = label_pixels(maps, self.grouping)
        objects = average_objects(maps, labels_s, curr_s.valid)
        # 3. The input's own pixels.
        rows, columns = nearest_indices(labels_s.shape, curr.depth.shape)
        labels, objects = relabel_present(labels_s[rows[:, None], columns], objects)
        # 4. Motions, and the flow that they make.
        if self.rigid == "refine":
            objects = refine_objects(pair, labels, objects)
        points = geometry.back_project(curr.depth, curr.camera)
        flow = pixel_flow(maps, labels, points) if self.rigid == "none" else rigid_flow(objects, labels, points)
        return SceneMotion(
            labels=labels,
            scene_flow=flow,
            objects=objects,
            method=self.METHOD,
            seconds=time.perf_counter() - start,
        )

    def resize(self, frame: RgbdFrame) -> RgbdFrame:
        """The frame with as many pixels as the network was trained with, in its own proportions."""
        return resize_to(frame, self.size)

    def predict(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneFlowNetOutput:
        """The network's maps (1, C, H, W) on the estimator's device, on the pixels of frames of any one size."""
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            out: SceneFlowNetOutput = self.network(*to_tensors(prev, device), *to_tensors(curr, device))
        return out

    def _check_kind(self, network: SceneFlowNet, metadata: dict[str, Any], path: Path) -> None:
        """Check that weights are of this method and not of another one."""
        variant = metadata.get("variant", self.METHOD)
        if variant != self.METHOD:
            raise MethodError(f"{path}: weights of {variant}, not of {self.METHOD}: load them by their own name")
        if network.settings.correlation != self.CORRELATION:
            raise MethodError(
                f"{path}: weights of another configuration: correlation is {network.settings.correlation} there, "
                f"but {self.METHOD} has {self.CORRELATION}"
            )


@dataclass(frozen=True)
class SceneFlowNetS(SceneFlowEstimator):
    """OurS of the paper: no correlation."""

    METHOD: ClassVar[str] = "sceneflownet-s"
    CORRELATION: ClassVar[bool] = False


@dataclass(frozen=True)
class SceneFlowNetC(SceneFlowEstimator):
    """OurC of the paper."""

    METHOD: ClassVar[str] = "sceneflownet-c"


@dataclass(frozen=True)
class SceneFlowNetCVL(SceneFlowEstimator):
    """OurC+vL of the paper: OurC trained with the variance and the violation loss."""

    METHOD: ClassVar[str] = "sceneflownet-c-vl"


def _trained_weight(metadata: dict[str, Any], path: Path) -> float:
    grouping = metadata.get("grouping", {})
    try:
        return float(grouping.get("rotation_weight", 0.0))
    except (AttributeError, TypeError, ValueError):
        raise MethodError(f"{path}: damaged: its grouping must be settings, not {grouping!r}") from None
