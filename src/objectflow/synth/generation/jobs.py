"""The parts of a data set to generate, and their fixed division into shards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from objectflow.dataset.manifest import Kind, part_name, shard_name

ROWS_A_SHARD = 512
"""Maximum number of rows per shard. The rows of a scene are never divided between two shards."""


@dataclass(frozen=True)
class GenerationJob:
    """One part of a data set to generate: all its pairs or all its sequences.

    Attributes:
        kind: "pairs" or "sequences".
        split: "train", "val" or "test".
        count: number of pairs or sequences.
        rows_a_scene: views per scene (fewer for the last scene), or frames per sequence.
    """

    kind: Kind
    split: str
    count: int
    rows_a_scene: int

    @property
    def part(self) -> str:
        """Name of the part, and prefix of its shards' names."""
        return part_name(self.split, self.kind)

    @property
    def rows(self) -> int:
        """Number of rows of the whole part."""
        return self.count if self.kind == "pairs" else self.count * self.rows_a_scene

    @property
    def shards(self) -> list[range]:
        """The scenes of each shard; the layout depends on the job alone."""
        scenes = -(-self.rows // self.rows_a_scene)
        step = max(1, ROWS_A_SHARD // self.rows_a_scene)
        return [range(start, min(start + step, scenes)) for start in range(0, scenes, step)]

    @property
    def metadata(self) -> dict[str, Any]:
        """What every shard of the part records about it."""
        return {"kind": self.kind, "split": self.split, "count": self.count, "rows_a_scene": self.rows_a_scene}

    def rows_of(self, scene: int) -> int:
        """Number of rows that a scene contributes."""
        return min(self.rows_a_scene, self.rows - scene * self.rows_a_scene)

    def shard_name(self, number: int) -> str:
        """File name of a shard."""
        return shard_name(self.part, number, len(self.shards))
