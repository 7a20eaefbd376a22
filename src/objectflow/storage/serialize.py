"""Nested dataclasses as plain JSON values and back, by their type hints: no class names in files, no code executed."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, cast

import numpy as np

from objectflow.errors import ObjectflowError

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Convert dataclasses to dictionaries, tuples to lists, NumPy scalars to Python's, non-finite numbers to None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def from_plain(kind: type[T], value: Any) -> T:
    """The inverse of `to_plain` for dataclasses, named tuples, tuples, mappings and simple values; None is NaN.

    Every field must be present; unknown ones are ignored.

    Raises:
        TypeError, ValueError, KeyError: the value does not have this form.
    """
    return cast(T, _read(kind, value, "value", exact=True))


def settings_from_plain(
    kind: type[T], values: Mapping[str, Any], *, what: str, error: type[ObjectflowError] = ObjectflowError
) -> T:
    """A settings dataclass from plain JSON; absent fields keep their defaults.

    The class itself checks ranges, choices and the lengths of tuples.

    Args:
        kind: a dataclass whose fields all have defaults.
        values: by field name.
        what: the term for a field in messages, such as "network setting".
        error: the type of error to raise.

    Raises:
        ObjectflowError: of type `error`, for an unknown field or a value of another type.
    """
    hints = typing.get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(cast(Any, kind))]
    for name in values:
        if name not in known:
            raise error(f"unknown {what} {name!r}: choose from {', '.join(known)}")
    try:
        arguments = {name: _read(hints[name], value, name, exact=False) for name, value in values.items()}
    except ValueError as reason:
        raise error(f"{what} {reason}") from reason
    return kind(**arguments)


def _read(kind: Any, value: Any, name: str, *, exact: bool) -> Any:
    """Check and convert one value; without `exact`, the lengths of tuples are left to the caller."""
    if kind is Any:
        return value
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        inner = [argument for argument in arguments if argument is not type(None)]
        return None if value is None else _read(inner[0], value, name, exact=exact)
    if origin is Literal:
        return _read(type(arguments[0]), value, name, exact=exact)
    if kind is float and (value is None or type(value) is int):
        return math.nan if value is None else float(value)
    if kind in (float, int, str, bool):
        if type(value) is not kind:
            raise ValueError(f"{name} must be of type {kind.__name__}, not {value!r}")
        return value
    if origin is tuple:
        items = _list(value, name)
        if (len(arguments) == 2 and arguments[1] is Ellipsis) or (not exact and len(items) != len(arguments)):
            return tuple(_read(arguments[0], item, name, exact=exact) for item in items)
        return tuple(_read(one, item, name, exact=exact) for one, item in zip(arguments, items, strict=True))
    if origin is dict:
        return {str(key): _read(arguments[1], item, str(key), exact=exact) for key, item in dict(value).items()}
    if isinstance(kind, type) and issubclass(kind, tuple):  # a named tuple
        hints = typing.get_type_hints(kind)
        pairs = zip(hints.items(), _list(value, name), strict=True)
        return kind(*(_read(hint, item, field, exact=exact) for (field, hint), item in pairs))
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints, names = typing.get_type_hints(kind), [field.name for field in dataclasses.fields(kind)]
        return kind(**{field: _read(hints[field], value[field], field, exact=exact) for field in names})
    raise TypeError(f"no rule for {kind}")


def _list(value: Any, name: str) -> Sequence[Any]:
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list, not {value!r}")
    return value
