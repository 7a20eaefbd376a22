"""Side threads: which works run in them, with how many threads of torch, and errors."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from objectflow.runtime.side_threads import has_side_threads, side_by_side, start_beside


@pytest.fixture(params=[1, 2], ids=["one", "two"])
def count(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_are_in_order(count: int) -> None:
    assert side_by_side(*(lambda k=k: k * k for k in range(7))) == [k * k for k in range(7)]


def test_works_meet_only_where_torch_may_use_several_threads(count: int) -> None:
    meeting = threading.Barrier(2)

    def meet() -> bool:
        try:
            meeting.wait(timeout=10 if count > 1 else 0.05)
        except threading.BrokenBarrierError:
            return False
        return True

    assert side_by_side(meet, meet) == [count > 1] * 2
    assert has_side_threads() == (count > 1)


def test_a_side_thread_computes_with_one_thread_and_others_keep_theirs(count: int) -> None:
    if count == 1:
        pytest.skip("there are no side threads with one thread")

    def threads_of_torch() -> int:
        torch.ones(1_000_000).exp().sum()  # large enough for several threads
        return torch.get_num_threads()

    assert start_beside(threads_of_torch).result() == 1
    assert not start_beside(has_side_threads).result()
    assert torch.get_num_threads() == 2
    with ThreadPoolExecutor(1) as new:
        assert new.submit(threads_of_torch).result() == 2


def test_the_error_of_a_work_is_raised_after_all_have_ended(count: int) -> None:
    ended = []

    def fail() -> None:
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        side_by_side(lambda: ended.append(1), fail)
    assert ended == [1]
