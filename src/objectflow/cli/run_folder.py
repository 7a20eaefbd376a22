"""The folder of an `objectflow run`: its source, its pairs and its tracks, read back."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.errors import ReaderError, ResultError
from objectflow.motion import SceneMotion
from objectflow.readers import CameraOptions, FrameSource, open_source
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors, located_errors
from objectflow.storage.image_files import read_image
from objectflow.storage.images import encode_png
from objectflow.storage.locked_folder import SETTINGS, FolderKind
from objectflow.storage.temporaries import sweep
from objectflow.tracking.model_files import INDEX, MODELS
from objectflow.tracking.reconstruction import SequenceView
from objectflow.tracking.track import Track, next_camera_pose
from objectflow.tracking.trajectory_files import TRACKS
from objectflow.typing import LabelImage
from objectflow.view.run_page.contents import model_poses

RUN_FOLDER = FolderKind(
    error=ResultError,
    content="a run",
    foreign="is no earlier run",
    busy="another run is writing there",
    target="output folder",
)
KNOWN = "known.png"
"""File of a pair's known objects: a 16-bit image of track ids, 0 beside them."""
NOTES = "notes.txt"
"""File of the notes on the source and of the frames that were left out; absent if there are none."""
LONGER_NAME = re.compile(r"since_(\d+)")
"""Folder in that of a pair: the result between an older frame, whose number it has, and the pair's current frame."""
PAIR_NAME = re.compile(r"pair_(\d+)_(\d+)")


def run_pairs(run: Path) -> list[tuple[int, int, Path]]:
    """Previous frame, current frame and folder of each finished pair of a run, in order.

    Raises:
        ResultError: there is none.
    """
    pairs = sorted(
        (int(match[1]), int(match[2]), folder)
        for folder in run.iterdir()
        if (match := PAIR_NAME.fullmatch(folder.name))
    )
    if not pairs:
        raise ResultError(f"{run}: the run has no finished pair")
    return pairs


def open_run_source(run: Path, source: Path | None, option: str) -> FrameSource:
    """Open the frames of a run with the run's settings.

    Args:
        run: the folder.
        source: where the frames lie now; None for where they lay during the run.
        option: of the command line that states the source, for messages.

    Raises:
        ResultError: the settings are damaged.
        ReaderError: the frames do not exist.
    """
    with located_errors(ResultError, f"{run / SETTINGS}: not the settings of a run"):
        settings = json.loads(files.read_bytes(run / SETTINGS))
        path = Path(settings["source"])
        color_topic, depth_topic = settings.get("topics") or (None, None)
        options = _options(settings)
    path = path if source is None else source
    if not path.exists():
        raise ReaderError(f"{path}: the run's frames do not exist any more: give their path by {option} SOURCE")
    return open_source(path, options, color_topic=color_topic, depth_topic=depth_topic)


def read_tracks(run: Path) -> list[Track]:
    """The tracks in `tracks.json`.

    Raises:
        ResultError: the file is missing or damaged.
    """
    path = run / TRACKS
    if not os.path.exists(path):
        raise ResultError(f"{path} is missing: the run is not finished; the same `objectflow run` goes on")
    with foreign_errors(ResultError, f"{path}: not the tracks of a run"):
        return [_track(values) for values in json.loads(files.read_bytes(path))["tracks"]]


def run_views(source: FrameSource, pairs: list[tuple[int, int, Path]]) -> Iterator[SequenceView]:
    """Current frame, labels and camera pose of each pair whose camera motion is known.

    The world of a part is the camera of its first frame; a part ends at a cut, and where the camera was lost.

    Raises:
        ResultError: a pair is damaged, or the source has changed.
    """
    part, last = 0, None
    world_T_camera = np.eye(4)
    for prev, curr, folder in pairs:
        if max(prev, curr) >= len(source):
            raise ResultError(f"{folder}: its source has only {len(source)} frames now: the source has changed")
        motion = SceneMotion.load(folder)
        pose = next_camera_pose(world_T_camera, motion)
        if last is not None and (prev != last or pose is None):
            part, world_T_camera = part + 1, np.eye(4)
            pose = next_camera_pose(world_T_camera, motion)
        last = curr
        if pose is None:
            continue
        world_T_camera = pose
        frame, time = source[curr], source.timestamp(curr)
        if frame.depth.shape != motion.labels.shape:
            raise ResultError(f"{folder}: its labels do not fit the frames of the source: the source has changed")
        # A run of an earlier version has no known objects.
        known = read_known(folder) if (folder / KNOWN).is_file() else None
        if known is not None and known.shape != motion.labels.shape:
            raise ResultError(f"{folder}: its known objects do not fit its labels: the run is damaged")
        when = float(curr) if time is None else time
        yield SequenceView(curr, part, when, frame, motion.labels, world_T_camera, known)


def read_known(pair: Path) -> LabelImage:
    """(H, W) int32 track ids of the known objects in the current frame of a pair.

    Raises:
        ReaderError: the image is missing or damaged.
    """
    return np.asarray(read_image(pair / KNOWN), dtype=np.int32)


def write_known(pair: Path, known: LabelImage) -> None:
    """Replace `known.png` in the folder of a pair, if it is another image.

    Raises:
        StorageError: it cannot be written.
    """
    data = encode_png(known.astype(np.uint16))
    if files.read_bytes(pair / KNOWN) != data:
        sweep(pair)  # what an interrupted run left
        files.write_bytes(pair / KNOWN, data)


def write_longer(pair: Path, older: int, motion: SceneMotion) -> None:
    """Write the result between an older frame of this number and the current frame into the new folder of a pair."""
    folder = pair / f"since_{older:06d}"
    folder.mkdir()
    motion.write_into(folder)


def read_longer(pair: Path) -> tuple[int, SceneMotion] | None:
    """The number and the result of what `write_longer` wrote; None where it wrote nothing.

    Raises:
        ResultError: the result is damaged.
    """
    for folder in sorted(pair.iterdir()):
        if match := LONGER_NAME.fullmatch(folder.name):
            return int(match[1]), SceneMotion.load(folder)
    return None


def read_model_index(run: Path) -> dict[str, Any]:
    """The content of `models/index.json`; empty for a run without models.

    Raises:
        ResultError: the file is damaged.
    """
    path = run / MODELS / INDEX
    return _read_table(path) if path.is_file() else {}


def read_settings(run: Path) -> dict[str, Any]:
    """The content of `settings.json`.

    Raises:
        ResultError: the file is missing or damaged.
    """
    return _read_table(run / SETTINGS)


def model_files(run: Path) -> dict[int, Path]:
    """The binary glTF file of each object with a model, by track id.

    Raises:
        ResultError: the index of the models is damaged.
    """
    return {int(entry["id"]): run / MODELS / entry["files"][1] for entry in read_model_index(run).get("objects", ())}


def registered_track(track: Track, index: dict[str, Any]) -> Track:
    """A track with the registered poses of its model, if `models/index.json` has one."""
    entry = next((entry for entry in index.get("objects", ()) if entry["id"] == track.id), None)
    return replace(track, world_T_object=model_poses(track, entry))


def _read_table(path: Path) -> dict[str, Any]:
    with foreign_errors(ResultError, f"{path}: cannot be read"):
        content = json.loads(files.read_bytes(path))
    if not isinstance(content, dict):
        raise ResultError(f"{path}: not a file of a run")
    return content


def _track(values: dict[str, Any]) -> Track:
    track = Track(
        int(values["id"]),
        [float(time) for time in values["times"]],
        [np.array(pose, dtype=np.float64).reshape(4, 4) for pose in values["world_T_object"]],
        [int(label) for label in values["labels"]],
        [float(score) for score in values["scores"]],
        [float(time) for time in values["gaps"]],
        merged=[int(number) for number in values.get("merged", ())],
    )
    lengths = {len(track.times), len(track.world_T_object), len(track.labels), len(track.scores)}
    if len(lengths) > 1:
        raise ValueError("its lists have different lengths")
    poses = [pose.ravel() for pose in track.world_T_object]
    if not np.isfinite(np.concatenate([track.times, track.scores, track.gaps, *poses])).all():
        raise ValueError("it holds numbers that are not finite")
    return track


def _options(settings: dict[str, Any]) -> CameraOptions:
    if "options" in settings:
        return CameraOptions.from_dict(settings["options"])
    camera = settings["intrinsics"]
    intrinsics = (float(camera["fx"]), float(camera["fy"]), float(camera["cx"]), float(camera["cy"]))
    return CameraOptions(intrinsics=intrinsics, depth_scale=float(settings["depth_scale"]))
