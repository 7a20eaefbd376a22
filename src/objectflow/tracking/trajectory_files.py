"""Trajectories on disk: one file per object in TUM format, and `tracks.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.storage import files
from objectflow.tracking.track import Track
from objectflow.tracking.tracker import Tracker
from objectflow.typing import Float64Array

TRACKS = "tracks.json"
TRAJECTORIES = "trajectories"
STATIC_TOLERANCE = 1e-9
"""Largest deviation of a static camera's pose from the identity, per matrix entry."""


def write_tracks(folder: Path, tracker: Tracker) -> None:
    """Write `tracks.json`, `trajectories/object_001.txt` etc., and `trajectories/camera.txt` if the camera moved.

    Args:
        folder: must exist; files of these names are replaced.
        tracker: after the last pair.

    Raises:
        StorageError: a file cannot be written.
    """
    trajectories: dict[str, str] = {}
    if any(np.abs(pose - np.eye(4)).max() > STATIC_TOLERANCE for pose in tracker.world_T_camera):
        trajectories["camera.txt"] = tum_lines(tracker.camera_times, tracker.world_T_camera)
    for track in tracker.tracks:
        trajectories[f"object_{track.id:03d}.txt"] = tum_lines(track.times, track.world_T_object)
    with files.new_folder(folder / TRAJECTORIES, replace=True) as temporary:
        for name, text in trajectories.items():
            files.write_text(temporary / name, text)
    content = {"frame": "world = camera of the first frame", "tracks": [_to_dict(track) for track in tracker.tracks]}
    files.write_text(folder / TRACKS, json.dumps(content, indent=2) + "\n")


def tum_lines(times: Sequence[float], poses: Sequence[Float64Array]) -> str:
    """Format a trajectory as `timestamp tx ty tz qx qy qz qw` lines, the format of the TUM RGB-D benchmark's tools.

    Args:
        times: seconds, or frame numbers.
        poses: one (4, 4) per time, metres.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(times, poses, strict=True):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)]
        lines.append(f"{time:.6f} " + " ".join(f"{number:.7f}" for number in numbers))
    return "\n".join(lines) + "\n"


def _to_dict(track: Track) -> dict[str, Any]:
    return {
        "id": track.id,
        "times": track.times,
        "labels": track.labels,
        "scores": track.scores,
        "gaps": track.gaps,
        "merged": track.merged,
        "world_T_object": [pose.tolist() for pose in track.world_T_object],
    }
