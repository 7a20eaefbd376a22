"""What a network is made of: widths and depths, the paper's as defaults, with a JSON form."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from objectflow.errors import MethodError

Widths = tuple[int, ...]
Stages = tuple[Widths, ...]


@dataclass(frozen=True)
class NetworkSettings:
    """Widths and depths of `SceneFlowNet`; the defaults are the paper's OurC at any input size.

    Raises:
        MethodError: a value that no network can be built from.
    """

    FREE: ClassVar[frozenset[str]] = frozenset()
    """Fields that no tensor depends on: weights serve other values too."""

    correlation: bool = True
    """False is OurS: one encoder for the four images, no correlation, no max-pool."""
    trunk_width: int = 64
    """Channels of the colour trunk's first layer; 64 is ResNet-50, which a pretrained file needs."""
    trunk_blocks: tuple[int, int] = (3, 4)
    """Bottlenecks at stride 4 and at stride 8; (3, 4) is ResNet-50."""
    trunk_norm: Literal["batch", "frozen"] = "batch"
    """Batch normalisation by the batch's statistics, or always by the stored ones: then every pair is on its own."""
    color_channels: int = 256
    """Channels of the colour features that are correlated."""
    shape_stages: Stages = ((16, 16, 16), (16, 16, 32), (32, 32, 64))
    """3x3 layers of the XYZ encoder; the last of each stage halves the size. Three stages: stride 8."""
    missing: Literal["channel", "masked"] = "channel"
    """How the XYZ encoder is told of missing depth: by a fourth channel, or by convolutions that leave it out."""
    reach: int = 10
    """L of the paper: the correlation's patch has (2 L + 1)^2 cells of stride 8."""
    correlation_mean: bool = False
    """Divide the correlation by the number of channels; the paper sums."""
    correlation_cosine: bool = False
    """Correlate features of length 1, times a learnt sharpness, and weigh cells relative to the best one, by
    exp(c - max c); the paper rectifies plain products. Matches are learnt in a few hundred steps."""
    displacement: bool = False
    """Give the hourglass each cell's expected displacement too, by the softmax of its correlations, and the highest
    probability. The paper has it drawn from pooled features alone. Without correlation there is none."""
    length_unit: float = 1.0
    """Metres that encoders and heads count in. Points in metres hardly differ within an object, and a step of a head's
    weights moves what it says by centimetres; 0.1 makes both easier to learn."""
    origin_depth: float = 0.0
    """Metres: encoders count depth from here. The middle of what the network will see makes small numbers."""
    down: Stages = ((64, 64), (128, 128, 128), (256, 256, 256), (512, 512, 512))
    """Layers of the hourglass on its way down; the first of every stage but the first is 5x5 and halves the size."""
    up: Stages = ((256, 512, 256), (128, 128, 128), (64, 128, 64))
    """Layers on its way up; the first of a stage doubles the size and receives the skip link."""
    fine: Stages = ((64, 64, 64, 64), (64, 64, 64, 64), (64, 64, 64))
    """Layers from stride 8 to the input's resolution; the first of a stage doubles the size. Three stages."""
    details: bool = False
    """Show every stage of `fine` the current frame at its own resolution, by a skip link; the paper has none. Edges
    come out sharper, and X, an offset from the pixel's own point, need not be drawn from stride 8."""

    def __post_init__(self) -> None:
        for name in ("trunk_width", "color_channels"):
            if getattr(self, name) < 1:
                raise MethodError(f"network setting {name} must be at least 1, not {getattr(self, name)}")
        if not 0 < self.length_unit < float("inf"):
            raise MethodError(f"network setting length_unit must be finite and above 0, not {self.length_unit}")
        if not abs(self.origin_depth) < float("inf"):
            raise MethodError(f"network setting origin_depth must be finite, not {self.origin_depth}")
        if self.reach < 0:
            raise MethodError(f"network setting reach must be at least 0, not {self.reach}")
        if len(self.trunk_blocks) != 2 or min(self.trunk_blocks) < 1:
            raise MethodError(f"network setting trunk_blocks needs two numbers from 1, not {self.trunk_blocks}")
        if self.trunk_norm not in ("batch", "frozen"):
            raise MethodError(f"network setting trunk_norm must be batch or frozen, not {self.trunk_norm!r}")
        if self.missing not in ("channel", "masked"):
            raise MethodError(f"network setting missing must be channel or masked, not {self.missing!r}")
        if self.missing == "masked" and not self.correlation:
            raise MethodError("network setting missing can be masked only with correlation: set it to channel")
        for name, count in (("shape_stages", 3), ("fine", 3), ("down", None), ("up", len(self.down) - 1)):
            stages: Stages = getattr(self, name)
            if not stages or (count is not None and len(stages) != count):
                raise MethodError(f"network setting {name} needs {count or 'some'} stages, not {len(stages)}")
            if any(not stage or min(stage) < 1 for stage in stages):
                raise MethodError(f"network setting {name} has a stage without layers or a layer without channels")

    def scaled(self, factor: float) -> NetworkSettings:
        """The same network with all widths times `factor`, as multiples of 8 and at least 8."""

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
        """Numbers, strings and lists of numbers, for JSON."""
        return {
            field.name: _lists(value) if isinstance(value := getattr(self, field.name), tuple) else value
            for field in dataclasses.fields(self)
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkSettings:
        """The inverse of `to_dict`; fields that are absent take their defaults.

        Raises:
            MethodError: an unknown field, a value of another type, or one that no network can be built from.
        """
        return cls(**read_fields(cls, values))


def read_fields(settings: type[Any], values: dict[str, Any]) -> dict[str, Any]:
    """JSON values as the arguments of a dataclass of numbers, strings and tuples.

    Raises:
        MethodError: an unknown field, or a value of another kind than the field's default.
    """
    known = {field.name: field.default for field in dataclasses.fields(settings)}
    for name in values:
        if name not in known:
            raise MethodError(f"unknown network setting {name!r}: choose from {', '.join(known)}")
    return {name: _like(known[name], value, name) for name, value in values.items()}


def _lists(value: Any) -> Any:
    return [_lists(item) for item in value] if isinstance(value, tuple) else value


def _like(example: Any, value: Any, name: str) -> Any:
    """`value` with lists made tuples, where it has the same kind and nesting as `example`."""
    if isinstance(example, tuple) and isinstance(value, list | tuple):
        return tuple(_like(example[0], item, name) for item in value)
    if type(value) is not type(example):
        kind = "a list" if isinstance(example, tuple) else f"of type {type(example).__name__}"
        raise MethodError(f"network setting {name} must be {kind}, not {value!r}")
    return value
