"""A few thousand mutated inputs at every door; `harness.py` runs more of them by hand."""

from __future__ import annotations

import itertools
import os
import random
from pathlib import Path

import pytest

from fuzz.doors import Read, prepare
from fuzz.harness import ALL_DOORS, fuzz
from objectflow.errors import ReaderError

COUNTS = {"weights": 100, "torch-files": 120, "parquet-bytes": 150, "results": 150, "images": 400, "camera-files": 400,
          "bag-messages": 60, "bag-records": 150, "bag-bytes": 150, "metadata-yaml": 100}  # fmt: skip
"""Numbers of inputs of the doors that do not get 200."""


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> None:
    prepare(tmp_path_factory.mktemp("valid"))


@pytest.mark.parametrize("door", sorted(ALL_DOORS))
def test_nothing_but_our_errors_comes_out(door: str, valid: None, tmp_path: Path) -> None:
    assert fuzz(door, range(COUNTS.get(door, 200)), 0, tmp_path) == []


def test_the_harness_finds_what_it_looks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counter = itertools.count()

    def door(rng: random.Random, folder: Path) -> Read:
        return FAULTS[next(counter)]

    monkeypatch.setitem(ALL_DOORS, "faulty", door)
    monkeypatch.setattr("fuzz.harness.MAX_MEMORY", 50 << 20)
    found = fuzz("faulty", range(len(FAULTS)), 0, tmp_path)
    assert [finding.what.split()[0] for finding in found] == [
        "builtins.KeyError:", "prints", "takes", "takes", "asks", "the",
    ]  # fmt: skip
    assert [finding.number for finding in found] == [1, 2, 3, 4, 5, 6]


def _raise(error: Exception) -> None:
    raise error


FAULTS: list[Read] = [
    lambda: _raise(ReaderError("ours")),
    lambda: _raise(KeyError("op")),
    lambda: os.write(1, b"chatter"),  # below pytest, which replaces sys.stdout
    lambda: bytearray(400 << 20),  # more than commands keep of what they free, so that the process grows
    lambda: bytearray(300 << 20),  # less than the peak of the input before
    lambda: _raise(ReaderError("x: not enough memory")),
    lambda: os._exit(9),
]
"""An error as it should be, then what the harness must find."""
