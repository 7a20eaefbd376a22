"""Seeded mutations of bytes, of plain JSON values and of lines of text."""

from __future__ import annotations

import copy
import random
from typing import Any

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32, 2**63, 2**64, 10**30, -(10**9), 1e308, -1e308,
    5e-324, float("nan"), float("inf"), float("-inf"), 0.5, 1e-9, True, False,
)  # fmt: skip
TEXTS = (
    "", "a", "a/b", "../../etc/passwd", "/dev/zero", "a\nb", "a\0b", "\ud800", "x" * 5000, "%s%n", "<script>",
    "\x1b[2J", "NaN", "1e400", "[" * 3000, "é" * 300, "-", ".", "..", "true",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, [], {}, [[]], [1], ["a"], {"a": 1}, [[[1]]], [0] * 1000)
WORDS = (b"\0", b"\xff", b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\x80", b"\n", b"PK", b"\xff\xd8")


def hostile(rng: random.Random) -> Any:
    """A value of a wrong type, size or sign."""
    others = copy.deepcopy(rng.choice(OTHERS))
    return rng.choice((rng.choice(NUMBERS), rng.choice(TEXTS), others, rng.uniform(-10, 10)))


def bytes_of(rng: random.Random, data: bytes) -> bytes:
    """One to four damages: changed bits, words and lengths, cuts, repetitions and zeros."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(out) + 1)
        if rng.random() < 0.4:  # headers are short, but most of what is parsed is in them
            at = min(at, rng.randrange(200))
        kind = rng.randrange(8)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            word = rng.choice(WORDS)
            out[at : at + len(word)] = word
        elif kind == 2:
            number = rng.choice((0, 1, 255, len(out), len(out) * 2, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1))
            size = rng.choice((1, 2, 4, 8))
            out[at : at + size] = (number % 256**size).to_bytes(size, rng.choice(("big", "little")))
        elif kind == 3:
            del out[at:]
        elif kind == 4:
            del out[at : at + rng.choice((1, 4, 64, 1000))]
        elif kind == 5:
            length = rng.choice((1, 4, 64, 1000))
            out[at:at] = out[at : at + length]
        elif kind == 6:
            length = rng.choice((4, 64, 1000))
            out[at : at + length] = bytes(min(length, max(0, len(out) - at)))
        else:
            out[at : at + 1] = rng.randbytes(rng.randrange(1, 9))
    return bytes(out)


def value_of(rng: random.Random, value: Any) -> Any:
    """A deep copy of a JSON value with one to three of its parts replaced, removed or repeated."""
    box = [copy.deepcopy(value)]
    for _ in range(rng.choice((1, 1, 2, 3))):
        place: Any = box
        key: Any = 0
        while isinstance(place[key], (dict, list)) and place[key] and rng.random() < 0.85:
            place = place[key]
            key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
        kind = rng.randrange(6)
        if kind == 0 and place is not box:
            del place[key]
        elif kind == 1 and isinstance(place, list) and place is not box:
            place.extend(copy.deepcopy(place[key]) for _ in range(rng.choice((1, 3, 300))))
        elif kind == 2 and isinstance(place, dict):
            place[rng.choice(TEXTS)] = copy.deepcopy(place[key])
        elif kind == 3 and isinstance(place[key], (int, float)):
            place[key] = place[key] * rng.choice((-1, 0, 10, 1e6, 1e-6)) + rng.choice((0, 1, -1))
        else:
            place[key] = hostile(rng)
    return box[0]


def lines_of(rng: random.Random, text: str) -> str:
    """Lines of text with words replaced, and with lines removed, repeated and moved."""
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(lines))
        kind = rng.randrange(5)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines[at:at] = [lines[at]] * rng.choice((1, 5, 500))
        elif kind == 2:
            lines.append(lines.pop(at))
        else:
            words = lines[at].split(" ")
            words[rng.randrange(len(words))] = str(hostile(rng))
            lines[at] = " ".join(words)
        lines = lines or [""]
    return "\n".join(lines)
