"""Nested dataclasses to JSON and back, by their type hints: no class names in the file, nothing executed."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast

import numpy as np

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Dataclasses to dictionaries, tuples to lists, NumPy scalars to Python's, NaN and infinities to None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(one) for key, one in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(one) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def from_plain(kind: type[T], value: Any) -> T:
    """The inverse of `to_plain` for dataclasses, named tuples, tuples, mappings and simple values; None is NaN.

    Raises:
        TypeError, ValueError, KeyError: the value does not have this form.
    """
    return cast(T, _read(kind, value))


def _read(kind: Any, value: Any) -> Any:
    if kind is Any:
        return value
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        inner = [one for one in arguments if one is not type(None)]
        return None if value is None else _read(inner[0], value)
    if kind is float:
        return math.nan if value is None else float(value)
    if kind in (int, str, bool):
        if type(value) is not kind:
            raise ValueError(f"expected {kind.__name__}, not {value!r}")
        return value
    if origin is tuple:
        items = _list(value)
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_read(arguments[0], one) for one in items)
        return tuple(_read(one, item) for one, item in zip(arguments, items, strict=True))
    if origin is dict:
        return {str(key): _read(arguments[1], one) for key, one in dict(value).items()}
    if isinstance(kind, type) and issubclass(kind, tuple):  # a named tuple
        hints = typing.get_type_hints(kind)
        return kind(*(_read(hints[name], item) for name, item in zip(hints, _list(value), strict=True)))
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return kind(**{field.name: _read(hints[field.name], value[field.name]) for field in dataclasses.fields(kind)})
    raise TypeError(f"no rule for {kind}")


def _list(value: Any) -> Sequence[Any]:
    if not isinstance(value, list):
        raise ValueError(f"expected a list, not {value!r}")
    return value
