"""Reading ahead: the same frames, errors at their own frame, and the next frame while the current one is used."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from objectflow.errors import ReaderError
from objectflow.readers.read_ahead import ReadAhead


class Source:
    """Frames that are numbers; frame 3 cannot be read."""

    camera, depth_scale, cuts, notes = SimpleNamespace(), 1000.0, (2,), ("a note",)

    def __init__(self) -> None:
        self.read: list[int] = []
        self.threads: set[int] = set()
        self.done = {index: threading.Event() for index in range(6)}

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index: int) -> Any:
        self.read.append(index)
        self.threads.add(threading.get_ident())
        self.done[index].set()
        if index == 3:
            raise ReaderError("frame 3 is broken")
        return f"frame {index}"

    def timestamp(self, index: int) -> float:
        return 0.1 * index


def test_the_next_frame_is_read_while_the_current_one_is_used() -> None:
    source = Source()
    with ReadAhead(source, [0, 2, 4]) as ahead:  # type: ignore[arg-type]
        assert ahead[0] == "frame 0"
        assert source.done[2].wait(5)
        assert not source.done[4].is_set()
        assert ahead[2] == "frame 2"
        assert source.done[4].wait(5)
        assert ahead[4] == "frame 4"
    assert source.read == [0, 2, 4]
    assert len(source.threads) == 1
    assert threading.get_ident() not in source.threads


def test_frames_in_any_order_and_errors_at_their_frame() -> None:
    source = Source()
    with ReadAhead(source, range(6)) as ahead:  # type: ignore[arg-type]
        assert [ahead[index] for index in (0, 1, 0, 2)] == [f"frame {index}" for index in (0, 1, 0, 2)]
        with pytest.raises(ReaderError, match="frame 3"):
            ahead[3]
        assert ahead[4] == "frame 4"
        assert (len(ahead), ahead.cuts, ahead.notes, ahead.timestamp(2)) == (6, (2,), ("a note",), 0.2)
    assert source.read.count(1) == 1
