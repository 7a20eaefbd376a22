"""Predictions on disk: `predictions/<method>/<key>.npz`, `settings.json` beside them, failures as JSON.

`<key>.npz` holds `labels` ((H, W), 0 = background), `flow`, `seconds`, `cold` (whether it was a process's first, with
imports and kernels to load), `machine`, the objects (`ids, pixels, scores, moving, centers, motions`) and, where the
camera moved, `camera_motion`. `flow` is (3, H, W) int16: scene flow in steps of 0.1 mm, -32768 where there is none, as
differences to the pixel on the left (modulo 65536), which is a fifth of the size of float32; or (H, W, 3) float32
metres where a flow is longer than int16 can say.
"""

from __future__ import annotations

import fcntl
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import DatasetError, ObjectflowError, ResultError, StorageError
from objectflow.evaluation.data.archives import BROKEN, read_archive
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.storage import files
from objectflow.typing import Float32Array

SETTINGS = "settings.json"
STEP = 1e-4
"""Metres. Rounding to it changes an end point error by 0.009 cm at most."""
_NONE = np.iinfo(np.int16).min
_LONGEST = 3.27
"""Metres that int16 can say."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One cached result; `motion.seconds` was measured around the method's call.

    Attributes:
        motion: with the flow as it was rounded.
        cold: the first of its process.
        machine: that it was made on.
    """

    motion: SceneMotion
    cold: bool
    machine: str


def encode(motion: SceneMotion, *, cold: bool, machine: str) -> bytes:
    """The bytes of a `.npz` file."""
    objects = motion.objects
    arrays: dict[str, Any] = {
        "labels": motion.labels.astype(np.min_scalar_type(int(motion.labels.max(initial=0)))),
        "flow": _pack(motion.scene_flow),
        "seconds": np.float64(motion.seconds),
        "cold": np.bool_(cold),
        "machine": np.str_(machine),
        "ids": np.array([obj.id for obj in objects], np.int32),
        "pixels": np.array([obj.pixels for obj in objects], np.int64),
        "scores": np.array([obj.score for obj in objects], np.float64),
        "moving": np.array([obj.moving for obj in objects], np.bool_),
        "centers": np.array([obj.center for obj in objects], np.float64).reshape(-1, 3),
        "motions": np.array([obj.prev_T_curr for obj in objects], np.float64).reshape(-1, 4, 4),
    }
    if motion.camera_motion is not None:
        arrays["camera_motion"] = motion.camera_motion
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def read_prediction(path: Path) -> Prediction:
    """Read one file.

    Raises:
        DatasetError: it is not whole, or not of this form.
    """
    arrays = read_archive(path)
    try:
        columns = [arrays[name] for name in ("ids", "pixels", "scores", "moving", "centers", "motions")]
        objects = tuple(
            ObjectMotion(int(i), int(pixels), float(score), bool(moving), center, prev_T_curr)
            for i, pixels, score, moving, center, prev_T_curr in zip(*columns, strict=True)
        )
        motion = SceneMotion(
            labels=arrays["labels"].astype(np.int32),
            scene_flow=_unpack(arrays["flow"]),
            objects=objects,
            camera_motion=arrays.get("camera_motion"),
            seconds=float(arrays["seconds"]),
        )
        return Prediction(motion, bool(arrays["cold"]), str(arrays["machine"]))
    except (ObjectflowError, *BROKEN) as error:
        raise DatasetError(f"{path}: not a cached prediction: {error}") from error


class MethodCache:
    """The cached predictions of one method on one set."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextmanager
    def claim(self, settings: Mapping[str, Any]) -> Iterator[None]:
        """Make the folder, or take up an earlier run's with the same settings; hold it for this process.

        Raises:
            ResultError: other settings, no cache at all, or another process writes there.
            StorageError: the disk refused.
        """
        if not self.folder.is_dir() or not any(self.folder.iterdir()):
            with files.new_folder(self.folder) as folder:
                files.write_text(folder / SETTINGS, json.dumps(settings, indent=2) + "\n")
        self.check(settings)
        try:
            with open(self.folder / SETTINGS) as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise ResultError(
                        f"{self.folder}: another run is writing there: wait, or name another output folder"
                    ) from None
                for leftover in self.folder.glob(".*.tmp"):
                    with suppress(OSError):
                        leftover.unlink()
                yield
        except OSError as error:
            raise StorageError(f"cannot write {self.folder}: {error.strerror or error}") from error

    def check(self, settings: Mapping[str, Any]) -> None:
        """Check that predictions with these settings may be added to what is there, if anything is.

        Raises:
            ResultError: other settings, or a folder of something else.
        """
        path = self.folder / SETTINGS
        if not self.folder.is_dir() or not any(self.folder.iterdir()):
            return
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ResultError(f"{self.folder} exists and holds no predictions: name another output folder") from None
        except (OSError, ValueError) as error:
            raise ResultError(f"{path}: cannot be read: {error}") from error
        if not isinstance(earlier, dict):
            raise ResultError(f"{path}: not the settings of predictions")
        if earlier.get("sha256") != settings.get("sha256"):
            raise ResultError(
                f"{self.folder} holds predictions of another data set (sha256 {str(earlier.get('sha256'))[:12]}, "
                f"this one's is {str(settings.get('sha256'))[:12]}): name another output folder"
            )
        for name in {**settings, **earlier}:
            if earlier.get(name) != settings.get(name):
                raise ResultError(
                    f"{self.folder} was made with {name} = {_short(earlier.get(name))}, now it is "
                    f"{_short(settings.get(name))}: name another output folder"
                )

    def read(self, key: str) -> Prediction | None:
        """The prediction of a pair; None where there is none that is whole."""
        path = self._path(key)
        if not path.is_file():
            return None
        try:
            return read_prediction(path)
        except DatasetError:
            return None

    def has(self, key: str) -> bool:
        """Whether there is a prediction of this pair that is whole."""
        return self.read(key) is not None

    def failure(self, key: str) -> str | None:
        """Why the method failed on a pair; None where it did not, as far as is known."""
        try:
            return str(json.loads(self._failure_path(key).read_text(encoding="utf-8"))["reason"])
        except (OSError, ValueError, LookupError, TypeError):
            return None

    def write(self, key: str, data: bytes) -> None:
        """Store what `encode` made; an earlier failure is forgotten.

        Raises:
            StorageError: the disk refused.
        """
        files.write_bytes(self._path(key), data)
        with suppress(FileNotFoundError):
            self._failure_path(key).unlink()

    def write_failure(self, key: str, reason: str) -> None:
        """Store why the method failed, for the scores; the next run tries again.

        Raises:
            StorageError: the disk refused.
        """
        with suppress(FileNotFoundError):
            self._path(key).unlink()
        files.write_text(self._failure_path(key), json.dumps({"key": key, "reason": reason}) + "\n")

    def _path(self, key: str) -> Path:
        return self.folder / f"{file_name(key)}.npz"

    def _failure_path(self, key: str) -> Path:
        return self.folder / f"{file_name(key)}.failed.json"


def file_name(key: str) -> str:
    """A key as part of a file's name: keys of sequences have a slash."""
    return key.replace("/", "_")


def _pack(flow: Float32Array) -> NDArray[Any]:
    missing = ~np.isfinite(flow).all(axis=-1)
    known = flow.copy()
    known[missing] = 0
    if np.abs(known).max(initial=0) > _LONGEST:
        known[missing] = np.nan
        return known
    steps = np.rint(known / np.float32(STEP)).astype(np.int16)
    steps[missing] = _NONE
    planes = np.ascontiguousarray(steps.transpose(2, 0, 1))
    return np.diff(planes, axis=2, prepend=np.int16(0))  # wraps around, and so does the sum that undoes it


def _unpack(packed: NDArray[Any]) -> Float32Array:
    if packed.dtype == np.float32:
        return packed
    if packed.dtype != np.int16 or packed.ndim != 3:
        raise ValueError(f"its flow is {packed.shape} {packed.dtype}")
    steps = np.cumsum(packed, axis=2, dtype=np.int16).transpose(1, 2, 0)
    flow = steps.astype(np.float32) * np.float32(STEP)
    flow[steps == _NONE] = np.nan
    return np.ascontiguousarray(flow)


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
