"""Prefetching of batches without a CUDA device: order, errors, and early termination."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from typing import Any

import pytest
import torch

from helpers.training_runs import write_set
from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.shards import open_pairs
from objectflow.errors import DatasetError
from objectflow.training.prefetch import copied_ahead

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def batches(tmp_path_factory: pytest.TempPathFactory) -> list[Batch]:
    source = Batches(open_pairs(write_set(tmp_path_factory.mktemp("set"))), 2, size=None, seed=0)
    return list(source.one_pass())


@pytest.fixture(autouse=True)
def no_pinned_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only CUDA's driver pins memory."""

    def same(tensor: torch.Tensor) -> torch.Tensor:
        return tensor

    monkeypatch.setattr(torch.Tensor, "pin_memory", same)


def ahead(source: Iterator[Batch]) -> Generator[Batch, None, None]:
    out: Any = copied_ahead(source, CPU)
    return out


def test_batches_come_in_order_and_unchanged(batches: list[Batch]) -> None:
    feed = ahead(iter(batches))
    for expected, got in zip(batches, feed, strict=True):
        assert got.keys == expected.keys
        assert torch.equal(got.curr_color, expected.curr_color)
        assert torch.equal(got.table.label, expected.table.label)


def test_an_error_is_raised_after_the_batches_before_it(batches: list[Batch]) -> None:
    def breaks() -> Iterator[Batch]:
        yield batches[0]
        raise DatasetError("row 7 is damaged")

    feed = ahead(breaks())
    assert next(feed).keys == batches[0].keys
    with pytest.raises(DatasetError, match="row 7 is damaged"):
        next(feed)


def test_closing_ends_the_thread_and_the_batches(batches: list[Batch]) -> None:
    closed = threading.Event()

    def endless() -> Iterator[Batch]:
        try:
            while True:
                yield from batches
        finally:
            closed.set()

    feed = ahead(endless())
    next(feed)
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "batches")
    feed.close()
    assert closed.is_set()
    assert not thread.is_alive()
