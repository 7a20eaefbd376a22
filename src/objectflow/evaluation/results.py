"""The results of `objectflow evaluate` as plain data, from which the tables and the report are made."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from objectflow import geometry
from objectflow.errors import DatasetError, StorageError
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.metrics.pair_score import PairScore
from objectflow.evaluation.tables.summary import Summary
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.storage import files
from objectflow.storage.serialize import from_plain, to_plain
from objectflow.typing import Float64Array

FORMAT = 3
"""Version of `results.json`; other versions are refused."""


@dataclass(frozen=True, eq=False)
class EvaluationPair:
    """The frames of one pair and their truth."""

    prev: RgbdFrame
    curr: RgbdFrame
    truth: PairTruth


class PairSource(Protocol):
    """Frames, truth and cached predictions of an evaluation, read from disk on request."""

    def pair(self, key: str) -> EvaluationPair:
        """The pair of this key.

        Raises:
            DatasetError: no such pair, or one that cannot be read.
        """
        ...

    def prediction(self, label: str, key: str) -> SceneMotion | None:
        """The result of the method with this label (`MethodResult.label`) for the pair; None if it failed."""
        ...


@dataclass(frozen=True)
class ObjectFacts:
    """True properties of one object, independent of any method.

    Attributes:
        label: in the true labels of the current frame.
        pixels: number of its pixels in the current frame.
        displacement_cm: of its centre in the world, without the motion of the camera.
        rotation_deg: of its motion in the world, reduced by symmetry; NaN if only the translation is known.
        symmetric: whether it has a symmetry axis.
        moving: whether it moves relative to the background.
        in_both: whether it is visible in both frames; only such objects are in the masked columns.
    """

    label: int
    pixels: int
    displacement_cm: float
    rotation_deg: float
    symmetric: bool
    moving: bool
    in_both: bool


@dataclass(frozen=True)
class PairFacts:
    """True properties of one pair, for the breakdowns; `objects` are those visible in the current frame."""

    key: str
    scene: str
    width: int
    height: int
    objects: tuple[ObjectFacts, ...]

    @property
    def number(self) -> int:
        """Number of objects visible in the current frame."""
        return len(self.objects)

    @property
    def displacement_cm(self) -> float:
        """Mean over the objects visible in both frames; NaN if there are none."""
        return self._mean(lambda obj: obj.displacement_cm)

    @property
    def rotation_deg(self) -> float:
        """Mean over the objects visible in both frames whose rotation is known; NaN if there are none."""
        return self._mean(lambda obj: obj.rotation_deg)

    @property
    def visible_pixels(self) -> float:
        """Mean number of pixels of the objects visible in both frames; NaN if there are none."""
        return self._mean(lambda obj: obj.pixels)

    @property
    def symmetric_share(self) -> float:
        """Share of symmetric objects among those visible in both frames, 0..1; NaN if there are none."""
        return self._mean(lambda obj: obj.symmetric)

    def _mean(self, of: Callable[[ObjectFacts], float]) -> float:
        values = [float(of(obj)) for obj in self.objects if obj.in_both]
        known = [value for value in values if not math.isnan(value)]
        return sum(known) / len(known) if known else math.nan


@dataclass(frozen=True)
class Failure:
    """A pair on which a method failed, and the reason in one line."""

    key: str
    reason: str


@dataclass(frozen=True)
class MethodResult:
    """The results of one method on the set.

    Attributes:
        label: its name in the tables, unique in an evaluation.
        method: its name in `objectflow methods`, or that of an oracle.
        options: the options given to it.
        oracle: whether it is given the truth and thus not a competitor.
        summary: of `scores`; None if every pair failed.
        failures: pairs without a score, in the set's order.
        scores: in the set's order.
    """

    label: str
    method: str
    options: dict[str, Any]
    oracle: bool
    summary: Summary | None
    failures: tuple[Failure, ...]
    scores: tuple[PairScore, ...]

    def score(self, key: str) -> PairScore | None:
        """The score of one pair; None if the method failed."""
        return next((score for score in self.scores if score.key == key), None)


@dataclass(frozen=True)
class Evaluation:
    """Results of methods on one set of pairs.

    Attributes:
        data: the set's name, without a path: "tiny", or the name of the folder.
        kind: "pairs" or "sequences" of a generated set (frames 20 and 80 of each sequence, as in the paper),
            "consecutive" (all consecutive frames of its sequences), or "real" (pair folders).
        split: of a generated set, otherwise "".
        sha256: of the set's content.
        total: number of pairs in the whole set, of which `pairs` are the first.
        machine: where the scores were computed; that of each method is in `summary.runtime.machine`.
        version: of objectflow.
        pairs: the evaluated pairs, in order.
        methods: in the order in which they were given.
    """

    data: str
    kind: str
    split: str
    sha256: str
    total: int
    machine: str
    version: str
    pairs: tuple[PairFacts, ...]
    methods: tuple[MethodResult, ...]

    def method(self, label: str) -> MethodResult:
        """The method of this label.

        Raises:
            KeyError: no such method.
        """
        return {method.label: method for method in self.methods}[label]

    def to_json(self) -> str:
        """The evaluation as JSON; NaN becomes null."""
        return json.dumps({"format": FORMAT, **to_plain(self)}, separators=(",", ":"), allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str, *, where: str = "results") -> Evaluation:
        """The inverse of `to_json`.

        Raises:
            DatasetError: text that `to_json` did not write; the message starts with `where`.
        """
        try:
            values = json.loads(text)
            if values["format"] != FORMAT:
                raise ValueError(f"its format is {values['format']!r}, this program reads {FORMAT}")
            return from_plain(cls, values)
        except KeyError as error:
            raise DatasetError(f"{where}: not the results of an evaluation: {error} is missing") from error
        except (TypeError, ValueError, AttributeError, RecursionError) as error:
            raise DatasetError(f"{where}: not the results of an evaluation: {error}") from error

    def write(self, path: Path) -> None:
        """Write `results.json` atomically.

        Raises:
            StorageError: the file cannot be written.
        """
        files.write_text(path, self.to_json())

    @classmethod
    def read(cls, path: Path) -> Evaluation:
        """Read a file of `write`.

        Raises:
            DatasetError: no such file, or another kind of file.
            StorageError: the file cannot be read.
        """
        try:
            text = files.read_bytes(path).decode()
        except FileNotFoundError:
            raise DatasetError(f"{path}: no such file") from None
        except UnicodeDecodeError as error:
            raise DatasetError(f"{path}: not the results of an evaluation: {error}") from error
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
        return cls.from_json(text, where=str(path))


def facts_of(truth: PairTruth) -> PairFacts:
    """The true properties of a pair that the breakdowns need."""
    height, width = truth.labels.shape
    pixels = np.bincount(truth.labels.ravel())
    camera = truth.background_prev_T_curr
    curr_T_prev = np.eye(4) if camera is None else geometry.inverse(camera)
    return PairFacts(
        key=truth.key,
        scene=truth.scene,
        width=width,
        height=height,
        objects=tuple(
            ObjectFacts(
                label=obj.label,
                pixels=int(pixels[obj.label]),
                displacement_cm=100 * _displacement(curr_T_prev @ obj.prev_T_curr, obj.center),
                rotation_deg=_angle_deg(curr_T_prev @ obj.prev_T_curr) if obj.rotation_known else math.nan,
                symmetric=len(obj.orders) > 0,
                moving=obj.label in truth.moving,
                in_both=obj.in_both,
            )
            for obj in truth.objects
        ),
    )


def _displacement(prev_T_curr: Float64Array, center: Float64Array) -> float:
    return float(np.linalg.norm(geometry.transform(prev_T_curr, center) - center))


def _angle_deg(prev_T_curr: Float64Array) -> float:
    return math.degrees(float(geometry.rotation_angle(prev_T_curr[:3, :3])))
