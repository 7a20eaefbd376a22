"""The paper's networks as estimators: two frames, dense maps, groups in trajectory space, rigid motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import RefineSettings, refine_objects
from objectflow.errors import MethodError
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.find_weights import find_weights
from objectflow.methods.labels import relabel_present, rigid_flow
from objectflow.methods.moving_camera import CompensationConfig, StaticCameraEstimator
from objectflow.methods.network_io import same_size_groups, scaled_size, to_tensors, trained_size
from objectflow.methods.sceneflownet.decoding import average_objects, label_pixels, pixel_flow
from objectflow.methods.sceneflownet.grouping import GroupingSettings
from objectflow.motion import SceneMotion
from objectflow.networks.sceneflownet.network import SceneFlowNet
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput
from objectflow.networks.weights import load_weights
from objectflow.runtime.devices import find_device
from objectflow.settings import setting


@dataclass(frozen=True)
class SceneFlowNetConfig(CompensationConfig):
    """The settings of the paper's networks."""

    weights: str | Path | None = None
    """A file, a folder, or hf://OWNER/NAME; the released weights where none is given."""
    rigid: Literal["none", "average", "refine"] = "average"
    """none: each pixel's own flow. average: the flow of its object's mean motion (+Rig of the paper). refine: that of
    the mean motion registered to the previous frame."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""
    rotation_weight: float | None = setting(None, minimum=0)
    """Metres per radian: weight of rotation in the trajectory feature; none: as the weights were trained."""
    min_pixels: int = setting(GroupingSettings.min_pixels, minimum=1)
    """Pixels of the network's input: smaller groups join the nearest object."""
    refine: RefineSettings = RefineSettings()


@dataclass(frozen=True)
class SceneFlowEstimator(SceneFlowNetConfig, StaticCameraEstimator):
    """A trained network of the paper; its fields are its settings. `weights` becomes the file that was found."""

    METHOD: ClassVar[str] = ""
    CORRELATION: ClassVar[bool] = True

    network: SceneFlowNet = field(init=False, repr=False, compare=False)
    size: tuple[int, int] = field(init=False, repr=False, compare=False)
    grouping: GroupingSettings = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        device = find_device(self.device)
        path = find_weights(self.METHOD, self.weights)
        network, metadata = load_weights(path, device)
        self._check_kind(network, metadata, path)
        weight = _trained_weight(metadata, path) if self.rotation_weight is None else self.rotation_weight
        # A frozen dataclass sets what follows from its settings once, here.
        object.__setattr__(self, "grouping", GroupingSettings(rotation_weight=weight, min_pixels=self.min_pixels))
        object.__setattr__(self, "size", trained_size(metadata, path))
        object.__setattr__(self, "weights", path)
        # Channels last is 1.5 times as fast on a CPU.
        object.__setattr__(self, "network", network.to(memory_format=torch.channels_last))  # type: ignore[call-overload]

    def estimate_static(self, pairs: Sequence[FramePair]) -> list[SceneMotion]:
        """See `StaticCameraEstimator`; the network is evaluated once for all pairs of one size."""
        motions: dict[int, SceneMotion] = {}
        for group in same_size_groups([scaled_size(pair.curr.frame, self.size) for pair in pairs]):
            height, width = group.size
            prev = [pairs[k].prev.resized(width, height).frame for k in group.members]
            curr = [pairs[k].curr.resized(width, height).frame for k in group.members]
            maps = self.predict(prev, curr)
            for place, k in enumerate(group.members):
                own = SceneFlowNetOutput(*(one[place : place + 1] for one in maps))
                motions[k] = self._finish(pairs[k], own, curr[place])
        return [motions[k] for k in range(len(pairs))]

    def predict(self, prev: Sequence[RgbdFrame], curr: Sequence[RgbdFrame]) -> SceneFlowNetOutput:
        """The network's maps (B, C, H, W), on the estimator's device, of pairs of frames of one size."""
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            out: SceneFlowNetOutput = self.network(*to_tensors(prev, device), *to_tensors(curr, device))
        return out

    def _finish(self, pair: FramePair, maps: SceneFlowNetOutput, curr_s: RgbdFrame) -> SceneMotion:
        """One pair's maps as objects on the pixels of its current frame."""
        # 1. Pixels to objects, and a motion for each.
        labels_s = label_pixels(maps, self.grouping)
        objects = average_objects(maps, labels_s, curr_s.valid)
        # 2. The pixels of the frame.
        rows, columns = nearest_indices(labels_s.shape, pair.curr.frame.depth.shape)
        labels, objects = relabel_present(labels_s[rows[:, None], columns], objects)
        # 3. Motions, and the flow that they make.
        if self.rigid == "refine":
            objects = refine_objects(pair, labels, objects, self.refine)
        points = pair.curr.points
        flow = pixel_flow(maps, labels, points) if self.rigid == "none" else rigid_flow(objects, labels, points)
        return SceneMotion(labels=labels, scene_flow=flow, objects=objects, method=self.METHOD)

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
