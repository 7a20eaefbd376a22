"""Which methods to evaluate, as they are named on the command line; the oracles among them see the truth."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

from objectflow.errors import MethodError
from objectflow.evaluation.data.truth import PairTruth
from objectflow.evaluation.oracles.oracle_masks import OracleMasks
from objectflow.evaluation.oracles.oracle_motion import OracleMotion
from objectflow.frame import RgbdFrame
from objectflow.methods.base import Estimator, check_camera_option
from objectflow.methods.moving_camera import MovingCamera
from objectflow.methods.registry import METHODS, load
from objectflow.motion import SceneMotion
from objectflow.storage.files import hash_file
from objectflow.storage.serialize import to_plain

ORACLES: dict[str, str] = {
    "oracle-masks": "true masks with our rigid fit",
    "oracle-motion": "true motions with our grouping",
}


@runtime_checkable
class SequenceEstimator(Protocol):
    """An estimator that can use more than two frames; where a set has sequences, it is given them."""

    def estimate_in_sequence(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> SceneMotion:
        """The motion from `frames[curr]` back to `frames[prev]`, on the pixels of `frames[curr]`."""
        ...


@dataclass(frozen=True)
class MethodSpec:
    """A method with its options.

    Attributes:
        label: its name in the tables.
        name: of `METHODS` or `ORACLES`.
        options: given to it.
        settings: every option with its value, defaults included; files by their hash.
    """

    label: str
    name: str
    options: dict[str, Any]
    settings: dict[str, Any]

    @property
    def oracle(self) -> bool:
        """Whether it sees the truth."""
        return self.name in ORACLES

    @property
    def folder(self) -> str:
        """The label as a folder's name."""
        return re.sub(r"[^\w.=,+-]", "_", self.label)

    def make(self, truth: PairTruth | None = None) -> Estimator:
        """The estimator; an oracle needs the truth of its pair.

        Raises:
            ObjectflowError: the method cannot be made.
        """
        return _make(self.name, self.options, truth)


def parse_methods(texts: Sequence[str], *, camera: str = "auto") -> list[MethodSpec]:
    """Read `name`, `name:option=value,option=value` or `label=name:...`; each method is made once, to be sure it can.

    Args:
        texts: one a method.
        camera: given to every method that does not name its own.

    Raises:
        MethodError: no methods, one that is not known, an option it does not have, or two of one label.
        ObjectflowError: a method that cannot be made.
    """
    if not texts:
        raise MethodError(f"no methods to evaluate: name some of {', '.join(_known())}")
    check_camera_option(camera)
    specs = [parse_method(text, camera=camera) for text in texts]
    for spec in specs:
        if sum(other.folder == spec.folder for other in specs) > 1:
            raise MethodError(f"two methods are called {spec.label!r}: give one a label of its own, LABEL=NAME:...")
    return specs


def parse_method(text: str, *, camera: str = "auto") -> MethodSpec:
    """Read one method; see `parse_methods`."""
    head, _, tail = text.partition(":")
    label, equals, name = head.rpartition("=")
    if equals and not label.strip():
        raise MethodError(f"{text!r}: there is no label before '='")
    if name not in METHODS and name not in ORACLES:
        raise MethodError(f"unknown method {name!r}: choose of {', '.join(_known())}")
    options: dict[str, Any] = {}
    for word in filter(None, tail.split(",")):
        key, equals, value = word.partition("=")
        if not equals or not key:
            raise MethodError(f"{text!r}: options are written NAME:OPTION=VALUE,OPTION=VALUE, not {word!r}")
        options[key] = _value(value)
    if name != "oracle-motion":
        options.setdefault("camera", camera)
    try:
        made = _make(name, options, None)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{text!r}: an option has a value that the method cannot use: {error}") from error
    shown = {key: value for key, value in options.items() if (key, value) != ("camera", "auto")}
    return MethodSpec(label.strip() or text, name, shown, _settings(made, options))


def _make(name: str, options: Mapping[str, Any], truth: PairTruth | None) -> Estimator:
    if name not in ORACLES:
        return load(name, **options)
    oracle: Any = OracleMasks if name == "oracle-masks" else OracleMotion
    known = [field.name for field in dataclasses.fields(oracle) if field.name not in _TRUTH_FIELDS]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise MethodError(f"method {name!r} has no option {unknown[0]!r}: it has {', '.join(known) or 'none'}")
    if name == "oracle-masks":
        return cast(Estimator, oracle(None if truth is None else truth.labels, **options))
    return cast(Estimator, oracle(truth, None if truth is None else truth.background_prev_T_curr, **options))


_TRUTH_FIELDS = frozenset({"labels", "truth", "background_prev_T_curr", "settings"})


def _settings(made: object, options: Mapping[str, Any]) -> dict[str, Any]:
    """What a prediction depends on: every field that can be given, as JSON."""
    values = dict(options)
    if isinstance(made, MovingCamera):
        # The method's own fields, and what it is told of the camera from outside.
        return {**_settings(made.estimator, options), "camera": made.camera}
    if dataclasses.is_dataclass(made) and not isinstance(made, type):
        fields = [field.name for field in dataclasses.fields(made) if field.init and field.name not in _TRUTH_FIELDS]
        values = {name: getattr(made, name) for name in fields}
    return {name: _recorded(value) for name, value in values.items()}


def _recorded(value: Any) -> Any:
    if isinstance(value, (str, Path)) and Path(value).is_file():
        return {"file": Path(value).name, "sha256": hash_file(Path(value))}
    plain = to_plain(value)
    try:
        json.dumps(plain)
    except TypeError:
        return repr(value)
    return plain


def _value(text: str) -> Any:
    """A number, true, false or null as JSON has them; anything else is text."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return text if isinstance(value, (list, dict)) else value


def _known() -> list[str]:
    return [*METHODS, *ORACLES]
