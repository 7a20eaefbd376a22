"""Decompression of the chunks of a bag, with limits on their size and on the total work of a scan."""

from __future__ import annotations

from collections import OrderedDict

from objectflow.readers.bag_records import ChunkPlace, MemorySpan, Span, decompress

KEPT_CHUNKS = 2
"""Number of decompressed chunks that are kept: the messages of a frame may lie in two."""
MAX_EXPANSION = 200
"""Largest ratio of the decompressed bytes of a whole file to its size, beyond `FREE_EXPANSION_BYTES`."""
FREE_EXPANSION_BYTES = 4 << 30
"""Bytes that any file may decompress to."""


class ChunkReader:
    """Decompresses the chunks of one file; the last ones are kept.

    Attributes:
        damaged: number of chunks that could not be decompressed.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._expanded = 0
        self._kept: OrderedDict[ChunkPlace, MemorySpan] = OrderedDict()

    def unpack(self, file: Span, place: ChunkPlace) -> MemorySpan | None:
        """Decompress a chunk during the scan; None, counted as damaged, if that fails.

        Raises:
            TruncatedFileError: the file ends within the chunk.
        """
        data = file.read(place.start, place.size)
        self._expanded += max(0, place.unpacked)
        try:
            if self._expanded > FREE_EXPANSION_BYTES + MAX_EXPANSION * file.size:
                raise ValueError("the chunks of the file expand without limit")
            return MemorySpan(decompress(data, place.compression, place.unpacked))
        except Exception:
            # The decompressors raise errors of many types; the chunks after this one may be intact.
            self.damaged += 1
            return None

    def read(self, file: Span, place: ChunkPlace) -> MemorySpan:
        """Decompress a chunk, or return it if it was read lately; the errors are those of the decompressor."""
        span = self._kept.pop(place, None)
        if span is None:
            span = MemorySpan(decompress(file.read(place.start, place.size), place.compression, place.unpacked))
        self._kept[place] = span
        while len(self._kept) > KEPT_CHUNKS:
            self._kept.popitem(last=False)
        return span
