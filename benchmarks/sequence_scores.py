"""Scores of sequences with ground truth, and their tables: steps, poses, known masks, models and times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from objectflow import geometry
from objectflow.geometry.symmetry import SymmetryAxis, reduce_motion
from objectflow.typing import Float64Array
from tracking import ORACLE, FollowedSteps

AGES = (1, 2, 5, 10, 20)
"""Numbers of frames since an object was followed first, up to which pose errors are printed."""
END = 10_000
"""Key of the pose errors in the last frame of each sequence."""
BEFORE = -1
"""Key of the errors of poses that were found later, by following an object back."""


@dataclasses.dataclass
class PoseErrors:
    """Errors of poses by the number of frames since an object was followed first.

    Attributes:
        shifts, turns: millimetres and degrees.
    """

    shifts: dict[int, list[float]] = dataclasses.field(default_factory=dict)
    turns: dict[int, list[float]] = dataclasses.field(default_factory=dict)

    def add(
        self,
        age: int,
        found: Float64Array,
        true: Float64Array,
        center: Float64Array,
        symmetry: Sequence[SymmetryAxis] = (),
    ) -> None:
        """Add a pose.

        Args:
            age: frames since the first one, or `BEFORE` or `END`.
            found, true: (4, 4) poses in one frame.
            center: (3,) metres in the object's true frame: the point at which the shift is measured. The axes of
                symmetry pass through its origin.
            symmetry: of the object; a turn within it is no error.
        """
        group = age if age in (BEFORE, END) else next((limit for limit in AGES if age <= limit), AGES[-1] + 1)
        shift = geometry.transform(found, center) - geometry.transform(true, center)
        self.shifts.setdefault(group, []).append(1000 * float(np.linalg.norm(shift)))
        turn = geometry.rotation_angle(reduce_motion(found[:3, :3], true[:3, :3], symmetry))
        self.turns.setdefault(group, []).append(float(np.degrees(turn)))


@dataclasses.dataclass
class Score(FollowedSteps):
    """Sums over sequences; see `FollowedSteps`.

    Attributes:
        tracks: errors of the tracks' poses in every frame since the object was followed first, also at rest.
        models: errors of the poses that reconstruction registered, since the first fused view.
        rest: IoU of the known mask of each object at rest that was followed before.
        vertices: millimetres from each vertex of each model to the true surface.
        covered: share of each modelled object's seen surface near its mesh.
        moved, modelled: number of objects that moved, and of those with a model.
        pairs: number of pairs.
        estimating, following: CPU seconds of the method in consecutive frames, and of everything else but the models'
            fusion: the method between frames farther apart belongs to the latter.
        completed, completed_switches: `tracked` and `switches` after the end of each sequence, when objects have been
            followed back.
    """

    tracks: PoseErrors = dataclasses.field(default_factory=PoseErrors)
    models: PoseErrors = dataclasses.field(default_factory=PoseErrors)
    rest: list[float] = dataclasses.field(default_factory=list)
    vertices: list[Float64Array] = dataclasses.field(default_factory=list)
    covered: list[float] = dataclasses.field(default_factory=list)
    moved: int = 0
    modelled: int = 0
    pairs: int = 0
    estimating: float = 0.0
    following: float = 0.0
    completed: int = 0
    completed_switches: int = 0


def following_table(title: str, scores: dict[str, Score]) -> Table:
    columns = (
        "method", "followed at once", "switches", "in the end", "switches", "IoU at rest, median", "mean",
        "objects that moved", "modelled",
    )  # fmt: skip
    table = Table(*columns, title=title)
    for method, score in scores.items():
        once, end = (
            f"{count} of {score.visible} ({count / max(1, score.visible):.0%})"
            for count in (score.tracked, score.completed)
        )
        rest = (f"{np.median(score.rest):.2f}", f"{np.mean(score.rest):.2f}") if score.rest else ("-", "-")
        table.add_row(
            method, once, str(score.switches), end, str(score.completed_switches), *rest, str(score.moved),
            str(score.modelled),
        )  # fmt: skip
    return table


def model_table(scores: dict[str, Score]) -> Table:
    table = Table("method", "vertex error mm, median", "90% below", "median model", "seen surface covered, median")
    for method, score in scores.items():
        if not score.vertices:
            table.add_row(method, "-", "-", "-", "-")
            continue
        every = np.concatenate(score.vertices)
        middle = float(np.median([np.median(one) for one in score.vertices]))
        table.add_row(
            method,
            f"{np.median(every):.2f}",
            f"{np.quantile(every, 0.9):.2f}",
            f"{middle:.2f}",
            f"{np.median(score.covered):.2f}",
        )
    return table


def pose_table(scores: dict[str, Score]) -> Table:
    """Median pose errors by the number of frames since an object was followed first."""
    names = (
        {BEFORE: "followed back"}
        | {age: f"<= {age}" for age in AGES}
        | {AGES[-1] + 1: f"> {AGES[-1]}", END: "at the end"}
    )
    table = Table("median pose error after", *names.values())
    for method, score in scores.items():
        for kind, errors in (("track", score.tracks), ("model", score.models)):
            cells = [
                f"{np.median(errors.shifts[age]):.1f} mm {np.median(errors.turns[age]):.1f} deg"
                if age in errors.shifts
                else "-"
                for age in names
            ]
            table.add_row(f"{method}, {kind}", *cells)
    return table


def time_table(scores: dict[str, Score]) -> Table:
    table = Table("method", "CPU s a pair", "tracks and known objects", "together / method alone")
    for method, score in scores.items():
        alone, more = score.estimating / score.pairs, score.following / score.pairs
        ratio = "-" if method == ORACLE else f"{(alone + more) / alone:.2f}"
        table.add_row(method, f"{alone:.2f}", f"{more:.2f}", ratio)
    return table
