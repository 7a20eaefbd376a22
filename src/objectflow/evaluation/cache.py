"""Predictions on disk: `predictions/<method>/<key>.npz`, with `settings.json` beside them and failures as JSON.

`<key>.npz`, with the key percent-encoded, holds `key` (JSON), `labels` ((H, W), 0 = background), `flow`, `seconds`,
`cold` (whether it was the first of its process, which loads imports and kernels), `machine`, the objects (`ids,
pixels, scores, moving, centers, motions`) and, where the camera moved, `camera_motion`. `flow` is (3, H, W) int16:
scene flow in steps of 0.1 mm, -32768 where it is missing, as differences to the pixel on the left (modulo 65536),
which takes a fifth of the space of float32; or (H, W, 3) float32 metres where a flow vector exceeds the range of
int16.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import DatasetError, ObjectflowError, ResultError
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.storage import files
from objectflow.storage.archives import read_archive
from objectflow.storage.foreign import located_errors
from objectflow.storage.locked_folder import FolderKind, is_unused, locked_folder, read_settings
from objectflow.typing import Float32Array

STEP = 1e-4
"""Metres: resolution of the stored flow. Rounding changes an end-point error by 0.009 cm at most."""
PREDICTION_FOLDER = FolderKind(
    error=ResultError,
    content="predictions",
    foreign="holds no predictions",
    busy="another run is writing there",
    target="output folder",
)
MAX_NAME = 120
"""Length in characters beyond which the file name of a key ends with a hash in place of the rest."""
_COLUMNS = {"ids": "iu", "pixels": "iu", "scores": "f", "moving": "b", "centers": "f", "motions": "f"}
"""The arrays of the objects, and the kinds of their NumPy types."""
_MISSING = np.iinfo(np.int16).min
_MAX_FLOW = 3.27
"""Metres: largest flow component that int16 holds in units of `STEP`."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """One cached result; `motion.seconds` was measured around the method's call.

    Attributes:
        key: of the pair.
        motion: with the flow rounded to `STEP`.
        cold: whether it was the first of its process.
        machine: where it was computed.
    """

    key: str
    motion: SceneMotion
    cold: bool
    machine: str


def encode(motion: SceneMotion, *, key: str, cold: bool, machine: str) -> bytes:
    """Encode the result of a pair as the bytes of a `.npz` file."""
    objects = motion.objects
    arrays: dict[str, Any] = {
        "key": np.frombuffer(json.dumps(key).encode(), np.uint8),
        "labels": motion.labels.astype(np.min_scalar_type(int(motion.labels.max(initial=0)))),
        "flow": pack_flow(motion.scene_flow),
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
    """Read one `.npz` file.

    Raises:
        DatasetError: the file is incomplete or of another form.
    """
    arrays = read_archive(path)
    with located_errors(DatasetError, f"{path}: not a cached prediction"):
        columns = [_column(arrays, name, kinds) for name, kinds in _COLUMNS.items()]
        objects = tuple(
            ObjectMotion(int(i), int(pixels), float(score), bool(moving), center, prev_T_curr)
            for i, pixels, score, moving, center, prev_T_curr in zip(*columns, strict=True)
        )
        motion = SceneMotion(
            labels=_column(arrays, "labels", "iu").astype(np.int32),
            scene_flow=unpack_flow(arrays["flow"]),
            objects=objects,
            camera_motion=arrays.get("camera_motion"),
            seconds=float(arrays["seconds"]),
        )
        key = json.loads(arrays["key"].tobytes())
        return Prediction(key, motion, bool(arrays["cold"]), str(arrays["machine"]))


def _column(arrays: Mapping[str, NDArray[Any]], name: str, kinds: str) -> NDArray[Any]:
    if arrays[name].dtype.kind not in kinds:
        raise ValueError(f"{name} has the type {arrays[name].dtype}")
    return arrays[name]


class MethodCache:
    """The cached predictions of one method on one set."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextmanager
    def claim(self, settings: Mapping[str, Any]) -> Iterator[None]:
        """Create the folder, or continue an earlier run with the same settings; see `locked_folder`.

        Raises:
            ResultError: other settings, a folder of something else, or another process writes there.
            StorageError: reading or writing failed.
        """
        with locked_folder(self.folder, settings, PREDICTION_FOLDER, check=partial(self._check_same, settings)):
            yield

    def check(self, settings: Mapping[str, Any]) -> None:
        """Check that predictions with these settings may be added to those in the folder.

        Raises:
            ResultError: other settings, or a folder of something else.
        """
        if not is_unused(self.folder):
            self._check_same(settings, read_settings(self.folder, PREDICTION_FOLDER))

    def _check_same(self, settings: Mapping[str, Any], earlier: Mapping[str, Any]) -> None:
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
        """The prediction of a pair; None where it is missing or incomplete."""
        path = self._path(key)
        if not path.is_file():
            return None
        try:
            found = read_prediction(path)
        except ObjectflowError:
            return None
        return found if found.key == key else None

    def has(self, key: str) -> bool:
        """Whether there is a complete prediction of this pair."""
        return self.read(key) is not None

    def failure(self, key: str) -> str | None:
        """The reason why the method failed on a pair; None where no failure is recorded."""
        try:
            failure = json.loads(files.read_bytes(self._failure_path(key)))
            return str(failure["reason"]) if failure["key"] == key else None
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            return None

    def write(self, key: str, data: bytes) -> None:
        """Store the bytes of `encode` and delete an earlier failure.

        Raises:
            StorageError: reading or writing failed.
        """
        files.write_bytes(self._path(key), data)
        with suppress(FileNotFoundError):
            self._failure_path(key).unlink()

    def write_failure(self, key: str, reason: str) -> None:
        """Record why the method failed, and delete an earlier prediction; the next run tries again.

        Raises:
            StorageError: reading or writing failed.
        """
        with suppress(FileNotFoundError):
            self._path(key).unlink()
        files.write_text(self._failure_path(key), json.dumps({"key": key, "reason": reason}) + "\n")

    def _path(self, key: str) -> Path:
        return self.folder / f"{file_name(key)}.npz"

    def _failure_path(self, key: str) -> Path:
        return self.folder / f"{file_name(key)}.failed.json"


def file_name(key: str) -> str:
    """A key as part of a file name, different for different keys; keys of sequences contain a slash."""
    name = quote(key, safe="", errors="surrogatepass")
    if len(name) <= MAX_NAME:
        return name
    return f"{name[: MAX_NAME // 2]}~{hashlib.sha256(name.encode()).hexdigest()}"


def pack_flow(flow: Float32Array) -> NDArray[Any]:
    """(H, W, 3) scene flow in metres -> the stored form; pixels with any non-finite component become missing."""
    missing = ~np.isfinite(flow).all(axis=-1)
    known = flow.copy()
    known[missing] = 0
    if np.abs(known).max(initial=0) > _MAX_FLOW:
        known[missing] = np.nan
        return known
    steps = np.rint(known / np.float32(STEP)).astype(np.int16)
    steps[missing] = _MISSING
    planes = np.ascontiguousarray(steps.transpose(2, 0, 1))
    return np.diff(planes, axis=2, prepend=np.int16(0))  # wraps around, as does the sum in `unpack_flow`


def unpack_flow(packed: NDArray[Any]) -> Float32Array:
    """The inverse of `pack_flow`, up to rounding to `STEP`; missing flow is NaN.

    Raises:
        ValueError: an array of another form.
    """
    if packed.dtype == np.float32:
        return packed
    if packed.dtype != np.int16 or packed.ndim != 3:
        raise ValueError(f"its flow is {packed.shape} {packed.dtype}")
    steps = np.cumsum(packed, axis=2, dtype=np.int16).transpose(1, 2, 0)
    flow = steps.astype(np.float32) * np.float32(STEP)
    flow[steps == _MISSING] = np.nan
    return np.ascontiguousarray(flow)


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else f"{text[:97]}..."
