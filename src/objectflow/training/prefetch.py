"""Prefetching: a thread pins batches and starts copying them to the device while the previous step computes."""

from __future__ import annotations

import dataclasses
import queue
import threading
from collections.abc import Generator, Iterator
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from objectflow.dataset.batches import Batch

_AHEAD = 2
"""Number of batches that wait on the device."""


def on_device(batches: Iterator[Batch], device: torch.device) -> Iterator[Batch]:
    """The same batches on a device. Closing the iterator closes `batches`.

    On a CPU nothing is copied, and the worker processes of `Batches` already read ahead.
    """
    return copied_ahead(batches, device) if device.type == "cuda" else batches


def copied_ahead(batches: Iterator[Batch], device: torch.device) -> Iterator[Batch]:
    """The same batches, in order, copied to a device by a thread; its errors are raised here.

    Closing the iterator ends the thread and closes `batches`.
    """
    ready: queue.Queue[Batch | BaseException | None] = queue.Queue(_AHEAD)
    done = threading.Event()

    def hand_on(item: Batch | BaseException | None) -> None:
        while not done.is_set():
            with suppress(queue.Full):
                ready.put(item, timeout=0.2)
                break

    def work() -> None:
        try:
            for batch in batches:
                hand_on(_pinned(batch).to(device))
                if done.is_set():
                    break
            hand_on(None)
        except BaseException as error:
            hand_on(error)
        finally:
            if isinstance(batches, Generator):
                batches.close()

    thread = threading.Thread(target=work, name="batches", daemon=True)
    thread.start()
    try:
        while True:
            item = ready.get()
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        done.set()
        thread.join()


def _pinned(batch: Any) -> Any:
    """A dataclass of tensors with its tensors in pinned memory, from which copies are asynchronous."""
    changes = {}
    for field in dataclasses.fields(batch):
        value = getattr(batch, field.name)
        if isinstance(value, Tensor):
            changes[field.name] = value.pin_memory()
        elif dataclasses.is_dataclass(value):
            changes[field.name] = _pinned(value)
    return dataclasses.replace(batch, **changes)
