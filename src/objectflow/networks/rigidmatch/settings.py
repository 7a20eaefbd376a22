"""What a `RigidMatch` is made of: widths, depths, and the choices that the ablation compares; with a JSON form."""

from __future__ import annotations

import typing
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from objectflow.errors import MethodError
from objectflow.storage.serialize import settings_from_plain, to_plain


@dataclass(frozen=True)
class RigidMatchSettings:
    """Widths, depths and forms of `RigidMatch`; the defaults are the full size, for 240x320.

    Raises:
        MethodError: a value that no network can be built from.
    """

    FREE: ClassVar[frozenset[str]] = frozenset({"queries", "seed_radius", "rounds"})
    """Fields that no tensor depends on: weights serve other values too."""

    stride: int = 8
    """Pixels a cell of the coarse grid, on which everything is matched with everything: 8 or 4. The fine grid's cells
    are half as wide."""
    stem_width: int = 64
    """Channels of the first layer, at stride 2."""
    fine_channels: int = 64
    """Of the fine grid's features."""
    channels: int = 128
    """Of the coarse grid's features and of the queries."""
    blocks: tuple[int, int, int] = (2, 2, 2)
    """Residual blocks of the fine grid, the coarse grid, and a context grid half as fine again with twice the
    channels: ResNet-18 without its last stage."""
    attention_layers: int = 6
    """In turn within a frame and across the two."""
    heads: int = 8
    """Of every attention."""
    key_pool: int = 1
    """Attend to means over so many by so many cells: 2 is a quarter of the work."""
    matching: Literal["global", "windowed"] = "global"
    """windowed: only previous cells within `reach` of a cell can be its match."""
    reach: int = 10
    """Cells, of windowed matching; the paper's L."""
    updates: int = 2
    """Of each fine cell's match within a small window; 0 leaves matches as the coarse grid has them."""
    window: int = 2
    """Fine cells: the small window has (2 window + 1)^2 of them."""
    objects: Literal["queries", "spheres"] = "queries"
    """spheres: an object is what votes within a radius around a seed, as in the paper; no decoder, no looks."""
    queries: int = 48
    """Most objects in a pair."""
    decoder_layers: int = 3
    """Of the queries' decoder."""
    seed_radius: float = 0.05
    """Metres in trajectory space: votes nearer to a seed make no other."""
    motion: Literal["solve", "regress"] = "solve"
    """solve: least squares over an object's matches; regress: from the object's query alone."""
    rounds: int = 1
    """Of solving again with matches that do not fit weighing less."""

    def __post_init__(self) -> None:
        if self.stride not in (4, 8):
            raise MethodError(f"network setting stride must be 4 or 8, not {self.stride}")
        least = {
            "stem_width": 1, "fine_channels": 1, "channels": 1, "heads": 1, "key_pool": 1, "window": 1, "queries": 1,
            "attention_layers": 0, "decoder_layers": 0, "updates": 0, "rounds": 0, "reach": 0,
        }  # fmt: skip
        for name, value in least.items():
            if getattr(self, name) < value:
                raise MethodError(f"network setting {name} must be at least {value}, not {getattr(self, name)}")
        if self.channels % self.heads:
            raise MethodError(f"network setting channels must be a multiple of heads, not {self.channels}")
        if len(self.blocks) != 3 or min(self.blocks) < 1:
            raise MethodError(f"network setting blocks needs three numbers from 1, not {self.blocks}")
        if not 0 < self.seed_radius < float("inf"):  # written so that NaN fails too
            raise MethodError(f"network setting seed_radius must be finite and above 0, not {self.seed_radius}")
        hints = typing.get_type_hints(type(self))
        for name in ("matching", "objects", "motion"):
            choices = typing.get_args(hints[name])
            if getattr(self, name) not in choices:
                raise MethodError(
                    f"network setting {name} must be one of {', '.join(choices)}, not {getattr(self, name)!r}"
                )

    @property
    def fine_stride(self) -> int:
        """Pixels a cell of the fine grid."""
        return self.stride // 2

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings and lists of numbers, for JSON."""
        return dict(to_plain(self))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RigidMatchSettings:
        """The inverse of `to_dict`; fields that are absent take their defaults.

        Raises:
            MethodError: an unknown field, a value of another type, or one that no network can be built from.
        """
        return settings_from_plain(cls, values, what="network setting", error=MethodError)


SMALL = RigidMatchSettings(
    stride=4, stem_width=24, fine_channels=32, channels=64, blocks=(1, 1, 1), attention_layers=4, heads=4, key_pool=2,
    window=1, updates=1,
)  # fmt: skip
"""For 120x160 on a CPU: as many cells as the full size has at 240x320, with half the channels."""
