"""Exceptions of libraries become errors of objectflow."""

from __future__ import annotations

import pytest

from objectflow.errors import FrameError, ReaderError
from objectflow.storage.foreign import foreign_errors


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        (KeyError("op"), "op is missing"),
        (MemoryError(), "not enough memory"),
        (RecursionError("maximum recursion depth exceeded"), "nested too deeply"),
        (ValueError("first line\nsecond line"), "first line second line"),
        (OSError(22, "Invalid argument"), "Invalid argument"),
        (StopIteration(), "StopIteration"),
        (AssertionError(), "AssertionError"),
    ],
)
def test_every_exception_becomes_the_error(reason: Exception, text: str) -> None:
    with pytest.raises(ReaderError) as caught, foreign_errors(ReaderError, "a.bag: cannot be read"):
        raise reason
    assert str(caught.value) == f"a.bag: cannot be read: {text}"
    assert caught.value.__cause__ is reason


def test_real_recursion_is_caught() -> None:
    def deeper() -> None:
        deeper()

    with pytest.raises(ReaderError, match="nested too deeply"), foreign_errors(ReaderError, "a.yaml"):
        deeper()


def test_errors_of_objectflow_and_interruptions_pass() -> None:
    for kind in (FrameError, KeyboardInterrupt, SystemExit):
        with pytest.raises(kind), foreign_errors(ReaderError, "a.bag"):
            raise kind("as it is")
