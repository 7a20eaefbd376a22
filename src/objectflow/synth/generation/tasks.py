"""What a worker of the generator is given and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from objectflow.dataset.manifest import Kind


class Task(NamedTuple):
    """One scene to be made: what becomes of it, and its number in its part."""

    kind: Kind
    scene: int


@dataclass(frozen=True)
class SceneRows:
    """What came of one scene.

    Attributes:
        rows: as `PairRow.to_dict` or `SequenceRow.to_dict` give them, in order.
        rejected: how many drafts of the scene were drawn anew, by reason.
        notes: things the user should know, one line each, such as a mesh that cannot be read.
        seconds: time spent, by stage.
    """

    rows: list[dict[str, Any]]
    rejected: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


Maker = Callable[[Task], SceneRows]


MakerFactory = Callable[[], Maker]
"""Builds a maker inside the process that will use it (a renderer is kept from scene to scene). Must be picklable."""
