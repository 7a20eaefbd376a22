"""Widths, depths and forms of a `RigidMatch`, with a JSON form."""

from __future__ import annotations

import typing
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from objectflow.errors import MethodError
from objectflow.storage.serialize import settings_from_plain, to_plain

MOST = {
    "stem_width": 1024, "fine_channels": 1024, "channels": 2048, "detail_channels": 1024, "heads": 64, "blocks": 64,
    "attention_layers": 64, "decoder_layers": 64, "key_pool": 64, "window": 16, "queries": 1024, "updates": 64,
    "rounds": 64,
}  # fmt: skip
"""Upper bounds of the settings, far above useful values: a damaged header must not describe an endless network."""

_RETIRED: dict[str, Any] = {"matching": "global", "reach": 10, "objects": "queries", "motion": "solve"}
"""Fields of the first generation's headers; networks with other values are no longer supported."""
_FIRST_GENERATION: dict[str, Any] = {
    "xfeat": "none", "window_geometry": False, "detail_channels": 0, "median_depth": 0.0,
}  # fmt: skip
"""Values that describe first-generation networks, whose headers lack these fields."""


@dataclass(frozen=True)
class RigidMatchSettings:
    """Widths, depths and forms of `RigidMatch`; the defaults are those of the second generation, for 240x320.

    Raises:
        MethodError: a value that no network can be built from.
    """

    FREE: ClassVar[frozenset[str]] = frozenset({"queries", "seed_radius", "rounds"})
    """Fields that no tensor depends on: weights work with other values too."""

    stride: int = 8
    """Pixels per cell of the coarse grid, on which all pairs of cells are matched: 8 or 4. Cells of the fine grid are
    half as wide."""
    stem_width: int = 32
    """Channels of the first layer, at stride 2."""
    fine_channels: int = 48
    """Feature channels of the fine grid."""
    channels: int = 96
    """Channels of the coarse grid's features and of the queries."""
    blocks: tuple[int, int, int] = (2, 2, 2)
    """Residual blocks of the fine grid, the coarse grid, and a context grid with half its resolution and twice its
    channels: ResNet-18 without its last stage."""
    attention_layers: int = 4
    """Attention layers, alternating between self-attention and cross-attention."""
    heads: int = 4
    """Heads of every attention layer."""
    key_pool: int = 2
    """Side in cells of the average pooling of keys and values: 2 takes a quarter of the computation."""
    xfeat: Literal["none", "input", "score", "both"] = "both"
    """Use of frozen XFeat features: added to tokens and window features (input), as a term of the matching score
    (score), or both."""
    updates: int = 2
    """Refinements of each fine cell's match within a small window; 0 only upsamples the coarse matches."""
    window: int = 2
    """Radius of the small window in fine cells: it has (2 window + 1)^2 of them."""
    window_geometry: bool = True
    """Score window cells by their 3D offset from the current match as well as by correlation."""
    detail_channels: int = 24
    """Channels of a decoder on the stem's grid that sharpens masks; 0 upsamples from the fine grid alone."""
    queries: int = 128
    """Number of queries, several times that of objects: confident votes lie on large objects, and an object without a
    query is missed."""
    decoder_layers: int = 3
    """Layers of the query decoder."""
    seed_radius: float = 0.1
    """Metres in trajectory space within which a seed suppresses others."""
    rounds: int = 1
    """Repetitions of the solve in which matches that disagree with the motion are weighted down."""
    median_depth: float = 0.75
    """Metres to which the median depth of the current frame is scaled before the network; 0 leaves depth as it is."""

    def __post_init__(self) -> None:
        if self.stride not in (4, 8):
            raise MethodError(f"network setting stride must be 4 or 8, not {self.stride}")
        least = {
            "stem_width": 1, "fine_channels": 1, "channels": 1, "heads": 1, "key_pool": 1, "window": 1, "queries": 1,
            "attention_layers": 0, "decoder_layers": 0, "updates": 0, "rounds": 0, "detail_channels": 0,
        }  # fmt: skip
        for name, value in least.items():
            if not value <= getattr(self, name) <= MOST[name]:
                raise MethodError(
                    f"network setting {name} must lie in {value}..{MOST[name]}, not {getattr(self, name)}"
                )
        if self.channels % self.heads:
            raise MethodError(f"network setting channels must be a multiple of heads, not {self.channels}")
        if len(self.blocks) != 3 or min(self.blocks) < 1 or max(self.blocks) > MOST["blocks"]:
            raise MethodError(f"network setting blocks needs three numbers in 1..{MOST['blocks']}, not {self.blocks}")
        if self.detail_channels and self.stride != 8:
            raise MethodError("network setting detail_channels needs a stride of 8: use 0")
        if not 0 < self.seed_radius < float("inf"):  # written so that NaN fails too
            raise MethodError(f"network setting seed_radius must be finite and above 0, not {self.seed_radius}")
        if not 0 <= self.median_depth < float("inf"):
            raise MethodError(f"network setting median_depth must be finite and >= 0, not {self.median_depth}")
        choices = typing.get_args(typing.get_type_hints(type(self))["xfeat"])
        if self.xfeat not in choices:
            raise MethodError(f"network setting xfeat must be one of {', '.join(choices)}, not {self.xfeat!r}")

    @property
    def fine_stride(self) -> int:
        """Pixels per cell of the fine grid."""
        return self.stride // 2

    @property
    def mask_stride(self) -> int:
        """Pixels per cell of the grid to which masks are upsampled."""
        return 2 if self.detail_channels else 1

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists of numbers, for JSON."""
        return dict(to_plain(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RigidMatchSettings:
        """The inverse of `to_dict`; absent fields take their defaults, those of the first generation in its headers.

        Raises:
            MethodError: an unknown field, a value of another type, or one that no network can be built from.
        """
        retired = {name: values[name] for name in _RETIRED if name in values}
        for name, value in retired.items():
            if value != _RETIRED[name]:
                raise MethodError(
                    f"network setting {name} {value!r} is no longer supported, only {_RETIRED[name]!r}: train again"
                )
        known = {name: value for name, value in values.items() if name not in retired}
        chosen = {**_FIRST_GENERATION, **known} if retired else known
        return settings_from_plain(cls, chosen, what="network setting", error=MethodError)
