"""Settings of a method: frozen dataclasses with typed, bounded, documented fields, and the ways to change them.

A method's settings are a tree. A path such as `postprocess.merge.max_loss` names one field of it, in Python
(`objectflow.load(name, **{path: value})`), on the command line (`--set PATH=VALUE`) and in a TOML file.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import itertools
import math
import operator
import sys
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from objectflow.errors import SettingsError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

S = TypeVar("S")


class SettingInfo(NamedTuple):
    """One setting, for help texts.

    Attributes:
        path: dotted.
        kind: what it takes, in words.
        default: as plain JSON.
        documentation: with unit and meaning.
    """

    path: str
    kind: str
    default: Any
    documentation: str


def setting(
    default: Any,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:
    """A field of `Settings` with bounds.

    Args:
        default: its value where nothing else is said.
        minimum, maximum: bounds that the value may reach.
        above, below: bounds that it may not reach.
    """
    bounds = {"minimum": minimum, "maximum": maximum, "above": above, "below": below}
    return dataclasses.field(
        default=default, metadata={name: bound for name, bound in bounds.items() if bound is not None}
    )


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of all settings: checks types and bounds when an instance is made.

    Raises:
        SettingsError: a value of the wrong type or out of bounds; the message names the field.
    """

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            if not field.init:
                continue
            value = converted(getattr(self, field.name), hints[field.name], field.name)
            _check_bounds(value, field.metadata, field.name)
            object.__setattr__(self, field.name, value)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values, nested as the settings are."""
        return {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self) if field.init}


def describe(cls: type[Any], prefix: str = "", base: Any = None) -> list[SettingInfo]:
    """Every setting of a class, nested ones by dotted paths, with its default and documentation.

    Args:
        cls: a settings class.
        prefix: of the paths.
        base: an instance whose values are the defaults, in place of those of the class.
    """
    hints, documentation = typing.get_type_hints(cls), _documentation(cls)
    out: list[SettingInfo] = []
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        hint, default = hints[field.name], _default(field) if base is None else getattr(base, field.name)
        if dataclasses.is_dataclass(hint):
            out += describe(typing.cast(type, hint), f"{prefix}{field.name}.", default)
        else:
            text = documentation.get(field.name, "")
            out.append(SettingInfo(prefix + field.name, _words(hint), _plain(default), text))
    return out


def _documentation(cls: type[Any]) -> dict[str, str]:
    """The docstring below each field, also of base classes."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]).body
        for field, following in itertools.pairwise(body):
            is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
                text = typing.cast(ast.Constant, typing.cast(ast.Expr, following).value).value
                found[field.target.id] = " ".join(str(text).split())
    return found


def flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings as one mapping from dotted paths to values."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            out |= {f"{name}.{rest}": item for rest, item in flat(value).items()}
        else:
            out[name] = value
    return out


def build(cls: type[S], values: Mapping[str, Any]) -> S:
    """An instance of a settings class with some fields changed.

    Args:
        cls: a dataclass whose fields have defaults.
        values: new values by field name or dotted path; nested mappings are allowed.

    Raises:
        SettingsError: an unknown path (the message lists the choices), a wrong type, or a value out of bounds.
    """
    made: S = _build(cls, values, "")
    return made


def _build(cls: type[Any], values: Mapping[str, Any], prefix: str, base: Any = None) -> Any:
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    own: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        name, _, rest = path.partition(".")
        if name not in fields:
            raise _unknown(prefix + name, list(fields), prefix, cls)
        inner = dataclasses.is_dataclass(hints[name])
        if inner and isinstance(value, Mapping):
            nested.setdefault(name, {}).update({f"{rest}.{key}" if rest else key: item for key, item in value.items()})
        elif inner and rest:
            nested.setdefault(name, {})[rest] = value
        elif rest:
            raise SettingsError(f"setting {prefix}{path}: {prefix}{name} is a value and has no fields")
        elif inner and not isinstance(value, hints[name]):
            choices = ", ".join(field.name for field in dataclasses.fields(hints[name]))
            raise SettingsError(
                f"setting {prefix}{name} is a group, not a value: choose one of its fields ({choices})"
            )
        else:
            own[name] = value if inner else converted(value, hints[name], prefix + name)
            _check_bounds(own[name], fields[name].metadata, prefix + name)
    for name, parts in nested.items():
        start = own.get(name, getattr(base, name) if base is not None else _default(fields[name]))
        own[name] = _build(hints[name], parts, f"{prefix}{name}.", start)
    return cls(**own) if base is None else dataclasses.replace(base, **own)


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def parse_assignments(words: Iterable[str]) -> dict[str, str]:
    """`PATH=VALUE` words as a mapping; the last assignment of a path wins.

    Raises:
        SettingsError: a word without "=" or without a path.
    """
    out: dict[str, str] = {}
    for word in words:
        path, equals, value = word.partition("=")
        if not equals or not path.strip():
            raise SettingsError(f"--set takes PATH=VALUE, such as threshold=0.2, not {word!r}")
        out[path.strip()] = value.strip()
    return out


def read_toml(path: Path) -> dict[str, Any]:
    """The settings of a TOML file, nested as its tables are.

    Raises:
        SettingsError: no such file, one that cannot be read, or invalid TOML.
    """
    try:
        if not path.is_file() and path.exists():
            raise SettingsError(f"{path}: cannot be read: it is not a regular file")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such settings file") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SettingsError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: cannot be read: not UTF-8 text") from error
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL
        raise SettingsError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def converted(value: Any, hint: Any, path: str) -> Any:
    """A value as its field's type; text is parsed, so that command lines and Python share one check.

    Raises:
        SettingsError: the value does not fit; the message names `path` and what the field takes.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        is_none = value is None or (isinstance(value, str) and value.lower() == "none")
        if is_none and type(None) in arguments:
            return None
        # Any text fits str, and so comes late; before Path, which would change an address such as hf://OWNER/NAME.
        order = {str: 1, Path: 2}
        for one in sorted((a for a in arguments if a is not type(None)), key=lambda a: order.get(a, 0)):
            try:
                return converted(value, one, path)
            except SettingsError:
                continue
        raise _wrong(path, _words(hint), value)
    if origin is Literal:
        for choice in arguments:
            # Values from the shell are text, also where the choices are numbers.
            if choice == value or str(choice) == value:
                return choice
        raise SettingsError(f"setting {path} must be one of {', '.join(map(str, arguments))}, not {value!r}")
    if origin is tuple:
        items = value
        if isinstance(value, str):
            items = [part.strip(" \"'") for part in value.strip("()[] ").split(",") if part.strip()]
        if not isinstance(items, list | tuple):
            raise _wrong(path, _words(hint), value)
        if arguments[-1] is Ellipsis:
            arguments = (arguments[0],) * len(items)
        if len(items) != len(arguments):
            raise _wrong(path, _words(hint), value)
        return tuple(converted(item, one, path) for item, one in zip(items, arguments, strict=True))
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, typing.cast(type, hint)):
            raise _wrong(path, f"a {typing.cast(type, hint).__name__}", value)
        return value
    return _scalar(value, hint, path)


def _scalar(value: Any, hint: Any, path: str) -> Any:
    if hint is bool:
        words = {"true": True, "false": False, "yes": True, "no": False, "1": True, "0": False}
        found = words.get(value.strip().lower()) if isinstance(value, str) else value
        if not isinstance(found, bool):
            raise _wrong(path, "true or false", value)
        return found
    if hint in (int, float):
        if isinstance(value, bool):
            raise _wrong(path, _words(hint), value)
        try:
            if hint is int and isinstance(value, int | str):
                return int(value)  # not by way of a float, which rounds large numbers
        except ValueError:
            pass
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            raise _wrong(path, _words(hint), value) from None
        if not math.isfinite(number) or (hint is int and number != int(number)):
            raise _wrong(path, _words(hint), value)
        return int(number) if hint is int else number
    if hint is Path and isinstance(value, str | Path):
        return Path(value)
    if getattr(hint, "_is_protocol", False):
        return value
    if isinstance(hint, type) and not isinstance(value, hint):
        raise _wrong(path, _words(hint), value)
    return value


_BOUNDS: dict[str, tuple[str, Callable[[float, float], bool]]] = {
    "minimum": ("at least", operator.ge),
    "maximum": ("at most", operator.le),
    "above": ("above", operator.gt),
    "below": ("below", operator.lt),
}


def _check_bounds(value: Any, bounds: Mapping[str, Any], path: str) -> None:
    values = value if isinstance(value, tuple) else (value,)
    known = {name: bound for name, bound in bounds.items() if name in _BOUNDS}
    wanted = " and ".join(f"{_BOUNDS[name][0]} {bound:g}" for name, bound in known.items())
    for number in values:
        if number is None:
            continue
        if not all(_BOUNDS[name][1](number, bound) for name, bound in known.items()):
            raise SettingsError(f"setting {path} must be {wanted}, not {number:g}")


def _words(hint: Any) -> str:
    names = {int: "a whole number", float: "a finite number", str: "text", Path: "a path", bool: "true or false"}
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return " | ".join(map(str, arguments))
    if typing.get_origin(hint) is tuple and arguments[-1] is Ellipsis:
        return "values"
    if typing.get_origin(hint) is tuple:
        return f"{len(arguments)} values"
    if arguments:
        return " or ".join("none" if one is type(None) else _words(one) for one in arguments)
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _wrong(path: str, wanted: str, value: Any) -> SettingsError:
    return SettingsError(f"setting {path} must be {wanted}, not {value!r}")


def _unknown(path: str, choices: list[str], prefix: str, cls: type[Any]) -> SettingsError:
    if not choices:
        return SettingsError(f"unknown setting {path}: {cls.__name__} has no settings")
    near = difflib.get_close_matches(path.rsplit(".", 1)[-1], choices, n=1)
    hint = f"did you mean {prefix}{near[0]}? " if near else ""
    return SettingsError(f"unknown setting {path}: {hint}choose one of {', '.join(prefix + name for name in choices)}")


def _plain(value: Any) -> Any:
    if isinstance(value, Settings):
        return value.to_dict()
    if isinstance(value, Path):
        return value.name  # paths of one machine do not belong into results
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
