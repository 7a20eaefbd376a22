"""Errors of libraries that read foreign data, turned into the errors of objectflow."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from objectflow.errors import ObjectflowError


@contextmanager
def foreign_errors(error: type[ObjectflowError], message: str) -> Iterator[None]:
    """Turn every exception inside the `with` block that is not ours into one of ours.

    Damaged data makes decoders, parsers and databases raise almost any exception, including MemoryError and
    RecursionError. The block should contain the call into the library and nothing else.

    Args:
        error: the type to raise.
        message: what failed and where, such as "bag.mcap: cannot be read"; the reason is appended after a colon.

    Raises:
        ObjectflowError: of type `error`; errors of objectflow that are raised inside the block are left as they are.
    """
    try:
        yield
    except ObjectflowError:
        raise
    except Exception as reason:
        raise error(f"{message}: {describe(reason)}") from reason


@contextmanager
def located_errors(error: type[ObjectflowError], message: str) -> Iterator[None]:
    """As `foreign_errors`, but errors of objectflow inside the block are turned into `error` too, with `message`.

    For data that are built from parts whose errors do not know the file.
    """
    with foreign_errors(error, message):
        try:
            yield
        except ObjectflowError as reason:
            raise error(f"{message}: {reason}") from reason


def describe(reason: Exception) -> str:
    """An exception of a library in words."""
    if isinstance(reason, MemoryError):
        return "not enough memory"
    if isinstance(reason, RecursionError):
        return "nested too deeply"
    if isinstance(reason, KeyError) and reason.args and isinstance(reason.args[0], str):
        return f"{reason.args[0]} is missing"
    if isinstance(reason, OSError) and reason.strerror:
        return reason.strerror
    text = str(reason)
    # The text of a StopIteration or AssertionError means nothing without its type.
    return text if len(text.split()) > 2 else f"{type(reason).__name__} {text}".strip()
