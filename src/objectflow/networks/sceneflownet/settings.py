"""The settings of a `SceneFlowNet` and their JSON form; the defaults are the paper's."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from objectflow.errors import MethodError
from objectflow.storage.serialize import settings_from_plain, to_plain

MAX_WIDTH, MAX_LAYERS, MAX_REACH = 4096, 64, 64
"""Upper bounds of channels of a layer, layers of a stage and cells of the correlation, far above useful values: a
damaged header must not describe an endless network."""

Widths = tuple[int, ...]
Stages = tuple[Widths, ...]


@dataclass(frozen=True)
class NetworkSettings:
    """Widths and depths of `SceneFlowNet`; the defaults are the paper's OurC at any input size.

    Raises:
        MethodError: a value that no network can be built from.
    """

    FREE: ClassVar[frozenset[str]] = frozenset()
    """Fields that no tensor depends on: weights are valid for any value."""

    RETIRED: ClassVar[Mapping[str, Any]] = {"missing": "channel", "correlation_mean": False}
    """Fields of earlier versions in headers of weights, with the only value that is still implemented."""

    correlation: bool = True
    """False is OurS: one encoder for the four images, no correlation, no max-pool."""
    trunk_width: int = 64
    """Channels of the first layer of the colour trunk; 64 is ResNet-50, which pretrained weights require."""
    trunk_blocks: tuple[int, int] = (3, 4)
    """Number of bottleneck blocks at stride 4 and at stride 8; (3, 4) is ResNet-50."""
    trunk_norm: Literal["batch", "frozen"] = "batch"
    """Training normalises by the statistics of the batch, or by the stored ones, which makes pairs independent."""
    color_channels: int = 256
    """Channels of the correlated colour features."""
    shape_stages: Stages = ((16, 16, 16), (16, 16, 32), (32, 32, 64))
    """Channels of the 3x3 layers of the XYZ encoder; the last layer of each stage halves the size. Three stages give
    stride 8."""
    reach: int = 10
    """L of the paper: the correlation covers (2 L + 1)^2 cells of stride 8."""
    correlation_cosine: bool = False
    """Correlate unit-length features scaled by a learnt factor, and weight cells by exp(c - max c); the paper
    rectifies plain products. Matches are then learnt in a few hundred steps."""
    xfeat: bool = False
    """Add the scaled cosines of frozen XFeat features (Potje et al., CVPR 2024) to the correlation, unlike the paper,
    whose colour trunk starts from ImageNet's weights. It needs `correlation_cosine`. Ignored without correlation."""
    displacement: bool = False
    """Pass each cell's expected displacement under the softmax of its correlations, and the highest probability, to
    the hourglass, which in the paper receives pooled features only. Ignored without correlation."""
    displacement_window: int = 0
    """Cells: the expected displacement is the mean over the window of so many cells around the most probable one, and
    its probability that of the window. 0 takes the whole patch, whose mean lies far from every candidate where the
    correlation has several maxima."""
    local_motion_window: int = 0
    """Cells in each direction of the neighbourhoods to whose displacements rigid motions are fitted, which the
    hourglass receives too; 0 for none, as in the paper. Without them, rotations are hardly learnt. They need
    `displacement`."""
    local_motion_scale: float = 0.06
    """Metres: distance at which the weight of a neighbour falls to exp(-1/2); about the radius of an object."""
    local_motion_tolerance: float = 0.015
    """Metres: change of the distance between two points from frame to frame at which their agreement on one rigid
    motion falls to exp(-1/2); about half a cell."""
    length_unit: float = 1.0
    """Metres: unit of the encoders' points and of the heads. In metres, points within an object hardly differ, and a
    step of a head's weights changes its output by centimetres; 0.1 makes both easier to learn."""
    origin_depth: float = 0.0
    """Metres: depth that encoders subtract; the middle of the depth range gives small numbers."""
    down: Stages = ((64, 64), (128, 128, 128), (256, 256, 256), (512, 512, 512))
    """Channels of the downsampling half of the hourglass; from the second stage on, the first layer of a stage is 5x5
    and halves the size."""
    up: Stages = ((256, 512, 256), (128, 128, 128), (64, 128, 64))
    """Channels of the upsampling half; the first layer of a stage doubles the size and takes the skip connection."""
    fine: Stages = ((64, 64, 64, 64), (64, 64, 64, 64), (64, 64, 64))
    """Channels of the layers from stride 8 to the input resolution, in three stages; the first layer of a stage
    doubles the size."""
    details: bool = False
    """Give every stage of `fine` a skip connection from the current frame at that resolution, unlike the paper. Edges
    become sharper, and X, an offset from the pixel's own point, does not have to come from stride 8."""

    def __post_init__(self) -> None:
        for name in ("trunk_width", "color_channels"):
            if not 1 <= getattr(self, name) <= MAX_WIDTH:
                raise MethodError(f"network setting {name} must lie in 1..{MAX_WIDTH}, not {getattr(self, name)}")
        if not 0 < self.length_unit < float("inf"):
            raise MethodError(f"network setting length_unit must be finite and above 0, not {self.length_unit}")
        if not abs(self.origin_depth) < float("inf"):
            raise MethodError(f"network setting origin_depth must be finite, not {self.origin_depth}")
        if not 0 <= self.reach <= MAX_REACH:
            raise MethodError(f"network setting reach must lie in 0..{MAX_REACH}, not {self.reach}")
        if not 0 <= self.displacement_window <= MAX_REACH:
            raise MethodError(
                f"network setting displacement_window must lie in 0..{MAX_REACH}, not {self.displacement_window}"
            )
        if not 0 <= self.local_motion_window <= MAX_REACH:
            raise MethodError(
                f"network setting local_motion_window must lie in 0..{MAX_REACH}, not {self.local_motion_window}"
            )
        if self.local_motion_window and not self.displacement:
            raise MethodError("network setting local_motion_window needs displacement: motions are fitted to it")
        for name in ("local_motion_scale", "local_motion_tolerance"):
            if not 0 < getattr(self, name) < float("inf"):
                raise MethodError(f"network setting {name} must be finite and above 0, not {getattr(self, name)}")
        if self.xfeat and not self.correlation_cosine:
            raise MethodError("network setting xfeat needs correlation_cosine: cosines are added to cosines")
        blocks = self.trunk_blocks
        if len(blocks) != 2 or min(blocks) < 1 or max(blocks) > MAX_LAYERS:
            raise MethodError(f"network setting trunk_blocks needs two numbers in 1..{MAX_LAYERS}, not {blocks}")
        if self.trunk_norm not in ("batch", "frozen"):
            raise MethodError(f"network setting trunk_norm must be batch or frozen, not {self.trunk_norm!r}")
        for name, count in (("shape_stages", 3), ("fine", 3), ("down", None), ("up", len(self.down) - 1)):
            stages: Stages = getattr(self, name)
            if not stages or (count is not None and len(stages) != count):
                raise MethodError(f"network setting {name} needs {count or 'some'} stages, not {len(stages)}")
            if any(not stage or min(stage) < 1 for stage in stages):
                raise MethodError(f"network setting {name} has a stage without layers or a layer without channels")
            if len(stages) > MAX_LAYERS or any(len(one) > MAX_LAYERS or max(one) > MAX_WIDTH for one in stages):
                raise MethodError(
                    f"network setting {name} has more than {MAX_LAYERS} stages or layers, or more than {MAX_WIDTH} "
                    "channels in a layer"
                )

    def scaled(self, factor: float) -> NetworkSettings:
        """The same network with all widths multiplied by `factor`, rounded to multiples of 8, at least 8."""

        def scale(width: int) -> int:
            return max(8, 8 * round(width * factor / 8))

        def scale_all(stages: Stages) -> Stages:
            return tuple(tuple(scale(width) for width in stage) for stage in stages)

        return dataclasses.replace(
            self,
            trunk_width=scale(self.trunk_width),
            color_channels=scale(self.color_channels),
            shape_stages=scale_all(self.shape_stages),
            down=scale_all(self.down),
            up=scale_all(self.up),
            fine=scale_all(self.fine),
        )

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain JSON values."""
        return dict(to_plain(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkSettings:
        """The inverse of `to_dict`; absent fields take their defaults.

        Raises:
            MethodError: an unknown or retired field, a value of another type, or one that no network can be built
                from.
        """
        for name, kept in cls.RETIRED.items():
            if values.get(name, kept) != kept:
                raise MethodError(
                    f"network setting {name} is {values[name]!r}, which this version no longer implements: it needs "
                    f"{kept!r}"
                )
        current = {name: value for name, value in values.items() if name not in cls.RETIRED}
        return settings_from_plain(cls, current, what="network setting", error=MethodError)
