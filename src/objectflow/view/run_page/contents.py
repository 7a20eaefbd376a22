"""What the report of a run is made of, and the steps of each track."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.tracking.track import Track
from objectflow.typing import Float64Array, LabelImage


class ReportFrame(NamedTuple):
    """One frame of a run.

    Attributes:
        number: in the source.
        time: as in the tracks: seconds, or the number of the frame.
        part: number of the part of the run; each part has its own world.
        pair: folder of the pair that ends with this frame; empty for the first frame of a part.
    """

    number: int
    time: float
    part: int
    pair: str = ""


@dataclass(frozen=True, eq=False)
class RunContents:
    """A finished run.

    Attributes:
        folder: of the run, in which the report is written; all links are relative to it.
        title: name of the source.
        facts: about the run, for display; without measured durations, so that a continued run has the same.
        notes: lines about the source and about new worlds.
        frames: in order.
        tracks: in order of id.
        has_times: whether times are seconds.
        models: the content of `models/index.json`; empty without models.
        read_frame: colour and depth by number.
        read_known: (H, W) int32 track ids by folder of a pair, 0 beside the objects.
    """

    folder: Path
    title: str
    facts: Sequence[str]
    notes: Sequence[str]
    frames: Sequence[ReportFrame]
    tracks: Sequence[Track]
    has_times: bool
    read_frame: Callable[[int], RgbdFrame]
    read_known: Callable[[str], LabelImage]
    models: Mapping[str, Any] = field(default_factory=dict)

    def part_of(self, track: Track) -> int:
        """The part in which a track lies.

        Times may repeat where a clock was set back, so the first part that has all times of the track is taken.
        """
        times = {part: {frame.time for frame in self.part(part)} for part in range(self.frames[-1].part + 1)}
        return next((part for part, known in times.items() if set(track.times) <= known), 0)

    def part(self, number: int) -> list[ReportFrame]:
        """The frames of one part."""
        return [frame for frame in self.frames if frame.part == number]

    def model(self, number: int) -> Mapping[str, Any] | None:
        """The entry of an object in the index of models; None without a model."""
        return next((entry for entry in self.models.get("objects", ()) if entry["id"] == number), None)


class Step(NamedTuple):
    """A motion of a track between two consecutive frames.

    Attributes:
        start, end: times.
        score: of the estimate, 0..1.
        shift: metres, of the origin of the object frame.
    """

    start: float
    end: float
    score: float
    shift: float


def steps(track: Track) -> list[Step]:
    """The moving steps of a track; the times between them are rests."""
    found = []
    for k in range(1, len(track.times)):
        # A step that only the model shows has no label.
        if track.labels[k] or not np.array_equal(track.world_T_object[k], track.world_T_object[k - 1]):
            shift = float(np.linalg.norm(track.world_T_object[k][:3, 3] - track.world_T_object[k - 1][:3, 3]))
            found.append(Step(track.times[k - 1], track.times[k], track.scores[k], shift))
    return found


def path_length(track: Track) -> float:
    """Metres: length of the path of the object frame's origin."""
    return sum(step.shift for step in steps(track))


def net_motion(track: Track) -> tuple[float, float]:
    """Displacement of the object frame's origin, metres, and rotation, degrees, from the first to the last pose."""
    first, last = track.world_T_object[0], track.world_T_object[-1]
    turn = float(np.degrees(geometry.rotation_angle(first[:3, :3].T @ last[:3, :3])))
    return float(np.linalg.norm(last[:3, 3] - first[:3, 3])), turn


def pose_at(times: Sequence[float], poses: Sequence[Float64Array], time: float) -> Float64Array | None:
    """(4, 4) the last pose up to a time; None before the first."""
    before = [pose for known, pose in zip(times, poses, strict=True) if known <= time]
    return before[-1] if before else None


def model_poses(track: Track, entry: Mapping[str, Any] | None) -> list[Float64Array]:
    """The poses of a track, corrected by the registration of its model.

    Args:
        track: its poses are chained motions, so that a correction holds for all later ones.
        entry: of the index of models, with the registered poses; None for none.

    Returns:
        (4, 4) `world_T_object` at each time of the track.
    """
    if entry is None:
        return list(track.world_T_object)
    registered = {
        float(time): np.array(pose, dtype=np.float64).reshape(4, 4)
        for time, pose in zip(entry["times"], entry["world_T_object"], strict=True)
    }
    poses, correction = [], np.eye(4)
    for time, pose in zip(track.times, track.world_T_object, strict=True):
        if time in registered:
            correction = geometry.inverse(pose) @ registered[time]
        poses.append(pose @ correction)
    return poses
