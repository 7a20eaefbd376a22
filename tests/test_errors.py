"""Messages are one printable line of bounded length."""

from __future__ import annotations

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from objectflow.errors import MAX_MESSAGE, ObjectflowError, ReaderError, one_line


@given(st.text(max_size=3000))
def test_any_text_becomes_one_printable_line(text: str) -> None:
    line = one_line(text)
    assert len(line) <= MAX_MESSAGE
    assert line.isprintable()
    assert one_line(line) == line


def test_white_space_is_squeezed_and_the_end_is_kept() -> None:
    assert str(ReaderError(" a\n\n  b\tc ")) == "a b c"
    long = f"x.bag: {'y' * 10_000}: copy the file again"
    message = str(ReaderError(long))
    assert message.startswith("x.bag: yyy")
    assert message.endswith("yyy: copy the file again")
    assert len(message) == MAX_MESSAGE


@pytest.mark.parametrize(("text", "line"), [("a\x1b[2Jb\0c", r"a\x1b[2Jb\x00c"), ("\udcff.png", r"\udcff.png")])
def test_control_characters_do_not_reach_the_terminal(text: str, line: str) -> None:
    assert str(ObjectflowError(text)) == line


def test_an_error_survives_pickling() -> None:
    error = pickle.loads(pickle.dumps(ReaderError("a\nb")))
    assert type(error) is ReaderError
    assert str(error) == "a b"
