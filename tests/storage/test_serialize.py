"""Dataclasses as plain JSON: round trips, type checks, and settings with defaults."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest

from objectflow.errors import MethodError
from objectflow.storage.serialize import from_plain, settings_from_plain, to_plain


class Range(NamedTuple):
    low: float
    high: float


@dataclass(frozen=True)
class Part:
    name: str
    range: Range
    counts: dict[str, int]


@dataclass(frozen=True)
class Whole:
    parts: tuple[Part, ...]
    size: tuple[int, float]
    note: str | None
    ready: bool


WHOLE = Whole((Part("a", Range(0.5, 2.0), {"x": 1}), Part("b", Range(1.0, 3.0), {})), (3, 0.25), None, True)


def test_dataclasses_survive_json() -> None:
    assert from_plain(Whole, json.loads(json.dumps(to_plain(WHOLE)))) == WHOLE


def test_numbers_that_json_lacks_become_null_and_nan() -> None:
    plain = to_plain({"a": np.float32(0.5), "b": math.inf, "c": (math.nan, np.int64(3))})
    assert plain == {"a": 0.5, "b": None, "c": [None, 3]}
    assert math.isnan(from_plain(float, None))
    assert from_plain(float, 2) == 2.0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"ready": 1}, ValueError, "ready must be of type bool, not 1"),
        ({"size": [3]}, ValueError, "shorter"),
        ({"size": 3}, ValueError, "size must be a list, not 3"),
        ({"size": [3, "0.25"]}, ValueError, "size must be of type float, not '0.25'"),
        ({"parts": [{"name": "a", "range": [0, 1]}]}, KeyError, "counts"),
    ],
)
def test_values_of_another_form_are_refused(change: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        from_plain(Whole, to_plain(WHOLE) | change)


@dataclass(frozen=True)
class Settings:
    rate: float = 0.1
    kind: Literal["one", "two"] = "one"
    stages: tuple[tuple[int, ...], ...] = ((1, 2), (3,))
    pair: tuple[int, int] = (1, 2)
    hidden: list[int] = field(default_factory=list, init=False, repr=False, compare=False)


def settings(values: dict[str, Any]) -> Settings:
    return settings_from_plain(Settings, values, what="network setting", error=MethodError)


def test_absent_settings_take_their_defaults() -> None:
    assert settings({}) == Settings()
    assert settings({"rate": 2, "stages": [[4], [5, 6]]}) == Settings(rate=2.0, stages=((4,), (5, 6)))
    assert settings({"pair": [1, 2, 3]}).pair == (1, 2, 3)  # lengths and choices are checked by the class


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"speed": 1}, "unknown network setting 'speed': choose from rate, kind, stages, pair"),
        ({"rate": "fast"}, "network setting rate must be of type float, not 'fast'"),
        ({"rate": True}, "network setting rate must be of type float, not True"),
        ({"kind": 3}, "network setting kind must be of type str, not 3"),
        ({"stages": [[1], ["a"]]}, "network setting stages must be of type int, not 'a'"),
        ({"stages": [1]}, "network setting stages must be a list, not 1"),
    ],
)
def test_wrong_settings_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        settings(values)
