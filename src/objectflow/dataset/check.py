"""Consistency checks and statistics of a data set."""

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

MAX_WORST = 5
"""Maximum number of worst objects in a report."""

MIN_PIXELS = 30
"""Minimum number of compared pixels of such an object: a median of fewer describes a rim or a thin edge."""


class Histogram:
    """Counts of values in bins of equal width, the last one open; exact mean, quantiles to the width of a bin."""

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
        """The number of added values."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """The mean of all values; NaN without values."""
        return self._sum / self.count if self.count else float("nan")

    def quantile(self, share: float) -> float:
        """The centre of the bin that contains this quantile, 0..1; NaN without values."""
        if not self.count:
            return float("nan")
        bin_ = int(np.searchsorted(np.cumsum(self.counts), share * self.count))
        return (bin_ + 0.5) * self.width


@dataclass(frozen=True)
class ObjectErrors:
    """Median errors of one object over its compared pixels: millimetres of depth, grey levels of colour."""

    key: str
    label: int
    model: str
    pixels: int
    depth_mm: float
    reduced_depth_mm: float
    color: float


@dataclass
class CheckReport:
    """The findings about one part of a data set.

    Attributes:
        part: name of the part.
        rows: number of rows of the part.
        hash: of the whole data set.
        rejected: number of rejected drafts of scenes, by reason.
        depth_mm, reduced_depth_mm, color: errors of all compared pixels: depth with the raw rotation, depth with the
            symmetry-reduced one, and colour.
        objects: objects per pair.
        visible: pixels per object in the current frame.
        displacement_cm, rotation_deg, raw_rotation_deg: of objects visible in both frames, in the camera frame; in
            rows with a camera motion, only of moving objects.
        movers: moving objects per pair, of rows with a camera motion (`objectflow.dataset.moving_objects`).
        motionless, moving_cameras: number of those pairs without a moving object, and with a moving camera.
        symmetric: number of objects with a symmetry axis, out of `objects_total`.
        worst: the objects with the largest median depth error.
        wrong: contradictions in object tables, each with the key of its row.
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
        """The report as plain JSON values."""
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
    """Verify every hash, then warp every pair by its own depth, poses and motions; one report per part.

    Args:
        folder: the data set.
        limit: maximum number of pairs to check in each part; all hashes are checked in any case.
        report: called after every pair with the name of the part, the number of pairs done, and the total.

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
    """Add one pair to a report."""
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
        if min(mine.sum(), mine_reduced.sum()) >= MIN_PIXELS:
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
    del report.worst[MAX_WORST:]


def _lengths(vectors: list[Float64Array]) -> Float64Array:
    return np.asarray(np.linalg.norm(np.reshape(vectors, (-1, 3)), axis=-1))


def contradictions(row: PairRow) -> list[str]:
    """The contradictions within a row, such as labels without an object, or motions that differ from the poses."""
    found = []
    labels = [obj.label for obj in row.objects]
    if sorted(set(labels)) != labels:
        found.append(f"labels {labels} are not in ascending order")
    for name, image in (("prev", row.prev_labels), ("curr", row.curr_labels)):
        stray = set(np.unique(image).tolist()) - {0} - set(labels)
        if stray:
            found.append(f"{name}_labels contain {sorted(stray)}, the object table does not")
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
            found.append(f"the motion of object {obj.label} differs from that of its poses")
        seen = [bool((image == obj.label).any()) for image in (row.prev_labels, row.curr_labels)]
        if obj.in_both != all(seen) or not any(seen):
            found.append(f"in_both={obj.in_both} of object {obj.label} contradicts the label images")
    return found


def _pairs(folder: Path, part: Part, manifest: Manifest) -> Iterator[PairRow]:
    """The pairs of a part; in sequences, each frame with its predecessor."""
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
