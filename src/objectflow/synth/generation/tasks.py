"""What a worker of the generator is given and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from objectflow.dataset.manifest import Kind


class Task(NamedTuple):
    """One scene to generate: the kind of its rows, and its number within its part of the data set."""

    kind: Kind
    scene: int


@dataclass(frozen=True)
class SceneRows:
    """The rows of one scene.

    Attributes:
        rows: as returned by `PairRow.to_dict` or `SequenceRow.to_dict`, in order.
        rejected: number of rejected attempts, by reason.
        notes: messages for the user, one line each, such as a mesh that cannot be read.
        seconds: time spent, by stage.
    """

    rows: list[dict[str, Any]]
    rejected: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


Maker = Callable[[Task], SceneRows]
"""Makes the rows of one scene."""
