"""The methods to evaluate, as named on the command line; the oracles among them are given the truth."""

from __future__ import annotations

import dataclasses
import hashlib
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
from objectflow.methods.registry import METHODS, find_class, load
from objectflow.motion import SceneMotion
from objectflow.storage.files import hash_file
from objectflow.storage.serialize import to_plain

MAX_FOLDER = 120
"""Length in characters beyond which the folder of a method ends with a hash in place of the rest of its label."""

ORACLES: dict[str, str] = {
    "oracle-masks": "true masks with our rigid fit",
    "oracle-motion": "true motions with our grouping",
}


@runtime_checkable
class SequenceEstimator(Protocol):
    """An estimator that can use more than two frames; it gets whole sequences if the set has any."""

    def estimate_in_sequence(self, frames: Sequence[RgbdFrame], prev: int, curr: int) -> SceneMotion:
        """The motion from `frames[curr]` back to `frames[prev]`, on the pixels of `frames[curr]`."""
        ...


@dataclass(frozen=True)
class MethodSpec:
    """A method with its options.

    Attributes:
        label: its name in the tables.
        name: in `METHODS` or `ORACLES`.
        options: given on the command line.
        settings: every option with its value, including defaults; files by their hash.
    """

    label: str
    name: str
    options: dict[str, Any]
    settings: dict[str, Any]

    @property
    def oracle(self) -> bool:
        """Whether the method is given the truth."""
        return self.name in ORACLES

    @property
    def folder(self) -> str:
        """The label as the name of a folder."""
        name = re.sub(r"^\.|[^\w.=,+-]", "_", self.label)
        return name if len(name) <= MAX_FOLDER else f"{name[:MAX_FOLDER]}~{hashlib.sha256(name.encode()).hexdigest()}"

    def make(self, truth: PairTruth | None = None) -> Estimator:
        """Make the estimator; an oracle needs the truth of its pair.

        Raises:
            ObjectflowError: the method cannot be made.
        """
        return _make(self.name, self.options, truth)


def parse_methods(texts: Sequence[str], *, camera: str = "auto") -> list[MethodSpec]:
    """Parse `name`, `name:option=value,option=value` or `label=name:...`, and make each method once as a check.

    Args:
        texts: one per method.
        camera: for every method without a camera option of its own.

    Raises:
        MethodError: no methods, an unknown one, an unknown option, or two methods with one label.
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
    """Parse one method; see `parse_methods`."""
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
    if camera != "auto" and _knows_camera(name):
        options.setdefault("camera", camera)
    try:
        made = _make(name, options, None)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{text!r}: an option has a value that the method cannot use: {error}") from error
    shown = {key: value for key, value in options.items() if (key, value) != ("camera", "auto")}
    return MethodSpec(label.strip() or text, name, shown, _settings(made, options))


def _knows_camera(name: str) -> bool:
    """Whether a method has the setting `camera`; `zero` and `dense-flow` do the same for any camera."""
    if name in ORACLES:
        return name == "oracle-masks"
    return any(field.name == "camera" for field in dataclasses.fields(cast(Any, find_class(name))))


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
    """Everything that a prediction depends on: every option of the method, as plain JSON."""
    values = dict(options)
    if dataclasses.is_dataclass(made) and not isinstance(made, type):
        fields = [field.name for field in dataclasses.fields(made) if field.init and field.name not in _TRUTH_FIELDS]
        values = {name: getattr(made, name) for name in fields}
    return {name: recorded(value) for name, value in values.items()}


def recorded(value: Any) -> Any:
    """A value of an option as plain JSON: files by name and hash, other objects by their `repr`."""
    if isinstance(value, (str, Path)) and Path(value).is_file():
        return {"file": Path(value).name, "sha256": hash_file(Path(value))}
    plain = to_plain(value)
    try:
        json.dumps(plain)
    except TypeError:
        return repr(value)
    return plain


def _value(text: str) -> Any:
    """A number, true, false or null in JSON notation; anything else is text."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return text if isinstance(value, (list, dict)) else value


def _known() -> list[str]:
    return [*METHODS, *ORACLES]
