"""Messages that are compressed one by one, as `ros2 bag record --compression-mode message` writes them."""

from __future__ import annotations

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of compressed data; a serialised message of ROS 2 starts with 0."""
MAX_MESSAGE_BYTES = 1 << 29
"""Largest message that is decompressed, bytes: 64 megapixels of 64 bits."""

HEAD_BYTES = 1 << 18
"""Number of compressed bytes that certainly hold the first block of a message, which has at most 128 KiB."""


def unpack_message(data: bytes) -> bytes:
    """Decompress a message if it is compressed.

    Raises:
        ValueError: it is larger than `MAX_MESSAGE_BYTES`.
        zstd.ZstdError: it is damaged.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    content = unpack_head(data, MAX_MESSAGE_BYTES)
    if len(content) == MAX_MESSAGE_BYTES:
        raise ValueError("a message is too large")
    return content


def unpack_head(data: bytes, size: int) -> bytes:
    """The first `size` bytes of a compressed message, or all of a shorter one.

    Args:
        data: the start of the compressed message, or all of it.
        size: number of bytes after decompression.

    Raises:
        zstd.ZstdError: the data are damaged.
    """
    from backports import zstd

    decompressor = zstd.ZstdDecompressor()
    parts, length, rest = [], 0, data
    while length < size and not decompressor.eof:
        part = decompressor.decompress(rest, size - length)
        if not part:
            break
        parts.append(part)
        length += len(part)
        rest = b""
    return b"".join(parts)
