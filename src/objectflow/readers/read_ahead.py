"""Reading of the next frame while the current one is used."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.readers.sequence import FrameSource
from objectflow.runtime.quiet import silence_stderr


class ReadAhead:
    """A `FrameSource` that reads the frames of another one in a thread, and the next frame in advance.

    All frames are read in that one thread, because a source need not be safe for use by several.

    Args:
        source: the frames.
        order: the frame numbers in the order in which they will be asked for.
    """

    def __init__(self, source: FrameSource, order: Sequence[int]) -> None:
        self._source = source
        self._next = dict(itertools.pairwise(order))
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead")
        self._waiting: dict[int, Future[RgbdFrame]] = {}

    @property
    def camera(self) -> Camera:
        """See `FrameSource`."""
        return self._source.camera

    @property
    def depth_scale(self) -> float:
        """See `FrameSource`."""
        return self._source.depth_scale

    @property
    def cuts(self) -> tuple[int, ...]:
        """See `FrameSource`."""
        return self._source.cuts

    @property
    def notes(self) -> tuple[str, ...]:
        """See `FrameSource`."""
        return self._source.notes

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> RgbdFrame:
        """The frame that was read in advance, or else read now; the one after it is then read.

        Raises:
            ReaderError, FrameError: of the source.
        """
        expected = index in self._waiting
        future = self._waiting.pop(index) if expected else self._pool.submit(self._read, index)
        # A frame that is read a second time does not replace the one that was read in advance.
        if index in self._next and (expected or not self._waiting):
            following = self._next[index]
            self._waiting = {following: self._pool.submit(self._read, following)}
        return future.result()

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def timestamp(self, index: int) -> float | None:
        """See `FrameSource`."""
        return self._source.timestamp(index)

    def __enter__(self) -> ReadAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _read(self, index: int) -> RgbdFrame:
        with silence_stderr():
            return self._source[index]
