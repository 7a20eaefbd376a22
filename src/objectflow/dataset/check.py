"""Check a data set against itself, and say what is in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest, Part
from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.dataset.shards import Shards
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.typing import Float64Array

WORST = 5
"""How many of the worst objects a report names."""

LEAST_PIXELS = 30
"""Compared pixels that an object needs to be among them: a median of fewer is that of a rim or a thin edge."""


class Histogram:
    """Counts of values in bins of equal width, the last one open; quantiles to a bin's width, mean exactly."""

    def __init__(self, width: float, bins: int) -> None:
        self.width, self.counts = width, np.zeros(bins, dtype=np.int64)
        self._sum = 0.0

    def add(self, values: NDArray[Any]) -> None:
        """Count values >= 0."""
        bins = np.minimum((values / self.width).astype(np.int64), len(self.counts) - 1)
        self.counts += np.bincount(bins, minlength=len(self.counts))
        self._sum += float(values.sum())

    @property
    def count(self) -> int:
        """How many values were added."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """The mean of all values; NaN without any."""
        return self._sum / self.count if self.count else float("nan")

    def quantile(self, share: float) -> float:
        """The middle of the bin below which this share of the values lies; NaN without any."""
        if not self.count:
            return float("nan")
        bin_ = int(np.searchsorted(np.cumsum(self.counts), share * self.count))
        return (bin_ + 0.5) * self.width

    def grouped(self, edges: list[float]) -> list[int]:
        """Counts between the edges, and above the last; edges are multiples of the width."""
        starts = [round(edge / self.width) for edge in edges]
        ends = [*starts[1:], len(self.counts)]
        return [int(self.counts[a:b].sum()) for a, b in zip(starts, ends, strict=True)]


@dataclass(frozen=True)
class ObjectErrors:
    """One object's medians over the pixels that can be compared: millimetres, and grey levels."""

    key: str
    label: int
    model: str
    pixels: int
    depth_mm: float
    reduced_depth_mm: float
    color: float


@dataclass
class CheckReport:
    """What `check_part` found.

    Attributes:
        part: its name.
        rows, hash: of the part and of the whole set.
        rejected: scenes that were drawn anew, by reason.
        depth_mm, reduced_depth_mm, color: errors of all compared pixels: with the raw rotation, with the
            symmetry-reduced one, and of colour.
        objects: objects a pair; visible: each object's pixels in the current frame.
        displacement_cm, rotation_deg, raw_rotation_deg: of objects seen in both frames; where rows know the camera's
            motion, of those that move, before the camera.
        movers: objects a pair that move, where rows know the camera's motion (`objectflow.dataset.moving_objects`).
        motionless, moving_cameras: how many of those pairs show no motion, and how many a moving camera's.
        symmetric: how many objects have an axis of symmetry, of `objects_total`.
        worst: the objects with the largest median depth error.
        wrong: rows whose object table contradicts itself, with the reason.
    """

    part: str
    rows: int
    hash: str
    rejected: dict[str, int]
    depth_mm: Histogram = field(default_factory=lambda: Histogram(0.01, 10_000))
    reduced_depth_mm: Histogram = field(default_factory=lambda: Histogram(0.01, 10_000))
    color: Histogram = field(default_factory=lambda: Histogram(0.1, 2_560))
    objects: Histogram = field(default_factory=lambda: Histogram(1, 256))
    visible: Histogram = field(default_factory=lambda: Histogram(10, 100_000))
    displacement_cm: Histogram = field(default_factory=lambda: Histogram(0.1, 1_000))
    rotation_deg: Histogram = field(default_factory=lambda: Histogram(1, 181))
    raw_rotation_deg: Histogram = field(default_factory=lambda: Histogram(1, 181))
    movers: Histogram = field(default_factory=lambda: Histogram(1, 256))
    motionless: int = 0
    moving_cameras: int = 0
    symmetric: int = 0
    objects_total: int = 0
    worst: list[ObjectErrors] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-able numbers."""
        spread = ("depth_mm", "reduced_depth_mm", "color", "objects", "visible", "displacement_cm", "rotation_deg")
        return {
            "part": self.part,
            "rows": self.rows,
            "hash": self.hash,
            "rejected": self.rejected,
            **{
                name: {
                    "mean": getattr(self, name).mean,
                    "median": getattr(self, name).quantile(0.5),
                    "p95": getattr(self, name).quantile(0.95),
                    "count": getattr(self, name).count,
                }
                for name in (*spread, "raw_rotation_deg")
            },
            **self._movers(),
            "symmetric_share": self.symmetric / max(1, self.objects_total),
            "worst": [asdict(entry) for entry in self.worst],
            "wrong": self.wrong,
        }

    def _movers(self) -> dict[str, Any]:
        if not self.movers.count:
            return {}
        count = self.movers.count
        return {
            "movers": {"mean": self.movers.mean, "most": int(np.flatnonzero(self.movers.counts).max())},
            "motionless_share": self.motionless / count,
            "moving_camera_share": self.moving_cameras / count,
        }


def check(
    folder: Path, *, limit: int | None = None, report: Callable[[str, int, int], None] = lambda part, done, total: None
) -> list[CheckReport]:
    """Verify every hash, then warp every pair by its own depth, poses and motions; one report a part.

    Args:
        folder: the data set.
        limit: check no more than this many pairs of each part; hashes are checked all the same.
        report: called after every pair with the part's name, pairs done, and pairs in all.

    Raises:
        DatasetError: no data set, or a shard whose hash differs.
    """
    manifest = Manifest.read(folder)
    manifests.verify(folder, manifest)
    reports = []
    for name, part in manifest.parts.items():
        result = CheckReport(name, part.rows, manifest.sha256, part.rejected)
        total = part.rows if part.kind == "pairs" else part.rows - part.scenes
        total = total if limit is None else min(limit, total)
        for done, row in enumerate(_pairs(folder, part, manifest)):
            if done == total:
                break
            add_pair(result, row)
            report(name, done + 1, total)
        reports.append(result)
    return reports


def add_pair(report: CheckReport, row: PairRow) -> None:
    """Count one pair into a report."""
    report.wrong += [f"{row.key}: {reason}" for reason in contradictions(row)]
    report.objects.add(np.array([len(row.objects)]))
    report.objects_total += len(row.objects)
    report.symmetric += sum(bool(obj.symmetry) for obj in row.objects)
    moving = moving_labels(row)
    if row.camera_motion is not None:
        report.movers.add(np.array([len(moving)]))
        report.motionless += not moving
        report.moving_cameras += not np.array_equal(row.camera_motion, np.eye(4))
    visible = np.bincount(row.curr_labels.ravel(), minlength=256)
    report.visible.add(np.array([visible[obj.label] for obj in row.objects if visible[obj.label]]))
    both = [obj for obj in row.objects if obj.in_both]
    if not both:
        return
    moved = [obj for obj in both if obj.label in moving]
    report.displacement_cm.add(_lengths([obj.translation for obj in moved]) * 100)
    report.rotation_deg.add(np.degrees(_lengths([obj.rotation_vector for obj in moved])))
    report.raw_rotation_deg.add(np.degrees(_lengths([obj.raw_rotation_vector for obj in moved])))

    raw, reduced = warp_errors(row, raw=True), warp_errors(row, raw=False)
    report.depth_mm.add(1000 * np.abs(raw.depth))
    report.reduced_depth_mm.add(1000 * np.abs(reduced.depth))
    report.color.add(raw.color)
    for obj in both:
        mine, mine_reduced = raw.labels == obj.label, reduced.labels == obj.label
        if min(mine.sum(), mine_reduced.sum()) >= LEAST_PIXELS:
            report.worst.append(
                ObjectErrors(
                    key=row.key,
                    label=obj.label,
                    model=obj.model,
                    pixels=int(mine.sum()),
                    depth_mm=float(1000 * np.median(np.abs(raw.depth[mine]))),
                    reduced_depth_mm=float(1000 * np.median(np.abs(reduced.depth[mine_reduced]))),
                    color=float(np.median(raw.color[mine])),
                )
            )
    report.worst.sort(key=lambda entry: -max(entry.depth_mm, entry.reduced_depth_mm))
    del report.worst[WORST:]


def _lengths(vectors: list[Float64Array]) -> Float64Array:
    return np.asarray(np.linalg.norm(np.reshape(vectors, (-1, 3)), axis=-1))


def contradictions(row: PairRow) -> list[str]:
    """What in a row does not fit the rest of it: labels without an object, motions unlike the poses."""
    found = []
    labels = [obj.label for obj in row.objects]
    if sorted(set(labels)) != labels:
        found.append(f"labels {labels} are not rising")
    for name, image in (("prev", row.prev_labels), ("curr", row.curr_labels)):
        stray = set(np.unique(image).tolist()) - {0} - set(labels)
        if stray:
            found.append(f"{name}_labels have {sorted(stray)}, the object table has not")
    if row.prev.camera != row.curr.camera:
        found.append("the two frames have different cameras")
    for obj in row.objects:
        moved = geometry.so3_exp(obj.raw_rotation_vector)
        by_poses = obj.prev_pose[:3, :3] @ obj.curr_pose[:3, :3].T
        if (
            np.abs(obj.center - obj.curr_pose[:3, 3]).max() > 1e-9
            or np.abs(obj.center + obj.translation - obj.prev_pose[:3, 3]).max() > 1e-9
            or np.abs(moved - by_poses).max() > 1e-6
        ):
            found.append(f"the motion of object {obj.label} is not that of its poses")
        seen = [bool((image == obj.label).any()) for image in (row.prev_labels, row.curr_labels)]
        if obj.in_both != all(seen) or not any(seen):
            found.append(f"object {obj.label} is not seen as in_both={obj.in_both} says")
    return found


def _pairs(folder: Path, part: Part, manifest: Manifest) -> Iterator[PairRow]:
    """The pairs of a part; of sequences, each frame with the one before."""
    if part.kind == "pairs":
        yield from Shards(folder, part, PairRow.from_dict, manifest)
        return
    prev: SequenceRow | None = None
    for curr in Shards(folder, part, SequenceRow.from_dict, manifest):
        if prev is not None and prev.sequence == curr.sequence:
            if curr.frame <= prev.frame:
                raise DatasetError(f"{folder}: frames of sequence {curr.sequence} are out of order")
            yield pair_of_frames(prev, curr)
        prev = curr
