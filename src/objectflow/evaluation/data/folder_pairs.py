"""Real pairs: a folder of pair folders, of which those with a `truth.npz` can be scored.

`truth.npz` holds `labels1` ((H, W) whole numbers, 0 = background, k = k-th object; on the current frame) and
`prev_T_curr` ((K, 4, 4), the motion of each object). Optional are `labels0` (the labels of the previous frame),
`background_prev_T_curr` ((4, 4); by default the camera is static), `names` ((K,)), `centers` ((K, 3) metres),
`moving` ((K,) bool) and `rotation_known` ((K,) bool).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import DatasetError
from objectflow.evaluation.data.truth import PairTruth, TrueObject, make_pair_truth
from objectflow.frame import RgbdFrame
from objectflow.readers.pair import is_pair, open_pair
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.archives import read_archive
from objectflow.typing import BoolMask, Float64Array, LabelImage

TRUTH = "truth.npz"
"""Name of the file with a pair's truth."""

_MAX_BALL_RADIUS, _MAX_BALL_RESIDUAL = 0.06, 0.004
"""Metres: an object is a ball if its visible points fit a sphere up to this radius with at most this RMS residual."""


@dataclass(frozen=True, eq=False)
class FolderPair:
    """A pair of frames, and its truth if there is one."""

    name: str
    prev: RgbdFrame
    curr: RgbdFrame
    truth: PairTruth | None


def find_pairs(folder: str | Path) -> list[Path]:
    """The pair folders in a folder, by name; or the folder itself if it is a pair folder.

    Raises:
        DatasetError: no such folder, or no pair folder in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    if is_pair(folder):
        return [folder]
    pairs = sorted(path for path in folder.iterdir() if path.is_dir() and is_pair(path))
    if not pairs:
        raise DatasetError(f"{folder}: no pair folders in it: each holds color0, depth0, color1, depth1, camera.json")
    return pairs


def read_pairs(
    folder: str | Path, *, with_truth: bool = True, translation_only: Collection[str] = ()
) -> Iterator[FolderPair]:
    """Read the pairs of a folder one by one.

    Args:
        folder: of pair folders.
        with_truth: skip pairs without `truth.npz`.
        translation_only: see `read_pair`.

    Raises:
        DatasetError: no pairs, none with truth if required, or a broken truth.
        ObjectflowError: frames that cannot be read.
    """
    paths = find_pairs(folder)
    if with_truth:
        paths = [path for path in paths if (path / TRUTH).is_file()]
        if not paths:
            raise DatasetError(f"{folder}: none of its pairs has a {TRUTH} to be scored against")
    return (read_pair(path, translation_only=translation_only) for path in paths)


def read_pair(folder: str | Path, *, translation_only: Collection[str] = ()) -> FolderPair:
    """Read one pair folder.

    Only objects that move relative to the background are labelled in the truth; static ones are background. Centres
    that the file does not give are the centre of the fitted sphere for a ball, whose rotation is not observable, and
    otherwise the median of the visible points.

    Args:
        folder: as `readers.pair` describes it, with or without `truth.npz`.
        translation_only: names of objects whose true rotation is too inaccurate for scoring.

    Raises:
        DatasetError: a truth that is broken or does not fit the frames.
        ObjectflowError: frames that cannot be read.
    """
    folder = Path(folder)
    with silence_stderr():  # decoders report damaged images there
        prev, curr = open_pair(folder)
    truth = None
    if (folder / TRUTH).is_file():
        truth = _truth(folder, curr, read_archive(folder / TRUTH), translation_only)
    return FolderPair(folder.name, prev, curr, truth)


def _truth(
    folder: Path, curr: RgbdFrame, arrays: Mapping[str, NDArray[Any]], translation_only: Collection[str]
) -> PairTruth:
    where, shape = folder / TRUTH, curr.depth.shape
    labels = _labels(arrays, "labels1", shape, where)
    before = _labels(arrays, "labels0", shape, where) if "labels0" in arrays else labels
    count = len(_array(arrays, "prev_T_curr", (None, 4, 4), where))
    if labels.max(initial=0) > count:
        raise DatasetError(f"{where}: labels1 goes up to {labels.max()}, prev_T_curr has {count} motions")
    motions = _array(arrays, "prev_T_curr", (count, 4, 4), where)
    if not all(map(geometry.is_rigid, motions)):
        raise DatasetError(f"{where}: prev_T_curr holds a matrix that is not a rigid transform")
    background = None
    if "background_prev_T_curr" in arrays:
        background = _array(arrays, "background_prev_T_curr", (4, 4), where)
        if not geometry.is_rigid(background):
            raise DatasetError(f"{where}: background_prev_T_curr is not a rigid transform")
        if np.array_equal(background, np.eye(4)):
            background = None
    names = [str(name) for name in arrays.get("names", np.full(count, ""))]
    known = _flags(arrays, "rotation_known", count, where)
    centers = _array(arrays, "centers", (count, 3), where) if "centers" in arrays else None
    if len(names) != count:
        raise DatasetError(f"{where}: {len(names)} names for {count} motions")
    points = geometry.back_project(curr.depth, curr.camera)
    objects = []
    for k in range(count):
        seen = points[(labels == k + 1) & curr.valid]
        if len(seen) == 0:  # an object without points cannot be scored
            labels[labels == k + 1] = 0
            continue
        center, is_ball = find_center(seen)
        objects.append(
            TrueObject(
                label=k + 1,
                center=center if centers is None else centers[k],
                prev_T_curr=motions[k],
                axes=np.empty((0, 3)),
                orders=(),
                in_both=bool((before == k + 1).any()),
                rotation_known=bool((known is None or known[k]) and not is_ball and names[k] not in translation_only),
            )
        )
    everything = make_pair_truth(folder.name, curr, labels, objects, background_prev_T_curr=background)
    flags = _flags(arrays, "moving", count, where)
    moving = everything.moving if flags is None else {k + 1 for k in range(count) if flags[k]}
    labels = np.where(np.isin(labels, list(moving)), labels, 0).astype(np.int32)
    kept = [obj for obj in objects if obj.label in moving]
    return make_pair_truth(folder.name, curr, labels, kept, background_prev_T_curr=background, min_displacement=-1.0)


def find_center(points: NDArray[np.floating[Any]]) -> tuple[Float64Array, bool]:
    """The point at which translations of an object are compared, and whether the object is a ball.

    Args:
        points: (N, 3) its visible points, metres.

    Returns:
        (3,) the centre of the ball or the median of the points, metres; True for a ball.
    """
    p = np.asarray(points, dtype=np.float64)
    median = np.median(p, axis=0)
    # Masks drawn by hand include some points of the background.
    near = p[np.linalg.norm(p - median, axis=1) < _MAX_BALL_RADIUS]
    if len(near) < max(20, 0.8 * len(p)):
        return median, False
    # |p - c|^2 = r^2 is linear in c and r^2 - |c|^2. Coordinates relative to the median keep the squares small.
    local = near - median
    (x, y, z, rest), *_ = np.linalg.lstsq(np.c_[2 * local, np.ones(len(local))], (local**2).sum(1), rcond=None)
    center = np.array([x, y, z])
    radius = float(np.sqrt(max(0.0, rest + center @ center)))
    residual = float(np.sqrt(np.mean((np.linalg.norm(local - center, axis=1) - radius) ** 2)))
    if radius < _MAX_BALL_RADIUS and residual < _MAX_BALL_RESIDUAL:
        return median + center, True
    return median, False


def _array(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], where: Path) -> Float64Array:
    if name not in arrays:
        raise DatasetError(f"{where}: {name} is missing; there is: {', '.join(sorted(arrays))}")
    array = arrays[name]
    fits = array.ndim == len(shape) and all(want in (None, n) for want, n in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        wanted = "x".join("K" if n is None else str(n) for n in shape)
        raise DatasetError(f"{where}: {name} must be {wanted} finite numbers, not {array.shape} {array.dtype}")
    return array.astype(np.float64)


def _labels(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...], where: Path) -> LabelImage:
    values = _array(arrays, name, shape, where)
    if arrays[name].dtype.kind not in "iu" or values.min(initial=0) < 0 or values.max(initial=0) > 65535:
        raise DatasetError(f"{where}: {name} must hold whole numbers in 0..65535")
    return values.astype(np.int32)


def _flags(arrays: Mapping[str, NDArray[Any]], name: str, count: int, where: Path) -> BoolMask | None:
    if name not in arrays:
        return None
    flags = arrays[name]
    if flags.shape != (count,) or flags.dtype != np.bool_:
        raise DatasetError(f"{where}: {name} must be {count} truth values, not {flags.shape} {flags.dtype}")
    return np.asarray(flags)
